"""The undo journal: what latents were at the last save, written down before they are overwritten for the first time.

One file per epoch, the time from one save to the next. An entry is a header (chunk, first row, rows, CRC-32 of the
bytes) and the old bytes. Undoing applies the entries backwards, newest file first. An entry at the end that is not
complete was not acted upon: the process died while writing it.
"""

import dataclasses
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dreamer_spec.disk.files import BINARY, open_file, reading
from dreamer_spec.replay.chunks import disk_errors, numbers, write_all

_HEADER = struct.Struct("<QIII")


@dataclasses.dataclass(frozen=True)
class JournalEntry:
    """Old latents of consecutive rows of a chunk. offset: of the bytes in the journal file."""

    chunk: int
    row: int
    rows: int
    sum: int
    offset: int


class Journal:
    """The journal of the epoch that is going on."""

    def __init__(self, directory: Path, epoch: int) -> None:
        self._directory = directory
        with disk_errors(directory):
            flags = os.O_RDWR | os.O_CREAT | os.O_TRUNC | getattr(os, "O_NOFOLLOW", 0) | BINARY
            self._fd = os.open(journal_path(directory, epoch), flags, 0o644)
        self._size = 0

    def append(self, chunk: int, row: int, latents: NDArray[np.uint8]) -> None:
        """Writes an entry down; only then may the rows [n, bytes] be overwritten.

        Raises:
          UserError: the disk refuses it.
        """
        data = np.ascontiguousarray(latents)
        header = _HEADER.pack(chunk, row, len(data), zlib.crc32(data.data))
        with disk_errors(self._directory):
            try:
                write_all(self._fd, header, self._size)
                write_all(self._fd, data, self._size + len(header))
            except OSError:
                os.ftruncate(self._fd, self._size)  # A torn entry must not stand before later ones.
                raise
        self._size += len(header) + data.nbytes

    def flush(self) -> None:
        with disk_errors(self._directory):
            os.fsync(self._fd)

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def __del__(self) -> None:
        self.close()


def journal_path(directory: Path, epoch: int) -> Path:
    return directory / f"journal-{epoch:010d}.bin"


def journal_epochs(directory: Path) -> list[int]:
    """The epochs of all journals of a directory, oldest first."""
    return numbers(directory, "journal-", ".bin")


def entries(path: Path, row_bytes: int) -> Iterator[JournalEntry]:
    """The complete entries of a journal file, oldest first.

    Raises:
      Unreadable.
    """
    offset = 0
    with open_file(path) as file, reading(path):
        size = os.fstat(file.fileno()).st_size
        while offset + _HEADER.size <= size:
            file.seek(offset)
            chunk, row, rows, checksum = _HEADER.unpack(file.read(_HEADER.size))
            start = offset + _HEADER.size
            offset = start + rows * row_bytes
            if offset <= size:
                yield JournalEntry(chunk, row, rows, checksum, start)


def old_latents(path: Path, entry: JournalEntry, row_bytes: int) -> NDArray[np.uint8] | None:
    """The bytes [rows, row_bytes] of an entry, or None if its checksum disagrees."""
    with open_file(path) as file, reading(path):
        file.seek(entry.offset)
        data = file.read(entry.rows * row_bytes)
    if zlib.crc32(data) != entry.sum:
        return None
    return np.frombuffer(data, np.uint8).reshape(entry.rows, row_bytes)
