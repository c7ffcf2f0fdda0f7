"""Fills the generated parts of the Markdown files: quoted code, tables of numbers and worked numbers.

`python -m docs.render` (or `make docs`) writes them, `--check` only compares.

A part stands between a marker line and an end line, and is never edited by hand:

  <!-- quote: reference_numpy/returns.py lambda_return -->      the source of a function or class
  <!-- end quote -->
  <!-- table: hyperparameters -->                               one of TABLES, each a table or more
  <!-- end table -->
  <!-- examples: returns; a return by hand -->              worked numbers of a chapter, some or all: docs/examples.py
  <!-- end examples -->
"""

import ast
import collections
import functools
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from conformance.commands.mutants import is_named
from conformance.mutants import implementations
from conformance.mutants.implementations import report as mutant_report
from conformance.requirements import chapter_of, requirements
from docs import backends, examples, measurements, score_tables, third_party
from dreamer_spec.report import catalogue
from spec import Edition, benchmarks, editions, hyperparameters, profiles, sizes

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "docs" / "results"
PART = re.compile(r"(<!-- (quote|table|examples): ([^>]*?) -->\n).*?(<!-- end \2 -->)", re.DOTALL)


def quote(argument: str) -> str:
    """The source of a top-level function or class, without decoration: `path name`."""
    path, name = argument.split()
    source = (ROOT / path).read_text(encoding="utf-8")
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name:
            first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
            lines = source.splitlines()[first - 1 : node.end_lineno]
            return f"[`{path}`](../{path})\n\n```python\n" + "\n".join(lines) + "\n```\n"
    raise ValueError(f"{path} defines no {name}")


def markdown_table(header: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(cells) + " |" for cells in (header, ["---"] * len(header), *rows)]
    return "\n".join(lines) + "\n"


def hyperparameter_table() -> str:
    """Every hyperparameter with its value in each profile."""
    rows = []
    for name, entry in hyperparameters().items():
        others = "; ".join(
            f"{profile}: {_value(values[name])}" for profile, values in profiles().items() if name in values
        )
        rows.append(
            [f"`{name}`", entry.get("symbol", ""), _value(entry["value"]), others, entry["help"], entry["source"]]
        )
    return markdown_table(["name", "symbol", "paper", "others, where they differ", "meaning", "source"], rows)


def edition_list() -> str:
    """What each edition is."""
    rows = [
        [f"`{edition.name}`", edition.title, edition.source, edition.date, f"`{edition.profile}`"]
        for edition in editions().values()
    ]
    return markdown_table(["edition", "what it is", "source", "date", "profile"], rows)


def edition_table(chapter: str = "") -> str:
    """The requirements that some edition has otherwise, of one chapter (`spec/07-returns.md`) or of all, and what holds
    in each."""
    found = {name for edition in editions().values() for name in edition.differs}
    names = [name for name in requirements() if name in found and chapter in ("", chapter_of(name))]
    rows = [[name, *(_in_edition(edition, name) for edition in editions().values())] for name in names]
    return markdown_table(["requirement", *editions()], rows)


def _in_edition(edition: Edition, requirement: str) -> str:
    if (difference := edition.differs.get(requirement)) is None:
        return "holds"
    values = (f"`{name}` {_value(profiles()[edition.profile][name])}" for name in difference.settings)
    return " ".join(
        [difference.instead, *(["Not judged."] if not difference.is_modelled else []), ", ".join(values)]
    ).strip()


def chapters_with_editions() -> list[str]:
    return sorted({chapter_of(name) for edition in editions().values() for name in edition.differs})


def edition_beyond() -> str:
    """The functions that editions have otherwise, without a model."""
    rows = [
        [f"`{edition.name}`", ", ".join(f"`{name}`" for name in edition.beyond)]
        for edition in editions().values()
        if edition.beyond
    ]
    return markdown_table(["edition", "not modelled"], rows)


def size_table() -> str:
    """Every size; what a size does not set has the default."""
    names = list(next(iter(sizes().values())))
    rows = [
        [f"`{size}`", *(str(values.get(name, hyperparameters()[name]["value"])) for name in names)]
        for size, values in sizes().items()
    ]
    return markdown_table(["size", *(f"`{name}`" for name in names)], rows)


