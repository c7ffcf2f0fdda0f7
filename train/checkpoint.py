"""Checkpoints: one directory each, complete or absent, nothing pickled.

LOGDIR/checkpoints/<environment step>/
  learner.safetensors   the training state under its canonical names (spec/10-agent.md): either backend reads it
  drawn.safetensors     the batch that was drawn ahead
  run.json              configuration, spaces, counters, and which state of LOGDIR/replay belongs to it: [LOOP-21]
"""

import dataclasses
import json
import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from train.errors import UserError

FORMAT = 2
OURS = re.compile(r"\d{12}(\.tmp|\.old)?")  # .tmp: being written; .old: about to be replaced by the same step

Arrays = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """info: format, identity (train.options.Options.identity), backend, spaces, counters, replay_ratio, random_return, evaluation."""

    path: Path
    info: dict[str, Any]

    @property
    def learner(self) -> Arrays:
        return _read_arrays(self.path / "learner.safetensors")

    @property
    def drawn(self) -> Arrays:
        return _read_arrays(self.path / "drawn.safetensors")


def name_of(step: int) -> str:
    """The name of the checkpoint of an environment step."""
    return f"{step:012d}"


def save(logdir: Path, step: int, learner: Mapping[str, Any], drawn: Mapping[str, Any], info: Mapping[str, Any]) -> Path:
    """Writes a checkpoint under another name, renames it, then removes the older ones. [LOOP-22]

    Raises:
      UserError: the disk refuses it.
    """
    directory = logdir / "checkpoints"
    final, temporary = directory / name_of(step), directory / f"{name_of(step)}.tmp"
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        save_file(_contiguous(_single_precision(learner)), temporary / "learner.safetensors")
        save_file(_contiguous(drawn), temporary / "drawn.safetensors")
        (temporary / "run.json").write_text(json.dumps({"format": FORMAT, **info}, indent=2) + "\n", encoding="utf-8")
        for file in temporary.iterdir():
            _flush_to_disk(file)
        if final.exists():  # The same step again, as before and after the last evaluation.
            final.rename(directory / f"{name_of(step)}.old")
        temporary.rename(final)
        for other in directory.iterdir():
            if other != final and OURS.fullmatch(other.name):
                shutil.rmtree(other)
    except (OSError, SafetensorError) as error:
        raise UserError(f"cannot write the checkpoint {final}: {error}") from error
    return final


def find(logdir: Path) -> Checkpoint | None:
    """The newest checkpoint of a log directory, or None.

    Raises:
      UserError: a checkpoint that cannot be read, or of another format.
    """
    found = (path for path in (logdir / "checkpoints").glob("*") if OURS.fullmatch(path.name) and path.suffix != ".tmp")
    paths = sorted(found, key=lambda path: (path.stem, path.suffix == ""))
    if not paths:
        return None
    try:
        info = json.loads((paths[-1] / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"the checkpoint {paths[-1]} is damaged: {error}") from error
    if info.get("format") != FORMAT:
        raise UserError(f"the checkpoint {paths[-1]} has format {info.get('format')}; this version reads format {FORMAT}")
    return Checkpoint(paths[-1], info)


def require_same_identity(checkpoint: Checkpoint, given: Mapping[str, Any]) -> None:
    """Raises:
    UserError: the checkpoint is of another configuration; the message lists name, value in the checkpoint, value given.
    """
    _require_same(checkpoint, checkpoint.info["identity"], given)


def require_same_spaces(checkpoint: Checkpoint, given: Mapping[str, Any]) -> None:
    """Raises:
    UserError: the task's spaces are not those of the checkpoint; the message lists them.
    """
    _require_same(checkpoint, _entries(checkpoint.info["spaces"]), _entries(given))


def _require_same(checkpoint: Checkpoint, saved: Mapping[str, Any], given: Mapping[str, Any]) -> None:
    given = json.loads(json.dumps(given))  # Tuples become lists, as in the file.
    names = [name for name in {**saved, **given} if saved.get(name) != given.get(name)]
    if names:
        differences = "; ".join(f"{name}: {_show(saved.get(name))} in the checkpoint, {_show(given.get(name))} given" for name in names)
        logdir = checkpoint.path.parent.parent
        raise UserError(f"{logdir} holds a run of another configuration: {differences}. Give the same options, or another --logdir")


def _entries(spaces: Mapping[str, Any]) -> dict[str, Any]:
    """observations: {x: ...} -> "observations x": ..., so that a difference names one key."""
    return {f"{kind} {key}": entry for kind, entries in spaces.items() for key, entry in entries.items()}


def _show(value: Any) -> str:
    return json.dumps(value) if isinstance(value, dict | list) else str(value)


def _single_precision(arrays: Mapping[str, Any]) -> Arrays:
    """[AGT-9]: a checkpoint is float32, also of a run that computes in float64."""
    return {name: np.asarray(array, np.float32 if np.asarray(array).dtype == np.float64 else None) for name, array in arrays.items()}


def _contiguous(arrays: Mapping[str, Any]) -> Arrays:
    return {name: np.array(array, order="C", copy=None) for name, array in arrays.items()}


def _read_arrays(path: Path) -> Arrays:
    try:
        return load_file(path)
    except (OSError, SafetensorError) as error:
        raise UserError(f"the checkpoint file {path} is damaged: {error}") from error


def _flush_to_disk(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())
