"""The statistical tier: right samplers pass, false alarms are as rare as stated, and usual mistakes are caught."""

import dataclasses
import math
import types
from typing import Any

import numpy as np
import pytest

from conformance import statistics
from conformance.adapters.numpy_adapter import NumpyAdapter
from conformance.case import Setting
from conformance.cases import learner, sampling
from conformance.execute import run_check, selected_checks
from conformance.problems import train_noise
from conformance.statistics import (
    distribution_distance,
    distribution_radius,
    frequency_radius,
    mean_radius,
    normal_cdf,
    normal_mean_radius,
    normal_square_radius,
)
from reference_numpy import agent
from reference_numpy.layers import TRUNCATED_NORMAL_STD
from spec import Config, Spaces, parameter_table

FRESH = selected_checks("float64", "learner.fresh_parameters")
CHECKS = {
    check.name.partition(".")[2]: check
    for check in (*selected_checks("float64", "sampling."), *selected_checks("float64", "learner.noise"), *FRESH)
}


def status(name: str, adapter: object, seed: int = 0) -> tuple[str, str]:
    result = run_check(CHECKS[name], adapter, Setting("float64", "paper", seed))
    return result.status, result.message


class Sampling(NumpyAdapter):
    """The reference, and of a learner the noise and the fresh parameters."""

    class Learner:
        def __init__(self, task: Spaces, config: Config, seed: int) -> None:
            self.task, self.config, self.seed = task, config, seed
            self.load_state_dict = self.train_step = self.initial_carry = self.policy = self.policy_noise = print

        def state_dict(self) -> dict[str, np.ndarray]:
            params = NumpyAdapter().draw_parameters(self.task, self.config, self.seed)
            return agent.flatten_state(agent.initial_state(params))

        def train_noise(self, batch: Any, seed: int) -> dict[str, np.ndarray]:
            rows, steps = batch["reward"].shape
            config = dataclasses.replace(self.config, batch_size=rows, batch_length=steps)
            return train_noise(np.random.default_rng(seed), config, self.task)


def offering(**functions: Any) -> types.SimpleNamespace:
    return types.SimpleNamespace(**functions)


def test_every_statistical_check_is_counted() -> None:
    assert len(CHECKS) == statistics.CHECKS


def test_the_level_is_shared_out() -> None:
    """L of 10 tests in each of 6 checks: 60 tests with 2 exp(-L) each make one false alarm in a million runs."""
    assert 60 * 2 * math.exp(-statistics.confidence(10)) == pytest.approx(1e-6)


