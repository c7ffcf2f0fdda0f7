"""Saved states of a buffer: what makes the content at a checkpoint come back exactly.

  saved-<epoch>.safetensors   items, queue, streams, chunks and their checksums at a save; small, written in one go
  journal-<epoch>.bin         what was overwritten between this save and the next (train/replay/journal.py)

Records are only ever appended, so a save needs to know no more than how many there were. A chunk that holds no record any more is
deleted when no kept save refers to it.
"""

import dataclasses
import json
import os
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load, save

from train.replay.chunks import chunk_numbers, chunk_path, disk_errors
from train.replay.journal import Journal, journal_epochs, journal_path

FORMAT = 1
_ARRAYS = {"items": (1,), "queue": (1,), "streams": (2, 3), "chunks": (2, 4), "sums": (2,), "block_sums": (2,), "workers": (2, 2)}
_UNSIGNED = ("sums", "block_sums")


@dataclasses.dataclass(frozen=True)
class Saved:
    """A kept save. chunks: the numbers of the files that it needs."""

    name: str
    chunks: frozenset[int]


class History:
    """The epochs of a directory: an epoch begins with a save, epoch 0 with an empty buffer.

    kept: epoch -> save that can be restored. journal: of the epoch that is going on, None in epoch 0, when nothing could be restored.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.epoch = 0
        self.next_chunk = 0
        self.journal: Journal | None = None
        self.kept: dict[int, Saved] = {}
        self._retired: set[int] = set()

    def new_chunk(self) -> int:
        """A number that no chunk file has had."""
        self.next_chunk += 1
        return self.next_chunk - 1

    def retire(self, chunk: int) -> bool:
        """Whether the file of a chunk without held records may be deleted now; if not, it is when the saves that need it go."""
        needed = any(chunk in saved.chunks for saved in self.kept.values())
        if needed:
            self._retired.add(chunk)
        return not needed

    def begin_epoch(self, name: str, arrays: Mapping[str, NDArray[Any]], facts: Mapping[str, Any]) -> dict[str, Any]:
        """Writes a saved state and begins the next epoch. Returns its description.

        Raises:
          UserError: the disk refuses it; nothing has changed.
        """
        epoch = self.epoch + 1
        metadata = json.dumps({**facts, "format": FORMAT, "name": name, "epoch": epoch})
        data = save({key: np.ascontiguousarray(array) for key, array in arrays.items()}, metadata={"replay": metadata})
        path = saved_path(self.directory, epoch)
        temporary = path.with_suffix(".tmp")
        with disk_errors(self.directory):
            try:
                with temporary.open("wb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
                journal = Journal(self.directory, epoch)
                temporary.rename(path)
                flush_directory(self.directory)
            except OSError:
                temporary.unlink(missing_ok=True)
                raise
        if self.journal:
            self.journal.close()
        self.journal, self.epoch = journal, epoch
        self.kept[epoch] = Saved(name, frozenset(arrays["chunks"][:, 0].tolist()))
        return {"format": FORMAT, "name": name, "file": path.name, "crc32": zlib.crc32(data)}

    def keep(self, names: Iterable[str]) -> None:
        """Lets go of all saves but the newest of each name, and deletes what only they needed."""
        newest = {saved.name: epoch for epoch, saved in sorted(self.kept.items())}
        wanted = {newest[name] for name in names if name in newest}
        for epoch in set(self.kept) - wanted:
            del self.kept[epoch]
            saved_path(self.directory, epoch).unlink(missing_ok=True)
        for epoch in journal_epochs(self.directory):
            if epoch < min(self.kept, default=self.epoch) and epoch != self.epoch:
                journal_path(self.directory, epoch).unlink(missing_ok=True)
        for chunk in [chunk for chunk in self._retired if self.retire(chunk)]:
            self._retired.discard(chunk)
            chunk_path(self.directory, chunk).unlink(missing_ok=True)

    def resume(self, epoch: int, chunks: set[int], needed: set[int], warnings: list[str]) -> None:
        """Makes a directory be at the beginning of an epoch, after its latents have been undone.

        Args:
          chunks: the files that the saved state needs. needed: those of them that the buffer still uses.
        """
        for later in reversed(journal_epochs(self.directory)):  # The newest first: what is left must undo the same, if this is interrupted.
            if later > epoch:
                journal_path(self.directory, later).unlink()
        self.journal, self.epoch = Journal(self.directory, epoch), epoch
        for other in saved_epochs(self.directory):
            try:
                self.kept[other] = read_kept(saved_path(self.directory, other))
            except ValueError as error:
                warnings.append(f"{error}: this older state is given up")
                saved_path(self.directory, other).unlink()
        present = chunk_numbers(self.directory)
        self.next_chunk = max([*present, *chunks], default=-1) + 1
        for chunk in present:
            if chunk not in needed and self.retire(chunk):
                chunk_path(self.directory, chunk).unlink()


def saved_path(directory: Path, epoch: int) -> Path:
    return directory / f"saved-{epoch:010d}.safetensors"


def saved_epochs(directory: Path) -> list[int]:
    """The epochs of all saved states of a directory, oldest first."""
    stems = (path.stem.removeprefix("saved-") for path in directory.glob("saved-*.safetensors"))
    return sorted(int(stem) for stem in stems if stem.isdigit())


def erase(directory: Path) -> None:
    """Deletes the files of a replay buffer from a directory, and nothing else."""
    for file in buffer_files(directory):
        file.unlink()


def buffer_files(directory: Path) -> list[Path]:
    return [path for pattern in ("chunk-*.bin", "journal-*.bin", "saved-*") for path in sorted(directory.glob(pattern))]


def read_kept(path: Path) -> Saved:
    """Raises:
    ValueError: the file is damaged; the message names it.
    """
    try:
        with safe_open(path, framework="numpy") as file:
            facts = json.loads((file.metadata() or {})["replay"])
            return Saved(str(facts["name"]), frozenset(file.get_tensor("chunks")[:, 0].tolist()))
    except (OSError, SafetensorError, KeyError, TypeError, IndexError, ValueError, RecursionError) as error:
        raise ValueError(f"the replay file {path} is damaged: {error}") from error


def read_saved(directory: Path, description: Any) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """The arrays and the facts of a saved state, its checksum compared.

    Raises:
      ValueError: the description is none, or the file is missing, damaged, or of another format; the message names the file.
    """
    try:
        name, expected = str(description["file"]), int(description["crc32"])
        known = description["format"] == FORMAT
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"not a description of a replay state: {error!r}") from error
    path = directory / name
    if not known or path.name != name:
        raise ValueError(f"not a description of a replay state of format {FORMAT}: {description!r}")
    try:
        data = path.read_bytes()
        if zlib.crc32(data) != expected:
            raise ValueError(f"checksum {zlib.crc32(data):08x}, expected {expected:08x}")
        arrays = load(data)
        with safe_open(path, framework="numpy") as file:
            facts = json.loads((file.metadata() or {})["replay"])
        _require_arrays(arrays, facts)
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"the replay file {path} is damaged: {error}") from error
    return arrays, facts


def _require_arrays(arrays: Mapping[str, NDArray[Any]], facts: Any) -> None:
    """Raises:
    ValueError: arrays or facts that no save writes.
    """
    for key, (dimensions, *columns) in _ARRAYS.items():
        array = arrays[key]
        if array.ndim != dimensions or list(array.shape[1:])[: len(columns)] != columns:
            raise ValueError(f"{key} has the shape {array.shape}")
        if array.dtype != (np.uint32 if key in _UNSIGNED else np.int64) or (array.size and array.min() < 0):
            raise ValueError(f"{key} holds something else than numbers from 0")
    if {len(arrays["chunks"])} != {len(arrays["sums"]), len(arrays["block_sums"])}:
        raise ValueError("there are not as many checksums as chunks")
    for key in ("format", "epoch", "length", "next_stream", "block_records", "chunk_records"):
        if not isinstance(facts[key], int) or facts[key] < 0:
            raise ValueError(f"{key} is {facts[key]!r}")
    if facts["format"] != FORMAT:
        raise ValueError(f"format {facts['format']}; this version reads {FORMAT}")


def flush_directory(directory: Path) -> None:
    fd = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
