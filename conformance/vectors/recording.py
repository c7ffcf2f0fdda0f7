"""From checks to vectors: what a check asks of the reference, and what it accepts, is written down as it runs.

A check hands the result of `run.call`, or a part of it, to `run.compare` or `run.exact`. The recorder knows results by
their identity, so it sees which calls are compared, and how closely. A right result that was made from another result
of the candidate is a relation between calls and no golden value; it is told apart by a second run on a reference whose
results are all a little off.
"""

import contextlib
import copy
import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import hypothesis
import numpy as np

from conformance.adapter import INTERFACE, OBJECTS
from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.check import BOUND, DTYPES, EPSILON, Check, Run, relative_deviation, round_to, scale_of
from conformance.execute import missing
from spec import Config

Path = tuple[str | int, ...]
"""Where in a nested result an array stands: keys of mappings and places in tuples."""

LARGEST = 3.4e38
"""Results beyond it overflow in float32 and bfloat16, so these are not compared with them."""
SHIFT = 1e-7
DRAW_BYTES = 8192
ATTEMPTS = 100


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


@dataclasses.dataclass(eq=False)
class _Comparison:
    expected: np.ndarray
    scale: np.ndarray | None
    bound: float

    def rejects(self, result: np.ndarray) -> bool:
        """Whether the check does not accept the reference's own result: it asks for rounding that the reference does
        not do."""
        return bool(
            np.any(relative_deviation(result, self.expected, scale_of(self.expected, self.scale, 0.0)) > self.bound)
        )


@dataclasses.dataclass(eq=False)
class _Call:
    function: str
    arguments: tuple[Any, ...]
    result: Any = None
    refused: tuple[str, ...] | None = None
    compared: dict[Path, _Comparison] = dataclasses.field(default_factory=dict)


class Recorder(Run):
    """A run that judges nothing and remembers every call and comparison. Inputs are such that every dtype holds
    them."""

    def __init__(self, adapter: object, dtype: str, profile: str, seed: int, examples: int) -> None:
        super().__init__(adapter, dtype, profile, seed, examples)
        self.calls: list[_Call] = []
        self._origins: dict[int, tuple[_Call, Path]] = {}
        self._alive: list[Any] = []  # an identity means something only while its object exists
        self._drawn = 0

    def cast(self, x: Any) -> np.ndarray:
        return round_to(x, "bfloat16")

    def call(self, function: str, *args: Any) -> Any:
        call = _Call(function, snapshot(args))
        self.calls.append(call)
        result = super().call(function, *args)
        call.result = snapshot(result)
        for path, part in _parts(result):
            if not isinstance(part, bool | int):  # small numbers are one object wherever they occur
                self._alive.append(part)
                self._origins[id(part)] = call, path
        self._last = result, call
        return result

    def refuses(self, function: str, *args: Any, naming: Iterable[str] = ()) -> None:
        self.calls.append(_Call(function, snapshot(args), refused=tuple(naming)))

    def holds(self, where: str, condition: Any) -> None:
        pass

    def exact(self, where: str, actual: Any, expected: Any) -> None:
        self.compare(where, actual, expected, magnitude=1.0, bound=0.0)

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
        origin = self._origin(actual)
        if origin is None:
            return
        call, base = origin
        allowed = BOUND[self.dtype] * factor if bound is None else bound
        for path, part, size in _aligned(expected, magnitude, base):
            call.compared.setdefault(path, _Comparison(part, _scale(size, part), allowed))

    def for_all(self, **strategies: Any) -> Callable[[Callable[..., None]], None]:
        """Draws the cases from bytes of NumPy's generator: hypothesis's own depends on the code that happens to be
        imported."""

        def decorate(body: Callable[..., None]) -> None:
            left = self.examples

            def counted(**drawn: Any) -> None:
                nonlocal left
                left -= 1
                body(**drawn)

            quiet = hypothesis.settings(
                database=None, deadline=None, suppress_health_check=list(hypothesis.HealthCheck)
            )
            test: Any = quiet(hypothesis.given(**strategies)(counted))
            self._drawn += 1
            rng = np.random.default_rng([self.seed, self._drawn])
            for _ in range(ATTEMPTS * self.examples):
                if left:
                    test.hypothesis.fuzz_one_input(rng.bytes(DRAW_BYTES))

        return decorate

    def _origin(self, actual: Any) -> tuple[_Call, Path] | None:
        """The call that gave this object, and where in its result it stood."""
        if self.calls and actual is self._last[0]:
            return self._last[1], ()
        if known := self._origins.get(id(actual)):
            return known
        entries = (
            list(actual.items())
            if isinstance(actual, Mapping)
            else list(enumerate(actual))
            if isinstance(actual, tuple)
            else []
        )
        origins = [(key, self._origins.get(id(value))) for key, value in entries]
        if not origins or origins[0][1] is None:
            return None
        call, base = origins[0][1][0], origins[0][1][1][:-1]
        together = all(
            origin is not None and origin[0] is call and origin[1] == (*base, key) for key, origin in origins
        )
        return (call, base) if together else None

    _last: tuple[Any, Any] = (object(), None)


