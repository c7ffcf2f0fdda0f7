"""What has to be said with every score that is published: how, from which episodes and runs, on what, by which
commands."""

import shlex
from collections.abc import Iterable, Sequence
from typing import Any

from dreamer_spec.report.runs import RunLog, show
from dreamer_spec.scoring import bsuite, statistics
from dreamer_spec.scoring.protocol import Protocol, RunScore
from dreamer_spec.system.machine import own_version
from dreamer_spec.words import counted

SHOWN_VERSIONS = ("dreamer-spec", "numpy", "jax", "torch", "gymnasium", "dm-control", "mujoco", "ale-py")
FEW = 5  # tasks that are named rather than counted

Statement = dict[str, str | list[str]]


def statement(scores: Sequence[RunScore], protocol: Protocol, command: str) -> Statement:
    """By topic, in words. command: that of the scores themselves."""
    runs = [score.run for score in scores]
    return {
        "protocol": _distinct(_protocol(score, protocol) for score in scores),
        "window": _distinct(_window(score, protocol) for score in scores),
        "episodes": _episodes(scores, protocol),
        "seeds": _seeds(runs),
        "intervals": f"{statistics.LEVEL:.0%}, percentiles of {statistics.RESAMPLES:,} resamples, stratified: runs are "
        f"drawn with replacement within each task (generator seed {statistics.SEED})",
        "machine": _distinct(_machine(run) for run in runs),
        "commit": _distinct(commit for run in runs for commit in _commits(run)),
        "versions": _distinct(_versions(run) for run in runs),
        "commands": _distinct(map(_command, runs)),
        "scored with": f"{command} (dreamer-spec {own_version()})",
    }


def _protocol(score: RunScore, protocol: Protocol) -> str:
    if score.suite == "bsuite":
        return "BSuite's score of each experiment and seed; then the mean over seeds, then over tasks (docs/scores.md)"
    what = "training episodes that ended" if protocol.episodes == "training" else "evaluations that were made"
    return (
        f"mean return of the {what} in the window; then the mean over seeds, then normalization, then summaries over "
        f"tasks (docs/scores.md)"
    )


def _window(score: RunScore, protocol: Protocol) -> str:
    if score.suite == "bsuite":
        return f"bsuite: the first {bsuite.episodes_of(score.task):,} training episodes, scored by bsuite's own rules"
    budget = f" of {score.run.planned:,} environment steps" if score.run.planned else ""
    return f"{score.suite or 'other tasks'}: the last {100 * protocol.share(score.suite):g} %{budget}"


def _episodes(scores: Sequence[RunScore], protocol: Protocol) -> str:
    counts = [score.returns for score in scores if score.score is not None]
    noun = "training episodes" if protocol.episodes == "training" else "evaluations"
    if protocol.episodes == "evaluation":
        each = _distinct(show(score.run.options.get("eval_episodes")) or "unknown" for score in scores)
        noun += f", each the mean of {' or '.join(each)} episodes"
    return f"{sum(counts):,} {noun}; {min(counts, default=0):,} to {max(counts, default=0):,} a run"


def _seeds(runs: Sequence[RunLog]) -> list[str]:
    """Of all tasks, or, if tasks differ, of each set of them that has the same seeds."""
    seeds: dict[str, list[str]] = {}
    for run in runs:
        seeds.setdefault(run.task, []).append(show(run.seed) or "unknown")
    together: dict[str, list[str]] = {}
    for task, own in seeds.items():
        together.setdefault(", ".join(sorted(own, key=lambda seed: (len(seed), seed))), []).append(task)
    if len(together) == 1:
        return list(together)
    named = {
        own: ", ".join(tasks) if len(tasks) <= FEW else counted(len(tasks), "task") for own, tasks in together.items()
    }
    return [f"{own} ({tasks})" for own, tasks in named.items()]


def _machine(run: RunLog) -> str:
    parts = [show(run.machine.get("processor")), _counted(run.machine.get("cores"), "cores")]
    parts += [
        _counted(run.machine.get("memory_gib"), "GiB"),
        show(run.machine.get("accelerator")),
        show(run.machine.get("system")),
    ]
    where = ", ".join(part for part in parts if part) or "unknown machine"
    return f"{where}; {run.backend or 'unknown backend'} on {run.device or 'an unknown device'}"


def _counted(value: Any, unit: str) -> str:
    return f"{value:g} {unit}" if isinstance(value, int | float) else ""


def _commits(run: RunLog) -> list[str]:
    """Of every start of the run."""
    found = [start.get("commit") or run.machine.get("commit") for start in run.starts] or [run.machine.get("commit")]
    return _distinct(show(commit) or "unknown: not run from a clone" for commit in found)


def _versions(run: RunLog) -> str:
    known = run.machine.get("versions")
    versions = known if isinstance(known, dict) else {}
    python = show(run.machine.get("python"))
    shown = [f"{name} {show(versions[name])}" for name in SHOWN_VERSIONS if name in versions]
    return ", ".join([f"Python {python}"] * bool(python) + shown) or "unknown"


def _command(run: RunLog) -> str:
    """The command of a run with TASK and SEED for what differs between runs of one kind, and no log directory."""
    try:
        words = shlex.split(run.command)
    except ValueError:
        return run.command
    if not words:
        return "unknown"
    for option in ("--seed", "--logdir"):
        if option in words:
            at = words.index(option)
            del words[at : at + 2]
    if "--task" in words[:-1]:
        words[words.index("--task") + 1] = "TASK"
    return shlex.join([*words, "--seed", "SEED"])


def _distinct(words: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(words))
