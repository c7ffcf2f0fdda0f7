"""The result in a terminal: a line for each chapter, what failed, and the outcome."""

import re
from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from conformance.reports import summary
from conformance.reports.summary import Data
from conformance.reports.values import brief

STYLE = {
    "pass": "green",
    "fail": "bold red",
    "error": "bold red",
    summary.EXTREME: "yellow",
    "expected failure": "yellow",
}
SHOWN = 5  # failures in full; the others by name
LINES = 10  # of one message: the last of a traceback say what happened


def show(console: Console, data: Data) -> None:
    """Prints it. Control characters of an implementation's messages do nothing."""
    data = printable(data)
    _chapters(console, data)
    for line in summary.notes(data):
        _plain(console, line)
    for diagnosis in summary.diagnoses(data):
        _diagnosis(console, data, diagnosis)
    failures = summary.failures(data)
    _failures(console, data, failures.ordinary, SHOWN)
    if failures.extreme:
        console.print("\n[bold]Only with extreme input[/]", highlight=False)
        _failures(console, data, failures.extreme, max(0, SHOWN - len(failures.ordinary)))
    for entry in data["expected_failures"]:
        outcome = {"fail": "fails as expected", "pass": "passes, and is expected to fail", "not run": "was not run"}[
            entry["outcome"]
        ]
        _plain(console, f"{entry['name']} {outcome}: {entry['reason']}")
    _plain(console, summary.tally(data))
    if not summary.judged(data):
        _plain(console, "nothing was checked: the functions that these checks need are not offered")
    console.print(
        f"[{'bold green' if data['verdict']['passed'] else 'bold red'}]{escape(summary.headline(data))}[/]",
        highlight=False,
    )
    if len(failures.ordinary) + len(failures.extreme) > SHOWN:
        _plain(console, "everything in full: --html FILE")


def _plain(console: Console, text: str) -> None:
    console.print(text, markup=False, highlight=False)


def _chapters(console: Console, data: Data) -> None:
    title = f"{summary.label(data)}: {summary.settings(data)}"
    table = Table(
        title=escape(title), title_justify="left", title_style="", caption=summary.SCALE, caption_justify="left"
    )
    for column in ("chapter", "requirements", "worst, of allowed", "where"):
        table.add_column(column, overflow="fold")
    for chapter in summary.chapters(data):
        if chapter.counts["not offered"] != len(chapter.requirements):
            found = [
                f"[{STYLE.get(name, 'default')}]{chapter.counts[name]} {name}[/]"
                for name in summary.STATUSES
                if chapter.counts[name]
            ]
            table.add_row(chapter.title, ", ".join(found), summary.percent(chapter.share), escape(chapter.where))
    if table.row_count:
        console.print(table)
    else:
        _plain(console, title)


def _diagnosis(console: Console, data: Data, diagnosis: Data) -> None:
    introduction = escape(summary.introduction(diagnosis))
    console.print(f"\n[bold]{introduction}[/]: {escape(diagnosis['explanation'])}", highlight=False)
    if diagnosis["provenance"]:
        _plain(console, f"  known from: {diagnosis['provenance']}")
    _plain(console, f"  see {diagnosis['chapter']}. {diagnosis['fix']}")
    _plain(console, f"  explains {', '.join(diagnosis['explained'])}")
    if objection := summary.objection(data, diagnosis):
        _plain(console, f"  {objection}")
    if diagnosis["alternatives"]:
        _plain(console, f"  cannot be told from {', '.join(diagnosis['alternatives'])}")


def _failures(console: Console, data: Data, failing: Sequence[tuple[str, Data]], shown: int) -> None:
    """Some in full, the others by name."""
    for name, check in failing[:shown]:
        console.print(
            f"\n[bold red]{name}[/] ({', '.join(check['requirements'])}): {escape(check['summary'])}", highlight=False
        )
        for line in [*(f"  {sentence}" for sentence in summary.demands(data, check)), details(check)]:
            _plain(console, line)
        console.print(f"  {check['failure']['command']}", markup=False, highlight=False, soft_wrap=True)
    if len(failing) > shown:
        number = f"and {len(failing) - shown} more" if shown else f"{len(failing)}"
        _plain(console, f"\n{number}: {', '.join(name for name, _ in failing[shown:])}")


def details(check: Data) -> str:
    """What went wrong, and the call in which it did."""
    lines = check["message"].rstrip().splitlines()
    told = ["..."] * (len(lines) > LINES) + lines[-LINES:]
    failure = check["failure"]
    if failure["function"]:
        told += [f"  {failure['function']}, called with", *(f"    {line}" for line in brief(failure["arguments"]))]
    return "\n".join(told)


def printable(value: Any) -> Any:
    """The same in plain JSON types, with nothing that a terminal would obey."""
    if isinstance(value, dict):
        return {printable(key): printable(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return list(map(printable, value))
    return (
        re.sub(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", "\N{REPLACEMENT CHARACTER}", value)
        if isinstance(value, str)
        else value
    )
