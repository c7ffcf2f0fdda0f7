"""Runs checks on an adapter and sums the results up by requirement."""

import dataclasses
import math
import traceback
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Case, Setting
from conformance.check import CHECKS, Check
from conformance.compare import CandidateLost, Comparisons, Deviation, Worst, is_extreme
from conformance.drawing import cases
from conformance.judge import Ask, asking, judge_cases, judge_ordinary_cases, standing_in
from conformance.requirements import requirements
from conformance.script import Script
from conformance.strategies import ordinary_numbers
from spec import editions

FAILING = ("fail", "error")
NOT_IMPLEMENTED = "not implemented: "
"""How the message of a check begins where the candidate raised a `NotImplementedError`: one that is not offered, or
passes in its other cases."""


@dataclasses.dataclass(frozen=True)
class FailedCall:
    """The call where a check failed, and the comparison that went wrong.

    got and expected: the two arrays that disagree, None where no arrays were compared. index: of the worst element,
    None where shapes differ. case: that the call belongs to, None in a script; drawn: whether hypothesis draws values
    there.
    """

    function: str
    arguments: tuple[Any, ...]
    got: np.ndarray | None = None
    expected: np.ndarray | None = None
    index: tuple[int, ...] | None = None
    case: Case | None = None
    drawn: bool = False

    @property
    def by_hand(self) -> bool:
        """Whether it is an example of a chapter."""
        return self.case is not None and self.case.by_hand

    @property
    def is_most_ordinary(self) -> bool:
        """Whether no input can be more ordinary: it is written down, and not extreme."""
        return self.case is not None and not self.drawn and not self.case.is_extreme

    @property
    def is_extreme_throughout(self) -> bool:
        """Whether no call of its case has ordinary input."""
        case = self.case
        return case is not None and (case.refused is not None or all(is_extreme(call.arguments) for call in case.calls))


@dataclasses.dataclass(frozen=True)
class Result:
    """What one check found. status: "pass", "fail", "error" (the candidate raised), "not offered" or "not in edition"
    (not judged).

    call: where it failed, the last call of the candidate; None where it was not called. extreme: whether it fails with
    extreme input only, and passes with ordinary input.
    """

    check: Check
    status: str
    worst: Worst
    compared: int
    message: str = ""
    call: FailedCall | None = None
    extreme: bool = False

    @property
    def is_partial(self) -> bool:
        """Whether it passed in some of its cases, and the others ask for what the candidate does not have."""
        return self.status == "pass" and bool(self.check.lacking or self.message)


@dataclasses.dataclass(frozen=True)
class CheckOptions:
    """What a run was asked to do. candidate: its name, or the command of a process. at_least: how many checks must
    pass."""

    candidate: str
    process: bool
    dtype: str
    device: str | None
    edition: str
    only: str
    seed: int
    examples: int
    at_least: int

    @property
    def setting(self) -> Setting:
        """With the profile of the edition's values."""
        return Setting(self.dtype, editions()[self.edition].profile, self.seed, self.examples)


@dataclasses.dataclass(frozen=True)
class RequirementResult:
    """What all checks of one requirement found."""

    requirement: str
    results: tuple[Result, ...]

    @property
    def status(self) -> str:
        statuses = {result.status for result in self.results}
        statuses |= {"not offered" for result in self.results if result.is_partial}
        for status in ("error", "fail", "not offered"):
            if status in statuses:
                return status
        return next((status for status in ("pass", "not in edition") if status in statuses), "no check")

    @property
    def worst(self) -> Worst:
        return max((result.worst for result in self.results), key=lambda worst: worst.share, default=Worst())


def missing(adapter: object, check: Check) -> list[str]:
    """What the check needs and the adapter does not offer. A module may hold other things under such names: `from mine
    import losses`."""
    return [name for name in check.uses if not callable(getattr(adapter, name, None))]


def not_offered(check: Check, lacking: Iterable[str]) -> Result:
    return Result(check, "not offered", Worst(), 0, f"the adapter does not offer {', '.join(lacking)}")


def not_implemented(check: Check, function: str, reason: str) -> Result:
    """The candidate offers the function, and says that it lacks what this call asks for."""
    return Result(check, "not offered", Worst(), 0, f"{NOT_IMPLEMENTED}{function}" + (f" ({reason})" if reason else ""))


