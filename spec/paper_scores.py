"""The scores that the paper prints, and what scores are normalized with: the CSV files in scores/, as plain data.

Numbers are `Decimal`, with as many digits as are printed, so that half a unit of the last one is known. Nothing that is
printed is mended: rows that hold what another row should are named in `misprints` (D-115), and
`PaperTable.aggregate` goes by them.

docs/scores.md says where each file comes from; `python -m docs.paper_scores` made those of the paper's own tables.
"""

import csv
import dataclasses
import functools
from collections.abc import Mapping
from decimal import Decimal
from importlib import resources

SUITES = ("minecraft", "atari", "procgen", "dmlab", "atari100k", "dmc", "dmc_vision", "bsuite")

Row = Mapping[str, Decimal | None]  # column -> number; None for a missing entry


@dataclasses.dataclass(frozen=True)
class Method:
    """A column of a table. steps: its budget in environment steps as it is printed, such as 200M; empty if the paper
    gives none."""

    column: str
    name: str
    steps: str


@dataclasses.dataclass(frozen=True)
class PaperTable:
    """The table of a suite. scores: by task. printed: the rows below the tasks, as they are printed. misprints: of
    these, the row that a printed one should have been."""

    suite: str
    methods: tuple[Method, ...]
    scores: Mapping[str, Row]
    printed: Mapping[str, Row]
    misprints: Mapping[str, str]

    def aggregate(self, name: str) -> Row | None:
        """The printed row that means this aggregate; None if the paper has none."""
        printed = {self.misprints.get(row, row): row for row in self.printed}
        return self.printed[printed[name]] if name in printed else None

    def column(self, name: str) -> dict[str, float]:
        """The scores of one method by task, without missing ones."""
        return {task: float(number) for task, row in self.scores.items() if (number := row[name]) is not None}


@functools.cache
def paper_tables() -> dict[str, PaperTable]:
    """Suite -> its table."""
    methods, misprints = read_rows("methods"), read_rows("misprints")
    return {
        suite: PaperTable(
            suite=suite,
            methods=tuple(
                Method(row["column"], row["method"], row["steps"]) for row in methods if row["suite"] == suite
            ),
            scores=_numbers(suite, "task"),
            printed={} if suite == "minecraft" else _numbers(f"{suite}-aggregates", "aggregate"),
            misprints={row["printed"]: row["means"] for row in misprints if row["suite"] == suite},
        )
        for suite in SUITES
    }


@functools.cache
def references() -> dict[str, dict[str, tuple[float, float]]]:
    """What counts as 0 and as 1, by task: `gamer` and `record` (Atari: random policy and game tester, random policy and
    record), `human` (DMLab-30: random policy and human), `range` (ProcGen, hard), `bsuite` (0 and 1: its scores are
    normalized as they are).

    Records are those of the paper's table, whole numbers; all others are exact.
    """
    gamer = _pairs("atari-references", "random", "gamer")
    records = paper_tables()["atari"].column("record")
    return {
        "gamer": gamer,
        "record": {task: (gamer[task][0], record) for task, record in records.items()},
        "human": _pairs("dmlab-references", "random", "human"),
        "range": _pairs("procgen-references", "minimum", "maximum"),
        "bsuite": dict.fromkeys(paper_tables()["bsuite"].scores, (0.0, 1.0)),
    }


@functools.cache
def bsuite_categories() -> dict[str, tuple[str, ...]]:
    """Experiment of BSuite -> its categories, of which there are seven."""
    return {row["task"]: tuple(row["categories"].split()) for row in read_rows("bsuite-categories")}


@functools.cache
def windows() -> dict[str, float]:
    """Suite -> the share of the budget at its end whose episodes a score is the mean of (D-118)."""
    return {row["suite"]: float(row["window"]) for row in read_rows("windows")}


def minecraft_items() -> list[dict[str, str]]:
    """What the text says about items in per cent, of `episodes` at the budget or of `runs`: item, method, share_of,
    percent. The rates of other items stand in a picture alone."""
    return read_rows("minecraft-items")


def atari100k_protocols() -> dict[str, dict[str, str]]:
    """Setting -> method -> a number, or yes or no: how the protocols for Atari100k differ."""
    return {row.pop("setting"): row for row in read_rows("atari100k-protocols")}


def ppo_settings() -> dict[str, str]:
    """Setting -> value: the table of PPO's hyperparameters, as the paper writes them (D-125)."""
    return {row["setting"]: row["value"] for row in read_rows("ppo")}


def read_rows(name: str) -> list[dict[str, str]]:
    """The rows of scores/NAME.csv by column. Lines that begin with # say where they come from."""
    text = resources.files("spec").joinpath("scores", f"{name}.csv").read_text(encoding="utf-8")
    return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))


def _numbers(name: str, key: str) -> dict[str, Row]:
    return {
        row.pop(key): {column: Decimal(number) if number else None for column, number in row.items()}
        for row in read_rows(name)
    }


def _pairs(name: str, low: str, high: str) -> dict[str, tuple[float, float]]:
    return {row["task"]: (float(row[low]), float(row[high])) for row in read_rows(name)}
