"""The result of a run as plain JSON types: report.schema.json says what is in it. Every report is made from it and from
nothing else."""

import dataclasses
import functools
import importlib.metadata
import json
import platform
import time
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from conformance.errors import UserError, read_text
from conformance.execute import FAILING, CheckOptions, RequirementResult, Result, by_requirement
from conformance.expected import ExpectedFailures
from conformance.foreign import ForeignAdapter
from conformance.offered import offered, unchecked, without_gradients
from conformance.reports.reproduce import failure
from conformance.requirements import chapter_of, requirements
from conformance.schema import misfit, validator

FORMAT = 1

Data = dict[str, Any]
NONE_EXPECTED = ExpectedFailures()


def finite(number: float) -> float | None:
    """Three digits of a number; None where it has no size."""
    return float(f"{number:.3g}") if abs(number) < 1e300 else None


def versions() -> dict[str, str]:
    """Of the kit and of what it stands on."""
    installed = {distribution.name: distribution.version for distribution in importlib.metadata.distributions()}
    names = ("dreamer-spec", "numpy", "hypothesis", "jax", "torch")
    return {"python": platform.python_version(), **{name: installed[name] for name in names if name in installed}}


def identity(adapter: object, candidate: str) -> Data:
    """Name, version, claimed edition and functions of the candidate. One of our own implementations has the version
    of the kit, and claims none."""
    if isinstance(adapter, ForeignAdapter):
        claimed = adapter.edition()
        about = {"name": adapter.name, "version": adapter.version, "edition": None if claimed is None else str(claimed)}
    else:
        about = {"name": candidate, "version": versions().get("dreamer-spec", ""), "edition": None}
    return {**about, "offered": offered(adapter)}


def result_data(
    options: CheckOptions,
    implementation: Mapping[str, Any],
    results: Iterable[Result],
    expected: ExpectedFailures,
    diagnoses: Sequence[Mapping[str, Any]] | None = (),
    choice: str = "given",
    fit: Data | None = None,
    is_cut: bool = False,
) -> Data:
    """A run and everything that was found.

    Args:
      implementation: of `identity`.
      diagnoses: of the mutants that the candidate behaves like, each as the schema's `diagnosis` says; None where they
        were not looked for.
      choice: how the edition was chosen: "given", "claimed" or "best fit".
      fit: how well each edition fits, as the schema's `fit` says; None where that was not asked.
      is_cut: whether the diagnosis reached its limit before everything was compared.

    `share` is the worst deviation as a share of the allowed one; it is null where what failed has no size.
    """
    results = list(results)
    return {
        "format": FORMAT,
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        **dataclasses.asdict(options),
        "profile": options.setting.profile,
        "choice": choice,
        "fit": fit,
        "implementation": dict(implementation),
        "unchecked": unchecked(implementation["offered"], results),
        "without_gradients": without_gradients(results),
        "versions": versions(),
        "verdict": verdict(options, results, expected),
        "expected_failures": [
            {"name": name, "reason": reason, "outcome": expected.outcome(name, results)}
            for name, reason in expected.reasons.items()
        ],
        "checks": {result.check.name: check_data(result, options, expected) for result in results},
        "requirements": {one.requirement: _requirement(one) for one in by_requirement(results)},
        "diagnoses": None if diagnoses is None else [dict(diagnosis) for diagnosis in diagnoses],
        "diagnosis_is_cut": is_cut,
    }


def verdict(options: CheckOptions, results: Sequence[Result], expected: ExpectedFailures) -> Data:
    """Whether the run passed, and what stands against it."""
    statuses = [
        result.status for result in results if expected.reason(result.check) is None or result.status not in FAILING
    ]
    failing, passing = sum(status in FAILING for status in statuses), statuses.count("pass")
    problems = [f"{_checks(failing)} failed"] if failing else []
    problems += [
        f"{name} passes, and is expected to fail"
        for name in expected.reasons
        if expected.outcome(name, results) == "pass"
    ]
    if passing < options.at_least:
        problems.append(f"{_checks(passing)} passed, and at least {options.at_least} must")
    return {"passed": not problems, "problems": problems}


def _checks(count: int) -> str:
    return f"{count} {'check' if count == 1 else 'checks'}"


def check_data(result: Result, options: CheckOptions, expected: ExpectedFailures = NONE_EXPECTED) -> Data:
    """What one check found, as the schema's `check` says."""
    check = result.check
    return {
        "status": result.status,
        "requirements": list(check.requirements),
        "lacking": list(check.lacking),
        "level": check.level,
        "summary": check.summary,
        "compared": result.compared,
        "deviation": finite(result.worst.deviation),
        "share": finite(result.worst.share),
        "where": result.worst.where,
        "message": result.message,
        "extreme": result.extreme,
        "expected_failure": expected.reason(check),
        "failure": failure(result, options) if result.status in FAILING else None,
    }


def _requirement(found: RequirementResult) -> Data:
    return {
        "status": found.status,
        "chapter": chapter_of(found.requirement),
        "text": requirements()[found.requirement],
        "checks": [result.check.name for result in found.results],
        "deviation": finite(found.worst.deviation),
        "share": finite(found.worst.share),
        "where": found.worst.where,
    }


def write(path: Path, report: Data) -> None:
    write_text(path, json.dumps(report, indent=1) + "\n")


def write_text(path: Path, text: str) -> None:
    """Characters of a candidate's messages that no encoding has are escaped. Raises UserError where it is not
    possible."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error


@functools.cache
def schema() -> Data:
    return dict(json.loads(resources.files("conformance").joinpath("report.schema.json").read_text(encoding="utf-8")))


def read(path: Path) -> Data:
    """A result that `conformance check --json` has written.

    Raises:
      UserError: there is none, or the file is something else.
    """
    try:
        data = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not JSON: {error}") from error
    if problem := misfit(data, validator(schema())):
        raise UserError(
            f"{path} is not a result of format {FORMAT}: {problem}; make one with: conformance check ... --json {path}"
        )
    return dict(data)
