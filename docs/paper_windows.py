"""Which episodes the scores of the paper are the means of: its rows against the learning curves that its authors have
released.

  python -m docs.paper_windows FOLDER --out docs/results/paper-windows.json

FOLDER holds files SUITE-METHOD.json.gz, as the folder `scores` of danijar/dreamerv3: lists of runs with `task`, `xs`
(environment steps) and `ys` (returns of episodes, or of bins of some). For every window, a share of the budget at its
end, the score of a task is computed as the mean over runs of their mean in the window; a run without a return there is
left out. Counted are the rows of the paper that come out in every printed digit.
"""

import argparse
import dataclasses
import gzip
import json
import sys
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from dreamer_spec.scoring.statistics import summarize
from dreamer_spec.scoring.suites import SUMMARIES
from spec import benchmarks
from spec.paper_scores import paper_tables, windows

SUITES = {"atari57": "atari", "dmlab30": "dmlab", "minecraft_diamond": "minecraft"}  # others have our names
METHODS = {"dreamerv3": "dreamer", "ppo_fixhp": "ppo", "drqv2": "drq_v2"}  # others have the paper's
TRIED = tuple(round(0.0005 * step, 4) for step in range(1, 241))  # up to 12 % of the budget
WHOLE = 0.99  # of the budget: curves that end before lack their last bin
COMPLETE = 0.95  # of the budget: shorter runs are no runs of Minecraft's row (D-119)


@dataclasses.dataclass(frozen=True)
class Run:
    """task: as in the paper's table. steps, returns: [n], finite."""

    task: str
    steps: np.ndarray
    returns: np.ndarray


def read_curves(path: Path, suite: str) -> list[Run]:
    """The runs of a file whose tasks are in the paper's table."""
    known = {name.replace("-", "_"): name for name in paper_tables()[suite].scores}
    runs = []
    for entry in json.loads(gzip.decompress(path.read_bytes())):
        name = entry["task"].partition("_")[2]
        name = name.removesuffix("_train") + "_test" if name.endswith("_train") else name
        returns = np.array([np.nan if value is None else value for value in entry["ys"]], float)
        finite = np.isfinite(returns)
        if name in known:
            runs.append(Run(known[name], np.array(entry["xs"], float)[finite], returns[finite]))
    return runs


def end_of(runs: Sequence[Run], budget: float) -> float:
    """Where the window ends: at the budget; or at the last point of the curves, if all of a file lack the last bin, as
    those of Dreamer in dmc do, which end at 490,000 of 500,000 steps."""
    last = max(float(run.steps[-1]) for run in runs)
    return last if last < WHOLE * budget else budget


def scores(runs: Sequence[Run], budget: float, window: float) -> dict[str, list[float]]:
    """Task -> the score of each run that has a return in the window."""
    found: dict[str, list[float]] = {}
    start = end_of(runs, budget) - budget * window
    for run in runs:
        inside = run.steps >= start - 1e-6
        if inside.any():
            found.setdefault(run.task, []).append(float(np.mean(run.returns[inside])))
    return found


def equal_rows(found: dict[str, list[float]], suite: str, column: str) -> int:
    """How many rows come out as they are printed: within half a unit of the last digit."""
    return sum(
        is_printed(float(np.mean(values)), paper_tables()[suite].scores[task][column]) for task, values in found.items()
    )


def is_printed(value: float, printed: Decimal | None) -> bool:
    """Whether a value rounds to what is printed."""
    if printed is None:
        return False
    return abs(value - float(printed)) <= 0.5 * 10.0 ** int(printed.as_tuple().exponent) * (1 + 1e-9)


def compare(path: Path) -> dict[str, Any] | None:
    """What a file says about the window; None if the paper has no such column."""
    name, _, method = path.name.removesuffix(".json.gz").rpartition("-")
    suite, column = SUITES.get(name, name), METHODS.get(method, method)
    if suite not in windows() or column not in [known.column for known in paper_tables()[suite].methods]:
        return None
    budget, table = benchmarks()[suite]["steps"], paper_tables()[suite]
    runs = read_curves(path, suite)
    if suite == "minecraft":
        runs = [run for run in runs if run.steps[-1] >= COMPLETE * budget]
    counts = {window: equal_rows(scores(runs, budget, window), suite, column) for window in TRIED}
    most = max(counts.values())
    taken = scores(runs, budget, windows()[suite])
    tasks = [task for task in table.scores if task in taken]
    summaries = {
        summary.name: round(float(summarize(summary, tasks, [np.array(taken[task]) for task in tasks])), 3)
        for summary in SUMMARIES[suite]
        if table.aggregate(summary.name)
    }
    return {
        "suite": suite,
        "method": column,
        "runs": len(runs),
        "left_out": len(runs) - sum(map(len, taken.values())),
        "rows": len(table.scores),
        "end": end_of(runs, budget),
        "window": windows()[suite],
        "equal": equal_rows(taken, suite, column),
        "most_equal": most,
        "windows_with_most": [min(w for w in TRIED if counts[w] == most), max(w for w in TRIED if counts[w] == most)],
        "summaries": summaries if len(tasks) == len(table.scores) else {},
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints a line for each file, and writes all of it. Returns 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the numbers as JSON")
    options = parser.parse_args(arguments)
    results = [found for path in sorted(options.folder.glob("*.json.gz")) if (found := compare(path))]
    for found in results:
        print(", ".join(f"{name} {value}" for name, value in found.items()))
    if options.out:
        options.out.write_text(json.dumps({"curves": results}, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
