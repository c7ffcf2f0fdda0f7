"""Trains one task with several seeds and both backends, and draws what came of it.

    python -m benchmarks.learning --out FOLDER/NAME -- OPTIONS OF TRAIN

Everything after `--` goes to `train` as it is. Writes NAME.json (command, machine, and the points of every curve) and
NAME.png (returns, and a panel for each of `--metrics`). A run that has come to its end in `--logdir` is not repeated.
"""

import argparse
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FormatStrFormatter

from benchmarks.machine import command
from dreamer_spec.monitoring.curve import BLUE, GRAY, ORANGE
from dreamer_spec.monitoring.logger import iterate_metrics
from dreamer_spec.system.machine import describe

COLORS = {"jax": BLUE, "torch": ORANGE}
EVALUATION, EPISODES = "evaluation/return", "episode/return"
BINS = 50  # points of a curve


def train(backend: str, seed: int, logdir: Path, arguments: list[str]) -> None:
    """One run in a process of its own, on the cores of this thread, unless it is there already.

    Raises:
      RuntimeError: the run failed.
    """
    run = [
        sys.executable,
        "-m",
        "dreamer_spec",
        "--backend",
        backend,
        "--seed",
        str(seed),
        "--logdir",
        str(logdir),
        *arguments,
    ]
    made = logdir / "made.json"
    if (
        (logdir / "curve.png").exists()
        and made.exists()
        and json.loads(made.read_text(encoding="utf-8"))["arguments"] == arguments
    ):
        return
    logdir.mkdir(parents=True, exist_ok=True)
    made.write_text(json.dumps({"arguments": arguments, "machine": describe()}), encoding="utf-8")
    with open(logdir / "output.log", "w", encoding="utf-8") as log:
        result = subprocess.run(run, stdout=log, stderr=log, check=False)
    last = (logdir / "output.log").read_text(encoding="utf-8").strip().splitlines()[-1:]
    print(f"{backend} seed {seed}: {' '.join(last)}", flush=True)
    if result.returncode:
        raise RuntimeError(f"{' '.join(run)}: exit code {result.returncode}; see {logdir / 'output.log'}")


def points(logdir: Path, metrics: list[str]) -> dict[str, Any]:
    """The curves of one run: name -> list of [step, minutes of training, value]; "random": what a random policy gets.

    Evaluations are all there; episodes and metrics are means over equal stretches of the run.
    """
    lines = [line for line in iterate_metrics(logdir / "metrics.jsonl") if line]
    curves = {
        EVALUATION: column(lines, EVALUATION),
        **{name: means(column(lines, name)) for name in (EPISODES, *metrics)},
    }
    rounded = {
        name: [[int(step), round(minutes, 2), float(f"{value:.4g}")] for step, minutes, value in curve]
        for name, curve in curves.items()
    }
    machine = json.loads((logdir / "made.json").read_text(encoding="utf-8"))["machine"]
    return rounded | {
        "random": next((line["random/return"] for line in lines if "random/return" in line), None),
        "machine": machine,
    }


def column(lines: list[dict[str, float]], name: str) -> np.ndarray:
    return np.array([(line["step"], line["seconds"] / 60, line[name]) for line in lines if name in line]).reshape(-1, 3)


def means(curve: np.ndarray) -> np.ndarray:
    """Means over BINS equal stretches of steps; a stretch without points is left out."""
    if not len(curve):
        return curve
    stretch = np.minimum((curve[:, 0] / curve[-1, 0] * BINS).astype(int), BINS - 1)
    return np.array([curve[stretch == index].mean(0) for index in np.unique(stretch)])


