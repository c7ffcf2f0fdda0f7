"""The result of one run or of several as one HTML page that needs nothing else. Whatever comes from a result is
escaped."""

import re
from collections.abc import Sequence
from html import escape

from conformance.reports import summary, tex
from conformance.reports.style import STYLE
from conformance.reports.summary import Data

POLICY = "default-src 'none'; style-src 'unsafe-inline'"
KIND = {
    **{
        "pass": "pass",
        "fail": "fail",
        "error": "fail",
        summary.EXTREME: "known",
        "expected failure": "known",
        "partly offered": "pass",
    },
    **{"not offered": "none", "not in edition": "none"},
}
SHORT = {summary.EXTREME: "at extremes", "expected failure": "as expected", "partly offered": "partly"}
CELL_ORDER = ("fail", summary.EXTREME, "expected failure", "pass", "partly offered", "not offered", "not in edition")
EXTREMES = (
    '<p class="small muted">NaN, infinities, huge or tiny numbers, or what must be refused. With '
    "ordinary input these checks pass.</p>"
)
OPEN = 3  # so many failures of a result are open from the start


def render(results: Sequence[Data], origins: Sequence[str] = ()) -> str:
    """The page: verdicts, the matrix of requirements and implementations, the mistakes recognized, and every failure in
    full.

    origins: where each result is from, for names; its candidate, unless given.
    """
    title = "DreamerV3 conformance"
    names = summary.names(results, origins or [data["candidate"] for data in results])
    named = list(zip(results, names if len(results) > 1 else [""], strict=True))
    head = [
        '<meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{title}: {escape(', '.join(names))}</title>",
        f"<style>{STYLE}</style>",
    ]
    body = [
        f"<h1>{title}</h1>",
        (
            '<p class="muted">What an implementation computes, held against the '
            "specification requirement by requirement.</p>"
        ),
        f'<div class="cards">{"".join(map(_card, results, names))}</div>',
        *(_diagnoses(data, name) for data, name in named),
        "<h2>Chapters</h2>",
        (
            '<p class="small muted">Requirements, by what was found. The bar is the worst '
            "deviation as a share of the allowed one.</p>"
        ),
        _overview(results, names),
        *(_failures(data, position, name) for position, (data, name) in enumerate(named)),
        *(_expected(data, position, name) for position, (data, name) in enumerate(named)),
        "<h2>Requirements</h2>",
        f'<p class="small muted">{summary.SCALE} Such a failure stands without a number. An empty cell: not run.</p>',
        _matrix(results, names),
    ]
    return (
        "\n".join(
            [
                "<!doctype html>",
                '<html lang="en-GB"><head>',
                *head,
                "</head><body>",
                *filter(None, body),
                "</body></html>",
            ]
        )
        + "\n"
    )


def chapter_link(path: str) -> str:
    """To the chapter on the web if the repository is there, else its path."""
    address, title = summary.address(path), escape(summary.title(path))
    return f'<a href="{escape(address)}">{title}</a>' if address else f"{title} <code>{escape(path)}</code>"


def prose(text: str) -> str:
    """A line of Markdown: code, bold and italics, links as their words, and formulas as plain text."""
    parts = re.split(r"`([^`]+)`", escape(tex.plain(text)))
    return "".join(f"<code>{part}</code>" if index % 2 else _emphasized(part) for index, part in enumerate(parts))


