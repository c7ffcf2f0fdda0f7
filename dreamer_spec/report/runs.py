"""The runs of a page, read from their log directories: nothing in these files is trusted to be whole or of the right
kind."""

import array
import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dreamer_spec.disk.about import read_about
from dreamer_spec.disk.files import Unreadable, entries, read_json
from dreamer_spec.errors import UserError
from dreamer_spec.monitoring.logger import iterate_metrics

# Of the options, beside task, backend and hyperparameters, those that change what is learned: runs of one group agree
# in all of them.
LEARNING_OPTIONS = ("env_arg", "time_limit", "action_repeat", "image_size", "replay_deter")
LABELS = (
    "backend",
    "profile",
    "size",
    *LEARNING_OPTIONS,
)  # what may tell groups apart, beside hyperparameters that were changed


@dataclasses.dataclass(frozen=True)
class Curve:
    """One metric of one run: environment steps, ascending, and values, which may not be finite. Both [n] float64."""

    steps: np.ndarray
    values: np.ndarray


@dataclasses.dataclass(frozen=True)
class RunLog:
    """One run.

    curves: by name of the metric. step, seconds: how far it is. written: when metrics.jsonl was written last, in
    seconds since 1970, None if it is not there. pictures: the newest PNG and GIF of every key that was predicted.
    notes: what was wrong with the files.
    """

    logdir: Path
    curves: dict[str, Curve]
    step: int
    seconds: float
    written: float | None
    task: str
    backend: str
    device: str
    command: str
    parameters: int | None
    options: dict[str, Any]
    hyperparameters: dict[str, Any]
    changed: dict[str, Any]
    profile: str
    size: str
    spaces: dict[str, Any]
    preflight: dict[str, Any]
    machine: dict[str, Any]
    starts: list[dict[str, Any]]
    pictures: list[Path]
    notes: list[str]

    @property
    def seed(self) -> Any:
        return self.options.get("seed")

    @property
    def planned(self) -> int | None:
        """Environment steps that the run is to have."""
        steps = self.options.get("steps")
        return steps if isinstance(steps, int) and steps > 0 else None

    def last(self, name: str) -> float | None:
        """The newest finite value of a metric."""
        curve = self.curves.get(name)
        finite = curve.values[np.isfinite(curve.values)] if curve else np.empty(0)
        return float(finite[-1]) if len(finite) else None


@dataclasses.dataclass(frozen=True)
class Group:
    """Runs that differ in nothing but their seed. color: its place among the groups of the task."""

    label: str
    color: int
    runs: list[RunLog]

    @property
    def size(self) -> str:
        """3 seeds; or 3 runs, if they have not each a seed of its own."""
        count, seeds = len(self.runs), {run.seed for run in self.runs}
        what = "seed" if len(seeds) == count and None not in seeds else "run"
        return f"{count} {what}{'' if count == 1 else 's'}"

    def curves(self, name: str) -> list[Curve]:
        """Of the runs that have this metric."""
        return [run.curves[name] for run in self.runs if name in run.curves]

    def last(self, name: str) -> list[float]:
        """The newest finite values of a metric, of the runs that have one."""
        return [value for run in self.runs if (value := run.last(name)) is not None]


def find_logdirs(paths: Sequence[Path], say: Callable[[str], None] = print) -> list[Path]:
    """The log directories among these paths and, where a path is none, directly below it; each once.

    say: is told of each path without any run, which is left out.

    Raises:
      UserError: a path that is not there, or no run anywhere.
    """
    found: dict[Path, Path] = {}
    without = []
    for path in paths:
        if not path.exists():
            raise UserError(f"{path} is not there; expected a log directory of train, or one that holds some")
        children = sorted(path.iterdir()) if path.is_dir() else []
        logdirs = [path] if _is_logdir(path) else [child for child in children if _is_logdir(child)]
        without += [] if logdirs else [path]
        found |= {logdir.resolve(): logdir for logdir in logdirs}
    if not found:
        raise UserError(
            f"{', '.join(map(str, without))} holds no run: neither metrics.jsonl nor run.json "
            f"is in it, or in a directory below it"
        )
    for path in without:
        say(f"{path} holds no run and is left out")
    return list(found.values())


def _is_logdir(path: Path) -> bool:
    return (path / "metrics.jsonl").is_file() or (path / "run.json").is_file()


def read_run(logdir: Path) -> RunLog:
    """What a log directory holds.

    Raises:
      UserError: a file cannot be read.
    """
    notes = []
    about = read_about(logdir)
    if about is None:
        about = _from_checkpoint(logdir)
        known = "what the newest checkpoint knows" if about else "nothing"
        notes.append(f"run.json is {'damaged' if (logdir / 'run.json').exists() else 'missing'}: shown is {known}")
    curves: dict[str, Curve] = {}
    seconds, damaged, written = 0.0, 0, None
    try:
        curves, seconds, damaged = _read_curves(logdir / "metrics.jsonl")
        written = (logdir / "metrics.jsonl").stat().st_mtime if (logdir / "metrics.jsonl").exists() else None
    except ValueError as error:
        notes.append(f"there are no metrics: {error}")
    except OSError as error:
        raise UserError(f"cannot read the run in {logdir}: {error}") from error
    pictures = newest_pictures(logdir / "predictions")
    if damaged:
        notes.append(
            f"metrics.jsonl has {damaged:,} damaged {'line' if damaged == 1 else 'lines'}, which "
            f"{'is' if damaged == 1 else 'are'} left out"
        )
    reached = [int(curve.steps[-1]) for curve in curves.values()] + [int(path.name) for path in _checkpoints(logdir)]
    starts = [start for start in _of(about, "starts", list) if isinstance(start, dict)]
    return RunLog(
        logdir=logdir,
        curves=curves,
        step=max(reached, default=0),
        seconds=seconds,
        written=written,
        parameters=_of(about, "parameters", int) or None,
        starts=starts,
        pictures=pictures,
        notes=notes,
        changed=_of(about, "changed_hyperparameters", dict),
        **{name: _of(about, name, str) for name in ("task", "backend", "device", "command", "profile", "size")},
        **{name: _of(about, name, dict) for name in ("options", "hyperparameters", "spaces", "preflight", "machine")},
    )


