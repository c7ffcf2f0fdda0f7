"""The learning curve of a run as a picture."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from train.logger import read_metrics

BLUE, ORANGE, GRAY = "#2563eb", "#ea580c", "#6b7280"


def draw_curve(logdir: Path, title: str, random_return: float | None) -> Path:
    """Draws LOGDIR/curve.png from LOGDIR/metrics.jsonl: training episodes, their running mean, evaluations, the random policy."""
    lines = read_metrics(logdir / "metrics.jsonl")
    steps, returns = _column(lines, "episode/return")
    eval_steps, eval_means = _column(lines, "evaluation/return")
    _, eval_errors = _column(lines, "evaluation/return_standard_error")

    figure = Figure(figsize=(8, 4.5), dpi=150, layout="constrained")
    axes = figure.subplots()
    if len(steps):
        axes.plot(steps, returns, ".", color=BLUE, alpha=0.25, markersize=4, markeredgewidth=0, label="training episodes")
        axes.plot(steps, _running_mean(returns), color=BLUE, linewidth=2, label="training, running mean")
    if len(eval_steps):
        axes.errorbar(
            eval_steps,
            eval_means,
            yerr=eval_errors,
            color=ORANGE,
            marker="o",
            markersize=5,
            linewidth=1.5,
            capsize=3,
            label="evaluation ± s.e.",
        )
    if random_return is not None:
        axes.axhline(random_return, color=GRAY, linestyle="--", linewidth=1.2, label=f"random policy ({random_return:.4g})")
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
    figure.savefig(path)
    return path


def _column(lines: list[dict[str, float]], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps and values of the lines that hold the name."""
    pairs = [(line["step"], line[name]) for line in lines if name in line]
    return np.array([step for step, _ in pairs]), np.array([value for _, value in pairs])


def _running_mean(values: np.ndarray) -> np.ndarray:
    """Over a tenth of the episodes, centred; near the ends over what there is."""
    half = max(1, len(values) // 20)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(len(values))
    low, high = np.maximum(index - half, 0), np.minimum(index + half + 1, len(values))
    return (sums[high] - sums[low]) / (high - low)
