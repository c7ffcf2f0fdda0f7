"""Checkpoints: one directory each, complete or absent, nothing pickled.

LOGDIR/checkpoints/<environment step>/
  learner.safetensors   the training state under its canonical names (spec/10-agent.md): either backend reads it
  loop.safetensors      what the loop held: the batch drawn ahead, the records of the moment, carries, and the actions
                        of the episodes under way
  checkpoint.json       configuration, spaces, counters, and which state of LOGDIR/replay belongs to it: [LOOP-21]
  SHA256SUMS            checksums of the other files, which `sha256sum --check` reads too
"""

import dataclasses
import json
import os
import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dreamer_spec.disk.files import Arrays, entries, free_name, reading
from dreamer_spec.disk.folders import SUMS, Sealed, discard, holds_any, open_sealed, require_intact, write_folder
from dreamer_spec.errors import UserError
from dreamer_spec.options import may_change

FORMAT = 4  # Since 4 it says how the environment's values are translated: what a policy made of it needs to act.
ONCE_COMPLETE = re.compile(r"[0-9]{12}(\.old)?")  # .old: about to be replaced by the same step
UNFINISHED = re.compile(r"[0-9]{12}(\.old)?\.[0-9a-f]{8}\.tmp")  # being written, or being removed
FILES = ("learner.safetensors", "loop.safetensors", "checkpoint.json")
ATTEMPTS, PAUSE = 100, 0.01  # to read a checkpoint that a run replaces meanwhile; seconds between two


class Damaged(UserError):
    """A checkpoint whose files were read and are not those that were written."""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """info: format, identity (dreamer_spec.options.Options.identity), backend, spaces, counters, and what else
    dreamer_spec/training/resume.py puts there.

    Its files stay open, so that it can be read to the end even if the run removes it meanwhile.
    """

    path: Path
    info: dict[str, Any]
    sealed: Sealed = dataclasses.field(repr=False)

    @property
    def learner(self) -> Arrays:
        return self._arrays("learner.safetensors")

    @property
    def loop(self) -> Arrays:
        return self._arrays("loop.safetensors")

    def _arrays(self, name: str) -> Arrays:
        try:
            return self.sealed.arrays(name)
        except ValueError as error:
            raise _damaged(self.path, error) from error


def name_of(step: int) -> str:
    """The name of the checkpoint of an environment step."""
    return f"{step:012d}"


def save(
    logdir: Path, step: int, learner: Mapping[str, Any], loop: Mapping[str, Any], info: Mapping[str, Any], keep: int
) -> Path:
    """Writes a checkpoint under another name, renames it, then removes all but the newest `keep`. [LOOP-22]

    What others have put into the folder `checkpoints` or into a checkpoint stays where it is: [LOOP-52].

    Raises:
      UserError: the disk refuses it, or something else has its name.
    """
    final = logdir / "checkpoints" / name_of(step)
    contents = _single_precision(learner), loop, {"format": FORMAT, **info}
    write_folder(final, dict(zip(FILES, contents, strict=True)), "checkpoint")
    kept = [path for path in candidates(logdir) if path.suffix == ""][:keep]
    for path in entries(final.parent):
        if path not in kept and (ONCE_COMPLETE.fullmatch(path.name) or UNFINISHED.fullmatch(path.name)):
            discard(path, FILES)
    return final


def candidates(logdir: Path) -> list[Path]:
    """The checkpoints of a log directory that were once complete, the newest first.

    Raises:
      Unreadable: the folder of the checkpoints, or one of them, cannot be looked into.
    """
    inside = entries(logdir / "checkpoints")
    found = [path for path in inside if ONCE_COMPLETE.fullmatch(path.name) and holds_any(path, FILES)]
    return sorted(found, key=lambda path: (path.stem, path.suffix == ""), reverse=True)


def set_aside(checkpoint: Path) -> Path:
    """Renames a damaged checkpoint, so that it is neither used nor removed. Returns its new path.

    Raises:
      UserError: the disk refuses it.
    """
    try:
        return checkpoint.rename(free_name(checkpoint.with_name(f"{checkpoint.name}.damaged")))
    except OSError as error:
        raise UserError(
            f"cannot rename the damaged checkpoint {checkpoint}: {error.strerror}; remove it yourself"
        ) from error


