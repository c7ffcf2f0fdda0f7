"""The held records of the workers: which chunk holds which, and those that are not written yet."""

import dataclasses
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamer_spec.replay.chunks import Chunk, ChunkStore
from dreamer_spec.replay.layout import RecordLayout, Sections
from dreamer_spec.replay.saves import Epochs


@dataclasses.dataclass
class Stage:
    """The newest records of a stream, in memory until a block is full. start: position of row 0; written: rows that the
    file has."""

    start: int
    sections: Sections
    written: int = 0


@dataclasses.dataclass
class Stream:
    """Consecutive records, positions first .. count-1. Position p is in row p % records of chunk p // records.

    open: a worker writes to it.
    """

    number: int
    first: int = 0
    count: int = 0
    chunks: dict[int, Chunk] = dataclasses.field(default_factory=dict)
    stage: Stage | None = None
    open: bool = True


@dataclasses.dataclass
class Span:
    """Consecutive records at one place. done: how many of the wanted ones come before; chunk_row: where the first one
    is in its chunk."""

    done: int
    rows: int
    chunk: Chunk
    chunk_row: int
    stage: Stage | None
    stage_row: int


class Storage:
    """Reads, appends and overwrites records of streams.

    block: records that are written at once and whose latents share a checksum; chunk_records is a multiple of it.
    """

    def __init__(self, store: ChunkStore, block: int, epochs: Epochs) -> None:
        self.store, self.block, self.epochs = store, block, epochs
        self.records = store.shape.records
        self.dirty: dict[int, Chunk] = {}  # written to since the last save, by number of the file

    @property
    def layout(self) -> RecordLayout:
        return self.store.layout

    def append(self, stream: Stream, packed: Sections, row: int) -> None:
        """Appends one packed record. If the disk refuses, nothing has changed."""
        position = stream.count
        offset = position % self.block
        if offset == 0:
            self._begin_block(stream, position)
        assert stream.stage is not None
        for target, source in zip(
            stream.stage.sections, packed, strict=False
        ):  # As many of both: this runs for every record.
            target[offset] = source[row]
        stream.count = position + 1

    def extend(self, stream: Stream, packed: Sections) -> None:
        """Appends many packed records, a block at a time."""
        row, total = 0, len(packed[0])
        while row < total:
            offset = stream.count % self.block
            if offset == 0:
                self._begin_block(stream, stream.count)
            assert stream.stage is not None
            rows = min(self.block - offset, total - row)
            for target, source in zip(stream.stage.sections, packed, strict=True):
                target[offset : offset + rows] = source[row : row + rows]
            stream.count += rows
            row += rows

    def closed_stream(self, number: int, first: int, packed: Sections) -> Stream:
        """A stream that nobody writes to, of packed records from position `first` on."""
        begin = first // self.records * self.records
        stream = Stream(number, begin, begin, open=False)
        if first > begin:  # A chunk begins at a multiple of its size: what would come before is never read.
            self.extend(stream, [np.zeros((first - begin, size), np.uint8) for size in self.layout.section_bytes])
        self.extend(stream, packed)
        self.write_stage(stream)
        stream.stage, stream.first = None, first
        return stream

    def retire(self, stream: Stream, indices: list[int]) -> None:
        """Takes chunks without held records from a stream and deletes their files, unless a save needs them."""
        for index in indices:
            chunk = stream.chunks.pop(index, None)
            if chunk is not None:
                self.dirty.pop(chunk.number, None)
                self.store.close(chunk.number)
                if self.epochs.retire(chunk.number):
                    self.store.discard(chunk.number)

    def _begin_block(self, stream: Stream, position: int) -> None:
        self.write_stage(stream)
        if position % self.records == 0:
            number = self.epochs.new_chunk()
            self.store.create(number)
            chunk = Chunk(
                number=number,
                sums=[0] * (len(self.layout.section_bytes) - 1),
                block_sums=np.zeros(self.records // self.block, np.uint32),
            )
            stream.chunks[position // self.records] = chunk
        if stream.stage is None:
            stream.stage = Stage(
                position, [np.zeros((self.block, size), np.uint8) for size in self.layout.section_bytes]
            )
        else:  # The same memory again: it is written, and what it holds beyond the new records is not read.
            stream.stage.start, stream.stage.written = position, 0

    def write_stage(self, stream: Stream) -> None:
        """Brings what is staged to the file; it stays staged."""
        stage = stream.stage
        if stage is None:
            return
        chunk, row, rows = (
            stream.chunks[stage.start // self.records],
            stage.start % self.records,
            stream.count - stage.start,
        )
        self.dirty[chunk.number] = chunk
        if stage.written < rows:
            for section, data in enumerate(stage.sections[:-1]):
                new = data[stage.written : rows]
                self.store.write(chunk.number, section, row + stage.written, new)
                chunk.sums[section] = zlib.crc32(new.data, chunk.sums[section])
        self.store.write(chunk.number, len(stage.sections) - 1, row, stage.sections[-1][:rows])
        stage.written, chunk.count = rows, row + rows

    def read_stage(self, stream: Stream) -> None:
        """Loads the unfinished block at the end of a stream, so that it can be appended to."""
        start = stream.count // self.block * self.block
        rows = stream.count - start
        if not rows:
            return
        row = start % self.records
        sections = [np.zeros((self.block, size), np.uint8) for size in self.layout.section_bytes]
        for target, source in zip(
            sections, self.store.open(stream.chunks[start // self.records].number).sections, strict=True
        ):
            target[:rows] = source[row : row + rows]
        stream.stage = Stage(start, sections, rows)

    def spans(self, stream: Stream, start: int, end: int) -> Iterator[Span]:
        """Where the records from position `start` up to `end` are."""
        position, staged = start, stream.stage.start if stream.stage else stream.count
        while position < end:
            index, row = divmod(position, self.records)
            in_file = position < staged
            rows = min(end, staged, (index + 1) * self.records) - position if in_file else end - position
            stage = None if in_file else stream.stage
            yield Span(position - start, rows, stream.chunks[index], row, stage, position - staged)
            position += rows

    def sections(self, span: Span) -> tuple[Sections, int]:
        """The arrays that hold a span, and its first row there. Only to be copied from."""
        if span.stage is not None:
            return span.stage.sections, span.stage_row
        return self.store.open(span.chunk.number).sections, span.chunk_row

    def replace_latents(self, stream: Stream, start: int, latents: NDArray[np.uint8]) -> None:
        """Overwrites the latents [n, bytes] of held records from `start` on."""
        for span in self.spans(stream, start, start + len(latents)):
            new = latents[span.done : span.done + span.rows]
            self._remember(span)
            if span.stage is not None:
                span.stage.sections[-1][span.stage_row : span.stage_row + span.rows] = new
            else:
                self.store.write(span.chunk.number, len(self.layout.section_bytes) - 1, span.chunk_row, new)
                self.dirty[span.chunk.number] = span.chunk

    def _remember(self, span: Span) -> None:
        """Writes down the latents as of the last save that are about to be overwritten for the first time since."""
        chunk, rows = span.chunk, slice(span.chunk_row, span.chunk_row + span.rows)
        if chunk.touched is None:
            chunk.touched = np.zeros(self.records, np.bool_)
        fresh = np.flatnonzero(~chunk.touched[rows][: max(0, chunk.saved - span.chunk_row)])
        if len(fresh) and self.epochs.journal is not None:
            # Rows between that were written down before do no harm: the first entry of a row is the last to be undone.
            low, high = int(fresh[0]), int(fresh[-1]) + 1
            sections, row = self.sections(span)
            self.epochs.journal.append(chunk.number, span.chunk_row + low, sections[-1][row + low : row + high])
        chunk.touched[rows] = True

    def sum_latents(self, chunk: Chunk) -> None:
        """Renews the checksums of the latents that changed since the last save."""
        blocks = np.zeros(len(chunk.block_sums), np.bool_)
        blocks[chunk.saved // self.block : -(-chunk.count // self.block)] = chunk.count > chunk.saved
        if chunk.touched is not None:
            blocks |= chunk.touched.reshape(-1, self.block).any(axis=1)
        fd = self.store.open(chunk.number).fd
        for index in np.flatnonzero(blocks).tolist():
            chunk.block_sums[index] = self.store.latents_sums(fd, chunk.count, self.block, range(index, index + 1))[0]


def state_arrays(storage: Storage, streams: list[Stream]) -> dict[str, NDArray[Any]]:
    """Every entry [sum of counts, ...] of the held records, one stream after another, as new arrays."""
    layout, count = storage.layout, sum(stream.count - stream.first for stream in streams)
    sections = [np.zeros((count, size), np.uint8) for size in layout.section_bytes]
    done = 0
    for stream in streams:
        for span in storage.spans(stream, stream.first, stream.count):
            sources, row = storage.sections(span)
            for target, source in zip(sections, sources, strict=True):
                target[done : done + span.rows] = source[row : row + span.rows]
            done += span.rows
    rows = layout.rows(sections[0])
    arrays = {key: np.array(rows[key]) for key in rows.dtype.names or ()}
    for key, section in zip(layout.large, sections[1:-1], strict=True):
        dtype, shape = layout.entries[key]
        arrays[key] = section.view(dtype).reshape(count, *shape)
    arrays["deter"], arrays["stoch"] = layout.unpack_latents(sections[-1])
    return {key: arrays[key] for key in layout.entries}
