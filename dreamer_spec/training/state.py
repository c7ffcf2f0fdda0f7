"""What a run is made of while it runs."""

import collections
import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from dreamer_spec.backend import Learner
from dreamer_spec.envs import Environments, Record
from dreamer_spec.monitoring.clock import Clock
from dreamer_spec.monitoring.logger import Display, Logger
from dreamer_spec.options import Options
from dreamer_spec.replay import Prefetcher
from reference_numpy.training_loop import ReplayRatio


@dataclasses.dataclass
class Counters:
    """How far a run is. records: environment steps without action repeat; starts: how often all environments were
    restarted; due: train steps that wait for the end of an episode."""

    records: int = 0
    policy_steps: int = 0
    train_steps: int = 0
    due: int = 0
    starts: int = 0
    episodes: int = 0
    evaluations: int = 0
    evaluation_steps: int = 0
    seconds: float = 0.0


class Scores:
    """Returns and lengths of the episodes under way: [LOOP-20]."""

    def __init__(self, count: int) -> None:
        self.total = np.zeros(count)
        self.length = np.zeros(count, np.int64)

    def update(self, record: Record) -> list[tuple[int, float, int]]:
        """(worker, return, length) of the episodes that end with these records."""
        self.total = np.where(record["is_first"], 0.0, self.total) + record["reward"]
        self.length = np.where(record["is_first"], 0, self.length) + 1
        return [
            (int(worker), float(self.total[worker]), int(self.length[worker]))
            for worker in np.flatnonzero(record["is_last"])
        ]


class Means:
    """Means of metrics since they were last taken."""

    def __init__(self, sums: Mapping[str, tuple[float, int]] | None = None) -> None:
        self.sums = {
            name: (float(total), int(count)) for name, (total, count) in (sums or {}).items()
        }  # name -> sum, how many

    def add(self, metrics: Mapping[str, float]) -> None:
        for name, value in metrics.items():
            total, count = self.sums.get(name, (0.0, 0))
            self.sums[name] = total + value, count + 1

    def take(self) -> dict[str, float]:
        sums, self.sums = self.sums, {}
        return {name: total / count for name, (total, count) in sums.items()}


@dataclasses.dataclass(frozen=True)
class TrainStep:
    """A train step whose metrics have not been looked at yet."""

    number: int
    seed: int
    batch: Mapping[str, np.ndarray]
    metrics: Mapping[str, Any]


@dataclasses.dataclass
class TrainingRun:
    """Everything that a run is made of.

    record, carry: the newest records of the environments, and the policy's carry before it has seen them.
    signals: those that asked the run to end.
    """

    options: Options
    envs: Environments
    test_envs: Environments | None
    learner: Learner
    replay: Prefetcher
    ratio: ReplayRatio
    logger: Logger
    display: Display
    counters: Counters
    scores: Scores
    record: Record
    carry: Any
    clock: Clock = dataclasses.field(default_factory=Clock)
    means: Means = dataclasses.field(default_factory=Means)  # of the train steps since the last line of metrics
    unsettled: TrainStep | None = None  # the newest train step
    warm: bool = False  # whether a train step has been made since the process began
    random_return: float | None = None
    evaluation: dict[str, float] | None = None  # of the last evaluation: step, return
    returns: collections.deque[float] = dataclasses.field(
        default_factory=lambda: collections.deque(maxlen=20)
    )  # of the last episodes
    signals: list[int] = dataclasses.field(default_factory=list)

    @property
    def interrupted(self) -> bool:
        """Whether the run shall end early: by a signal, or because somebody who watches its metrics wants it."""
        return bool(self.signals) or self.logger.stopped

    @property
    def ending(self) -> str:
        """How the run ends early, as a word for messages."""
        return "interrupted" if self.signals else "stopped by the callback"

    @property
    def shares_environment(self) -> bool:
        """Whether evaluations are played in the environment of training: [LOOP-66]."""
        return self.test_envs is self.envs

    @property
    def step(self) -> int:
        """Environment steps, action repeat included: the unit of --steps, of the logs and of the curve."""
        return self.counters.records * self.options.action_repeat
