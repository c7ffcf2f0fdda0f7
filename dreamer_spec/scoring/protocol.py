"""The final score of a run: the mean return of the episodes at the end of its budget ([LOOP-20], D-118)."""

import dataclasses

import numpy as np

from dreamer_spec.report.runs import RunLog
from dreamer_spec.scoring import bsuite
from dreamer_spec.scoring.suites import split_task, window_of

EPISODES = {"training": "episode/return", "evaluation": "evaluation/return"}


@dataclasses.dataclass(frozen=True)
class Protocol:
    """window: the share of the budget at its end that counts, above 0 and at most 1; None for that of the paper's
    tables for each suite. episodes: `training` or `evaluation`."""

    window: float | None = None
    episodes: str = "training"

    def share(self, suite: str) -> float:
        return window_of(suite) if self.window is None else self.window


@dataclasses.dataclass(frozen=True)
class Note:
    """What is not as the protocol wants it. what: alike for all runs of which it holds. detail: of this run."""

    what: str
    detail: str = ""


@dataclasses.dataclass(frozen=True)
class RunScore:
    """What came of one run.

    suite, task: as `split_task` names them. score: None if no episode ended; of BSuite that of this configuration
    alone. returns: how many numbers it is made of, episodes or evaluations. first, last: the window, in environment
    steps.
    """

    run: RunLog
    suite: str
    task: str
    score: float | None
    returns: int
    first: float
    last: float
    notes: tuple[Note, ...]


def score_run(run: RunLog, protocol: Protocol) -> RunScore:
    """The score of a run. Of one that has not reached its budget the window ends where it is."""
    suite, task = split_task(run.task)
    if suite == "bsuite":
        return _score_bsuite(run, task)
    notes = [Note(note) for note in run.notes]
    budget = run.planned
    if budget is None:
        notes.append(Note("of unknown budget, so that the window ends at the last step", f"{run.step:,}"))
    elif run.step < budget:
        notes.append(Note("unfinished, so that the window ends at the last step", f"{run.step:,} of {budget:,}"))
    end = min(run.step, budget or run.step)
    first = end - protocol.share(suite) * (budget or run.step)
    curve = run.curves.get(EPISODES[protocol.episodes])
    steps, values = (curve.steps, curve.values) if curve else (np.empty(0), np.empty(0))
    if bad := int(np.sum(~np.isfinite(values))):
        notes.append(Note("returns that are not finite are left out", str(bad)))
    within = np.isfinite(values) & (steps <= end + _last_round(run))
    inside = within & (steps >= first)
    if within.any() and not inside.any():
        noun = "training episode ended" if protocol.episodes == "training" else "evaluation was made"
        inside = within & (steps == steps[within][-1])
        notes.append(Note(f"no {noun} in the window: scored is the last before it", f"step {steps[inside][0]:,.0f}"))
    if not inside.any():
        notes.append(Note(f"no {'episode has ended' if protocol.episodes == 'training' else 'evaluation was made'}"))
    score = float(np.mean(values[inside])) if inside.any() else None
    return RunScore(run, suite, task, score, int(inside.sum()), max(first, 0.0), end, tuple(notes))


def _score_bsuite(run: RunLog, experiment: str) -> RunScore:
    """By the first episodes of training, whatever the protocol: BSuite scores how soon something is learned."""
    notes = [Note(note) for note in run.notes]
    episodes, most = bsuite.scored(run), bsuite.episodes_of(experiment)
    if episodes is None and "episode/return" in run.curves:
        notes.append(Note("without what BSuite counts for its score; run with --info-metrics 'bsuite/*'"))
    elif episodes is None:
        notes.append(Note("no episode has ended"))
    elif len(episodes.returns) < most:
        notes.append(Note("fewer episodes than BSuite's score is made of", f"{len(episodes.returns):,} of {most:,}"))
    score = None if episodes is None else bsuite.score(experiment, [episodes])
    returns = 0 if episodes is None else len(episodes.returns)
    last = float(run.curves["episode/return"].steps[returns - 1]) if returns else 0.0
    return RunScore(run, "bsuite", experiment, score, returns, 0.0, last, tuple(notes))


def _last_round(run: RunLog) -> int:
    """How many steps beyond its budget a run can end, because all its environments step at once."""
    environments, repeat = run.hyperparameters.get("envs"), run.options.get("action_repeat")
    if not isinstance(environments, int) or not isinstance(repeat, int):
        return 0
    return max(environments * repeat - 1, 0)
