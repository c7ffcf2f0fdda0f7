"""`train bsuite LOGDIR... --csv FOLDER`: runs of BSuite as the package's own logger writes them.

For the package's own analysis and plots; `train score` has the same scores without it. They are made of what the
package counts beside the rewards, such as regret without the noise, which the environments give and a run logs
([bsuite] in spec/benchmarks.toml). A logger inside the environments would lose count when a run is resumed, and count
evaluations.
"""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dreamer_spec.cli import Formatter, Parser
from dreamer_spec.disk.files import replacing
from dreamer_spec.errors import UserError, writing
from dreamer_spec.report.runs import RunLog, find_logdirs, read_run
from dreamer_spec.scoring import bsuite

DESCRIPTION = """Write runs of BSuite as the CSV files of the package bsuite, for its own analysis (docs/suites.md).

  train bsuite runs/bsuite-* --csv results"""


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
        most = bsuite.episodes_of(name.partition("/")[0])
        print(f"bsuite:{name}: {rows[-1]['episode']:,} of {most:,} episodes, from {logdir}")
    return 0


def configuration(run: RunLog) -> str:
    """bsuite:catch -> catch/0

    Raises:
      UserError: a run of something else.
    """
    found = bsuite.configuration(run.task)
    if found is None:
        raise UserError(f"{run.logdir} is a run of {run.task or 'an unknown task'}; expected bsuite:EXPERIMENT/NUMBER")
    return f"{found[0]}/{found[1]}"


def rows_of(run: RunLog) -> list[dict[str, float]]:
    """The rows that the package's logger would have written.

    Raises:
      UserError: no episode has ended, or what the package counts was not logged.
    """
    if "episode/return" not in run.curves:
        raise UserError(f"{run.logdir}: no episode has ended")
    returns, lengths = run.curves["episode/return"].values, run.curves["episode/length"].values
    counted = bsuite.counted_by_the_package(run)
    experiment = configuration(run).partition("/")[0]
    best = experiment.startswith("cartpole")
    if bsuite.needed(experiment) not in {*counted, ""}:
        raise UserError(f"{run.logdir} did not log what the package counts; run with --info-metrics 'bsuite/*'")
    return rows(returns, lengths - 1, counted, best, bsuite.episodes_of(experiment))


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
    chosen = [episode for episode in range(1, min(len(returns), most) + 1) if bsuite.is_logged(episode)]
    return [
        {"episode": episode, "episode_return": float(returns[episode - 1]), "episode_len": float(lengths[episode - 1])}
        | {name: float(values[episode - 1]) for name, values in sums.items()}
        for episode in chosen
    ]


def _write(path: Path, rows: Sequence[Mapping[str, float]]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            file.write(text.getvalue().encode())
