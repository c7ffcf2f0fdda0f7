"""Vector environments that the tests of `train` look through, and the environment of which they are made."""

import os
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces as gym
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

COUNT = 3
TROUBLE = {"raise": 0.9, "nan": 0.8}  # what the first number of an action brings about: more than this


class Trip(gymnasium.Env[Any, Any]):
    """An episode of 1 to 7 steps that ends in either way; every number depends on the seed of the reset and on the
    actions."""

    observation_space = gym.Dict(
        {
            "camera": gym.Box(0, 255, (20, 16, 3), np.uint8),
            "place": gym.Dict({"at": gym.Box(-np.inf, np.inf, (2,), np.float32), "room": gym.Discrete(5, start=10)}),
            "pair": gym.Tuple((gym.MultiBinary(3), gym.Box(-1, 1, (), np.float64))),
        }
    )
    action_space = gym.Dict({"gear": gym.Discrete(3), "push": gym.Box(-1, 1, (2,), np.float32)})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._left = int(self.np_random.integers(1, 8))
        self._at = self.np_random.normal(size=2)
        return self._observation(), {"fuel": 1.0}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if action["push"][0] > TROUBLE["raise"]:
            raise ZeroDivisionError("the road ends")
        self._left -= 1
        self._at += action["push"] + action["gear"] + self.np_random.normal(size=2)
        if action["push"][0] > TROUBLE["nan"]:
            self._at[0] = np.nan
        terminated, truncated = [(True, False), (False, True)][int(self.np_random.integers(2))]
        end = self._left == 0
        info = {"fuel": float(self._at[0]), "stats": {"left": self._left}}
        return self._observation(), float(self._at[1]), end and terminated, end and truncated, info

    def _observation(self) -> dict[str, Any]:
        return {
            "camera": self.np_random.integers(0, 256, (20, 16, 3), np.uint8),
            "place": {"at": self._at.astype(np.float32), "room": np.int64(10 + self._left % 5)},
            "pair": (self.np_random.integers(0, 2, 3).astype(np.int8), np.float64(np.tanh(np.nan_to_num(self._at[0])))),
        }


def sync(mode: str, count: int = COUNT) -> SyncVectorEnv:
    return SyncVectorEnv([Trip] * count, autoreset_mode=AutoresetMode(mode))


def asynchronous(mode: str) -> AsyncVectorEnv:
    return AsyncVectorEnv([Trip] * COUNT, autoreset_mode=AutoresetMode(mode), context="forkserver")


def sized(num_envs: int) -> SyncVectorEnv:
    return sync("NextStep", num_envs)


class Narrow(SyncVectorEnv):
    """Does less than Gymnasium's own. seeds: "one" takes a number alone, "array" an array for those of the mask, "some"
    gives the observations of those alone as well. masks: whether it obeys them, or resets all."""

    def __init__(self, mode: str, seeds: str = "one", masks: bool = False) -> None:
        super().__init__([Trip] * COUNT, autoreset_mode=AutoresetMode(mode))
        self._takes, self._masks = seeds, masks

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, bool))
        if self._takes == "one" and not isinstance(seed, int | None):
            raise gymnasium.error.Error(f"Seed must be a python integer, actual type: {type(seed)}")
        if self._takes != "one" and seed is not None:
            if not isinstance(seed, np.ndarray):
                raise TypeError("Unsupported seed type")
            each = np.zeros(self.num_envs, int)
            each[mask] = seed
            seed = each.tolist()
        observation, infos = super().reset(seed=seed, options=options if self._masks else None)
        if self._takes == "some":
            observation = _some(observation, mask)
        return observation, infos


def _some(value: Any, mask: np.ndarray) -> Any:
    if isinstance(value, dict):
        return {key: _some(entry, mask) for key, entry in value.items()}
    return tuple(_some(entry, mask) for entry in value) if isinstance(value, tuple) else value[mask]


def silent() -> SyncVectorEnv:
    """Does not say when it resets."""
    envs = sync("NextStep")
    envs.metadata = {}
    return envs


def short() -> SyncVectorEnv:
    """Returns one reward too few, from its tenth step on."""
    envs = sync("NextStep")
    step, taken = envs.step, []

    def cut(actions: Any) -> Any:
        taken.append(actions)
        observation, reward, *others = step(actions)
        return observation, reward[: COUNT - (len(taken) >= 10)], *others

    envs.step = cut
    return envs


class Leaving(SyncVectorEnv):
    """Ends its process in its fifth step after a reset."""

    def __init__(self) -> None:
        super().__init__([Trip] * COUNT, autoreset_mode=AutoresetMode.SAME_STEP)
        self._taken = 0

    def step(self, actions: Any) -> Any:
        self._taken += 1
        if self._taken == 5:
            os._exit(3)
        return super().step(actions)
