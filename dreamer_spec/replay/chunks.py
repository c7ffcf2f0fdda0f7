"""Chunk files: a fixed number of consecutive records of one stream, section after section.

  header    what the records look like; the same bytes in every chunk of a buffer but for the chunk's number
  section   [records, bytes], each beginning at a multiple of 4096

Files are made in their full size, with their blocks reserved on the disk. They are written with `pwrite` and read
through a mapping: a full or failing disk is an error where it is met, never a signal in the middle of a copy.
"""

import collections
import contextlib
import dataclasses
import errno
import json
import mmap
import os
import re
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dreamer_spec.disk.files import BINARY, Unreadable, entries, open_file, reading
from dreamer_spec.errors import UserError
from dreamer_spec.replay.layout import RecordLayout, Sections
from dreamer_spec.replay.positioned import most_descriptors, read_at, write_at

PAGE = 4096
MAGIC = "dreamer-spec replay chunk"
FORMAT = 1
CHUNK = "chunk-"
SPARE = 32  # files that wait to be used again


@dataclasses.dataclass
class Chunk:
    """What is known of one chunk file.

    number: of the file. count: records written to it. sums: CRC-32 of the first `count` rows of each section but the
    latents.
    block_sums: CRC-32 of the latents of each block of records, valid as of the last save. saved: records at the last
    save; touched: which records' latents were written since, None if none were.
    """

    number: int
    sums: list[int]
    block_sums: NDArray[np.uint32]
    count: int = 0
    saved: int = 0
    touched: NDArray[np.bool_] | None = None


@dataclasses.dataclass
class OpenChunk:
    """A chunk file that is open and mapped. Nothing outside this module's callers may keep the views."""

    fd: int
    sections: Sections

    def __del__(self) -> None:
        os.close(self.fd)


class Shape:
    """Where things are in a chunk file: the same for all chunks of a buffer."""

    def __init__(self, layout: RecordLayout, records: int) -> None:
        self.layout, self.records = layout, records
        self.header_bytes = _pages(len(self._header_text(2**63)))
        self.offsets: list[int] = []
        end = self.header_bytes
        for size in layout.section_bytes:
            self.offsets.append(end)
            end = _pages(end + records * size)
        self.file_bytes = end

    def header(self, number: int) -> bytes:
        return self._header_text(number).ljust(self.header_bytes, b" ")

    def _header_text(self, number: int) -> bytes:
        facts = {"format": FORMAT, "chunk": number, "records": self.records, "layout": self.layout.to_json()}
        return f"{MAGIC}\n{json.dumps(facts)}\n".encode()