def benchmark_table() -> str:
    """Every suite, and whether its protocol is ours; values of the profile `official` in parentheses where they
    differ."""
    names = ["steps", "action_repeat", "envs", "replay_ratio", "size", "time_limit", "observation"]

    def cell(suite: dict[str, Any], name: str) -> str:
        official = suite.get("official", {})
        changed = f" ({_value(official[name])})" if name in official else ""
        return (_value(suite[name]) if name in suite else "environment's") + changed

    def arguments(suite: dict[str, Any]) -> str:
        own = suite.get("env", {})
        return ", ".join(f"`{name}` {cell({**own, 'official': _official_env(suite)}, name)}" for name in own)

    def printed(suite: dict[str, Any], name: str) -> str:
        return str(suite.get(name, ""))

    rows = [
        [
            f"`{name}`" + (", ours" if suite.get("ours") else ""),
            str(len(suite["tasks"])),
            *(cell(suite, column) for column in names),
            arguments(suite),
            printed(suite, "seeds"),
            printed(suite, "gpu_days"),
        ]
        for name, suite in benchmarks().items()
    ]
    return markdown_table(["suite", "tasks", *names, "its environment", "seeds", "GPU days"], rows)


def _official_env(suite: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = suite.get("official", {}).get("env", {})
    return found


def conformance_summary() -> str:
    """The committed runs of the kit on our backends."""
    header = ["backend", "dtype", "edition", *backends.STATUSES, "numbers compared", "worst, of allowed"]
    return markdown_table(header, backends.summary_rows())


def conformance_chapters() -> str:
    """The same, chapter by chapter, in float64."""
    columns, rows = backends.chapter_rows()
    return markdown_table(["requirements", *columns], rows)


def mutants() -> dict[str, dict[str, dict[str, Any]]]:
    """The committed run of `conformance mutants --diagnose --json`: chapter -> mutant -> what it is, what caught it,
    what it was named."""
    chapters: dict[str, dict[str, dict[str, Any]]] = {}
    for name, entry in json.loads((RESULTS / "mutants.json").read_text(encoding="utf-8"))["mutants"].items():
        chapters.setdefault(entry["chapter"], {})[name] = entry
    return dict(sorted(chapters.items()))


def mutant_summary() -> str:
    """For each chapter how many mutants there are, how many were caught and how many named."""
    rows = []
    for chapter, entries in mutants().items():
        caught = sum(bool(entry["deviates_in"] + entry["raises_in"]) for entry in entries.values())
        named = sum(is_named(name, entry["diagnosis"]) for name, entry in entries.items())
        rows.append([f"[{Path(chapter).stem}](../{chapter})", *map(str, (len(entries), caught, named))])
    totals = [str(sum(int(row[column]) for row in rows)) for column in (1, 2, 3)]
    return markdown_table(["chapter", "mutants", "caught", "named"], [*rows, ["all", *totals]])


def mutant_tables() -> str:
    """Every mutant: a table for each chapter."""
    return "\n".join(
        f"### [{chapter}](../{chapter})\n\n{_mutants_of(entries)}" for chapter, entries in mutants().items()
    )


def _mutants_of(entries: dict[str, dict[str, Any]]) -> str:
    rows = []
    for name, entry in entries.items():
        killers = entry["deviates_in"] + entry["raises_in"]
        caught = f"{len(killers)}: `{killers[0]}`" if killers else "nothing"
        first = entry["diagnosis"][0] if entry["diagnosis"] else {"mutant": "nothing", "alternatives": []}
        named = (
            "itself"
            if is_named(name, entry["diagnosis"])
            else ", ".join(f"`{n}`" for n in (first["mutant"], *first["alternatives"]))
        )
        texts = [entry[part].replace("|", "\\|") for part in ("explanation", "provenance", "fix")]
        rows.append([f"`{name}`", *texts[:2], ", ".join(entry["violates"]), texts[2], caught, named])
    return markdown_table(["mutant", "mistake", "provenance", "violates", "fix", "caught by", "named"], rows)


def implementation_mutant_kinds() -> str:
    """What kinds of mistakes are planted in the implementations, and how many of each."""
    kinds = collections.Counter(patch.kind for patch in implementations.patches().values())
    rows = [[f"`{kind}`", meaning, str(kinds[kind])] for kind, meaning in implementations.KINDS.items()]
    return markdown_table(["kind", "mistake", "mutants"], [*rows, ["all", "", str(kinds.total())]])


def implementation_mutants() -> str:
    """The committed runs of `conformance mutants --implementations --json`, and what they missed."""
    path = RESULTS / "implementation-mutants.json"
    if not path.exists():
        return f"No run of all of them is recorded yet (`{path.relative_to(ROOT)}`).\n"
    found = json.loads(path.read_text(encoding="utf-8"))["mutants"]
    rows = [[kind, *map(str, row)] for kind, row in mutant_report.counts(found).items()]
    for name, patches in implementations.catalogues().items():
        own = {mutant: found[mutant] for mutant in patches if mutant in found}
        rows.append([f"all in `{name}.toml`", *map(str, mutant_report.counts(own)["all"])])
    table = markdown_table(["kind", *mutant_report.COLUMNS], rows)
    if left := len(implementations.patches()) - len(found):
        table += f"\nNot run yet: {left} of {len(implementations.patches())}.\n"
    for column, title in (("test", "Noticed by a test alone"), ("survived", "Survivors")):
        rows = [
            [f"`{name}`", f"`{entry['file']}`", entry["explanation"].replace("|", "\\|")]
            for name, entry in found.items()
            if mutant_report.column_of(entry) == column
        ]
        table += f"\n{title}:\n\n" + markdown_table(["mutant", "file", "mistake"], rows) if rows else ""
    return table


def _value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:,}" if isinstance(value, int) else str(value)


