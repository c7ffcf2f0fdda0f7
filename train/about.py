"""LOGDIR/run.json: everything that a reader of a run has to know, and cannot see in its metrics."""

import dataclasses
import datetime
import json
import os
import secrets
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spec import Config, Spaces, built_profiles, load_config, sizes
from train.errors import writing
from train.files import read_json
from train.machine import describe
from train.options import Options, presets

if TYPE_CHECKING:
    from conformance.preflight import Report

FORMAT = 1
NAME = "run.json"

About = dict[str, Any]


def write_about(
    options: Options,
    *,
    spaces: Spaces,
    device: str,
    parameters: int,
    preflight: "Report | None",
    resumed_at: int | None,
    understood: Sequence[str] = (),
) -> About:
    """Writes LOGDIR/run.json, complete or not at all, and returns what stands there.

    device: as the learner names it. parameters: how many numbers are trained. preflight: its result, None if it was skipped. resumed_at:
    the environment step of the checkpoint that is continued, None for a new run. understood: what the environment's spaces became, in
    words. A resumed run keeps its `id` and its earlier `starts`;
    all else describes this start.

    Raises:
      UserError: the disk refuses it.
    """
    earlier = (resumed_at is not None and read_about(options.logdir)) or {}
    profile, size, changed = nearest(options.config)
    machine = describe()
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    start = {"time": now, "step": resumed_at or 0, "backend": options.backend, "device": device}
    start |= {name: machine[name] for name in ("accelerator", "python", "versions", "commit")}
    known, starts = earlier.get("id"), earlier.get("starts")
    about = {
        "format": FORMAT,
        "id": known if isinstance(known, str) else secrets.token_hex(8),
        "command": shlex.join(command_line(options)),
        "task": options.task,
        "backend": options.backend,
        "device": device,
        "profile": profile,
        "size": size,
        "parameters": parameters,
        "options": _options(options),
        "hyperparameters": dataclasses.asdict(options.config),
        "changed_hyperparameters": changed,
        "spaces": spaces.to_json(),
        "understood": list(understood),
        "preflight": dataclasses.asdict(preflight) if preflight else None,
        "machine": machine,
        "starts": [*(starts if isinstance(starts, list) else []), start],
    }
    text = json.dumps(about, indent=1) + "\n"
    _write(options.logdir / NAME, text)
    return json.loads(text)


def read_about(logdir: Path) -> About | None:
    """What run.json says; None if it is not there, damaged or of another format. No entry can be relied on."""
    try:
        about = read_json(logdir / NAME)
    except (OSError, ValueError):
        return None
    return about if about.get("format") == FORMAT else None


def command_line(options: Options) -> list[str]:
    """The words of a command that gives these options, whatever the presets are."""
    profile, size, changed = nearest(options.config)
    defaults = {field.name: field.default for field in dataclasses.fields(options)} | {"env_args": {}} | presets()["base"]
    words = ["train", "--backend", options.backend, "--task", options.task, "--profile", profile, "--size", size]
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if field.name in ("backend", "task", "config") or value == defaults[field.name]:
            continue
        flag = field.name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        elif isinstance(value, Mapping):
            words += [word for name, entry in value.items() for word in ("--env-arg", f"{name}={json.dumps(entry)}")]
        else:
            words += [f"--{flag}", _show(value)]
    for name, value in changed.items():
        words += [f"--{name.replace('_', '-')}", _show(value)]
    return words


def nearest(config: Config) -> tuple[str, str, dict[str, Any]]:
    """The profile and the size that come nearest to a configuration, and the hyperparameters in which it differs from them."""
    values = dataclasses.asdict(config)

    def changed(profile: str, size: str) -> dict[str, Any]:
        other = dataclasses.asdict(load_config(profile, size))
        return {name: value for name, value in values.items() if value != other[name]}

    candidates = [(profile, size, changed(profile, size)) for profile in built_profiles() for size in sizes()]
    return min(candidates, key=lambda candidate: len(candidate[2]))


def _options(options: Options) -> dict[str, Any]:
    """All but the hyperparameters, in plain JSON types."""
    values = {field.name: getattr(options, field.name) for field in dataclasses.fields(options) if field.name != "config"}
    return {name: str(value) if isinstance(value, Path) else value for name, value in values.items()}


def _show(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _write(path: Path, text: str) -> None:
    temporary = path.with_suffix(".tmp")
    with writing(path):
        with temporary.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
