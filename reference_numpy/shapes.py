"""Shape checks shared by the modules of the reference."""

from types import EllipsisType
from typing import Any

import numpy as np
from numpy.typing import NDArray


def checked(name: str, value: Any, *expected: int | str | EllipsisType) -> NDArray[np.float64]:
    """`value` as a float64 array, after its shape was compared with `expected`. Implements [CON-8].

    Args:
      name: what the message calls the argument.
      value: anything that converts to an array of real numbers.
      expected: one entry for each axis: a length, or a letter for any length; a leading `...` stands for any number of
        axes.

    Raises:
      ValueError: the shape differs; the message holds the name, the expected shape and the shape that came.
    """
    array = np.asarray(value, dtype=np.float64)
    require_shape(name, array.shape, *expected)
    return array


def require_shape(name: str, shape: tuple[int, ...], *expected: int | str | EllipsisType) -> None:
    """Compares a shape with `expected`, in the notation of `checked`. Implements [CON-8].

    Raises:
      ValueError: they differ.
    """
    axes = expected[1:] if expected and expected[0] is ... else expected
    last = shape[len(shape) - len(axes) :] if len(shape) >= len(axes) else shape
    fits = len(shape) == len(axes) or (len(axes) < len(expected) and len(shape) > len(axes))
    if not fits or any(isinstance(axis, int) and axis != length for axis, length in zip(axes, last, strict=True)):
        wanted = ", ".join("..." if axis is ... else str(axis) for axis in expected)
        raise ValueError(f"{name}: expected shape [{wanted}], got [{', '.join(map(str, shape))}]")
