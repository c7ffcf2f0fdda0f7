"""Plant realistic mistakes in the reference one by one, and list the checks that catch each."""

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from conformance.execute import selected_checks
from conformance.mutants import MUTANTS, caught_by, sound
from conformance.results import versions, write


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", type=Path, default=None, metavar="FILE", help="write the results to this file, too")


def main(console: Console, options: argparse.Namespace) -> int:
    view = Table()
    for column in ("mutant", "mistake", "deviates in", "raises in", "first"):
        view.add_column(column, overflow="fold")
    report: dict[str, dict[str, Any]] = {}
    with console.status("running the checks on the reference without a mistake") as status:
        checks, broken = sound(selected_checks("float64"))
        for number, mutant in enumerate(MUTANTS.values(), 1):
            status.update(f"{number}/{len(MUTANTS)} {mutant.name}")
            caught = caught_by(mutant, checks)
            killers = caught["fail"] + caught["error"]
            report[mutant.name] = {"mistake": mutant.explanation, "caught_by": killers}
            counts = (str(len(caught["fail"])), str(len(caught["error"])))
            view.add_row(mutant.name, mutant.explanation, *counts, killers[0] if killers else "[bold red]nothing")
    console.print(view)
    for result in broken:
        console.print(f"[bold red]{result.check.name}[/] is not counted: the reference itself does not pass it")
        console.print(result.message, markup=False, highlight=False)
    survivors = sum(not entry["caught_by"] for entry in report.values())
    console.print(
        f"{len(MUTANTS)} mutants, {survivors} survived; {len(checks)} checks, {len(broken)} more that the reference does not pass"
    )
    if options.json:
        write(options.json, {"versions": versions(), "mutants": report})
    return 1 if survivors or broken else 0
