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

from dreamer_spec import arguments as keywords
from dreamer_spec.disk.files import free_name, read_json, replacing
from dreamer_spec.errors import writing
from dreamer_spec.options import Options, defaults
from dreamer_spec.system.machine import describe
from spec import Config, Spaces, built_profiles, load_config, sizes

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
    given_anew: Mapping[str, Any] | None = None,
    origin: Mapping[str, Any] | None = None,
    understood: Sequence[str] = (),
) -> About:
    """Writes LOGDIR/run.json, complete or not at all, and returns what stands there.

    device: as the learner names it. parameters: how many numbers are trained. preflight: its result, None if it was
    skipped. resumed_at: the environment step of the checkpoint that is continued, None for a new run. given_anew: name
    -> [value before, value from here on] of the options that a resumed run was given. origin: where the parameters of a
    new run come from, if not from its seed. A resumed run keeps its `id`, its `origin` and its earlier `starts`; all
    else describes this start. understood: what the environment's spaces became, in words.

    Raises:
      UserError: the disk refuses it.
    """
    path = options.logdir / NAME
    earlier = (resumed_at is not None and read_about(options.logdir)) or {}
    if (
        resumed_at is not None and not earlier and os.path.lexists(path)
    ):  # Damaged, or of another program: the checkpoints are ours.
        with writing(path):
            path.rename(free_name(path.with_name(f"{NAME}.damaged")))
    profile, size, changed = nearest(options.config)
    machine = describe()
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    start = {"time": now, "step": resumed_at or 0, "backend": options.backend, "device": device}
    start |= {name: machine[name] for name in ("accelerator", "python", "versions", "commit")}
    start["changed"] = dict(given_anew or {})
    known, starts = earlier.get("id"), earlier.get("starts")
    about = {
        "format": FORMAT,
        "has_checkpoint": resumed_at is not None,
        "id": known if isinstance(known, str) else secrets.token_hex(8),
        "command": shlex.join(command_line(options)),
        "task": options.task,
        "backend": options.backend,
        "device": device,
        "profile": profile,
        "size": size,
        "parameters": parameters,
        "origin": earlier.get("origin") if resumed_at is not None else origin,
        "options": options_json(options),
        "hyperparameters": dataclasses.asdict(options.config),
        "changed_hyperparameters": changed,
        "spaces": spaces.to_json(),
        "understood": list(understood),
        "preflight": dataclasses.asdict(preflight) if preflight else None,
        "machine": machine,
        "starts": [*(starts if isinstance(starts, list) else []), start],
    }
    return write_json(path, about)


def read_about(logdir: Path) -> About | None:
    """What run.json says; None if it is not there, damaged or of another format. No entry can be relied on.

    Raises:
      Unreadable.
    """
    try:
        about = read_json(logdir / NAME)
    except (FileNotFoundError, ValueError):
        return None
    return about if about.get("format") == FORMAT else None


def write_json(path: Path, value: About) -> About:
    """Writes run.json, complete or not at all, and returns what stands there: ? for the bytes of a path that is not
    UTF-8.

    Raises:
      UserError: the disk refuses it.
    """
    data = (json.dumps(value, indent=1, ensure_ascii=False) + "\n").encode("utf-8", "replace")
    with writing(path), replacing(path) as file:
        file.write(data)
    return json.loads(data)


def command_line(options: Options) -> list[str]:
    """The words of a command that gives these options, whatever the presets are."""
    profile, size, changed = nearest(options.config)
    usual = defaults()
    words = ["train", "--backend", options.backend, "--task", options.task, "--profile", profile, "--size", size]
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if field.name in ("backend", "task", "make", "config", "env_arg") or value == usual.get(field.name):
            continue
        flag = field.name.rstrip("_").replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            words += [f"--{flag}", _show(value)]
    words += [word for argument in keywords.write(options.env_arg) for word in ("--env-arg", argument)]
    for name, value in changed.items():
        words += [f"--{name.replace('_', '-')}", _show(value)]
    return words


def nearest(config: Config) -> tuple[str, str, dict[str, Any]]:
    """The profile and the size that come nearest to a configuration, and the hyperparameters in which it differs from
    them."""
    values = dataclasses.asdict(config)

    def changed(profile: str, size: str) -> dict[str, Any]:
        other = dataclasses.asdict(load_config(profile, size))
        return {name: value for name, value in values.items() if value != other[name]}

    candidates = [(profile, size, changed(profile, size)) for profile in built_profiles() for size in sizes()]
    return min(candidates, key=lambda candidate: len(candidate[2]))


def options_json(options: Options) -> dict[str, Any]:
    """All but the hyperparameters, in plain JSON types."""
    values = {
        field.name: getattr(options, field.name)
        for field in dataclasses.fields(options)
        if field.name not in ("config", "make")
    }
    return {name: str(value) if isinstance(value, Path) else value for name, value in values.items()}


def _show(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
