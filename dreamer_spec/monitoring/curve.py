"""The learning curve of a run as a picture."""

from array import array
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from dreamer_spec.disk.files import replacing
from dreamer_spec.errors import writing
from dreamer_spec.monitoring.logger import iterate_metrics

BLUE, ORANGE, GRAY = "#2563eb", "#ea580c", "#6b7280"
EPISODE, EVALUATION, ERROR = "episode/return", "evaluation/return", "evaluation/return_standard_error"


def draw_curve(logdir: Path, title: str, random_return: float | None) -> Path:
    """Draws LOGDIR/curve.png from LOGDIR/metrics.jsonl: training episodes, their running mean, evaluations, the random
    policy.

    Raises:
      UserError: the disk refuses it.
    """
    columns = _columns(logdir / "metrics.jsonl")
    (steps, returns), (eval_steps, eval_means), (error_steps, errors) = (
        columns[name] for name in (EPISODE, EVALUATION, ERROR)
    )
    known = dict(zip(error_steps, errors, strict=True))

    figure = Figure(figsize=(8, 4.5), dpi=150, layout="constrained")
    axes = figure.subplots()
    if len(steps):
        axes.plot(
            steps, returns, ".", color=BLUE, alpha=0.25, markersize=4, markeredgewidth=0, label="training episodes"
        )
        axes.plot(steps, _running_mean(returns), color=BLUE, linewidth=2, label="training, running mean")
    if len(eval_steps):
        axes.errorbar(
            eval_steps,
            eval_means,
            yerr=[known.get(step, 0.0) for step in eval_steps],
            color=ORANGE,
            marker="o",
            markersize=5,
            linewidth=1.5,
            capsize=3,
            label="evaluation ± s.e.",
        )
    if random_return is not None:
        axes.axhline(
            random_return, color=GRAY, linestyle="--", linewidth=1.2, label=f"random policy ({random_return:.4g})"
        )
    axes.set_title(title, loc="left", fontsize=11)
    axes.set_xlabel("environment steps")
    axes.set_ylabel("episode return")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlim(left=0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", alpha=0.25)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False, fontsize=9)
    path = logdir / "curve.png"
    with writing(path), replacing(path) as file:
        figure.savefig(file, format="png")
    return path


def _columns(path: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Steps and values of what is drawn. The lines of a long run do not fit in memory."""
    columns = {name: (array("d"), array("d")) for name in (EPISODE, EVALUATION, ERROR)}
    for line in iterate_metrics(path):
        for name, (steps, values) in columns.items():
            if line and name in line:
                steps.append(line["step"])
                values.append(line[name])
    return {name: (np.array(steps), np.array(values)) for name, (steps, values) in columns.items()}


def _running_mean(values: np.ndarray) -> np.ndarray:
    """Over a tenth of the episodes, centred; near the ends over what there is."""
    half = max(1, len(values) // 20)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(len(values))
    low, high = np.maximum(index - half, 0), np.minimum(index + half + 1, len(values))
    return (sums[high] - sums[low]) / (high - low)
