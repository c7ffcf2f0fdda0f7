"""Transforms: exact properties and edge cases. The numbers of spec/01-transforms.md are in tests/test_examples.py."""

import numpy as np
import pytest

from reference_numpy.transforms import exponential_bins, ordered_expectation, symexp, symlog, twohot

SMALL = [-3.0, -1.0, 0.0, 1.0, 3.0]


def test_symlog_and_symexp_are_inverse():
    x = np.array([-1e6, -2.5, -1e-12, 0.0, 0.3, 7.0, 1e9])
    np.testing.assert_allclose(symexp(symlog(x)), x, rtol=1e-13)


def test_special_values():
    np.testing.assert_array_equal(symlog([0.0, -0.0, np.inf, -np.inf, np.nan]), [0, 0, np.inf, -np.inf, np.nan])
    np.testing.assert_array_equal(symexp([0.0, -0.0, np.inf, -np.inf, np.nan]), [0, 0, np.inf, -np.inf, np.nan])
    np.testing.assert_array_equal(symexp([3e38, -1e30]), [np.inf, -np.inf])
    np.testing.assert_allclose(symlog([1e-40, 5e-324]), [1e-40, 5e-324], atol=2.3e-308)
    np.testing.assert_allclose(symexp([1e-40, -5e-324]), [1e-40, -5e-324], atol=2.3e-308)


def test_bins():
    bins = exponential_bins(255)
    assert bins.shape == (255,)
    np.testing.assert_array_equal(bins, -bins[::-1])
    assert np.all(np.diff(bins) > 0)


@pytest.mark.parametrize("bins", [0, 1, 2, 254])
def test_bins_refuse_even_and_small_numbers(bins):
    with pytest.raises(ValueError, match="odd number of at least 3"):
        exponential_bins(bins)


@pytest.mark.parametrize(
    ("x", "expected"),
    [
        (-np.inf, [1, 0, 0, 0, 0]),
        (np.inf, [0, 0, 0, 0, 1]),
        (-0.0, [0, 0, 1, 0, 0]),
        (np.nan, [np.nan] * 5),
    ],
)
def test_twohot_of_special_numbers(x, expected):
    np.testing.assert_array_equal(twohot(x, SMALL), expected)


@pytest.mark.parametrize("x", [0.1, 1.0, 300.0])
def test_twohot_interpolates_in_raw_space(x):
    weights = twohot(x, exponential_bins(255))
    assert np.count_nonzero(weights) == 2
    assert weights @ exponential_bins(255) == pytest.approx(x, rel=1e-12)


def test_twohot_keeps_leading_axes():
    weights = twohot([[2.0, 7.0], [1.0, -3.0]], SMALL)
    assert weights.shape == (2, 2, 5)
    np.testing.assert_array_equal(weights[0, 1], twohot(7.0, SMALL))


def test_ordered_expectation_of_symmetric_probabilities_is_exactly_zero():
    bins = exponential_bins(255)
    half = np.random.default_rng(0).random(127)
    probs = np.concatenate([half, [0.3], half[::-1]])
    assert ordered_expectation(probs / probs.sum(), bins) == 0.0


def test_ordered_expectation_is_exactly_odd():
    bins, probs = exponential_bins(255), np.random.default_rng(0).random(255)
    assert ordered_expectation(probs, bins) == -ordered_expectation(probs[::-1], bins) != 0


def test_ordered_expectation_shows_nan():
    for place in range(5):
        probs = np.full(5, 0.2)
        probs[place] = np.nan
        assert np.isnan(ordered_expectation(probs, SMALL))


def test_wrong_shapes():
    with pytest.raises(ValueError, match="bins"):
        twohot(1.0, [[0.0, 1.0]])
    with pytest.raises(ValueError, match="bins"):
        twohot(1.0, [0.0])
    with pytest.raises(ValueError, match="odd"):
        ordered_expectation([0.5, 0.5], [-1.0, 1.0])
    with pytest.raises(ValueError, match="mirror"):
        ordered_expectation([0.2, 0.3, 0.5], [-1.0, 0.0, 2.0])
    with pytest.raises(ValueError, match="probs"):
        ordered_expectation([0.2, 0.8], [-1.0, 0.0, 1.0])
