"""Learning curves of every task as one picture: the mean over runs, with one standard deviation around it."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from dreamer_spec.disk.files import replacing
from dreamer_spec.errors import writing
from dreamer_spec.monitoring.curve import BLUE, GRAY
from dreamer_spec.report.runs import Curve, RunLog
from dreamer_spec.scoring.protocol import EPISODES, Protocol, RunScore
from spec.paper_scores import paper_tables

BINS = 50
COLUMNS = 6  # of pictures beside each other


def draw(scores: Sequence[RunScore], protocol: Protocol, path: Path) -> None:
    """Draws a file in the format of its name, with a picture for each task and Dreamer's score in the paper as a line.

    Raises:
      UserError: the disk refuses it.
    """
    tasks = list(dict.fromkeys((score.suite, score.task, score.run.task) for score in scores))
    columns = min(COLUMNS, len(tasks))
    rows = math.ceil(len(tasks) / columns)
    figure = Figure(figsize=(3.2 * columns + 0.4, 2.4 * rows + 0.4), dpi=150, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes, (suite, task, full) in zip(grid.flat, tasks, strict=False):
        runs = [score.run for score in scores if score.run.task == full]
        _draw_task(axes, suite, task, runs, EPISODES[protocol.episodes])
    for axes in grid.flat[len(tasks) :]:
        axes.set_axis_off()
    with writing(path), replacing(path) as file:
        figure.savefig(file, format=path.suffix[1:])


def _draw_task(axes: Axes, suite: str, task: str, runs: Sequence[RunLog], metric: str) -> None:
    """Dreamer's score in the paper is a line but in BSuite, whose scores are no returns."""
    end = max(max(run.step, run.planned or 0) for run in runs)
    steps, mean, deviation = mean_curve([run.curves[metric] for run in runs if metric in run.curves], end)
    axes.plot(steps, mean, color=BLUE, linewidth=1.5)
    axes.fill_between(steps, mean - deviation, mean + deviation, color=BLUE, alpha=0.2, linewidth=0)
    if suite not in ("", "bsuite") and (score := paper_tables()[suite].scores[task]["dreamer"]) is not None:
        axes.axhline(float(score), color=GRAY, linestyle="--", linewidth=1)
    axes.set_title(runs[0].task, fontsize=9)
    axes.set_xlim(0, max(end, 1))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.tick_params(labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)


def mean_curve(curves: Sequence[Curve], end: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middle of each bin of the steps 0 to `end`, mean over runs of their means in it, and the standard deviation
    (n - 1) of these; 0 for a single run. A bin in which no run has a return is left out: [n] each."""
    sums, counts = np.zeros((len(curves), BINS)), np.zeros((len(curves), BINS))
    for row, curve in enumerate(curves):
        finite = np.isfinite(curve.values)
        index = np.minimum((curve.steps[finite] / max(end, 1) * BINS).astype(int), BINS - 1)
        np.add.at(sums[row], index, curve.values[finite])
        np.add.at(counts[row], index, 1)
    runs = np.sum(counts > 0, axis=0)
    kept = runs > 0
    has = counts[:, kept] > 0
    means = np.divide(sums[:, kept], counts[:, kept], out=np.zeros_like(sums[:, kept]), where=has)
    mean = np.sum(means, axis=0) / runs[kept]
    squares = np.sum(np.where(has, (means - mean) ** 2, 0.0), axis=0)
    deviation = np.sqrt(squares / np.maximum(runs[kept] - 1, 1))
    return ((np.arange(BINS) + 0.5) / BINS * max(end, 1))[kept], mean, deviation
