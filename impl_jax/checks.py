"""Errors that name the argument, what was expected and what came. Shapes are static, so none of this costs anything in
compiled code."""

from typing import Any


def require(condition: bool, name: str, expected: str, got: Any) -> None:
    """Raises ValueError unless the condition holds."""
    if not condition:
        raise ValueError(f"{name}: expected {expected}, got {got}")


def require_shape(name: str, array: Any, *expected: int | str) -> None:
    """Raises ValueError unless the array has this shape; a string stands for any length."""
    shape = tuple(array.shape)
    fits = len(shape) == len(expected) and all(
        isinstance(e, str) or n == e for n, e in zip(shape, expected, strict=True)
    )
    require(fits, name, f"shape [{', '.join(map(str, expected))}]", f"shape {list(shape)}")


def require_trailing(name: str, array: Any, *expected: int | str) -> None:
    """Raises ValueError unless the last axes of the array are these."""
    shape = tuple(array.shape)
    tail = shape[len(shape) - len(expected) :] if len(shape) >= len(expected) else None
    fits = tail is not None and all(isinstance(e, str) or n == e for n, e in zip(tail, expected, strict=True))
    require(fits, name, f"shape [..., {', '.join(map(str, expected))}]", f"shape {list(shape)}")


def require_same_shape(**arrays: Any) -> None:
    """Raises ValueError unless all arrays have the shape of the first."""
    (first, reference), *others = arrays.items()
    for name, array in others:
        require(
            array.shape == reference.shape,
            name,
            f"the shape {list(reference.shape)} of {first}",
            f"shape {list(array.shape)}",
        )
