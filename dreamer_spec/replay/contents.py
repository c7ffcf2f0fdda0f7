"""What a replay buffer holds: streams of records, the sequences that start in them, and the files behind them."""

import shutil
import tempfile
import threading
import weakref
from pathlib import Path

from dreamer_spec.replay.chunks import ChunkStore, Shape, disk_errors
from dreamer_spec.replay.items import Items, require_representable
from dreamer_spec.replay.layout import Packed, RecordLayout
from dreamer_spec.replay.saves import Epochs, buffer_files
from dreamer_spec.replay.storage import Storage, Stream

CHUNK_BYTES = 2**24
CHUNK_RECORDS = 2**14
MEMORY_LIMIT = 2**31
BLOCK_RECORDS = 64


class Contents:
    """The state of a buffer, and how it grows. `Replay` in buffer.py explains the arguments, and is what others use.

    lock: held by whoever calls a method.
    """

    def __init__(
        self,
        capacity: int,
        length: int,
        directory: Path | None = None,
        *,
        memory_limit: int = MEMORY_LIMIT,
        deter_dtype: str = "bfloat16",
        classes: int = 256,
        chunk_records: int | None = None,
        block_records: int = BLOCK_RECORDS,
        restoring: bool = False,
    ) -> None:
        if capacity < 1 or length < 1:
            raise ValueError(f"capacity and length must be at least 1, got {capacity} and {length}")
        if block_records < 1 or (chunk_records is not None and (chunk_records < 1 or chunk_records % block_records)):
            raise ValueError(
                f"chunk_records must be a positive multiple of block_records, got {chunk_records} and {block_records}"
            )
        self.capacity, self.length, self.memory_limit = capacity, length, memory_limit
        self.deter_dtype, self.classes = deter_dtype, classes
        self.chunk_records, self.block_records = chunk_records, block_records
        if directory is None:
            directory = Path(tempfile.mkdtemp(prefix="replay-"))
            weakref.finalize(self, shutil.rmtree, directory, ignore_errors=True)
        if not restoring:
            with disk_errors(directory):
                directory.mkdir(parents=True, exist_ok=True)
            if buffer_files(directory):
                raise ValueError(f"{directory} holds a replay buffer already: restore it, or erase it first")
        self.directory = directory
        self.lock = threading.RLock()
        self.warnings: list[str] = []
        self.epochs = Epochs(directory)
        self.storage: Storage | None = None  # made with the first record, which says what records are like
        self.streams: dict[int, Stream] = {}
        self.next_stream = 0
        self.current: dict[int, int] = {}  # worker -> number of the stream it writes to
        self.items = Items(capacity)

    def clear(self) -> None:
        """Forgets the content; saves that are kept stay restorable."""
        for stream in self.streams.values():
            assert self.storage is not None
            self.storage.retire(stream, list(stream.chunks))
        self.streams, self.current, self.next_stream = {}, {}, 0
        self.items = Items(self.capacity)

    def __len__(self) -> int:
        """The number of items. Implements [REP-3]."""
        return len(self.items)

    def append(self, packed: Packed, row: int, worker: int) -> None:
        """Appends record `row` of a pack to the stream of a worker, and with it the sequence that it completes.

        Raises:
          ValueError: more streams or records than the index can tell apart.
          UserError: the disk refuses a file; nothing has changed.
        """
        storage = self.storage or self.make_storage(packed.layout)
        number = self.current.get(worker)
        stream = self.streams[number] if number is not None else Stream(self.next_stream)
        position = stream.count
        require_representable(stream.number, position)
        storage.append(stream, packed.sections, row)
        if number is None:
            self.streams[stream.number] = stream
            self.current[worker] = stream.number
            self.next_stream += 1
        if position - self.length >= stream.first:
            if len(self.items) == self.capacity:
                self.evict()
            item = stream.number, position - self.length
            self.items.append(item)
            if position % (self.length + 1) == 0:
                self.items.queue.append(item)

    def make_storage(self, layout: RecordLayout) -> Storage:
        """Where records of this layout go from now on."""
        records = self.chunk_records or fitting_records(layout, self.capacity, self.block_records)
        store = ChunkStore(self.directory, Shape(layout, records), self.memory_limit)
        self.storage = Storage(store, self.block_records, self.epochs)
        return self.storage

    def evict(self) -> None:
        """Lets go of the oldest item. A stream's items leave in the order of their starts, so exactly the record at the
        start is no longer needed."""
        assert self.storage is not None
        number, start = self.items.pop_oldest()
        stream = self.streams[number]
        stream.first = start + 1
        if not stream.open and stream.count - stream.first <= self.length:
            del self.streams[number]
            self.storage.retire(stream, list(stream.chunks))
        elif stream.first % self.storage.records == 0:
            self.storage.retire(stream, [stream.first // self.storage.records - 1])


def fitting_records(layout: RecordLayout, capacity: int, block: int) -> int:
    """Records of a chunk: a multiple of the block, so that a chunk is neither a tiny file nor a large part of the
    buffer."""
    most = min(CHUNK_BYTES // layout.record_bytes, CHUNK_RECORDS, capacity // 64)
    return max(1, most // block) * block
