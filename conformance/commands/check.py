"""Run the checks on an implementation."""

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path

from rich.console import Console

from conformance.candidate import candidate, remarks
from conformance.check import DTYPES, Check
from conformance.diagnosis import diagnose
from conformance.errors import UserError
from conformance.execute import Result, Settings, run_check, selected_checks
from conformance.expected import ExpectedFailures, read_expected
from conformance.reports import badge, html, junit, markdown, terminal
from conformance.results import Data, identity, result_data, write, write_text
from spec import profiles

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
        help="jax, torch or numpy; or an adapter of your own with functions of conformance/adapter.py: a module or a .py file",
    )
    parser.add_argument("--process", metavar="COMMAND", help="a command that starts a candidate of its own, see docs/adapters.md")
    parser.add_argument("--timeout", type=float, default=120.0, help="seconds that a process has for each reply")
    parser.add_argument("--dtype", choices=DTYPES, default="float64", help="precision of the backend")
    parser.add_argument("--device", default=None, help="device of the backend, as the backend names it: cpu, cuda, gpu, ...")
    parser.add_argument("--profile", choices=tuple(profiles()), default="paper", help="profile of the configurations")
    parser.add_argument("--only", default="", help="only checks whose name or requirement id contains this")
    parser.add_argument("--seed", type=int, default=0, help="seed of the drawn cases")
    parser.add_argument("--examples", type=int, default=25, help="cases that hypothesis draws for each property")
    parser.add_argument("--expect", type=Path, metavar="FILE", help="failures that are known, each with a reason: see docs/reports.md")
    parser.add_argument("--at-least", type=int, default=1, metavar="N", help="fail unless so many checks pass")
    files = parser.add_argument_group("reports, written to files")
    files.add_argument("--json", type=Path, metavar="FILE", help="the whole result, see conformance/report.schema.json")
    files.add_argument("--markdown", type=Path, metavar="FILE", help="the result for people")
    files.add_argument("--junit", type=Path, metavar="FILE", help="JUnit XML for CI")
    files.add_argument(
        "--html", type=Path, metavar="FILE", help="one page with all failing inputs; `conformance report` joins several results"
    )
    files.add_argument("--badge", type=Path, metavar="FILE", help="an SVG for a README")


def main(console: Console, options: argparse.Namespace) -> int:
    checks = selected_checks(options.dtype, options.only)
    if not checks:
        raise UserError(f"no check matches --only {options.only!r}")
    expected = read_expected(options.expect) if options.expect else ExpectedFailures()
    settings = Settings(
        candidate=options.candidate or options.process or "",
        process=options.process is not None,
        **{name: getattr(options, name) for name in ("dtype", "device", "profile", "only", "seed", "examples", "at_least")},
    )
    with candidate(options.candidate, options.process, options.dtype, options.device, options.timeout) as adapter:
        for remark in remarks(adapter):
            console.print(remark, markup=False, highlight=False)
        implementation = identity(adapter, settings)
        results = list(_run_all(console, checks, adapter, settings))
        with console.status("comparing failures with known mistakes"):
            diagnoses = diagnose(adapter, results, settings.dtype, settings.profile, settings.seed, settings.examples)
        data = result_data(settings, implementation, results, expected, [diagnosis.to_json() for diagnosis in diagnoses])
    terminal.show(console, data)
    if options.json:
        write(options.json, data)
    for name, render in RENDERED.items():
        if path := getattr(options, name):
            write_text(path, render(data))
    return 0 if data["verdict"]["passed"] else 1


def _run_all(console: Console, checks: list[Check], adapter: object, settings: Settings) -> Iterable[Result]:
    with console.status("checking") as status:
        for number, check in enumerate(checks, 1):
            status.update(f"{number}/{len(checks)} {check.name}")
            yield run_check(check, adapter, settings.dtype, settings.profile, settings.seed, settings.examples)
