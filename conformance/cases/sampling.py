"""Checks of samples that an implementation draws with a generator of its own: the functions named `draw_...`.

They are statistical. All of them together are wrong about a right sampler with a probability of at most 1e-6 in a run:
see conformance/statistics.py, which counts these checks.
"""

import itertools

import numpy as np

from conformance.check import Run, check
from conformance.problems import small_config, spaces
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
from spec import parameter_table

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


@check("RSSM-10", "DIS-7", "CON-21", uses=["draw_categorical"], level=1, dtypes=EXACT)
def latents_have_their_frequencies(run: Run) -> None:
    """Each class as often as the mixture says, with and without uniform share; neighbouring latents are independent."""
    classes = LATENTS.shape[1]
    tests = 2 * tests_of([classes] * len(LATENTS))
    for seed, unimix in enumerate((UNIMIX, 0.0), 2 * run.seed):
        drawn = np.asarray(run.call("draw_categorical", LATENTS, unimix, seed, SAMPLES), np.float64)
        require_onehots(run, "samples", drawn, (SAMPLES, *LATENTS.shape))
        probs = np.exp(unimix_log_probs(LATENTS, unimix))
        compare_groups(
            run,
            f"unimix {unimix}: ",
            {f"latent {i}": (drawn[:, i], probs[i]) for i in range(len(probs))},
            confidence(tests),
        )
    other = run.call("draw_categorical", LATENTS, UNIMIX, 2 * run.seed + 2, SAMPLES)
    run.holds("another seed gives other samples", not np.array_equal(drawn, other))


@check("CON-18", "CON-21", uses=["draw_normal"], level=1, dtypes=EXACT)
def normals_have_their_distribution(run: Run) -> None:
    """Mean, standard deviation and the whole distribution; the signs of neighbouring dimensions are independent."""
    mean, std = np.array([0.5, -2.0, 0.0]), np.array([0.25, 1.0, 3.0])
    tests = 3 * len(mean) + tests_of([2] * len(mean))
    drawn = np.asarray(run.call("draw_normal", mean, std, run.seed, SAMPLES), np.float64)
    require_shape(run, "samples", drawn, (SAMPLES, len(mean)))
    z = (drawn - mean) / std
    for i in range(len(mean)):
        compare_normal(run, f"dimension {i}", z[:, i], confidence(tests))
    compare_groups(run, "", {f"sign of dimension {i}": signs(z[:, i]) for i in range(len(mean))}, confidence(tests))
    other = run.call("draw_normal", mean, std, run.seed + 1, SAMPLES)
    run.holds("another seed gives other samples", not np.array_equal(drawn, other))


@check("BEH-1", "BEH-2", "BEH-4", "CON-26", "CON-27", uses=["draw_actions"], level=1, dtypes=EXACT)
def actions_have_their_distribution(run: Run) -> None:
    """Categoricals with their uniform share, normals neither clipped nor squashed, neighbours independent, in the order
    of the keys."""
    config, task = small_config(run.profile, run.dtype, actor_unimix=UNIMIX), spaces(action="mixed")
    outputs = {
        "arm": {"mean": np.array([0.9, -0.3]), "std": np.array([1.0, -3.0])},
        "buttons": {"logits": np.array([0.0, -9, 1, 2, -9])},
    }
    tests = 3 * 2 + tests_of([2, 2, 2, 3])
    drawn = np.asarray(run.call("draw_actions", outputs, task, config, run.seed, SAMPLES), np.float64)
    require_shape(run, "samples", drawn, (SAMPLES, task.action_size))

    groups: dict[str, Group] = {}
    means, stds = bounded_normal(
        outputs["arm"]["mean"], outputs["arm"]["std"], config.actor_min_std, config.actor_max_std
    )
    for i in range(2):
        z = (drawn[:, i] - means[i]) / stds[i]
        compare_normal(run, f"arm {i}", z, confidence(tests))
        groups[f"sign of arm {i}"] = signs(z)
    for i, segment in enumerate((slice(0, 2), slice(2, 5))):
        own = drawn[:, 2:][:, segment]
        require_onehots(run, f"button {i}", own, own.shape)
        groups[f"button {i}"] = own, np.exp(unimix_log_probs(outputs["buttons"]["logits"][segment], UNIMIX))
    compare_groups(run, "", groups, confidence(tests))


