"""The tables of docs/scores.md: what the rows of the paper give, which windows its curves allow, and settings that it
prints."""

import json
from decimal import Decimal
from pathlib import Path
from typing import Any

from dreamer_spec.scoring.suites import SUMMARIES
from dreamer_spec.scoring.tables import of_paper
from spec.paper_scores import PaperTable, atari100k_protocols, paper_tables, ppo_settings

RESULTS = Path(__file__).resolve().parent / "results"
CURVES = RESULTS / "paper-windows.json"


def summaries() -> tuple[list[str], list[list[str]]]:
    """Header and rows: every printed summary, from the rows of the paper and from the released curves, for Dreamer; and
    how many columns come out as printed."""
    rows = []
    for suite, table in paper_tables().items():
        for name, values in _recomputed(table).items():
            printed = table.aggregate(name) or {}
            equal = [column for column, value in values.items() if _is_printed(value, printed[column])]
            others = [_name(table, column) for column in values if column not in equal]
            cells = [f"`{suite}`", name.replace("_", " "), str(printed["dreamer"]), _digits(values["dreamer"], printed)]
            exact = _of_curves(suite).get(name)
            cells.append("" if exact is None else _digits(exact, printed))
            rows.append([*cells, f"{len(equal)} of {len(values)}" + (f"; not {', '.join(others)}" if others else "")])
    header = ["suite", "summary", "printed", "from the rows", "from the curves", "columns equal in every printed digit"]
    return header, rows


def _recomputed(table: PaperTable) -> dict[str, dict[str, float]]:
    """Summary -> column -> number."""
    known = [summary for summary in SUMMARIES[table.suite] if table.aggregate(summary.name)]
    found = {summary.name: of_paper(summary, table, list(table.scores)) for summary in known}
    return {name: {column: value for column, value in row.items() if value is not None} for name, row in found.items()}


def _is_printed(value: float, printed: Decimal | None) -> bool:
    return printed is not None and abs(value - float(printed)) <= 0.5 * 10.0 ** int(printed.as_tuple().exponent) + 1e-9


def _name(table: PaperTable, column: str) -> str:
    return next(method.name for method in table.methods if method.column == column)


def _digits(value: float, printed: Any) -> str:
    """One digit more than is printed."""
    return f"{value:.{1 - int(printed['dreamer'].as_tuple().exponent)}f}"


def curves() -> list[dict[str, Any]]:
    return json.loads(CURVES.read_text(encoding="utf-8"))["curves"]


def _of_curves(suite: str) -> dict[str, float]:
    """Summaries of Dreamer's curves, which are not rounded."""
    return next((c["summaries"] for c in curves() if (c["suite"], c["method"]) == (suite, "dreamer")), {})


def windows() -> tuple[list[str], list[list[str]]]:
    """Header and rows: how many rows of a column come out with the window that is taken."""
    rows = []
    for entry in curves():
        table = paper_tables()[entry["suite"]]
        low, high = (f"{100 * window:g}" for window in entry["windows_with_most"])
        reach = f"{low} %" if low == high else f"{low} to {high} %"
        cells = [f"`{entry['suite']}`", _name(table, entry["method"]), f"{entry['runs']}", f"{entry['left_out']}"]
        cells += [f"{100 * entry['window']:g} %", f"{entry['equal']} of {entry['rows']}"]
        rows.append([*cells, f"{entry['most_equal']} with {reach}"])
    header = ["suite", "method", "runs", "left out", "window", "rows equal in every printed digit"]
    return [*header, "most, with the shortest and the longest window"], rows


def atari100k_settings() -> tuple[list[str], list[list[str]]]:
    """Header and rows: how the protocols for Atari100k differ, a column for each method."""
    protocols = atari100k_protocols()
    rows = [[setting.replace("_", " "), *values.values()] for setting, values in protocols.items()]
    return ["setting", *next(iter(protocols.values()))], rows


def ppo_settings_rows() -> tuple[list[str], list[list[str]]]:
    """Header and rows: the paper's hyperparameters of PPO."""
    return ["setting", "value"], [[setting, value] for setting, value in ppo_settings().items()]


def published(name: str) -> tuple[list[str], list[list[str]]]:
    """Header and rows: every run in results/NAME.json, which `train score --json` wrote, beside the paper's task."""
    data = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    paper = {f"{suite['suite']}:{task['task']}": task["paper"] for suite in data["suites"] for task in suite["tasks"]}
    rows = []
    for run in data["runs"]:
        printed = paper[run["task"].partition("/")[0]]
        cells = [f"`{run['task']}`", run["backend"], str(run["seed"]), f"{run['step']:,}", f"{run['returns']:,}"]
        rows.append([*cells, f"{run['score']:.3f}", f"{printed['random']:g}", f"{printed['dreamer']:g}"])
    header = ["task", "backend", "seed", "steps", "episodes", "score", "random, paper", "Dreamer, paper"]
    return header, rows
