"""One environment as a stream of records without end, whose failures are values: what runs inside a worker process."""

import contextlib
import dataclasses
import os
import signal
import traceback
from collections.abc import Callable
from typing import Any, Literal

import gymnasium
import numpy as np

from spec import Spaces
from train.envs.adapter import ContractEnv, Garbage, Observation, array_spaces, where
from train.envs.history import History
from train.errors import UserError

Step = tuple[Observation, float, bool, bool, dict[str, Any]]


@dataclasses.dataclass(frozen=True)
class Failure:
    """An environment did not give its next record.

    worker: its index. kind: its process ended ("crash"), it raised ("error"), did not answer in time ("timeout"), or returned what its
    spaces do not allow ("garbage"). message: names task, environment and step. details: the traceback of an error, else empty.
    """

    worker: int
    kind: Literal["crash", "error", "timeout", "garbage"]
    message: str
    details: str = ""


class Stream(gymnasium.Env[Observation, np.ndarray]):
    """The step after the end of an episode ignores its action and resets: [LOOP-11]. Nothing raises: see `_failed`.

    make: index -> environment; called by the first reset, for which Gymnasium waits with a limit, as it does not for the making.
    spaces: those of every environment of the run. trainer: id of the process that closes the workers. env: if it has been made already.
    """

    def __init__(
        self,
        make: Callable[[int], ContractEnv],
        index: int,
        task: str,
        spaces: Spaces,
        trainer: int,
        env: ContractEnv | None = None,
    ) -> None:
        self._make = make
        self._index = index
        self._task = task
        self._spaces = spaces
        self._env = env
        self._ended = False
        self._steps = 0
        self.metadata = {}
        self.observation_space, self.action_space = array_spaces(spaces)
        self._nothing = {key: np.zeros(space.array_shape) for key, space in spaces.observations.items()}
        if os.getpid() != trainer:
            for number in {signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)}:  # On Windows nothing hangs up.
                signal.signal(number, signal.SIG_IGN)  # Sent to the whole group, they are for the trainer, which closes its workers.

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """`resume` as Gymnasium calls it. options: "episode" and "actions" of the history. Reward and flags are in the info."""
        assert seed is not None
        observation, reward, terminated, truncated, info = self.resume(History(seed, **(options or {})))
        return observation, {"reward": reward, "terminated": terminated, "truncated": truncated, **info}

    def resume(self, history: History) -> Step:
        """Begins the episode of a history and replays its actions: [LOOP-34]. What followed the last one."""
        try:
            return self._replay(history)
        except Exception as error:
            return self._failed(error)

    def step(self, action: np.ndarray) -> Step:
        try:
            return self._advance(action)
        except Exception as error:
            return self._failed(error)

    def _replay(self, history: History) -> Step:
        if self._env is None:
            self._env = self._made()
        observation, _ = self._env.reset(seed=history.seed, options={"episode": history.episode})
        self._ended = False
        step: Step = observation, 0.0, False, False, {}
        for action in history.actions:
            if self._ended:
                raise ValueError(f"episode {history.episode} ended before all of its actions were replayed: it is not deterministic")
            step = self._advance(action)
        return step

    def _advance(self, action: np.ndarray) -> Step:
        assert self._env is not None, "reset comes first"
        if self._ended:
            self._ended = False
            return self._env.reset()[0], 0.0, False, False, {}
        self._steps += 1
        step = self._env.step(action)
        self._ended = step[2] or step[3]
        return step

    def _made(self) -> ContractEnv:
        env = self._make(self._index)
        if env.spaces != self._spaces:
            raise UserError(f"task {self._task}: environment {self._index} has the spaces {env.spaces}, others {self._spaces}")
        return env

    def _failed(self, error: Exception) -> Step:
        """A failure in the info: as an exception it would lose its traceback on its way through Gymnasium."""
        if isinstance(error, UserError):
            failure = Failure(self._index, "garbage" if isinstance(error, Garbage) else "error", str(error), error.details)
        else:
            place = where(self._task, self._index, self._steps)
            message = f"{place}: the environment raised {type(error).__name__}: {error}"
            failure = Failure(self._index, "error", message, traceback.format_exc())
        return self._nothing, 0.0, False, False, {"failure": failure}

    def shut(self) -> None:
        """Closes the environment as well as it can be closed."""
        env, self._env = self._env, None
        if env is not None:
            with contextlib.suppress(Exception):
                env.close()

    def close(self) -> None:
        self.shut()
