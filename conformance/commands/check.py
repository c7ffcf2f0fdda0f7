"""Run the checks on an implementation."""

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path

from rich.console import Console

from conformance.candidate import candidate, remarks
from conformance.check import Check
from conformance.compare import DTYPES
from conformance.diagnosis import diagnose
from conformance.editions import Fit, best, by_comparison, fit, judge_twice, may_fit_better, telling_checks, to_json
from conformance.errors import UserError
from conformance.execute import FAILING, CheckOptions, Result, calls_of, selected_checks
from conformance.expected import ExpectedFailures, read_expected
from conformance.our_candidates import OUR_CANDIDATES
from conformance.progress import Progress
from conformance.reports import badge, html, junit, markdown, terminal
from conformance.results import Data, identity, result_data, write, write_text
from spec import editions, find_edition

# of our own implementations, unless another is given: they follow the configuration, so there is nothing to find out
OUR_EDITION = "paper"
RENDERED: dict[str, Callable[[Data], str]] = {
    "markdown": markdown.render,
    "junit": junit.render,
    "html": lambda data: html.render([data]),
    "badge": badge.render,
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "candidate",
        nargs="?",
        help=(
            "jax, torch, numpy or trainer; or an adapter of your own with functions of "
            "conformance/adapter.py: a module or a .py file"
        ),
    )
    parser.add_argument(
        "--process", metavar="COMMAND", help="a command that starts a candidate of its own, see docs/adapters.md"
    )
    parser.add_argument("--timeout", type=float, default=120.0, help="seconds that a process has for each reply")
    parser.add_argument(
        "--dtype", choices=DTYPES, default="float64", help="precision of the backend; the trainer has float64 alone"
    )
    parser.add_argument(
        "--device", default=None, help="device of the backend, as the backend names it: cpu, cuda, gpu, ..."
    )
    parser.add_argument(
        "--edition",
        choices=tuple(editions()),
        help="judge in this edition (default: the one that is claimed, or else the one that fits best)",
    )
    parser.add_argument("--only", default="", help="only checks whose name or requirement id contains this")
    parser.add_argument("--seed", type=int, default=0, help="seed of the drawn cases")
    parser.add_argument("--examples", type=int, default=25, help="cases that hypothesis draws for each property")
    parser.add_argument(
        "--expect", type=Path, metavar="FILE", help="failures that are known, each with a reason: see docs/reports.md"
    )
    parser.add_argument(
        "--no-diagnosis", action="store_true", help="do not look for the known mistakes that failures come from"
    )
    parser.add_argument("--at-least", type=int, default=1, metavar="N", help="fail unless so many checks pass")
    files = parser.add_argument_group("reports, written to files")
    files.add_argument("--json", type=Path, metavar="FILE", help="the whole result, see conformance/report.schema.json")
    files.add_argument("--markdown", type=Path, metavar="FILE", help="the result for people")
    files.add_argument("--junit", type=Path, metavar="FILE", help="JUnit XML for CI")
    files.add_argument(
        "--html",
        type=Path,
        metavar="FILE",
        help="one page with all failing inputs; `conformance report` joins several results",
    )
    files.add_argument("--badge", type=Path, metavar="FILE", help="an SVG for a README")


def main(console: Console, options: argparse.Namespace) -> int:
    checks = selected_checks(options.dtype, options.only)
    if not checks:
        raise UserError(f"no check matches --only {options.only!r}")
    expected = read_expected(options.expect) if options.expect else ExpectedFailures()
    with (
        candidate(options.candidate, options.process, options.dtype, options.device, options.timeout) as adapter,
        Progress() as progress,
    ):
        for remark in remarks(adapter):
            console.print(remark, markup=False, highlight=False)
        implementation = identity(adapter, options.candidate or options.process or "")
        given = options.edition or (OUR_EDITION if options.candidate in OUR_CANDIDATES else None)
        named = given or _claimed(implementation["edition"])
        fits = [] if named else _fit(progress, checks, adapter, options)
        asked = CheckOptions(
            candidate=options.candidate or options.process or "",
            process=options.process is not None,
            edition=named or best(fits).edition,
            **{name: getattr(options, name) for name in ("dtype", "device", "only", "seed", "examples", "at_least")},
        )
        results = list(_run_all(progress, checks, adapter, asked))
        failing = telling_checks(result.check for result in results if result.status in FAILING and not result.extreme)
        if named and may_fit_better(
            progress.over("editions", failing), adapter, editions()[named], asked.dtype, asked.seed
        ):
            fits = _fit(progress, checks, adapter, options)
        diagnoses, is_cut = (None, False) if options.no_diagnosis else _diagnoses(progress, adapter, results, asked)
        choice = "given" if given else "claimed" if named else "best fit"
        data = result_data(
            asked,
            implementation,
            results,
            expected,
            diagnoses,
            choice,
            to_json(fits, asked.edition) if fits else None,
            is_cut,
        )
    terminal.show(console, data)
    if options.json:
        write(options.json, data)
    for name, render in RENDERED.items():
        if path := getattr(options, name):
            write_text(path, render(data))
    return 0 if data["verdict"]["passed"] else 1


def _claimed(name: str | None) -> str | None:
    """The edition that an adapter claims, by its name or that of its profile."""
    try:
        return None if name is None else find_edition(name).name
    except ValueError as error:
        raise UserError(f"the adapter's edition(): {error}") from error


def _fit(progress: Progress, checks: list[Check], adapter: object, options: argparse.Namespace) -> list[Fit]:
    return fit(progress.over("editions", telling_checks(checks)), adapter, options.dtype, options.seed)


def _run_all(progress: Progress, checks: list[Check], adapter: object, asked: CheckOptions) -> Iterable[Result]:
    edition = editions()[asked.edition]
    if compile_calls := getattr(adapter, "compile_calls", None):
        progress.say("compiling")
        compile_calls(calls_of(checks, adapter, asked.setting))
    for check in progress.over("checks", checks):
        yield judge_twice(check, adapter, edition, asked.dtype, asked.seed, asked.examples)


def _diagnoses(
    progress: Progress, adapter: object, results: list[Result], asked: CheckOptions
) -> tuple[list[Data], bool]:
    """The mistakes that explain failures, and whether there was more to compare. What the edition has otherwise is
    none."""
    progress.say("diagnosis")
    edition = editions()[asked.edition]
    results = [
        result for result in results if result.status not in FAILING or not by_comparison(result, edition, asked)
    ]
    found = diagnose(adapter, results, asked.setting, progress.over)
    others = [diagnosis for diagnosis in found.diagnoses if diagnosis.mutant.name not in edition.mutants]
    return [diagnosis.to_json() for diagnosis in others], found.is_cut
