"""Episodes that are played but not learned from: evaluation of the agent, and what a random policy gets."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from dreamer_spec.backend import Learner
from dreamer_spec.envs import Environments, Failure, Record, random_actions
from dreamer_spec.errors import UserError
from reference_numpy.training_loop import derive_seed

LONGEST_EPISODE = 108_000  # records

Act = Callable[[Record], np.ndarray]


class Episode(NamedTuple):
    """score: the sum of the rewards, undiscounted. length: in records, the reset's included. info: what --info-metrics
    has chosen."""

    score: float
    length: int
    info: Mapping[str, float]


class Interrupted(Exception):
    """Somebody asked the run to end."""


def play(envs: Environments, act: Act, episodes: int, seeds: list[int]) -> list[float]:
    """The returns of `episodes` whole episodes, as `play_episodes` plays them."""
    return [episode.score for episode in play_episodes(envs, act, episodes, seeds)]


def play_episodes(
    envs: Environments, act: Act, episodes: int, seeds: list[int], interrupted: Callable[[], bool] = lambda: False
) -> list[Episode]:
    """Scores and lengths of `episodes` whole episodes: [LOOP-20].

    Each environment plays its share. The first `episodes` to end, wherever they do, would be the short ones. An
    abandoned episode has no return; another is played in its place.

    Raises:
      UserError: an episode that does not end.
      Interrupted: `interrupted` says so.
    """
    share = np.full(envs.count, episodes // envs.count) + (np.arange(envs.count) < episodes % envs.count)
    played: list[list[Episode]] = [[] for _ in range(envs.count)]
    total, length = np.zeros(envs.count), np.zeros(envs.count, int)
    record = envs.reset(seeds)
    while True:
        total = np.where(record["is_first"], 0.0, total) + record["reward"]
        length = np.where(record["is_first"], 0, length) + 1
        for worker in np.flatnonzero(record["is_last"]):
            if len(played[worker]) < share[worker]:
                played[worker].append(Episode(float(total[worker]), int(length[worker]), envs.info[worker]))
        unfinished = [len(ended) < wanted for ended, wanted in zip(played, share, strict=True)]
        if not any(unfinished):
            return [episode for ended in played for episode in ended]
        if interrupted():
            raise Interrupted
        if length[unfinished].max() > LONGEST_EPISODE:
            raise UserError(
                f"an episode did not end within {LONGEST_EPISODE:,} steps, so it has no return; give the "
                f"environment a time limit "
                "(gymnasium.wrappers.TimeLimit), or --eval-episodes 0 --random-episodes 0"
            )
        record = envs.step(act(record))


def report_failures(envs: Environments, say: Callable[[str], None]) -> None:
    """Says which environments failed since the last call."""
    for failure in envs.take_failures():
        report_failure(failure, say)


def report_failure(failure: Failure, say: Callable[[str], None]) -> None:
    say(f"{failure.who} failed and was restarted ({failure.kind}): {failure.message}")


class Agent:
    """Acts as the learner does, with a carry of its own that starts at zero.

    seed: of the run. step: policy steps of all its evaluations so far. mode: takes the mode of the actor, not a sample:
    [LOOP-71].
    """

    def __init__(self, learner: Learner, envs: Environments, seed: int, step: int, mode: bool = False) -> None:
        self.step = step
        self._seed = seed
        self._policy = functools.partial(learner.policy, mode=True) if mode else learner.policy
        self._carry: Any = learner.initial_carry(envs.count)
        self._keys = list(envs.spaces.observations)

    def __call__(self, record: Record) -> np.ndarray:
        observation = {key: record[key] for key in self._keys}
        seed = derive_seed(self._seed, "evaluation", self.step)
        action, _, self._carry = self._policy(observation, record["is_first"], self._carry, seed)
        self.step += 1
        return np.asarray(action)


def evaluate(
    act: Act, envs: Environments, episodes: int, seed: int, earlier: int, interrupted: Callable[[], bool]
) -> list[Episode]:
    """Episodes of the agent as it is now, sampling its actions: [LOOP-18], [LOOP-19]. earlier: evaluations of this run
    before.

    Raises:
      Interrupted: `interrupted` says so.
    """
    seeds = [derive_seed(seed, "evaluation_environment", worker + envs.count * earlier) for worker in range(envs.count)]
    return play_episodes(envs, act, episodes, seeds, interrupted)


def play_randomly(envs: Environments, episodes: int, seed: int) -> list[float]:
    """Returns of the policy that ignores what it sees: every choice and every real number in [-1, 1) equally likely."""
    rng = np.random.default_rng(derive_seed(seed, "random_policy", 0))
    seeds = [derive_seed(seed, "random_environment", worker) for worker in range(envs.count)]
    return play(envs, lambda record: random_actions(envs.spaces, rng, envs.count), episodes, seeds)
