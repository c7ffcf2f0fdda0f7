"""Checks, and what they are run with.

A check is a function that takes a `Run`, computes what the reference says, and hands it to `run.expect` together with
the name and the arguments of the candidate's function. It is written once and runs on any adapter. A check names the
requirements that it covers and the functions that it needs; where the adapter does not offer one of these, the check is
reported as not offered.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import hypothesis
import numpy as np

DTYPES = ("float64", "float32", "bfloat16")
EPSILON = {"float64": 2.0**-52, "float32": 2.0**-23, "bfloat16": 2.0**-7}
SMALLEST_NORMAL = {"float64": 2.0**-1022, "float32": 2.0**-126, "bfloat16": 2.0**-126}
# Rounding of one function, relative to the magnitude of what it sums. float64 is held to 1e-12; the others to multiples
# of their epsilon.
BOUND = {"float64": 1e-12, "float32": 64 * EPSILON["float32"], "bfloat16": 16 * EPSILON["bfloat16"]}
HUGE, TINY = 1e9, 1e-30  # sizes between which a number is ordinary; the outermost bins are below
SHRINKING = 2.0  # seconds in which hypothesis may look for a smaller case that deviates
COPIED = 2**16  # numbers of an array up to which a failing input is kept as it was


@dataclasses.dataclass(frozen=True)
class Check:
    """One registered check."""

    name: str
    requirements: tuple[str, ...]
    uses: tuple[str, ...]
    level: int
    body: Callable[["Run"], None]
    dtypes: tuple[str, ...]

    @property
    def summary(self) -> str:
        return (self.body.__doc__ or "").strip().splitlines()[0]


CHECKS: dict[str, Check] = {}


def check(*requirements: str, uses: Iterable[str], level: int, dtypes: tuple[str, ...] = DTYPES) -> Callable[..., Any]:
    """Registers a check under `row.function_name`. Its docstring says in one line what holds."""

    def register(body: Callable[["Run"], None]) -> Callable[["Run"], None]:
        name = f"{body.__module__.rsplit('.', 1)[-1]}.{body.__name__}"
        if name in CHECKS:
            raise ValueError(f"two checks are named {name}")
        CHECKS[name] = Check(name, requirements, tuple(uses), level, body, dtypes)
        return body

    return register


class Deviation(AssertionError):
    """The candidate and the reference disagree."""


class CandidateLost(BaseException):
    """The candidate is gone in the middle of a check. Not an Exception: hypothesis would go on to search for a smaller
    case."""


@dataclasses.dataclass
class Worst:
    """The worst comparison of a check: deviation as a share of its bound, the deviation itself, and where."""

    share: float = 0.0
    deviation: float = 0.0
    where: str = ""


@dataclasses.dataclass(frozen=True)
class Call:
    """A call of the candidate, and the comparison of what came of it that went wrong.

    function and arguments: as the candidate was called; arrays that are not large are copies, so that a candidate that
    writes into them hides nothing. got
    and expected: the two arrays that disagree, None where no arrays were compared. index: of the worst element, None
    where shapes differ.
    """

    function: str
    arguments: tuple[Any, ...]
    got: np.ndarray | None = None
    expected: np.ndarray | None = None
    index: tuple[int, ...] | None = None


class Run:
    """One check on one adapter.

    dtype: precision of the candidate. profile: name of the profile that configurations are drawn from. seed and
    examples: of the drawn
    cases. shrink: whether hypothesis makes a case that deviates smaller, which takes longer. stand_in: an adapter that
    answers in place of the candidate where the input is extreme (`is_extreme`, or to be refused), so that a deviation
    is one with ordinary input; None for nobody. `compared` counts numbers compared, so that a check that compares
    nothing can be told from one that passes.
    """

    def __init__(
        self,
        adapter: object,
        dtype: str,
        profile: str,
        seed: int = 0,
        examples: int = 25,
        shrink: bool = True,
        stand_in: object | None = None,
    ) -> None:
        self.adapter = adapter
        self.dtype = dtype
        self.profile = profile
        self.seed = seed
        self.examples = examples
        self.shrink = shrink
        self.stand_in = stand_in
        self.worst = Worst()
        self.compared = 0
        self.last_call: Call | None = (
            None  # of the candidate; after a deviation, that of the smallest case that deviates
        )

    @property
    def u(self) -> float:
        """Distance from 1 to the next number in the precision of losses, returns and transforms: float32 or better."""
        return EPSILON["float64" if self.dtype == "float64" else "float32"]

    @property
    def tiny(self) -> float:
        """Smallest normal number of that precision."""
        return SMALLEST_NORMAL["float64" if self.dtype == "float64" else "float32"]

    def rng(self) -> np.random.Generator:
        return np.random.default_rng(self.seed)

    def cast(self, x: Any) -> np.ndarray:
        """Rounds inputs to what the candidate's dtype can hold, so that reference and candidate start from the same
        numbers."""
        return round_to(x, self.dtype)

    def call(self, function: str, *args: Any) -> Any:
        self.last_call = Call(function, _copied(args))
        return getattr(self.answering(function, args), function)(*args)

    def answering(self, function: str, args: Any) -> object:
        """The candidate, or what stands in for it."""
        extreme = hasattr(self.stand_in, function) and is_extreme(args)
        return self.stand_in if extreme else self.adapter

    def expect(self, function: str, args: tuple[Any, ...], expected: Any, **how: Any) -> Any:
        """Calls the candidate and compares its result; returns the result. `how` is passed to `compare`."""
        actual = self.call(function, *args)
        self.compare(function, actual, expected, **how)
        return actual

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
        dtype, for longer computations.
        bound: replaces it. NaN must meet NaN and an infinity the same infinity.
        """
        if isinstance(expected, Mapping):
            if not isinstance(actual, Mapping) or set(actual) != set(expected):
                got = sorted(actual) if isinstance(actual, Mapping) else type(actual).__name__
                raise Deviation(f"{where}: expected the keys {sorted(expected)}, got {got}")
            for key in expected:
                part = magnitude[key] if isinstance(magnitude, Mapping) else magnitude
                self.compare(f"{where}[{key}]", actual[key], expected[key], magnitude=part, factor=factor, bound=bound)
        elif isinstance(expected, tuple):
            if not isinstance(actual, tuple | list) or len(actual) != len(expected):
                raise Deviation(f"{where}: expected {len(expected)} results, got {actual!r:.80}")
            for index, (a, e) in enumerate(zip(actual, expected, strict=True)):
                part = magnitude[index] if isinstance(magnitude, tuple) else magnitude
                self.compare(f"{where}[{index}]", a, e, magnitude=part, factor=factor, bound=bound)
        else:
            self._compare_arrays(
                where, actual, expected, magnitude, BOUND[self.dtype] * factor if bound is None else bound
            )

    def exact(self, where: str, actual: Any, expected: Any) -> None:
        """Raises `Deviation` unless equal in every bit but the sign of zero."""
        self._compare_arrays(where, actual, expected, 1.0, 0.0)

    def holds(self, where: str, condition: Any) -> None:
        """Raises `Deviation` unless the condition holds everywhere."""
        self.compared += int(np.size(condition))
        if not np.all(condition):
            self.worst = Worst(math.inf, math.inf, where)
            raise Deviation(f"{where} does not hold")

    def refuses(self, function: str, *args: Any, naming: Iterable[str] = ()) -> None:
        """Raises `Deviation` unless the candidate raises a ValueError with a message; `naming` are words that it must
        hold.

        Somebody else's program, an adapter that `refuses_anyhow`, may raise any exception.
        """
        self.compared += 1
        if self.stand_in is not None:
            return
        try:
            result = self.call(function, *args)
        except Exception as error:
            if getattr(self.adapter, "refuses_anyhow", False):
                return
            if not isinstance(error, ValueError):
                raise
            self.holds(f"the error message of {function}", bool(str(error)))
            for word in naming:
                self.holds(f"the error message of {function} names {word!r} ({_brief(str(error))})", word in str(error))
            return
        self.worst = Worst(math.inf, math.inf, function)
        raise Deviation(f"{function} must raise a ValueError for {_brief(args)}, and returned {_brief(result)}")

    def for_all(self, **strategies: Any) -> Callable[[Callable[..., None]], None]:
        """Decorator: runs the function on cases drawn by hypothesis, and shrinks the first that deviates."""

        def decorate(body: Callable[..., None]) -> None:
            shrinking = _Shrinking(body)

            def one_case(**drawn: Any) -> None:
                shrinking.run(**drawn)

            wrapped = hypothesis.given(**strategies)(one_case)
            wrapped = hypothesis.settings(
                max_examples=self.examples,
                deadline=None,
                database=None,
                suppress_health_check=list(hypothesis.HealthCheck),
                phases=[phase for phase in hypothesis.Phase if self.shrink or phase is not hypothesis.Phase.shrink],
                report_multiple_bugs=False,  # several deviations would come as a group, which is no Deviation
            )(wrapped)
            try:
                hypothesis.seed(self.seed)(wrapped)()
            except _Enough:
                shrinking.repeat_smallest()

        return decorate

    def _compare_arrays(self, where: str, actual: Any, expected: Any, magnitude: Any, bound: float) -> None:
        actual = np.asarray(actual, np.float64)
        expected = np.asarray(expected, np.float64)
        if actual.shape != expected.shape:
            self.worst = Worst(math.inf, math.inf, where)
            self._note(actual, expected, None)
            raise Deviation(f"{where}: {_shapes(expected.shape, actual.shape)}")
        self.compared += expected.size
        if not expected.size:
            return
        scale = scale_of(expected, magnitude, self.tiny / self.u)
        deviation = relative_deviation(actual, expected, scale)
        index = tuple(map(int, np.unravel_index(np.argmax(deviation), deviation.shape)))
        largest = float(deviation[index])
        share = largest / bound if bound else (0.0 if largest == 0 else math.inf)
        place = f"{where}[{', '.join(map(str, index))}]" if index else where
        if share > self.worst.share or not self.worst.where:
            self.worst = Worst(share, largest, place)
        if share > 1:
            self._note(actual, expected, index)
            got, wanted = float(actual[index]), float(expected[index])
            difference = (
                f", differs by {abs(got - wanted):.3g}, allowed {bound * scale[index]:.3g}"
                if math.isfinite(got - wanted)
                else ""
            )
            raise Deviation(f"{place}: got {got!r}, expected {wanted!r}{difference}")

    def _note(self, got: np.ndarray, expected: np.ndarray, index: tuple[int, ...] | None) -> None:
        if self.last_call is not None:
            self.last_call = dataclasses.replace(self.last_call, got=got, expected=expected, index=index)


