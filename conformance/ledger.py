"""The replay buffer by its definition, and records of which every entry tells where it belongs."""

from typing import Any

import numpy as np

Record = dict[str, np.ndarray]
Arrays = dict[str, np.ndarray]
Item = tuple[int, int]
"""Number of a stream, and the position where the sequence starts."""

LATENTS = ("deter", "stoch")


def record(n: int, worker: int = 0, **changes: Any) -> Record:
    values: Record = {
        "x": np.array([n, worker], np.float32),
        "image": np.full((2, 3, 1), (7 * n + worker) % 256, np.uint8),
        "mode": np.array([n % 3], np.int64),
        "reward": np.array(0.5 * n, np.float32),
        "is_first": np.array(n == 0),
        "is_last": np.array(False),
        "is_terminal": np.array(False),
        "action": np.array([10 * n, -n], np.float32),
        "deter": np.array([n, 1000 + n, 1 / (n + 1)], np.float32),
        "stoch": np.array([n % 64, (n + 1) % 64], np.int32),
    }
    return values | changes


class Ledger:
    """The buffer by its definition: all records for ever, and plain lists. Slow, and nothing like an implementation."""

    def __init__(self, length: int) -> None:
        self.length = length
        self.streams: list[list[Record]] = []
        self.current: dict[int, int] = {}
        self.items: list[Item] = []
        self.queue: list[Item] = []

    def add(self, step: Record, worker: int, capacity: int) -> None:
        if worker not in self.current:
            self.current[worker] = len(self.streams)
            self.streams.append([])
        number = self.current[worker]
        self.streams[number].append({key: np.array(value) for key, value in step.items()})
        n = len(self.streams[number]) - 1
        if n >= self.length:
            self.items = [*self.items, (number, n - self.length)][-capacity:]
            if n % (self.length + 1) == 0:
                self.queue.append((number, n - self.length))

    def held(self, number: int, position: int) -> bool:
        if number >= len(self.streams) or not 0 <= position < len(self.streams[number]):
            return False
        open_ = number in self.current.values() and position >= len(self.streams[number]) - self.length
        return open_ or any((number, position - i) in self.items for i in range(self.length + 1))

    def choose(self, uniform: np.ndarray, online: bool) -> list[Item]:
        chosen = []
        for u in uniform:
            self.queue = [item for item in self.queue if item in self.items] if online else self.queue
            chosen.append(self.queue.pop(0) if online and self.queue else self.items[int(u * len(self.items))])
        return chosen

    def batch(self, chosen: list[Item]) -> Arrays:
        rows = [self.streams[number][start : start + self.length + 1] for number, start in chosen]
        batch = {
            key: np.array([[step[key] for step in row[1:]] for row in rows]) for key in rows[0][0] if key not in LATENTS
        }
        batch["prev_action"] = np.array([[step["action"] for step in row[:-1]] for row in rows])
        del batch["action"]
        for row, b in zip(rows, range(len(rows)), strict=True):
            for t in range(1, self.length):
                batch["is_last"][b, t - 1] = row[t]["is_last"] or row[t + 1]["is_first"]
        return {**batch, **{key: np.array([row[0][key] for row in rows]) for key in LATENTS}, "ids": np.array(chosen)}

    def write_back(self, ids: np.ndarray, fresh: Arrays) -> None:
        for row, (number, start) in enumerate(ids.tolist()):
            for t in range(self.length):
                if self.held(number, start + 1 + t):
                    self.streams[number][start + 1 + t] |= {key: fresh[key][row, t] for key in LATENTS}

    def state(self) -> Arrays:
        table = []
        for number in sorted({number for number, _ in self.items}):
            positions = [start for owner, start in self.items if owner == number]
            table.append((number, positions[0], len(positions) + self.length))
        records = [step for number, first, count in table for step in self.streams[number][first : first + count]]
        return {
            "length": np.array(self.length),
            "next_stream": np.array(len(self.streams)),
            "streams": np.array(table).reshape(-1, 3),
            "items": np.array(self.items).reshape(-1, 2),
            **{f"records/{key}": np.array([step[key] for step in records]) for key in (records[0] if records else {})},
        }

    def restart(self, capacity: int) -> None:
        self.current, self.queue, self.items = {}, [], self.items[-capacity:]
