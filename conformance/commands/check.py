"""Run the checks on an implementation."""

import argparse
from collections import Counter
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from conformance.candidate import load_candidate
from conformance.check import DTYPES
from conformance.diagnosis import describe, diagnose
from conformance.errors import UserError
from conformance.execute import Result, rows, run_check, selected_checks
from conformance.results import finite, versions, write
from spec import profiles

STYLE = {"pass": "green", "fail": "bold red", "error": "bold red", "not offered": "yellow"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "candidate", help="jax, torch or numpy; or an adapter of your own with functions of conformance/adapter.py: a module or a .py file"
    )
    parser.add_argument("--dtype", choices=DTYPES, default="float64", help="precision of the backend")
    parser.add_argument("--device", default=None, help="device of the backend, as the backend names it: cpu, cuda, gpu, ...")
    parser.add_argument("--profile", choices=tuple(profiles()), default="paper", help="profile of the configurations")
    parser.add_argument("--only", default="", help="only checks whose name or requirement id contains this")
    parser.add_argument("--seed", type=int, default=0, help="seed of the drawn cases")
    parser.add_argument("--examples", type=int, default=25, help="cases that hypothesis draws for each property")
    parser.add_argument("--json", type=Path, default=None, metavar="FILE", help="write the results to this file, too")


def main(console: Console, options: argparse.Namespace) -> int:
    adapter = load_candidate(options.candidate, options.dtype, options.device)
    checks = selected_checks(options.dtype, options.only)
    if not checks:
        raise UserError(f"no check matches --only {options.only!r}")
    results: list[Result] = []
    with console.status("checking") as status:
        for number, check in enumerate(checks, 1):
            status.update(f"{number}/{len(checks)} {check.name}")
            results.append(run_check(check, adapter, options.dtype, options.profile, options.seed, options.examples))
        status.update("comparing with known mistakes")
        diagnoses = diagnose(adapter, results, options.dtype, options.profile, options.seed, options.examples)
    _print_results(console, results, options)
    for diagnosis in diagnoses:
        console.print(describe(diagnosis), markup=False, highlight=False)
    if options.json:
        write(options.json, run_report(results, options))
    return 0 if all(result.status in ("pass", "not offered") for result in results) and any(r.status == "pass" for r in results) else 1


def _print_results(console: Console, results: list[Result], options: argparse.Namespace) -> None:
    table = Table(title=f"{options.candidate}, {options.dtype}, profile {options.profile}, seed {options.seed}", title_justify="left")
    for column in ("requirement", "checks", "worst deviation", "of allowed", "where", "result"):
        table.add_column(column, overflow="fold")
    for row in rows(results):
        worst = row.worst
        table.add_row(
            row.requirement,
            str(len(row.results)),
            f"{worst.deviation:.1e}",
            f"{worst.share:.0%}" if worst.share < 1e6 else "-",
            worst.where,
            f"[{STYLE[row.status]}]{row.status}",
        )
    console.print(table)
    for result in results:
        if result.status in ("fail", "error"):
            console.print(f"[bold red]{result.check.name}[/] ({', '.join(result.check.requirements)}): {result.check.summary}")
            console.print(result.message, markup=False, highlight=False)
    counts = Counter(result.status for result in results)
    numbers = sum(result.compared for result in results)
    console.print(f"{len(results)} checks, {numbers:,} numbers compared: " + ", ".join(f"{counts[name]} {name}" for name in STYLE))


def run_report(results: list[Result], options: argparse.Namespace) -> dict[str, Any]:
    """A run in plain JSON types: what was run, and what was found for each check and for each requirement.

    `share` is the worst deviation as a share of the allowed one; it is null where what failed has no size.
    """
    settings = {name: getattr(options, name) for name in ("candidate", "dtype", "device", "profile", "only", "seed", "examples")}
    checks = {result.check.name: {"status": result.status, "compared": result.compared, "message": result.message} for result in results}
    found = {
        row.requirement: {
            "status": row.status,
            "checks": [result.check.name for result in row.results],
            "deviation": finite(row.worst.deviation),
            "share": finite(row.worst.share),
            "where": row.worst.where,
        }
        for row in rows(results)
    }
    return {**settings, "versions": versions(), "checks": checks, "requirements": found}
