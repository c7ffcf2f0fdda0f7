"""One environment as a stream of records without end, whose failures are values: what runs inside a worker process."""

import os
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from dreamer_spec.envs.adapter import ContractEnv, Observation, array_spaces, where
from dreamer_spec.envs.failure import Failure, attempt
from dreamer_spec.envs.history import History
from dreamer_spec.envs.process import begin_worker
from dreamer_spec.errors import UserError
from dreamer_spec.translation import Translation

Step = tuple[Observation, float, bool, bool, dict[str, Any]]


class StreamEnv(gymnasium.Env[Observation, np.ndarray]):
    """The step after the end of an episode ignores its action and resets: [LOOP-11]. Nothing raises: see `_guarded`.

    make: index -> environment; called by the first reset, for which Gymnasium waits with a limit, as it does not for
    the making.
    translation: of every environment of the run. trainer: id of the process that closes the workers. env: if it has
    been made already.
    """

    def __init__(
        self,
        make: Callable[[int], ContractEnv],
        index: int,
        task: str,
        translation: Translation,
        trainer: int,
        env: ContractEnv | None = None,
    ) -> None:
        self._make = make
        self._index = index
        self._task = task
        self._translation = translation
        spaces = translation.spaces
        self._env = env
        self._ended = False
        self._steps = 0
        self.metadata = {}
        self.observation_space, self.action_space = array_spaces(spaces)
        self._nothing = {key: np.zeros(space.array_shape) for key, space in spaces.observations.items()}
        if os.getpid() != trainer:
            begin_worker()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """`resume` as Gymnasium calls it. options: "episode" and "actions" of the history. Reward and flags are in the
        info."""
        assert seed is not None
        observation, reward, terminated, truncated, info = self.resume(History(seed, **(options or {})))
        return observation, {"reward": reward, "terminated": terminated, "truncated": truncated, **info}

    def resume(self, history: History) -> Step:
        """Begins the episode of a history and replays its actions: [LOOP-34]. What followed the last one."""
        return self._guarded(lambda: self._replay(history))

    def step(self, action: np.ndarray) -> Step:
        return self._guarded(lambda: self._advance(action))

    def _guarded(self, work: Callable[[], Step]) -> Step:
        """A failure is in the info: as an exception it would lose its traceback on its way through Gymnasium."""
        step = attempt(work, self._index, self._place)
        return (self._nothing, 0.0, False, False, {"failure": step}) if isinstance(step, Failure) else step

    def _place(self) -> str:
        return where(self._task, self._index, self._steps)

    def _replay(self, history: History) -> Step:
        if self._env is None:
            self._env = self._made()
        observation, _ = self._env.reset(seed=history.seed, options={"episode": history.episode})
        self._ended = False
        step: Step = observation, 0.0, False, False, {}
        for action in history.actions:
            if self._ended:
                raise ValueError(
                    f"episode {history.episode} ended before all of its actions were replayed: it is not deterministic"
                )
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
        if found := self._translation.differences(env.translation):
            raise UserError(
                f"task {self._task}: environment {self._index} is not like the first: {'; '.join(found[:3])}"
            )
        return env

    def shut(self) -> None:
        """Closes the environment as well as it can be closed."""
        env, self._env = self._env, None
        if env is not None:
            attempt(env.close, self._index, self._place)

    def close(self) -> None:
        self.shut()
