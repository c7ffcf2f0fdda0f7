"""Fills the generated parts of the Markdown files: quoted code and tables of numbers.

`python -m docs.render` (or `make docs`) writes them, `--check` only compares.

A part stands between a marker line and an end line, and is never edited by hand:

  <!-- quote: reference_numpy/returns.py lambda_return -->      the source of a function or class
  <!-- end quote -->
  <!-- table: hyperparameters -->                               one of TABLES
  <!-- end table -->
"""

import ast
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from spec import benchmarks, hyperparameters, profiles, sizes

ROOT = Path(__file__).resolve().parent.parent
PART = re.compile(r"(<!-- (quote|table): ([^>]*?) -->\n).*?(<!-- end \2 -->)", re.DOTALL)


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
        official = profiles()["official"].get(name, entry["value"])
        symbol = entry.get("symbol", "")
        values = [_value(entry["value"]), _value(official) if official != entry["value"] else ""]
        rows.append([f"`{name}`", symbol, *values, entry["help"], entry["source"]])
    return markdown_table(["name", "symbol", "paper", "official, where it differs", "meaning", "source"], rows)


def size_table() -> str:
    """Every size; what a size does not set has the default."""
    names = list(next(iter(sizes().values())))
    rows = [[f"`{size}`", *(str(values.get(name, hyperparameters()[name]["value"])) for name in names)] for size, values in sizes().items()]
    return markdown_table(["size", *(f"`{name}`" for name in names)], rows)


def benchmark_table() -> str:
    """Every suite; values of the profile `official` in parentheses where they differ."""
    names = ["tasks", "steps", "action_repeat", "envs", "replay_ratio", "size", "observation"]

    def cell(suite: dict[str, Any], name: str) -> str:
        official = suite.get("official", {})
        changed = f" ({_value(official[name])})" if name in official else ""
        return (_value(suite[name]) if name in suite else "environment's") + changed

    rows = [[f"`{name}`", *(cell(suite, column) for column in names)] for name, suite in benchmarks().items()]
    return markdown_table(["suite", *names], rows)


def _value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:,}" if isinstance(value, int) else str(value)


TABLES: dict[str, Callable[[], str]] = {"hyperparameters": hyperparameter_table, "sizes": size_table, "benchmarks": benchmark_table}


def render(text: str) -> str:
    """The text with every generated part made anew."""

    def part(match: re.Match[str]) -> str:
        start, kind, argument, end = match.groups()
        content = quote(argument) if kind == "quote" else TABLES[argument]()
        return f"{start}\n{content}\n{end}"

    return PART.sub(part, text)


def documents() -> list[Path]:
    return [ROOT / "README.md", *sorted((ROOT / "spec").glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]


def stale() -> list[Path]:
    """The files whose generated parts differ from their sources."""
    return [path for path in documents() if path.exists() and render(path.read_text(encoding="utf-8")) != path.read_text(encoding="utf-8")]


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
