"""What chapters 11 and 12 demand of a run whose records are known."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from conformance.running.records import Place, Record
from reference_numpy.replay import Replay
from reference_numpy.training_loop import ReplayRatio, can_train
from spec import Config


def train_steps(records: Sequence[Record], config: Config) -> list[int]:
    """How many train steps follow each record: [LOOP-4], [LOOP-13] to [LOOP-16]."""
    ratio = ReplayRatio(config.replay_ratio, config.batch_size * config.batch_length)
    items, counts = 0, []
    for step, record in enumerate(records, 1):
        items = min(items + (record.position >= config.batch_length), config.replay_capacity)
        counts.append(ratio(step) if can_train(items, config) else 0)
    return counts


def train_steps_by_act(records: Sequence[Record], config: Config) -> list[int]:
    """How many train steps follow each policy step."""
    counts = np.zeros(records[-1].act + 1, int)
    for record, count in zip(records, train_steps(records, config), strict=True):
        counts[record.act] += count
    return [int(count) for count in counts]


def batch_row(stream: Sequence[Record], start: int, length: int) -> dict[str, np.ndarray]:
    """The trained positions of a sequence, but for its latents: [REP-14] to [REP-17]."""
    trained = stream[start + 1 : start + 1 + length]
    keys = trained[0].frame.observation
    row = {key: np.stack([record.frame.observation[key] for record in trained]) for key in keys}
    row |= {
        flag: np.array([getattr(record, flag) for record in trained]) for flag in ("is_first", "is_last", "is_terminal")
    }
    row["is_last"][:-1] |= row["is_first"][1:]
    row["reward"] = np.array([record.reward for record in trained], np.float32)
    row["prev_action"] = np.stack([record.action for record in stream[start : start + length]])
    return row


def draws(
    records: Sequence[Record], config: Config, uniform: Callable[[int], np.ndarray], ahead: bool
) -> list[list[list[Place]]]:
    """The places [B][T] of the trained positions of every batch: [REP-7] to [REP-12], [LOOP-26].

    uniform: train step -> the numbers that draw its batch. ahead: whether each batch but the first is drawn when the
    one before is taken [REP-33], and not when it is needed.
    """
    replay = Replay(config.replay_capacity, config.batch_length)

    def draw(number: int) -> list[list[Place]]:
        places = replay.sample(uniform(number))["place"]
        return [[(int(worker), int(position)) for worker, position in row] for row in places]

    batches: list[list[list[Place]]] = []
    waiting: list[list[Place]] | None = None
    for record, count in zip(records, train_steps(records, config), strict=True):
        replay.add(_placed(record), record.worker)
        for _ in range(count):
            number = len(batches)
            batches.append(draw(number) if waiting is None else waiting)
            waiting = draw(number + 1) if ahead else None
    return batches


def _placed(record: Record) -> Mapping[str, Any]:
    nothing = {"reward": 0.0, "is_first": False, "is_last": False, "is_terminal": False}
    return {"place": np.array(record.place), **nothing, "action": [0.0], "deter": [0.0], "stoch": [0]}


class StoredLatents:
    """The marks of the latents that records hold, as train steps write them back: [LOOP-3], [LOOP-17], [LOOP-43]."""

    def __init__(self, streams: Mapping[int, Sequence[Record]]) -> None:
        self._marks = {record.place: [(-2, record.latents)] for stream in streams.values() for record in stream}

    def allowed(self, place: Place, train_step: int) -> list[int]:
        """The marks that a batch of a train step may hold: with the latents of the step before, or without them."""
        return [
            next(mark for step, mark in reversed(self._marks[place]) if step < train_step - late) for late in (0, 1)
        ]

    def write_back(self, rows: Sequence[Sequence[Place]], marks: Sequence[Sequence[int]], train_step: int) -> None:
        """The later row wins: [REP-22]."""
        for places, fresh in zip(rows, marks, strict=True):
            for place, mark in zip(places, fresh, strict=True):
                self._marks[place].append((train_step, mark))
