"""The scores as tables of text, for the terminal and for Markdown."""

import dataclasses
from collections.abc import Sequence

from dreamer_spec.report.results import number
from dreamer_spec.scoring.protocol import RunScore
from dreamer_spec.scoring.statement import Statement
from dreamer_spec.scoring.statistics import LEVEL
from dreamer_spec.scoring.tables import Paper, SuiteScore, SummaryScore, TaskScore
from dreamer_spec.words import counted

MOST_NAMED = 5  # runs in a remark


@dataclasses.dataclass(frozen=True)
class Cells:
    """A table: the first column holds names, the others numbers."""

    header: list[str]
    rows: list[list[str]]


def title(suite: SuiteScore) -> str:
    if not suite.suite:
        return "Tasks that are not in a table of the paper"
    return f"{suite.suite}: {'all' if suite.is_complete else f'{len(suite.tasks)} of'} {counted(suite.of, 'task')}"


def task_cells(suite: SuiteScore) -> Cells:
    """A row for each task."""
    normalized = any(task.normalized is not None for task in suite.tasks)
    header = ["task", "runs", "episodes", "score", "± std", *(["normalized"] * normalized), *_methods(suite)]
    return Cells(header, [_task(task, suite, normalized) for task in suite.tasks])


def _methods(suite: SuiteScore) -> list[str]:
    return [f"{method.name} {method.steps}".rstrip() for method in suite.methods]


def _task(task: TaskScore, suite: SuiteScore, normalized: bool) -> list[str]:
    cells = [task.task, str(len(task.runs)), f"{sum(run.returns for run in task.runs):,}", number(task.score)]
    cells.append("" if task.deviation is None else number(task.deviation))
    if normalized:
        cells.append("" if task.normalized is None else f"{task.normalized:.1f} %")
    return cells + _paper(task.paper, suite)


def _paper(paper: Paper, suite: SuiteScore, unit: str = "") -> list[str]:
    """At most two digits behind the point, which is what the paper prints."""
    values = (paper.get(method.column) for method in suite.methods)
    return ["" if value is None else f"{round(value, 2):,.12g}{unit}" for value in values]


def summary_cells(suite: SuiteScore) -> Cells:
    """A row for each summary."""
    header = ["summary", "value", f"{LEVEL:.0%} interval", *_methods(suite)]
    return Cells(header, [_summary(summary, suite) for summary in suite.summaries])


def _summary(found: SummaryScore, suite: SuiteScore) -> list[str]:
    unit = f" {found.summary.unit}".rstrip()
    interval = found.estimate.interval
    digits = 2 if found.summary.category else 1  # scores between 0 and 1
    between = f"{interval[0]:,.{digits}f} to {interval[1]:,.{digits}f}" if interval else "one run a task"
    name = found.summary.name.replace("_", " ").replace("iqm", "interquartile mean")
    return [name, f"{found.estimate.value:,.{digits}f}{unit}", between, *_paper(found.paper, suite, unit)]


def origin(suite: SuiteScore) -> str:
    """What the numbers of the paper are; empty where there are none."""
    if not suite.methods:
        return ""
    if suite.is_complete or not suite.summaries:
        return "Columns with a method's name: as the paper prints them."
    return (
        f"Columns with a method's name: the paper's rows of tasks, and in summaries what follows from its rows for the "
        f"{counted(len(suite.tasks), 'task')} above."
    )


def statement_lines(about: Statement) -> list[tuple[str, list[str]]]:
    """Topic and what is said about it."""
    return [(topic.capitalize(), [said] if isinstance(said, str) else said) for topic, said in about.items()]


def remarks(suites: Sequence[SuiteScore], scores: Sequence[RunScore]) -> list[str]:
    """What is not as it should be, of suites and of runs: a line for each kind, which names some of its runs."""
    of_suites = [f"{suite.suite}: {note}" if suite.suite else note for suite in suites for note in suite.notes]
    runs: dict[str, list[str]] = {}
    for score in scores:
        for note in score.notes:
            runs.setdefault(note.what, []).append(f"{score.run.logdir}" + (f" ({note.detail})" if note.detail else ""))
    return of_suites + [f"{what}: {_some(named)}" for what, named in runs.items()]


def _some(named: Sequence[str]) -> str:
    rest = len(named) - MOST_NAMED
    return ", ".join(named[:MOST_NAMED]) + (f" and {counted(rest, 'other run')}" if rest > 0 else "")
