"""How a candidate is judged in an edition, and which edition fits it best.

The checks say what holds in the chapters. Where an edition differs, a mutant of the reference may behave as the edition
does; the reference with all mutants of an edition is the edition's own reference. A check that it passes holds in the
edition, too, and runs as always. A check that it does not pass, or that names what the edition has otherwise, gives the
calls: what the candidate returns is compared with what the edition's reference returns. And where the edition's way is
not modelled, nothing is judged.
"""

import dataclasses
import functools
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Call, Equal, Refused, Setting
from conformance.check import CHECKS, Check
from conformance.compare import WIDE, Comparisons, Unjudged, Worst, round_to
from conformance.diagnosis import VALUES
from conformance.execute import FAILING, CheckOptions, Result, missing, not_offered, outcome, run, run_check
from conformance.interface import OBJECTS
from conformance.judge import Ask, asking, copied, judge_refusal, standing_in
from conformance.mutants import MUTANTS, Mutant, MutantAdapter
from conformance.mutants.trial import on_the_mutant, on_the_reference
from conformance.offered import narrowed
from conformance.traces import AGREEMENT, DERIVATIVES
from spec import Edition, editions

NOT_JUDGED = "not in edition"
REACH_EXAMPLES = 5  # cases that show which functions a check reaches
FIT_EXAMPLES = 5
AGAIN = 4  # times as many cases show that a failure is with extreme input only: few would by chance be gentle
GRADIENTS = {"gradients", "gradients_given", "loss_derivatives"}
PREFERRED = ("paper", "2024-12", "2024-04", "2023")
"""The order of editions that fit equally well."""


@functools.cache
def own_reference(edition: str) -> Mutant | None:
    """The mutants of an edition as one; None where the reference itself is the edition's.

    Raises:
      ValueError: two of them change the same words.
    """
    edits: dict[str, dict[str, str]] = {}
    for name in editions()[edition].mutants:
        for target, changes in MUTANTS[name].edits.items():
            if clash := changes.keys() & edits.setdefault(target, {}).keys():
                raise ValueError(f"edition {edition}: two mutants change {sorted(clash)} of {target}")
            edits[target] |= changes
    if not edits:
        return None
    differs = tuple(requirement for requirement, difference in editions()[edition].differs.items() if difference.like)
    return Mutant(f"edition {edition}", editions()[edition].title, editions()[edition].source, differs, "", edits)


def telling_checks(checks: Iterable[Check]) -> list[Check]:
    """Those by which editions can be told apart: of a requirement that an edition has otherwise, by a mutant or by a
    setting.

    Gradients and large batches are left out: they are slow, and tell nothing that the losses of small ones do not.
    """
    told = {
        name
        for edition in editions().values()
        for name, difference in edition.differs.items()
        if difference.is_modelled
    }
    return [
        check
        for check in checks
        if not told.isdisjoint(check.requirements) and GRADIENTS.isdisjoint(check.uses) and not check.is_large
    ]


def judge(
    check: Check,
    adapter: object,
    edition: Edition,
    dtype: str,
    seed: int = 0,
    examples: int = 25,
    shrink: bool = True,
    ordinary: bool = False,
) -> Result:
    """Runs one check as the edition has it; with the status "not in edition" where that is not known.

    ordinary: deviations with extreme input do not count.
    """
    setting = Setting(dtype, edition.profile, seed, examples)
    check = narrowed(check, adapter, setting)
    if lacking := missing(adapter, check):
        return not_offered(check, lacking)
    if reason := _unknown(check, edition.name, setting):
        return Result(check, NOT_JUDGED, Worst(), 0, reason)
    if _holds(check, edition.name, setting):
        return run_check(check, adapter, setting, shrink, ordinary)
    return _compared(check, adapter, edition, setting, shrink, ordinary)


def judge_twice(
    check: Check, adapter: object, edition: Edition, dtype: str, seed: int = 0, examples: int = 25
) -> Result:
    """`judge`; where the check fails, the result is that of the most ordinary input that it fails with.

    It is run again where a more ordinary input than the first that fails may fail too.
    """
    how = (check, adapter, edition, dtype, seed)
    result = judge(*how, examples, shrink=False)
    if result.status not in FAILING or (result.call is not None and result.call.is_most_ordinary):
        return result
    again = judge(*how, AGAIN * examples, ordinary=True)
    if again.status in FAILING and again.call is not None:
        return again
    smaller = judge(*how, examples) if result.call is None or result.call.case is None or result.call.drawn else result
    extreme = again.status == "pass" or (result.call is not None and result.call.is_extreme_throughout)
    return dataclasses.replace(smaller if smaller.status in FAILING else result, extreme=extreme)


