"""From deviations to the mistake: which mutant gives the numbers of the candidate where the checks fail.

A failing check is run again on the candidate with a note of every call and its result: its trace. The same check is run
on each mutant that it reaches. A mutant explains the check if its results agree with the trace, also where those of the
reference do not. Where a check fails with ordinary input, the trace is made of that alone: what is done with NaN and
infinities would hide the mistake. Of mutants that explain the same, those are named that also agree after the first
deviation.
"""

import copy
import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.check import CHECKS, Check, Deviation, Run
from conformance.execute import Result, finish, missing
from conformance.mutants import MUTANTS, Mutant, MutantAdapter
from conformance.mutants.trial import on_the_mutant, on_the_reference

# Agreement with a trace, relative to the largest number of an array, where the check itself does not say what it
# allows.
AGREEMENT = {"float64": 1e-9, "float32": 1e-3, "bfloat16": 0.1}
DERIVATIVES = {"float64": 1e-5, "float32": 1e-2, "bfloat16": 0.1}  # those of the reference are differences
TRACE_LENGTH = 5000
# so many checks, the most elementary first, are compared with every mutant in vain before the rest is left unexplained
TRIES = 8
VALUES = "agent.losses_match"


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """The candidate behaves like a mutant.

    explained: names of the failing checks in which its results are those of the mutant. unexplained: of the other
    failing checks that
    can be compared. alternatives: mutants that explain the same checks and cannot be told apart by any other.
    """

    mutant: Mutant
    explained: tuple[str, ...]
    unexplained: tuple[str, ...]
    alternatives: tuple[Mutant, ...] = ()

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
        }


def diagnose(
    adapter: object, results: Iterable[Result], dtype: str, profile: str, seed: int = 0, examples: int = 25
) -> list[Diagnosis]:
    """The mistakes that explain why checks fail, those that explain most first; each explains a check that none before
    it does.

    Args:
      adapter: the candidate.
      results: of all checks that were run on it, with the settings that follow.
    """
    results = list(results)
    candidate = _Candidate(
        adapter, (dtype, profile, seed, examples), {result.check.name: result.status for result in results}
    )
    failing = [result.check for result in results if result.status in ("fail", "error")]
    failing.sort(key=lambda check: (check.level, _of_derivatives(check), candidate.size(check), check.name))
    traces = {check: trace for check in failing if (trace := candidate.trace(check))}
    evidence = dict(sorted(traces.items(), key=lambda item: not item[1].ordinary))
    explained = {
        mutant: {check for check, trace in evidence.items() if candidate.explains(mutant, check, trace)}
        for mutant in _suspects(candidate, evidence)
    }
    passing = [result.check for result in results if result.status == "pass"]
    diagnoses: list[Diagnosis] = []
    left = set(evidence)
    while explained := {mutant: checks for mutant, checks in explained.items() if checks & left}:
        first, *others = _best(candidate, explained, passing)
        known = tuple(check.name for check in evidence if check in explained[first])
        unknown = tuple(check.name for check in evidence if check not in explained[first])
        alternatives = tuple(mutant for mutant in others if explained[mutant] == explained[first])
        diagnoses.append(Diagnosis(first, known, unknown, alternatives))
        left -= explained[first]
    return diagnoses


def _suspects(candidate: "_Candidate", evidence: dict[Check, "_Trace"]) -> list[Mutant]:
    """The mutants that explain a failing check. A check that one of them explains is not searched for others."""
    found: list[Mutant] = []
    tries = 0
    for check, trace in evidence.items():
        if any(candidate.explains(mutant, check, trace) for mutant in found):
            continue
        if new := [mutant for mutant in MUTANTS.values() if candidate.explains(mutant, check, trace)]:
            found += new
        elif (tries := tries + 1) == TRIES:
            break
    return found


def _best(candidate: "_Candidate", explained: dict[Mutant, set[Check]], passing: list[Check]) -> list[Mutant]:
    """The mutants that explain most checks; of several, those that no passing check speaks against, if there are
    such."""
    most = max(map(len, explained.values()))
    tied = [mutant for mutant, checks in explained.items() if len(checks) == most]
    if len(tied) == 1:
        return tied
    tied = [
        mutant for mutant in tied if all(candidate.follows_to_the_end(mutant, check) for check in explained[mutant])
    ] or tied
    return [mutant for mutant in tied if not candidate.contradicts(mutant, passing)] or tied


