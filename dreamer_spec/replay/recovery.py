"""Saving the content of a buffer, and bringing it back: [REP-29] to [REP-32]."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamer_spec.disk.files import open_file
from dreamer_spec.replay.chunks import Chunk, ChunkStore, Shape
from dreamer_spec.replay.contents import Contents
from dreamer_spec.replay.items import are_representable, decode, encode
from dreamer_spec.replay.journal import entries, journal_epochs, journal_path, old_latents
from dreamer_spec.replay.layout import RecordLayout
from dreamer_spec.replay.saves import read_saved, saved_epochs, saved_path
from dreamer_spec.replay.storage import Storage, Stream

Arrays = Mapping[str, NDArray[Any]]


def save(replay: Contents, name: str) -> dict[str, Any]:
    """See Replay.save. First the chunks, then the file that refers to them: whenever it is interrupted, one state is
    complete."""
    storage = replay.storage
    if storage is not None:
        for stream in replay.streams.values():
            storage.write_stage(stream)
        for chunk in storage.dirty.values():
            storage.sum_latents(chunk)
            storage.store.flush(chunk.number)
        if replay.epochs.journal is not None:
            replay.epochs.journal.flush()
    description = replay.epochs.begin_epoch(name, _arrays(replay), _facts(replay))
    if storage is not None:
        for chunk in storage.dirty.values():
            chunk.saved, chunk.touched = chunk.count, None
        storage.dirty.clear()
    return description


def _facts(replay: Contents) -> dict[str, Any]:
    storage = replay.storage
    return {
        "length": replay.length,
        "next_stream": replay.next_stream,
        "layout": storage.layout.to_json() if storage else None,
        "chunk_records": storage.records if storage else 0,
        "block_records": storage.block if storage else 0,
    }


def _arrays(replay: Contents) -> dict[str, NDArray[Any]]:
    chunks = [
        (chunk, stream.number, index) for stream in replay.streams.values() for index, chunk in stream.chunks.items()
    ]
    sums = [chunk.sums for chunk, _, _ in chunks]
    blocks = [chunk.block_sums for chunk, _, _ in chunks]
    return {
        "items": replay.items.codes(),
        "queue": encode(np.array(replay.items.queue, np.int64).reshape(-1, 2)),
        "streams": np.array([(s.number, s.first, s.count) for s in replay.streams.values()], np.int64).reshape(-1, 3),
        "workers": np.array(list(replay.current.items()), np.int64).reshape(-1, 2),
        "chunks": np.array(
            [(chunk.number, number, index, chunk.count) for chunk, number, index in chunks], np.int64
        ).reshape(-1, 4),
        "sums": np.array(sums, np.uint32).reshape(len(chunks), -1 if chunks else 0),
        "block_sums": np.array(blocks, np.uint32).reshape(len(chunks), -1 if chunks else 0),
    }


def restore(replay: Contents, description: Mapping[str, Any], continue_streams: bool) -> None:
    """See Replay.restore. It may be interrupted at any point and done again."""
    arrays, facts = read_saved(replay.directory, description)
    storage = _matching_storage(replay, arrays, facts)
    chunks = _usable_chunks(storage, arrays, replay.warnings) if storage is not None else {}
    require_readable(replay.directory, facts["epoch"])
    for epoch in saved_epochs(replay.directory):
        if epoch > facts["epoch"]:  # Before the undoing, which spoils them.
            saved_path(replay.directory, epoch).unlink()
    replay.next_stream = facts["next_stream"]
    if storage is not None:
        _undo(storage, chunks, facts["epoch"], replay.warnings)
        _leave_out_damaged(storage, chunks, replay.warnings)
        _rebuild(replay, storage, arrays, chunks, continue_streams)
    needed = {chunk.number for stream in replay.streams.values() for chunk in stream.chunks.values()}
    replay.epochs.resume(facts["epoch"], set(arrays["chunks"][:, 0].tolist()), needed, replay.warnings)


def require_readable(directory: Path, epoch: int) -> None:
    """That the journals from an epoch on can be read, before the first of them is used: [REP-35].

    Raises:
      Unreadable.
    """
    for number in journal_epochs(directory):
        if number >= epoch:
            open_file(journal_path(directory, number)).close()


def _matching_storage(replay: Contents, arrays: Arrays, facts: Mapping[str, Any]) -> Storage | None:
    """The storage that a saved state needs, None if nothing had been added yet.

    Raises:
      ValueError: the buffer is configured in another way than the saved one, or the state contradicts itself.
    """
    if facts["length"] != replay.length:
        raise ValueError(
            f"the saved replay has length {facts['length']}, this one {replay.length}: sequences would differ"
        )
    if facts["layout"] is None:
        return None
    layout = RecordLayout.from_json(facts["layout"])
    for name in ("deter_dtype", "classes"):
        if getattr(layout, name) != getattr(replay, name):
            raise ValueError(f"the saved replay has {name} {getattr(layout, name)}, this one {getattr(replay, name)}")
    records, block = facts["chunk_records"], facts["block_records"]
    chunks, sums, block_sums = arrays["chunks"], arrays["sums"], arrays["block_sums"]
    if not block or not records or records % block or np.any(chunks[:, 3] > records):
        raise ValueError(
            f"the saved replay in {replay.directory} contradicts itself: chunks of {records} records, blocks of {block}"
        )
    if len(chunks) and (sums.shape[1] != len(layout.section_bytes) - 1 or block_sums.shape[1] != records // block):
        raise ValueError(
            f"the saved replay in {replay.directory} contradicts itself: {sums.shape[1]} and "
            f"{block_sums.shape[1]} checksums"
        )
    streams, places = arrays["streams"], chunks[:, 1:3]
    distinct = (streams[:, 0], chunks[:, 0], encode(places))
    if (
        not all(len(np.unique(values)) == len(values) for values in distinct)
        or np.any(streams[:, 1] > streams[:, 2])
        or np.any(streams[:, 0] >= facts["next_stream"])
        or not are_representable(facts["next_stream"], streams[:, 2])
        or not are_representable(facts["next_stream"], records * chunks[:, 2].astype(object))
    ):
        raise ValueError(
            f"the saved replay in {replay.directory} contradicts itself: its streams or chunks are impossible"
        )
    store = ChunkStore(replay.directory, Shape(layout, records), replay.memory_limit)
    replay.storage = Storage(store, block, replay.epochs)
    return replay.storage


def _usable_chunks(storage: Storage, arrays: Arrays, warnings: list[str]) -> dict[int, Chunk]:
    """The chunks of a saved state by number, without those whose file is missing or of another form."""
    chunks = {}
    for (number, _, _, count), sums, block_sums in zip(
        arrays["chunks"].tolist(), arrays["sums"], arrays["block_sums"], strict=True
    ):
        problem = storage.store.problem(number)
        if problem:
            _warn(warnings, storage.store.path(number), problem)
        else:
            chunks[number] = Chunk(number, sums.tolist(), np.array(block_sums), count, saved=count)
    return chunks


def _undo(storage: Storage, chunks: Mapping[int, Chunk], epoch: int, warnings: list[str]) -> None:
    """Gives back the latents that were overwritten since an epoch began. Doing it twice does no harm."""
    directory, section = storage.store.directory, len(storage.layout.section_bytes) - 1
    size, undone = storage.layout.section_bytes[-1], set()
    for number in reversed([number for number in journal_epochs(directory) if number >= epoch]):
        path = journal_path(directory, number)
        for entry in reversed(list(entries(path, size))):
            if entry.chunk not in chunks or entry.row + entry.rows > storage.records:
                continue
            latents = old_latents(path, entry, size)
            if latents is None:
                warnings.append(f"{path} is damaged: the entry at byte {entry.offset} is left out")
            else:
                storage.store.write(entry.chunk, section, entry.row, latents)
                undone.add(entry.chunk)
    for number in undone:
        storage.store.flush(number)


def _leave_out_damaged(storage: Storage, chunks: dict[int, Chunk], warnings: list[str]) -> None:
    for chunk in list(chunks.values()):
        problem = storage.store.damage(chunk, storage.block)
        if problem:
            _warn(warnings, storage.store.path(chunk.number), problem)
            del chunks[chunk.number]


def _rebuild(
    replay: Contents, storage: Storage, arrays: Arrays, chunks: Mapping[int, Chunk], continue_streams: bool
) -> None:
    """Streams, items and queue. What is left of a stream on either side of a hole becomes a stream of its own."""
    places: dict[int, dict[int, Chunk]] = {}
    for number, stream, index, _ in arrays["chunks"].tolist():
        if number in chunks:
            places.setdefault(stream, {})[index] = chunks[number]
    table: list[tuple[int, int, int, int]] = []  # number before, first, end, number now
    parts: dict[int, Stream] = {}
    for old, first, count in arrays["streams"].tolist():
        for begin, end in _unbroken(places.get(old, {}), first, count, storage.records):
            number = old if old not in parts else replay.next_stream
            replay.next_stream += number != old
            indices = range(begin // storage.records, -(-end // storage.records))
            own = {index: places[old][index] for index in indices}
            parts[number] = Stream(number, begin, end, own, open=False)
            table.append((old, begin, end, number))
    items = _renumbered(arrays["items"], table, replay.length)
    if len(items) < len(arrays["items"]):
        replay.warnings.append(
            f"{len(arrays['items']) - len(items)} of {len(arrays['items'])} sequences are lost with them"
        )
    replay.items.extend(items[-replay.capacity :])
    if continue_streams:
        ends = {(old, end): number for old, _, end, number in table}
        counts = {number: count for number, _, count in arrays["streams"].tolist()}
        for worker, old in arrays["workers"].tolist():
            number = ends.get((old, counts.get(old, -1)))
            if number is not None:
                replay.current[worker] = number
                parts[number].open = True
        queue = _renumbered(arrays["queue"], table, replay.length)
        oldest = dict(reversed(replay.items.to_array().tolist()))
        replay.items.queue.extend(
            (number, start) for number, start in decode(queue).tolist() if start >= oldest.get(number, start + 1)
        )
    replay.streams = _held(storage, parts, replay)


def _unbroken(chunks: Mapping[int, Chunk], first: int, count: int, records: int) -> list[tuple[int, int]]:
    """The ranges of positions, within first .. count-1, whose chunks are there.

    Raises:
      ValueError: a chunk has fewer records than the stream says.
    """
    ranges: list[tuple[int, int]] = []
    for index in sorted(chunks):
        if (index + 1) * records <= first or index * records >= count:
            continue
        begin, end = max(first, index * records), min(count, (index + 1) * records)
        if chunks[index].count < end - index * records:
            raise ValueError(
                f"the saved replay contradicts itself: chunk {chunks[index].number} has {chunks[index].count} records"
            )
        if ranges and ranges[-1][1] == begin:
            begin = ranges.pop()[0]
        ranges.append((begin, end))
    return ranges


def _renumbered(codes: NDArray[np.int64], table: list[tuple[int, int, int, int]], length: int) -> NDArray[np.int64]:
    """The items that lie in one part of a stream, under the part's number."""
    if not table or not len(codes):
        return codes[:0]
    old, first, end, number = np.array(sorted(table), np.int64).T
    begins = encode(np.stack([old, first], axis=-1))
    items = decode(codes)
    part = np.maximum(np.searchsorted(begins, codes, side="right") - 1, 0)
    inside = (old[part] == items[:, 0]) & (first[part] <= items[:, 1]) & (items[:, 1] + length < end[part])
    return encode(np.stack([number[part], items[:, 1]], axis=-1))[inside]


def _held(storage: Storage, parts: Mapping[int, Stream], replay: Contents) -> dict[int, Stream]:
    """The streams that are held, from their oldest item on; a stream that is written to keeps what its next item
    needs."""
    items = replay.items.to_array()
    numbers, places = np.unique(items[:, 0], return_index=True)
    oldest = dict(zip(numbers.tolist(), items[places, 1].tolist(), strict=True))
    streams = {}
    for number, stream in parts.items():
        if not stream.open and number not in oldest:
            continue
        stream.first = oldest.get(number, max(stream.first, stream.count - replay.length))
        stream.chunks = {
            index: chunk for index, chunk in stream.chunks.items() if (index + 1) * storage.records > stream.first
        }
        if stream.open:
            storage.read_stage(stream)
        streams[number] = stream
    return streams


def _warn(warnings: list[str], path: Path, problem: str) -> None:
    warnings.append(f"the replay file {path} {problem}; it is left out")
