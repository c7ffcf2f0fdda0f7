"""Plant realistic mistakes one by one, and list what catches each: checks, or preflight and tests too."""

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from conformance.compare import Worst
from conformance.diagnosis import Diagnosis, diagnose
from conformance.errors import UserError
from conformance.execute import Result, selected_checks
from conformance.mutants import MUTANTS, Mutant, MutantAdapter, relevant, sound, trial
from conformance.mutants.implementations import report as implementations
from conformance.mutants.trial import setting_of_trials
from conformance.results import versions, write

EXAMPLES = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--only", default="", help="only mutants whose name contains this")
    parser.add_argument(
        "--diagnose",
        action="store_true",
        help="check each as if it were a third-party implementation, and see whether it is named",
    )
    parser.add_argument(
        "--implementations",
        nargs="*",
        default=None,
        metavar="NAME",
        help="plant the mistakes of the backends, the learners and the trainer instead of those of the reference; all, "
        "or those with this name, kind, file or catalogue. Takes hours, and a checkout",
    )
    parser.add_argument("--json", type=Path, default=None, metavar="FILE", help="write the results to this file, too")


def main(console: Console, options: argparse.Namespace) -> int:
    if options.implementations is not None:
        return implementations.main(console, options.implementations, options.json)
    mutants = [mutant for mutant in MUTANTS.values() if options.only in mutant.name]
    if not mutants:
        raise UserError(f"no mutant matches --only {options.only!r}")
    view = Table()
    for column in (
        "mutant",
        "mistake",
        "provenance",
        "deviates in",
        "raises in",
        "first",
        *["diagnosis"] * options.diagnose,
    ):
        view.add_column(column, overflow="fold")
    report: dict[str, dict[str, Any]] = {}
    with console.status("running the checks on the reference without a mistake") as status:
        reach, broken = sound(selected_checks("float64"), EXAMPLES)
        for number, mutant in enumerate(mutants, 1):
            status.update(f"{number}/{len(mutants)} {mutant.name}")
            results = list(trial(mutant, relevant(mutant, reach), EXAMPLES))
            report[mutant.name] = entry = mutant_report(mutant, results)
            if options.diagnose:
                # The checks that cannot notice the mutant pass.
                unmoved = [
                    Result(check, "pass", Worst(), 1) for check in reach if not reach[check] & mutant.edits.keys()
                ]
                found, _ = diagnose(MutantAdapter(mutant), [*results, *unmoved], setting_of_trials(EXAMPLES))
                entry["diagnosis"] = [diagnosis_report(diagnosis) for diagnosis in found]
            view.add_row(*_row(mutant, entry))
    console.print(view)
    for result in broken:
        console.print(f"[bold red]{result.check.name}[/] is not counted: the reference itself does not pass it")
        console.print(result.message, markup=False, highlight=False)
    survivors = sum(not entry["deviates_in"] + entry["raises_in"] for entry in report.values())
    unnamed = sum("diagnosis" in entry and not is_named(name, entry["diagnosis"]) for name, entry in report.items())
    diagnosed = f", {unnamed} not named by the diagnosis" if options.diagnose else ""
    console.print(
        f"{len(mutants)} mutants, {survivors} survived{diagnosed}; {len(reach)} checks, {len(broken)} more "
        f"that the reference does not pass"
    )
    if options.json:
        write(options.json, {"versions": versions(), "mutants": report})
    return 1 if survivors or unnamed or broken else 0


def mutant_report(mutant: Mutant, results: Iterable[Result]) -> dict[str, Any]:
    """A mutant and what caught it, in plain JSON types."""
    results = list(results)
    return {
        "explanation": mutant.explanation,
        "provenance": mutant.provenance,
        "chapter": mutant.chapter,
        "violates": list(mutant.violates),
        "fix": mutant.fix,
        "deviates_in": [result.check.name for result in results if result.status == "fail"],
        "raises_in": [result.check.name for result in results if result.status == "error"],
    }


def diagnosis_report(diagnosis: Diagnosis) -> dict[str, Any]:
    return {
        "mutant": diagnosis.mutant.name,
        "alternatives": [mutant.name for mutant in diagnosis.alternatives],
        "explained": len(diagnosis.explained),
        "unexplained": list(diagnosis.unexplained),
    }


def is_named(name: str, diagnoses: list[dict[str, Any]]) -> bool:
    """Whether the first diagnosis is this mutant and no other."""
    return bool(diagnoses) and diagnoses[0]["mutant"] == name and not diagnoses[0]["alternatives"]


def _row(mutant: Mutant, entry: dict[str, Any]) -> list[str]:
    killers = entry["deviates_in"] + entry["raises_in"]
    row = [
        mutant.name,
        mutant.explanation,
        mutant.provenance,
        str(len(entry["deviates_in"])),
        str(len(entry["raises_in"])),
    ]
    row.append(killers[0] if killers else "[bold red]nothing")
    if "diagnosis" in entry:
        named = is_named(mutant.name, entry["diagnosis"])
        others = [name for found in entry["diagnosis"] for name in (found["mutant"], *found["alternatives"])]
        row.append("named" if named else f"[bold red]{', '.join(others) or 'nothing'}")
    return row
