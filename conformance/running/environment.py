"""An environment whose observations say which episode they belong to and what led to them."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from conformance.running.diary import Diary, Frame, Key, mark
from spec import Discrete, Spaces, Vector

SPACES = Spaces(
    {"place": Vector(6), "clock": Discrete((4,))}, {"jump": Discrete((3,)), "steer": Vector(2), "turn": Vector(1)}
)
LOW = {"steer": np.array([0, -2], np.float32), "turn": np.array([-np.inf], np.float32)}
HIGH = {"steer": np.array([10, 2], np.float32), "turn": np.array([np.inf], np.float32)}
LONGEST = 7  # frames of an episode, the reset not counted
DIGIT = 2**12  # of a seed; float32 holds each exactly


class Broken(Exception):
    """What an environment raises that fails."""


@dataclasses.dataclass(frozen=True)
class World:
    """What environments do beside counting.

    longest: frames of the longest episodes, the reset not counted. repeatable: whether an episode is a function of its
    seed and its actions. fails: (number of an environment, in the order of their first resets; its frame that raises).
    scribbles: whether they write into the actions that they are given, as some do.
    """

    longest: int = LONGEST
    repeatable: bool = True
    fails: tuple[int, int] | None = None
    scribbles: bool = False


class CountingEnvironment:
    """Follows `conformance.running.interface.RunEnvironment`, and writes all into a diary.

    Length and kind of the end of an episode depend on its seed. Rewards are quarters, so that their sums are exact.
    Like many environments it hands out the same arrays again and again.
    """

    spaces, low, high = SPACES, LOW, HIGH

    def __init__(self, diary: Diary, world: World, nonce: Callable[[], int]) -> None:
        self._diary, self._world, self._nonce = diary, world, nonce
        self._number = -1
        self._steps = 0
        self._over = True
        self._observation: dict[str, np.ndarray] = {"place": np.zeros(6, np.float32), "clock": np.zeros(1, np.int64)}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Mapping[str, np.ndarray], dict[str, Any]]:
        if self._number < 0:
            self._number = self._diary.environments
            self._diary.environments += 1
        # Without a seed of the loop episodes are told apart by numbers that no seed has.
        self._seed = 2**32 + len(self._diary.events) if seed is None else int(seed)
        self._time, self._over = 0, False
        self._state = mark("reset", self._seed, 0 if self._world.repeatable else self._nonce())
        self._write(seed, None, 0.0, False, False)
        return self._observation, {}

    def step(self, action: Mapping[str, Any]) -> tuple[Mapping[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        given = {key: np.array(value, np.float64).reshape(-1) for key, value in action.items()}
        if self._world.scribbles:
            for value in (value for value in action.values() if np.ndim(value)):
                value[...] = 1
        self._steps += 1
        if self._world.fails == (self._number, self._steps):
            self._diary.failed.append(self._number)
            raise Broken("the environment of the kit fails, as it was asked to")
        self._time += 1
        self._state = mark(self._state, *(given[key] for key in sorted(given)))
        end = self._time > self._seed % self._world.longest
        kind = self._seed // self._world.longest % 3  # 0 terminated, 1 truncated, 2 both at once
        reward = (self._state % 64 - 32) / 4
        self._write(None, given, reward, end and kind != 1, end and kind != 0)
        return self._observation, reward, end and kind != 1, end and kind != 0, {}

    def close(self) -> None:
        pass

    def _write(
        self,
        seed: int | None,
        action: Mapping[str, np.ndarray] | None,
        reward: float,
        terminated: bool,
        truncated: bool,
    ) -> None:
        seed_digits = (self._seed % DIGIT, self._seed // DIGIT % DIGIT, self._seed // DIGIT**2)
        self._observation["place"][:] = *seed_digits, self._time, self._state % DIGIT, self._state // DIGIT % DIGIT
        self._observation["clock"][:] = self._time % 4
        copies = {key: value.copy() for key, value in self._observation.items()}
        key = key_of(self._observation["place"])
        frame = Frame(
            self._number, key, copies, seed, action, reward, terminated, truncated, bool(action) and self._over
        )
        self._diary.events.append(frame)
        self._over = terminated or truncated


def key_of(place: Any) -> Key:
    """What the observation `place` [6] is recognized by."""
    return tuple(int(number) for number in np.asarray(place))
