"""From checks to vectors: every golden value of a check's cases, with the tolerances of all precisions."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Call, Case, Equal, Setting
from conformance.check import Check
from conformance.compare import BOUND, DTYPES, EPSILON, Path, entries, part_of, relative_deviation, round_to, scale_of
from conformance.drawing import cases
from conformance.execute import missing
from conformance.interface import INTERFACE
from conformance.judge import copied
from spec import Config

LARGEST = 3.4e38
"""Results beyond it overflow in float32 and bfloat16, so these are not compared with them."""


@dataclasses.dataclass(frozen=True, eq=False)
class Output:
    """One array of a result: what is right, what its rounding is relative to (None: itself), and the tolerance in units
    of that."""

    path: Path
    expected: np.ndarray
    scale: np.ndarray | None
    tolerance: Mapping[str, float]


@dataclasses.dataclass(frozen=True, eq=False)
class Vector:
    """One call of one function. refused: words that the error message must hold; None where the call has a result."""

    name: str
    check: Check
    function: str
    arguments: tuple[Any, ...]
    outputs: tuple[Output, ...] = ()
    refused: tuple[str, ...] | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class _Golden:
    """A golden array of one precision."""

    expected: np.ndarray
    scale: np.ndarray | None
    bound: float

    def rejects(self, result: np.ndarray) -> bool:
        """Whether the check does not accept the reference's own result: it asks for rounding that the reference does
        not do."""
        scale = scale_of(self.expected, self.scale, 0.0)
        return bool(np.any(relative_deviation(result, self.expected, scale) > self.bound))


@dataclasses.dataclass(frozen=True, eq=False)
class _Asked:
    """A call, and what is golden of its result."""

    call: Call
    golden: Mapping[Path, _Golden]
    refused: tuple[str, ...] | None


def record(check: Check, profile: str, seed: int, examples: int) -> list[Vector]:
    """The vectors of a check, none where it compares nothing with a golden value.

    The inputs are such that every precision holds them: those of float32 where the check has them, and of another
    precision where not. The tolerances of the others come from the same calls there. A more precise one, for which
    checks may draw closer to a boundary, has the same tolerance for other numbers.
    """
    if check.cases is None or missing(NumpyAdapter(), check):
        return []
    inputs = min(check.dtypes, key=("float32", "float64", "bfloat16").index)
    asked = {dtype: _asked(check, Setting(dtype, profile, seed, examples, "bfloat16")) for dtype in check.dtypes}
    vectors: list[Vector] = []
    for index, one in enumerate(asked[inputs]):
        twins = {
            dtype: asked[dtype][index].golden
            for dtype in DTYPES
            if dtype in asked
            and _same_call(asked[dtype], index, one.call)
            and (EPSILON[dtype] < EPSILON[inputs] or _same(asked[dtype][index].call.arguments, one.call.arguments))
        }
        if vector := _vector(f"{check.name}/{len(vectors)}", check, one, twins):
            vectors.append(vector)
    return vectors


def _asked(check: Check, setting: Setting) -> list[_Asked]:
    """Every call of a check's cases."""
    assert check.cases is not None
    return [
        _Asked(call, dict(_golden(case, index, setting)), case.refused.naming if case.refused else None)
        for case, _ in cases(check.cases, setting)
        for index, call in enumerate(case.calls)
    ]


def _golden(case: Case, call: int, setting: Setting) -> Iterator[tuple[Path, _Golden]]:
    for demand in case.demands:
        if isinstance(demand, Equal) and demand.call == call:
            bound = BOUND[setting.dtype] * demand.factor if demand.bound is None else demand.bound
            for path, expected, magnitude in _arrays(demand.expected, demand.magnitude, demand.at):
                yield path, _Golden(expected, _scale(magnitude, expected), bound)


def _vector(name: str, check: Check, asked: _Asked, twins: Mapping[str, Mapping[Path, _Golden]]) -> Vector | None:
    function, arguments = asked.call.function, asked.call.arguments
    if asked.refused is not None:
        return Vector(name, check, function, arguments, refused=asked.refused)
    if not asked.golden:
        return None
    with np.errstate(all="ignore"):
        result = getattr(NumpyAdapter(), function)(*copied(arguments, everything=True))
    outputs = tuple(output for path in asked.golden if (output := _output(result, path, asked, twins)) is not None)
    return Vector(name, check, function, _without_unread(function, arguments), outputs) if outputs else None


