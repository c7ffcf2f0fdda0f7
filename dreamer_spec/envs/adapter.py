"""One environment as the contract wants it: a Gymnasium environment with arrays in, arrays out, and everything that
comes in checked."""

import math
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces as gym

from dreamer_spec.envs.frames import frame_skip
from dreamer_spec.envs.info import EpisodeInfo, chosen
from dreamer_spec.envs.spaces import translate
from dreamer_spec.errors import UserError
from dreamer_spec.words import counted
from reference_numpy.training_loop import derive_seed
from spec import Discrete, Image, Spaces, Vector

Observation = dict[str, np.ndarray]

FLOAT32_MAX = float(np.finfo(np.float32).max)


class InvalidData(UserError):
    """An environment returned what its spaces, or Gymnasium's interface, do not allow: [LOOP-31]."""


class ContractEnv(gymnasium.Env[Observation, np.ndarray]):
    """Wraps an environment: observations become arrays of `spec.Spaces`, flat actions become the environment's, actions
    are repeated.

    env: the environment. task, index: its name and number, for messages. image_size: side of every image, in pixels.
    action_repeat: how often each action is applied; the rewards are summed, and the repetition stops where the episode
    ends. info_metrics: names in the info of an episode's last step that `step` returns under "metrics", see
    `info.chosen`. observations, leave_out: which keys, or patterns of keys, to use and not to use; all where
    `observations` is empty.

    Raises:
      UserError: an unsupported space.
      InvalidData: from `reset` and `step`, whatever the environment returns that its spaces do not allow, NaN included.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        task: str,
        index: int = 0,
        image_size: int = 64,
        action_repeat: int = 1,
        info_metrics: Sequence[str] = (),
        observations: Sequence[str] = (),
        leave_out: Sequence[str] = (),
    ) -> None:
        self.task = task
        self._env = env
        self._index = index
        self._steps = 0
        self._action_repeat = action_repeat
        self._info_metrics = info_metrics
        self._seed: int | None = None
        self._episode = 0
        try:
            self.translation = translate(env.observation_space, env.action_space, image_size, observations, leave_out)
        except UserError as error:
            raise UserError(f"task {task}: {error}") from error
        self.spaces: Spaces = self.translation.spaces
        self.frame_skip = frame_skip(env)
        self.metadata = {}
        self.render_mode = env.render_mode
        self.observation_space, self.action_space = array_spaces(self.spaces)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode. Each is a function of its seed and its actions, as far as the environment is
        deterministic: [LOOP-33].

        seed: of all episodes from here on; begins with their episode 0, or with {"episode": n} as options with their
        episode n. Without a seed the next episode begins.
        """
        if seed is None:
            self._episode += 1
        else:
            self._seed, self._episode = seed, (options or {}).get("episode", 0)
        value = self._env.reset(seed=None if self._seed is None else derive_seed(self._seed, "episode", self._episode))
        if not isinstance(value, tuple) or len(value) != 2:
            raise self._invalid(f"reset returned {_describe(value)}; Gymnasium's reset returns (observation, info)")
        return self._observation(value[0]), {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        self._steps += 1
        total = 0.0
        for _ in range(self._action_repeat):
            value = self._act(action)
            if not isinstance(value, tuple) or len(value) != 5:
                raise self._invalid(
                    f"step returned {_describe(value)}; Gymnasium's step returns (observation, reward, "
                    f"terminated, truncated, info)"
                )
            observation, reward, _, _, info = value
            total += self._reward(reward)
            terminated, truncated = self._flag("terminated", value[2]), self._flag("truncated", value[3])
            if terminated or truncated:
                break
        if abs(total) > FLOAT32_MAX:
            raise self._invalid(
                f"the rewards of {self._action_repeat} repeated actions add up to {total}, more than float32 can hold"
            )
        extra = {"metrics": self._metrics(info)} if self._info_metrics and (terminated or truncated) else {}
        return self._observation(observation), total, terminated, truncated, extra

    def render(self) -> Any:
        """What the environment shows, in its `render_mode`."""
        return self._env.render()

    def frames_per_second(self, usual: float) -> float:
        """How many steps of this adapter are a second of the environment's time; `usual` where the environment does not
        say."""
        fps = self._env.metadata.get("render_fps") or usual
        return float(fps) / self._action_repeat

    def close(self) -> None:
        self._env.close()

    def _act(self, action: np.ndarray) -> Any:
        return self._env.step(self.translation.action(action))  # A new one: an environment may write into it.

    def _observation(self, value: Any) -> Observation:
        try:
            return self.translation.observation(value)
        except ValueError as error:
            raise self._invalid(str(error)) from error

    def _metrics(self, info: Any) -> EpisodeInfo:
        try:
            return chosen(info, self._info_metrics)
        except UserError as error:
            raise self._invalid(str(error)) from error

    def _reward(self, value: Any) -> float:
        array = np.asarray(value)
        if array.size != 1 or array.dtype.kind not in "fiub":
            raise self._invalid(f"the reward is {_describe(value)}; expected one number")
        reward = float(array.reshape(()))
        if not math.isfinite(reward) or abs(reward) > FLOAT32_MAX:
            raise self._invalid(f"the reward is {reward}; expected a finite number")
        return reward

    def _flag(self, name: str, value: Any) -> bool:
        """Python finds a truth in everything: a NaN or the text "False" would end the episode. [LOOP-47]"""
        array = np.asarray(value)
        if array.size != 1 or array.dtype.kind not in "biu" or array.item() not in (0, 1):
            raise self._invalid(f"{name} is {f'{value!r}'[:80]}; expected True or False")
        return bool(array.item())

    def _invalid(self, message: str) -> InvalidData:
        return InvalidData(f"{where(self.task, self._index, self._steps)}: {message}")


def where(task: str, index: int, steps: int, together: int | None = None) -> str:
    """The place of an error: in which environment, or vector of so many, at which of its steps since it was made,
    resets not counted."""
    which = f"vector of {counted(together, 'environment')}" if together else f"environment {index}"
    return f"task {task}, {which}, step {steps}"


def array_spaces(spaces: Spaces) -> tuple[gym.Space[Any], gym.Space[Any]]:
    """The spaces of the adapted observations and of flat actions, as Gymnasium says them."""
    observations = gym.Dict({key: _array_space(space) for key, space in spaces.observations.items()})
    return observations, gym.Box(-np.inf, np.inf, (spaces.action_size,), np.float32)


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
