"""The scores of the paper as data: how they are read from its LaTeX, that they are complete, and that its own rows give
its own summaries."""

import gzip
import json
import os
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docs import paper_scores, paper_windows
from docs.latex_tables import cell_text, number, read_tables
from dreamer_spec.scoring.statistics import summarize
from dreamer_spec.scoring.suites import SUMMARIES, Summary
from spec import benchmarks
from spec.paper_scores import (
    PaperTable,
    atari100k_protocols,
    bsuite_categories,
    minecraft_items,
    paper_tables,
    ppo_settings,
    read_rows,
    references,
    windows,
)

TEX = os.environ.get("DREAMERV3_TEX")
TABLE = r"""
\begin{mytabular}{
  colspec = {| L{8em} | C{3em} C{3em} |}, % a comment & \\
}
\toprule
Task & R2D2+ & \clap{Boot DQN} \\
\midrule
Environment steps & --- & \o\o200M \\
\midrule
Ms Pacman & \textbf{\o\llap{--}21} & 1,234 \\
Hero & \o0.50 & --- \\ \midrule
Gamer mean \rlap{(\%)} & \textbf{1} & 2 \\
\bottomrule
\end{mytabular}
\caption{At 100M environment steps.}
\label{tab:x}
"""


# Reading LaTeX


def test_a_table_is_read_as_it_is_printed() -> None:
    table = read_tables(TABLE, ["tab:x"])["tab:x"]
    assert table.parts == [
        [["Task", "R2D2+", "Boot DQN"]],
        [["Environment steps", "---", "200M"]],
        [["Ms Pacman", "-21", "1,234"], ["Hero", "0.50", "---"]],
        [["Gamer mean (%)", "1", "2"]],
    ]
    assert "100M environment steps" in table.caption
    columns, tasks, aggregates = paper_scores._suite(table, paper_scores.slug)
    assert columns == [("r2d2_plus", "R2D2+", ""), ("boot_dqn", "Boot DQN", "200M")]
    assert tasks == [["ms_pacman", "-21", "1234"], ["hero", "0.50", ""]]
    assert aggregates == [["gamer_mean", "1", "2"]]


