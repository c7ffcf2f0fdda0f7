"""Runs checks on an adapter and sums the results up by requirement."""

import dataclasses
import math
import traceback
from collections.abc import Iterable

from conformance.check import CHECKS, Call, CandidateLost, Check, Deviation, Run, Worst
from conformance.requirements import requirements
from conformance.strategies import ordinary_numbers
from spec import editions

FAILING = ("fail", "error")
NOT_IMPLEMENTED = "not implemented: "
"""How the message of a check begins that is not offered because the candidate raised a `NotImplementedError`."""


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
    call: Call | None = None
    extreme: bool = False


@dataclasses.dataclass(frozen=True)
class Settings:
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
    def profile(self) -> str:
        """The name of the edition's values."""
        return editions()[self.edition].profile


@dataclasses.dataclass(frozen=True)
class Row:
    """What all checks of one requirement found."""

    requirement: str
    results: tuple[Result, ...]

    @property
    def status(self) -> str:
        statuses = {result.status for result in self.results}
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


def run_check(
    check: Check, adapter: object, dtype: str, profile: str, seed: int = 0, examples: int = 25, shrink: bool = True
) -> Result:
    """Runs one check; what the candidate raises becomes a result."""
    if lacking := missing(adapter, check):
        return not_offered(check, lacking)
    return finish(check, Run(adapter, dtype, profile, seed, examples, shrink))


def finish(check: Check, run: Run) -> Result:
    """Runs a check to its end or to its first deviation."""
    try:
        with ordinary_numbers(run.stand_in is not None):
            check.body(run)
    except Deviation as deviation:
        return Result(check, "fail", run.worst, run.compared, str(deviation), run.last_call)
    except CandidateLost as lost:
        return Result(check, "error", Worst(math.inf, math.inf, check.name), run.compared, str(lost), run.last_call)
    except (Exception, SystemExit) as error:  # an object that the candidate made may call sys.exit
        if isinstance(error, NotImplementedError) and getattr(
            run.adapter, "refuses_anyhow", False
        ):  # not of our own columns
            return not_implemented(check, run.last_call.function if run.last_call else check.name, str(error))
        return Result(
            check,
            "error",
            Worst(math.inf, math.inf, check.name),
            run.compared,
            traceback.format_exc(limit=-4),
            run.last_call,
        )
    if not run.compared:
        return Result(check, "error", run.worst, 0, "the check compared nothing")
    return Result(check, "pass", run.worst, run.compared)


def selected_checks(dtype: str, only: str = "") -> list[Check]:
    """The checks that apply at a dtype and whose name or requirement ids contain `only`."""
    import conformance.cases  # noqa: F401 - importing registers the checks

    return [
        check
        for check in sorted(CHECKS.values(), key=lambda check: (check.level, check.name))
        if dtype in check.dtypes
        and (only in check.name or any(only in requirement for requirement in check.requirements))
    ]


def run_checks(
    adapter: object, dtype: str, profile: str, seed: int = 0, examples: int = 25, only: str = ""
) -> Iterable[Result]:
    for check in selected_checks(dtype, only):
        yield run_check(check, adapter, dtype, profile, seed, examples)


def rows(results: Iterable[Result]) -> list[Row]:
    """The results by requirement, in the order of the chapters; requirements that none of the checks names are left
    out."""
    results = list(results)
    found = [
        Row(requirement, tuple(result for result in results if requirement in result.check.requirements))
        for requirement in requirements()
    ]
    return [row for row in found if row.results]
