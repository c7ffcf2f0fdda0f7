"""What came of the runs, in numbers."""

import math
import time
from collections.abc import Sequence
from html import escape

import numpy as np

from dreamer_spec.monitoring.logger import duration
from dreamer_spec.report.html import cell, swatch, table
from dreamer_spec.report.runs import Group, RunLog, show

LAST_EPISODES = 20


def result_cards(task: str, groups: Sequence[Group], several: bool) -> str:
    """One card for each group of a task: its result as large as anything on the page."""
    heading = f"<h3>{escape(task or 'unknown task')}</h3>" if several else ""
    return f'{heading}<div class="cards">{"".join(_card(group) for group in groups)}</div>'


def _card(group: Group) -> str:
    value, lines = headline(group)
    label = f'{swatch(group.color)}{escape(group.label)} <span class="muted">{group.size}</span>'
    border = f' style="border-left-color: var(--c{group.color % 8})"'
    about = "".join(f'<p class="small muted">{escape(line)}</p>' for line in lines)
    return f'<div class="card"{border}><p>{label}</p><b>{value}</b>{about}</div>'


def headline(group: Group) -> tuple[str, list[str]]:
    """The return of a group as markup, and lines that say what it is: of the last evaluations, or else of the last
    training episodes."""
    evaluated = [run for run in group.runs if run.last("evaluation/return") is not None]
    trained = [run for run in group.runs if last_episodes(run) is not None]
    if evaluated:
        values = [value for run in evaluated if (value := run.last("evaluation/return")) is not None]
        about = "last evaluation"
        error = evaluated[0].last("evaluation/return_standard_error")
        spread = "standard error over its episodes"
    elif trained:
        values = [value for run in trained if (value := last_episodes(run)) is not None]
        about = f"mean of the last {LAST_EPISODES} training episodes"
        error, spread = None, ""
    else:
        return "no return yet", ["no episode has ended yet"]
    if len(values) > 1:
        error = float(np.std(values, ddof=1) / math.sqrt(len(values)))
        about, spread = (
            f"{about}, mean over {group.size if len(values) == len(group.runs) else f'{len(values)} of {group.size}'}",
            "standard error over them",
        )
    tail = "" if error is None else f" <small>± {error:.3g}</small>"
    lines = [f"return, {about}", *([f"± {spread}"] if error is not None else [])]
    random = [value for run in group.runs if (value := run.last("random/return")) is not None]
    if random:
        lines.append(f"a random policy gets {number(float(np.mean(random)))}")
    steps = dict.fromkeys(f"{run.step:,}" for run in group.runs)
    return number(float(np.mean(values))) + tail, [*lines, f"after {' / '.join(steps)} environment steps"]


def result_table(runs: Sequence[RunLog], now: float) -> str:
    """One line for each run."""
    header = [
        "run",
        "backend",
        "seed",
        "steps",
        "training time",
        "episodes",
        "last evaluation",
        "best evaluation",
        "last episodes",
        "state",
    ]
    return table(header, [_row(run, now) for run in runs], numbers=range(2, 9))


def _row(run: RunLog, now: float) -> list[str]:
    evaluation, error, best = run.last("evaluation/return"), run.last("evaluation/return_standard_error"), _best(run)
    episodes, recent = run.curves.get("episode/return"), last_episodes(run)
    last = "" if evaluation is None else number(evaluation) + ("" if error is None else f" ± {error:.3g}")
    numbers = [
        show(run.seed),
        f"{run.step:,}",
        duration(run.seconds),
        f"{len(episodes.steps):,}" if episodes else "0",
        last,
        "" if best is None else f"{number(best[1])} at {best[0]:,}",
        "" if recent is None else number(recent),
    ]
    return [
        cell(run.logdir.name, "name"),
        cell(run.backend),
        *(cell(text, "number") for text in numbers),
        cell(state(run, now)),
    ]


def state(run: RunLog, now: float) -> str:
    """finished, or how far the run is and when it was heard of last."""
    if run.planned and run.step >= run.planned:
        return "finished"
    share = (
        f"{run.step / run.planned:.0%} of {run.planned:,} steps" if run.planned else "unfinished or of unknown length"
    )
    if not run.curves or run.written is None:
        return f"{share}, nothing logged yet"
    silent = max(now - run.written, 0.0)
    return (
        f"{share}, last line {duration(silent)} ago" if silent < 86_400 else f"{share}, last line {_date(run.written)}"
    )


def _date(seconds: float) -> str:
    return time.strftime("%Y-%m-%d", time.gmtime(seconds))


def last_episodes(run: RunLog) -> float | None:
    """Mean return of the last training episodes."""
    curve = run.curves.get("episode/return")
    finite = curve.values[np.isfinite(curve.values)] if curve else np.empty(0)
    return float(np.mean(finite[-LAST_EPISODES:])) if len(finite) else None


def _best(run: RunLog) -> tuple[int, float] | None:
    """Step and value of the highest evaluation."""
    curve = run.curves.get("evaluation/return")
    if curve is None or not np.isfinite(curve.values).any():
        return None
    index = int(np.nanargmax(np.where(np.isfinite(curve.values), curve.values, -np.inf)))
    return int(curve.steps[index]), float(curve.values[index])


def number(value: float) -> str:
    """Four digits: 1,234, 98.77, 0.001234."""
    if value and not 1e-4 <= abs(value) < 1e9:
        return f"{value:.3e}"
    digits = 0 if abs(value) >= 1000 else 4
    return f"{value:,.0f}" if not digits else f"{value:.4g}"
