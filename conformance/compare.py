"""What counts as equal: precisions, tolerances, and the comparison of results with what is right."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from conformance.case import Call, Case

DTYPES = ("float64", "float32", "bfloat16")
EPSILON = {"float64": 2.0**-52, "float32": 2.0**-23, "bfloat16": 2.0**-7}
SMALLEST_NORMAL = {"float64": 2.0**-1022, "float32": 2.0**-126, "bfloat16": 2.0**-126}
# Rounding of one function, relative to the magnitude of what it sums. float64 is held to 1e-12; the others to multiples
# of their epsilon.
BOUND = {"float64": 1e-12, "float32": 64 * EPSILON["float32"], "bfloat16": 16 * EPSILON["bfloat16"]}
WIDE = {"float64": "float64", "float32": "float32", "bfloat16": "float32"}
"""Precision of losses, returns and transforms: float32 or better."""
HUGE, TINY = 1e9, 1e-30  # sizes between which a number is ordinary; the outermost bins are below

Path = tuple[str | int, ...]
"""Where in a nested result a part stands: keys of mappings and places in tuples."""


class Deviation(AssertionError):
    """The candidate and the reference disagree.

    got and expected: the two arrays, None where no arrays were compared. index: of the worst element, None where shapes
    differ.
    """

    def __init__(
        self,
        message: str,
        got: np.ndarray | None = None,
        expected: np.ndarray | None = None,
        index: tuple[int, ...] | None = None,
    ) -> None:
        super().__init__(message)
        self.got, self.expected, self.index = got, expected, index


class CandidateLost(BaseException):
    """The candidate is gone in the middle of a check. Not an Exception: no smaller case is searched for."""


@dataclasses.dataclass
class Worst:
    """The worst comparison of a check: deviation as a share of its bound, the deviation itself, and where."""

    share: float = 0.0
    deviation: float = 0.0
    where: str = ""


class Comparisons:
    """Compares results in one precision, and remembers the worst.

    `compared` counts numbers compared, so that a check that compares nothing can be told from one that passes. `call`
    is the last one that was made, whose results are compared; `case` is the one that it belongs to, None in a script,
    and `drawn` whether hypothesis draws values there.
    """

    def __init__(self, dtype: str) -> None:
        self.dtype = dtype
        self.worst = Worst()
        self.compared = 0
        self.call: Call | None = None
        self.left_out: list[str] = []
        self.case: Case | None = None
        self.drawn = False

    def compare(
        self,
        where: str,
        actual: Any,
        expected: Any,
        *,
        magnitude: Any = None,
        factor: float = 1.0,
        bound: float | None = None,
    ) -> None:
        """Raises `Deviation` unless |actual - expected| <= bound * magnitude, elementwise, in every array of a nested
        result.

        magnitude: what rounding is relative to. None: |expected| of each element; "tensor": the largest |expected| of
        the array; or an array (for sums: the sum of the magnitudes of the terms). factor: multiplies the bound of the
        dtype, for longer computations. bound: replaces it. NaN must meet NaN and an infinity the same infinity.
        """
        if isinstance(expected, Mapping):
            if not isinstance(actual, Mapping) or set(actual) != set(expected):
                got = sorted(actual) if isinstance(actual, Mapping) else type(actual).__name__
                self.fail(where, f"{where}: expected the keys {sorted(expected)}, got {got}")
        elif isinstance(expected, tuple):
            if not isinstance(actual, tuple | list) or len(actual) != len(expected):
                self.fail(where, f"{where}: expected {len(expected)} results, got {actual!r:.80}")
        else:
            allowed = BOUND[self.dtype] * factor if bound is None else bound
            self.compare_arrays(where, actual, expected, magnitude, allowed)
            return
        for key in entries(expected):
            part = magnitude[key] if isinstance(magnitude, Mapping | tuple) else magnitude
            self.compare(f"{where}[{key}]", actual[key], expected[key], magnitude=part, factor=factor, bound=bound)

    def exact(self, where: str, actual: Any, expected: Any) -> None:
        """Raises `Deviation` unless equal in every bit but the sign of zero."""
        self.compare_arrays(where, actual, expected, 1.0, 0.0)

    def holds(self, where: str, condition: Any) -> None:
        """Raises `Deviation` unless the condition holds everywhere."""
        self.compared += int(np.size(condition))
        if not np.all(condition):
            self.fail(where, f"{where} does not hold")

    def unchanged(self, where: str, now: Any, before: Any) -> None:
        """Raises `Deviation` unless two nested values are the same in every bit."""
        if isinstance(before, Mapping | tuple | list):
            for key in entries(before):
                self.unchanged(where, now[key], before[key])
        elif isinstance(before, np.ndarray):
            self.holds(where, np.array_equal(now, before, equal_nan=before.dtype.kind == "f"))

    def fail(self, where: str, message: str) -> None:
        """Raises `Deviation`: nothing is worse."""
        self.worst = Worst(math.inf, math.inf, where)
        raise Deviation(message)

    def compare_arrays(self, where: str, actual: Any, expected: Any, magnitude: Any, bound: float) -> None:
        actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
        if actual.shape != expected.shape:
            self.worst = Worst(math.inf, math.inf, where)
            raise Deviation(f"{where}: {_shapes(expected.shape, actual.shape)}", actual, expected)
        self.compared += expected.size
        if not expected.size:
            return
        wide = WIDE[self.dtype]
        scale = scale_of(expected, magnitude, SMALLEST_NORMAL[wide] / EPSILON[wide])
        deviation = relative_deviation(actual, expected, scale)
        index = tuple(map(int, np.unravel_index(np.argmax(deviation), deviation.shape)))
        largest = float(deviation[index])
        share = largest / bound if bound else (0.0 if largest == 0 else math.inf)
        place = f"{where}[{', '.join(map(str, index))}]" if index else where
        if share > self.worst.share or not self.worst.where:
            self.worst = Worst(share, largest, place)
        if share > 1:
            got, wanted = float(actual[index]), float(expected[index])
            by = f", differs by {abs(got - wanted):.3g}, allowed {bound * scale[index]:.3g}"
            message = f"{place}: got {got!r}, expected {wanted!r}{by if math.isfinite(got - wanted) else ''}"
            raise Deviation(message, actual, expected, index)


class Unjudged(Comparisons):
    """Compares nothing: for runs of which only the calls count."""

    def compare(self, where: str, actual: Any, expected: Any, **how: Any) -> None:
        pass

    def exact(self, where: str, actual: Any, expected: Any) -> None:
        pass

    def holds(self, where: str, condition: Any) -> None:
        pass

    def fail(self, where: str, message: str) -> None:
        pass


def entries(value: Any) -> Iterable[Any]:
    """The keys of a mapping, the places of a tuple or list."""
    return value if isinstance(value, Mapping) else range(len(value))


def part_of(value: Any, path: Path) -> Any:
    for key in path:
        value = value[key]
    return value


def is_extreme(value: Any) -> bool:
    """Whether a nested value holds what no training step has: a NaN, an infinity, a tiny or a huge number among its
    real numbers, an empty array, or the flags [B, 1] of sequences that are one step long."""
    if isinstance(value, Mapping | tuple | list):
        return any(is_extreme(value[key]) for key in entries(value))
    if not isinstance(value, float | np.floating | np.ndarray):
        return False
    array = np.asarray(value)
    if array.size == 0 or (array.dtype.kind == "b" and array.shape[1:] == (1,)):
        return True
    if array.dtype.kind != "f":
        return False
    size = np.abs(value)
    return not bool(np.all((size == 0) | ((size >= TINY) & (size <= HUGE))))


def scale_of(expected: np.ndarray, magnitude: Any, floor: float) -> np.ndarray:
    """What deviations of each element are relative to: see `Comparisons.compare`."""
    with np.errstate(all="ignore"):
        if magnitude is None:
            magnitude = np.abs(expected)
        elif isinstance(magnitude, str):
            magnitude = np.max(np.abs(expected), where=np.isfinite(expected), initial=0.0)
        scale = np.maximum(np.broadcast_to(np.asarray(magnitude, np.float64), expected.shape), floor)
    return np.where(np.isfinite(scale), scale, 1.0)


def relative_deviation(actual: np.ndarray, expected: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """|actual - expected| / scale, with infinity where only one is NaN or infinities differ."""
    with np.errstate(all="ignore"):
        difference = np.abs(actual - expected) / scale
    same = (actual == expected) | (np.isnan(actual) & np.isnan(expected))
    return np.where(same, 0.0, np.where(np.isfinite(difference), difference, np.inf))


def round_to(x: Any, dtype: str) -> np.ndarray:
    """x as float64, rounded to what `dtype` can hold."""
    x = np.asarray(x, np.float64)
    if dtype == "float64":
        return x
    with np.errstate(all="ignore"):
        x32 = x.astype(np.float32)
    if dtype == "float32":
        return x32.astype(np.float64)
    bits = np.atleast_1d(x32).view(np.uint32).astype(np.uint64)
    rounded = ((bits + 0x7FFF + ((bits >> 16) & 1)) & 0xFFFF0000).astype(np.uint32).view(np.float32).reshape(x.shape)
    return np.where(np.isfinite(x32), rounded, x32).astype(np.float64)


def _shapes(expected: tuple[int, ...], actual: tuple[int, ...]) -> str:
    """What is wrong with a shape, and the usual reason."""
    message = f"expected shape {expected}, got {actual}"
    if actual == (*expected[1::-1], *expected[2:]) and len(expected) > 1:
        return message + ": rows come first and time comes second"
    return message + (": leave out the last axis" if actual == (*expected, 1) else "")
