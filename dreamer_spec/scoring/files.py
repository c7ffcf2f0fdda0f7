"""The scores as files: Markdown, CSV and JSON. Each carries the statement of how they came about."""

import csv
import dataclasses
import io
import json
from collections.abc import Sequence
from typing import Any

from conformance.reports.markdown import code, table, text
from dreamer_spec.scoring.cells import Cells, origin, remarks, statement_lines, summary_cells, task_cells, title
from dreamer_spec.scoring.protocol import RunScore
from dreamer_spec.scoring.statement import Statement
from dreamer_spec.scoring.tables import SuiteScore, SummaryScore, TaskScore

FORMAT = 1
CODE = ("commands", "scored with")  # what of a statement one may want to copy


def markdown(suites: Sequence[SuiteScore], scores: Sequence[RunScore], about: Statement) -> str:
    """A section for each suite, then the statement, then what is not as it should be."""
    parts = ["# Scores"]
    for suite in suites:
        parts.append(f"## {text(title(suite))}")
        parts += [_table(cells) for cells in (task_cells(suite), summary_cells(suite)) if cells.rows]
        parts += [text(origin(suite))] if origin(suite) else []
    lines = []
    for topic, said in statement_lines(about):
        dress = code if topic.lower() in CODE else text
        lines.append(f"- **{topic}.** " + "; ".join(map(dress, said)))
    parts += ["## How these scores came about", "\n".join(lines)]
    if found := remarks(suites, scores):
        parts += ["## Remarks", "\n".join(f"- {text(remark)}" for remark in found)]
    return "\n\n".join(parts) + "\n"


def _table(cells: Cells) -> str:
    return table(list(map(text, cells.header)), [list(map(text, row)) for row in cells.rows])


def as_csv(suites: Sequence[SuiteScore], scores: Sequence[RunScore], about: Statement) -> str:
    """The statement and the remarks as comments, then a row for each task and each summary."""
    comments = [f"{topic}: {'; '.join(said)}" for topic, said in statement_lines(about)]
    comments += [f"Remark: {remark}" for remark in remarks(suites, scores)]
    columns = list(dict.fromkeys(f"paper_{method.column}" for suite in suites for method in suite.methods))
    own = [
        "suite",
        "kind",
        "name",
        "value",
        "low",
        "high",
        "standard_deviation",
        "runs",
        "returns",
        "normalized_percent",
    ]
    rows: list[dict[str, Any]] = []
    for suite in suites:
        rows += [{"suite": suite.suite, "kind": "task", **_task_row(task)} for task in suite.tasks]
        rows += [{"suite": suite.suite, "kind": "summary", **_summary_row(found)} for found in suite.summaries]
    written = io.StringIO()
    writer = csv.DictWriter(written, [*own, *columns], restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return "".join(f"# {' '.join(comment.split())}\n" for comment in comments) + written.getvalue()


def _task_row(task: TaskScore) -> dict[str, Any]:
    row = {"name": task.task, "value": task.score, "standard_deviation": task.deviation, "runs": len(task.runs)}
    row |= {"returns": sum(run.returns for run in task.runs), "normalized_percent": task.normalized}
    return row | {f"paper_{column}": number for column, number in task.paper.items()}


def _summary_row(found: SummaryScore) -> dict[str, Any]:
    low, high = found.estimate.interval or (None, None)
    row = {"name": found.summary.name, "value": found.estimate.value, "low": low, "high": high}
    return row | {f"paper_{column}": number for column, number in found.paper.items()}


def as_json(suites: Sequence[SuiteScore], scores: Sequence[RunScore], about: Statement) -> str:
    """Everything, each run with its own command included."""
    data = {
        "format": FORMAT,
        "statement": about,
        "suites": [_suite_json(suite) for suite in suites],
        "runs": [_run_json(score) for score in scores],
        "remarks": remarks(suites, scores),
    }
    return json.dumps(data, indent=1, ensure_ascii=False) + "\n"


def _suite_json(suite: SuiteScore) -> dict[str, Any]:
    return {
        "suite": suite.suite,
        "tasks_of_the_suite": suite.of,
        "tasks": [
            {
                "task": task.task,
                "score": task.score,
                "standard_deviation": task.deviation,
                "normalized_percent": task.normalized,
                "runs": task.values.tolist(),
                "paper": task.paper,
            }
            for task in suite.tasks
        ],
        "summaries": [
            {
                "name": found.summary.name,
                "unit": found.summary.unit,
                "value": found.estimate.value,
                "interval": found.estimate.interval,
                "paper": found.paper,
                "paper_is": "as printed" if suite.is_complete else "from its rows for the same tasks",
            }
            for found in suite.summaries
        ],
    }


def _run_json(score: RunScore) -> dict[str, Any]:
    run = score.run
    return {
        "logdir": str(run.logdir),
        "task": run.task,
        "seed": run.seed,
        "backend": run.backend,
        "device": run.device,
        "score": score.score,
        "returns": score.returns,
        "window": [score.first, score.last],
        "step": run.step,
        "budget": run.planned,
        "command": run.command,
        "machine": run.machine,
        "starts": run.starts,
        "notes": [dataclasses.asdict(note) for note in score.notes],
    }
