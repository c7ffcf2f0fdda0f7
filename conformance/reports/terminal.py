"""The result in a terminal: a line for each chapter, what failed, and the outcome."""

import re
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from conformance.reports import summary
from conformance.reports.summary import Data

STYLE = {"pass": "green", "fail": "bold red", "error": "bold red", "expected failure": "yellow"}
SHOWN = 5  # failures in full; the others by name
LINES = 10  # of one message: the last of a traceback say what happened


def show(console: Console, data: Data) -> None:
    """Prints it. Control characters of an implementation's messages do nothing."""
    data = _printable(data)
    title = f"{summary.label(data)}: {summary.settings(data)}"
    table = Table(title=escape(title), title_justify="left", title_style="")
    for column in ("chapter", "requirements", "worst, of allowed", "where"):
        table.add_column(column, overflow="fold")
    for chapter in summary.chapters(data):
        if chapter.counts["not offered"] != len(chapter.requirements):
            found = [f"[{STYLE.get(name, 'default')}]{chapter.counts[name]} {name}[/]" for name in summary.STATUSES if chapter.counts[name]]
            table.add_row(chapter.title, ", ".join(found), summary.percent(chapter.share), escape(chapter.where))
    if table.row_count:
        console.print(table)
    else:
        console.print(title, markup=False, highlight=False)
    for line in summary.edition(data):
        console.print(line, markup=False, highlight=False)
    for diagnosis in data["diagnoses"]:
        console.print(f"\n[bold]behaves like {escape(diagnosis['mutant'])}[/]: {escape(diagnosis['explanation'])}", highlight=False)
        console.print(f"  see {diagnosis['chapter']}. {diagnosis['fix']}", markup=False, highlight=False)
        console.print(f"  explains {', '.join(diagnosis['explained'])}", markup=False, highlight=False)
        if diagnosis["alternatives"]:
            console.print(f"  cannot be told from {', '.join(diagnosis['alternatives'])}", markup=False, highlight=False)
    failing = [(name, check) for name, check in summary.failures(data) if not summary.is_expected(check)]
    for name, check in failing[:SHOWN]:
        console.print(f"\n[bold red]{name}[/] ({', '.join(check['requirements'])}): {escape(check['summary'])}", highlight=False)
        lines = check["message"].rstrip().splitlines()
        console.print("\n".join(["..."] * (len(lines) > LINES) + lines[-LINES:]), markup=False, highlight=False)
        console.print(f"  {check['failure']['command']}", markup=False, highlight=False, soft_wrap=True)
    if len(failing) > SHOWN:
        console.print(f"\nand {len(failing) - SHOWN} more: {', '.join(name for name, _ in failing[SHOWN:])}", markup=False, highlight=False)
    for entry in data["expected_failures"]:
        outcome = {"fail": "fails as expected", "pass": "passes, and is expected to fail", "not run": "was not run"}[entry["outcome"]]
        console.print(f"{entry['name']} {outcome}: {entry['reason']}", markup=False, highlight=False)
    console.print(summary.tally(data), markup=False, highlight=False)
    if not summary.judged(data):
        console.print("nothing was checked: the functions that these checks need are not offered", markup=False, highlight=False)
    console.print(f"[{'bold green' if data['verdict']['passed'] else 'bold red'}]{escape(summary.headline(data))}[/]", highlight=False)


def _printable(value: Any) -> Any:
    if isinstance(value, dict):
        return {_printable(key): _printable(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return list(map(_printable, value))
    return re.sub(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", "\N{REPLACEMENT CHARACTER}", value) if isinstance(value, str) else value
