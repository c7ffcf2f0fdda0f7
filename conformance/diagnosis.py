"""From deviations to the mistake: which mutant gives the numbers of the candidate where the checks fail.

A failing check is run again on the candidate with a note of every call and its result: its trace. The same check is run
on each mutant that it reaches. A mutant explains the check if its results agree with the trace, also where those of the
reference do not. Where a check fails with ordinary input, the trace is made of that alone: what is done with NaN and
infinities would hide the mistake. Of mutants that explain the same, those are named that also agree after the first
deviation.
"""

import copy
import dataclasses
import functools
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

import numpy as np

from conformance.adapter import OBJECTS
from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Call, Equal, Refused, Setting
from conformance.check import CHECKS, Check
from conformance.compare import Comparisons, Unjudged
from conformance.execute import FAILING, Result, missing, outcome, run
from conformance.judge import Ask, asking, standing_in
from conformance.mutants import MUTANTS, Mutant, MutantAdapter
from conformance.mutants.trial import on_the_mutant, on_the_reference

# Agreement with a trace, relative to the largest number of an array, where the check itself does not say what it
# allows.
AGREEMENT = {"float64": 1e-9, "float32": 1e-3, "bfloat16": 0.1}
DERIVATIVES = {"float64": 1e-5, "float32": 1e-2, "bfloat16": 0.1}  # those of the reference are differences
TRACE_LENGTH = 5000
# so many checks, the most elementary first, are compared with every mutant in vain before the rest is left unexplained
TRIES = 8
VALUES = tuple(
    f"losses.{name}"
    for name in (
        *("latents_match", "reconstructions_match", "reward_and_continue_match", "dynamics_and_representation_match"),
        *("predictions_match", "return_range_matches", "actor_matches", "critic_matches", "replay_critic_matches"),
        "total_matches",
    )
)
"""The checks that all losses are right."""

Watch = Callable[[str, Collection[Check]], Iterable[Check]]
"""Hands out checks one after the other, and may tell somebody what is done with them and how far it is."""


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """The candidate behaves like a mutant.

    explained: names of the failing checks in which its results are those of the mutant. unexplained: of the other
    failing checks that can be compared. alternatives: mutants that explain the same checks and cannot be told apart by
    any other. refuted_by: a check that the candidate passes and the mutant does not: it is only the nearest that is
    known; "" where there is none.
    """

    mutant: Mutant
    explained: tuple[str, ...]
    unexplained: tuple[str, ...]
    alternatives: tuple[Mutant, ...] = ()
    refuted_by: str = ""

    def to_json(self) -> dict[str, Any]:
        """As the reports take it: conformance/report.schema.json."""
        return {
            "mutant": self.mutant.name,
            "explanation": self.mutant.explanation,
            "provenance": self.mutant.provenance,
            "chapter": self.mutant.chapter,
            "requirements": list(self.mutant.violates),
            "fix": self.mutant.fix,
            "explained": list(self.explained),
            "unexplained": list(self.unexplained),
            "alternatives": [mutant.name for mutant in self.alternatives],
            "refuted_by": self.refuted_by,
        }


def unwatched(what: str, checks: Collection[Check]) -> Iterable[Check]:
    return checks


def diagnose(adapter: object, results: Iterable[Result], setting: Setting, watch: Watch = unwatched) -> list[Diagnosis]:
    """The mistakes that explain why checks fail, those that explain most first; each explains a check that none before
    it does.

    Args:
      adapter: the candidate.
      results: of all checks that were run on it, with the settings that follow.
      watch: hands out the failing checks.
    """
    results = list(results)
    candidate = _Candidate(adapter, setting, {result.check.name: result.status for result in results})
    failing = [result.check for result in results if result.status in FAILING and not result.check.is_large]
    failing.sort(key=lambda check: (check.level, _of_derivatives(check), candidate.size(check), check.name))
    traces = {check: trace for check in watch("diagnosis, recording", failing) if (trace := candidate.trace(check))}
    # What is compared soonest and says most comes first: derivatives are slow, extreme input is special.
    evidence = dict(sorted(traces.items(), key=lambda item: (_of_derivatives(item[0]), not item[1].ordinary)))
    explained = {
        mutant: {check for check, trace in evidence.items() if candidate.explains(mutant, check, trace)}
        for mutant in _suspects(candidate, evidence, watch)
    }
    passing = [result.check for result in results if result.status == "pass" and not result.check.is_large]
    diagnoses: list[Diagnosis] = []
    left = set(evidence)
    while explained := {mutant: checks for mutant, checks in explained.items() if checks & left}:
        (first, *others), refuted_by = _best(candidate, explained, passing)
        known = tuple(check.name for check in evidence if check in explained[first])
        unknown = tuple(check.name for check in evidence if check not in explained[first])
        alternatives = tuple(mutant for mutant in others if explained[mutant] == explained[first])
        diagnoses.append(Diagnosis(first, known, unknown, alternatives, refuted_by))
        left -= explained[first]
    return diagnoses