def draw(path: Path, title: str, runs: list[dict[str, Any]], metrics: list[str]) -> None:
    """Returns of training episodes of every run (thin) and their mean per backend (thick), evaluations (dots), and the
    other metrics.

    A run that is shorter than its first episode has no returns to draw.
    """
    panels = [name for name in (EPISODES, *metrics) if any(run[name] for run in runs)] or [EPISODES]
    columns, rows = min(len(panels), 3), -(-len(panels) // 3)
    figure = Figure(figsize=(8 if len(panels) == 1 else 4.2 * columns, 4.2 * rows), dpi=130, layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    grid = figure.subplots(rows, columns, squeeze=False).flat
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    for panel, axes in zip(panels, grid, strict=False):
        for run in runs:
            if run[panel]:
                steps, _, values = np.array(run[panel]).T
                label = None if panel == EPISODES else f"{run['backend']}, seed {run['seed']}"
                axes.plot(
                    steps,
                    values,
                    color=COLORS[run["backend"]],
                    alpha=0.35 if panel == EPISODES else 0.8,
                    linewidth=1,
                    label=label,
                )
        if panel == EPISODES:
            draw_returns(axes, runs)
        if panel == panels[0]:
            figure.legend(
                *axes.get_legend_handles_labels(), frameon=False, fontsize=9, loc="outside lower center", ncols=3
            )
        axes.set_ylabel("return" if panel == EPISODES else panel.removeprefix("train/"))
        axes.set_xlabel("environment steps")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", alpha=0.25)
        if panel.startswith("train/loss/") and all(value > 0 for run in runs for _, _, value in run[panel]):
            axes.set_yscale("log")
            for ticks in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
                ticks(FormatStrFormatter("%g"))
    figure.savefig(path)


def draw_returns(axes: Axes, runs: list[dict[str, Any]]) -> None:
    for backend in COLORS:
        group = [run for run in runs if run["backend"] == backend]
        training = [np.array(run[EPISODES]) for run in group if run[EPISODES]]
        if not training:
            continue
        grid = np.linspace(max(curve[0, 0] for curve in training), min(curve[-1, 0] for curve in training), 2 * BINS)
        mean = np.mean([np.interp(grid, curve[:, 0], curve[:, 2]) for curve in training], axis=0)
        seeds = f", mean of {len(group)} seeds" if len(group) > 1 else ""
        axes.plot(grid, mean, color=COLORS[backend], linewidth=2.5, label=f"{backend}, training episodes{seeds}")
        steps, _, values = np.array([point for run in group for point in run[EVALUATION]]).reshape(-1, 3).T
        axes.plot(
            steps,
            values,
            "o",
            color=COLORS[backend],
            markersize=5,
            markeredgecolor="white",
            label=f"{backend}, evaluations",
        )
    random = [run["random"] for run in runs if run["random"] is not None]
    if random:
        axes.axhline(
            np.mean(random), color=GRAY, linestyle="--", linewidth=1.2, label=f"random policy ({np.mean(random):.4g})"
        )
    axes.set_xlim(left=0)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="path of the results without its ending")
    parser.add_argument("--title", default="", help="title of the picture")
    parser.add_argument("--backends", nargs="+", default=["jax", "torch"], choices=list(COLORS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument(
        "--metrics", nargs="*", default=[], help="metrics to draw beside the return, as train/loss/reward"
    )
    parser.add_argument("--jobs", type=int, default=1, help="runs at once, each with its share of the cores")
    parser.add_argument("--logdir", type=Path, default=Path("runs/learning"), help="where the runs are kept")
    split = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    options, arguments = parser.parse_args(sys.argv[1:split]), sys.argv[split + 1 :]

    cores = sorted(os.sched_getaffinity(0))
    if not 1 <= options.jobs <= len(cores):
        parser.error(f"--jobs is {options.jobs}; expected 1 to {len(cores)}, the number of cores")
    shares = [set(cores[job :: options.jobs]) for job in range(options.jobs)]
    free = list(shares)
    cases = [
        (backend, seed, options.logdir / f"{options.out.name}-{backend}-{seed}")
        for seed in options.seeds
        for backend in options.backends
    ]

    # Linux sets affinity for one thread, and processes inherit it from the thread that starts them.
    with ThreadPoolExecutor(options.jobs, initializer=lambda: os.sched_setaffinity(0, free.pop())) as pool:
        list(pool.map(lambda case: train(*case, arguments), cases))
    runs = [{"backend": backend, "seed": seed, **points(logdir, options.metrics)} for backend, seed, logdir in cases]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    report = {"command": command("benchmarks.learning"), "cores_per_run": len(shares[0]), "runs": runs}
    options.out.with_suffix(".json").write_text(json.dumps(report) + "\n", encoding="utf-8")
    draw(options.out.with_suffix(".png"), options.title, runs, options.metrics)
    for run in runs:
        for step, minutes, value in run[EVALUATION][-1:]:
            print(
                f"{run['backend']:6} seed {run['seed']}: {value} after {step:,} steps and "
                f"{minutes} minutes; random {run['random']}"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
