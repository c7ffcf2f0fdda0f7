"""Numbers about many runs of many tasks, and how sure they are.

Scores are a list over tasks of arrays [..., runs of the task]; leading axes are resamples.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from dreamer_spec.scoring.suites import CATEGORIES, Summary
from spec.paper_scores import bsuite_categories

LEVEL = 0.95
RESAMPLES = 10_000
SEED = 0  # of the generator of the resamples: the same runs have the same interval

Scores = Sequence[np.ndarray]


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A number and its interval, None where no task has more than one run."""

    value: float
    interval: tuple[float, float] | None


def estimate(summary: Summary, tasks: Sequence[str], scores: Scores) -> Estimate:
    """A summary of returns, with its interval. scores: [runs] of each task."""
    return Estimate(
        float(summarize(summary, tasks, scores)),
        bootstrap(lambda drawn: summarize(summary, tasks, drawn), scores),
    )


def summarize(summary: Summary, tasks: Sequence[str], scores: Scores) -> np.ndarray:
    """[...]: mean and median are over tasks, of the normalized mean of each task's runs, as in the paper (D-118); the
    interquartile mean is over all runs. At least one task must count for the summary."""
    counting = [index for index, task in enumerate(tasks) if summary.counts(task)]
    tasks, scores = [tasks[index] for index in counting], [scores[index] for index in counting]
    if summary.statistic == "iqm":
        return interquartile_mean(summary.normalized(tasks, scores))
    of_tasks = np.stack(summary.normalized(tasks, [np.mean(runs, axis=-1) for runs in scores]), axis=-1)
    if summary.statistic == "category_mean":
        return category_mean(tasks, of_tasks)
    return np.mean(of_tasks, axis=-1) if summary.statistic == "mean" else np.median(of_tasks, axis=-1)


def category_mean(tasks: Sequence[str], values: np.ndarray) -> np.ndarray:
    """The mean over BSuite's categories of the mean of the experiments in each, those without any left out:
    [..., tasks] -> [...]."""
    members = [[name in bsuite_categories()[task] for task in tasks] for name in CATEGORIES]
    return np.mean([np.mean(values[..., inside], axis=-1) for inside in members if any(inside)], axis=0)


def interquartile_mean(scores: Scores) -> np.ndarray:
    """[...]: the mean of the middle half of all runs. Each task weighs the same, however many runs it has, and a run
    that lies on the border of the half counts with the part of its weight that is inside."""
    weights = np.concatenate([np.full(runs.shape[-1], 1 / (len(scores) * runs.shape[-1])) for runs in scores])
    values = np.concatenate(list(scores), axis=-1)
    order = np.argsort(values, axis=-1)
    ends = np.cumsum(weights[order], axis=-1)
    inside = np.minimum(ends, 0.75) - np.maximum(ends - weights[order], 0.25)
    return np.sum(np.maximum(inside, 0) * np.take_along_axis(values, order, axis=-1), axis=-1) / 0.5


def bootstrap(
    statistic: Callable[[Scores], np.ndarray],
    scores: Scores,
    level: float = LEVEL,
    resamples: int = RESAMPLES,
    seed: int = SEED,
) -> tuple[float, float] | None:
    """The percentile interval of a statistic under the stratified bootstrap: every resample draws, for each task, as
    many of its runs as there are, with replacement. It holds for these tasks and for other seeds of them.

    Returns None where no task has two runs: nothing is known about other seeds.
    """
    if all(runs.shape[-1] < 2 for runs in scores):
        return None
    random = np.random.default_rng(seed)
    drawn = [runs[random.integers(len(runs), size=(resamples, len(runs)))] for runs in scores]
    low, high = np.quantile(statistic(drawn), [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)
