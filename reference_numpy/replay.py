"""The replay buffer: uniform sampling with an online queue, stored latents and their write-back.

Chapter: spec/11-replay.md. Paper: section Implementation, Experience replay. This is the plain definition; it is also
fast enough for small runs. Nothing here is differentiable, and types are those of the records, not float64.
"""

import collections
import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reference_numpy.shapes import require_shape

Record = dict[str, NDArray[Any]]

_TYPES = {
    "reward": np.float32,
    "is_first": np.bool_,
    "is_last": np.bool_,
    "is_terminal": np.bool_,
    "action": np.float32,
    "deter": np.float32,
    "stoch": np.int32,
}
_VECTORS = ("action", "deter", "stoch")  # the others in _TYPES are scalars


@dataclasses.dataclass
class _Stream:
    """The held records of one worker, by position; positions are first .. count-1."""

    first: int = 0
    count: int = 0
    records: dict[int, Record] = dataclasses.field(default_factory=dict)


class Replay:
    """Sequences of T+1 consecutive records, found by their start positions. Implements [REP-1] to [REP-28].

    Args:
      capacity: how many start positions are kept.
      length: T, the time steps of a sequence that are trained on; one context step comes before them.

    Raises:
      ValueError: a capacity or length below 1.
    """

    def __init__(self, capacity: int, length: int) -> None:
        if capacity < 1 or length < 1:
            raise ValueError(f"capacity and length must be at least 1, got {capacity} and {length}")
        self.capacity, self.length = capacity, length
        self._clear()

    def _clear(self) -> None:
        self._streams: dict[int, _Stream] = {}
        self._next_stream = 0
        self._current: dict[int, int] = {}  # worker -> number of the stream it writes to
        # A ring: item i, counted from the oldest, is at (oldest + i) % len. It grows until it holds `capacity` items.
        self._items: list[tuple[int, int]] = []
        self._oldest = 0
        self._queue: collections.deque[tuple[int, int]] = collections.deque()
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._dtypes: dict[str, np.dtype[Any]] = {}

    def __len__(self) -> int:
        """The number of items. Implements [REP-3]."""
        return len(self._items)

    def add(self, step: Mapping[str, Any], worker: int) -> None:
        """Appends one record to the stream of a worker.
        Implements [REP-1], [REP-2], [REP-4] to [REP-7], [REP-27], [REP-28].

        Args:
          step: observations, reward, is_first, is_last, is_terminal, action [A], deter [D], stoch [S]; copied.

        Raises:
          ValueError: an entry is missing or unknown, or differs in shape or kind from the first record.
        """
        record = self._checked_record(step)
        if worker not in self._current:
            self._current[worker] = self._next_stream
            self._streams[self._next_stream] = _Stream()
            self._next_stream += 1
        number = self._current[worker]
        stream = self._streams[number]
        position = stream.count
        stream.records[position] = record
        stream.count += 1
        if position >= self.length:
            item = (number, position - self.length)
            self._add_item(item)
            if position % (self.length + 1) == 0:
                self._queue.append(item)

    def sample(self, uniform: Any, online: bool = True) -> dict[str, NDArray[Any]]:
        """A train batch: first from the online queue, then uniformly. Implements [REP-6], [REP-8] to [REP-18].

        Args:
          uniform: [B] numbers in [0, 1).
          online: whether rows may come from the online queue.

        Returns:
          Observations [B, T, ...], reward, is_first, is_last, is_terminal [B, T], prev_action [B, T, A], the context's
          deter [B, D] and stoch [B, S], and ids [B, 2].

        Raises:
          ValueError: no items, or uniforms outside [0, 1).
        """
        uniform = np.asarray(uniform, np.float64)
        require_shape("uniform", uniform.shape, "B")
        if not uniform.size or not np.all((uniform >= 0) & (uniform < 1)):
            raise ValueError(f"uniform: expected at least one number, all in [0, 1), got {uniform!r}")
        if not self._items:
            raise ValueError(f"nothing to sample: no stream has the {self.length + 1} records of a sequence yet")
        chosen = [(online and self._pop_queue()) or self._draw(u) for u in uniform]
        rows = [[self._streams[number].records[start + i] for i in range(self.length + 1)] for number, start in chosen]

        batch = {"ids": np.array(chosen, np.int64).reshape(-1, 2)}
        contexts = [row[:1] for row in rows]
        batch["deter"], batch["stoch"] = self._gather(contexts, "deter")[:, 0], self._gather(contexts, "stoch")[:, 0]
        batch["prev_action"] = self._gather([row[:-1] for row in rows], "action")
        trained = [row[1:] for row in rows]
        for key in self._shapes:
            if key not in _VECTORS:
                batch[key] = self._gather(trained, key)
        # The last position keeps its flag: whether the next record starts an episode is not known inside the sequence.
        batch["is_last"][:, :-1] |= batch["is_first"][:, 1:]
        return batch

    def write_back(self, ids: Any, latents: Mapping[str, Any]) -> None:
        """Replaces the latents of the trained positions of sampled rows. Implements [REP-20] to [REP-22].

        Args:
          ids: [B, 2] as `sample` gave them.
          latents: {"deter" [B, T, D], "stoch" [B, T, S] class indices}.

        Raises:
          ValueError: an array has another shape.
        """
        ids, deter, stoch = np.asarray(ids), np.asarray(latents["deter"]), np.asarray(latents["stoch"])
        require_shape("ids", ids.shape, "B", 2)
        for key, array in (("deter", deter), ("stoch", stoch)):
            require_shape(f"latents[{key!r}]", array.shape, len(ids), self.length, *self._shapes.get(key, ("?",)))
        if stoch.dtype.kind not in "iu":
            raise ValueError(f"latents['stoch']: expected class indices of an integer type, got {stoch.dtype}")
        for row, (number, start) in enumerate(ids.tolist()):
            stream = self._streams.get(number, _Stream())
            for t in range(self.length):
                record = stream.records.get(start + 1 + t)
                if record is not None:
                    record["deter"][...] = deter[row, t]
                    record["stoch"][...] = stoch[row, t]

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """A copy of the content as flat named arrays. Implements [REP-23] to [REP-25]."""
        items = self._items[self._oldest :] + self._items[: self._oldest]
        used = {number: self._streams[number] for number in sorted({number for number, _ in items})}
        state = {
            "length": np.array(self.length, np.int64),
            "next_stream": np.array(self._next_stream, np.int64),
            "streams": np.array([(n, s.first, s.count - s.first) for n, s in used.items()], np.int64).reshape(-1, 3),
            "items": np.array(items, np.int64).reshape(-1, 2),
        }
        records = [stream.records[p] for stream in used.values() for p in range(stream.first, stream.count)]
        for key in self._shapes:
            state[f"records/{key}"] = self._gather([records], key)[0]
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Replaces the content by a saved one; all streams are closed, the queue is empty.
        Implements [REP-24] to [REP-26].

        Raises:
          ValueError: the state was saved with another length.
        """
        if int(state["length"]) != self.length:
            raise ValueError(
                f"the saved replay has length {int(state['length'])}, this one {self.length}: sequences would differ"
            )
        self._clear()
        self._next_stream = int(state["next_stream"])
        arrays = {
            name.removeprefix("records/"): np.asarray(array)
            for name, array in state.items()
            if name.startswith("records/")
        }
        self._shapes = {key: array.shape[1:] for key, array in arrays.items()}
        self._dtypes = {key: array.dtype for key, array in arrays.items()}
        row = 0
        for number, first, count in np.asarray(state["streams"]).tolist():
            positions = range(first, first + count)
            records = {p: {key: np.array(array[row + p - first]) for key, array in arrays.items()} for p in positions}
            self._streams[number] = _Stream(first, first + count, records)
            row += count
        for number, start in np.asarray(state["items"]).tolist():
            self._add_item((number, start))

    def _checked_record(self, step: Mapping[str, Any]) -> Record:
        values = {key: np.asarray(value) for key, value in step.items()}
        if not self._shapes:
            missing = [key for key in _TYPES if key not in values]
            if missing or len(values) == len(_TYPES):
                raise ValueError(f"the record lacks {', '.join(missing) or 'an observation'}")
            for key in _TYPES:
                require_shape(f"{key} of the record", values[key].shape, *("n",) * (key in _VECTORS))
            floats = {key: np.float32 for key, value in values.items() if value.dtype.kind == "f"}
            dtypes = {key: np.dtype(_TYPES.get(key, floats.get(key, value.dtype))) for key, value in values.items()}
            self._shapes, self._dtypes = {key: value.shape for key, value in values.items()}, dtypes
        if values.keys() != self._shapes.keys():
            raise ValueError(
                f"the record has the keys {sorted(values)}; expected {sorted(self._shapes)} as in the first record"
            )
        for key, value in values.items():
            require_shape(f"{key} of the record", value.shape, *self._shapes[key])
            if not np.can_cast(value.dtype, self._dtypes[key], "same_kind"):
                raise ValueError(
                    f"{key} of the record: expected numbers of type {self._dtypes[key]}, got {value.dtype}"
                )
        return {key: np.array(value, self._dtypes[key]) for key, value in values.items()}

    def _add_item(self, item: tuple[int, int]) -> None:
        if len(self._items) < self.capacity:
            self._items.append(item)
            return
        self._evict(*self._items[self._oldest])
        self._items[self._oldest] = item
        self._oldest = (self._oldest + 1) % self.capacity

    def _evict(self, number: int, start: int) -> None:
        """A stream's items leave in the order of their starts, so the record at the start is no longer needed."""
        stream = self._streams[number]
        del stream.records[start]
        stream.first = start + 1
        closed = number not in self._current.values()
        if closed and stream.count - stream.first <= self.length:
            del self._streams[number]

    def _pop_queue(self) -> tuple[int, int] | None:
        while self._queue:
            number, start = self._queue.popleft()
            if number in self._streams and start >= self._streams[number].first:
                return number, start
        return None

    def _draw(self, u: float) -> tuple[int, int]:
        n = len(self._items)
        return self._items[(self._oldest + min(int(u * n), n - 1)) % n]

    def _gather(self, rows: list[list[Record]], key: str) -> NDArray[Any]:
        """Copies one entry of [B, T] records into a new array [B, T, ...]."""
        out = np.empty((len(rows), len(rows[0]) if rows else 0, *self._shapes[key]), self._dtypes[key])
        for b, row in enumerate(rows):
            for t, record in enumerate(row):
                out[b, t] = record[key]
        return out