@dataclasses.dataclass
class _Call:
    """One call and what came of it: a result, or the name of an exception's class. how: what the check allows."""

    function: str
    result: Any = None
    raised: str | None = None
    how: dict[str, Any] | None = None


@dataclasses.dataclass
class _Trace:
    """The calls of a check. ordinary: with extreme input they are the reference's. to_the_end: also those after the
    first deviation."""

    ordinary: bool
    to_the_end: bool = False
    calls: list[_Call] = dataclasses.field(default_factory=list)


class _Candidate:
    """A candidate and what is known of it, for one dtype, profile, seed and number of examples."""

    def __init__(self, adapter: object, settings: tuple[str, str, int, int], statuses: dict[str, str]) -> None:
        self.adapter, self.settings, self.statuses = adapter, settings, statuses
        self._explained: dict[tuple[str, str], bool] = {}
        self._whole: dict[str, _Trace] = {}

    def size(self, check: Check) -> int:
        """How many numbers it compares."""
        return on_the_reference(check, *self.settings)[0].compared

    def trace(self, check: Check) -> _Trace | None:
        """The calls of a check. None if the reference cannot make them, or makes them with the same results.

        Derivatives are compared where the losses are right: those of other losses are wrong anyway.
        """
        if missing(NumpyAdapter(), check) or (
            _of_derivatives(check) and self.statuses.get(VALUES) in ("fail", "error")
        ):
            return None
        for ordinary in (True, False):
            run = _Recorder(self.adapter, *self.settings, _Trace(ordinary))
            finish(check, run)
            if not self._follows(NumpyAdapter(), check, run.trace):
                return run.trace
        return None

    def explains(self, mutant: Mutant, check: Check, trace: _Trace) -> bool:
        key = (mutant.name, check.name)
        if key not in self._explained:
            self._explained[key] = self._may_explain(mutant, check) and self._follows(
                MutantAdapter(mutant), check, trace
            )
        return self._explained[key]

    def contradicts(self, mutant: Mutant, passing: list[Check]) -> bool:
        """Whether a check that the candidate passes fails on the mutant."""
        rows = {target.partition(".")[0] for target in mutant.edits}
        return any(
            self._fails(mutant, check)
            for check in sorted(passing, key=lambda check: check.name.partition(".")[0] not in rows)
        )

    def follows_to_the_end(self, mutant: Mutant, check: Check) -> bool:
        if check.name not in self._whole:
            run = _Recorder(self.adapter, *self.settings, _Trace(ordinary=True, to_the_end=True))
            finish(check, run)
            self._whole[check.name] = run.trace
        return self._follows(MutantAdapter(mutant), check, self._whole[check.name])

    def _may_explain(self, mutant: Mutant, check: Check) -> bool:
        """What changes a loss is not the mistake of a candidate whose losses are right. This is said fast, derivatives
        are slow."""
        right = _of_derivatives(check) and self.statuses.get(VALUES) == "pass"
        return self._reaches(mutant, check) and not (right and self._fails(mutant, CHECKS[VALUES]))

    def _fails(self, mutant: Mutant, check: Check) -> bool:
        return self._reaches(mutant, check) and on_the_mutant(mutant, check, *self.settings).status in ("fail", "error")

    def _reaches(self, mutant: Mutant, check: Check) -> bool:
        return not on_the_reference(check, *self.settings)[1].isdisjoint(mutant.edits)

    def _follows(self, adapter: object, check: Check, trace: _Trace) -> bool:
        run = _Follower(adapter, *self.settings, trace)
        finish(check, run)
        return run.agrees