def by_comparison(result: Result, edition: Edition, asked: CheckOptions) -> bool:
    """Whether a check was compared with the edition's own reference, of which the catalogue of mutants says nothing."""
    return not _holds(result.check, edition.name, asked.setting)


@functools.cache
def _unknown(check: Check, name: str, setting: Setting) -> str:
    """Why a check cannot be judged in an edition; "" if it can."""
    edition = editions()[name]
    if others := [identifier for identifier in check.requirements if _is_unknown(edition, identifier)]:
        return f"{name} has {', '.join(others)} otherwise, which is not modelled here"
    if own_reference(name) is None and edition.is_built:
        return ""
    if reached := sorted(_reach(check, setting) & set(edition.beyond)):
        return f"it reaches {', '.join(reached)}, which {name} has otherwise and which is not modelled here"
    if _holds(check, name, setting):
        return ""
    if missing(NumpyAdapter(), check) or any(use in OBJECTS or use.startswith("draw_") for use in check.uses):
        return f"{name} has some of it otherwise, and there are no right results to compare with"
    return ""


def _is_unknown(edition: Edition, requirement: str) -> bool:
    return requirement in edition.differs and not edition.differs[requirement].is_modelled


@functools.cache
def _holds(check: Check, name: str, setting: Setting) -> bool:
    """Whether a check is run as always: it names nothing that the edition has otherwise, and the edition's own
    reference passes it."""
    differs, mutant = editions()[name].differs, own_reference(name)
    if any(requirement in differs and differs[requirement].like for requirement in check.requirements):
        return False
    if mutant is None or _reach(check, setting).isdisjoint(mutant.edits):
        return True
    return all(on_the_mutant(mutant, one, where).status == "pass" for one, where in _stand_ins(check, setting))


def _reach(check: Check, setting: Setting) -> frozenset[str]:
    one, where = _stand_ins(check, setting)[0]
    return on_the_reference(one, dataclasses.replace(where, examples=REACH_EXAMPLES))[1]


def _stand_ins(check: Check, setting: Setting) -> list[tuple[Check, Setting]]:
    """What can be asked of the reference: for gradients and train steps, which it lacks, the losses that these are made
    of."""
    if not missing(NumpyAdapter(), check):
        return [(check, setting)]
    values = [CHECKS[name] for name in VALUES]
    wide = dataclasses.replace(setting, dtype="float64")
    return [(value, setting if setting.dtype in value.dtypes else wide) for value in values]


def _compared(
    check: Check, adapter: object, edition: Edition, setting: Setting, shrink: bool, ordinary: bool
) -> Result:
    """Runs a check and compares every answer with that of the edition's reference. What the check itself demands does
    not count."""
    mutant = own_reference(edition.name)
    assert mutant is not None
    comparisons = _Digits(setting.dtype)
    ask = comparing(asking(adapter), asking(MutantAdapter(mutant)), comparisons, adapter)
    if ordinary and check.script:
        ask = standing_in(ask, MutantAdapter(mutant))
    unjudged = Unjudged(setting.dtype)
    unjudged.left_out = comparisons.left_out

    def body() -> None:
        try:
            run(check, setting, ask, unjudged, adapter, shrink, ordinary)
        finally:
            comparisons.case, comparisons.drawn = unjudged.case, unjudged.drawn

    return outcome(check, adapter, comparisons, body)


def comparing(theirs: Ask, right: Ask, comparisons: Comparisons, adapter: object) -> Ask:
    """The candidate's answers, each compared with what is right."""

    def ask(call: Call, demand: Equal | Refused | None) -> Any:
        try:
            expected = right(Call(call.function, copied(call.arguments, everything=True)), demand)
        except ValueError:
            if not isinstance(demand, Refused):
                raise
            any_error = bool(getattr(adapter, "refuses_anyhow", False))
            judge_refusal(call, demand, theirs, comparisons, any_error)
            return None
        comparisons.call = Call(call.function, copied(call.arguments))
        actual = theirs(call, demand)
        bounds = DERIVATIVES if call.function == "loss_derivatives" else AGREEMENT
        comparisons.compare(call.function, actual, expected, bound=bounds[comparisons.dtype])
        return actual

    return ask


