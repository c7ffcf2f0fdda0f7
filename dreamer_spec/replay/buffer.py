"""The replay buffer of spec/11-replay.md for many records: they are on the disk, only an index and the newest are in
memory."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamer_spec.replay import recovery
from dreamer_spec.replay.batches import Batch, empty_batch, gather, require_same_form
from dreamer_spec.replay.contents import Contents
from dreamer_spec.replay.layout import LATENTS, Packed, layout_of
from dreamer_spec.replay.storage import state_arrays
from reference_numpy.shapes import require_shape


class Replay(Contents):
    """Sequences of T+1 consecutive records, found by their start positions. Implements [REP-1] to [REP-34]; every
    method takes `lock`.

    Args:
      capacity: how many start positions are kept.
      length: T, the time steps of a sequence that are trained on; one context step comes before them.
      directory: where the files are; must hold no buffer yet. None: a temporary directory that goes with the buffer.
      memory_limit: bytes of chunk files that may be mapped at once.
      deter_dtype: how `deter` is stored, "bfloat16" or "float32".
      classes: indices in `stoch` are below; up to 256 they take a byte each.
      chunk_records: records of a chunk file, a multiple of `block_records`. None: as many as 16 MiB hold, at most 16384
        and at most a sixty-fourth of the capacity, at least a block.
      block_records: records of a stream that are gathered in memory and written at once.
      restoring: the directory may hold a buffer; for `restore`, which then reads it.

    Raises:
      ValueError: an argument out of range, or a directory that is in use.
      UserError: the disk refuses the directory.
    """

    def add(self, step: Mapping[str, Any], worker: int) -> None:
        """Appends one record to the stream of a worker. Implements [REP-1], [REP-2], [REP-4] to [REP-7], [REP-27],
        [REP-28].

        Args:
          step: observations, reward, is_first, is_last, is_terminal, action [A], deter [D], stoch [S]; copied.

        Raises:
          ValueError: an entry is missing or unknown, differs in shape or kind from the first record, or is out of
            range.
          UserError: the disk is full or refuses a file; the buffer is as it was.
        """
        self.add_packed(self.pack({key: np.asarray(value)[None] for key, value in step.items()}), 0, worker)

    def add_batch(self, steps: Mapping[str, Any], workers: Iterable[int] | None = None) -> None:
        """Adds records [N, ...] one after another, of workers 0 .. N-1 or as given. Raises what `add` raises."""
        packed = self.pack(steps)
        for row, worker in enumerate(range(len(packed.sections[0])) if workers is None else workers):
            self.add_packed(packed, row, worker)

    def pack(self, steps: Mapping[str, Any]) -> Packed:
        """Records of N workers, every entry [N, ...], checked and converted at once; `add_packed` adds them one by one
        and copies.

        What is returned may share memory with `steps`: add it before they change.

        Raises:
          ValueError: as `add`.
        """
        if self.storage is not None:
            layout = self.storage.layout
        else:
            layout = layout_of(
                {key: np.asarray(value)[0] for key, value in steps.items()}, self.deter_dtype, self.classes
            )
        return Packed(layout, layout.pack(steps))

    def add_packed(self, packed: Packed, row: int, worker: int) -> None:
        """Appends record `row` of a pack to the stream of a worker; see `add`."""
        with self.lock:
            self.append(packed, row, worker)

    def sample(self, uniform: Any, online: bool = True, out: Batch | None = None) -> Batch:
        """A train batch: first from the online queue, then uniformly. Implements [REP-6], [REP-8] to [REP-18].

        Args:
          uniform: [B] numbers in [0, 1).
          online: whether rows may come from the online queue.
          out: a batch of the same size from an earlier call, to be filled again; saves the time in which new memory is
            made.

        Returns:
          Observations [B, T, ...], reward, is_first, is_last, is_terminal [B, T], prev_action [B, T, A], the context's
          deter [B, D] and stoch [B, S], and ids [B, 2]. Nothing in it is shared with the buffer.

        Raises:
          ValueError: no items, uniforms outside [0, 1), or an `out` of other keys, shapes or types.
        """
        uniform = np.asarray(uniform, np.float64)
        require_shape("uniform", uniform.shape, "B")
        if not uniform.size or not np.all((uniform >= 0) & (uniform < 1)):
            raise ValueError(f"uniform: expected at least one number, all in [0, 1), got {uniform!r}")
        with self.lock:
            if not len(self.items) or self.storage is None:
                raise ValueError(f"nothing to sample: no stream has the {self.length + 1} records of a sequence yet")
            batch = empty_batch(self.storage.layout, len(uniform), self.length)
            if out is not None:
                batch = require_same_form(out, batch)
            queue = self.items.queue
            chosen = [queue.popleft() if online and queue else self.items.draw(u) for u in uniform.tolist()]
            batch["ids"][...] = chosen
            gather(self.storage, [(self.streams[number], start) for number, start in chosen], self.length, batch)
        return batch

    def write_back(self, ids: Any, latents: Mapping[str, Any]) -> None:
        """Replaces the latents of the trained positions of sampled rows. Implements [REP-20] to [REP-22].

        Args:
          ids: [B, 2] as `sample` gave them.
          latents: {"deter" [B, T, D], "stoch" [B, T, S] class indices}.

        Raises:
          ValueError: an array has another shape, or an index is out of range.
          UserError: the disk is full or refuses a file.
        """
        ids, deter, stoch = np.asarray(ids), np.asarray(latents["deter"]), np.asarray(latents["stoch"])
        require_shape("ids", ids.shape, "B", 2)
        with self.lock:
            shapes = {key: self.storage.layout.entries[key][1] for key in LATENTS} if self.storage else {}
            for key, array in (("deter", deter), ("stoch", stoch)):
                require_shape(f"latents[{key!r}]", array.shape, len(ids), self.length, *shapes.get(key, ("?",)))
            if self.storage is None:
                return
            self.storage.layout.require_indices("latents['stoch']", stoch)
            for row, (number, start) in enumerate(ids.tolist()):
                stream = self.streams.get(number)
                low = max(start + 1, stream.first) if stream else 0
                high = min(start + 1 + self.length, stream.count) if stream else 0
                if stream and low < high:
                    held = slice(low - start - 1, high - start - 1)
                    self.storage.replace_latents(
                        stream, low, self.storage.layout.pack_latents(deter[row, held], stoch[row, held])
                    )

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """A copy of the content as flat named arrays, all in memory. Implements [REP-23] to [REP-25]; `save` is the way
        for a large one."""
        with self.lock:
            items = self.items.to_array()
            used = [self.streams[number] for number in sorted(set(items[:, 0].tolist()))]
            state = {
                "length": np.array(self.length, np.int64),
                "next_stream": np.array(self.next_stream, np.int64),
                "streams": np.array([(s.number, s.first, s.count - s.first) for s in used], np.int64).reshape(-1, 3),
                "items": items,
            }
            records = state_arrays(self.storage, used) if self.storage else {}
            return state | {f"records/{key}": array for key, array in records.items()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Replaces the content by a saved one; all streams are closed, the queue is empty. Implements [REP-24] to
        [REP-26].

        Raises:
          ValueError: the state was saved with another length, or its records cannot be stored.
          UserError: the disk is full or refuses a file.
        """
        if int(state["length"]) != self.length:
            raise ValueError(
                f"the saved replay has length {int(state['length'])}, this one {self.length}: sequences would differ"
            )
        arrays = {
            name.removeprefix("records/"): np.asarray(array)
            for name, array in state.items()
            if name.startswith("records/")
        }
        with self.lock:
            self.clear()
            self.next_stream = int(state["next_stream"])
            if not arrays:
                return
            layout = layout_of(
                {key: np.zeros(array.shape[1:], array.dtype) for key, array in arrays.items()},
                self.deter_dtype,
                self.classes,
            )
            if self.storage is None or self.storage.layout != layout:
                self.make_storage(layout)
            assert self.storage is not None
            row = 0
            for number, first, count in np.asarray(state["streams"]).tolist():
                packed = layout.pack({key: array[row : row + count] for key, array in arrays.items()})
                self.streams[number] = self.storage.closed_stream(number, first, packed)
                row += count
            for number, start in np.asarray(state["items"]).tolist():
                if len(self.items) == self.capacity:
                    self.evict()
                self.items.append((number, start))

    def save(self, name: str) -> dict[str, Any]:
        """Makes the content of this moment restorable, also after `kill -9`. Implements [REP-29], [REP-30].

        Returns:
          A description in plain JSON types, for `restore`. It holds until `keep` is called without the name.

        Raises:
          UserError: the disk is full or refuses a file; what was saved before stays restorable.
        """
        with self.lock:
            return recovery.save(self, name)

    def keep(self, names: Iterable[str]) -> None:
        """Lets go of every save but the newest of each of these names, and of the disk space that only the others
        needed."""
        with self.lock:
            self.epochs.keep(names)

    @classmethod
    def restore(
        cls,
        directory: Path,
        description: Mapping[str, Any],
        capacity: int,
        length: int,
        *,
        continue_streams: bool = False,
        **settings: Any,
    ) -> "Replay":
        """The buffer as it was when `save` returned the description. Implements [REP-29] to [REP-31].

        Everything that was added or written back later is undone, saves made later are given up. Damaged or missing
        chunks are left out: `warnings` of the result names each of them and what went with it.

        Args:
          continue_streams: False: all streams are closed and the queue is empty, [REP-25]. True: workers go on with
            their streams and the queue is as it was, for environments that are restored too.
          settings: `memory_limit`, `deter_dtype`, `classes` as for a new buffer; the last two must be those of the
            saved one.

        Raises:
          ValueError: not a description, its file is damaged or missing, or the settings differ from those of the saved
            buffer.
          UserError: the disk refuses it.
        """
        replay = cls(capacity, length, directory, restoring=True, **settings)
        recovery.restore(replay, description, continue_streams)
        return replay