class _Recorder(Run):
    """A run that notes every call, those of objects that the candidate makes included."""

    def __init__(self, adapter: object, dtype: str, profile: str, seed: int, examples: int, trace: _Trace) -> None:
        super().__init__(
            adapter, dtype, profile, seed, examples, shrink=False, stand_in=NumpyAdapter() if trace.ordinary else None
        )
        self.trace = trace

    @property
    def calls(self) -> list[_Call]:
        return self.trace.calls

    def call(self, function: str, *args: Any) -> Any:
        made = self.noted(function, getattr(self.answering(function, args), function), *args)
        return _Object(self, made) if isinstance(getattr(NumpyAdapter(), function, None), type) else made

    def expect(self, function: str, args: tuple[Any, ...], expected: Any, **how: Any) -> Any:
        before = len(self.calls)
        actual = self.call(function, *args)
        if len(self.calls) > before:
            self.calls[-1].how = how
        self.compare(function, actual, expected, **how)
        return actual

    def compare(self, where: str, actual: Any, expected: Any, **how: Any) -> None:
        if not self.trace.to_the_end:
            super().compare(where, actual, expected, **how)

    def exact(self, where: str, actual: Any, expected: Any) -> None:
        if not self.trace.to_the_end:
            super().exact(where, actual, expected)

    def holds(self, where: str, condition: Any) -> None:
        if not self.trace.to_the_end:
            super().holds(where, condition)

    def noted(self, name: str, function: Any, *args: Any, **options: Any) -> Any:
        entry = _Call(name)
        try:
            result = function(*args, **options)
        except Exception as error:
            entry.raised = type(error).__name__
            raise
        else:
            entry.result = copy.deepcopy(result) if _is_data(result) else None
        finally:
            self.note(entry)
        return result

    def note(self, entry: _Call) -> None:
        if len(self.calls) < TRACE_LENGTH:
            self.calls.append(entry)


class _Follower(_Recorder):
    """A run that compares every call with the same call of a trace, and ends at the first that differs."""

    def __init__(self, adapter: object, dtype: str, profile: str, seed: int, examples: int, followed: _Trace) -> None:
        super().__init__(adapter, dtype, profile, seed, examples, _Trace(followed.ordinary, followed.to_the_end))
        self.followed = followed.calls
        self.differs = False

    @property
    def agrees(self) -> bool:
        return not self.differs and len(self.calls) >= min(len(self.followed), TRACE_LENGTH)

    def note(self, entry: _Call) -> None:
        super().note(entry)
        position = len(self.calls) - 1
        if not self.differs and position < len(self.followed):
            self.differs = not self._same(entry, self.followed[position])
        if self.differs:
            raise Deviation("another result than in the trace")

    def _same(self, entry: _Call, noted: _Call) -> bool:
        if (entry.function, entry.raised) != (noted.function, noted.raised):
            return False
        ruler = Run(None, self.dtype, self.profile)
        bounds = DERIVATIVES if entry.function == "loss_derivatives" else AGREEMENT
        try:
            if noted.how is None:
                return _agree(ruler, entry.result, noted.result, bounds[self.dtype])
            # Both may err by what the check allows.
            ruler.compare("", entry.result, noted.result, **{**noted.how, "factor": 2 * noted.how.get("factor", 1.0)})
        except Exception:  # whatever a candidate may return where numbers are expected
            return False
        return True


class _Object:
    """Something with methods that the candidate made. Its calls are noted, too."""

    def __init__(self, run: _Recorder, made: Any) -> None:
        self._run, self._made = run, made

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._made, name)

        def call(*args: Any, **options: Any) -> Any:
            return self._run.noted(name, method, *args, **options)

        call.__name__ = name
        return call

    def __call__(self, *args: Any) -> Any:
        return self._run.noted("__call__", self._made, *args)

    def __len__(self) -> int:
        return int(self._run.noted("__len__", self._made.__len__))


def _of_derivatives(check: Check) -> bool:
    return "loss_derivatives" in check.uses


def _is_data(result: Any) -> bool:
    """Whether a result can be compared as it is. Objects are compared by what their methods return."""
    if isinstance(result, Mapping):
        return all(map(_is_data, result.values()))
    if isinstance(result, tuple | list):
        return all(map(_is_data, result))
    return result is None or isinstance(result, str | bool | int | float | np.ndarray | np.generic)


def _agree(ruler: Run, result: Any, noted: Any, bound: float) -> bool:
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
