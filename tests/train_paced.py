"""Workers whose episodes have lengths of their own, and a learner that writes down what it is given, row by row: what
belongs to another worker, another step or another episode does not pass for the right one."""

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy as np
import pytest
from fake_state import digest
from gymnasium import spaces as gym
from train_fakes import FakeLearner
from train_runs import Make

from dreamer_spec.envs import ContractEnv
from dreamer_spec.options import Options
from dreamer_spec.training import loop, setup
from reference_numpy.training_loop import derive_seed

LENGTHS = (3, 4, 5)  # records of an episode of each worker: ends come one by one, in pairs, and after 60 all together
WORKERS = len(LENGTHS)


class Paced(gymnasium.Env[Any, Any]):
    """Observation [worker, code of the episode, time, the action that led here], reward code + time / 8.

    An episode is a function of its seed and its actions. Episodes with an even code terminate, the others are
    truncated. fails: worker -> how many steps after it was made it raises, once.
    """

    fails: ClassVar[dict[int, int]] = {}

    observation_space = gym.Box(-np.inf, np.inf, (5,), np.float32)
    action_space = gym.Box(-np.inf, np.inf, (2,), np.float32)

    def __init__(self, worker: int) -> None:
        self._worker, self._steps = worker, 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        assert seed is not None
        self._code, self._time = code(seed), 0
        return np.float32([self._worker, self._code, 0, 0, 0]), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self._steps += 1
        if self.fails.get(self._worker) == self._steps:
            self.fails.clear()
            raise RuntimeError("it broke")
        self._time += 1
        end, even = self._time == LENGTHS[self._worker] - 1, self._code % 2 == 0
        observation = np.float32([self._worker, self._code, self._time, *action])
        return observation, reward(self._code, self._time), end and even, end and not even, {}


def code(episode_seed: int) -> int:
    """A number that float32 holds exactly."""
    return episode_seed % 10007


def reward(episode: int, time: int) -> float:
    return episode + time / 8


class Moment(NamedTuple):
    """Where a worker is in one of its records."""

    code: int
    time: int


def moments(worker: int, seed: int, failed: int | None = None) -> Iterator[Moment]:
    """What follows for a worker from its seed: [LOOP-26]. failed: the record that is missing because the environment
    failed."""
    record = episode = time = 0
    while True:
        if record == failed:
            seed, episode, time = derive_seed(seed, "restart", 0), 0, 0
        yield Moment(code(derive_seed(seed, "episode", episode)), time)
        record, time = record + 1, time + 1
        if time == LENGTHS[worker]:
            episode, time = episode + 1, 0


class Call(NamedTuple):
    """One policy step. carry: as it was given, before any row was reset; [N, D], as what came out, `deter`."""

    observation: np.ndarray
    is_first: np.ndarray
    carry: np.ndarray
    seed: int
    mode: bool
    action: np.ndarray
    deter: np.ndarray


class Recorder(FakeLearner):
    """Carry and `deter` are [steps since the reset of the row, what it observed (5), what it did (2)]. An action
    depends on the parameters, and its second number says how many updates had been made."""

    calls: ClassVar[list[Call]] = []

    def initial_carry(self, envs: int) -> Any:
        return np.zeros((envs, self._config.deter), np.float32)

    def policy(
        self, observation: Mapping[str, np.ndarray], is_first: np.ndarray, carry: Any, seed: int, mode: bool = False
    ) -> tuple[np.ndarray, dict[str, np.ndarray], Any]:
        action, latents, _ = super().policy(observation, is_first, np.zeros(len(is_first), int), seed, mode)
        action[:, 0] += digest({"w": self._state["params/w"]})
        action[:, 1] = self._state["optimizer/step"]
        steps = np.where(is_first, 0, carry[:, 0] + 1)
        deter = np.concatenate([steps[:, None], observation["observation"], action], 1).astype(np.float32)
        given = (observation["observation"], is_first, carry)
        self.calls.append(Call(*(np.array(array) for array in given), seed, mode, np.array(action), deter.copy()))
        return action, {**latents, "deter": deter.copy()}, deter

    def train_step(self, batch: Mapping[str, np.ndarray], seed: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """The latents are [1000 + the number of the update, what was observed (5), the action before (2)], and a metric
        is the number of the update."""
        metrics, latents = super().train_step(batch, seed)
        metrics["update"] = float(self._state["optimizer/step"])
        latents["deter"][..., 1:] = np.concatenate([batch["observation"], batch["prev_action"]], -1)
        return metrics, latents


@pytest.fixture
def paced(make: Make, monkeypatch: pytest.MonkeyPatch) -> Make:
    """Options of a run with these workers."""

    def env_maker(options: Options) -> Any:
        return lambda index: ContractEnv(Paced(index), "paced", index, action_repeat=options.action_repeat)

    monkeypatch.setattr(setup, "env_maker", env_maker)
    monkeypatch.setattr(Recorder, "calls", [])
    monkeypatch.setattr(Paced, "fails", {})
    return lambda **given: make(**{"task": "paced:Paced", "envs": WORKERS, "processes": "no", **given})


def stop_after(monkeypatch: pytest.MonkeyPatch, *policy_steps: int) -> None:
    """Interrupts the run after each of these policy steps, once."""
    act, left = loop.act, list(policy_steps)

    def act_and_stop(run: Any, wait: bool = False) -> None:
        act(run, wait)
        if run.counters.policy_steps in left:
            left.remove(run.counters.policy_steps)
            run.signals.append(2)

    monkeypatch.setattr(loop, "act", act_and_stop)
