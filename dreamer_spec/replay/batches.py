"""From stored records to a train batch: [REP-14] to [REP-18]."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamer_spec.replay.layout import LATENTS, RecordLayout
from dreamer_spec.replay.storage import Storage, Stream

Batch = dict[str, NDArray[Any]]


def empty_batch(layout: RecordLayout, rows: int, length: int) -> Batch:
    """New arrays of a batch of `rows` sequences with `length` trained steps each, not filled."""
    batch: Batch = {}
    for key, (dtype, shape) in layout.entries.items():
        if key in LATENTS:
            batch[key] = np.empty((rows, *shape), dtype)
        else:
            batch["prev_action" if key == "action" else key] = np.empty((rows, length, *shape), dtype)
    return batch | {"ids": np.empty((rows, 2), np.int64)}


def require_same_form(out: Batch, expected: Batch) -> Batch:
    """`out`, if it can be filled in place of the expected batch.

    Raises:
      ValueError: other keys, shapes or types, or an array that is not contiguous or not writeable.
    """
    if out.keys() != expected.keys():
        raise ValueError(f"out has the keys {sorted(out)}; expected {sorted(expected)}")
    for key, array in expected.items():
        given = out[key]
        if (
            given.shape != array.shape
            or given.dtype != array.dtype
            or not (given.flags.c_contiguous and given.flags.writeable)
        ):
            raise ValueError(f"out[{key!r}]: expected a writeable contiguous array {array.dtype} {array.shape}")
    return out


def gather(storage: Storage, chosen: list[tuple[Stream, int]], length: int, batch: Batch) -> None:
    """Fills a batch with the sequences that start at these positions: one copy for each section and chunk of a row."""
    layout, rows = storage.layout, len(chosen)
    small = np.empty((rows, length + 1, layout.section_bytes[0]), np.uint8)
    large = [batch[key].reshape(rows, length, -1).view(np.uint8) for key in layout.large]
    latents = np.empty((rows, layout.section_bytes[-1]), np.uint8)
    for b, (stream, start) in enumerate(chosen):
        for span in storage.spans(stream, start, start + length + 1):
            sections, row = storage.sections(span)
            end = row + span.rows
            small[b, span.done : span.done + span.rows] = sections[0][row:end]
            context = span.done == 0  # Of the first record only the action and the latents are wanted.
            if context:
                latents[b] = sections[-1][row]
            for target, source in zip(large, sections[1:-1], strict=True):
                target[b, span.done - 1 + context : span.done - 1 + span.rows] = source[row + context : end]
    _unpack(layout, layout.rows(small), batch)
    batch["deter"][...], batch["stoch"][...] = layout.unpack_latents(latents)


def _unpack(layout: RecordLayout, records: NDArray[Any], batch: Batch) -> None:
    """Fills the entries that are stored side by side from records [B, T+1]."""
    for key in records.dtype.names or ():
        if key == "action":
            batch["prev_action"][...] = records[key][:, :-1]
        else:
            batch[key][...] = records[key][:, 1:]
    # The last position keeps its flag: whether the next record starts an episode is not known inside the sequence.
    batch["is_last"][:, :-1] |= batch["is_first"][:, 1:]