def _output(result: Any, path: Path, asked: _Asked, twins: Mapping[str, Mapping[Path, _Golden]]) -> Output | None:
    """The reference's own result, which has all its digits where a check writes seven, with the tolerance of every
    precision."""
    expected = np.asarray(part_of(result, path), np.float64)
    overflows = bool(np.any(np.isfinite(expected) & (np.abs(expected) > LARGEST)))
    tolerance = {
        dtype: golden[path].bound
        for dtype, golden in twins.items()
        if path in golden
        and not (dtype != "float64" and overflows)
        and not (dtype == "bfloat16" and golden[path].rejects(expected))
    }
    return Output(path, expected, asked.golden[path].scale, tolerance) if tolerance else None


def along_one_direction(vector: Vector) -> Vector:
    """A vector of `loss_derivatives` with the first of its directions alone, rounded to numbers that take little
    room."""
    *others, directions = vector.arguments
    direction = {name: round_to(value, "bfloat16") for name, value in directions[0].items()}
    derivatives = NumpyAdapter().loss_derivatives(*copied(tuple(others), everything=True), [direction])
    outputs = tuple(dataclasses.replace(output, expected=derivatives[output.path[0]]) for output in vector.outputs)
    return dataclasses.replace(vector, arguments=(*others, (direction,)), outputs=outputs)


class _Reading(dict[str, Any]):
    """A mapping that notes which keys are read: all of them where it is walked."""

    def __init__(self, entries: Mapping[str, Any]) -> None:
        super().__init__(entries)
        self.read: set[str] = set()

    def __getitem__(self, key: str) -> Any:
        self.read.add(key)
        return super().__getitem__(key)

    def __iter__(self) -> Iterator[str]:
        self.read.update(super().keys())
        return super().__iter__()

    def items(self) -> Any:
        self.read.update(super().keys())
        return super().items()


def _without_unread(function: str, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """The arguments with those parameters alone that the function reads [CON-31]."""
    if INTERFACE[function][0] != "params":
        return arguments
    params, *others = arguments
    reading = _Reading(params)
    with np.errstate(all="ignore"):
        getattr(NumpyAdapter(), function)(reading, *copied(tuple(others), everything=True))
    return {name: value for name, value in params.items() if name in reading.read}, *others


def _same_call(asked: list[_Asked], index: int, call: Call) -> bool:
    return index < len(asked) and asked[index].call.function == call.function


def _same(value: Any, other: Any) -> bool:
    """Equality of arguments, whatever their configurations compute in."""
    if isinstance(value, Config):
        return isinstance(other, Config) and dataclasses.replace(value, compute_dtype=other.compute_dtype) == other
    if isinstance(value, Mapping):
        return (
            isinstance(other, Mapping)
            and value.keys() == other.keys()
            and all(_same(value[k], other[k]) for k in value)
        )
    if isinstance(value, tuple | list):
        return isinstance(other, tuple | list) and len(value) == len(other) and all(map(_same, value, other))
    if isinstance(value, np.ndarray):
        return value.dtype == other.dtype and np.array_equal(value, other, equal_nan=value.dtype.kind == "f")
    return bool(value == other)


def _arrays(expected: Any, magnitude: Any, path: Path) -> Iterator[tuple[Path, np.ndarray, Any]]:
    """Every array of what is expected, with its magnitude, as `Comparisons.compare` pairs them."""
    if isinstance(expected, Mapping | tuple):
        for key in entries(expected):
            part = magnitude[key] if isinstance(magnitude, Mapping | tuple) else magnitude
            yield from _arrays(expected[key], part, (*path, key))
    else:
        yield path, np.array(expected, np.float64), magnitude


def _scale(magnitude: Any, expected: np.ndarray) -> np.ndarray | None:
    if magnitude is None:
        return None
    if isinstance(magnitude, str):
        magnitude = np.max(np.abs(expected), where=np.isfinite(expected), initial=0.0)
    scale = np.array(magnitude, np.float64)
    return np.where(np.isfinite(scale), scale, 1.0)
