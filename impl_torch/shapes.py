"""Errors that name the argument, what was expected and what came ([CON-8]), and the precisions of a configuration
([CON-23])."""

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

from spec import Config

DTYPES = {"float64": torch.float64, "float32": torch.float32, "bfloat16": torch.bfloat16}


def compute_dtype(config: Config) -> torch.dtype:
    """Of activations."""
    return DTYPES[config.compute_dtype]


def wide_dtype(config: Config) -> torch.dtype:
    """Of parameters, losses and everything else that is never narrower than float32."""
    return torch.float64 if config.compute_dtype == "float64" else torch.float32


def widen(x: Tensor) -> Tensor:
    """x in float32 or float64: lower precisions, integers and booleans become float32."""
    return x if x.dtype in (torch.float32, torch.float64) else x.float()


def expect(condition: bool, name: str, expected: object, came: object) -> None:
    """Raises ValueError unless the condition holds."""
    if not condition:
        raise ValueError(f"{name}: expected {expected}, got {came}")


def expect_shape(name: str, x: Tensor, expected: Iterable[int]) -> None:
    """Raises ValueError unless x has exactly this shape."""
    expected = tuple(expected)
    if x.shape != expected:
        raise ValueError(f"{name}: expected shape {list(expected)}, got {list(x.shape)}")


def expect_last(name: str, x: Tensor, *expected: int) -> None:
    """Raises ValueError unless the last axes of x are these; any leading axes are fine."""
    if x.shape[max(0, x.ndim - len(expected)) :] != expected:
        axes = ", ".join(map(str, expected))
        raise ValueError(f"{name}: expected shape [..., {axes}], got {list(x.shape)}")


def expect_same_shape(**arrays: Tensor) -> None:
    """Raises ValueError unless all arrays have the shape of the first."""
    (first, reference), *others = arrays.items()
    for name, x in others:
        if x.shape != reference.shape:
            raise ValueError(f"{name}: expected shape {list(reference.shape)}, that of {first}, got {list(x.shape)}")


def expect_keys(name: str, mapping: Mapping[str, object], expected: Iterable[str], exactly: bool = False) -> None:
    """Raises ValueError unless the mapping has the expected keys; with `exactly`, no others."""
    expected = set(expected)
    missing, unexpected = sorted(expected - set(mapping)), sorted(set(mapping) - expected) if exactly else []
    if missing or unexpected:
        parts = [f"{what} {keys}" for what, keys in (("missing", missing), ("unexpected", unexpected)) if keys]
        raise ValueError(f"{name}: {'; '.join(parts)}")
