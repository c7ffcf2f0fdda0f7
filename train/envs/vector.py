"""N environments side by side, each a stream of records as in spec/00-notation.md.

Gymnasium's autoreset mode NEXT_STEP gives these streams: the step after the end of an episode ignores its action and returns the reset
observation with reward 0. So the last observation of an episode is a record of its own, with its reward and its flags.
"""

import dataclasses
import functools
import multiprocessing
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from spec import Spaces
from train.envs.adapter import ContractEnv
from train.envs.spaces import random_actions
from train.errors import UserError

Record = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Failure:
    worker: int
    kind: str
    message: str


@dataclasses.dataclass(frozen=True)
class History:
    seed: int
    episode: int
    actions: np.ndarray

    def to_json(self) -> dict[str, Any]:
        return {"seed": self.seed, "episode": self.episode}

    @classmethod
    def from_json(cls, entry: dict[str, Any], actions: np.ndarray) -> "History":
        return cls(**entry, actions=actions)


FLAGS = ("is_first", "is_last", "is_terminal")

SLOW_STEP = 5e-4  # seconds; from here on a process of its own is faster than taking turns


class Environments:
    """`count` environments, in this process or in one process each.

    make: index -> environment; must be picklable by cloudpickle.

    `start(action)` sends the actions off, `finish()` waits for the records: what happens in between overlaps with the environments where
    they have processes of their own. `reset(seeds)` begins everywhere anew, and seeds this episode and all after it.
    """

    def __init__(
        self, make: Callable[[int], ContractEnv], count: int, processes: bool, timeout: float = 600.0, failures_allowed: int = 10
    ) -> None:
        self.count = count
        self.failures = 0
        self._action: np.ndarray | None = None
        self._pending = False  # whether worker processes owe an answer, or failed to give one
        self._is_last = np.zeros(self.count, bool)
        makers = [functools.partial(_make_in_worker, make, index) for index in range(self.count)]
        self._guard = _worker_errors if processes else nullcontext
        self._envs: AsyncVectorEnv | SyncVectorEnv
        if processes:
            with self._guard():
                self._envs = AsyncVectorEnv(makers, context=_start_method(), autoreset_mode=AutoresetMode.NEXT_STEP)
        else:
            self._envs = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.NEXT_STEP)
        self.spaces: Spaces = self._envs.get_attr("spaces")[0]

    def reset(self, seeds: list[int]) -> Record:
        """The first records of new episodes, [N, ...] each."""
        self._pending = True
        with self._guard():
            observation, _ = self._envs.reset(seed=list(seeds))
        self._pending = False
        nothing = np.zeros(self.count, bool)
        self._is_last = nothing
        return self._record(observation, np.zeros(self.count), np.ones(self.count, bool), nothing, nothing)

    def start(self, action: np.ndarray) -> None:
        """Sends flat actions [N, A]; where the last record was the last of an episode, the action is ignored."""
        self._pending = True
        with self._guard():
            if isinstance(self._envs, AsyncVectorEnv):
                self._envs.step_async(action)
            else:
                self._action = np.array(action)

    def finish(self) -> Record:
        """The records that follow the actions, [N, ...] each."""
        with self._guard():
            if isinstance(self._envs, AsyncVectorEnv):
                observation, reward, terminated, truncated, _ = self._envs.step_wait()
            else:
                observation, reward, terminated, truncated, _ = self._envs.step(self._action)
        self._pending = False
        is_first = self._is_last
        self._is_last = terminated | truncated
        return self._record(observation, reward, is_first, self._is_last, terminated)

    def take_failures(self) -> list[Failure]:
        return []

    def histories(self) -> list[History | None]:
        return [None] * self.count

    def restore(self, histories: list[History | None]) -> Record | None:
        return None

    def step(self, action: np.ndarray) -> Record:
        """`start` and `finish` in one."""
        self.start(action)
        return self.finish()

    def close(self) -> None:
        if isinstance(self._envs, AsyncVectorEnv) and self._pending:
            # Gymnasium would wait for answers that have been read already, or that a worker which is gone will never give.
            for process in self._envs.processes:
                process.kill()
                process.join()
            for pipe in self._envs.parent_pipes:
                if pipe is not None:
                    pipe.close()
            self._envs.closed = True
        else:
            self._envs.close()

    def _record(self, observation: Any, reward: np.ndarray, *flags: np.ndarray) -> Record:
        """Everything in memory of its own: the vector environments keep and reuse their arrays."""
        flags_by_name = {name: np.array(flag, bool) for name, flag in zip(FLAGS, flags, strict=True)}
        return {**observation, "reward": np.array(reward, np.float32), **flags_by_name}


def is_slow(make: Callable[[int], ContractEnv], seed: int) -> bool:
    """Whether one environment takes long enough for a step to deserve a process: measured, for 0.3 seconds at most."""
    env = make(0)
    rng = np.random.default_rng(seed)
    try:
        env.reset(seed=seed)
        start, steps = time.perf_counter(), 0
        while steps < 100 and time.perf_counter() - start < 0.3:
            _, _, terminated, truncated, _ = env.step(random_actions(env.spaces, rng, 1)[0])
            steps += 1
            if terminated or truncated:
                env.reset()
        return (time.perf_counter() - start) / steps > SLOW_STEP
    finally:
        env.close()


def _make_in_worker(make: Callable[[int], ContractEnv], index: int) -> ContractEnv:
    if multiprocessing.parent_process() is not None:
        for number in (signal.SIGINT, signal.SIGTERM):  # Sent to the whole group, they are for the trainer, which then closes its workers.
            signal.signal(number, signal.SIG_IGN)
    return make(index)


def _start_method() -> str:
    """Workers must not be forks of this process: a backend has threads in it."""
    if sys.platform == "win32":
        return "spawn"
    multiprocessing.set_forkserver_preload(["train.envs"])
    return "forkserver"


@contextmanager
def _worker_errors() -> Iterator[None]:
    """Gymnasium warns about errors of its workers, with their traceback, before it raises them here. The error itself says all."""
    level, gymnasium.logger.min_level = gymnasium.logger.min_level, gymnasium.logger.ERROR + 1
    try:
        yield
    except (EOFError, ConnectionError) as error:
        raise UserError(
            "a process of an environment ended unexpectedly (killed, or out of memory?); what it said is above; "
            "with --processes no the environments run in the trainer's own process"
        ) from error
    finally:
        gymnasium.logger.min_level = level
