"""The scores of many runs by suite: a row for each task, summaries of them, and the paper's numbers for the same."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dreamer_spec.report.runs import LABELS, RunLog, differing, settings, show
from dreamer_spec.scoring import bsuite
from dreamer_spec.scoring.protocol import RunScore
from dreamer_spec.scoring.statistics import Estimate, estimate, summarize
from dreamer_spec.scoring.suites import SUMMARIES, Summary, tasks_of
from spec import benchmarks
from spec.paper_scores import Method, PaperTable, paper_tables

Paper = dict[str, float | None]  # column of the paper's table -> number, None for a missing entry


@dataclasses.dataclass(frozen=True)
class TaskScore:
    """Of one task. runs: those that have a score. values: their scores; of BSuite a score for each seed, made of all
    configurations with it. deviation: the standard deviation of these (n - 1), None for a single one. normalized: in
    per cent, None if the suite is not normalized."""

    task: str
    runs: tuple[RunScore, ...]
    values: np.ndarray
    score: float
    deviation: float | None
    normalized: float | None
    paper: Paper


@dataclasses.dataclass(frozen=True)
class SummaryScore:
    """A summary of all tasks of a suite that were found. paper: what the paper prints for it; if not all of its tasks
    were found, the same summary of its rows for those that were. Empty for the interquartile mean, which needs runs."""

    summary: Summary
    estimate: Estimate
    paper: Paper


@dataclasses.dataclass(frozen=True)
class SuiteScore:
    """suite: "" for tasks without one. of: how many tasks the suite has. methods: the columns of the paper. notes: in
    what the runs differ from each other and from the paper."""

    suite: str
    of: int
    methods: tuple[Method, ...]
    tasks: tuple[TaskScore, ...]
    summaries: tuple[SummaryScore, ...]
    notes: tuple[str, ...]

    @property
    def is_complete(self) -> bool:
        return len(self.tasks) == self.of


def suite_scores(scores: Sequence[RunScore]) -> list[SuiteScore]:
    """Suites in the order of the paper, then all tasks without one, in that of the runs."""
    known = [suite for suite in SUMMARIES if any(score.suite == suite for score in scores)]
    found = [_suite(suite, [score for score in scores if score.suite == suite]) for suite in known]
    if others := [score for score in scores if not score.suite]:
        found.append(_others(others))
    return found


def _suite(suite: str, scores: Sequence[RunScore]) -> SuiteScore:
    table = paper_tables()[suite]
    names = tasks_of(table, [score.task for score in scores if score.score is not None])
    first = SUMMARIES[suite][0] if SUMMARIES[suite] and SUMMARIES[suite][0].reference else None
    tasks = tuple(_task(name, scores, first, _floats(table.scores[name])) for name in names)
    complete = len(names) == len(table.scores)
    counting = [summary for summary in SUMMARIES[suite] if any(map(summary.counts, names))]
    summaries = tuple(_summary(summary, table, tasks, complete) for summary in counting)
    notes = [*_differences([score.run for score in scores]), *_against_the_paper(suite, scores), *_single(tasks)]
    notes += _configurations(tasks) if suite == "bsuite" else []
    return SuiteScore(suite, len(table.scores), table.methods, tasks, summaries, tuple(notes))


def _others(scores: Sequence[RunScore]) -> SuiteScore:
    names = list(dict.fromkeys(score.task for score in scores))
    found = [name for name in names if any(score.score is not None for score in scores if score.task == name)]
    notes = []
    for name in names:
        runs = [score.run for score in scores if score.task == name]
        notes += [f"{name}: {note}" for note in _differences(runs)]
    return SuiteScore("", len(names), (), tuple(_task(name, scores, None, {}) for name in found), (), tuple(notes))


def _task(name: str, scores: Sequence[RunScore], summary: Summary | None, paper: Paper) -> TaskScore:
    runs = tuple(score for score in scores if score.task == name and score.score is not None)
    values = _of_bsuite(name, runs) if runs[0].suite == "bsuite" else np.array([run.score for run in runs], float)
    mean = np.mean(values)
    normalized = float(summary.normalized([name], [mean])[0]) if summary else None
    deviation = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return TaskScore(name, runs, values, float(mean), deviation, normalized, paper)


def _by_seed(runs: Sequence[RunScore]) -> dict[str, dict[int, bsuite.Episodes]]:
    """Seed -> number of a configuration -> its episodes; of runs that are there twice the first."""
    found: dict[str, dict[int, bsuite.Episodes]] = {}
    for run in runs:
        episodes = bsuite.scored(run.run)
        assert episodes is not None, "it has a score"
        found.setdefault(show(run.run.seed), {}).setdefault(episodes.number, episodes)
    return found


def _of_bsuite(experiment: str, runs: Sequence[RunScore]) -> np.ndarray:
    """[n]: the score of each seed, made of all configurations that were run with it."""
    return np.array([bsuite.score(experiment, list(found.values())) for found in _by_seed(runs).values()])


def _configurations(tasks: Sequence[TaskScore]) -> list[str]:
    """Experiments of which not all configurations were run, at all or with some seed."""
    known = benchmarks()["bsuite"]["experiments"]
    found = {task.task: len({bsuite.configuration(run.run.task) for run in task.runs}) for task in tasks}
    partly = [
        f"{name} {count} of {known[name]['configurations']}"
        for name, count in found.items()
        if count < known[name]["configurations"]
    ]
    notes = [f"not all configurations were run: {', '.join(partly)}"] if partly else []
    unlike = [task.task for task in tasks if len({frozenset(one) for one in _by_seed(task.runs).values()}) > 1]
    return notes + ([f"not every seed has the same configurations: {', '.join(unlike)}"] if unlike else [])


def _summary(summary: Summary, table: PaperTable, tasks: Sequence[TaskScore], complete: bool) -> SummaryScore:
    names = [task.task for task in tasks]
    found = estimate(summary, names, [task.values for task in tasks])
    if summary.statistic == "iqm":
        return SummaryScore(summary, found, {})
    printed = table.aggregate(summary.name) if complete else None
    return SummaryScore(summary, found, _floats(printed) if printed else of_paper(summary, table, names))


def of_paper(summary: Summary, table: PaperTable, tasks: Sequence[str]) -> Paper:
    """The summary of the paper's rows for some tasks, by column."""

    def of(column: str) -> float | None:
        numbers = [table.scores[task][column] for task in tasks]
        if None in numbers:
            return None
        return float(summarize(summary, tasks, [np.array([number], float) for number in numbers]))

    return {method.column: of(method.column) for method in table.methods}