@pytest.mark.parametrize("name", CHECKS)
def test_the_number_of_tests_is_right(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The check makes as many tests as it has asked a level for."""
    asked, made = [], 0
    confidence, within = statistics.confidence, sampling.within

    def counted(tests: int) -> float:
        asked.append(tests)
        return confidence(tests)

    def counting(run: Any, where: str, actual: Any, expected: Any, radius: Any) -> None:
        nonlocal made
        made += np.size(actual)
        within(run, where, actual, expected, radius)

    for module in (sampling, learner):
        monkeypatch.setattr(module, "confidence", counted)
    monkeypatch.setattr(sampling, "within", counting)
    assert status(name, Sampling())[0] == "pass"
    assert set(asked) == {made}


def test_right_samplers_raise_fewer_alarms_than_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    """With an allowed rate of 1/2 per run: 5 checks of 12 seeds alarm less often than in half of the runs, and at 1e-6
    never."""
    adapter = Sampling()
    alarms = {0.5: 0, 1e-6: 0}
    for rate in alarms:
        monkeypatch.setattr(statistics, "FALSE_ALARMS", rate)
        for seed in range(12):
            alarms[rate] += any(status(name, adapter, 10 * seed)[0] != "pass" for name in CHECKS)
    assert alarms[0.5] <= 6
    assert alarms[1e-6] == 0


def test_the_radii_hold_and_are_not_wide() -> None:
    """At a level of 1/10 each radius is exceeded in at most 10 % of 4,000 experiments; half of the radius is exceeded
    often."""
    rng, n, trials, level = np.random.default_rng(0), 400, 4000, math.log(20)
    normals, uniforms = rng.normal(size=(trials, n)), rng.random((trials, n))
    distances = np.array([distribution_distance(row, lambda x: x) for row in uniforms[:1000]])
    experiments = {
        "frequency": (
            np.abs(rng.binomial(n, 0.02, trials) / n - 0.02),
            float(frequency_radius(np.array(0.02), n, level)),
        ),
        "mean": (np.abs(uniforms.mean(1) - 0.5), float(mean_radius(1 / 12, 0.5, n, level))),
        "normal mean": (np.abs(normals.mean(1)), normal_mean_radius(n, level)),
        "normal square": (np.abs(np.mean(normals**2, 1) - 1), normal_square_radius(n, level)),
        "distribution": (distances, distribution_radius(n, level)),
    }
    for name, (deviations, radius) in experiments.items():
        assert np.mean(deviations > radius) <= 0.1, name
        assert np.mean(deviations > radius / 2) > 0.1, name


def test_the_distance_of_distributions() -> None:
    """Of the samples 0.1, 0.4 and 0.8 from the uniform distribution: largest just after 0.4, 2/3 - 0.4."""
    assert distribution_distance(np.array([0.8, 0.1, 0.4]), lambda x: x) == pytest.approx(2 / 3 - 0.4)
    np.testing.assert_allclose(
        normal_cdf(np.array([-40.0, -1.0, 0.0, 1.959964])), [0, 0.15865525, 0.5, 0.975], atol=1e-8
    )


def softmax(logits: np.ndarray, unimix: float) -> np.ndarray:
    probs = np.exp(logits - logits.max(-1, keepdims=True))
    return (1 - unimix) * probs / probs.sum(-1, keepdims=True) + unimix / logits.shape[-1]


def inverse(probs: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """Class indices [n, S] of uniforms [n, S]."""
    return np.sum(np.cumsum(probs, -1)[:, :-1] <= uniform[..., None], -1)


CATEGORICAL_MISTAKES = {
    "no mixture": lambda logits, unimix, rng, n: inverse(softmax(logits, 0), rng.random((n, len(logits)))),
    "the mixture twice": lambda logits, unimix, rng, n: inverse(
        softmax(np.log(softmax(logits, unimix)), unimix), rng.random((n, len(logits)))
    ),
    "the most likely class": lambda logits, unimix, rng, n: np.tile(logits.argmax(-1), (n, 1)),
    "one number for all latents": lambda logits, unimix, rng, n: inverse(
        softmax(logits, unimix), np.tile(rng.random((n, 1)), len(logits))
    ),
    "one sample n times": lambda logits, unimix, rng, n: np.tile(
        inverse(softmax(logits, unimix), rng.random((1, len(logits)))), (n, 1)
    ),
    "a temperature": lambda logits, unimix, rng, n: inverse(
        softmax(1.1 * logits, unimix), rng.random((n, len(logits)))
    ),
    "probabilities as logits": lambda logits, unimix, rng, n: inverse(
        softmax(softmax(logits, unimix), 0), rng.random((n, len(logits)))
    ),
}


@pytest.mark.parametrize("mistake", [None, *CATEGORICAL_MISTAKES])
def test_mistakes_with_categoricals(mistake: str | None) -> None:
    def draw(logits: np.ndarray, unimix: float, seed: int, n: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        right = inverse(softmax(logits, unimix), rng.random((n, len(logits))))
        return np.eye(logits.shape[1])[CATEGORICAL_MISTAKES[mistake](logits, unimix, rng, n) if mistake else right]

    assert status("latents_have_their_frequencies", offering(draw_categorical=draw))[0] == (
        "fail" if mistake else "pass"
    )


def test_a_seed_that_is_not_used() -> None:
    def draw(mean: np.ndarray, std: np.ndarray, seed: int, n: int) -> np.ndarray:
        return mean + std * np.random.default_rng(5).normal(size=(n, len(mean)))

    state, message = status("normals_have_their_distribution", offering(draw_normal=draw))
    assert (state, message) == ("fail", "another seed gives other samples does not hold")


NORMAL_MISTAKES = {
    "the variance for the deviation": lambda mean, std, z: mean + std**2 * z,
    "clipped": lambda mean, std, z: mean + std * np.clip(z, -2, 2),
    "a deviation 5 % too large": lambda mean, std, z: mean + 1.05 * std * z,
    "no mean": lambda mean, std, z: std * z,
    "one number for all dimensions": lambda mean, std, z: mean + std * z[:, :1],
    "uniform": lambda mean, std, z: mean + std * (normal_cdf(z) - 0.5) * math.sqrt(12),
}


@pytest.mark.parametrize("mistake", [None, *NORMAL_MISTAKES])
def test_mistakes_with_normals(mistake: str | None) -> None:
    def draw(mean: np.ndarray, std: np.ndarray, seed: int, n: int) -> np.ndarray:
        z = np.random.default_rng(seed).normal(size=(n, len(mean)))
        return NORMAL_MISTAKES[mistake](mean, std, z) if mistake else mean + std * z

    assert status("normals_have_their_distribution", offering(draw_normal=draw))[0] == ("fail" if mistake else "pass")


ACTION_MISTAKES = {
    "clipped": lambda actions, outputs: np.clip(actions, -1, 1),
    "squashed": lambda actions, outputs: np.concatenate([np.tanh(actions[:, :2]), actions[:, 2:]], 1),
    "the mean": lambda actions, outputs: np.concatenate(
        [np.tile(np.tanh(outputs["arm"]["mean"]), (len(actions), 1)), actions[:, 2:]], 1
    ),
    "the keys in another order": lambda actions, outputs: np.concatenate([actions[:, 2:], actions[:, :2]], 1),
    "the buttons in another order": lambda actions, outputs: actions[:, [0, 1, 4, 5, 6, 2, 3]],
}


@pytest.mark.parametrize("mistake", [None, *ACTION_MISTAKES])
def test_mistakes_with_actions(mistake: str | None) -> None:
    def draw(outputs: Any, task: Spaces, config: Config, seed: int, n: int) -> np.ndarray:
        actions = NumpyAdapter().draw_actions(outputs, task, config, seed, n)
        return ACTION_MISTAKES[mistake](actions, outputs) if mistake else actions

    assert status("actions_have_their_distribution", offering(draw_actions=draw))[0] == ("fail" if mistake else "pass")


@pytest.mark.parametrize("change", [{"actor_unimix": 0.0}, {"actor_min_std": 0.2}, {"actor_max_std": 1.1}])
def test_actions_of_another_configuration(change: dict[str, float]) -> None:
    def draw(outputs: Any, task: Spaces, config: Config, seed: int, n: int) -> np.ndarray:
        return NumpyAdapter().draw_actions(outputs, task, dataclasses.replace(config, **change), seed, n)

    assert status("actions_have_their_distribution", offering(draw_actions=draw))[0] == "fail"


def truncated(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Standard normals drawn again until they lie within 2."""
    z = rng.normal(size=shape)
    while np.any(outside := np.abs(z) > 2):
        z[outside] = rng.normal(size=int(outside.sum()))
    return z


def right(entry: Any, rng: np.random.Generator) -> np.ndarray:
    return truncated(rng, entry.shape) / TRUNCATED_NORMAL_STD * entry.outscale / math.sqrt(entry.fan_in)


def average_fan(entry: Any) -> float:
    *taps, inputs, outputs = entry.shape if len(entry.shape) != 3 else (entry.shape[1], entry.shape[2])
    return math.prod(taps) * (inputs + outputs) / 2


INITIALIZER_MISTAKES = {
    "clipped": lambda entry, rng: (
        np.clip(rng.normal(size=entry.shape), -2, 2) * entry.outscale / math.sqrt(entry.fan_in)
    ),
    "not truncated": lambda entry, rng: rng.normal(size=entry.shape) * entry.outscale / math.sqrt(entry.fan_in),
    "truncated at 2 of any size": lambda entry, rng: np.clip(
        rng.normal(size=entry.shape) * entry.outscale / math.sqrt(entry.fan_in), -2, 2
    ),
    "no correction of the deviation": lambda entry, rng: (
        truncated(rng, entry.shape) * entry.outscale / math.sqrt(entry.fan_in)
    ),
    "uniform": lambda entry, rng: (
        rng.uniform(-1, 1, entry.shape) * math.sqrt(3) * entry.outscale / math.sqrt(entry.fan_in)
    ),
    "the fan of one block": lambda entry, rng: (
        right(entry, rng) * (math.sqrt(entry.shape[0]) if len(entry.shape) == 3 else 1)
    ),
    "the mean of both fans": lambda entry, rng: right(entry, rng) * math.sqrt(entry.fan_in / average_fan(entry)),
    "no outscale": lambda entry, rng: right(dataclasses.replace(entry, outscale=1.0), rng),
    "zeros": lambda entry, rng: np.zeros(entry.shape),
}


@pytest.mark.parametrize("mistake", [None, *INITIALIZER_MISTAKES])
def test_mistakes_with_parameters(mistake: str | None) -> None:
    def draw(task: Spaces, config: Config, seed: int) -> dict[str, np.ndarray]:
        rng, constants = np.random.default_rng(seed), {"zeros": 0.0, "ones": 1.0}
        kernel = INITIALIZER_MISTAKES[mistake] if mistake else right
        table = parameter_table(config, task)
        return {
            name: np.full(entry.shape, constants[entry.initializer])
            if entry.initializer in constants
            else kernel(entry, rng)
            for name, entry in table.items()
        }

    assert status("parameters_have_their_distribution", offering(draw_parameters=draw))[0] == (
        "fail" if mistake else "pass"
    )