def _emphasized(text: str) -> str:
    text = re.sub(r"\[([^\]]+)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"\*\*([^*]+)\*\*", r"<b>\1</b>", text)
    return re.sub(r"(?<!\w)\*([^*\s](?:[^*]*[^*\s])?)\*(?!\w)", r"<i>\1</i>", text)


def _card(data: Data, name: str) -> str:
    passed, counts = data["verdict"]["passed"], summary.counts(data)
    others = [
        f"{counts[name]} {name}" for name in ("expected failure", "not offered", "not in edition") if counts[name]
    ]
    problems = "".join(f"<li>{escape(problem)}</li>" for problem in summary.problems(data))
    versions = ", ".join(f"{name} {version}" for name, version in data["versions"].items())
    lines = [
        f'<p>{escape(name)} <span class="muted">{escape(data["dtype"])}, {escape(data["edition"])}</span></p>'
        if name == summary.label(data)
        else f"<p>{escape(name)}</p>",
        f"<b>{counts['pass']} <small>of {summary.judged(data)} offered checks pass</small></b>",
        f'<p class="{"good" if passed else "bad"}">{summary.outcome(data)}</p>',
        f'<ul class="small">{problems}</ul>' if problems else "",
        f'<p class="small">{escape(", ".join(others))}</p>',
        *(f'<p class="small">{escape(line)}</p>' for line in (*summary.edition(data), *summary.unchecked(data))),
        f'<p class="small muted">{escape(summary.settings(data))}; {escape(data["date"])}</p>',
        f'<p class="small muted">{escape(versions)}</p>',
    ]
    return f'<div class="card {"good" if passed else "bad"}">{"".join(lines)}</div>'


def _heads(names: Sequence[str]) -> str:
    return "".join(f"<th class=cell>{escape(name)}</th>" for name in names)


def _by_path(results: Sequence[Data]) -> tuple[list[str], list[dict[str, summary.Chapter]]]:
    """The chapters of all results in the order of the book, and those of each."""
    found = [{chapter.path: chapter for chapter in summary.chapters(data)} for data in results]
    return sorted({path for chapters in found for path in chapters}), found


def _overview(results: Sequence[Data], names: Sequence[str]) -> str:
    """A line for each chapter."""
    paths, found = _by_path(results)
    rows = (
        f'<tr><th><a href="#{_chapter_identifier(path)}">{escape(summary.title(path))}</a></th>'
        f"{''.join(_chapter_cell(chapters.get(path)) for chapters in found)}</tr>"
        for path in paths
    )
    head = f"<thead><tr><th></th>{_heads(names)}</tr></thead>"
    return f'<div class="scroll"><table class="matrix overview">{head}<tbody>{"".join(rows)}</tbody></table></div>'


def _matrix(results: Sequence[Data], names: Sequence[str]) -> str:
    """The requirements of each chapter; chapters with a failure are open, and what nobody offers is folded away."""
    paths, found = _by_path(results)
    parts = []
    for path in paths:
        here = [chapters[path] for chapters in found if path in chapters]
        all_here = list(dict.fromkeys(name for chapter in here for name in chapter.requirements))
        offered = [name for name in all_here if any(_status(data, name) not in ("", "not offered") for data in results)]
        absent = [name for name in all_here if name not in offered]
        opened = " open" if any(chapter.counts["fail"] + chapter.counts["error"] for chapter in here) else ""
        heading = f"{escape(summary.title(path))}, {len(all_here)} requirements"
        tables = [_requirements(results, names, offered)] if offered else []
        if absent:
            tables.append(
                f"<details><summary>{len(absent)} not "
                f"offered</summary>{_requirements(results, names, absent)}</details>"
            )
        parts.append(
            f'<details class="box" id="{_chapter_identifier(path)}"{opened}><summary>{heading}</summary>'
            f"<p>{chapter_link(path)}</p>{''.join(tables)}</details>"
        )
    return "".join(parts)


def _chapter_identifier(path: str) -> str:
    return "chapter-" + re.sub(r"[^A-Za-z0-9]", "-", path)


def _chapter_cell(chapter: summary.Chapter | None) -> str:
    if chapter is None:
        return _cell("none", "")
    counts = {**chapter.counts, "fail": chapter.counts["fail"] + chapter.counts["error"], "error": 0}
    words = ", ".join(f"{counts[name]} {SHORT.get(name, name)}" for name in CELL_ORDER if counts.get(name))
    kinds = {KIND[name] for name in summary.STATUSES if counts.get(name)}
    kind = next(kind for kind in ("fail", "known", "pass", "none") if kind in kinds)
    return _cell(kind, words, chapter.share if kind == "pass" else None)


def _status(data: Data, requirement: str) -> str:
    """One of STATUSES; "" where the result does not have the requirement."""
    return summary.status(data, requirement) if requirement in data["requirements"] else ""


def _requirements(results: Sequence[Data], names: Sequence[str], requirements: Sequence[str]) -> str:
    texts = {
        name: data["requirements"][name]["text"]
        for data in results
        for name in requirements
        if name in data["requirements"]
    }
    rows = (
        f"<tr><th>{escape(name)}</th>"
        f"{''.join(_requirement_cell(data, position, name) for position, data in enumerate(results))}"
        f'<td class="text"><div>{prose(texts[name])}</div></td></tr>'
        for name in requirements
    )
    head = f"<thead><tr><th></th>{_heads(names)}<th class=text></th></tr></thead>"
    return f'<div class="scroll"><table class="matrix">{head}<tbody>{"".join(rows)}</tbody></table></div>'


def _requirement_cell(data: Data, position: int, name: str) -> str:
    if name not in data["requirements"]:
        return _cell("none", "")
    entry, status = data["requirements"][name], summary.status(data, name)
    checks = {check: data["checks"][check]["status"] for check in entry["checks"] if check in data["checks"]}
    if status == "pass":
        return _cell("pass", summary.percent(entry["share"]), entry["share"])
    if status == "partly offered":
        return _cell("pass", f"{list(checks.values()).count('pass')} of {len(checks)} checks")
    failing = [check for check in checks if summary.told(data["checks"][check]) == status]
    if status not in (*summary.FAILING, summary.EXTREME, "expected failure"):
        return _cell("none", status)
    size = f" {summary.percent(entry['share'])}" if entry["share"] is not None else ""
    return _cell(KIND[status], f'<a href="#{_identifier(position, failing[0])}">{status}</a>{size}')


def _cell(kind: str, markup: str, share: float | None = None) -> str:
    bar = (
        "" if share is None else f'<span class="bar"><span style="width: {min(100.0, 100 * share):.0f}%"></span></span>'
    )
    return f'<td class="cell {kind}">{markup}{bar}</td>'


def _identifier(position: int, check: str) -> str:
    return f"failure-{position}-{escape(re.sub(r'[^A-Za-z0-9_.-]', '-', check))}"


def _heading(words: str, name: str) -> str:
    """name: of the implementation, "" on a page of one."""
    return f"<h2>{words}{f': {escape(name)}' if name else ''}</h2>"


def _diagnoses(data: Data, name: str) -> str:
    if not data["diagnoses"]:
        return ""
    return _heading("Mistakes recognized", name) + "".join(map(_diagnosis, data["diagnoses"]))


def _diagnosis(found: Data) -> str:
    lines = [
        f"<p>Behaves like <b>{escape(found['mutant'])}</b>: {escape(found['explanation'])}</p>",
        f'<p class="small muted">Known from: {escape(found["provenance"])}</p>' if found["provenance"] else "",
        (
            f"<p>{escape(found['fix'])} See {chapter_link(found['chapter'])}, "
            f"{escape(', '.join(found['requirements']))}.</p>"
        ),
        f'<p class="small muted">Explains {escape(", ".join(found["explained"]))}</p>',
        f'<p class="small muted">Cannot be told from {escape(", ".join(found["alternatives"]))}</p>'
        if found["alternatives"]
        else "",
    ]
    return f'<div class="diagnosis">{"".join(lines)}</div>'


def _expected(data: Data, position: int, name: str) -> str:
    if not data["expected_failures"]:
        return ""
    rows = "".join(
        f"<tr><td>{escape(entry['name'])}</td><td>{escape(entry['outcome'])}</td><td>{escape(entry['reason'])}</td></tr>"
        for entry in data["expected_failures"]
    )
    head = "<thead><tr><th>name</th><th>outcome</th><th>reason</th></tr></thead>"
    table = f'<div class="scroll"><table>{head}<tbody>{rows}</tbody></table></div>'
    return _heading("Expected failures", name) + table + _boxes(data, position, summary.failures(data).expected, 0)


def _failures(data: Data, position: int, name: str) -> str:
    """The ordinary ones, of which the first are open, and then those with extreme input only."""
    found = summary.failures(data)
    ordinary = _heading("Failures", name) + _boxes(data, position, found.ordinary, OPEN) if found.ordinary else ""
    extreme = (
        _heading("Only with extreme input", name) + EXTREMES + _boxes(data, position, found.extreme, 0)
        if found.extreme
        else ""
    )
    return ordinary + extreme


def _boxes(data: Data, position: int, failing: Sequence[tuple[str, Data]], opened: int) -> str:
    return "".join(
        _failure(data, position, name, check, number < opened) for number, (name, check) in enumerate(failing)
    )


def _failure(data: Data, position: int, name: str, check: Data, is_open: bool) -> str:
    failure, is_expected = check["failure"], summary.is_expected(check)
    chapter = {data["requirements"][name]["chapter"] for name in check["requirements"] if name in data["requirements"]}
    diagnoses = summary.matching(data, name)
    links = ", ".join(map(chapter_link, sorted(chapter)))
    message, cause = check["message"].rstrip(), summary.cause(check["message"])
    parts = [
        f"<p>{prose(check['summary'])}</p>",
        f'<p class="small muted">{escape(", ".join(check["requirements"]))}: {links}</p>',
        f'<p class="known">Expected to fail: {escape(check["expected_failure"])}</p>' if is_expected else "",
        f"<pre>{escape(cause)}</pre>",
        f"<p>Behaves like <b>{escape(', '.join(found['mutant'] for found in diagnoses))}</b>, see above.</p>"
        if diagnoses
        else "",
        f"<h3>The call of {escape(failure['function'])}</h3>{_values(failure)}" if failure["function"] else "",
        f"<h3>See it again</h3><pre>{escape(failure['command'])}</pre><pre>{escape(failure['snippet'])}</pre>",
        f"<details><summary>Traceback</summary><pre>{escape(message)}</pre></details>" if cause != message else "",
    ]
    kind, opened = KIND[summary.told(check)].replace("fail", "bad"), (" open" if is_open else "")
    summary_line = f"{escape(name)} <span class=muted>{escape(check['status'])}</span>"
    heading = (
        f'<details class="box {kind}" id="{_identifier(position, name)}"{opened}><summary>{summary_line}</summary>'
    )
    return f"{heading}{''.join(parts)}</details>"


def _values(failure: Data) -> str:
    rows = "".join(
        f"<tr><td><code>{escape(value['name'])}</code></td><td>{escape(value['type'])}</td><td><pre>{escape(value['text'])}</pre></td></tr>"
        for value in summary.values(failure)
    )
    return f'<table class="values"><tbody>{rows}</tbody></table>'