def _floats(row: Mapping[str, Any]) -> Paper:
    return {column: None if number is None else float(number) for column, number in row.items()}


def _differences(runs: Sequence[RunLog]) -> list[str]:
    """In what runs that are taken together differ, and seeds that are there more than once."""
    budget = [] if all(bsuite.configuration(run.task) for run in runs) else ["steps"]  # in BSuite each task's own
    shown = [
        {name: value for name, value in settings(run).items() if name in (*LABELS, *budget, *run.hyperparameters)}
        for run in runs
    ]
    notes = []
    for name in differing(shown):
        values = dict.fromkeys(show(configuration[name]) for configuration in shown if name in configuration)
        notes.append(f"the runs differ in {name}: {', '.join(value or 'none' for value in values)}")
    pairs = [(run.task, run.seed) for run in runs]
    twice = [f"{task} with seed {seed}" for task, seed in dict.fromkeys(pairs) if pairs.count((task, seed)) > 1]
    counted = ", of which the first counts" if not budget else ""
    return notes + ([f"more than one run of {', '.join(twice)}{counted}"] if twice else [])


def _single(tasks: Sequence[TaskScore]) -> list[str]:
    """Tasks with one run among others, of which the intervals cannot know how much they vary."""
    single = [task.task for task in tasks if len(task.runs) == 1]
    if not single or len(single) == len(tasks):
        return []
    return [f"the intervals are too narrow, because these tasks have one run: {', '.join(single)}"]


def _against_the_paper(suite: str, scores: Sequence[RunScore]) -> list[str]:
    """Another budget than the paper's, and runs without a score."""
    paper = benchmarks()[suite].get("steps")  # none for BSuite, whose budget is in episodes
    budgets = sorted({score.run.planned for score in scores if score.run.planned} - {paper}) if paper else []
    notes = [f"the paper's budget is {paper:,} environment steps, here it is {budget:,}" for budget in budgets]
    without = sorted({score.task for score in scores} - {score.task for score in scores if score.score is not None})
    return notes + ([f"without any score: {', '.join(without)}"] if without else [])
