"""The result of one run or of several as one HTML page: what stands where is in templates/conformance.html."""

import dataclasses
import re
from collections.abc import Sequence

from conformance import pages
from conformance.reports import summary
from conformance.reports.summary import Data

KIND = {
    **{"pass": "pass", "partly offered": "pass", "fail": "fail", "error": "fail"},
    **{summary.EXTREME: "known", "expected failure": "known", "not offered": "none", "not in edition": "none"},
}
SHORT = {summary.EXTREME: "at extremes", "expected failure": "as expected", "partly offered": "partly"}
CELL_ORDER = ("fail", summary.EXTREME, "expected failure", "pass", "partly offered", "not offered", "not in edition")


@dataclasses.dataclass(frozen=True)
class Cell:
    """Of a matrix. check: that the words tell of, and that failed. share: the length of its bar."""

    kind: str = "none"
    words: str = ""
    size: str = ""
    check: str = ""
    share: float | None = None


@dataclasses.dataclass(frozen=True)
class Row:
    """A requirement, with a cell for each result. checks: those that cover it. is_offered: whether some result has
    found anything."""

    name: str
    text: str
    checks: list[str]
    cells: list[Cell]
    is_offered: bool


@dataclasses.dataclass(frozen=True)
class Chapter:
    """A line of the overview, and its requirements, which are open if one has failed."""

    path: str
    cells: list[Cell]
    is_open: bool
    rows: list[Row]


def render(results: Sequence[Data], origins: Sequence[str] = ()) -> str:
    """The page: verdicts, the matrix of requirements and implementations, the mistakes recognized, and every failure in
    full.

    origins: where each result is from, for names; its candidate, unless given.
    """
    names = summary.names(results, origins or [data["candidate"] for data in results])
    reports = [
        {"name": name, "data": data, "position": index}
        for index, (name, data) in enumerate(zip(names, results, strict=True))
    ]
    values = {"reports": reports, "chapters": _chapters(results), "summary": summary, "anchor": anchor}
    return pages.render(__package__, "conformance.html", **values)


def anchor(name: str) -> str:
    """A name as part of an address within the page."""
    return re.sub(r"[^A-Za-z0-9_.-]", "-", name)


def _chapters(results: Sequence[Data]) -> list[Chapter]:
    """The chapters of all results in the order of the book."""
    found = [{chapter.path: chapter for chapter in summary.chapters(data)} for data in results]
    paths = sorted({path for chapters in found for path in chapters})
    return [_chapter(results, path, [chapters.get(path) for chapters in found]) for path in paths]


def _chapter(results: Sequence[Data], path: str, found: Sequence[summary.Chapter | None]) -> Chapter:
    here = [chapter for chapter in found if chapter]
    rows = [_row(results, name) for name in dict.fromkeys(name for chapter in here for name in chapter.requirements)]
    is_open = any(chapter.counts["fail"] + chapter.counts["error"] for chapter in here)
    return Chapter(path, list(map(_chapter_cell, found)), is_open, rows)


def _row(results: Sequence[Data], name: str) -> Row:
    text = next(data["requirements"][name]["text"] for data in results if name in data["requirements"])
    checks = dict.fromkeys(check for data in results for check in summary.checks_of(data, name))
    cells = [_requirement_cell(data, name) for data in results]
    return Row(name, text, list(checks), cells, any(cell.words not in ("", "not offered") for cell in cells))


def _chapter_cell(chapter: summary.Chapter | None) -> Cell:
    if chapter is None:
        return Cell()
    counts = {**chapter.counts, "fail": chapter.counts["fail"] + chapter.counts["error"], "error": 0}
    words = ", ".join(f"{counts[name]} {SHORT.get(name, name)}" for name in CELL_ORDER if counts.get(name))
    kinds = {KIND[name] for name in summary.STATUSES if counts.get(name)}
    kind = next(kind for kind in ("fail", "known", "pass", "none") if kind in kinds)
    return Cell(kind, words, share=chapter.share if kind == "pass" else None)


def _requirement_cell(data: Data, name: str) -> Cell:
    if name not in data["requirements"]:
        return Cell()
    entry, status = data["requirements"][name], summary.status(data, name)
    checks = {check: data["checks"][check]["status"] for check in entry["checks"] if check in data["checks"]}
    if status == "pass":
        return Cell("pass", summary.percent(entry["share"]), share=entry["share"])
    if status == "partly offered":
        return Cell("pass", f"{list(checks.values()).count('pass')} of {len(checks)} checks")
    if status not in (*summary.FAILING, summary.EXTREME, "expected failure"):
        return Cell("none", status)
    failing = next(check for check in checks if summary.told(data["checks"][check]) == status)
    return Cell(KIND[status], status, "" if entry["share"] is None else summary.percent(entry["share"]), failing)
