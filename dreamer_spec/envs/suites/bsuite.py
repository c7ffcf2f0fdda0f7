"""BSuite as Gymnasium environments: `bsuite:catch/0` is configuration 0 of the experiment catch, `bsuite:catch` too.

Not through the package's own wrapper, which needs the Gym of before Gymnasium.
"""

import importlib
import inspect
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces as gym

from dreamer_spec.envs.suites import Play
from dreamer_spec.errors import UserError

MNIST = ("train-images-idx3-ubyte", "train-labels-idx1-ubyte", "t10k-images-idx3-ubyte", "t10k-labels-idx1-ubyte")
NO_SUM = "best_episode"  # the one number of `bsuite_info` that is not a sum over episodes; made of raw_return


def make(play: Play) -> gymnasium.Env[Any, Any]:
    """A configuration EXPERIMENT/NUMBER of the package's sweep; number 0 for EXPERIMENT alone.

    Raises:
      UserError: no such configuration, or the files of MNIST are missing.
    """
    package = importlib.import_module("bsuite")
    configurations = importlib.import_module("bsuite.sweep").SETTINGS
    experiment, separator, _ = play.name.partition("/")
    name = play.name if separator else f"{experiment}/0"
    if name not in configurations:
        numbers = [known.partition("/")[2] for known in configurations if known.partition("/")[0] == experiment]
        known = sorted({known.partition("/")[0] for known in configurations})
        remedy = f"its numbers are 0 to {len(numbers) - 1}" if numbers else f"known: {', '.join(known)}"
        raise UserError(f"unknown task {play.task!r}; {remedy}")
    if experiment.startswith("mnist"):
        _require_mnist(play.task)
    return BsuiteEnv(package.load(experiment, configurations[name]), int(name.partition("/")[2]))


def _require_mnist(task: str) -> None:
    """The package would download what is missing while a run begins."""
    loader = importlib.import_module("bsuite.utils.datasets").load_mnist
    folder = Path(inspect.signature(loader).parameters["directory"].default)
    missing = [f"{name}.gz" for name in MNIST if not (folder / f"{name}.gz").is_file()]
    if missing:
        raise UserError(
            f"task {task}: {folder}, where the package bsuite looks for MNIST, lacks {', '.join(missing)}; put the "
            f"four files of MNIST there, gzipped, under these names"
        )


class BsuiteEnv(gymnasium.Env[np.ndarray, Any]):
    """An environment of the package. Observations are one vector; an end with discount 0 is terminal ([D-111]).

    What a configuration is (which arm pays, what an action means in which square) was drawn when it was made. What its
    episodes draw, the noise of rewards included, comes from the seeds of the resets: [LOOP-33]. number: of the
    configuration. It enters too: many are equal but for a seed that the package leaves open.

    The last step's info has, under "bsuite", what the package counts for its scores, for this episode alone.
    """

    def __init__(self, env: Any, number: int) -> None:
        self._env, self._number = env, number
        self._before: Mapping[str, float] = {}
        size = int(np.prod(env.observation_spec().shape))
        self.observation_space = gym.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = gym.Discrete(env.action_spec().num_values)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        if seed is not None:
            reseed(self._env, [seed, self._number])
        step = self._env.reset()
        self._before = self._env.bsuite_info()
        return _flat(step.observation), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        step = self._env.step(action)
        info = {"bsuite": difference(self._before, self._env.bsuite_info())} if step.last() else {}
        terminated, truncated = step.last() and step.discount == 0, step.last() and step.discount != 0
        return _flat(step.observation), step.reward, terminated, truncated, info

    def close(self) -> None:
        self._env.close()


def reseed(env: Any, seed: Sequence[int]) -> None:
    """Each layer of an environment, that of the rewards' noise or scale and the game itself, goes on from a seed of its
    own. `_rng` is what episodes draw from; what a configuration was drawn from has other names, or is not asked
    again."""
    layers = list(_layers(env))
    for layer, state in zip(layers, np.random.SeedSequence(seed).generate_state(len(layers)), strict=True):
        if "_rng" in vars(layer):
            layer._rng.seed(int(state))


def _layers(env: Any) -> Iterator[Any]:
    while env is not None:
        yield env
        env = vars(env).get("_env")


def difference(before: Mapping[str, float], after: Mapping[str, float]) -> dict[str, float]:
    """What an episode added to the numbers that the package sums over episodes."""
    return {name: float(value - before[name]) for name, value in after.items() if name != NO_SUM}


def _flat(observation: Any) -> np.ndarray:
    return np.array(observation, np.float32).reshape(-1)
