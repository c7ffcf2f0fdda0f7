"""The result of one run or of several as one HTML page that needs nothing else. Whatever comes from a result is escaped."""

import re
from collections import Counter
from collections.abc import Sequence
from html import escape

from conformance.reports import summary
from conformance.reports.style import STYLE
from conformance.reports.summary import Data

POLICY = "default-src 'none'; style-src 'unsafe-inline'"
KIND = {
    **{"pass": "pass", "fail": "fail", "error": "fail", "expected failure": "known", "partly offered": "pass"},
    **{"not offered": "none", "not in edition": "none"},
}
OPEN = 3  # so many failures of a result are open from the start


def render(results: Sequence[Data]) -> str:
    """The page: verdicts, the matrix of requirements and implementations, the mistakes recognized, and every failure in full."""
    title = "DreamerV3 conformance"
    head = [
        '<meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{title}: {escape(', '.join(summary.label(data) for data in results))}</title>",
        f"<style>{STYLE}</style>",
    ]
    body = [
        f"<h1>{title}</h1>",
        '<p class="muted">What an implementation computes, held against the specification requirement by requirement.</p>',
        f'<div class="cards">{"".join(map(_card, results))}</div>',
        *(_diagnoses(data, len(results) > 1) for data in results),
        "<h2>Chapters</h2>",
        '<p class="small muted">The bar is the worst deviation as a share of what is allowed.</p>',
        _overview(results),
        *(_expected(data, len(results) > 1) for data in results),
        *(_failures(data, position, len(results) > 1) for position, data in enumerate(results)),
        "<h2>Requirements</h2>",
        '<p class="small muted">A percentage is the worst deviation as a share of what is allowed: 100% is the limit. Empty: not run.</p>',
        _matrix(results),
    ]
    return "\n".join(["<!doctype html>", '<html lang="en-GB"><head>', *head, "</head><body>", *filter(None, body), "</body></html>"]) + "\n"


def chapter_link(path: str) -> str:
    """To the chapter on the web if the repository is there, else its path."""
    address, title = summary.address(path), escape(summary.title(path))
    return f'<a href="{escape(address)}">{title}</a>' if address else f"{title} <code>{escape(path)}</code>"


def prose(text: str) -> str:
    """A line of Markdown: code and bold, and links as their words."""
    text = re.sub(r"\[([^\]]+)\]\([^)]*\)", r"\1", escape(text))
    text = re.sub(r"\*\*([^*]+)\*\*", r"<b>\1</b>", text)
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", text)


def _card(data: Data) -> str:
    passed, counts = data["verdict"]["passed"], summary.counts(data)
    failing = counts["fail"] + counts["error"]
    others = [f"{failing} fail"] if failing else []
    others += [f"{counts[name]} {name}" for name in ("expected failure", "not offered", "not in edition") if counts[name]]
    problems = "".join(f"<li>{escape(problem)}</li>" for problem in data["verdict"]["problems"])
    versions = ", ".join(f"{name} {version}" for name, version in data["versions"].items())
    lines = [
        f'<p>{escape(summary.label(data))} <span class="muted">{escape(data["dtype"])}, {escape(data["edition"])}</span></p>',
        f"<b>{counts['pass']} <small>of {summary.judged(data)} offered checks pass</small></b>",
        f'<p class="{"good" if passed else "bad"}">{"Conforms in what it offers" if passed else "Does not conform"}</p>',
        f'<ul class="small">{problems}</ul>' if problems else "",
        f'<p class="small">{escape(", ".join(others))}</p>',
        *(f'<p class="small">{escape(line)}</p>' for line in summary.edition(data)),
        f'<p class="small muted">{escape(summary.settings(data))}; {escape(data["date"])}</p>',
        f'<p class="small muted">{escape(versions)}</p>',
    ]
    return f'<div class="card {"good" if passed else "bad"}">{"".join(lines)}</div>'


