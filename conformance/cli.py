"""The command `conformance`."""

import argparse
import importlib
import importlib.metadata
import json
import sys
import textwrap
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from conformance.adapter import COLUMNS, load_adapter
from conformance.check import DTYPES
from conformance.coverage import coverage
from conformance.execute import Result, rows, run_check, selected_checks
from conformance.mutants import MUTANTS, caught_by, sound
from conformance.requirements import requirements
from spec import profiles

STYLE = {"pass": "green", "fail": "bold red", "error": "bold red", "not offered": "yellow"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns 0 when everything that was asked holds, 1 when it does not, 2 for a wrong command line."""
    parser = argparse.ArgumentParser(prog="conformance", description="Checks an implementation of DreamerV3 against the specification.")
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="run the checks on a backend", formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    candidate = run.add_mutually_exclusive_group(required=True)
    candidate.add_argument("--backend", choices=COLUMNS, help="which of our own columns to check")
    candidate.add_argument(
        "--adapter", metavar="MODULE", help="importable module of your own that offers functions of conformance/adapter.py"
    )
    run.add_argument("--dtype", choices=DTYPES, default="float64", help="precision of the backend")
    run.add_argument("--device", default=None, help="device of the backend, as the backend names it: cpu, cuda, gpu, ...")
    run.add_argument("--profile", choices=tuple(profiles()), default="paper", help="profile of the configurations")
    run.add_argument("--only", default="", help="only checks whose name or requirement id contains this")
    run.add_argument("--seed", type=int, default=0, help="seed of the drawn cases")
    run.add_argument("--examples", type=int, default=25, help="cases that hypothesis draws for each property")
    run.add_argument("--json", type=Path, default=None, metavar="FILE", help="write the results to this file, too")
    commands.add_parser("coverage", help="list every requirement and what covers it; fails if one is not covered")
    mutants = commands.add_parser(
        "mutants", help="plant realistic mistakes in the reference one by one, and list the checks that catch each"
    )
    mutants.add_argument("--json", type=Path, default=None, metavar="FILE", help="write the results to this file, too")
    options = parser.parse_args(arguments)
    console = Console(width=None if sys.stdout.isatty() else 150)
    return {"run": _run, "coverage": _coverage, "mutants": _mutants}[options.command](console, options)


def _run(console: Console, options: argparse.Namespace) -> int:
    try:
        adapter = _load(options)
    except ImportError as error:
        hint = f"install it with: pip install 'dreamer-spec[{options.backend}]'" if options.backend else "is it on PYTHONPATH?"
        print(f"conformance: error: {error}; {hint}", file=sys.stderr)
        return 2
    except (ValueError, RuntimeError) as error:
        if options.adapter:
            raise  # a mistake in somebody's own module: its place is in the traceback
        print(f"conformance: error: {str(error).partition(chr(10))[0]}", file=sys.stderr)
        return 2
    checks = selected_checks(options.dtype, options.only)
    if not checks:
        print(f"conformance: error: no check matches --only {options.only!r}", file=sys.stderr)
        return 2
    results: list[Result] = []
    with console.status("checking") as status:
        for number, check in enumerate(checks, 1):
            status.update(f"{number}/{len(checks)} {check.name}")
            results.append(run_check(check, adapter, options.dtype, options.profile, options.seed, options.examples))
    _print_run(console, results, options)
    if options.json:
        _write(options.json, run_report(results, options))
    return 0 if all(result.status in ("pass", "not offered") for result in results) and any(r.status == "pass" for r in results) else 1


def _load(options: argparse.Namespace) -> object:
    if options.backend:
        return load_adapter(options.backend, options.dtype, options.device)
    sys.path.insert(0, "")
    return importlib.import_module(options.adapter)


def _print_run(console: Console, results: list[Result], options: argparse.Namespace) -> None:
    table = Table(
        title=f"{options.backend or options.adapter}, {options.dtype}, profile {options.profile}, seed {options.seed}", title_justify="left"
    )
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
    settings = {name: getattr(options, name) for name in ("backend", "adapter", "dtype", "device", "profile", "only", "seed", "examples")}
    checks = {result.check.name: {"status": result.status, "compared": result.compared, "message": result.message} for result in results}
    found = {
        row.requirement: {
            "status": row.status,
            "checks": [result.check.name for result in row.results],
            "deviation": _finite(row.worst.deviation),
            "share": _finite(row.worst.share),
            "where": row.worst.where,
        }
        for row in rows(results)
    }
    return {**settings, "versions": _versions(), "checks": checks, "requirements": found}


def _finite(number: float) -> float | None:
    return float(f"{number:.3g}") if abs(number) < 1e300 else None


def _versions() -> dict[str, str]:
    installed = {distribution.name: distribution.version for distribution in importlib.metadata.distributions()}
    return {name: installed[name] for name in ("dreamer-spec", "numpy", "jax", "torch") if name in installed}


def _write(path: Path, report: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


def _coverage(console: Console, options: argparse.Namespace) -> int:
    del options
    table, problems = coverage()
    view = Table()
    columns = (*COLUMNS, "tests")
    for column in ("requirement", *columns, "text"):
        view.add_column(column, min_width=len(column))
    for requirement, covering in table.items():
        counts = (str(len(covering[column])) if column in covering else "-" for column in columns)
        text = textwrap.shorten(requirements()[requirement], 80, placeholder=" ...")
        view.add_row(requirement, *counts, text.replace("[", r"\["))
    console.print(view)
    for problem in problems:
        console.print(f"[bold red]{problem}")
    there = {column for covering in table.values() for column in covering}
    if absent := [column for column in COLUMNS if column not in there]:
        console.print(f"not installed, so not looked at: {', '.join(absent)}")
    if "tests" not in there:
        unchecked = sum(not any(covering.values()) for covering in table.values())
        console.print(f"no tests here (an installed package has none): {unchecked} requirements that no check covers are left to them")
    console.print(f"{len(table)} requirements, {len(problems)} problems")
    return 1 if problems or not table else 0


def _mutants(console: Console, options: argparse.Namespace) -> int:
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
        _write(options.json, {"versions": _versions(), "mutants": report})
    return 1 if survivors or broken else 0


if __name__ == "__main__":
    sys.exit(main())
