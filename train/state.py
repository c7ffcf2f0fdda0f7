"""What a run is made of while it runs."""

import collections
import dataclasses
from collections.abc import Mapping
from typing import Any

from reference_numpy.training_loop import ReplayRatio
from train.backend import Learner
from train.envs import Environments
from train.logger import Display, Logger
from train.options import Options
from train.replay import Prefetcher


@dataclasses.dataclass
class Counters:
    """How far a run is. records: environment steps without action repeat; starts: of this run, resumed ones included."""

    records: int = 0
    policy_steps: int = 0
    train_steps: int = 0
    starts: int = 0
    episodes: int = 0
    evaluations: int = 0
    evaluation_steps: int = 0
    seconds: float = 0.0


@dataclasses.dataclass
class Run:
    """Everything that a run is made of.

    metrics: of the train steps since the last line of metrics.
    interrupted: the signals that asked the run to end.
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
    random_return: float | None = None
    evaluation: dict[str, float] | None = None  # of the last evaluation: step, return
    returns: collections.deque[float] = dataclasses.field(default_factory=lambda: collections.deque(maxlen=20))  # of the last episodes
    metrics: list[Mapping[str, Any]] = dataclasses.field(default_factory=list)
    interrupted: list[int] = dataclasses.field(default_factory=list)

    @property
    def step(self) -> int:
        """Environment steps, action repeat included: the unit of --steps, of the logs and of the curve."""
        return self.counters.records * self.options.action_repeat
