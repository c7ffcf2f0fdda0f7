"""One environment as the contract wants it: a Gymnasium environment with arrays in, arrays out, and everything that comes in checked."""

import math
import traceback
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces as gym

from spec import Discrete, Image, Spaces, Vector
from train.envs.spaces import translate
from train.errors import UserError

Observation = dict[str, np.ndarray]

FLOAT32_MAX = float(np.finfo(np.float32).max)


class ContractEnv(gymnasium.Env[Observation, np.ndarray]):
    """Wraps an environment: observations become arrays of `spec.Spaces`, flat actions become the environment's, actions are repeated.

    env: the environment. task, index: its name and number, for messages. image_size: side of every image, in pixels. action_repeat: how
    often each action is applied; the rewards are summed, and the repetition stops where the episode ends.

    Raises:
      UserError: an unsupported space; from `reset` and `step`: whatever the environment returns that its spaces do not allow, NaN included.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], task: str, index: int = 0, image_size: int = 64, action_repeat: int = 1) -> None:
        self._env = env
        self._name = f"task {task}, environment {index}"
        self._steps = 0
        self._action_repeat = action_repeat
        try:
            self._translation = translate(env.observation_space, env.action_space, image_size)
        except UserError as error:
            raise UserError(f"task {task}: {error}") from error
        self.spaces: Spaces = self._translation.spaces
        self.metadata = {}
        self.observation_space: gym.Space[Any] = gym.Dict({key: _array_space(space) for key, space in self.spaces.observations.items()})
        self.action_space = gym.Box(-np.inf, np.inf, (self.spaces.action_size,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        value = self._call(self._env.reset, seed=seed)
        if not isinstance(value, tuple) or len(value) != 2:
            raise self._error(f"reset returned {_describe(value)}; Gymnasium's reset returns (observation, info)")
        return self._observation(value[0]), {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        total = 0.0
        for _ in range(self._action_repeat):
            self._steps += 1
            value = self._call(self._env.step, self._translation.action(action))  # Made anew: an environment may write into it.
            if not isinstance(value, tuple) or len(value) != 5:
                raise self._error(
                    f"step returned {_describe(value)}; Gymnasium's step returns (observation, reward, terminated, truncated, info)"
                )
            observation, reward, terminated, truncated, _info = value
            total += self._reward(reward)
            if terminated or truncated:
                break
        if abs(total) > FLOAT32_MAX:
            raise self._error(f"the rewards of {self._action_repeat} repeated actions add up to {total}, more than float32 can hold")
        return self._observation(observation), total, bool(terminated), bool(truncated), {}

    def close(self) -> None:
        self._env.close()

    def _observation(self, value: Any) -> Observation:
        try:
            return self._translation.observation(value)
        except UserError as error:
            raise self._error(str(error)) from error

    def _reward(self, value: Any) -> float:
        array = np.asarray(value)
        if array.size != 1 or array.dtype.kind not in "fiub":
            raise self._error(f"the reward is {_describe(value)}; expected one number")
        reward = float(array.reshape(()))
        if not math.isfinite(reward) or abs(reward) > FLOAT32_MAX:
            raise self._error(f"the reward is {reward}; expected a finite number")
        return reward

    def _call(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Errors of the environment's own code keep their traceback as text: it would be lost on the way from a worker process."""
        try:
            return function(*args, **kwargs)
        except Exception as error:
            where = f"{self._name}, step {self._steps}"
            raise RuntimeError(f"{where}: the environment raised {type(error).__name__}: {error}\n{traceback.format_exc()}") from error

    def _error(self, message: str) -> UserError:
        return UserError(f"{self._name}, step {self._steps}: {message}")


def _array_space(space: Vector | Discrete | Image) -> gym.Space[Any]:
    if isinstance(space, Vector):
        return gym.Box(-np.inf, np.inf, space.array_shape, np.float32)
    if isinstance(space, Image):
        return gym.Box(0, 255, space.array_shape, np.uint8)
    return gym.MultiDiscrete(list(space.classes))


def _describe(value: Any) -> str:
    if isinstance(value, tuple):
        return f"{len(value)} values"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape} and dtype {value.dtype}"
    return f"{value!r}"[:80]