@check("AGT-1", "AGT-3", "AGT-4", "AGT-5", "AGT-6", "LAY-9", "LAY-10", uses=["draw_parameters"], level=1, dtypes=EXACT)
def parameters_have_their_distribution(run: Run) -> None:
    """Names and shapes of the table; exact zeros and ones; kernels follow the truncated normal, each by itself and all
    together."""
    task = spaces()
    config = small_config(
        run.profile, run.dtype, units=48, deter=96, cnn_depth=4, actor_outscale=0.01, reward_outscale=0.0
    )
    table = parameter_table(config, task)
    params = run.call("draw_parameters", task, config, run.seed)
    run.holds("the names are those of the parameter table", set(params) == set(table))
    random = {
        name: entry for name, entry in table.items() if entry.initializer == "truncated_normal" and entry.outscale
    }
    level = confidence(2 * len(random) + 1)
    weights = []
    for name, entry in table.items():
        value = np.asarray(params[name], np.float64)
        require_shape(run, name, value, entry.shape)
        if name not in random:
            run.exact(name, value, np.full(entry.shape, float(entry.initializer == "ones")))
            continue
        weight = value.ravel() / (entry.outscale / np.sqrt(entry.fan_in))
        run.holds(f"{name} ends at {LARGEST:.4f} standard deviations", np.abs(weight) <= LARGEST * (1 + 1e-5))
        radius = mean_radius(SQUARE_VARIANCE, LARGEST**2 - 1, weight.size, level)
        within(run, f"{name}: mean square in units of its variance", np.mean(weight**2), 1.0, radius)
        within(
            run,
            f"{name}: distance of distributions",
            distribution_distance(weight, truncated_cdf),
            0.0,
            distribution_radius(weight.size, level),
        )
        weights.append(weight)
    together = np.concatenate(weights)
    within(
        run,
        "all kernels: distance of distributions",
        distribution_distance(together, truncated_cdf),
        0.0,
        distribution_radius(together.size, level),
    )


def truncated_cdf(weight: np.ndarray) -> np.ndarray:
    """Of the truncated normal of [LAY-9] with standard deviation 1."""
    lowest = normal_cdf(np.array(-2.0))
    return (normal_cdf(np.clip(weight * 2 / LARGEST, -2, 2)) - lowest) / (1 - 2 * lowest)


def tests_of(sizes: list[int]) -> int:
    """How many tests `compare_groups` makes of groups with these numbers of classes."""
    return sum(sizes) + sum(a * b for a, b in itertools.pairwise(sizes))


def compare_groups(run: Run, where: str, groups: dict[str, Group], level: float) -> None:
    """The frequency of every class of every group, and of every pair of classes of neighbouring groups."""
    for label, (onehot, probs) in groups.items():
        within(run, f"{where}frequencies of {label}", onehot.mean(0), probs, frequency_radius(probs, SAMPLES, level))
    for (a, (left, p)), (b, (right, q)) in itertools.pairwise(groups.items()):
        both = np.outer(p, q)
        within(
            run, f"{where}{a} together with {b}", left.T @ right / SAMPLES, both, frequency_radius(both, SAMPLES, level)
        )


def compare_normal(run: Run, where: str, z: np.ndarray, level: float) -> None:
    within(run, f"{where}: mean in standard deviations", z.mean(), 0.0, normal_mean_radius(SAMPLES, level))
    within(
        run, f"{where}: mean square in units of the variance", np.mean(z**2), 1.0, normal_square_radius(SAMPLES, level)
    )
    within(
        run,
        f"{where}: distance of distributions",
        distribution_distance(z, normal_cdf),
        0.0,
        distribution_radius(SAMPLES, level),
    )


def signs(z: np.ndarray) -> Group:
    return np.stack([z < 0, z >= 0], -1).astype(np.float64), HALVES


def within(run: Run, where: str, actual: object, expected: object, radius: object) -> None:
    """Compares in units of the radius, so that the allowed deviation is 1."""
    run.compare(where, actual, expected, magnitude=radius, bound=1.0)


def require_shape(run: Run, where: str, value: np.ndarray, shape: tuple[int, ...]) -> None:
    run.holds(f"{where}: the shape {shape}, got {value.shape};", value.shape == shape)


def require_onehots(run: Run, where: str, value: np.ndarray, shape: tuple[int, ...]) -> None:
    require_shape(run, where, value, shape)
    run.holds(f"{where}: one-hot;", (value.sum(-1) == 1) & np.all((value == 0) | (value == 1), -1))