def _of(about: dict[str, Any], name: str, kind: type) -> Any:
    """An entry if it is of its kind, or an empty one."""
    value = about.get(name)
    return value if isinstance(value, kind) else kind()


def _checkpoints(logdir: Path) -> list[Path]:
    return sorted(path for path in entries(logdir / "checkpoints") if path.name.isascii() and path.name.isdigit())


def _from_checkpoint(logdir: Path) -> dict[str, Any]:
    """What the newest checkpoint says about a run that has no run.json."""
    for path in reversed(_checkpoints(logdir)):
        try:
            info = read_json(path / "checkpoint.json")
            identity = dict(info["identity"])
            options = {name: identity.pop(name) for name in ("task", "seed", *LEARNING_OPTIONS) if name in identity}
            about = {"task": options.pop("task", ""), "backend": info.get("backend"), "spaces": info.get("spaces")}
            return about | {"options": options, "hyperparameters": identity}
        except (OSError, ValueError, KeyError, TypeError, AttributeError, Unreadable):
            continue
    return {}


def _read_curves(path: Path) -> tuple[dict[str, Curve], float, int]:
    """Curves by name, the seconds of training, and how many lines are damaged."""
    columns: dict[str, tuple[array.array[float], array.array[float]]] = {}
    seconds, damaged = 0.0, 0
    for line in iterate_metrics(path):
        if line is None:
            damaged += 1
            continue
        step = line.pop("step")
        seconds = max(seconds, line.pop("seconds", 0.0))
        for name, value in line.items():
            steps, values = columns.setdefault(name, (array.array("d"), array.array("d")))
            steps.append(step)
            values.append(value)
    return {name: _curve(*column) for name, column in columns.items()}, seconds, damaged


def _curve(steps: "array.array[float]", values: "array.array[float]") -> Curve:
    order = np.argsort(np.array(steps), kind="stable")
    return Curve(np.array(steps)[order], np.array(values)[order])


def newest_pictures(directory: Path) -> list[Path]:
    """The PNG and GIF files of the newest step of each key: <step>-<key>.png and .gif."""
    newest: dict[tuple[str, str], Path] = {}
    for path in entries(directory):
        step, separator, key = path.stem.partition("-")
        if path.suffix in (".png", ".gif") and separator and step.isascii() and step.isdigit():
            newest[key, path.suffix] = path
    return [newest[name] for name in sorted(newest)]


def group_runs(runs: Sequence[RunLog]) -> dict[str, list[Group]]:
    """Task -> its groups, in the order of the runs."""
    tasks: dict[str, dict[str, list[RunLog]]] = {}
    for run in runs:
        tasks.setdefault(run.task, {}).setdefault(_identity(run), []).append(run)
    return {task: _label(list(groups.values())) for task, groups in tasks.items()}


def _identity(run: RunLog) -> str:
    """What runs of one group agree in; a run about which nothing is known agrees with no other."""
    return (
        json.dumps([run.backend, _of_learning(run), run.hyperparameters], sort_keys=True)
        if run.hyperparameters
        else str(run.logdir)
    )


def _label(groups: list[list[RunLog]]) -> list[Group]:
    """Names each group by what tells it from the others."""
    first = [group[0] for group in groups]
    changed = dict.fromkeys(name for run in first for name in run.changed)
    names = differing(
        [{name: value for name, value in settings(run).items() if name in (*LABELS, *changed)} for run in first]
    )

    def label(run: RunLog) -> str:
        words = [
            show(settings(run).get(name)) if name == "backend" else f"{name} {show(settings(run).get(name))}"
            for name in names
        ]
        return ", ".join(words) if run.hyperparameters and words else run.backend or run.logdir.name

    labels = [label(run) for run in first]
    repeated = {label for label in labels if labels.count(label) > 1}
    labels = [
        f"{label} ({run.logdir.name})" if label in repeated else label for label, run in zip(labels, first, strict=True)
    ]
    return [Group(label, color, group) for color, (label, group) in enumerate(zip(labels, groups, strict=True))]


def _of_learning(run: RunLog) -> dict[str, Any]:
    return {name: run.options.get(name) for name in LEARNING_OPTIONS}


def settings(run: RunLog) -> dict[str, Any]:
    """Everything that was set, by name: task, backend, device, options and hyperparameters, but not where the logs
    are."""
    options = {
        name: value for name, value in run.options.items() if name not in ("logdir", "task", "backend", "device")
    }
    top = {"task": run.task, "backend": run.backend, "device": run.device, "profile": run.profile, "size": run.size}
    return {name: value for name, value in top.items() if value} | options | run.hyperparameters


def differing(configurations: Sequence[dict[str, Any]]) -> list[str]:
    """The names whose values are not the same in all configurations that have them."""
    values: dict[str, set[str]] = {}
    for configuration in configurations:
        for name, value in configuration.items():
            values.setdefault(name, set()).add(json.dumps(value, sort_keys=True))
    return [name for name, found in values.items() if len(found) > 1]


def show(value: Any) -> str:
    """A setting as one writes it: 4e-05, true, 1,2,3,4."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return ",".join(map(show, value))
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, int):
        return f"{value:,}"
    return "" if value is None else str(value)
