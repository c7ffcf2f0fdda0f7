"""What the cases are drawn from: numbers that break implementations, and arrays of them."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import hypothesis.strategies as st
import numpy as np

BIN_EDGE = float(np.expm1(20.0))

_ordinary = False


@contextmanager
def ordinary_numbers(only: bool) -> Iterator[None]:
    """While this context lasts, and if `only`, adversarial numbers and logits are neither special nor tiny nor huge."""
    global _ordinary
    before, _ordinary = _ordinary, only
    try:
        yield
    finally:
        _ordinary = before


def adversarial_numbers(finite: bool = False) -> st.SearchStrategy[float]:
    """Both zeros, subnormals, ordinary, huge, bin edges and their float neighbours, and unless `finite` the infinities
    and NaN."""
    if _ordinary:
        return st.one_of(st.sampled_from([0.0, 1.0, -1.0, 300.0]), st.integers(-1024, 1024).map(lambda n: n / 64))
    special = [0.0, -0.0, 1e-45, -1e-45, 1e-310, 1e-38, 1.0, -1.0, 1e-8, 0.1, 300.0, 1e30, -1e30, 3e38, -3e38]
    edges = [sign * float(np.nextafter(BIN_EDGE, towards)) for sign in (1, -1) for towards in (0.0, BIN_EDGE, 1e300)]
    choices = [
        st.sampled_from(special + edges),
        st.floats(-1e9, 1e9, allow_nan=False, width=32),
        st.floats(-3, 3, allow_nan=False, width=32),
    ]
    if not finite:
        choices.append(st.sampled_from([np.inf, -np.inf, np.nan]))
    return st.one_of(choices)


def adversarial_logits() -> st.SearchStrategy[float]:
    """Ordinary logits, both zeros, a subnormal, ones that are far apart, and minus infinity; see `ordinary_numbers`."""
    if _ordinary:
        return st.one_of(st.sampled_from([0.0, 100.0]), st.integers(-1280, 1280).map(lambda n: n / 64))
    special = st.sampled_from([0.0, -0.0, 1e-45, 100.0, -1e4, 1e30, -1e30, -math.inf])
    return st.one_of(st.floats(-20, 20, width=32), special)


@st.composite
def arrays(draw: Any, elements: st.SearchStrategy[float], shape: tuple[int, ...]) -> np.ndarray:
    """A float64 array whose every element is drawn."""
    size = int(np.prod(shape))
    return np.array(draw(st.lists(elements, min_size=size, max_size=size)), np.float64).reshape(shape)


def seeds() -> st.SearchStrategy[int]:
    """For arrays too large to draw number by number: a seed that hypothesis varies."""
    return st.integers(0, 2**32 - 1)


def normals(seed: int, *shape: int, scale: float = 1.0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, scale, shape)


SHAPES = ((), (1,), (4,), (2, 3), (3, 1, 2))
"""Of elementwise functions: few, since a candidate that compiles does so for each."""
