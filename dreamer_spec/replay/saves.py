"""Saved states of a buffer: what makes the content at a checkpoint come back exactly.

  saved-<epoch>.safetensors   items, queue, streams, chunks and their checksums at a save; small, written in one go
  journal-<epoch>.bin         what was overwritten between this save and the next (dreamer_spec/replay/journal.py)

Records are only ever appended, so a save needs to know no more than how many there were. A chunk that holds no record
any more is deleted when no kept save refers to it.
"""

import dataclasses
import json
import re
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from conformance.schema import closed, misfit, validator
from dreamer_spec.disk.files import Unreadable, entries, flush, free_name, open_file, reading, replacing
from dreamer_spec.replay.chunks import chunk_numbers, chunk_path, disk_errors, next_number, numbers
from dreamer_spec.replay.journal import Journal, journal_epochs, journal_path

FORMAT = 1
_ARRAYS = {
    "items": (1,),
    "queue": (1,),
    "streams": (2, 3),
    "chunks": (2, 4),
    "sums": (2,),
    "block_sums": (2,),
    "workers": (2, 2),
}
_UNSIGNED = ("sums", "block_sums")
_COUNTS = ("format", "epoch", "length", "next_stream", "block_records", "chunk_records")
_COUNT, _TEXT = {"type": "integer", "minimum": 0}, {"type": "string"}
_FACTS = validator(
    {
        "type": "object",
        "properties": dict.fromkeys(_COUNTS, _COUNT) | {"name": _TEXT},
        "required": [*_COUNTS, "name", "layout"],
    }
)
_DESCRIPTION = validator(
    closed(
        {
            "format": {"const": FORMAT},
            "name": _TEXT,
            "file": _TEXT | {"pattern": r"^saved-[0-9]{10}\.safetensors\Z"},
            "crc32": _COUNT,
        }
    )
)
_UNFINISHED = re.compile(r"\.saved-[0-9]{10}\.safetensors-[0-9a-f]{8}\.tmp")


@dataclasses.dataclass(frozen=True)
class Saved:
    """A kept save. chunks: the numbers of the files that it needs."""

    name: str
    chunks: frozenset[int]


class Epochs:
    """The epochs of a directory: an epoch begins with a save, epoch 0 with an empty buffer.

    kept: epoch -> save that can be restored. journal: of the epoch that is going on, None in epoch 0, when nothing
    could be restored.
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
        """Whether the file of a chunk without held records may be deleted now; if not, it is when the saves that need
        it go."""
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
        with disk_errors(self.directory):
            with replacing(path) as file:
                file.write(data)
                journal = Journal(self.directory, epoch)  # Before the name: a state that can be restored has a journal.
            flush(self.directory)
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
        for later in reversed(
            journal_epochs(self.directory)
        ):  # The newest first: what is left must undo the same, if this is interrupted.
            if later > epoch:
                journal_path(self.directory, later).unlink()
        self.journal, self.epoch = Journal(self.directory, epoch), epoch
        for other in saved_epochs(self.directory):
            try:
                self.kept[other] = read_kept(saved_path(self.directory, other))
            except (FileNotFoundError, ValueError) as error:
                warnings.append(f"{error}: this older state is given up")
                saved_path(self.directory, other).unlink(missing_ok=True)
        for path in entries(self.directory):
            if _UNFINISHED.fullmatch(path.name):  # A process was killed while it wrote it.
                path.unlink(missing_ok=True)
        self.next_chunk = max([next_number(self.directory), *(chunk + 1 for chunk in chunks)])
        for chunk in chunk_numbers(self.directory):
            if chunk not in needed and self.retire(chunk):
                chunk_path(self.directory, chunk).unlink()


def saved_path(directory: Path, epoch: int) -> Path:
    return directory / f"saved-{epoch:010d}.safetensors"


def saved_epochs(directory: Path) -> list[int]:
    """The epochs of all saved states of a directory, oldest first."""
    return numbers(directory, "saved-", ".safetensors")


def erase(directory: Path) -> None:
    """Deletes the files of a replay buffer from a directory, and nothing else.

    Raises:
      UserError: the disk refuses it.
    """
    with disk_errors(directory):
        for file in buffer_files(directory):
            file.unlink()


def set_aside(directory: Path) -> Path:
    """Moves the files of a replay buffer that cannot be restored into a new folder in it, which is returned. [REP-37]

    Raises:
      UserError: the disk refuses it.
    """
    folder = free_name(directory / "damaged")
    with disk_errors(directory):
        folder.mkdir()
        for file in buffer_files(directory):
            file.rename(folder / file.name)
    return folder


def buffer_files(directory: Path) -> list[Path]:
    """The files of a directory that are a replay buffer's: [REP-36].

    Raises:
      Unreadable.
    """
    chunks = [chunk_path(directory, number) for number in chunk_numbers(directory)]
    journals = [journal_path(directory, epoch) for epoch in journal_epochs(directory)]
    states = [saved_path(directory, epoch) for epoch in saved_epochs(directory)]
    return [*chunks, *journals, *states, *(path for path in entries(directory) if _UNFINISHED.fullmatch(path.name))]


def read_kept(path: Path) -> Saved:
    """Raises:
    FileNotFoundError, Unreadable.
    ValueError: the file is damaged; the message names it.
    """
    arrays, facts = _parse(path, _read(path))
    return Saved(facts["name"], frozenset(arrays["chunks"][:, 0].tolist()))


def read_saved(directory: Path, description: Any) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """The arrays and the facts of a saved state, its checksum compared.

    Raises:
      Unreadable: also where the directory holds no buffer at all: then it is away, and not damaged.
      ValueError: the description is none, or the file is missing, damaged or of another format; the message names the
        file.
    """
    if problem := misfit(description, _DESCRIPTION):
        raise ValueError(f"not a description of a replay state of format {FORMAT}: {problem}")
    path, expected = directory / description["file"], description["crc32"]
    try:
        data = _read(path)
    except FileNotFoundError:
        if buffer_files(directory) or (directory / "damaged").is_dir():
            raise ValueError(f"the replay file {path} is missing") from None
        raise Unreadable(
            f"the replay buffer is away: {directory} holds none of its files. Nothing was changed: mount its "
            f"disk or put the files back, "
            f"and give the same command. If they are lost for good, make an empty file {path}: the run then "
            f"goes on with an empty buffer"
        ) from None
    if zlib.crc32(data) != expected:
        raise ValueError(f"the replay file {path} is damaged: checksum {zlib.crc32(data):08x}, expected {expected:08x}")
    return _parse(path, data)


def _read(path: Path) -> bytes:
    with open_file(path) as file, reading(path):
        return file.read()


def _parse(path: Path, data: bytes) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    try:
        arrays = load(data)
        header = json.loads(
            data[8 : 8 + int.from_bytes(data[:8], "little")]
        )  # load has looked at it, and gives no metadata
        facts = json.loads(header["__metadata__"]["replay"])
        _require_arrays(arrays, facts)
    except (SafetensorError, KeyError, TypeError, IndexError, ValueError, RecursionError) as error:
        raise ValueError(f"the replay file {path} is damaged: {error!s:.300}") from error
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
    if problem := misfit(facts, _FACTS):
        raise ValueError(problem)
    if facts["format"] != FORMAT:
        raise ValueError(f"format {facts['format']}; this version reads {FORMAT}")
