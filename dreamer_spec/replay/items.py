"""Which sequences exist: the start positions in the order of their creation, and the online queue."""

import collections
from typing import Any

import numpy as np
from numpy.typing import NDArray

Item = tuple[int, int]  # stream number, start position

_POSITION_BITS = 40
_POSITIONS = 1 << _POSITION_BITS
_STREAMS = 1 << (63 - _POSITION_BITS)


class Items:
    """A ring of `capacity` items, eight bytes each, and the queue. Implements [REP-3], [REP-4], [REP-7] to [REP-9].

    Items leave in the order in which they came, and so do the entries of the queue: an evicted entry is always its
    head.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.queue: collections.deque[Item] = collections.deque()
        self._ring = np.empty(capacity, np.int64)
        self._oldest = 0
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, item: Item) -> None:
        """Adds the newest item; there must be room."""
        self._ring[(self._oldest + self._count) % self.capacity] = item[0] << _POSITION_BITS | item[1]
        self._count += 1

    def pop_oldest(self) -> Item:
        item = self[0]
        self._oldest = (self._oldest + 1) % self.capacity
        self._count -= 1
        if self.queue and self.queue[0] == item:
            self.queue.popleft()
        return item

    def __getitem__(self, index: int) -> Item:
        """Item number `index`, 0 being the oldest."""
        code = int(self._ring[(self._oldest + index) % self.capacity])
        return code >> _POSITION_BITS, code & (_POSITIONS - 1)

    def draw(self, u: float) -> Item:
        """[REP-12]: the item that a number in [0, 1) chooses."""
        return self[min(int(u * self._count), self._count - 1)]

    def to_array(self) -> NDArray[np.int64]:
        """All items [n, 2], oldest first."""
        return decode(self.codes())

    def codes(self) -> NDArray[np.int64]:
        """All items [n], oldest first, eight bytes each."""
        end = self._oldest + self._count
        return np.concatenate([self._ring[self._oldest : end], self._ring[: max(0, end - self.capacity)]])

    def extend(self, codes: NDArray[np.int64]) -> None:
        """Fills an empty ring."""
        self._ring[: len(codes)] = codes
        self._oldest, self._count = 0, len(codes)


def encode(items: NDArray[np.int64]) -> NDArray[np.int64]:
    """[n, 2] to [n]."""
    return items[:, 0] << _POSITION_BITS | items[:, 1]


def decode(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """[n] to [n, 2]."""
    return np.stack([codes >> _POSITION_BITS, codes & (_POSITIONS - 1)], axis=-1)


def require_representable(number: int, position: int) -> None:
    """Raises:
    ValueError: more streams or records than the index can tell apart; eight million starts or a trillion steps of one
    worker.
    """
    if number >= _STREAMS or position >= _POSITIONS:
        raise ValueError(
            f"stream {number}, position {position}: the index holds {_STREAMS} streams of {_POSITIONS} records"
        )


def are_representable(number: int, positions: NDArray[Any]) -> bool:
    """Whether the index can tell these apart."""
    return number < _STREAMS and bool(np.all(positions < _POSITIONS))