class Shifted:
    """The reference with all its real results a little off."""

    def __init__(self) -> None:
        self._reference = NumpyAdapter()

    def __getattr__(self, name: str) -> Any:
        function = getattr(self._reference, name)
        return function if name in OBJECTS else lambda *arguments: _shifted(function(*arguments))


def record(check: Check, profile: str, seed: int, examples: int) -> list[Vector]:
    """The vectors of a check, none where it compares nothing with a golden value.

    The inputs are those of float32 where that gives any, and of another dtype where not.
    """
    if missing(NumpyAdapter(), check) or any(name in OBJECTS or name.startswith("draw_") for name in check.uses):
        return []
    for inputs in sorted(check.dtypes, key=("float32", "float64", "bfloat16").index):
        if vectors := _record(check, inputs, profile, seed, examples):
            return vectors
    return []


def _record(check: Check, inputs: str, profile: str, seed: int, examples: int) -> list[Vector]:
    """The vectors with the inputs of a dtype. The tolerances of the others come from runs of their own.

    There the same calls count. Of a more precise dtype, for which checks may draw closer to a boundary, every call is
    the same.
    """

    def run(adapter: object, dtype: str) -> list[_Call]:
        recorder = Recorder(adapter, dtype, profile, seed, examples)
        with np.errstate(all="ignore"):
            check.body(recorder)
        return recorder.calls

    calls = run(NumpyAdapter(), inputs)
    if not any(call.compared or call.refused is not None for call in calls):
        return []
    others = {
        dtype: calls if dtype == inputs else run(NumpyAdapter(), dtype) for dtype in DTYPES if dtype in check.dtypes
    }
    shifted: list[_Call] = []
    with contextlib.suppress(Exception):  # what a check makes of results that are off need not be sound
        shifted = run(Shifted(), inputs)
    vectors: list[Vector] = []
    for index, call in enumerate(calls):
        twins = {
            dtype: other[index]
            for dtype, other in others.items()
            if _same_call(other, index, call)
            and (EPSILON[dtype] < EPSILON[inputs] or _same(other[index].arguments, call.arguments))
        }
        golden = _golden(call, shifted[index]) if _same_call(shifted, index, call) else []
        outputs = tuple(output for path in golden if (output := _output(call, path, twins)) is not None)
        if outputs or call.refused is not None:
            arguments = _without_unread(call.function, call.arguments) if outputs else call.arguments
            vectors.append(
                Vector(f"{check.name}/{len(vectors)}", check, call.function, arguments, outputs, call.refused)
            )
    return vectors


def along_one_direction(vector: Vector) -> Vector:
    """A vector of `loss_derivatives` with the first of its directions alone, rounded to numbers that take little
    room."""
    *others, directions = vector.arguments
    direction = {name: round_to(value, "bfloat16") for name, value in directions[0].items()}
    derivatives = NumpyAdapter().loss_derivatives(*snapshot(tuple(others)), [direction])
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
        getattr(NumpyAdapter(), function)(reading, *snapshot(tuple(others)))
    return {name: value for name, value in params.items() if name in reading.read}, *others


