"""The records of each worker of a run, from its diary: what every policy step saw, and what came with it."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from conformance.running.diary import Act, Diary, Frame, Key
from conformance.script import Script

Place = tuple[int, int]
"""Worker and position in its stream."""


@dataclasses.dataclass(frozen=True)
class Record:
    """What is stored of an observation: spec/00-notation.md.

    worker, position: its place. frame: with which the observation came. act, row: the policy step that it went through,
    by its number among those of training. latents: their mark.
    """

    worker: int
    position: int
    frame: Frame
    act: int
    row: int
    reward: float
    action: np.ndarray
    latents: int

    @property
    def place(self) -> Place:
        return self.worker, self.position

    @property
    def is_first(self) -> bool:
        return self.frame.is_reset

    @property
    def is_terminal(self) -> bool:
        return self.frame.terminated

    @property
    def is_last(self) -> bool:
        return self.frame.terminated or self.frame.truncated


def records_of(script: Script, diary: Diary, acts: Sequence[Act] | None = None) -> list[Record]:
    """The records in the order in which they are added: [LOOP-4], [LOOP-9], [LOOP-27].

    A worker is an environment, and what takes its place when it has failed. acts: the policy steps of training; all of
    them if there are no others.
    """
    frames = {frame.key: frame for frame in diary.frames}
    rewards = _rewards_so_far(diary.frames)
    streams: dict[int, list[Record]] = {}
    workers = _Workers(diary.failed)
    records = []
    for number, act in enumerate(diary.acts if acts is None else acts):
        for row, key in enumerate(act.keys):
            script.holds(f"an environment has given the observation of row {row}, policy step {number}", key in frames)
            frame = frames[key]
            stream = streams.setdefault(workers.of(frame.environment, row), [])
            reward = 0.0 if frame.is_reset else rewards[key] - (rewards[stream[-1].frame.key] if stream else 0.0)
            action = np.zeros_like(act.action[row]) if frame.terminated or frame.truncated else act.action[row]
            place = workers.of(frame.environment, row), len(stream)
            stream.append(Record(*place, frame, number, row, reward, action, act.latents[row]))
            records.append(stream[-1])
    script.holds("no two observations are the same", len({record.frame.key for record in records}) == len(records))
    return records


def streams_of(records: Sequence[Record]) -> dict[int, list[Record]]:
    """Worker -> its records."""
    workers = dict.fromkeys(record.worker for record in records)
    return {worker: [record for record in records if record.worker == worker] for worker in workers}


class _Workers:
    """Which worker an environment belongs to. One that comes later than another in the same row succeeds it, if that
    has failed."""

    def __init__(self, failed: Sequence[int]) -> None:
        self._failed = failed
        self._worker: dict[int, int] = {}
        self._in_row: dict[int, int] = {}

    def of(self, environment: int, row: int) -> int:
        if environment not in self._worker:
            before = self._in_row.get(row, -1)
            self._worker[environment] = (
                self._worker[before] if before in self._failed else len(set(self._worker.values()))
            )
        self._in_row[row] = environment
        return self._worker[environment]


def _rewards_so_far(frames: Sequence[Frame]) -> Mapping[Key, float]:
    """The sum of rewards of its episode up to each frame."""
    total: dict[int, float] = {}
    found = {}
    for frame in frames:
        total[frame.environment] = 0.0 if frame.is_reset else total[frame.environment] + frame.reward
        found[frame.key] = total[frame.environment]
    return found