class ChunkStore:
    """The chunk files of a directory, and the mapped ones among them: the least recently used are unmapped when too
    much is mapped.

    memory_limit: bytes that may be mapped at once; one chunk may always be.
    """

    def __init__(self, directory: Path, shape: Shape, memory_limit: int) -> None:
        self.directory, self.shape, self.memory_limit = directory, shape, memory_limit
        self._open: collections.OrderedDict[int, OpenChunk] = collections.OrderedDict()
        self._spare: list[Path] = []
        # A mapping holds a descriptor too, and half of them stay free for others.
        self._most_open = max(1, min(memory_limit // shape.file_bytes, max(most_descriptors(), 64) // 4))

    @property
    def mapped_bytes(self) -> int:
        """Bytes of chunk files that are mapped now."""
        return len(self._open) * self.shape.file_bytes

    def path(self, number: int) -> Path:
        return chunk_path(self.directory, number)

    def create(self, number: int) -> None:
        """Makes a chunk file without records, of one that is not needed any more if there is one: its blocks are taken
        already.

        Raises:
          UserError: the disk is full or refuses it; nothing is left behind.
        """
        path = self.path(number)
        with disk_errors(self.directory):
            if self._spare:
                with self._spare[-1].open("rb+", buffering=0) as file:
                    write_all(file.fileno(), self.shape.header(number), 0)
                self._spare.pop().rename(path)
                return
            fd = os.open(
                path, os.O_RDWR | os.O_CREAT | os.O_EXCL | BINARY, 0o644
            )  # Never over a file that is there already.
            try:
                reserve(fd, self.shape.file_bytes)
                write_all(fd, self.shape.header(number), 0)
            except OSError:
                path.unlink()
                raise
            finally:
                os.close(fd)

    def open(self, number: int) -> OpenChunk:
        """The chunk file, mapped for reading."""
        chunk = self._open.get(number)
        if chunk is not None:
            self._open.move_to_end(number)
            return chunk
        while len(self._open) >= self._most_open:
            self._open.popitem(last=False)
        with disk_errors(self.directory):
            fd = os.open(self.path(number), os.O_RDWR | BINARY)
            try:
                mapping = mmap.mmap(fd, self.shape.file_bytes, access=mmap.ACCESS_READ)
            except (OSError, ValueError):
                os.close(fd)
                raise
        view = np.frombuffer(mapping, np.uint8)
        sections = [
            view[offset : offset + self.shape.records * size].reshape(self.shape.records, size)
            for offset, size in zip(self.shape.offsets, self.shape.layout.section_bytes, strict=True)
        ]
        chunk = self._open[number] = OpenChunk(fd, sections)
        return chunk

    def write(self, number: int, section: int, row: int, data: NDArray[np.uint8]) -> None:
        """Writes rows [n, bytes] of a section from `row` on.

        Raises:
          UserError: the disk refuses it.
        """
        with disk_errors(self.directory):
            write_all(self.open(number).fd, data, self.shape.offsets[section] + row * data.shape[1])

    def flush(self, number: int) -> None:
        with disk_errors(self.directory):
            os.fsync(self.open(number).fd)

    def close(self, number: int) -> None:
        self._open.pop(number, None)

    def discard(self, number: int) -> None:
        """Gives up a chunk file: it becomes another one, or goes."""
        if len(self._spare) < SPARE:
            self._spare.append(self.path(number))
        else:
            self.path(number).unlink(missing_ok=True)

    def problem(self, number: int) -> str | None:
        """What is wrong with the file as such, or None.

        Raises:
          Unreadable: [REP-35].
        """
        path = self.path(number)
        try:
            with open_file(path) as file, reading_chunk(path):
                size = os.fstat(file.fileno()).st_size
                if size != self.shape.file_bytes:
                    return f"has {size} bytes, expected {self.shape.file_bytes}"
                return (
                    None if file.read(self.shape.header_bytes) == self.shape.header(number) else "has a damaged header"
                )
        except FileNotFoundError:
            return "is missing"
        except ValueError:
            return "is not a file"

    def damage(self, chunk: Chunk, block: int) -> str | None:
        """What of the content disagrees with its checksums, or None. Reads all of it, through no mapping.

        Raises:
          Unreadable: [REP-35].
        """
        names = ["records", *self.layout.large, "latents"]
        path = self.path(chunk.number)
        with open_file(path) as file, reading_chunk(path):
            for section, expected in enumerate(chunk.sums):
                total = 0
                for data in self._pieces(file.fileno(), section, chunk.count):
                    total = zlib.crc32(data, total)
                if total != expected:
                    return f"is damaged: the checksum of {names[section]} is {total:08x}, expected {expected:08x}"
            sums = self.latents_sums(file.fileno(), chunk.count, block, range(-(-chunk.count // block)))
            if not np.array_equal(sums, chunk.block_sums[: len(sums)]):
                return "is damaged: a checksum of latents differs"
        return None

    def latents_sums(self, fd: int, count: int, block: int, blocks: range) -> list[int]:
        """CRC-32 of the latents of some blocks, the last one up to `count` records."""
        size = self.layout.section_bytes[-1]
        start = self.shape.offsets[-1]
        return [
            zlib.crc32(
                read_at(fd, (min((index + 1) * block, count) - index * block) * size, start + index * block * size)
            )
            for index in blocks
        ]

    @property
    def layout(self) -> RecordLayout:
        return self.shape.layout

    def _pieces(self, fd: int, section: int, count: int) -> Iterator[bytes]:
        start, end = (
            self.shape.offsets[section],
            self.shape.offsets[section] + count * self.layout.section_bytes[section],
        )
        for offset in range(start, end, 1 << 20):
            yield read_at(fd, min(1 << 20, end - offset), offset)


def chunk_path(directory: Path, number: int) -> Path:
    return directory / f"{CHUNK}{number:010d}.bin"


def chunk_numbers(directory: Path) -> list[int]:
    """The numbers of all chunk files of a directory, and of no other file: [REP-36]."""
    return [number for number in numbers(directory, CHUNK, ".bin") if is_chunk(chunk_path(directory, number))]


def next_number(directory: Path) -> int:
    """Of a chunk: beyond all that are in a directory, whoever put them there."""
    found = [match for path in entries(directory) if (match := re.fullmatch(rf"{CHUNK}([0-9]{{10}})\.bin", path.name))]
    return max((int(match[1]) for match in found), default=-1) + 1


def numbers(directory: Path, prefix: str, suffix: str) -> list[int]:
    """Of the plain files <prefix><ten digits><suffix> of a directory, in their order.

    Raises:
      Unreadable.
    """
    pattern = re.compile(f"{re.escape(prefix)}([0-9]{{10}}){re.escape(suffix)}")
    found = [(path, match) for path in entries(directory) if (match := pattern.fullmatch(path.name))]
    return [int(match[1]) for path, match in found if path.is_file() and not path.is_symlink()]


def is_chunk(path: Path) -> bool:
    """Whether a file begins as ours do, or as one whose making was interrupted: with zeros, or not at all."""
    with open_file(path) as file, reading_chunk(path):
        start = file.read(len(MAGIC))
    return start == MAGIC.encode() or not start.strip(b"\0")


@contextlib.contextmanager
def reading_chunk(path: Path) -> Iterator[None]:
    """As dreamer_spec.disk.files.reading, with what to do about a file that no mending helps."""
    try:
        with reading(path):
            yield
    except Unreadable as error:
        raise Unreadable(f"{error}; or move that file away: the run then goes on without its records") from error


def reserve(fd: int, size: int) -> None:
    """Makes a new file `size` bytes long with its blocks taken, so that writing it later cannot run out of disk.

    Raises:
      OSError: there is not so much room.
    """
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(fd, 0, size)
        return
    zeros = bytes(1 << 20)
    for offset in range(0, size, len(zeros)):
        write_all(fd, zeros[: size - offset], offset)


def write_all(fd: int, data: bytes | NDArray[np.uint8], offset: int) -> None:
    """Writes all of it, in as many calls as it takes."""
    left = memoryview(data) if isinstance(data, bytes) else np.ascontiguousarray(data).reshape(-1).data
    while left:
        written = write_at(fd, left, offset)
        left, offset = left[written:], offset + written


@contextlib.contextmanager
def disk_errors(directory: Path) -> Iterator[None]:
    """What the disk refuses becomes a UserError that names the directory."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            is_saved = any(numbers(directory, "saved-", ".safetensors"))
            kept = "the last checkpoint is intact" if is_saved else "there is no checkpoint yet"
            raise UserError(
                f"the disk of the replay directory {directory} is full; {kept}: make room and give the same command"
            ) from error
        raise UserError(f"cannot use the replay directory {directory}: {error}") from error


def _pages(size: int) -> int:
    return -(-size // PAGE) * PAGE