def _suspects(candidate: "_Candidate", evidence: dict[Check, "_Trace"], watch: Watch) -> list[Mutant]:
    """The mutants that explain a failing check. A check that one of them explains is not searched for others."""
    found: list[Mutant] = []
    tries = 0
    for check in watch("diagnosis, comparing", evidence):
        trace = evidence[check]
        if any(candidate.explains(mutant, check, trace) for mutant in found):
            continue
        if new := [mutant for mutant in MUTANTS.values() if candidate.explains(mutant, check, trace)]:
            found += new
        elif (tries := tries + 1) == TRIES:
            break
    return found


def _best(
    candidate: "_Candidate", explained: dict[Mutant, set[Check]], passing: list[Check]
) -> tuple[list[Mutant], str]:
    """Of the mutants that no passing check speaks against those that explain most checks; where there are none, of all,
    and a check that does."""
    counts = sorted({len(checks) for checks in explained.values()}, reverse=True)
    nearest: list[Mutant] = []
    for count in counts:
        tied = [mutant for mutant, checks in explained.items() if len(checks) == count]
        group = _likeliest(candidate, tied, explained)
        nearest = nearest or group
        if possible := [mutant for mutant in group if not candidate.contradiction(mutant, passing)]:
            return possible, ""
    return nearest, candidate.contradiction(nearest[0], passing)


def _likeliest(
    candidate: "_Candidate", tied: list[Mutant], explained: Mapping[Mutant, Collection[Check]]
) -> list[Mutant]:
    """Of several those that also agree after the first deviation, if there are such."""
    if len(tied) == 1:
        return tied
    return [
        mutant for mutant in tied if all(candidate.follows_to_the_end(mutant, check) for check in explained[mutant])
    ] or tied


@dataclasses.dataclass
class _Answer:
    """What came of one call: a result, or the name of an exception's class. demand: what the check says of it."""

    function: str
    demand: Equal | None = None
    result: Any = None
    raised: str | None = None


@dataclasses.dataclass
class _Trace:
    """The answers to a check's calls.

    ordinary: without extreme input. to_the_end: also those after the first deviation.
    """

    ordinary: bool
    to_the_end: bool = False
    answers: list[_Answer] = dataclasses.field(default_factory=list)


