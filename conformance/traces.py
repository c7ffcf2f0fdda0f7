"""What a candidate answers to the calls of a check, and whether another adapter answers the same."""

import copy
import dataclasses
import functools
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Call, Equal, Refused, Setting
from conformance.check import Check
from conformance.compare import Comparisons, Unjudged, entries
from conformance.drawing import cases
from conformance.execute import FAILING, outcome, run
from conformance.interface import OBJECTS
from conformance.judge import Ask, asking, judge_case, standing_in
from conformance.mutants.trial import tracing

# Agreement with a trace, relative to the largest number of an array, where the check itself does not say what it
# allows.
AGREEMENT = {"float64": 1e-9, "float32": 1e-3, "bfloat16": 0.1}
DERIVATIVES = {"float64": 1e-5, "float32": 1e-2, "bfloat16": 0.1}  # those of the reference are differences
TRACE_LENGTH = 5000

ORDINARY, EXTREME, WHOLE = "ordinary", "extreme", "whole"
"""Parts of a check: without its extreme input, that alone, and all of it."""


@dataclasses.dataclass
class Answer:
    """What came of one call: a result, or the name of an exception's class. demand: what the check says of it."""

    function: str
    demand: Equal | Refused | None = None
    result: Any = None
    raised: str | None = None


@dataclasses.dataclass(eq=False)
class Trace:
    """The answers of a candidate to the calls of a part of a check, up to the first deviation.

    any_error: whether what must be refused may be with any exception. reach: what the reference enters until it
    answers otherwise; work: how often it enters functions. raises: whether what the candidate answers otherwise is an
    exception.
    """

    check: Check
    part: str
    answers: list[Answer]
    any_error: bool = False
    reach: frozenset[str] = frozenset()
    work: int = 0
    raises: bool = False

    @property
    def of_derivatives(self) -> bool:
        return of_derivatives(self.check)


def of_derivatives(check: Check) -> bool:
    return "loss_derivatives" in check.uses


def evidence(adapter: object, check: Check, setting: Setting) -> list[Trace]:
    """The traces of a check that fails, in which the reference answers otherwise.

    One with ordinary input where the candidate deviates in that already, and then another of the extreme input, where
    it may make a mistake of another kind; else one of the whole.
    """
    ordinary, _ = record(adapter, check, setting, ORDINARY)
    if _deviates(ordinary, setting):
        if check.cases is None:
            return [ordinary]
        extreme, fails = record(adapter, check, setting, EXTREME)
        return [ordinary, extreme] if fails and _deviates(extreme, setting) else [ordinary]
    whole, _ = record(adapter, check, setting, WHOLE)
    return [whole] if _deviates(whole, setting) else []


def record(adapter: object, check: Check, setting: Setting, part: str, to_the_end: bool = False) -> tuple[Trace, bool]:
    """A trace, and whether the check fails. to_the_end: goes on after the first deviation."""
    trace = Trace(check, part, [], any_error=bool(getattr(adapter, "refuses_anyhow", False)))
    comparisons = (Unjudged if to_the_end else Comparisons)(setting.dtype)
    fails = _run(trace, setting, adapter, comparisons, trace.answers.append)
    return trace, fails


def follows(adapter: object, trace: Trace, setting: Setting, to_the_end: bool = False) -> tuple[bool, int]:
    """Whether an adapter gives the answers of a trace, and up to which it was asked: the first that differs."""
    count = 0

    def compare(answer: Answer) -> None:
        nonlocal count
        count += 1
        if count <= len(trace.answers) and not same(answer, trace.answers[count - 1], setting, trace.any_error):
            raise _Differs

    comparisons = (Unjudged if to_the_end else Comparisons)(setting.dtype)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what a mutant computes
            _run(trace, setting, adapter, comparisons, compare)
    except _Differs:
        return False, count
    return count >= len(trace.answers), count


def _deviates(trace: Trace, setting: Setting) -> bool:
    """Whether the reference answers otherwise; what that takes is noted in the trace."""
    entered: Counter[str] = Counter()
    with tracing(entered):
        agrees, asked = follows(NumpyAdapter(), trace, setting)
    trace.reach, trace.work = frozenset(entered), entered.total()
    trace.raises = 0 < asked <= len(trace.answers) and trace.answers[asked - 1].raised is not None
    return not agrees


def _run(
    trace: Trace, setting: Setting, adapter: object, comparisons: Comparisons, note: Callable[[Answer], None]
) -> bool:
    """Runs a part of a check, and notes every answer. Returns whether it fails."""
    check, ordinary = trace.check, trace.part == ORDINARY
    ask = asking(adapter)
    if ordinary and check.script:
        ask = standing_in(ask, NumpyAdapter())
    left = TRACE_LENGTH

    def note_some(answer: Answer) -> None:
        nonlocal left
        left -= 1
        if left >= 0:
            note(answer)

    noted = _noting(ask, note_some)
    if trace.part == EXTREME:
        body = functools.partial(_run_extreme, check, setting, noted, comparisons, adapter)
    else:
        body = functools.partial(run, check, setting, noted, comparisons, adapter, shrink=False, ordinary=ordinary)
    return outcome(check, adapter, comparisons, body).status in FAILING


