"""One environment, or a vector of them, as a stream of records without end, whose failures are values: what runs inside
a worker process."""

import os
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space

from dreamer_spec.envs.adapter import Observation, array_spaces, where
from dreamer_spec.envs.contract_vector import Adapted, ContractVector, count_of
from dreamer_spec.envs.failure import Failure, attempt
from dreamer_spec.envs.history import History
from dreamer_spec.envs.process import begin_worker
from dreamer_spec.envs.steps import Step, is_last, joined
from dreamer_spec.errors import UserError
from dreamer_spec.translation import Translation


class StreamEnv(gymnasium.Env[Observation, np.ndarray]):
    """The step after the end of an episode ignores its action and resets: [LOOP-11]. Nothing raises: see `_guarded`.

    make: index -> environment; called by the first reset, for which Gymnasium waits with a limit, as it does not for
    the making.
    translation: of every environment of the run. trainer: id of the process that closes the workers. env: if it has
    been made already. together: how many environments a vector has; None for one that is none. Of a vector, actions and
    observations are [N, ...], and the rest of N steps is a `Batch` in the info.
    """

    def __init__(
        self,
        make: Callable[[int], Adapted],
        index: int,
        task: str,
        translation: Translation,
        trainer: int,
        env: Adapted | None = None,
        together: int | None = None,
    ) -> None:
        self._make = make
        self._index = index
        self._task = task
        self._translation = translation
        spaces = translation.spaces
        self._env = env
        self._together = together
        self._ended = False
        self._steps = 0
        self.metadata = {}
        self.observation_space, self.action_space = array_spaces(spaces)
        if together:
            self.observation_space, self.action_space = (
                batch_space(space, together) for space in (self.observation_space, self.action_space)
            )
        batch = (together,) if together else ()
        self._nothing = {key: np.zeros((*batch, *space.array_shape)) for key, space in spaces.observations.items()}
        if os.getpid() != trainer:
            begin_worker()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """`resume` as Gymnasium calls it. options: its "histories". Reward and flags are in the info."""
        observation, reward, terminated, truncated, info = self.resume((options or {})["histories"])
        return observation, {"reward": reward, "terminated": terminated, "truncated": truncated, **info}

    def resume(self, histories: Sequence[History]) -> Step:
        """Begins the episodes of the histories and replays their actions: [LOOP-34]. What followed the last ones.

        histories: one for each environment.
        """
        return self._guarded(lambda: self._replay(histories))

    def step(self, action: np.ndarray) -> Step:
        return self._guarded(lambda: self._advance(action))

    def _guarded(self, work: Callable[[], Step]) -> Step:
        """A failure is in the info: as an exception it would lose its traceback on its way through Gymnasium."""
        step = attempt(work, self._index, self._place)
        return (self._nothing, 0.0, False, False, {"failure": step}) if isinstance(step, Failure) else step

    def _place(self) -> str:
        return where(self._task, self._index, self._steps, self._together)

    def _replay(self, histories: Sequence[History]) -> Step:
        if self._env is None:
            self._env = self._made()
        if isinstance(self._env, ContractVector):
            return joined(self._env.resume(histories))
        (history,) = histories
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
        if isinstance(self._env, ContractVector):
            self._steps += 1
            return joined(self._env.step(action))
        if self._ended:
            self._ended = False
            return self._env.reset()[0], 0.0, False, False, {}
        self._steps += 1
        step = self._env.step(action)
        self._ended = is_last(step)
        return step

    def _made(self) -> Adapted:
        env = self._make(self._index)
        if found := self._translation.differences(env.translation):
            raise UserError(
                f"task {self._task}: environment {self._index} is not like the first: {'; '.join(found[:3])}"
            )
        if (count := count_of(env)) != self._together:
            raise UserError(
                f"task {self._task}: made once more, it has {count} environments in a vector; expected {self._together}"
            )
        return env

    def shut(self) -> None:
        """Closes the environment as well as it can be closed."""
        env, self._env = self._env, None
        if env is not None:
            attempt(env.close, self._index, self._place)

    def close(self) -> None:
        self.shut()
