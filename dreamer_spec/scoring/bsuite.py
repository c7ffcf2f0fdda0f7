"""The scores of BSuite, from 0 to 1, as bsuite 0.3.6 computes them from what its environments count.

Episodes are those of training, the first 10,000 or 1,000 of a run ([bsuite.experiments] in spec/benchmarks.toml). The
package averages regret over the configurations of an experiment, or counts those that reached something; experiments
with noise or scaled rewards lose the standard deviation over the five scales. (docs/scores.md)
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from dreamer_spec.report.runs import RunLog
from spec import benchmarks

INFO = "episode/info/bsuite/"
# Of each decade, the episodes that the package logs, and at which `deep_sea` asks whether it is solved.
LOGGED = (1.0, 1.2, 1.4, 1.7, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0)

# The mean regret of a policy that scores 0.
BASE_REGRET = {
    "bandit": 0.5,
    "cartpole": 1000,
    "cartpole_swingup": 700,
    "catch": 1.6,
    "mnist": 1.8,
    "mountain_car": 1000,
}
# What the package counts for a score, where it is not the regret; nothing where returns tell it.
NEEDED = {
    "cartpole": "raw_return",
    "cartpole_swingup": "raw_return",
    "mountain_car": "raw_return",
    "memory": "total_perfect",
    "deep_sea": "total_bad_episodes",
    "discounting_chain": "",
}
GOOD_EPISODE = {"cartpole": 500, "cartpole_swingup": 100}  # the return that counts as solved
MOUNTAIN_CAR_BEST = -100.0  # the return that has no regret
UMBRELLA_REGRET = 0.5  # below which an umbrella is learned
MEMORY_FAILURES = 0.75 * 0.5  # below which memory is; guessing fails half of the time
CHAIN_BEST, CHAIN_SLOPE = 1.1, 10.0
BAD_SHARE = {"deep_sea": 0.9, "deep_sea_stochastic": 0.8}  # of episodes, below which it is solved
FIRST_ASKED = {"deep_sea": 1, "deep_sea_stochastic": 100}  # episodes
FORGIVENESS = 100  # episodes beside the 2**size that chance needs
REPEATS = 4  # configurations of each scale, which follow each other


@dataclasses.dataclass(frozen=True)
class Episodes:
    """What counts of a run of one configuration. returns: of each episode [n]. counted: name -> what each episode adds
    to what the package counts [n]."""

    number: int
    returns: np.ndarray
    counted: Mapping[str, np.ndarray]

    def mean(self, name: str) -> float:
        return float(np.mean(self.counted[name]))


def configuration(task: str) -> tuple[str, int] | None:
    """bsuite:catch/3 -> ("catch", 3); bsuite:catch is its number 0. None for what is no configuration of BSuite."""
    suite, _, name = task.partition(":")
    experiment, separator, number = name.partition("/")
    known = benchmarks()["bsuite"]["experiments"]
    if suite != "bsuite" or experiment not in known or (separator and not number.isdecimal()):
        return None
    return experiment, int(number or 0)


def episodes_of(experiment: str) -> int:
    """How many a score is made of."""
    count: int = benchmarks()["bsuite"]["experiments"][experiment]["episodes"]
    return count


def counted_by_the_package(run: RunLog) -> dict[str, np.ndarray]:
    """Name -> what each episode of the run added to what the package counts; only what every episode has."""
    episodes = len(run.curves["episode/return"].values)
    return {
        name.removeprefix(INFO): curve.values
        for name, curve in run.curves.items()
        if name.startswith(INFO) and len(curve.values) == episodes
    }


def needed(experiment: str) -> str:
    """The name of what the package counts for the score; empty if returns tell it."""
    return NEEDED.get(_kind(experiment), "total_regret")


def scored(run: RunLog) -> Episodes | None:
    """The episodes of a run that count; None if none has ended, or if what the score is made of was not logged."""
    found = configuration(run.task)
    if found is None or "episode/return" not in run.curves:
        return None
    experiment, number = found
    most, counted = episodes_of(experiment), counted_by_the_package(run)
    if needed(experiment) and needed(experiment) not in counted:
        return None
    returns = run.curves["episode/return"].values[:most]
    return Episodes(number, returns, {name: values[:most] for name, values in counted.items()})


def score(experiment: str, runs: Sequence[Episodes]) -> float:
    """The score of an experiment, 0 to 1. runs: one of each configuration that was run, at least one."""
    if not experiment.endswith(("_noise", "_scale")):
        return _score(experiment, runs)
    scales: dict[int, list[Episodes]] = {}
    for run in runs:
        scales.setdefault(run.number // REPEATS, []).append(run)
    scores = [_score(experiment, alike) for alike in scales.values()]
    mean, deviation = float(np.mean(scores)), float(np.std(scores))
    return (_clipped(mean) + _clipped(mean - deviation)) / 2


def _kind(experiment: str) -> str:
    """What experiments that are scored alike have in common."""
    name = experiment.removesuffix("_noise").removesuffix("_scale").removesuffix("_stochastic")
    return name.partition("_")[0] if name.startswith(("memory_", "umbrella_")) else name


def _score(experiment: str, runs: Sequence[Episodes]) -> float:
    kind = _kind(experiment)
    match kind:
        case "bandit" | "catch":
            return _regret(kind, [run.mean("total_regret") for run in runs])
        case "mountain_car":
            return _regret(kind, [MOUNTAIN_CAR_BEST - run.mean("raw_return") for run in runs])
        case "cartpole":
            regret = _regret(kind, [BASE_REGRET[kind] - run.mean("raw_return") for run in runs])
            return (regret + _share(_is_solved(kind, run) for run in runs)) / 2
        case "cartpole_swingup":  # each configuration, a height of its own, for itself
            regrets = [_regret(kind, [BASE_REGRET[kind] - run.mean("raw_return")]) for run in runs]
            return (float(np.mean(regrets)) + _share(_is_solved(kind, run) for run in runs)) / 2
        case "mnist":
            regret = _regret(kind, [run.mean("total_regret") for run in runs])
            return (regret + float(np.mean([_accuracy(run.counted["total_regret"]) for run in runs]))) / 2
        case "discounting_chain":
            mean = float(np.mean([np.mean(run.returns) for run in runs]))
            return _clipped(1 - CHAIN_SLOPE * (CHAIN_BEST - mean))
        case "memory":
            return _share(1 - run.mean("total_perfect") < MEMORY_FAILURES for run in runs)
        case "umbrella":
            return _share(run.mean("total_regret") < UMBRELLA_REGRET for run in runs)
        case _:
            return _share(_beats_chance(experiment, run) for run in runs)


def _is_solved(kind: str, run: Episodes) -> bool:
    return bool(np.max(run.counted["raw_return"]) > GOOD_EPISODE[kind])


def _regret(kind: str, regrets: Sequence[float]) -> float:
    """1 for none, 0 for that of a random policy."""
    return _clipped(1 - float(np.mean(regrets)) / BASE_REGRET[kind])


def _accuracy(regret: np.ndarray) -> float:
    """Of the classifier in the last tenth of its episodes; a wrong answer has the regret 2."""
    return float(1 - np.mean(regret[-math.ceil(len(regret) / 10) :]) / 2)


def _beats_chance(experiment: str, run: Episodes) -> bool:
    """Whether the first logged episode until which few were bad comes before chance would have found the treasure."""
    size = benchmarks()["bsuite"]["experiments"][experiment]["longest"][run.number]
    bad = np.cumsum(run.counted["total_bad_episodes"])
    for episode in range(FIRST_ASKED[experiment], len(bad) + 1):
        if is_logged(episode) and bad[episode - 1] / episode < BAD_SHARE[experiment]:
            return bool(episode < 2**size + FORGIVENESS)
    return False


def is_logged(episode: int) -> bool:
    """Whether the package logs this episode, counted from 1."""
    decade = 10 ** math.floor(math.log10(episode))
    return any(episode == decade * part for part in LOGGED)


def _share(found: Iterable[bool]) -> float:
    return float(np.mean(list(found)))


def _clipped(value: float) -> float:
    return float(np.clip(value, 0, 1))
