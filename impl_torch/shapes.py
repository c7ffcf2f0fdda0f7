"""Checks of arguments, and the precisions of a configuration.

An error names the argument, what was expected and what came. All implementations have the same `require` functions.
"""

from collections.abc import Iterable, Mapping
from types import EllipsisType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spec import Config, Discrete, Image, Spaces

Observations = Mapping[str, Tensor]

LISTED = 8  # problems that one message names
DTYPES = {"float64": torch.float64, "float32": torch.float32, "bfloat16": torch.bfloat16}


def compute_dtype(config: Config) -> torch.dtype:
    """Of activations. [CON-23]"""
    return DTYPES[config.compute_dtype]


def wide_dtype(config: Config) -> torch.dtype:
    """Of parameters, losses and everything else that is never narrower than float32. [CON-22] [CON-23]"""
    return torch.float64 if config.compute_dtype == "float64" else torch.float32


def widen(x: Tensor) -> Tensor:
    """x in float32 or float64: lower precisions, integers and booleans become float32. [TRA-1] [DIS-1]"""
    return x if x.dtype in (torch.float32, torch.float64) else x.float()


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


def require_same_shape(**arrays: Tensor) -> None:
    """Raises ValueError unless all arrays have the shape of the first. [CON-8]"""
    (_, first), *others = arrays.items()
    for name, array in others:
        require_shape(name, array.shape, *first.shape)


def require_observations(
    name: str, observations: Observations, spaces: Spaces, leading: tuple[Any, ...] = (...,)
) -> tuple[int, ...]:
    """The leading axes of all observations, after checks of names, dtypes and shapes. [NET-2] [NET-4] [NET-6] [NET-27]

    leading: what these axes must be, in the notation of `require_shape`.

    Raises:
      ValueError: naming the key. Classes of a Discrete are not looked at: that would wait for an accelerator.
    """
    require_keys(name, observations, spaces.observations)
    for key, space in spaces.observations.items():
        x = observations[key]
        require_shape(f"{name}[{key!r}]", x.shape, *leading, *space.array_shape)
        leading = x.shape[: x.ndim - len(space.array_shape)]  # the first key's, for all others
        if isinstance(space, Image):
            require(x.dtype == torch.uint8, f"{name}[{key!r}]", "dtype uint8", x.dtype)
        elif isinstance(space, Discrete):
            whole = not x.is_floating_point() and x.dtype != torch.bool
            require(whole, f"{name}[{key!r}]", "an integer dtype", x.dtype)
    return leading
