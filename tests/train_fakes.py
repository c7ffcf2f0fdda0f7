"""Environments and a learner that the tests of `train` look through: every number that comes out says where it came
from."""

import multiprocessing
import os
import signal
import time
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np
from fake_state import digest, fresh_state, next_state
from gymnasium import spaces as gym

from dreamer_spec.envs import random_actions
from spec import Config, Image, Spaces

EPISODE = 4  # steps of an episode of `Counting`, the reset not counted


class Counting(gymnasium.Env[Any, Any]):
    """Observation [episode, t], reward 10 * episode + t. Episodes 0, 2, ... terminate, the others are truncated.

    A rude environment: it hands out one buffer again and again, and writes into the actions that it is given.
    """

    observation_space = gym.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.Box(np.float32([0, -np.inf]), np.float32([10, np.inf]))

    def __init__(self) -> None:
        self._buffer = np.zeros(2, np.float32)
        self._episode, self._time = -1, 0
        self.actions: list[np.ndarray] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self._episode, self._time = self._episode + 1, 0
        self._buffer[:] = self._episode, 0
        return self._buffer, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.actions.append(action.copy())
        action[:] = -99
        self._time += 1
        self._buffer[:] = self._episode, self._time
        end = self._time == EPISODE
        return (
            self._buffer,
            10.0 * self._episode + self._time,
            end and self._episode % 2 == 0,
            end and self._episode % 2 == 1,
            {},
        )


class Everything(gymnasium.Env[Any, Any]):
    """Every kind of observation and of action. Says what it got in `actions`."""

    observation_space = gym.Dict(
        {
            "camera": gym.Box(0, 255, (20, 30, 3), np.uint8),
            "depth": gym.Box(0, 255, (20, 30), np.uint8),
            "arm": gym.Dict({"angle": gym.Box(-1, 1, (), np.float64), "touch": gym.MultiBinary(3)}),
            "room": gym.Discrete(5, start=10),
            "items": gym.MultiDiscrete([2, 3], start=[1, -1]),
            "matrix": gym.Box(-5, 5, (2, 2), np.int32),
        }
    )
    action_space = gym.Dict(
        {
            "move": gym.Box(np.float32([[0, -2]]), np.float32([[10, 2]])),
            "gear": gym.Discrete(3, start=-1),
            "keys": gym.Dict({"left": gym.MultiDiscrete([2, 4])}),
        }
    )

    def __init__(self) -> None:
        self.actions: list[Any] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        self.actions.append(action)
        return self.observation(), 1.0, False, False, {}

    def observation(self) -> dict[str, Any]:
        return {
            "camera": np.full((20, 30, 3), 7, np.uint8),
            "depth": np.full((20, 30), 9, np.uint8),
            "arm": {"angle": np.float64(0.5), "touch": np.array([1, 0, 1], np.int8)},
            "room": np.int64(12),
            "items": np.array([2, -1]),
            "matrix": np.array([[1, 2], [3, 4]], np.int32),
        }


class Faulty(Counting):
    """`Counting`, until its `at`-th step since it was made returns something wrong."""

    def __init__(self, at: int, **wrong: Any) -> None:
        super().__init__()
        self._steps, self._at, self._wrong = 0, at, wrong

    def step(self, action: np.ndarray) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        self._steps += 1
        if self._steps != self._at:
            return observation, reward, terminated, truncated, info
        if "error" in self._wrong:
            raise self._wrong["error"]
        result = (
            self._wrong.get("observation", observation),
            self._wrong.get("reward", reward),
            terminated,
            truncated,
            info,
        )
        return result[: self._wrong.get("values", 5)]


class Sequences(Counting):
    observation_space = gym.Dict({"words": gym.Sequence(gym.Discrete(3))})


class Endless(Counting):
    def step(self, action: np.ndarray) -> Any:
        return (*super().step(action)[:2], False, False, {})


class Sleepy(Counting):
    """Takes a while for a step, so that its process can be killed in the middle of it."""

    def step(self, action: np.ndarray) -> Any:
        time.sleep(0.5)
        return super().step(action)