def _copied(value: Any) -> Any:
    """The value with copies of its arrays. Those of full-size networks, in the preflight, stay as they are."""
    if isinstance(value, np.ndarray):
        return value.copy() if value.size <= COPIED else value
    if isinstance(value, dict):
        return {key: _copied(entry) for key, entry in value.items()}
    if isinstance(value, tuple):
        return tuple(map(_copied, value))
    return value


def _shapes(expected: tuple[int, ...], actual: tuple[int, ...]) -> str:
    """What is wrong with a shape, and the usual reason."""
    message = f"expected shape {expected}, got {actual}"
    if actual == (*expected[1::-1], *expected[2:]) and len(expected) > 1:
        return message + ": rows come first and time comes second"
    return message + (": leave out the last axis" if actual == (*expected, 1) else "")


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 120 else text[:117] + "..."


def is_extreme(value: Any) -> bool:
    """Whether there is a NaN, an infinity, a tiny or a huge number among the real numbers of a nested value."""
    if isinstance(value, Mapping):
        return any(map(is_extreme, value.values()))
    if isinstance(value, tuple | list):
        return any(map(is_extreme, value))
    if not isinstance(value, float | np.floating | np.ndarray) or np.asarray(value).dtype.kind != "f":
        return False
    size = np.abs(value)
    return not bool(np.all((size == 0) | ((size >= TINY) & (size <= HUGE))))