def _same_call(calls: list[_Call], index: int, call: _Call) -> bool:
    return index < len(calls) and calls[index].function == call.function


def _same(value: Any, other: Any) -> bool:
    """Equality of arguments, whatever their configurations compute in."""
    if isinstance(value, Config):
        return isinstance(other, Config) and dataclasses.replace(value, compute_dtype=other.compute_dtype) == other
    if isinstance(value, Mapping):
        return (
            isinstance(other, Mapping)
            and value.keys() == other.keys()
            and all(_same(value[key], other[key]) for key in value)
        )
    if isinstance(value, tuple):
        return isinstance(other, tuple) and len(value) == len(other) and all(map(_same, value, other))
    if isinstance(value, np.ndarray):
        return value.dtype == other.dtype and np.array_equal(value, other, equal_nan=value.dtype.kind == "f")
    return bool(value == other)


def _golden(call: _Call, shifted: _Call) -> list[Path]:
    """Where the right result does not depend on what the candidate gave."""
    return [
        path
        for path, comparison in call.compared.items()
        if path in shifted.compared
        and np.array_equal(comparison.expected, shifted.compared[path].expected, equal_nan=True)
    ]


def _output(call: _Call, path: Path, twins: Mapping[str, _Call]) -> Output | None:
    """The reference's own result, which has all its digits where a check writes seven, with the tolerance of every
    dtype."""
    expected = call.result
    for key in path:
        expected = expected[key]
    expected = np.asarray(expected, np.float64)
    overflows = bool(np.any(np.isfinite(expected) & (np.abs(expected) > LARGEST)))
    tolerance = {}
    for dtype, twin in twins.items():
        comparison = twin.compared.get(path)
        if (
            comparison is not None
            and not (dtype != "float64" and overflows)
            and not (dtype == "bfloat16" and comparison.rejects(expected))
        ):
            tolerance[dtype] = comparison.bound
    return Output(path, expected, call.compared[path].scale, tolerance) if tolerance else None


def _aligned(expected: Any, magnitude: Any, path: Path) -> Iterator[tuple[Path, np.ndarray, Any]]:
    """Every array of what is expected, with its magnitude, as `Run.compare` pairs them."""
    if isinstance(expected, Mapping | tuple):
        entries = expected.items() if isinstance(expected, Mapping) else enumerate(expected)
        for key, value in entries:
            yield from _aligned(
                value, magnitude[key] if isinstance(magnitude, type(expected)) else magnitude, (*path, key)
            )
    else:
        yield path, np.array(expected, np.float64), magnitude


def _scale(magnitude: Any, expected: np.ndarray) -> np.ndarray | None:
    if magnitude is None:
        return None
    if isinstance(magnitude, str):
        magnitude = np.max(np.abs(expected), where=np.isfinite(expected), initial=0.0)
    scale = np.array(magnitude, np.float64)
    return np.where(np.isfinite(scale), scale, 1.0)


def snapshot(value: Any) -> Any:
    """A copy that nobody else writes to. Configurations and spaces never change."""
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, Mapping):
        return {key: snapshot(entry) for key, entry in value.items()}
    if isinstance(value, tuple | list):
        return tuple(snapshot(entry) for entry in value)
    return copy.copy(value) if isinstance(value, np.generic) else value


def _parts(value: Any, path: Path = ()) -> Iterator[tuple[Path, Any]]:
    yield path, value
    if isinstance(value, Mapping | tuple):
        for key, entry in value.items() if isinstance(value, Mapping) else enumerate(value):
            yield from _parts(entry, (*path, key))


def _shifted(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _shifted(entry) for key, entry in value.items()}
    if isinstance(value, tuple):
        return tuple(_shifted(entry) for entry in value)
    array = np.asarray(value)
    return array + SHIFT * (1 + np.abs(array)) if array.dtype.kind == "f" else value