class _Digits(Comparisons):
    """Digits far below 1 are demanded by the chapters. An edition may lose them, each program in its own way."""

    def compare_arrays(self, where: str, actual: Any, expected: Any, magnitude: Any, bound: float) -> None:
        expected = round_to(expected, WIDE[self.dtype])  # beyond which a right result is infinite
        size = np.maximum(np.abs(expected), 1.0) if magnitude is None else magnitude
        super().compare_arrays(where, actual, expected, size, bound)


@dataclasses.dataclass(frozen=True)
class Fit:
    """What the telling checks found in one edition. statuses: check name -> status, of the checks that are offered."""

    edition: str
    statuses: Mapping[str, str]

    @property
    def judged(self) -> frozenset[str]:
        return frozenset(name for name, status in self.statuses.items() if status != NOT_JUDGED)

    @property
    def passed(self) -> frozenset[str]:
        return frozenset(name for name, status in self.statuses.items() if status == "pass")


def fit(checks: Iterable[Check], adapter: object, dtype: str, seed: int = 0, examples: int = FIT_EXAMPLES) -> list[Fit]:
    """How the candidate does in each edition with ordinary input, those that are preferred first.

    A candidate that raises in one edition is not asked again in the others: it would tell nothing, and may be slow to
    come back.
    """
    found: dict[str, dict[str, str]] = {name: {} for name in PREFERRED}
    first = Setting(dtype, editions()[PREFERRED[0]].profile, seed, examples)
    for check in (narrowed(check, adapter, first) for check in checks):
        if missing(adapter, check):
            continue
        broken = False
        for name, statuses in found.items():
            edition = editions()[name]
            known = _unknown(check, name, Setting(dtype, edition.profile, seed, examples))
            status = NOT_JUDGED if known else "error" if broken else ""
            status = status or judge(check, adapter, edition, dtype, seed, examples, shrink=False, ordinary=True).status
            statuses[check.name] = NOT_JUDGED if status == "not offered" else status
            broken |= status == "error"
    return [Fit(name, statuses) for name, statuses in found.items()]


def may_fit_better(failing: Iterable[Check], adapter: object, chosen: Edition, dtype: str, seed: int = 0) -> bool:
    """Whether one of the checks that fail in the chosen edition passes in another with ordinary input: where none does,
    no edition can fit better."""
    others = [edition for name, edition in editions().items() if name != chosen.name]
    return any(
        judge(check, adapter, edition, dtype, seed, FIT_EXAMPLES, shrink=False, ordinary=True).status == "pass"
        for check in failing
        for edition in others
    )


def best(fits: Iterable[Fit]) -> Fit:
    """The edition that the fewest others fit better; of several, the first.

    Two editions are compared on the checks that are judged in both. So an edition does not win by what is not judged in
    it.
    """
    fits = list(fits)
    return min(fits, key=lambda one: sum(fits_better(other, one) for other in fits))


def fits_better(one: Fit, other: Fit) -> bool:
    common = one.judged & other.judged
    return len(one.passed & common) > len(other.passed & common)


def alike(fits: Iterable[Fit], chosen: Fit) -> list[str]:
    """The other editions that nothing which is offered tells from the chosen one."""
    return [
        one.edition
        for one in fits
        if one is not chosen and all(one.statuses[name] == chosen.statuses[name] for name in one.judged & chosen.judged)
    ]


def to_json(fits: list[Fit], edition: str) -> dict[str, Any]:
    """What the reports say of the fits of a candidate that was judged in an edition: the schema's `fit`."""
    chosen = next(one for one in fits if one.edition == edition)
    better = best(fits)
    return {
        "editions": [
            {"edition": one.edition, "passed": len(one.passed), "judged": len(one.judged), "offered": len(one.statuses)}
            for one in fits
        ],
        "alike": alike(fits, chosen),
        "better": better.edition if fits_better(better, chosen) else None,
    }