def _heads(results: Sequence[Data]) -> str:
    """Names of the columns, with what tells two runs of the same implementation apart."""
    labels = [summary.label(data) for data in results]
    twice = Counter(labels)
    heads = (
        f"{label} {data['dtype']}, {data['edition']}" if twice[label] > 1 else label for label, data in zip(labels, results, strict=True)
    )
    return "".join(f"<th class=cell>{escape(head)}</th>" for head in heads)


def _by_path(results: Sequence[Data]) -> tuple[list[str], list[dict[str, summary.Chapter]]]:
    """The chapters of all results in the order of the book, and those of each."""
    found = [{chapter.path: chapter for chapter in summary.chapters(data)} for data in results]
    return sorted({path for chapters in found for path in chapters}), found


def _overview(results: Sequence[Data]) -> str:
    """A line for each chapter."""
    paths, found = _by_path(results)
    rows = (
        f'<tr><th><a href="#{_chapter_identifier(path)}">{escape(summary.title(path))}</a></th>'
        f"{''.join(_chapter_cell(chapters.get(path)) for chapters in found)}</tr>"
        for path in paths
    )
    head = f"<thead><tr><th></th>{_heads(results)}</tr></thead>"
    return f'<div class="scroll"><table class="matrix overview">{head}<tbody>{"".join(rows)}</tbody></table></div>'


def _matrix(results: Sequence[Data]) -> str:
    """The requirements of each chapter; chapters with a failure are open."""
    paths, found = _by_path(results)
    parts = []
    for path in paths:
        here = [chapters[path] for chapters in found if path in chapters]
        names = list(dict.fromkeys(name for chapter in here for name in chapter.requirements))
        opened = " open" if any(chapter.counts["fail"] + chapter.counts["error"] for chapter in here) else ""
        heading = f"{escape(summary.title(path))}, {len(names)} requirements"
        parts.append(
            f'<details class="box" id="{_chapter_identifier(path)}"{opened}><summary>{heading}</summary>'
            f"<p>{chapter_link(path)}</p>{_requirements(results, names)}</details>"
        )
    return "".join(parts)


def _chapter_identifier(path: str) -> str:
    return "chapter-" + re.sub(r"[^A-Za-z0-9]", "-", path)


def _chapter_cell(chapter: summary.Chapter | None) -> str:
    if chapter is None:
        return _cell("none", "")
    counts, total = chapter.counts, len(chapter.requirements)
    failing, passing = counts["fail"] + counts["error"], counts["pass"] + counts["partly offered"]
    if failing:
        return _cell("fail", f"{failing} of {total} fail")
    if counts["expected failure"]:
        return _cell("known", f"{counts['expected failure']} of {total} as expected")
    return _cell("pass", f"{passing} of {total} pass", chapter.share) if passing else _cell("none", "not judged")


def _requirements(results: Sequence[Data], names: Sequence[str]) -> str:
    texts = {name: data["requirements"][name]["text"] for data in results for name in names if name in data["requirements"]}
    rows = (
        f"<tr><th>{escape(name)}</th>"
        f"{''.join(_requirement_cell(data, position, name) for position, data in enumerate(results))}"
        f'<td class="text"><div>{prose(texts[name])}</div></td></tr>'
        for name in names
    )
    head = f"<thead><tr><th></th>{_heads(results)}<th class=text></th></tr></thead>"
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
    failing = [check for check in checks if checks[check] in summary.FAILING]
    if not failing:
        return _cell("none", status)
    size = f" {summary.percent(entry['share'])}" if entry["share"] is not None else ""
    return _cell(KIND[status], f'<a href="#{_identifier(position, failing[0])}">{status}</a>{size}')


def _cell(kind: str, markup: str, share: float | None = None) -> str:
    bar = "" if share is None else f'<span class="bar"><span style="width: {min(100.0, 100 * share):.0f}%"></span></span>'
    return f'<td class="cell {kind}">{markup}{bar}</td>'


