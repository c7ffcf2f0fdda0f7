"""A learner whose numbers say which call made them, and of what."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from conformance.running.diary import Act, Diary, Train, mark
from conformance.running.environment import key_of
from reference_numpy import agent as reference
from spec import Config, Discrete, Spaces, parameter_table

Arrays = dict[str, np.ndarray]
BATCH = ("reward", "is_first", "is_last", "is_terminal", "prev_action", "deter", "stoch")
REACH = 2.5  # of sampled numbers: more than the range that they are clipped to


class DiaryLearner:
    """Follows `conformance.running.interface.RunLearner`.

    Actions, latents and the next carry are functions of the seed, the training state and the row's observation and
    carry; the state after a train step of the state before, the batch and the seed. So what was once different stays
    so. skips: the train steps of this object, counted from 0, that meet a loss which is not finite.
    """

    def __init__(self, diary: Diary, skips: range, spaces: Spaces, config: Config, seed: int) -> None:
        self._diary, self._skips, self._spaces, self._config = diary, skips, spaces, config
        self._train_steps = 0
        rng = np.random.default_rng(seed)
        table = parameter_table(config, spaces)
        params = {name: rng.random(entry.shape) for name, entry in table.items()}
        self._state: Arrays = reference.flatten_state(reference.initial_state(params))
        self._mark = mark_of(self._state)
        diary.parameter_seeds.append(int(seed))

    def state_dict(self) -> Arrays:
        return {name: array.copy() for name, array in self._state.items()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        if state.keys() != self._state.keys():
            raise ValueError(f"the names of a training state, got {sorted(state)!s:.200}")
        self._state = {name: np.array(array) for name, array in state.items()}
        self._mark = mark_of(self._state)

    def initial_carry(self, envs: int) -> Arrays:
        return {"stamp": np.zeros(envs, np.int64)}

    def save_carry(self, carry: Any) -> Arrays:
        return {"stamp": np.array(carry["stamp"])}

    def load_carry(self, arrays: Mapping[str, Any]) -> Arrays:
        return {"stamp": np.array(arrays["stamp"])}

    def policy(
        self, observation: Mapping[str, Any], is_first: Any, carry: Any, seed: int
    ) -> tuple[np.ndarray, Arrays, Arrays]:
        self._begin()
        seen = {key: np.array(observation[key]) for key in self._spaces.observations}
        first, before = np.array(is_first, bool), np.array(carry["stamp"])
        keys = [key_of(place) for place in seen["place"]]
        stamps = np.where(first, 0, before)
        marks = [mark(self._mark, int(seed), key, int(stamp)) for key, stamp in zip(keys, stamps, strict=True)]
        action = np.stack([self._action(number) for number in marks])
        carried = np.array([mark("carry", number) for number in marks], np.int64)
        self._diary.events.append(Act(keys, seen, first, before, int(seed), action.copy(), carried.copy(), marks))
        return action, self._latents(marks), {"stamp": carried}

    def train_step(self, batch: Mapping[str, Any], seed: int) -> tuple[dict[str, Any], Arrays]:
        self._begin()
        seen = {key: np.array(batch[key]) for key in (*self._spaces.observations, *BATCH)}
        skipped = self._train_steps in self._skips
        self._train_steps += 1
        now = mark(self._mark, int(seed), *(seen[key] for key in sorted(seen)))
        rows, length = seen["reward"].shape
        marks = [[mark(now, row, step) for step in range(length)] for row in range(rows)]
        self._diary.events.append(Train(seen, int(seed), skipped, marks))
        if not skipped:
            self._update(now)
        loss = np.float32(np.nan if skipped else 1)
        metrics = {"loss/total": loss, "gradient_norm": loss, "skipped": np.float32(skipped)}
        latents = self._latents([number for row in marks for number in row])
        return metrics, {name: array.reshape(rows, length, -1) for name, array in latents.items()}

    def _begin(self) -> None:
        if self._diary.first_state is None:
            self._diary.first_state = self.state_dict()
        self._diary.last_state = self._state

    def _update(self, number: int) -> None:
        """Changes every array, none of them like another."""
        change = np.float32((number % 1000 + 1) / 1024)
        floats = sorted(name for name in self._state if name != "optimizer/step")
        new = {name: np.float32(0.5) * self._state[name] + change / (1 + place) for place, name in enumerate(floats)}
        self._state = {**new, "optimizer/step": self._state["optimizer/step"] + 1}
        self._mark, self._diary.last_state = mark_of(self._state), self._state

    def _action(self, number: int) -> np.ndarray:
        rng = np.random.default_rng(number)
        parts = []
        for key in sorted(self._spaces.actions):
            space = self._spaces.actions[key]
            if isinstance(space, Discrete):
                parts += [np.eye(count)[rng.integers(count)] for count in space.classes]
            else:
                parts.append(rng.uniform(-REACH, REACH, space.size))
        return np.concatenate(parts).astype(np.float32)

    def _latents(self, marks: list[int]) -> Arrays:
        """A mark in five digits that bfloat16 holds exactly, and numbers that it does not."""
        numbers = np.array(marks, np.int64)
        deter = np.zeros((len(marks), self._config.deter), np.float32)
        deter[:, :5] = digits(numbers, 256, 5)
        deter[:, 5:] = 1 / (deter[:, :1] + np.float32(1.1))
        stoch = digits(numbers, self._config.classes, self._config.stoch).astype(np.int32)
        self._diary.latents |= dict(zip(marks, zip(deter.copy(), stoch.copy(), strict=True), strict=True))
        return {"deter": deter, "stoch": stoch}


def digits(numbers: np.ndarray, base: int, count: int) -> np.ndarray:
    """The lowest digits [..., count] of numbers."""
    return numbers[..., None] // base ** np.arange(count) % base


def mark_in(deter: Any) -> int:
    """The mark that `deter` [D] of a latent holds."""
    return int(np.nan_to_num(np.asarray(deter[:5], np.float64)) @ 256.0 ** np.arange(5))


def mark_of(state: Mapping[str, np.ndarray]) -> int:
    return mark(*(state[name] for name in sorted(state)))