def run_check(check: Check, adapter: object, setting: Setting, shrink: bool = True, ordinary: bool = False) -> Result:
    """Runs one check; what the candidate raises becomes a result.

    shrink: makes values smaller that deviate, which takes longer. ordinary: deviations with extreme input do not count;
    with `shrink`, cases are built one by one, which is faster where one of the first deviates.
    """
    if lacking := missing(adapter, check):
        return not_offered(check, lacking)
    comparisons = Comparisons(setting.dtype)
    ask = standing_in(asking(adapter), NumpyAdapter()) if ordinary and check.script else asking(adapter)
    return outcome(
        check, adapter, comparisons, lambda: run(check, setting, ask, comparisons, adapter, shrink, ordinary)
    )


def run(
    check: Check,
    setting: Setting,
    ask: Ask,
    comparisons: Comparisons,
    adapter: object,
    shrink: bool = True,
    ordinary: bool = False,
) -> None:
    """Runs a check to its end or to its first deviation, which is raised. adapter: the candidate that `ask` asks."""
    any_error = bool(getattr(adapter, "refuses_anyhow", False))
    with np.errstate(all="ignore"), ordinary_numbers(ordinary):
        if check.cases is not None and ordinary and shrink:
            judge_ordinary_cases(check.cases, setting, ask, comparisons, any_error)
        elif check.cases is not None:
            judge_cases(check.cases, setting, ask, comparisons, ordinary=ordinary, shrink=shrink, any_error=any_error)
        else:
            assert check.script is not None
            check.script(Script(setting, ask, comparisons, shrink, any_error, refusals=not ordinary))


def outcome(check: Check, adapter: object, comparisons: Comparisons, body: Callable[[], None]) -> Result:
    """What came of running a check."""

    def result(status: str, worst: Worst, message: str, deviation: Deviation | None = None) -> Result:
        return Result(check, status, worst, comparisons.compared, message, _failed(comparisons, deviation))

    broken = Worst(math.inf, math.inf, check.name)
    try:
        body()
    except Deviation as deviation:
        return result("fail", comparisons.worst, str(deviation), deviation)
    except CandidateLost as lost:
        return result("error", broken, str(lost))
    except (Exception, SystemExit) as error:  # an object that the candidate made may call sys.exit
        if isinstance(error, NotImplementedError) and getattr(
            adapter, "refuses_anyhow", False
        ):  # not of our own implementations
            return not_implemented(check, comparisons.call.function if comparisons.call else check.name, str(error))
        return result("error", broken, traceback.format_exc(limit=-4))
    lacking = NOT_IMPLEMENTED + ", ".join(dict.fromkeys(comparisons.left_out)) if comparisons.left_out else ""
    if lacking and not comparisons.compared:
        return Result(check, "not offered", Worst(), 0, lacking)
    if not comparisons.compared:
        return Result(check, "error", comparisons.worst, 0, "the check compared nothing")
    return Result(check, "pass", comparisons.worst, comparisons.compared, lacking)


def _failed(comparisons: Comparisons, deviation: Deviation | None) -> FailedCall | None:
    if (call := comparisons.call) is None:
        return None
    arrays = (deviation.got, deviation.expected, deviation.index) if deviation is not None else (None, None, None)
    return FailedCall(call.function, call.arguments, *arrays, comparisons.case, comparisons.drawn)


def selected_checks(dtype: str, only: str = "") -> list[Check]:
    """The checks that apply at a dtype and whose name or requirement ids contain `only`."""
    import conformance.cases  # noqa: F401 - importing registers the checks

    return [
        check
        for check in sorted(CHECKS.values(), key=lambda check: (check.level, check.name))
        if dtype in check.dtypes
        and (only in check.name or any(only in requirement for requirement in check.requirements))
    ]


def calls_of(checks: Iterable[Check], adapter: object, setting: Setting) -> Iterator[tuple[str, tuple[Any, ...]]]:
    """The calls of all cases that are not refused, which a candidate that compiles may want to know in advance."""
    for check in checks:
        if check.cases is not None and not missing(adapter, check):
            for case, _ in cases(check.cases, setting):
                yield from ((call.function, call.arguments) for call in case.calls if case.refused is None)


def by_requirement(results: Iterable[Result]) -> list[RequirementResult]:
    """The results by requirement, in the order of the chapters; requirements that none of the checks names are left
    out."""
    results = list(results)
    found = [
        RequirementResult(requirement, tuple(result for result in results if requirement in result.check.requirements))
        for requirement in requirements()
    ]
    return [one for one in found if one.results]