def open_checkpoint(path: Path) -> Checkpoint:
    """The checkpoint in a folder, or the newest one of a log directory or of its folder `checkpoints`.

    A run may replace it meanwhile: then the one that takes its place is read.

    Raises:
      Damaged: a file is missing or not what was written.
      Unreadable: it cannot be read now.
      UserError: there is none, or it has another format.
    """
    is_one = ONCE_COMPLETE.fullmatch(path.name) is not None or os.path.lexists(path / SUMS)
    for _ in range(ATTEMPTS):
        found = [path] if is_one else candidates(path.parent if path.name == "checkpoints" else path)
        before = _identity(found[0]) if found else None
        try:
            if before:
                return _open(found[0])
        except FileNotFoundError:
            pass
        except Damaged:
            if _identity(found[0]) == before:
                raise
        time.sleep(PAUSE)
    if not is_one and not found:
        raise UserError(
            f"no checkpoint in {path}; expected a log directory of `train`, or one of the folders in its checkpoints/"
        )
    raise UserError(
        f"the checkpoint {path} is not there"
        if not before
        else f"{path} is replaced faster than it can be read; try again"
    )


def _identity(path: Path) -> tuple[int, int] | None:
    """What tells a folder from one that takes its place; None if there is none."""
    try:
        with reading(path):
            found = os.stat(path)
    except FileNotFoundError:
        return None
    return found.st_dev, found.st_ino


def _open(path: Path) -> Checkpoint:
    try:
        sealed = open_sealed(path, FILES)
        info = sealed.json("checkpoint.json")
        if info.get("format") != FORMAT:
            raise UserError(
                f"the checkpoint {path} has format {info.get('format')!r:.80}; this version reads format {FORMAT}"
            )
        require_intact(sealed, FILES)
    except ValueError as error:
        raise _damaged(path, error) from error
    return Checkpoint(path, info, sealed)


def _damaged(path: Path, error: Exception) -> Damaged:
    return Damaged(f"the checkpoint {path} is damaged: {error!s:.500}")


def require_same_identity(checkpoint: Checkpoint, given: Mapping[str, Any]) -> None:
    """Raises:
    UserError: the checkpoint is of another configuration; the message lists name, value in the checkpoint, value given.
    What may change when a run is continued is not compared: [LOOP-70].
    """
    saved = checkpoint.info["identity"]
    _require_same(
        checkpoint,
        *({name: value for name, value in one.items() if name not in may_change()} for one in (saved, given)),
    )


def require_same_spaces(checkpoint: Checkpoint, given: Mapping[str, Any]) -> None:
    """Raises:
    UserError: the task's spaces are not those of the checkpoint; the message lists them.
    """
    _require_same(checkpoint, space_entries(checkpoint.info["spaces"]), space_entries(given))


def require_same_translation(checkpoint: Checkpoint, given: Mapping[str, Any]) -> None:
    """Raises:
    UserError: bounds, dtypes or keys of the task are not those of the checkpoint; the message lists them. [LOOP-64]
    """
    _require_same(
        checkpoint, space_entries(checkpoint.info["translation"]), space_entries(json.loads(json.dumps(given)))
    )


def _require_same(checkpoint: Checkpoint, saved: Mapping[str, Any], given: Mapping[str, Any]) -> None:
    found = differences(saved, given)
    if found:
        logdir = checkpoint.path.parent.parent
        raise UserError(
            f"{logdir} holds a run of another configuration: {'; '.join(found)}. These may not change half "
            f"way: give the same options, or "
            "another --logdir"
        )


def differences(saved: Mapping[str, Any], given: Mapping[str, Any]) -> list[str]:
    """A text for each name whose value in a checkpoint is not the given one."""
    saved, given = json.loads(json.dumps([saved, given]))  # Tuples become lists, as in the file.
    names = [name for name in {**saved, **given} if saved.get(name) != given.get(name)]
    return [f"{name}: {_show(saved.get(name))} in the checkpoint, {_show(given.get(name))} given" for name in names]


def space_entries(spaces: Mapping[str, Any]) -> dict[str, Any]:
    """observations: {x: ...} -> "observations x": ..., so that a difference names one key."""
    named = {
        kind: entries if isinstance(entries, dict) else dict(enumerate(entries)) for kind, entries in spaces.items()
    }
    return {f"{kind} {key}": entry for kind, entries in named.items() for key, entry in entries.items()}


def _show(value: Any) -> str:
    return json.dumps(value) if isinstance(value, dict | list) else str(value)


def _single_precision(arrays: Mapping[str, Any]) -> Arrays:
    """[AGT-9]: a checkpoint is float32, also of a run that computes in float64."""
    return {
        name: np.asarray(array, np.float32 if np.asarray(array).dtype == np.float64 else None)
        for name, array in arrays.items()
    }