class _Enough(BaseException):
    """No more time for smaller cases. Not an Exception: hypothesis would take it for another way to fail."""


class _Shrinking:
    """Runs the body of a property; ends the search for a smaller case that deviates some seconds after the first."""

    def __init__(self, body: Callable[..., None]) -> None:
        self._body = body
        self._since, self._size = math.inf, math.inf
        self._smallest: dict[str, Any] = {}

    def run(self, **drawn: Any) -> None:
        if time.monotonic() - self._since > SHRINKING:
            raise _Enough
        try:
            self._body(**drawn)
        except hypothesis.errors.UnsatisfiedAssumption:
            raise
        except Exception:
            self._since = min(self._since, time.monotonic())
            if (size := _count(drawn)) <= self._size:
                self._size, self._smallest = size, drawn
            raise

    def repeat_smallest(self) -> None:
        """Fails once more with the smallest case that was found."""
        self._body(**self._smallest)
        raise Deviation("a case that deviated does not deviate again: the candidate is not deterministic")


def _count(value: Any) -> int:
    """How many numbers a nested value holds."""
    if isinstance(value, Mapping):
        return sum(map(_count, value.values()))
    return sum(map(_count, value)) if isinstance(value, tuple | list) else int(np.size(value))


def scale_of(expected: np.ndarray, magnitude: Any, floor: float) -> np.ndarray:
    """What deviations of each element are relative to: see `Run.compare`."""
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
