"""The result as Markdown, for a comment or a page of a wiki."""

import re
from collections.abc import Iterable, Sequence

from conformance.reports import summary
from conformance.reports.summary import Data


def render(data: Data) -> str:
    parts = [
        f"# Conformance of {text(summary.label(data))}",
        f"**{text(summary.headline(data)).capitalize()}.**",
        f"{text(summary.settings(data))}, {text(data['date'])}. {text(summary.tally(data))}.",
        text(" ".join(summary.notes(data))),
        _chapters(data),
        *_diagnoses(data),
        *_requirements(data),
        *_failures(data, "Failures", summary.failures(data).ordinary),
        *_failures(data, "Only with extreme input", summary.failures(data).extreme),
        *_expected(data),
    ]
    return "\n\n".join(parts) + "\n"


def text(plain: str) -> str:
    """Plain text in which nothing is markup, in one line."""
    return _escaped(" ".join(plain.split()))


def _escaped(plain: str) -> str:
    return re.sub(r"([\\`*_{}\[\]<>|#!~$&])", r"\\\1", plain)


def sentence(line: str) -> str:
    """A sentence of a chapter. Only what stands in `code` is markup."""
    return "".join(part if part.startswith("`") else _escaped(part) for part in re.split(r"(`[^`]+`)", line))


def code(plain: str) -> str:
    """Plain text as code in a line. It may hold backticks."""
    if not plain.strip():
        return ""
    fence = "`" * (_longest_run(plain) + 1)
    space = " " if plain.startswith("`") or plain.endswith("`") else ""
    return f"{fence}{space}{' '.join(plain.split())}{space}{fence}"


def block(plain: str, language: str = "") -> str:
    fence = "`" * max(3, _longest_run(plain) + 1)
    return f"{fence}{language}\n{plain.rstrip()}\n{fence}"


def _longest_run(plain: str) -> int:
    return max((len(run) for run in re.findall("`+", plain)), default=0)


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Cells are markup."""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (header, ["---"] * len(header), *rows))


def chapter(path: str) -> str:
    address = summary.address(path)
    return f"[{text(summary.title(path))}]({address})" if address else f"{text(summary.title(path))} ({code(path)})"


def _chapters(data: Data) -> str:
    rows = []
    for found in summary.chapters(data):
        counts = ", ".join(f"{found.counts[name]} {name}" for name in summary.STATUSES if found.counts[name])
        rows.append([chapter(found.path), counts, summary.percent(found.share), text(found.where)])
    return f"{table(['chapter', 'requirements', 'worst, of allowed', 'where'], rows)}\n\n{text(summary.SCALE)}"


def _diagnoses(data: Data) -> list[str]:
    lines = [
        f"- {_introduced(found)}: {sentence(found['explanation'])}. See "
        f"{chapter(found['chapter'])}. {sentence(found['fix'])} "
        f"Explains {', '.join(map(code, found['explained']))}."
        + (f" Known from: {text(found['provenance'])}." if found["provenance"] else "")
        + (f" Only the nearest, {text(objection)}." if (objection := summary.objection(data, found)) else "")
        for found in summary.diagnoses(data)
    ]
    return ["## It behaves like", "\n".join(lines)] if lines else []


def _introduced(diagnosis: Data) -> str:
    """The heading says already that it behaves like what has no other words."""
    words, name = summary.likeness(diagnosis)
    bold = f"**{text(name or words)}**"
    return f"{text(words)} {bold}" if name and words != summary.LIKENESS["known"][0] else bold


def _requirements(data: Data) -> list[str]:
    """Those that failed, with the checks that say so."""
    failing = (*summary.FAILING, summary.EXTREME)
    rows = [
        [text(name), summary.status(data, name), ", ".join(map(code, summary.checks_of(data, name, failing)))]
        for name in data["requirements"]
        if summary.status(data, name) in failing
    ]
    return ["## Requirements that fail", table(["requirement", "status", "failing checks"], rows)] if rows else []


def _expected(data: Data) -> list[str]:
    rows = [[code(entry["name"]), entry["outcome"], text(entry["reason"])] for entry in data["expected_failures"]]
    if not rows:
        return []
    failing = (part for name, check in summary.failures(data).expected for part in _failure(data, name, check))
    return ["## Expected failures", table(["name", "outcome", "reason"], rows), *failing]


def _failures(data: Data, title: str, failing: Sequence[tuple[str, Data]]) -> list[str]:
    parts = [part for name, check in failing for part in _failure(data, name, check)]
    return [f"## {title}", *parts] if parts else []


def _failure(data: Data, name: str, check: Data) -> list[str]:
    failure = check["failure"]
    expected = f" An expected failure: {text(check['expected_failure'])}" if summary.is_expected(check) else ""
    parts = [
        f"### {text(name)}",
        f"{', '.join(check['requirements'])}: {text(check['summary'])}{expected}",
        *(f"> {sentence(line)}" for line in summary.demands(data, check)),
        block(check["message"], "text"),
    ]
    rows = [
        [code(value["name"]), text(value["type"]), code(value["text"]).replace("|", "\\|")]
        for value in summary.values(failure)
    ]
    if rows:
        parts += [f"The call of {code(failure['function'])}:", table(["", "type", "value"], rows)]
    return [*parts, block(failure["command"], "sh"), block(failure["snippet"], "python")]