def _run_extreme(check: Check, setting: Setting, ask: Ask, comparisons: Comparisons, adapter: object) -> None:
    assert check.cases is not None
    any_error = bool(getattr(adapter, "refuses_anyhow", False))
    with np.errstate(all="ignore"):
        for case, _ in cases(check.cases, setting):
            if case.is_extreme:
                judge_case(case, ask, comparisons, any_error)


class _Differs(BaseException):
    """Another answer than in the trace. Not an Exception: it is no failure of what is asked."""


def _noting(ask: Ask, note: Callable[[Answer], None]) -> Ask:
    """Notes the answers, those of objects that are made included."""

    def noted(call: Call, demand: Equal | Refused | None) -> Any:
        result = _noted(Answer(call.function, demand), note, lambda: ask(call, demand))
        return _Object(result, note) if call.function in OBJECTS else result

    return noted


def _noted(answer: Answer, note: Callable[[Answer], None], call: Callable[[], Any]) -> Any:
    try:
        result = call()
    except Exception as error:
        answer.raised = type(error).__name__
        raise
    else:
        answer.result = copy.deepcopy(result) if _is_data(result) else None
    finally:
        note(answer)
    return result


class _Object:
    """Something with methods that was made. Its answers are noted, too."""

    def __init__(self, made: Any, note: Callable[[Answer], None]) -> None:
        self._made, self._note = made, note

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._made, name)

        def call(*arguments: Any, **options: Any) -> Any:
            return _noted(Answer(name), self._note, lambda: method(*arguments, **options))

        call.__name__ = name
        return call

    def __call__(self, *arguments: Any) -> Any:
        return _noted(Answer("__call__"), self._note, lambda: self._made(*arguments))

    def __len__(self) -> int:
        return int(_noted(Answer("__len__"), self._note, lambda: len(self._made)))


def same(answer: Answer, noted: Answer, setting: Setting, any_error: bool = False) -> bool:
    """Whether two answers agree. What comes of a call that should have been refused says nothing."""
    if answer.function != noted.function:
        return False
    if isinstance(noted.demand, Refused):
        return bool(answer.raised) == bool(noted.raised) if any_error else answer.raised == noted.raised
    if answer.raised != noted.raised:
        return False
    ruler, demand = Comparisons(setting.dtype), noted.demand
    bound = (DERIVATIVES if answer.function == "loss_derivatives" else AGREEMENT)[setting.dtype]
    try:
        if demand is None or demand.bound == 0:
            return _agree(ruler, answer.result, noted.result, bound)
        # Both may err by what the check allows. Wrong numbers may be larger than right ones, and their rounding with
        # them.
        magnitude = _at_least(demand.magnitude, noted.result)
        ruler.compare(
            "", answer.result, noted.result, magnitude=magnitude, factor=2 * demand.factor, bound=demand.bound
        )
    except Exception:  # whatever a candidate may return where numbers are expected
        return False
    return True


def _at_least(magnitude: Any, result: Any) -> Any:
    """What rounding is relative to, as `compare` takes it, and no less than the numbers of the result."""
    if magnitude is None or isinstance(magnitude, str):
        return magnitude
    if isinstance(result, Mapping | tuple | list):
        parts = magnitude if isinstance(magnitude, Mapping | tuple) else dict.fromkeys(entries(result), magnitude)
        return {key: _at_least(parts[key], result[key]) for key in entries(result)}
    return np.fmax(magnitude, np.abs(result))


def _is_data(result: Any) -> bool:
    """Whether a result can be compared as it is. Objects are compared by what their methods return."""
    if isinstance(result, Mapping):
        return all(map(_is_data, result.values()))
    if isinstance(result, tuple | list):
        return all(map(_is_data, result))
    return result is None or isinstance(result, str | bool | int | float | np.ndarray | np.generic)


def _agree(ruler: Comparisons, result: Any, noted: Any, bound: float) -> bool:
    """Whether a result has the numbers of the noted one within the bound, and is equal otherwise. The noted one may
    hold more keys."""
    if isinstance(result, Mapping):
        if not set(result) <= set(noted):
            return False
        if all(
            isinstance(value, int | float | np.number | np.ndarray) and np.ndim(value) == 0 for value in result.values()
        ):
            # Numbers under one roof, such as losses: the large ones say how exact the small ones can be.
            result, noted = np.array([*result.values()]), np.array([noted[key] for key in result])
        else:
            return all(_agree(ruler, result[key], noted[key], bound) for key in result)
    if isinstance(result, tuple | list):
        return len(result) == len(noted) and all(
            _agree(ruler, *pair, bound) for pair in zip(result, noted, strict=True)
        )
    if result is None or isinstance(result, str):
        return bool(result == noted)
    ruler.compare("", result, noted, magnitude="tensor", bound=bound)
    return True