def test_methods_with_one_name_are_told_apart_by_their_budgets() -> None:
    text = TABLE.replace(r"\clap{Boot DQN}", "R2D2+").replace("--- & \\o\\o200M", "1B & 10B")
    columns, _, _ = paper_scores._suite(read_tables(text, ["tab:x"])["tab:x"], paper_scores.slug)
    assert [name for name, _, _ in columns] == ["r2d2_plus_1b", "r2d2_plus_10b"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("& 1,234", ""), "cells"),
        ((r"\textbf{1}", r"\emph{1}"), "not understood"),
        ((r"\label{tab:x}", ""), "no end or no label"),
        ((r"\label{tab:x}", r"\label{tab:y}"), "no table tab:x"),
        (("{\n  colspec", "{{\n  colspec"), "not closed"),
    ],
)
def test_what_is_not_understood_is_an_error(change: tuple[str, str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_tables(TABLE.replace(*change), ["tab:x"])


def test_numbers_keep_their_digits() -> None:
    assert [number(cell) for cell in ("10,506,650", "-0.10", "0", "---")] == ["10506650", "-0.10", "0", ""]
    for cell in ("1,23", "X", "", "1e5", "nan", "1.2.3"):
        with pytest.raises(ValueError, match="not a number"):
            number(cell)
    assert cell_text(r" \textbf{\o\llap{--}17098} ") == "-17098"


def test_tasks_are_named_as_on_the_command_line() -> None:
    assert paper_scores.slug("Montezuma Revenge") == "montezuma_revenge"
    assert paper_scores.control_task("Ball In Cup Catch") == "ball_in_cup-catch"
    assert paper_scores.control_task("Cartpole Balance Sparse") == "cartpole-balance_sparse"


@pytest.mark.skipif(TEX is None, reason="DREAMERV3_TEX names no LaTeX source of the paper")
def test_the_files_are_those_of_the_paper(capsys: pytest.CaptureFixture[str]) -> None:
    assert TEX
    assert paper_scores.main([TEX, "--check"]) == 0, capsys.readouterr().out


@pytest.mark.skipif(TEX is None, reason="DREAMERV3_TEX names no LaTeX source of the paper")
def test_a_file_that_was_changed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert TEX
    monkeypatch.setattr(paper_scores, "FOLDER", tmp_path)
    assert paper_scores.main([TEX]) == 0
    path = tmp_path / "atari.csv"
    path.write_text(path.read_text().replace("10977", "10978"))
    capsys.readouterr()
    assert paper_scores.main([TEX, "--check"]) == 1
    assert capsys.readouterr().out == f"{path}: differs from the paper\n"


# The data


def test_the_tables_are_complete() -> None:
    sizes = {
        suite: (len(table.scores), len(table.methods), len(table.printed)) for suite, table in paper_tables().items()
    }
    assert sizes == {
        "minecraft": (1, 4, 0),
        "atari": (57, 6, 4),
        "procgen": (16, 4, 1),
        "dmlab": (30, 6, 1),
        "atari100k": (26, 8, 2),
        "dmc": (18, 5, 2),
        "dmc_vision": (20, 5, 2),
        "bsuite": (23, 6, 9),
    }
    for suite, table in paper_tables().items():
        columns = [method.column for method in table.methods]
        assert all(list(row) == columns for row in (*table.scores.values(), *table.printed.values()))
        assert list(table.scores) == benchmarks()[suite]["tasks"]
    assert len(ppo_settings()) == 16
    assert len(atari100k_protocols()) == 11
    assert {len(row) for row in atari100k_protocols().values()} == {6}
    assert [row["percent"] for row in minecraft_items()] == ["0.4", "100", "0"]


def test_single_numbers_of_the_paper() -> None:
    tables = paper_tables()
    assert tables["atari"].scores["skiing"]["random"] == -17098
    assert tables["atari"].scores["video_pinball"]["record"] == 89218328
    assert tables["dmlab"].scores["language_execute_random_task"]["impala_100m"] == Decimal("-44.4")
    assert str(tables["bsuite"].scores["catch"]["dreamer"]) == "0.96"
    assert tables["minecraft"].scores["diamond"]["dreamer"] == Decimal("9.1")
    assert next(method for method in tables["dmlab"].methods if method.column == "impala_1b").steps == "1B"
    assert atari100k_protocols()["uses_early_resets"] == {
        **dict.fromkeys(("simple", "spr", "twm", "dreamer"), "no"),
        **dict.fromkeys(("effmuzero", "iris"), "yes"),
    }


def test_the_misprint_of_the_control_tables_is_kept_and_named() -> None:
    for suite, mean, median in (("dmc", 754, 871), ("dmc_vision", 786, 861)):
        table = paper_tables()[suite]
        assert (table.printed["task_mean"]["dreamer"], table.printed["task_median"]["dreamer"]) == (median, mean)
        assert (table.aggregate("task_mean") or {})["dreamer"] == mean
        assert (table.aggregate("task_median") or {})["dreamer"] == median
    assert {row["decision"] for row in read_rows("misprints")} == {"D-115"}
    assert paper_tables()["atari"].aggregate("gamer_iqm") is None


def test_references_have_the_tasks_of_the_tables() -> None:
    tables = paper_tables()
    assert set(references()["gamer"]) == set(references()["record"]) == set(tables["atari"].scores)
    assert set(tables["atari100k"].scores) < set(tables["atari"].scores)
    assert set(references()["human"]) == set(tables["dmlab"].scores)
    assert set(references()["range"]) == set(tables["procgen"].scores)
    assert set(bsuite_categories()) == set(tables["bsuite"].scores)
    assert set(windows()) | {"bsuite"} == set(tables)
    for pairs in references().values():
        assert all(low < high for low, high in pairs.values())


@pytest.mark.parametrize(("suite", "low", "high"), [("atari", "random", "gamer"), ("atari100k", "random", "human")])
def test_the_references_of_atari_round_to_the_columns_of_the_paper(suite: str, low: str, high: str) -> None:
    for task, row in paper_tables()[suite].scores.items():
        for exact, printed in zip(references()["gamer"][task], (row[low], row[high]), strict=True):
            assert printed is not None
            assert abs(exact - float(printed)) <= 0.5


# The paper's rows give the paper's summaries


def half_unit(printed: Decimal) -> float:
    """Of the last digit that is printed."""
    return 0.5 * 10.0 ** int(printed.as_tuple().exponent)


def recomputed(summary: Summary, table: PaperTable, column: str) -> tuple[float, float, float]:
    """The summary of a column, with its rows as printed, and the lowest and the highest that they may have been before
    they were rounded: every summary rises with every row."""
    scores = {task: number for task, row in table.scores.items() if (number := row[column]) is not None}
    assert len(scores) == len(table.scores)

    def of(sign: int) -> float:
        shifted = [np.array([float(printed) + sign * half_unit(printed)]) for printed in scores.values()]
        return float(summarize(summary, list(scores), shifted))

    return of(0), of(-1), of(1)


PRINTED = [
    (suite, summary, method.column)
    for suite, summaries in SUMMARIES.items()
    for summary in summaries
    if paper_tables()[suite].aggregate(summary.name)
    for method in paper_tables()[suite].methods
]
# What the rows, each rounded to a whole number or a few digits, do not give in the last digit of the summary.
ROUNDED_ROWS = {
    ("atari", "gamer_median", "dreamer"): 832.5,  # the median task is Boxing: 99.69 before rounding gives 829.9
    ("atari", "gamer_mean", "dreamer"): 3381.75,
    ("procgen", "normalized_mean", "ppo"): 42.81,
    ("procgen", "normalized_mean", "ppg"): 64.90,
    ("bsuite", "basic", "ac_rnn"): 0.5867,
    ("bsuite", "credit_assignment", "boot_dqn"): 0.55,
    ("bsuite", "category_mean", "boot_dqn"): 56.49,
}


@pytest.mark.parametrize(("suite", "summary", "column"), PRINTED, ids=lambda value: getattr(value, "name", value))
def test_rows_give_the_summary_that_is_printed(suite: str, summary: Summary, column: str) -> None:
    table = paper_tables()[suite]
    printed = (table.aggregate(summary.name) or {})[column]
    assert printed is not None
    value, low, high = recomputed(summary, table, column)
    within = half_unit(printed) + 1e-9
    assert low - within <= float(printed) <= high + within, "no rows that round to those of the paper give it"
    expected = ROUNDED_ROWS.get((suite, summary.name, column))
    if expected is None:
        assert abs(value - float(printed)) <= within
    else:
        assert value == pytest.approx(expected, abs=0.005)


def test_every_printed_summary_is_recomputed() -> None:
    found = {(suite, summary.name) for suite, summary, _ in PRINTED}
    printed = {(suite, row) for suite, table in paper_tables().items() for row in table.printed}
    assert printed == found
    assert len(PRINTED) == 4 * 6 + 4 + 6 + 2 * 8 + 2 * 2 * 5 + 9 * 6


def test_capping_below_as_well_would_not_give_the_summaries() -> None:
    """D-118: from above only."""
    for suite, name, column, printed in (("atari", "record", "dreamer", 38), ("dmlab", "human", "impala_100m", 31.0)):
        table, pairs = paper_tables()[suite], references()[name]
        shares = [
            (score - pairs[task][0]) / (pairs[task][1] - pairs[task][0]) for task, score in table.column(column).items()
        ]
        digits = 0 if suite == "atari" else 1
        assert round(100 * float(np.mean(np.minimum(shares, 1))), digits) == printed
        assert round(100 * float(np.mean(np.clip(shares, 0, 1))), digits) != printed


# The window


def curves(path: Path, **runs: list[tuple[float, float | None]]) -> Path:
    entries: list[dict[str, Any]] = [
        {"task": f"procgen_{task}", "xs": [step for step, _ in points], "ys": [value for _, value in points]}
        for task, points in runs.items()
    ]
    path.write_bytes(gzip.compress(json.dumps(entries).encode()))
    return path


def test_a_window_is_found_from_curves(tmp_path: Path) -> None:
    """Two rows of ProcGen, whose budget is 50M: bigfish 8.62 and maze 6.85."""
    path = curves(
        tmp_path / "procgen-dreamerv3.json.gz",
        bigfish=[(0, None), (48.9e6, 0.0), (49.0e6, 8.61), (50e6, 8.63)],
        maze=[(49.5e6, 6.849)],
        leaper=[(40e6, 7.05)],
    )
    found = paper_windows.compare(path)
    assert found
    assert (found["equal"], found["most_equal"], found["runs"], found["left_out"]) == (2, 2, 3, 1)
    assert found["windows_with_most"] == [0.02, 0.0215], "further back the 0 of bigfish is inside"
    assert found["summaries"] == {}, "of all tasks only"
    assert paper_windows.compare(curves(tmp_path / "procgen-unknown.json.gz", maze=[(1.0, 1.0)])) is None
    assert paper_windows.compare(curves(tmp_path / "dmlab30-impala_deep.json.gz", maze=[(1.0, 1.0)])) is None


def test_the_recorded_comparison_supports_the_windows() -> None:
    """Of the suites whose curves tell windows apart, every row of Dreamer and of PPO comes out with the one that is
    taken, and with no window that is more than a bin away."""
    text = (Path(__file__).resolve().parent.parent / "docs/results/paper-windows.json").read_text(encoding="utf-8")
    found = {(entry["suite"], entry["method"]): entry for entry in json.loads(text)["curves"]}
    for suite in set(windows()) - {"minecraft"}:
        for method in ("dreamer", "ppo"):
            entry = found[suite, method]
            assert entry["window"] == windows()[suite]
            assert entry["equal"] == entry["most_equal"] == entry["rows"] == len(paper_tables()[suite].scores)
    assert found["minecraft", "dreamer"]["equal"] == 1
