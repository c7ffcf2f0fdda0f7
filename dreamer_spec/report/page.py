"""The page: one HTML file that needs nothing else. What stands where is in templates/run.html."""

import base64
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from conformance import pages
from dreamer_spec.disk.files import Unreadable, open_file, reading, replacing
from dreamer_spec.errors import writing
from dreamer_spec.report.charts import Task, task_charts
from dreamer_spec.report.results import headline, result_row
from dreamer_spec.report.runs import RunLog, differing, group_runs, settings, show
from dreamer_spec.words import counted

LARGEST_PICTURE = 8 * 2**20  # bytes of a picture that goes into the page
KINDS = {b"\x89PNG\r\n\x1a\n": "image/png", b"GIF87a": "image/gif", b"GIF89a": "image/gif"}


def write(path: Path, runs: Sequence[RunLog], remedy: str = "") -> int:
    """Writes the page about these runs, whole or not at all. Returns its bytes.

    Raises:
      UserError: it cannot be written, with the remedy.
    """
    page = render(runs, time.time()).encode("utf-8", "replace")  # The name of a log directory need not be text.
    with writing(path, remedy), replacing(path) as file:
        file.write(page)
    return len(page)


def render(runs: Sequence[RunLog], now: float) -> str:
    """The page about these runs. now: seconds since 1970."""
    tasks = [task_charts(name or "unknown task", groups) for name, groups in group_runs(runs).items()]
    made = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(now))
    return pages.render(
        __package__,
        "run.html",
        tasks=tasks,
        headline=headline,
        about=f"{counted(len(runs), 'run')} of dreamer-spec, as of {made}.",
        results=[result_row(run, now) for run in runs],
        differences=_differences(tasks),
        pictures=[_picture(run, path) for run in runs for path in run.pictures],
        runs=list(map(_run, runs)),
        settings=_settings(runs),
    )


def _differences(tasks: Sequence[Task]) -> list[list[str]]:
    """What is not the same in all groups: a row of their names, and one for each setting."""
    groups = [(task, group) for task in tasks for group in task.groups if group.runs[0].hyperparameters]
    configurations = [
        {name: value for name, value in settings(group.runs[0]).items() if name != "seed"} for _, group in groups
    ]
    header = ["", *(f"{task.name}: {group.label}" if len(tasks) > 1 else group.label for task, group in groups)]
    names = differing(configurations)
    return [header, *([name, *(show(values.get(name)) for values in configurations)] for name in names)]


def _settings(runs: Sequence[RunLog]) -> list[list[str]]:
    """Every option and hyperparameter: its name, its values in all runs, and whether it was changed."""
    configurations = [settings(run) for run in runs]
    rows = []
    for name in dict.fromkeys(name for configuration in configurations for name in configuration):
        values = dict.fromkeys(show(configuration.get(name)) for configuration in configurations)
        rows.append([name, " | ".join(values), "changed" if any(name in run.changed for run in runs) else ""])
    return rows


def _run(run: RunLog) -> dict[str, Any]:
    """Everything about one run that is not a number over time."""
    spaces = {
        name: "; ".join(f"{key}: {_space(space)}" for key, space in _entries(run.spaces.get(name)))
        for name in ("observations", "actions")
    }
    facts = {
        "log directory": str(run.logdir),
        "task": run.task,
        "backend": f"{run.backend} on {run.device}" if run.device else run.backend,
        "profile and size": f"{run.profile}, {run.size}" if run.profile else "",
        "parameters": show(run.parameters),
    }
    return {
        "title": run.logdir.name + ("" if run.seed is None else f", seed {show(run.seed)}"),
        "notes": run.notes,
        "command": run.command,
        "facts": facts | spaces,
        "preflight": _preflight(run.preflight),
        "machine": _machine(run.machine),
        "starts": _starts(run),
    }


def _preflight(found: dict[str, Any]) -> dict[str, Any]:
    """comparisons: what was compared, requirements, outcome, and the deviation as a share of what is allowed. seconds:
    of each part."""
    worst, comparisons = found.get("worst"), found.get("comparisons")
    entries = comparisons if isinstance(comparisons, list) else []
    return found and {
        "passed": found.get("passed") is True,
        "summary": show(found.get("summary")),
        "deviation": f"{worst:.3g}" if isinstance(worst, int | float) else "",
        "seconds": ", ".join(f"{show(part)} {show(value)} s" for part, value in _entries(found.get("seconds"))),
        "comparisons": [_comparison(entry) for entry in entries if isinstance(entry, dict)],
    }


def _comparison(entry: dict[str, object]) -> list[str]:
    share, requirements = entry.get("share"), entry.get("requirements")
    ids = ", ".join(map(show, requirements)) if isinstance(requirements, list) else ""
    return [show(entry.get("name")), ids, "passed", f"{share:.2%}" if isinstance(share, int | float) else ""]


def _machine(found: dict[str, Any]) -> dict[str, str]:
    facts = {
        name.removesuffix("_gib"): show(value) for name, value in found.items() if name not in ("versions", "date")
    }
    if facts.get("memory"):
        facts["memory"] += " GiB"
    versions = ", ".join(f"{name} {show(version)}" for name, version in _entries(found.get("versions")))
    return facts | {"packages": versions} if found else {}


def _starts(run: RunLog) -> list[list[str]]:
    """Each start with what changed since the one before."""
    rows, before = [], None
    for start in run.starts:
        now = {name: show(start.get(name)) for name in ("backend", "device", "accelerator", "python", "commit")}
        now |= {str(name): show(version) for name, version in _entries(start.get("versions"))}
        if before is None:
            words = [f"{now['backend']} on {now['device']}, commit {now['commit'] or 'unknown'}"]
        else:
            words = [f"{name} {value}" for name, value in now.items() if before.get(name) != value]
        given = _entries(start.get("changed"))
        words += [f"{name} {show(values[-1])}" for name, values in given if isinstance(values, list) and values]
        rows.append([show(start.get("time")), show(start.get("step")), ", ".join(words) or "nothing changed"])
        before = now
    return rows


def _entries(value: object) -> Iterable[tuple[object, object]]:
    return value.items() if isinstance(value, dict) else ()


def _space(space: object) -> str:
    """{"kind": "vector", "size": 4} -> vector, size 4."""
    if not isinstance(space, dict):
        return show(space)
    return ", ".join(
        [show(space.get("kind")), *(f"{name} {show(value)}" for name, value in space.items() if name != "kind")]
    )


def _picture(run: RunLog, path: Path) -> dict[str, Any]:
    """A prediction: an address that holds the picture, or a problem."""
    step, _, key = path.stem.partition("-")
    source, problem = _embedded(path)
    return {"key": key, "run": run.logdir.name, "step": f"{int(step):,}", "source": source, "problem": problem}


def _embedded(path: Path) -> tuple[str, str]:
    """The picture as an address that holds it, and why there is none."""
    try:
        with open_file(path) as file, reading(path):
            content = file.read(LARGEST_PICTURE + 1)
    except (FileNotFoundError, ValueError, Unreadable) as error:
        return "", f"{path.name} cannot be read: {error}."
    if len(content) > LARGEST_PICTURE:
        return "", f"{path.name} is larger than {LARGEST_PICTURE / 2**20:.0f} MiB and stays outside."
    kind = next((kind for start, kind in KINDS.items() if content.startswith(start)), None)
    if kind is None:
        return "", f"{path.name} is damaged: neither PNG nor GIF."
    return f"data:{kind};base64,{base64.b64encode(content).decode()}", ""
