"""`train bsuite LOGDIR... --csv FOLDER`: runs of BSuite as the package's own logger writes them.

The scores of the benchmark are the package's (`summary_analysis.bsuite_score`), over all configurations of an
experiment; most are made of what the package counts beside the rewards, such as regret without the noise, which the
environments give and a run logs ([bsuite] in spec/benchmarks.toml). A logger inside the environments would lose count
when a run is resumed, and count evaluations.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dreamer_spec.cli import Formatter, Parser
from dreamer_spec.disk.files import replacing
from dreamer_spec.errors import UserError, writing
from dreamer_spec.report.runs import RunLog, find_logdirs, read_run
from spec import benchmarks

DESCRIPTION = """Write runs of BSuite as the CSV files of the package bsuite, which scores them (docs/suites.md).

  train bsuite runs/bsuite-* --csv results"""

# Of each decade, the episodes that the package logs.
LOGGED = (1.0, 1.2, 1.4, 1.7, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0)
INFO = "episode/info/bsuite/"


def main(arguments: Sequence[str]) -> int:
    """Writes the files. Returns 0.

    Raises:
      UserError: no run of BSuite, two of one configuration, one without episodes or without the numbers for the scores,
        or a file that cannot be written.
    """
    parser = Parser(prog="train bsuite", description=DESCRIPTION, formatter_class=Formatter, allow_abbrev=False)
    parser.add_argument(
        "logdirs", type=Path, nargs="+", metavar="LOGDIR", help="log directory of a run, or a directory that holds some"
    )
    parser.add_argument("--csv", type=Path, metavar="FOLDER", required=True, help="where the files are written")
    options = parser.parse_args(arguments)
    written: dict[str, Path] = {}
    for logdir in find_logdirs(options.logdirs):
        run = read_run(logdir)
        name = configuration(run)
        if name in written:
            raise UserError(f"{written[name]} and {logdir} are both of bsuite:{name}; one folder holds one of each")
        written[name] = logdir
        rows = rows_of(run)
        _write(options.csv / f"bsuite_id_-_{name.replace('/', '-')}.csv", rows)
        print(f"bsuite:{name}: {rows[-1]['episode']:,} of {episodes_of(name):,} episodes, from {logdir}")
    return 0


def configuration(run: RunLog) -> str:
    """bsuite:catch -> catch/0

    Raises:
      UserError: a run of something else.
    """
    suite, _, name = run.task.partition(":")
    experiment, separator, _ = name.partition("/")
    if suite != "bsuite" or experiment not in benchmarks()["bsuite"]["experiments"]:
        raise UserError(f"{run.logdir} is a run of {run.task or 'an unknown task'}; expected bsuite:EXPERIMENT/NUMBER")
    return name if separator else f"{name}/0"


def episodes_of(name: str) -> int:
    """Episodes that a score of the experiment is made of."""
    count: int = benchmarks()["bsuite"]["experiments"][name.partition("/")[0]]["episodes"]
    return count


def rows_of(run: RunLog) -> list[dict[str, float]]:
    """The rows that the package's logger would have written.

    Raises:
      UserError: no episode has ended, or what the package counts was not logged.
    """
    if "episode/return" not in run.curves:
        raise UserError(f"{run.logdir}: no episode has ended")
    returns, lengths = run.curves["episode/return"].values, run.curves["episode/length"].values
    counted = {
        key.removeprefix(INFO): curve.values
        for key, curve in run.curves.items()
        if key.startswith(INFO) and len(curve.values) == len(returns)
    }
    name = configuration(run)
    best = name.startswith("cartpole")
    if ("raw_return" not in counted) if best else not (counted or name.startswith("discounting_chain")):
        raise UserError(f"{run.logdir} did not log what the package counts; run with --info-metrics 'bsuite/*'")
    return rows(returns, lengths - 1, counted, best, episodes_of(name))


def rows(
    returns: np.ndarray, lengths: np.ndarray, counted: Mapping[str, np.ndarray], best: bool, most: int
) -> list[dict[str, float]]:
    """Sums over the episodes so far, at the episodes that the package logs, up to the last that its scores look at.

    returns, lengths: of each episode, in rewards and steps [n]. counted: what each adds to what the package counts,
    each [n]. best: with the largest `raw_return` so far. most: episodes that a score is made of.
    """
    sums = {"steps": np.cumsum(lengths), "total_return": np.cumsum(returns)}
    sums |= {name: np.cumsum(values) for name, values in counted.items()}
    if best:
        sums["best_episode"] = np.maximum.accumulate(counted["raw_return"])
    chosen = [episode for episode in range(1, min(len(returns), most) + 1) if is_logged(episode)]
    return [
        {"episode": episode, "episode_return": float(returns[episode - 1]), "episode_len": float(lengths[episode - 1])}
        | {name: float(values[episode - 1]) for name, values in sums.items()}
        for episode in chosen
    ]


def is_logged(episode: int) -> bool:
    """Whether the package logs this episode, counted from 1."""
    decade = 10 ** math.floor(math.log10(episode))
    return any(episode == decade * part for part in LOGGED)


def _write(path: Path, rows: Sequence[Mapping[str, float]]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            file.write(text.getvalue().encode())
