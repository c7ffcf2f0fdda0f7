"""Checks of arguments.

An error names the argument, what was expected and what came. All implementations have the same `require` functions.
"""

from collections.abc import Iterable, Mapping
from types import EllipsisType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spec.spaces import Discrete, Image, Spaces

LISTED = 8  # problems that one message names


def checked(name: str, value: Any, *expected: int | str | EllipsisType) -> NDArray[np.float64]:
    """`value` as a float64 array, after its shape was compared with `expected`. Implements [CON-8].

    Args:
      name: what the message calls the argument.
      value: anything that converts to an array of real numbers.
      expected: see `require_shape`.

    Raises:
      ValueError: the shape differs; the message holds the name, the expected shape and the shape that came.
    """
    array = np.asarray(value, dtype=np.float64)
    require_shape(name, array.shape, *expected)
    return array


def require(condition: bool, name: str, expected: object, got: object) -> None:
    """Raises ValueError unless the condition holds."""
    if not condition:
        raise ValueError(f"{name}: expected {expected}, got {got}")


def require_shape(name: str, shape: tuple[int, ...], *expected: int | str | EllipsisType) -> None:
    """Raises ValueError unless the shape is the expected one. [CON-8]

    expected: for each axis its length, or a letter for any length; a leading `...` stands for any number of axes.
    """
    axes = expected[1:] if expected[:1] == (...,) else expected
    last = shape[max(0, len(shape) - len(axes)) :] if len(axes) < len(expected) else shape
    if last == axes:  # the usual case, at little cost: a train step of eager code comes here a thousand times
        return
    fits = [isinstance(axis, str) or axis == length for axis, length in zip(axes, last, strict=False)]
    if len(last) != len(axes) or not all(fits):
        wanted = ", ".join("..." if axis is ... else str(axis) for axis in expected)
        raise ValueError(f"{name}: expected shape [{wanted}], got {list(shape)}")


def require_keys(name: str, given: Iterable[str], expected: Iterable[str], exactly: bool = False) -> None:
    """Raises ValueError unless all expected keys are given and, with `exactly`, no others."""
    given, expected = set(given), set(expected)
    if exactly or not expected <= given:
        _refuse(name, _differences(given, expected))


def require_shapes(name: str, arrays: Mapping[str, Any], expected: Mapping[str, tuple[int, ...]]) -> None:
    """Raises ValueError unless the arrays have exactly these names and shapes. [CON-8]"""
    differing = [key for key in expected if key in arrays and np.shape(arrays[key]) != expected[key]]
    wrong = [f"{key!r}: expected shape {list(expected[key])}, got {list(np.shape(arrays[key]))}" for key in differing]
    _refuse(name, _differences(set(arrays), set(expected)) + wrong)


def _differences(given: set[str], expected: set[str]) -> list[str]:
    missing, unknown = sorted(expected - given), sorted(given - expected)
    return [f"missing {key!r}" for key in missing] + [f"unknown {key!r}" for key in unknown]


def _refuse(name: str, problems: list[str]) -> None:
    """Raises ValueError if there are problems, and names the first few: a parameter table has hundreds of entries."""
    if problems:
        more = [f"{len(problems) - LISTED} more"] if len(problems) > LISTED else []
        raise ValueError(f"{name}: {'; '.join(problems[:LISTED] + more)}")


def require_observations(
    name: str, observations: Mapping[str, Any], spaces: Spaces, leading: tuple[Any, ...] = (...,)
) -> tuple[int, ...]:
    """The leading axes of all observations, after checks of names, dtypes and shapes.
    Implements [NET-2], [NET-4], [NET-6], [NET-27].

    Args:
      name: what the message calls the mapping.
      observations: key -> [..., *array_shape], raw; other keys are ignored.
      leading: what the leading axes must be, in the notation of `require_shape`.

    Raises:
      ValueError: naming the key.
    """
    require_keys(name, observations, spaces.observations)
    for key, space in spaces.observations.items():
        x = np.asarray(observations[key])
        require_shape(f"{name}[{key!r}]", x.shape, *leading, *space.array_shape)
        leading = x.shape[: x.ndim - len(space.array_shape)]  # the first key's, for all others
        if isinstance(space, Image):
            require(x.dtype == np.uint8, f"{name}[{key!r}]", "dtype uint8", x.dtype)
        elif isinstance(space, Discrete):
            require(np.issubdtype(x.dtype, np.integer), f"{name}[{key!r}]", "an integer dtype", x.dtype)
    return leading