class _Candidate:
    """A candidate and what is known of it, in one setting."""

    def __init__(self, adapter: object, setting: Setting, statuses: dict[str, str]) -> None:
        self.adapter, self.setting, self.statuses = adapter, setting, statuses
        self._explained: dict[tuple[str, str], bool] = {}
        self._whole: dict[str, _Trace] = {}

    def size(self, check: Check) -> int:
        """How many numbers it compares."""
        return on_the_reference(check, self.setting)[0].compared

    def trace(self, check: Check) -> _Trace | None:
        """The answers to a check. None if the reference cannot give them, or gives the same.

        Derivatives are compared where the losses are right: those of other losses are wrong anyway.
        """
        if missing(NumpyAdapter(), check) or (_of_derivatives(check) and self._fails_values()):
            return None
        for ordinary in (True, False):
            trace = self._answers(check, ordinary)
            if not self._follows(NumpyAdapter(), check, trace):
                return trace
        return None

    def explains(self, mutant: Mutant, check: Check, trace: _Trace) -> bool:
        key = (mutant.name, check.name)
        if key not in self._explained:
            follows = self._may_explain(mutant, check) and self._follows(MutantAdapter(mutant), check, trace)
            self._explained[key] = follows
        return self._explained[key]

    def contradiction(self, mutant: Mutant, passing: list[Check]) -> str:
        """The name of a check that the candidate passes and the mutant does not; "" if there is none."""
        chapters = {target.partition(".")[0] for target in mutant.edits}
        nearest = sorted(passing, key=lambda check: check.name.partition(".")[0] not in chapters)
        return next((check.name for check in nearest if self._fails(mutant, check)), "")

    def follows_to_the_end(self, mutant: Mutant, check: Check) -> bool:
        if check.name not in self._whole:
            self._whole[check.name] = self._answers(check, ordinary=True, to_the_end=True)
        return self._follows(MutantAdapter(mutant), check, self._whole[check.name])

    def _fails_values(self) -> bool:
        return any(self.statuses.get(name) in FAILING for name in VALUES)

    def _may_explain(self, mutant: Mutant, check: Check) -> bool:
        """What changes the total loss is not the mistake of a candidate whose losses are right. This is said fast,
        derivatives are slow."""
        right = _of_derivatives(check) and all(self.statuses.get(name) == "pass" for name in VALUES)
        return self._reaches(mutant, check) and not (right and self._fails(mutant, CHECKS["losses.total_matches"]))

    def _fails(self, mutant: Mutant, check: Check) -> bool:
        return self._reaches(mutant, check) and on_the_mutant(mutant, check, self.setting).status in FAILING

    def _reaches(self, mutant: Mutant, check: Check) -> bool:
        return not on_the_reference(check, self.setting)[1].isdisjoint(mutant.edits)

    def _answers(self, check: Check, ordinary: bool, to_the_end: bool = False) -> _Trace:
        trace = _Trace(ordinary, to_the_end)
        self._run(check, self.adapter, trace, trace.answers.append)
        return trace

    def _follows(self, adapter: object, check: Check, trace: _Trace) -> bool:
        """Whether an adapter gives the answers of a trace. It is asked up to the first that differs."""
        count = 0

        def compare(answer: _Answer) -> None:
            nonlocal count
            if count < len(trace.answers) and not _same(answer, trace.answers[count], self.setting):
                raise _Differs
            count += 1

        try:
            self._run(check, adapter, trace, compare)
        except _Differs:
            return False
        return count >= len(trace.answers)

    def _run(self, check: Check, adapter: object, how: _Trace, note: Callable[[_Answer], None]) -> None:
        """Runs a check, and notes every answer."""
        comparisons = (Unjudged if how.to_the_end else Comparisons)(self.setting.dtype)
        ask = asking(adapter)
        if how.ordinary and check.script:
            ask = standing_in(ask, NumpyAdapter())
        left = TRACE_LENGTH

        def note_some(answer: _Answer) -> None:
            nonlocal left
            left -= 1
            if left >= 0:
                note(answer)

        body = functools.partial(run, check, self.setting, _noting(ask, note_some), comparisons, adapter, False)
        outcome(check, adapter, comparisons, lambda: body(how.ordinary))


class _Differs(BaseException):
    """Another answer than in the trace. Not an Exception: it is no failure of what is asked."""


def _noting(ask: Ask, note: Callable[[_Answer], None]) -> Ask:
    """Notes the answers, those of objects that are made included."""

    def noted(call: Call, demand: Equal | Refused | None) -> Any:
        answer = _Answer(call.function, demand if isinstance(demand, Equal) else None)
        result = _noted(answer, note, lambda: ask(call, demand))
        return _Object(result, note) if call.function in OBJECTS else result

    return noted


def _noted(answer: _Answer, note: Callable[[_Answer], None], call: Callable[[], Any]) -> Any:
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

    def __init__(self, made: Any, note: Callable[[_Answer], None]) -> None:
        self._made, self._note = made, note

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._made, name)

        def call(*arguments: Any, **options: Any) -> Any:
            return _noted(_Answer(name), self._note, lambda: method(*arguments, **options))

        call.__name__ = name
        return call

    def __call__(self, *arguments: Any) -> Any:
        return _noted(_Answer("__call__"), self._note, lambda: self._made(*arguments))

    def __len__(self) -> int:
        return int(_noted(_Answer("__len__"), self._note, lambda: len(self._made)))


def _same(answer: _Answer, noted: _Answer, setting: Setting) -> bool:
    """Whether two answers agree."""
    if (answer.function, answer.raised) != (noted.function, noted.raised):
        return False
    ruler, demand = Comparisons(setting.dtype), noted.demand
    bound = (DERIVATIVES if answer.function == "loss_derivatives" else AGREEMENT)[setting.dtype]
    try:
        if demand is None or demand.bound == 0:
            return _agree(ruler, answer.result, noted.result, bound)
        # Both may err by what the check allows.
        how = {"magnitude": demand.magnitude, "factor": 2 * demand.factor, "bound": demand.bound}
        ruler.compare("", answer.result, noted.result, **how)
    except Exception:  # whatever a candidate may return where numbers are expected
        return False
    return True


def _of_derivatives(check: Check) -> bool:
    return "loss_derivatives" in check.uses


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
