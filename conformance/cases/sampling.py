"""Checks of samples that an implementation draws with a generator of its own: the functions named `draw_...`.

They are statistical. All of them together are wrong about a right sampler with a probability of at most 1e-6 in a run:
see conformance/statistics.py, which counts these checks.
"""

import itertools
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from conformance.check import script
from conformance.problems import small_config, spaces
from conformance.script import Script
from conformance.statistics import (
    confidence,
    distribution_distance,
    distribution_radius,
    frequency_radius,
    mean_radius,
    normal_cdf,
    normal_mean_radius,
    normal_square_radius,
)
from reference_numpy.distributions import bounded_normal, unimix_log_probs
from spec import Config, Spaces, parameter_table

EXACT = ("float64", "float32")  # samplers compute in float32 or better
SAMPLES = 50_000
UNIMIX = 0.01
LATENTS = np.array([[0.0, 1, 2, 0.5, -9], [9, 0, 0, 0, 0], [0, 0, 0, 0, 0]])
# Of the truncated normal of [LAY-9] with standard deviation 1: where it ends, and the variance of its square.
LARGEST = 2.273694468677113
SQUARE_VARIANCE = 1.365537
HALVES = np.array([0.5, 0.5])

Group = tuple[np.ndarray, np.ndarray]
"""One-hot samples [n, C], and the probabilities [C] that they should have."""


@script("RSSM-10", "DIS-7", "CON-21", uses=["draw_categorical"], level=1, dtypes=EXACT)
def latents_have_their_frequencies(script: Script) -> None:
    """Each class as often as the mixture says, with and without uniform share; neighbouring latents are independent."""
    classes = LATENTS.shape[1]
    tests = 2 * tests_of([classes] * len(LATENTS))
    for seed, unimix in enumerate((UNIMIX, 0.0), 2 * script.setting.seed):
        drawn = np.asarray(script.call("draw_categorical", LATENTS, unimix, seed, SAMPLES), np.float64)
        require_onehots(script, "samples", drawn, (SAMPLES, *LATENTS.shape))
        probs = np.exp(unimix_log_probs(LATENTS, unimix))
        groups = {f"latent {i}": (drawn[:, i], probs[i]) for i in range(len(probs))}
        compare_groups(script, f"unimix {unimix}: ", groups, confidence(tests))
    other = script.call("draw_categorical", LATENTS, UNIMIX, 2 * script.setting.seed + 2, SAMPLES)
    script.holds("another seed gives other samples", not np.array_equal(drawn, other))


@script("CON-18", "CON-21", uses=["draw_normal"], level=1, dtypes=EXACT)
def normals_have_their_distribution(script: Script) -> None:
    """Mean, standard deviation and the whole distribution; the signs of neighbouring dimensions are independent."""
    mean, std = np.array([0.5, -2.0, 0.0]), np.array([0.25, 1.0, 3.0])
    tests = 3 * len(mean) + tests_of([2] * len(mean))
    drawn = np.asarray(script.call("draw_normal", mean, std, script.setting.seed, SAMPLES), np.float64)
    require_shape(script, "samples", drawn, (SAMPLES, len(mean)))
    z = (drawn - mean) / std
    for i in range(len(mean)):
        compare_normal(script, f"dimension {i}", z[:, i], confidence(tests))
    compare_groups(script, "", {f"sign of dimension {i}": signs(z[:, i]) for i in range(len(mean))}, confidence(tests))
    other = script.call("draw_normal", mean, std, script.setting.seed + 1, SAMPLES)
    script.holds("another seed gives other samples", not np.array_equal(drawn, other))


@script("BEH-1", "BEH-2", "BEH-4", "CON-26", "CON-27", uses=["draw_actions"], level=1, dtypes=EXACT)
def actions_have_their_distribution(script: Script) -> None:
    """Categoricals with their uniform share, normals neither clipped nor squashed, neighbours independent, in the order
    of the keys."""
    setting, task = script.setting, spaces(action="mixed")
    config = small_config(setting.profile, setting.dtype, actor_unimix=UNIMIX)
    outputs = {
        "arm": {"mean": np.array([0.9, -0.3]), "std": np.array([1.0, -3.0])},
        "buttons": {"logits": np.array([0.0, -9, 1, 2, -9])},
    }
    tests = 3 * 2 + tests_of([2, 2, 2, 3])
    drawn = np.asarray(script.call("draw_actions", outputs, task, config, setting.seed, SAMPLES), np.float64)
    require_shape(script, "samples", drawn, (SAMPLES, task.action_size))

    groups: dict[str, Group] = {}
    arm = outputs["arm"]
    means, stds = bounded_normal(arm["mean"], arm["std"], config.actor_min_std, config.actor_max_std)
    for i in range(2):
        z = (drawn[:, i] - means[i]) / stds[i]
        compare_normal(script, f"arm {i}", z, confidence(tests))
        groups[f"sign of arm {i}"] = signs(z)
    for i, segment in enumerate((slice(0, 2), slice(2, 5))):
        own = drawn[:, 2:][:, segment]
        require_onehots(script, f"button {i}", own, own.shape)
        groups[f"button {i}"] = own, np.exp(unimix_log_probs(outputs["buttons"]["logits"][segment], UNIMIX))
    compare_groups(script, "", groups, confidence(tests))