# Those that are made elsewhere, as header and rows.
MEASURED: dict[str, Callable[[], measurements.Table]] = {
    "preflight": measurements.preflight,
    "train_step": measurements.train_step,
    "learning": measurements.learning,
    "replay_image": lambda: measurements.replay("image"),
    "replay_small": lambda: measurements.replay("small"),
    "loop_shares": measurements.loop_shares,
    "loop_memory": measurements.loop_memory,
    "lockstep_free": lambda: measurements.lockstep("free", ("float64",)),
    "lockstep_one_step": lambda: measurements.lockstep("one step", ("float64", "float32", "bfloat16")),
    "scores_bsuite": lambda: score_tables.published("scores-bsuite"),
    "paper_summaries": score_tables.summaries,
    "paper_windows": score_tables.windows,
    "atari100k_protocols": score_tables.atari100k_settings,
    "ppo": score_tables.ppo_settings_rows,
}


def written(made: Callable[[], measurements.Table]) -> str:
    return markdown_table(*made())


TABLES: dict[str, Callable[[], str]] = {
    "hyperparameters": hyperparameter_table,
    "sizes": size_table,
    "editions": edition_list,
    "edition_differences": edition_table,
    "edition_beyond": edition_beyond,
    **{
        f"editions of {Path(chapter).stem}": functools.partial(edition_table, chapter)
        for chapter in chapters_with_editions()
    },
    "benchmarks": benchmark_table,
    "conformance_summary": conformance_summary,
    "conformance_chapters": conformance_chapters,
    "mutant_summary": mutant_summary,
    "mutants": mutant_tables,
    "implementation_mutant_kinds": implementation_mutant_kinds,
    "implementation_mutants": implementation_mutants,
    **{name: functools.partial(written, made) for name, made in MEASURED.items()},
    "metrics": catalogue.markdown,
    "third_party": third_party.summary_table,
    "third_party_findings": third_party.finding_sections,
}


KINDS: dict[str, Callable[[str], str]] = {
    "quote": quote,
    "table": lambda name: TABLES[name](),
    "examples": examples.markdown,
}


def render(text: str) -> str:
    """The text with every generated part made again."""

    def part(match: re.Match[str]) -> str:
        start, kind, argument, end = match.groups()
        content = KINDS[kind](argument)
        return f"{start}\n{content}\n{end}"

    return PART.sub(part, text)


def documents() -> list[Path]:
    return [ROOT / "README.md", *sorted((ROOT / "spec").glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]


def stale() -> list[Path]:
    """The files whose generated parts differ from their sources."""
    return [
        path
        for path in documents()
        if path.exists() and render(path.read_text(encoding="utf-8")) != path.read_text(encoding="utf-8")
    ]


def main() -> int:
    paths = stale()
    if "--check" in sys.argv[1:]:
        for path in paths:
            print(f"{path.relative_to(ROOT)} is stale; run: make docs", file=sys.stderr)
        return 1 if paths else 0
    for path in paths:
        path.write_text(render(path.read_text(encoding="utf-8")), encoding="utf-8")
        print(f"wrote {path.relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
