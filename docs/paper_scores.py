"""Extracts the tables of scores from the LaTeX source of the paper: spec/scores/*.csv.

  python -m docs.paper_scores PAPER.tex            writes the files
  python -m docs.paper_scores PAPER.tex --check    only compares, and names what differs

Digits are kept as they are printed, misprints too: spec/scores/misprints.csv, which nobody extracts, says which rows
are known to be wrong. Names of tasks are those of --task, columns those of the methods.
"""

import argparse
import csv
import io
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from docs.latex_tables import LatexTable, number, read_tables

FOLDER = Path(__file__).resolve().parent.parent / "spec" / "scores"
HEADER = (
    "# Made of the paper's LaTeX source by `python -m docs.paper_scores`; do not edit. Missing entries are empty.\n"
)
DOMAINS = ("ball_in_cup",)  # those of the control suite that are more than one word
Rows = list[list[str]]


def slug(words: str) -> str:
    """Ms Pacman -> ms_pacman, R2D2+ -> r2d2_plus, Gamer mean (%) -> gamer_mean"""
    plain = words.lower().replace("(%)", "").replace("+", " plus")
    return re.sub(r"[^a-z0-9]+", "_", plain).strip("_")


def control_task(words: str) -> str:
    """Ball In Cup Catch -> ball_in_cup-catch, Cartpole Balance Sparse -> cartpole-balance_sparse"""
    name = slug(words)
    domain = next((domain for domain in DOMAINS if name.startswith(domain)), name.partition("_")[0])
    return f"{domain}-{name.removeprefix(domain + '_')}"


# Suite -> the label of its table, and how its rows are named.
SUITES: dict[str, tuple[str, Callable[[str], str]]] = {
    "atari": ("tab:atari", slug),
    "procgen": ("tab:procgen", slug),
    "dmlab": ("tab:dmlab", slug),
    "atari100k": ("tab:atari100k", slug),
    "dmc": ("tab:dmc_proprio", control_task),
    "dmc_vision": ("tab:dmc_vision", control_task),
    "bsuite": ("tab:bsuite", slug),
}


def extract(source: str) -> dict[str, str]:
    """Name of a file in spec/scores -> what it holds.

    Raises:
      ValueError: a table is not there, or not as it was when this was written.
    """
    tables = read_tables(source, [*(label for label, _ in SUITES.values()), "tab:minecraft", "tab:atari100k_setting"])
    files: dict[str, Rows] = {}
    methods: Rows = [["suite", "column", "method", "steps"]]
    for suite, (label, name) in SUITES.items():
        columns, tasks, aggregates = _suite(tables[label], name)
        methods += [[suite, *column] for column in columns]
        names = [column for column, _, _ in columns]
        files[suite] = [["task", *names], *tasks]
        files[f"{suite}-aggregates"] = [["aggregate", *names], *aggregates]
    files["minecraft"], of_minecraft = _minecraft(tables["tab:minecraft"])
    files["methods"] = methods + of_minecraft
    files["minecraft-items"] = _items(source)
    files["atari100k-protocols"] = _protocols(tables["tab:atari100k_setting"])
    return {f"{name}.csv": HEADER + _csv(rows) for name, rows in files.items()}


def _suite(table: LatexTable, name: Callable[[str], str]) -> tuple[list[tuple[str, str, str]], Rows, Rows]:
    """The columns, each its name, the method and the environment steps; the rows of tasks; the rows below them."""
    [[_, *methods]], *parts = table.parts
    steps = [""] * len(methods)
    if parts[0][0][0] == "Environment steps":
        [[_, *steps]], *parts = parts
    steps = [number_of_steps(cell) for cell in steps]
    twice = {method for method in methods if methods.count(method) > 1}
    names = [
        slug(f"{method} {step}") if method in twice else slug(method)
        for method, step in zip(methods, steps, strict=True)
    ]
    _require_unique(table.label, names)
    tasks = [[name(task), *map(number, cells)] for task, *cells in parts[0]]
    aggregates = [[slug(row), *map(number, cells)] for part in parts[1:] for row, *cells in part]
    _require_unique(table.label, [row[0] for row in tasks])
    _require_unique(table.label, [row[0] for row in aggregates])
    return list(zip(names, methods, steps, strict=True)), tasks, aggregates


def number_of_steps(cell: str) -> str:
    """200M, as it is printed; nothing where the paper gives none.

    Raises:
      ValueError: something else.
    """
    if cell in ("", "---"):
        return ""
    if not re.fullmatch(r"\d+[KMB]", cell):
        raise ValueError(f"{cell!r} is not a number of environment steps")
    return cell


def _require_unique(label: str, names: Sequence[str]) -> None:
    if twice := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"{label}: {', '.join(sorted(twice))} occurs more than once")


def _minecraft(table: LatexTable) -> tuple[Rows, Rows]:
    """The one task as a row, its methods as columns; and these methods. The budget stands in the caption."""
    [_], methods = table.parts
    [steps] = re.findall(r"at (\d+M) environment steps", table.caption)
    names = [slug(method) for method, _ in methods]
    scores = [["task", *names], ["diamond", *(number(score) for _, score in methods)]]
    return scores, [["minecraft", slug(method), method, steps] for method, _ in methods]


def _items(source: str) -> Rows:
    """What the text says about items in per cent. The other rates stand in a picture alone."""
    text = " ".join(source.split())
    [[of_episodes]] = [re.findall(r"Dreamer obtains diamonds in ([\d.]+)\\% of episodes", text)]
    [[of_runs, of_baselines]] = re.findall(
        r"([\d.]+)\\% of Dreamer agents obtain one or more diamonds.*?compared to ([\d.]+)\\% of the baseline agents",
        text,
    )
    return [
        ["item", "method", "share_of", "percent"],
        ["diamond", "dreamer", "episodes", of_episodes],
        ["diamond", "dreamer", "runs", of_runs],
        ["diamond", "baselines", "runs", of_baselines],
    ]


def _protocols(table: LatexTable) -> Rows:
    """Numbers, and what a method does: yes (X in the paper) or no (a dash)."""
    [[_, *methods]], numbers, settings = table.parts
    marks = {"X": "yes", "---": "no"}
    rows = [["setting", *map(slug, methods)]]
    rows += [[slug(name), *map(number, cells)] for name, *cells in numbers]
    return rows + [[slug(name), *(marks[cell] for cell in cells)] for name, *cells in settings]


def _csv(rows: Iterable[Sequence[str]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command. Returns 0, or 1 if `--check` found a difference."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paper", type=Path, metavar="PAPER.tex")
    parser.add_argument("--check", action="store_true", help="compare, and write nothing")
    options = parser.parse_args(arguments)
    files = extract(options.paper.read_text(encoding="utf-8"))
    differing = [name for name, text in files.items() if _differs(FOLDER / name, text)]
    if not options.check:
        FOLDER.mkdir(exist_ok=True)
        for name in differing:
            (FOLDER / name).write_text(files[name], encoding="utf-8", newline="\n")
    verb = "differs from the paper" if options.check else "written"
    print("\n".join(f"{FOLDER / name}: {verb}" for name in differing) or f"{len(files)} files are those of the paper")
    return int(options.check and bool(differing))


def _differs(path: Path, text: str) -> bool:
    return not path.exists() or path.read_text(encoding="utf-8") != text


if __name__ == "__main__":
    sys.exit(main())
