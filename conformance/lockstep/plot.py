"""A lockstep as a picture: deviation over steps, a line for each group, with gaps where it is 0."""

import math
from pathlib import Path
from typing import Any

from conformance.errors import UserError
from conformance.lockstep.bounds import bound_of_part
from conformance.lockstep.drift import GROUPS

STYLES = {
    **{
        group: (color, "--")
        for group, color in zip(GROUPS[1:6], ("#737373", "#111111", "#0d9488", "#9333ea", "#d946ef"), strict=True)
    },
    "encoder": ("#1d4ed8", "-"),
    "rssm": ("#0284c7", "-"),
    "decoder": ("#38bdf8", "-"),
    "reward": ("#15803d", "-"),
    "continue": ("#84cc16", "-"),
    "actor": ("#dc2626", "-"),
    "critic": ("#ea580c", "-"),
    "slow critic": ("#f59e0b", "-"),
}
BOUNDS = {"encoder": "world model", "critic": "critic", "actor": "actor"}
TITLES = {"free": "running free", "one step": "one step from a common state"}
LARGEST = 1e6  # of the axis, for what has no size


def figure_class() -> Any:
    """matplotlib's, which only pictures need.

    Raises:
      UserError: it is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UserError("pictures need matplotlib; install it with: pip install matplotlib") from error
    return Figure


def draw(path: Path, found: dict[str, Any], title: str, bounded: bool) -> None:
    """A row for each member, a column for each mode. found: of `report`."""
    rows = found["comparisons"]
    figure = figure_class()(figsize=(12, 0.9 + 4.1 * len(rows)), dpi=100, layout="constrained")
    grid = figure.subplots(len(rows), len(TITLES), sharex=True, sharey=True, squeeze=False)
    for line, (name, modes) in zip(grid, rows.items(), strict=True):
        for axes, (mode, comparison) in zip(line, modes.items(), strict=True):
            parted = f"; the samples part at step {comparison['parted']}" if comparison["parted"] else ""
            axes.set_title(f"{name} against {found['baseline']}, {TITLES[mode]}{parted}", loc="left", fontsize=10)
            _draw_curves(axes, found["steps"], comparison["curves"])
            if bounded:
                _draw_bounds(axes, found["steps"], mode)
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.grid(alpha=0.2)
            axes.spines[["top", "right"]].set_visible(False)
        line[0].set_ylabel("deviation, share of the way")
    for axes in grid[-1]:
        axes.set_xlabel("train step")
    figure.suptitle(title, x=0.01, ha="left", fontsize=12)
    figure.legend(*grid[0][1].get_legend_handles_labels(), loc="outside right center", frameon=False, fontsize=9)
    figure.savefig(path)


def _draw_curves(axes: Any, steps: list[int], curves: dict[str, list[float | None]]) -> None:
    for group, (color, style) in STYLES.items():
        values = [LARGEST if value is None else min(value, LARGEST) or math.nan for value in curves[group]]
        axes.plot(
            steps[: len(values)],
            values,
            style,
            color=color,
            linewidth=1.4,
            marker="." if len(values) < 3 else "",
            label=group,
        )


def _draw_bounds(axes: Any, steps: list[int], mode: str) -> None:
    for part, name in BOUNDS.items():
        allowed = [bound_of_part(part, step if mode == "free" else 1) for step in steps]
        axes.plot(steps, allowed, ":", color="#525252", linewidth=1.2)
        axes.annotate(
            f"bound, {name}", (1, allowed[0]), xytext=(0, 3), textcoords="offset points", fontsize=8, color="#525252"
        )
