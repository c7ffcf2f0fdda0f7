"""How far samples may be from their distribution: bounds that hold for every number of samples, not only in the limit.

A statistical check is wrong about a right sampler with some probability. Over all checks of one run together it is at
most FALSE_ALARMS: the run makes a known number of tests, each is allowed its share (the union bound), and each radius
below is exceeded with at most the probability 2 exp(-L), where L = `confidence(tests)` = ln(2 CHECKS tests /
FALSE_ALARMS), for a check with that many tests:

  CHECKS checks x `tests` tests x 2 exp(-L) = FALSE_ALARMS.

The radii are inequalities and thus somewhat wide: what is rejected deserves it. The numbers that computers call random,
and their rounding, stand for real ones: frequencies differ from those of real numbers by some 1e-7, far less than any
radius here.
"""

import math
from collections.abc import Callable

import numpy as np

FALSE_ALARMS = 1e-6
CHECKS = 6
"""How many checks of a run are statistical."""


def confidence(tests: int) -> float:
    """L for each of a check's tests."""
    return math.log(2 * CHECKS * tests / FALSE_ALARMS)


def mean_radius(variance: np.ndarray | float, largest: float, n: int, confidence: float) -> np.ndarray:
    """Of the mean of n samples with this variance, none farther than `largest` from the expectation: Bernstein's
    inequality.

    P(|mean - expectation| >= r) <= 2 exp(-n r^2 / (2 variance + 2 largest r / 3)), solved for r.
    """
    linear = largest * confidence / (3 * n)
    return linear + np.sqrt(linear**2 + 2 * confidence * np.asarray(variance) / n)


def frequency_radius(probability: np.ndarray, n: int, confidence: float) -> np.ndarray:
    """Of the share of n samples that fall into a class of this probability: the mean of zeros and ones."""
    return mean_radius(probability * (1 - probability), 1.0, n, confidence)


def normal_mean_radius(n: int, confidence: float) -> float:
    """Of the mean of n standard normals, itself a normal: P(|mean| >= r) <= 2 exp(-n r^2 / 2)."""
    return math.sqrt(2 * confidence / n)


def normal_square_radius(n: int, confidence: float) -> float:
    """Of the mean square of n standard normals: the inequality of Laurent and Massart for the chi-square
    distribution."""
    return 2 * math.sqrt(confidence / n) + 2 * confidence / n


def distribution_radius(n: int, confidence: float) -> float:
    """Of `distribution_distance`: the inequality of Dvoretzky, Kiefer and Wolfowitz with the constant of Massart, 2
    exp(-2 n r^2)."""
    return math.sqrt(confidence / (2 * n))


def distribution_distance(samples: np.ndarray, cdf: Callable[[np.ndarray], np.ndarray]) -> float:
    """The largest difference between the share of samples up to a number and the probability up to it."""
    expected = cdf(np.sort(samples))
    n = len(expected)
    steps = np.arange(n + 1) / n
    return float(max(np.max(steps[1:] - expected), np.max(expected - steps[:-1])))


def normal_cdf(z: np.ndarray) -> np.ndarray:
    """Of the standard normal."""
    return np.array([0.5 * math.erfc(-x / math.sqrt(2)) for x in np.ravel(z)]).reshape(np.shape(z))
