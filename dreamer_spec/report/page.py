"""The page: one HTML file that needs nothing else. Whatever comes from a log directory is escaped."""

import base64
import hashlib
import time
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from dreamer_spec.disk.files import Unreadable, open_file, reading
from dreamer_spec.report.charts import task_section
from dreamer_spec.report.html import cell, details, table
from dreamer_spec.report.results import result_cards, result_table
from dreamer_spec.report.runs import Group, RunLog, differing, group_runs, settings, show
from dreamer_spec.report.style import SCRIPT, STYLE

LARGEST_PICTURE = 8 * 2**20  # bytes of a picture that goes into the page
KINDS = {b"\x89PNG\r\n\x1a\n": "image/png", b"GIF87a": "image/gif", b"GIF89a": "image/gif"}


def render(runs: Sequence[RunLog], now: float) -> str:
    """The page about these runs. now: seconds since 1970."""
    tasks = group_runs(runs)
    title = ", ".join(name or "unknown task" for name in tasks)
    made = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(now))
    body = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="muted">{len(runs)} {"run" if len(runs) == 1 else "runs"} of dreamer-spec, as of {made}.</p>',
        *(result_cards(task, groups, several=len(tasks) > 1) for task, groups in tasks.items()),
        result_table(runs, now),
        _differences(tasks),
        *(task_section(task, groups, several=len(tasks) > 1) for task, groups in tasks.items()),
        _predictions(runs),
        "<h2>Runs</h2>",
        *(_run(run, is_open=len(runs) == 1) for run in runs),
        _all_settings(runs),
    ]
    digest = base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    head = [
        '<meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(title)}</title>",
        f"<style>{STYLE}</style>",
    ]
    lines = [
        "<!doctype html>",
        '<html lang="en-GB"><head>',
        *head,
        "</head><body>",
        *body,
        f"<script>{SCRIPT}</script>",
        "</body></html>",
    ]
    return "\n".join(lines) + "\n"


def _differences(tasks: dict[str, list[Group]]) -> str:
    """What is not the same in all groups, one column for each."""
    groups = [group for groups in tasks.values() for group in groups if group.runs[0].hyperparameters]
    configurations = [
        {name: value for name, value in settings(group.runs[0]).items() if name != "seed"} for group in groups
    ]
    names = differing(configurations)
    if not names:
        return ""
    several = len(tasks) > 1
    header = ["", *(f"{group.runs[0].task}: {group.label}" if several else group.label for group in groups)]
    rows = [[cell(name, "mono"), *(cell(show(values.get(name))) for values in configurations)] for name in names]
    return "<h2>What differs</h2>" + table(header, rows)


def _all_settings(runs: Sequence[RunLog]) -> str:
    """Every option and hyperparameter; where runs differ, every value."""
    configurations = [settings(run) for run in runs]
    names = dict.fromkeys(name for configuration in configurations for name in configuration)
    rows = []
    for name in names:
        values = dict.fromkeys(show(configuration.get(name)) for configuration in configurations)
        mark = "changed" if any(name in run.changed for run in runs) else ""
        rows.append([cell(name, "mono"), cell(" | ".join(values)), cell(mark, "muted")])
    if not rows:
        return ""
    caption = "<p>Changed: not what the profile and the size say.</p>"
    return "<h2>Configuration</h2>" + details(
        f"All {len(rows)} options and hyperparameters", caption + table(["name", "value", ""], rows)
    )


def _run(run: RunLog, is_open: bool) -> str:
    """Everything about one run that is not a number over time."""
    parts = [f'<p class="fail">{escape(note)}</p>' for note in run.notes]
    if run.command:
        words = " ".join(
            f"<span>{escape(word)}</span>" for word in run.command.split(" ")
        )  # so that no line ends inside --an-option
        parts.append(f"<h3>Command to reproduce</h3><pre>{words}</pre>")
    facts = {
        "log directory": str(run.logdir),
        "task": run.task,
        "backend": f"{run.backend} on {run.device}" if run.device else run.backend,
        "profile and size": f"{run.profile}, {run.size}" if run.profile else "",
        "parameters": show(run.parameters),
        **{
            name: "; ".join(f"{key}: {_space(space)}" for key, space in _entries(run.spaces.get(name)))
            for name in ("observations", "actions")
        },
    }
    parts.append(_fact_table(facts))
    parts.append("<h3>Preflight</h3>" + _preflight(run))
    if run.machine:
        machine = {name: value for name, value in run.machine.items() if name not in ("versions", "date")}
        memory = {"memory_gib": f"{show(machine['memory_gib'])} GiB"} if machine.get("memory_gib") else {}
        versions = ", ".join(f"{name} {show(version)}" for name, version in _entries(run.machine.get("versions")))
        named = {name.removesuffix("_gib"): show(value) for name, value in (machine | memory).items()}
        parts.append("<h3>Machine and versions</h3>" + _fact_table(named | {"packages": versions}))
    if run.starts:
        parts.append("<h3>Starts</h3>" + _starts(run))
    return details(
        f"{run.logdir.name}{'' if run.seed is None else f', seed {show(run.seed)}'}", "".join(parts), "run", is_open
    )