def nan_observation() -> gymnasium.Env[Any, Any]:
    return Faulty(7, observation=np.array([0, np.nan], np.float32))


def wrong_dtype() -> gymnasium.Env[Any, Any]:
    return Faulty(3, observation=np.array(["a", "b"]))


def wrong_shape() -> gymnasium.Env[Any, Any]:
    return Faulty(3, observation=np.zeros(3, np.float32))


class FakeLearner:
    """Obeys dreamer_spec/backend.py in NumPy: random actions, latents that say which call made them, a training state
    of which nothing may be lost (`fake_state.py`), and a diary of what it was given."""

    diary: ClassVar[list[tuple[str, Any]]] = []
    seeds: ClassVar[list[tuple[str, int]]] = []
    loss: ClassVar[float] = 1.0

    def __init__(
        self,
        spaces: Spaces,
        config: Config,
        *,
        seed: int,
        device: str | None = None,
        nonfinite: str = "stop",
        threads: int | None = None,
    ) -> None:
        if device not in (None, "cpu"):
            raise ValueError(f"no device {device!r}; available: cpu")
        self.device = "cpu"
        self._spaces, self._config = spaces, config
        self._state = fresh_state()
        self.seeds.append(("parameters", seed))

    def initial_carry(self, envs: int) -> Any:
        return np.zeros(envs, int)

    def save_carry(self, carry: Any) -> dict[str, np.ndarray]:
        return {"steps": carry}

    def load_carry(self, arrays: Mapping[str, np.ndarray]) -> Any:
        return arrays["steps"]

    def memory(self) -> int | None:
        return None

    def policy(
        self, observation: Mapping[str, np.ndarray], is_first: np.ndarray, carry: Any, seed: int, mode: bool = False
    ) -> tuple[np.ndarray, dict[str, np.ndarray], Any]:
        """deter[0] counts the policy steps since the last reset of the row, deter[1] is the seed, deter[2] tells one
        training state from another."""
        assert set(observation) == set(self._spaces.observations)
        action = 3 * random_actions(self._spaces, np.random.default_rng(seed), len(is_first))
        carry = np.where(is_first, 0, carry + 1)
        deter = np.zeros((len(is_first), self._config.deter), np.float32)
        deter[:, 0], deter[:, 1], deter[:, 2] = carry, seed, digest(self._state)
        self.seeds.append(("policy", seed))
        self.diary.append(("policy", {key: value.copy() for key, value in observation.items()}))
        return action, {"deter": deter, "stoch": np.zeros((len(is_first), self._config.stoch), np.int32)}, carry

    def train_step(self, batch: Mapping[str, np.ndarray], seed: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """The latents that are to be written back are 1000 + the number of the update."""
        assert set(batch) == {
            *self._spaces.observations,
            "reward",
            "is_first",
            "is_last",
            "is_terminal",
            "prev_action",
            "deter",
            "stoch",
        }
        if np.isfinite(self.loss):
            self._state = next_state(self._state, batch, seed)
        self.seeds.append(("train", seed))
        self.diary.append(("train", {key: value.copy() for key, value in batch.items()}))
        shape = (self._config.batch_size, self._config.batch_length)
        deter = np.full((*shape, self._config.deter), 1000 + self._state["optimizer/step"], np.float32)
        return {"loss/total": np.float32(self.loss), "skipped": np.float32(not np.isfinite(self.loss))}, {
            "deter": deter,
            "stoch": np.ones((*shape, self._config.stoch), np.int32),
        }

    def predict(
        self,
        observation: Mapping[str, np.ndarray],
        prev_action: np.ndarray,
        is_first: np.ndarray,
        context: int,
        seed: int,
    ) -> dict[str, np.ndarray]:
        """The reward that is predicted is the number of the step; everything else is 0.5."""
        self.seeds.append(("predict", seed))
        self.diary.append(("predict", {**observation, "prev_action": prev_action, "is_first": is_first}))
        sizes = {
            key: space.array_shape if isinstance(space, Image) else (space.encoded_size,)
            for key, space in self._spaces.observations.items()
        }
        halves = {key: np.full((*is_first.shape, *size), 0.5, np.float32) for key, size in sizes.items()}
        return {
            **halves,
            "continue_": np.full(is_first.shape, 0.5),
            "reward": np.broadcast_to(np.arange(is_first.shape[1]), is_first.shape),
        }

    def gradients(self, batch: Mapping[str, np.ndarray], seed: int) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        return {"loss/total": self.loss}, {"w": np.full((3, 2), self.loss, np.float32)}

    def state_dict(self) -> dict[str, np.ndarray]:
        return {name: array.copy(order="K") for name, array in self._state.items()}

    def load_state_dict(self, state: Mapping[str, np.ndarray]) -> None:
        if set(state) != set(self._state):
            raise ValueError(f"unexpected names {sorted(state)}")
        self._state = {name: np.array(array) for name, array in state.items()}


class Fragile(Counting):
    """`Counting` whose second observation is random.

    What the first number of an action has above 5 is the seconds that it takes. If the second is a key of TROUBLES, it
    gives that trouble.
    """

    TROUBLES: ClassVar[dict[float, str]] = {0.25: "error", 0.5: "invalid data", 0.75: "timeout", 1.0: "crash"}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        observation, info = super().reset(seed=seed)
        observation[1] = self.np_random.random()
        return observation, info

    def step(self, action: np.ndarray) -> Any:
        time.sleep(max(0.0, float(action[0]) - 5.0))
        trouble = self.TROUBLES.get(float(action[1]))
        observation, reward, terminated, truncated, info = super().step(action)
        observation[1] = self.np_random.random()
        if trouble == "error":
            raise ZeroDivisionError("inside\nthe environment")
        if trouble == "invalid data":
            reward = np.nan
        if trouble == "timeout":
            time.sleep(60)
        if trouble == "crash":
            os.kill(os.getpid(), signal.SIGKILL)
        return observation, reward, terminated, truncated, info


class Clinging(Counting):
    """Hangs when it is closed in a worker process."""

    def close(self) -> None:
        if multiprocessing.parent_process():
            time.sleep(60)


class Maze(gymnasium.Env[Any, Any]):
    """Dict spaces, and chance in everything. An episode terminates by chance, or is truncated after 12 steps."""

    observation_space = gym.Dict(
        {
            "view": gym.Box(0, 255, (16, 20, 3), np.uint8),
            "body": gym.Dict({"place": gym.Discrete(7), "speed": gym.Box(-np.inf, np.inf, (2,), np.float64)}),
        }
    )
    action_space = gym.Dict({"turn": gym.Discrete(3), "push": gym.Box(-2, 2, (2,), np.float32)})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._time, self._place, self._speed = 0, int(self.np_random.integers(7)), self.np_random.normal(size=2)
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._time += 1
        self._place = (self._place + int(action["turn"])) % 7
        self._speed += action["push"] + self.np_random.normal(size=2)
        return self._observation(), float(self._speed.sum()), self.np_random.random() < 0.05, self._time == 12, {}

    def _observation(self) -> dict[str, Any]:
        view = self.np_random.integers(0, 256, (16, 20, 3), np.uint8)
        return {"view": view, "body": {"place": np.int64(self._place), "speed": self._speed}}


class Unrepeatable(Counting):
    """No two episodes are the same, whatever their seeds."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        observation, info = super().reset(seed=seed)
        observation[1] = time.perf_counter() % 1
        return observation, info


class Shrinking(Counting):
    """Its first episodes are shorter in every environment that is made."""

    made: ClassVar[int] = 0

    def __init__(self) -> None:
        super().__init__()
        type(self).made += 1

    def step(self, action: np.ndarray) -> Any:
        observation, reward, *_ = super().step(action)
        return observation, reward, self._time >= 10 - self.made, False, {}


class Enormous(Counting):
    """More classes than any machine can hold one-hot."""

    observation_space = gym.Discrete(2**62)


class EnormousActions(Counting):
    action_space = gym.MultiDiscrete([2, 2**40])
