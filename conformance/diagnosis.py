"""From deviations to the mistake: which mutant gives the numbers of the candidate where the checks fail.

A failing check is run again on the candidate with a note of every call and its result: its trace. The same check is run
on each mutant that it reaches. A mutant explains the check if its results agree with the trace, also where those of the
reference do not. Where a check fails with ordinary input, the trace is made of that alone: what is done with NaN and
infinities would hide the mistake; it has a trace of its own. Of mutants that explain the same, those are named that
also agree after the first deviation.

A trace that no mutant of the catalogue explains is compared with the single-term variants of the equations that the
check reaches, and then with two mutants at once. How much is compared is limited by a count of work that is the same
on every machine.
"""

import dataclasses
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Setting
from conformance.check import CHECKS, Check
from conformance.execute import FAILING, Result, missing, run_check
from conformance.mutants import MUTANTS, Mutant, MutantAdapter
from conformance.mutants.catalogue import GENERATED, KNOWN, PAIR
from conformance.mutants.pairs import both, pairs
from conformance.mutants.reach import reach_of, suspects
from conformance.mutants.trial import on_the_mutant
from conformance.mutants.variants import variants
from conformance.traces import EXTREME, ORDINARY, Trace, evidence, follows, of_derivatives, record

# so many traces, the most elementary first, are compared with all of a kind in vain before the rest is left unexplained
TRIES = {KNOWN: 8, GENERATED: 3, PAIR: 3}
ALIKE = 4  # variants that are told apart by further checks
# How often functions of the reference may be entered for a comparison: some microseconds each. So much for any run, and
# so much more for each check that was judged.
WORK, WORK_OF_A_CHECK = 1_500_000, 4_000
SHARES = {KNOWN: 0.6, GENERATED: 0.9, PAIR: 1.0}  # of the work, up to which each kind may go
OVERHEAD = 50  # of a comparison, in the same unit
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
    any other. refuted_by: a check that speaks against it, so that it is only the nearest: the candidate passes it and
    the mutant does not, or both fail it with other numbers; "" where there is none.
    """

    mutant: Mutant
    explained: tuple[str, ...]
    unexplained: tuple[str, ...]
    alternatives: tuple[Mutant, ...] = ()
    refuted_by: str = ""

    def to_json(self) -> dict[str, Any]:
        """As the reports take it: conformance/report.schema.json."""
        return {
            "kind": self.mutant.kind,
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


class Findings(NamedTuple):
    """What a diagnosis came to. is_cut: whether it reached its limit before everything was compared."""

    diagnoses: list[Diagnosis]
    is_cut: bool


def unwatched(what: str, checks: Collection[Check]) -> Iterable[Check]:
    return checks


def diagnose(adapter: object, results: Iterable[Result], setting: Setting, watch: Watch = unwatched) -> Findings:
    """The mistakes that explain why checks fail, those that explain most first; each explains a check that none before
    it does.

    Args:
      adapter: the candidate.
      results: of all checks that were run on it, with the settings that follow.
      watch: hands out the failing checks.
    """
    candidate = _Candidate(adapter, setting, list(results))
    candidate.record(watch)
    search = _Search(candidate)
    search.run(watch)
    return Findings(list(_diagnoses(candidate, search.found)), search.is_cut)


def _diagnoses(candidate: "_Candidate", mutants: Iterable[Mutant]) -> Iterator[Diagnosis]:
    traces = candidate.traces
    explained: Mapping[Mutant, set[Trace]] = {
        mutant: {trace for trace in traces if candidate.explains(mutant, trace)} for mutant in mutants
    }
    left = set(traces)
    while explained := {mutant: found for mutant, found in explained.items() if found & left}:
        (first, *others), refuted_by = _best(candidate, explained)
        names = dict.fromkeys(trace.check.name for trace in traces)
        known = {trace.check.name for trace in explained[first]}
        alternatives = tuple(mutant for mutant in others if explained[mutant] == explained[first])
        yield Diagnosis(
            first,
            tuple(name for name in names if name in known),
            tuple(name for name in names if name not in known),
            alternatives,
            refuted_by,
        )
        left -= explained[first]


def _best(candidate: "_Candidate", explained: Mapping[Mutant, set[Trace]]) -> tuple[list[Mutant], str]:
    """Of the mutants that no check speaks against those that explain most; where there are none, of all, and a check
    that does. Of several the simplest: one that is known, one that is generated, two that are known."""
    ranks = [KNOWN, GENERATED, PAIR]
    groups: dict[tuple[int, int], list[Mutant]] = {}
    for mutant, found in explained.items():
        groups.setdefault((-len(found), ranks.index(mutant.kind)), []).append(mutant)
    nearest: list[Mutant] = []
    for _, tied in sorted(groups.items()):
        group = _likeliest(candidate, tied, explained)
        nearest = nearest or group
        if possible := [mutant for mutant in group if not candidate.contradiction(mutant)]:
            return possible, ""
    return nearest, candidate.contradiction(nearest[0])


def _likeliest(
    candidate: "_Candidate", tied: list[Mutant], explained: Mapping[Mutant, Collection[Trace]]
) -> list[Mutant]:
    """Of several those that also agree after the first deviation, if there are such."""
    if len(tied) == 1:
        return tied
    return [
        mutant
        for mutant in tied
        if all(candidate.follows_to_the_end(mutant, trace) for trace in explained[mutant] if trace.part != EXTREME)
    ] or tied


class _Search:
    """Looks for mutants that explain traces, of each first in the catalogue, and then beyond it."""

    def __init__(self, candidate: "_Candidate") -> None:
        self.found: list[Mutant] = []
        self.is_cut = False
        self._candidate = candidate
        self._tries = dict(TRIES)
        self._groups = {KNOWN: _known, GENERATED: self._variants, PAIR: self._pairs}

    def run(self, watch: Watch) -> None:
        traces = self._candidate.traces
        for _, trace in zip(watch("diagnosis, comparing", [one.check for one in traces]), traces, strict=True):
            if not self._is_explained(trace):
                self._explain(trace)

    def _is_explained(self, trace: Trace) -> bool:
        """Whether something explains it that no check speaks against: else there may be better."""
        candidate = self._candidate
        return any(candidate.explains(mutant, trace) and not candidate.contradiction(mutant) for mutant in self.found)

    def _explain(self, trace: Trace) -> None:
        """Adds what explains a trace: of the first kind in which there is something."""
        is_special = trace.part == EXTREME or trace.raises
        for kind in (KNOWN,) if is_special else (KNOWN, GENERATED, PAIR):
            if not self._tries[kind]:
                self.is_cut = True
                continue
            alike = self._first_that_explain(trace, self._groups[kind](trace), SHARES[kind])
            self.found += self._told_apart(alike) if kind == GENERATED else alike
            if self._is_explained(trace):
                return
            self._tries[kind] -= 1

    def _first_that_explain(self, trace: Trace, groups: Iterable[Iterable[Mutant]], share: float) -> list[Mutant]:
        """All of the first group in which there is something."""
        for group in groups:
            alike: list[Mutant] = []
            for mutant in group:
                if self._candidate.has_spent(share):
                    self.is_cut = True
                    return alike
                if mutant not in self.found and self._candidate.explains(mutant, trace):
                    alike.append(mutant)
            if alike:
                return alike
        return []

    def _variants(self, trace: Trace) -> Iterable[Iterable[Mutant]]:
        """Of one function that a trace reaches after the other."""
        return map(variants, suspects(trace.reach, self._candidate.failing, self._candidate.passing))

    def _pairs(self, trace: Trace) -> Iterable[Iterable[Mutant]]:
        """Two mistakes that were found, wherever they are, and then two in one function."""
        found = [(one, other) for place, other in enumerate(self.found) for one in self.found[:place]]
        yield [made for one, other in found if PAIR not in (one.kind, other.kind) and (made := both(one, other))]
        yield pairs(mutant for mutant in MUTANTS.values() if not trace.reach.isdisjoint(mutant.edits))

    def _told_apart(self, alike: list[Mutant]) -> list[Mutant]:
        """Of variants that explain the same trace those that explain others, too, as far as one does."""
        for trace in self._candidate.traces:
            if len(alike) > 1 and not trace.of_derivatives:
                alike = [mutant for mutant in alike if self._candidate.explains(mutant, trace)] or alike
        return alike[:ALIKE]


def _known(trace: Trace) -> Iterable[Iterable[Mutant]]:
    """The catalogue. Where derivatives alone are wrong, first what is about gradients."""
    if trace.of_derivatives:
        yield [mutant for mutant in MUTANTS.values() if "stop_gradient" in str(mutant.edits)]
    yield MUTANTS.values()


class _Candidate:
    """A candidate and what is known of it, in one setting."""

    def __init__(self, adapter: object, setting: Setting, results: list[Result]) -> None:
        self.adapter, self.setting = adapter, setting
        self.statuses = {result.check.name: result.status for result in results}
        small = [result for result in results if not result.check.is_large]
        self.failing = [result.check for result in small if result.status in FAILING]
        self.failing.sort(key=lambda check: (check.level, of_derivatives(check), len(reach_of(check)), check.name))
        self.passing = [result.check for result in small if result.status == "pass"]
        self.traces: list[Trace] = []
        self._limit = WORK + WORK_OF_A_CHECK * (len(self.failing) + len(self.passing))
        self._work = 0.0
        self._explained: dict[tuple[Mutant, Trace], bool] = {}
        self._contradictions: dict[Mutant, str] = {}
        self._whole: dict[Trace, Trace] = {}

    def has_spent(self, share: float) -> bool:
        """Whether so much of the work has been done that is allowed."""
        return self._work >= share * self._limit

    def record(self, watch: Watch) -> None:
        """The traces of the checks that fail, as far as the reference can give the answers.

        Derivatives are compared where the losses are right: those of other losses are wrong anyway.
        """
        values_fail = any(self.statuses.get(name) in FAILING for name in VALUES)
        for check in watch("diagnosis, recording", self.failing):
            if not missing(NumpyAdapter(), check) and not (of_derivatives(check) and values_fail):
                self.traces += evidence(self.adapter, check, self.setting)
        # What is compared soonest and says most comes first: derivatives are slow, extreme input is special.
        self.traces.sort(
            key=lambda one: (one.of_derivatives, one.part != ORDINARY, one.check.level, one.work, one.check.name)
        )

    def explains(self, mutant: Mutant, trace: Trace) -> bool:
        if (key := (mutant, trace)) not in self._explained:
            self._explained[key] = self._may_explain(mutant, trace) and self._follows(mutant, trace)
        return self._explained[key]

    def contradiction(self, mutant: Mutant) -> str:
        """The name of a check that speaks against a mutant; "" if there is none."""
        if mutant not in self._contradictions:
            self._contradictions[mutant] = next(self._speaking_against(mutant), "")
        return self._contradictions[mutant]

    def _speaking_against(self, mutant: Mutant) -> Iterator[str]:
        """Checks of a function that the mutant changes alone, in which the candidate has other numbers; and those that
        it passes, and the mutant does not."""
        own = [trace for trace in self.traces if trace.part == ORDINARY and self._is_of(mutant, trace.check)]
        for check in dict.fromkeys(trace.check for trace in own):
            if not any(self.explains(mutant, trace) for trace in self.traces if trace.check is check):
                yield check.name
        chapters = {target.partition(".")[0] for target in mutant.edits}
        nearest = sorted(self.passing, key=lambda check: check.name.partition(".")[0] not in chapters)
        yield from (check.name for check in nearest if self._fails(mutant, check))

    def _is_of(self, mutant: Mutant, check: Check) -> bool:
        names = {target.partition(".")[2] for target in mutant.edits}
        return check.level == 0 and not names.isdisjoint(check.uses)

    def follows_to_the_end(self, mutant: Mutant, trace: Trace) -> bool:
        if trace not in self._whole:
            self._whole[trace] = record(self.adapter, trace.check, self.setting, ORDINARY, to_the_end=True)[0]
        return follows(MutantAdapter(mutant), self._whole[trace], self.setting, to_the_end=True)[0]

    def _follows(self, mutant: Mutant, trace: Trace) -> bool:
        agrees, asked = follows(MutantAdapter(mutant), trace, self.setting)
        self._work += OVERHEAD + trace.work * min(1.0, asked / max(1, len(trace.answers)))
        return agrees

    def _may_explain(self, mutant: Mutant, trace: Trace) -> bool:
        """What changes the total loss is not the mistake of a candidate whose losses are right. This is said fast,
        derivatives are slow."""
        if trace.reach.isdisjoint(mutant.edits):
            return False
        right = trace.of_derivatives and all(self.statuses.get(name) == "pass" for name in VALUES)
        return not (right and self._fails(mutant, CHECKS["losses.total_matches"]))

    def _fails(self, mutant: Mutant, check: Check) -> bool:
        if reach_of(check).isdisjoint(mutant.edits):
            return False
        if mutant.kind == KNOWN:
            return on_the_mutant(mutant, check, self.setting).status in FAILING
        return run_check(check, MutantAdapter(mutant), self.setting, shrink=False).status in FAILING