@script("AGT-1", "AGT-3", "AGT-4", "AGT-5", "AGT-6", "LAY-9", "LAY-10", uses=["draw_parameters"], level=1, dtypes=EXACT)
def parameters_have_their_distribution(script: Script) -> None:
    """Names and shapes of the table; exact zeros and ones; kernels follow the truncated normal, each by itself and all
    together, and do not follow each other."""
    task, config = spaces(), drawn_config(script)
    compare_parameters(script, task, config, script.call("draw_parameters", task, config, script.setting.seed))


def drawn_config(script: Script) -> Config:
    """Large enough for statistics."""
    sizes = {"units": 48, "deter": 96, "cnn_depth": 4, "actor_outscale": 0.01, "reward_outscale": 0.0}
    return small_config(script.setting.profile, script.setting.dtype, **sizes)


def compare_parameters(script: Script, task: Spaces, config: Config, params: Mapping[str, Any]) -> None:
    """Fresh parameters against the table, and their kernels against the truncated normal."""
    table = parameter_table(config, task)
    script.holds("the names are those of the parameter table", set(params) == set(table))
    random = {
        name: entry for name, entry in table.items() if entry.initializer == "truncated_normal" and entry.outscale
    }
    level = confidence(2 * len(random) + 1 + math.comb(len(random), 2))
    weights: dict[str, np.ndarray] = {}
    for name, entry in table.items():
        value = np.asarray(params[name], np.float64)
        require_shape(script, name, value, entry.shape)
        if name not in random:
            script.exact(name, value, np.full(entry.shape, float(entry.initializer == "ones")))
            continue
        weight = value.ravel() / (entry.outscale / np.sqrt(entry.fan_in))
        script.holds(f"{name} ends at {LARGEST:.4f} standard deviations", np.abs(weight) <= LARGEST * (1 + 1e-5))
        radius = mean_radius(SQUARE_VARIANCE, LARGEST**2 - 1, weight.size, level)
        within(script, f"{name}: mean square in units of its variance", np.mean(weight**2), 1.0, radius)
        compare_distribution(script, name, weight, truncated_cdf, level)
        weights[name] = weight
    compare_distribution(script, "all kernels", np.concatenate(list(weights.values())), truncated_cdf, level)
    for one, other in itertools.combinations(weights, 2):
        n = min(weights[one].size, weights[other].size)
        product, radius = weights[one][:n] @ weights[other][:n] / n, mean_radius(1.0, LARGEST**2, n, level)
        within(script, f"mean product of {one} and {other}", product, 0.0, radius)


def truncated_cdf(weight: np.ndarray) -> np.ndarray:
    """Of the truncated normal of [LAY-9] with standard deviation 1."""
    lowest = normal_cdf(np.array(-2.0))
    return (normal_cdf(np.clip(weight * 2 / LARGEST, -2, 2)) - lowest) / (1 - 2 * lowest)


def tests_of(sizes: list[int]) -> int:
    """How many tests `compare_groups` makes of groups with these numbers of classes."""
    return sum(sizes) + sum(a * b for a, b in itertools.pairwise(sizes))


def compare_groups(script: Script, where: str, groups: dict[str, Group], level: float) -> None:
    """The frequency of every class of every group, and of every pair of classes of neighbouring groups."""
    for label, (onehot, probs) in groups.items():
        radius = frequency_radius(probs, len(onehot), level)
        within(script, f"{where}frequencies of {label}", onehot.mean(0), probs, radius)
    for (a, (left, p)), (b, (right, q)) in itertools.pairwise(groups.items()):
        both, found = np.outer(p, q), left.T @ right / len(left)
        within(script, f"{where}{a} together with {b}", found, both, frequency_radius(both, len(left), level))


def compare_normal(script: Script, where: str, z: np.ndarray, level: float) -> None:
    within(script, f"{where}: mean in standard deviations", z.mean(), 0.0, normal_mean_radius(SAMPLES, level))
    radius = normal_square_radius(SAMPLES, level)
    within(script, f"{where}: mean square in units of the variance", np.mean(z**2), 1.0, radius)
    compare_distribution(script, where, z, normal_cdf, level)


def compare_distribution(
    script: Script, where: str, samples: np.ndarray, cdf: Callable[[np.ndarray], np.ndarray], level: float
) -> None:
    distance, radius = distribution_distance(samples, cdf), distribution_radius(samples.size, level)
    within(script, f"{where}: distance of distributions", distance, 0.0, radius)


def signs(z: np.ndarray) -> Group:
    return np.stack([z < 0, z >= 0], -1).astype(np.float64), HALVES


def within(script: Script, where: str, actual: object, expected: object, radius: object) -> None:
    """Compares in units of the radius, so that the allowed deviation is 1."""
    script.compare(where, actual, expected, magnitude=radius, bound=1.0)


def require_shape(script: Script, where: str, value: np.ndarray, shape: tuple[int, ...]) -> None:
    script.holds(f"{where}: the shape {shape}, got {value.shape};", value.shape == shape)


def require_onehots(script: Script, where: str, value: np.ndarray, shape: tuple[int, ...]) -> None:
    require_shape(script, where, value, shape)
    script.holds(f"{where}: one-hot;", (value.sum(-1) == 1) & np.all((value == 0) | (value == 1), -1))
