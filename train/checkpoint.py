"""Checkpoints: one directory each, complete or absent, nothing pickled.

LOGDIR/checkpoints/<environment step>/
  learner.safetensors   the training state under its canonical names (spec/10-agent.md): either backend reads it
  loop.safetensors      what the loop held: the batch drawn ahead, the records of the moment, carries, actions of the episodes under way
  run.json              configuration, spaces, counters, and which state of LOGDIR/replay belongs to it: [LOOP-21]
  SHA256SUMS            checksums of the other files, which `sha256sum --check` reads too
"""

import dataclasses
import json
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import save_file

from train.errors import UserError
from train.files import SUMS, Arrays, flush, read_arrays, read_json, require_intact, seal

FORMAT = 4  # Since 4 it says how the environment's values are translated: what a policy made of it needs to act.
OURS = re.compile(r"\d{12}(\.tmp|\.old)?")  # .tmp: being written; .old: about to be replaced by the same step
FILES = ("learner.safetensors", "loop.safetensors", "run.json")


class Damaged(UserError):
    """A checkpoint whose files are not those that were written."""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """info: format, identity (train.options.Options.identity), backend, spaces, counters, and what else train/resume.py puts there."""

    path: Path
    info: dict[str, Any]

    @property
    def learner(self) -> Arrays:
        return _read_arrays(self.path / "learner.safetensors")

    @property
    def loop(self) -> Arrays:
        return _read_arrays(self.path / "loop.safetensors")


def name_of(step: int) -> str:
    """The name of the checkpoint of an environment step."""
    return f"{step:012d}"


def save(logdir: Path, step: int, learner: Mapping[str, Any], loop: Mapping[str, Any], info: Mapping[str, Any], keep: int) -> Path:
    """Writes a checkpoint under another name, renames it, then removes all but the newest `keep`. [LOOP-22]

    Raises:
      UserError: the disk refuses it.
    """
    directory = logdir / "checkpoints"
    final, temporary = directory / name_of(step), directory / f"{name_of(step)}.tmp"
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        save_file(_contiguous(_single_precision(learner)), temporary / "learner.safetensors")
        save_file(_contiguous(loop), temporary / "loop.safetensors")
        (temporary / "run.json").write_text(json.dumps({"format": FORMAT, **info}, indent=2) + "\n", encoding="utf-8")
        seal(temporary, FILES)
        if final.exists():  # The same step again, as before and after the last evaluation.
            old = directory / f"{name_of(step)}.old"
            if old.exists():  # A process was killed before it could remove it.
                shutil.rmtree(old)
            final.rename(old)
        temporary.rename(final)
        flush(directory)
        kept = [path for path in candidates(logdir) if path.suffix == ""][:keep]
        for other in directory.iterdir():
            if other not in kept and OURS.fullmatch(other.name):
                shutil.rmtree(other)
    except (OSError, SafetensorError) as error:
        raise UserError(f"cannot write the checkpoint {final}: {error}") from error
    return final


def candidates(logdir: Path) -> list[Path]:
    """The checkpoints of a log directory that were once complete, the newest first."""
    found = (path for path in (logdir / "checkpoints").glob("*") if OURS.fullmatch(path.name) and path.suffix != ".tmp")
    return sorted(found, key=lambda path: (path.stem, path.suffix == ""), reverse=True)


def set_aside(checkpoint: Path) -> Path:
    """Renames a damaged checkpoint, so that it is neither used nor removed. Returns its new path.

    Raises:
      UserError: the disk refuses it.
    """
    aside = checkpoint.with_name(f"{checkpoint.name}.damaged")
    try:
        shutil.rmtree(aside, ignore_errors=True)
        return checkpoint.rename(aside)
    except OSError as error:
        raise UserError(f"cannot rename the damaged checkpoint {checkpoint}: {error.strerror}; remove it yourself") from error


def open_checkpoint(path: Path) -> Checkpoint:
    """The checkpoint in a folder, or the newest one of a log directory or of its folder `checkpoints`.

    Raises:
      Damaged: a file is missing or not what was written.
      UserError: there is none, or it has another format.
    """
    if not OURS.fullmatch(path.name) and not (path / SUMS).exists():
        found = candidates(path.parent if path.name == "checkpoints" else path)
        if not found:
            raise UserError(f"no checkpoint in {path}; expected a log directory of `train`, or one of the folders in its checkpoints/")
        path = found[0]
    try:
        info = read_json(path / "run.json")
        if info.get("format") != FORMAT:
            raise UserError(f"the checkpoint {path} has format {info.get('format')!r:.80}; this version reads format {FORMAT}")
        require_intact(path, FILES)
    except (OSError, ValueError) as error:
        raise Damaged(f"the checkpoint {path} is damaged: {error!s:.500}") from error
    return Checkpoint(path, info)


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


def require_same_translation(checkpoint: Checkpoint, given: Mapping[str, Any]) -> None:
    """Raises:
    UserError: bounds, dtypes or keys of the task are not those of the checkpoint; the message lists them. [LOOP-64]
    """
    _require_same(checkpoint, _entries(checkpoint.info["translation"]), _entries(json.loads(json.dumps(given))))


def _require_same(checkpoint: Checkpoint, saved: Mapping[str, Any], given: Mapping[str, Any]) -> None:
    given = json.loads(json.dumps(given))  # Tuples become lists, as in the file.
    names = [name for name in {**saved, **given} if saved.get(name) != given.get(name)]
    if names:
        differences = "; ".join(f"{name}: {_show(saved.get(name))} in the checkpoint, {_show(given.get(name))} given" for name in names)
        logdir = checkpoint.path.parent.parent
        raise UserError(f"{logdir} holds a run of another configuration: {differences}. Give the same options, or another --logdir")


def _entries(spaces: Mapping[str, Any]) -> dict[str, Any]:
    """observations: {x: ...} -> "observations x": ..., so that a difference names one key."""
    named = {kind: entries if isinstance(entries, dict) else dict(enumerate(entries)) for kind, entries in spaces.items()}
    return {f"{kind} {key}": entry for kind, entries in named.items() for key, entry in entries.items()}


def _show(value: Any) -> str:
    return json.dumps(value) if isinstance(value, dict | list) else str(value)


def _single_precision(arrays: Mapping[str, Any]) -> Arrays:
    """[AGT-9]: a checkpoint is float32, also of a run that computes in float64."""
    return {name: np.asarray(array, np.float32 if np.asarray(array).dtype == np.float64 else None) for name, array in arrays.items()}


def _contiguous(arrays: Mapping[str, Any]) -> Arrays:
    return {name: np.array(array, order="C", copy=None) for name, array in arrays.items()}


def _read_arrays(path: Path) -> Arrays:
    try:
        return read_arrays(path)
    except (OSError, ValueError) as error:
        raise Damaged(f"the checkpoint {path.parent} is damaged: {error!s:.500}") from error
