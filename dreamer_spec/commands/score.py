"""`train score LOGDIR...`: final scores of runs by a stated protocol, beside the paper's."""

import argparse
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

from dreamer_spec.cli import Formatter, Parser
from dreamer_spec.disk.files import replacing, require_place
from dreamer_spec.errors import UserError, writing
from dreamer_spec.report.runs import find_logdirs, read_run
from dreamer_spec.scoring import cells, files
from dreamer_spec.scoring.protocol import EPISODES, Protocol, RunScore, score_run
from dreamer_spec.scoring.statement import Statement, statement
from dreamer_spec.scoring.tables import SuiteScore, suite_scores

DESCRIPTION = """Final scores of runs: the mean return of the episodes at the end of the budget, normalized and
summarized as the paper does it, with intervals, beside the paper's numbers. docs/scores.md describes the protocol.

  train score runs/*
  train score runs/study --markdown scores.md --json scores.json --plot curves.png"""

MOST_LOGDIRS = 4  # that are named in the statement

WRITERS: dict[str, Callable[[Sequence[SuiteScore], Sequence[RunScore], Statement], str]] = {
    "markdown": files.markdown,
    "csv": files.as_csv,
    "json": files.as_json,
}


def main(arguments: Sequence[str]) -> int:
    """Prints the scores and writes the files that were asked for. Returns 0.

    Raises:
      UserError: no run, none of which an episode has ended, or a file that cannot be written.
    """
    options = _parser().parse_args(arguments)
    asked = {name: path for name in (*WRITERS, "plot") if (path := getattr(options, name))}
    for path in asked.values():
        with writing(path):
            require_place(path)
    protocol = Protocol(options.window, options.episodes)
    scores = [score_run(read_run(logdir), protocol) for logdir in find_logdirs(options.logdirs)]
    if all(score.score is None for score in scores):
        raise UserError(f"no run has a score: {cells.remarks([], scores)[0]}")
    about = statement(scores, protocol, _command(arguments, options.logdirs))
    suites = suite_scores(scores)
    _print(Console(highlight=False, markup=False), suites, scores, about)
    for name, path in asked.items():
        if name == "plot":
            from dreamer_spec.scoring.plot import draw  # Only now: Matplotlib is for those who want a picture.

            draw(scores, protocol, path)
        else:
            with writing(path), replacing(path) as file:
                file.write(WRITERS[name](suites, scores, about).encode("utf-8", "replace"))
        print(f"{path}: written")
    return 0


def _command(arguments: Sequence[str], logdirs: Sequence[Path]) -> str:
    """As it was typed; many log directories are counted."""
    if len(logdirs) <= MOST_LOGDIRS:
        return shlex.join(["train", "score", *arguments])
    options = [argument for argument in arguments if Path(argument) not in logdirs]
    return f"{shlex.join(['train', 'score', 'LOGDIR...', *options])} with {len(logdirs):,} log directories"


def _parser() -> Parser:
    parser = Parser(prog="train score", description=DESCRIPTION, formatter_class=Formatter, allow_abbrev=False)
    parser.add_argument(
        "logdirs", type=Path, nargs="+", metavar="LOGDIR", help="log directory of a run, or a directory that holds some"
    )
    parser.add_argument(
        "--window",
        type=_share,
        metavar="SHARE",
        help="of the budget, at its end, whose episodes count (default: that of the paper's table for each suite, "
        "0.01 to 0.05, and 0.05 for other tasks)",
    )
    parser.add_argument(
        "--episodes", choices=EPISODES, default="training", help="which returns count (default training)"
    )
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write tables and statement for a page")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write a row for each task and summary")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything, every run included")
    parser.add_argument(
        "--plot", type=_picture, metavar="FILE", help="draw the learning curves of every task: .png, .pdf or .svg"
    )
    return parser


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value <= 1:
        raise argparse.ArgumentTypeError(f"{text!r:.40} is not a share of the budget, above 0 and at most 1")
    return value


def _picture(text: str) -> Path:
    if Path(text).suffix not in (".png", ".pdf", ".svg"):
        raise argparse.ArgumentTypeError(f"{text!r:.80} names no picture; expected .png, .pdf or .svg")
    return Path(text)


def _print(console: Console, suites: Sequence[SuiteScore], scores: Sequence[RunScore], about: Statement) -> None:
    for suite in suites:
        console.print(f"\n{cells.title(suite)}", style="bold", soft_wrap=True)
        for found in (cells.task_cells(suite), cells.summary_cells(suite)):
            if found.rows:
                console.print(_table(found))
        if cells.origin(suite):
            console.print(cells.origin(suite), soft_wrap=True)
    console.print()
    for topic, said in cells.statement_lines(about):
        console.print(f"{topic}: {'; '.join(said)}", soft_wrap=True)
    for remark in cells.remarks(suites, scores):
        console.print(f"Remark: {remark}", soft_wrap=True)


def _table(found: cells.Cells) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 0, 0, 1), pad_edge=False)  # 80 columns are narrow
    for number, column in enumerate(found.header):
        table.add_column(column, justify="right" if number else "left", overflow="fold", no_wrap=not number)
    for row in found.rows:
        table.add_row(*row)
    return table
