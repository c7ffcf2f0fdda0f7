"""What came of the runs, in numbers."""

import dataclasses
import math
import time

import numpy as np

from dreamer_spec.monitoring.logger import duration
from dreamer_spec.report.runs import Group, RunLog, show

LAST_EPISODES = 20


@dataclasses.dataclass(frozen=True)
class Headline:
    """The return of a group with its error, and lines that say what they are."""

    value: str
    error: str
    lines: list[str]


def headline(group: Group) -> Headline:
    """Of the last evaluations, or else of the last training episodes."""
    error, spread = None, ""
    if values := group.last("evaluation/return"):
        about, spread = "last evaluation", "standard error over its episodes"
        error = next(iter(group.last("evaluation/return_standard_error")), None)
    elif values := [value for run in group.runs if (value := last_episodes(run)) is not None]:
        about = f"mean of the last {LAST_EPISODES} training episodes"
    else:
        return Headline("no return yet", "", ["no episode has ended yet"])
    if len(values) > 1:
        error, spread = float(np.std(values, ddof=1) / math.sqrt(len(values))), "standard error over them"
        about += f", mean over {f'{len(values)} of ' * (len(values) < len(group.runs))}{group.size}"
    lines = [f"return, {about}", *([f"± {spread}"] if error is not None else [])]
    if random := group.last("random/return"):
        lines.append(f"a random policy gets {number(float(np.mean(random)))}")
    steps = dict.fromkeys(f"{run.step:,}" for run in group.runs)
    lines.append(f"after {' / '.join(steps)} environment steps")
    return Headline(number(float(np.mean(values))), "" if error is None else f"± {error:.3g}", lines)


def result_row(run: RunLog, now: float) -> list[str]:
    """Its name, backend, seed, steps, training time, episodes, last and best evaluation, last episodes, and state."""
    evaluation, error, best = run.last("evaluation/return"), run.last("evaluation/return_standard_error"), _best(run)
    episodes, recent = run.curves.get("episode/return"), last_episodes(run)
    last = "" if evaluation is None else number(evaluation) + ("" if error is None else f" ± {error:.3g}")
    return [
        run.logdir.name,
        run.backend,
        show(run.seed),
        f"{run.step:,}",
        duration(run.seconds),
        f"{len(episodes.steps):,}" if episodes else "0",
        last,
        "" if best is None else f"{number(best[1])} at {best[0]:,}",
        "" if recent is None else number(recent),
        state(run, now),
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
    day = time.strftime("%Y-%m-%d", time.gmtime(run.written))
    return f"{share}, last line {f'{duration(silent)} ago' if silent < 86_400 else day}"


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
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