def _preflight(run: RunLog) -> str:
    if not run.preflight:
        return '<p class="muted">Not run, or not recorded.</p>'
    passed = run.preflight.get("passed") is True
    word = '<span class="pass">Passed</span>' if passed else '<span class="fail">Failed</span>'
    worst = run.preflight.get("worst")
    deviation = (
        f" Worst deviation {worst:.3g}, relative to the size of what deviates."
        if isinstance(worst, int | float)
        else ""
    )
    summary = f"<p>{word}: {escape(show(run.preflight.get('summary')))}.{deviation}</p>"
    comparisons = run.preflight.get("comparisons")
    rows = (
        [_comparison(entry) for entry in comparisons if isinstance(entry, dict)]
        if isinstance(comparisons, list)
        else []
    )
    if not rows:
        return summary
    header = ["compared with the reference", "requirements", "", "worst deviation, share of what is allowed"]
    return summary + details(f"All {len(rows)} comparisons", table(header, rows, numbers=(3,)))


def _comparison(entry: dict[str, object]) -> list[str]:
    share, requirements = entry.get("share"), entry.get("requirements")
    ids = ", ".join(map(show, requirements)) if isinstance(requirements, list) else ""
    shown = f"{share:.2%}" if isinstance(share, int | float) else ""
    return [cell(show(entry.get("name")), "mono"), cell(ids), cell("passed", "pass"), cell(shown, "number")]


def _starts(run: RunLog) -> str:
    """Each start with what changed since the one before."""
    rows, before = [], None
    for start in run.starts:
        now = {name: show(start.get(name)) for name in ("backend", "device", "accelerator", "python", "commit")}
        now |= {str(name): show(version) for name, version in _entries(start.get("versions"))}
        changed = [f"{name} {value}" for name, value in now.items() if before is not None and before.get(name) != value]
        what = (
            ", ".join(changed)
            if before is not None
            else f"{now['backend']} on {now['device']}, commit {now['commit'] or 'unknown'}"
        )
        given = [
            f"{name} {show(values[-1])}"
            for name, values in _entries(start.get("changed"))
            if isinstance(values, list) and values
        ]
        what = ", ".join([*filter(None, [what]), *given])
        rows.append(
            [cell(show(start.get("time"))), cell(show(start.get("step")), "number"), cell(what or "nothing changed")]
        )
        before = now
    return table(["time", "step", "with"], rows, numbers=(1,))


def _fact_table(facts: dict[str, str]) -> str:
    return table([], [[f"<th>{escape(name)}</th>", cell(value)] for name, value in facts.items() if value])


def _entries(value: object) -> Iterable[tuple[object, object]]:
    return value.items() if isinstance(value, dict) else ()


def _space(space: object) -> str:
    """{"kind": "vector", "size": 4} -> vector, size 4."""
    if not isinstance(space, dict):
        return show(space)
    return ", ".join(
        [show(space.get("kind")), *(f"{name} {show(value)}" for name, value in space.items() if name != "kind")]
    )


def _predictions(runs: Sequence[RunLog]) -> str:
    """The newest pictures of every run."""
    figures = [_picture(run, path) for run in runs for path in run.pictures]
    if not figures:
        return ""
    about = (
        "<p>The model sees the first steps of a recorded episode, then only the actions; the pictures are "
        "the newest of each run.</p>"
    )
    return f'<h2>Open-loop predictions</h2>{about}<div class="pictures">{"".join(figures)}</div>'


def _picture(run: RunLog, path: Path) -> str:
    step, _, key = path.stem.partition("-")
    caption = f'<span class="name">{escape(key)}</span> {escape(run.logdir.name)}, step {int(step):,}'
    picture = _embedded(path, f"prediction of {key} at step {int(step):,}")
    return f"<figure><figcaption>{caption}</figcaption>{picture}</figure>"


def _embedded(path: Path, label: str) -> str:
    """The picture inside the page, or a line that says why not."""
    try:
        with open_file(path) as file, reading(path):
            content = file.read(LARGEST_PICTURE + 1)
    except (FileNotFoundError, ValueError, Unreadable) as error:
        return f'<p class="fail">{escape(path.name)} cannot be read: {escape(str(error))}.</p>'
    if len(content) > LARGEST_PICTURE:
        return (
            f'<p class="muted">{escape(path.name)} is larger than '
            f"{LARGEST_PICTURE / 2**20:.0f} MiB and stays outside.</p>"
        )
    kind = next((kind for start, kind in KINDS.items() if content.startswith(start)), None)
    if kind is None:
        return f'<p class="fail">{escape(path.name)} is damaged: neither PNG nor GIF.</p>'
    return f'<img alt="{escape(label)}" src="data:{kind};base64,{base64.b64encode(content).decode()}">'