def _identifier(position: int, check: str) -> str:
    return f"failure-{position}-{escape(re.sub(r'[^A-Za-z0-9_.-]', '-', check))}"


def _heading(words: str, data: Data, several: bool) -> str:
    return f"<h2>{words}{f' of {escape(summary.label(data))}' if several else ''}</h2>"


def _diagnoses(data: Data, several: bool) -> str:
    if not data["diagnoses"]:
        return ""
    return _heading("Mistakes recognized", data, several) + "".join(map(_diagnosis, data["diagnoses"]))


def _diagnosis(found: Data) -> str:
    lines = [
        f"<p>Behaves like <b>{escape(found['mutant'])}</b>: {escape(found['explanation'])}</p>",
        f'<p class="small muted">Known from: {escape(found["provenance"])}</p>' if found["provenance"] else "",
        f"<p>{escape(found['fix'])} See {chapter_link(found['chapter'])}, {escape(', '.join(found['requirements']))}.</p>",
        f'<p class="small muted">Explains {escape(", ".join(found["explained"]))}</p>',
        f'<p class="small muted">Cannot be told from {escape(", ".join(found["alternatives"]))}</p>' if found["alternatives"] else "",
    ]
    return f'<div class="diagnosis">{"".join(lines)}</div>'


def _expected(data: Data, several: bool) -> str:
    if not data["expected_failures"]:
        return ""
    rows = "".join(
        f"<tr><td>{escape(entry['name'])}</td><td>{escape(entry['outcome'])}</td><td>{escape(entry['reason'])}</td></tr>"
        for entry in data["expected_failures"]
    )
    head = "<thead><tr><th>name</th><th>outcome</th><th>reason</th></tr></thead>"
    return _heading("Expected failures", data, several) + f'<div class="scroll"><table>{head}<tbody>{rows}</tbody></table></div>'


def _failures(data: Data, position: int, several: bool) -> str:
    found = [_failure(data, position, name, check, number < OPEN) for number, (name, check) in enumerate(summary.failures(data))]
    return _heading("Failures", data, several) + "".join(found) if found else ""


def _failure(data: Data, position: int, name: str, check: Data, is_open: bool) -> str:
    failure, is_expected = check["failure"], summary.is_expected(check)
    chapter = {data["requirements"][name]["chapter"] for name in check["requirements"] if name in data["requirements"]}
    diagnoses = summary.matching(data, name)
    links = ", ".join(map(chapter_link, sorted(chapter)))
    links = ", ".join(map(chapter_link, sorted(chapter)))
    parts = [
        f"<p>{prose(check['summary'])}</p>",
        f'<p class="small muted">{escape(", ".join(check["requirements"]))}: {links}</p>',
        f'<p class="known">Expected to fail: {escape(check["expected_failure"])}</p>' if is_expected else "",
        f"<pre>{escape(check['message'].rstrip())}</pre>",
        f"<p>Behaves like <b>{escape(', '.join(found['mutant'] for found in diagnoses))}</b>, see above.</p>" if diagnoses else "",
        f"<h3>The call of {escape(failure['function'])}</h3>{_values(failure)}" if failure["function"] else "",
        f"<h3>See it again</h3><pre>{escape(failure['command'])}</pre><pre>{escape(failure['snippet'])}</pre>",
    ]
    kind, opened = ("known" if is_expected else "bad"), (" open" if is_open else "")
    summary_line = f"{escape(name)} <span class=muted>{escape(check['status'])}</span>"
    heading = f'<details class="box {kind}" id="{_identifier(position, name)}"{opened}><summary>{summary_line}</summary>'
    return f"{heading}{''.join(parts)}</details>"


def _values(failure: Data) -> str:
    rows = "".join(
        f"<tr><td><code>{escape(value['name'])}</code></td><td>{escape(value['type'])}</td><td><pre>{escape(value['text'])}</pre></td></tr>"
        for value in summary.values(failure)
    )
    return f'<table class="values"><tbody>{rows}</tbody></table>'
