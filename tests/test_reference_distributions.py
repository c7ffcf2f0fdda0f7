"""Distributions: edge cases and gradients. The numbers of spec/02-distributions.md are in tests/test_examples.py."""

import math

import numpy as np
import pytest

from reference_numpy.distributions import (
    bernoulli_loss,
    bernoulli_mean,
    bounded_normal,
    categorical_entropy,
    categorical_kl,
    categorical_log_prob,
    categorical_sample,
    mse_loss,
    normal_log_prob,
    normal_sample,
    straight_through,
    symexp_twohot_loss,
    symexp_twohot_mean,
    symlog_mse_loss,
    unimix_log_probs,
)
from reference_numpy.stop_gradient import recording, replaying
from reference_numpy.transforms import exponential_bins

LN2 = math.log(2)
SMALL = [-3.0, -1.0, 0.0, 1.0, 3.0]
MIXED = unimix_log_probs([math.log(8), 0.0, 0.0], 0.01)


def gradient(function, x, step=1e-6):
    """Central differences of the sum of a function, constants held fixed."""
    x = np.asarray(x, dtype=np.float64)
    with recording() as tape:
        function(x)
    result = np.zeros_like(x)
    for index in np.ndindex(x.shape):
        shift = np.zeros_like(x)
        shift[index] = step
        for sign in (1, -1):
            with replaying(tape):
                result[index] += sign * np.sum(function(x + sign * shift)) / (2 * step)
    return result


def test_log_softmax_is_stable():
    np.testing.assert_allclose(unimix_log_probs([1001.0, 1002.0], 0.0), unimix_log_probs([1.0, 2.0], 0.0), rtol=1e-12)


def test_special_logits():
    for bad in ([np.nan, 0.0], [np.inf, 0.0], [-np.inf, -np.inf]):
        for unimix in (0.0, 0.01):
            assert np.isnan(unimix_log_probs(bad, unimix)).all()


def test_sample_of_zero_probabilities():
    np.testing.assert_array_equal(categorical_sample([-np.inf, 0.0], 0.0), [0, 1])
    np.testing.assert_array_equal(categorical_sample([0.0], 0.99), [1])
    assert categorical_sample([np.nan, np.nan], 0.5).sum() == 1


def test_straight_through():
    sample = np.array([0.0, 1.0, 0.0])
    np.testing.assert_array_equal(straight_through(MIXED, sample), sample)
    upstream = np.array([1.0, 2.0, 5.0])
    result = gradient(lambda log_probs: straight_through(log_probs, sample) * upstream, MIXED)
    np.testing.assert_allclose(result, np.exp(MIXED) * upstream, rtol=1e-8)


def test_a_sample_is_constant():
    result = gradient(lambda log_probs: categorical_sample(log_probs, 0.7953333333) * [1.0, 2.0, 3.0], MIXED, step=0.1)
    np.testing.assert_array_equal(result, [0, 0, 0])


def test_kl_to_itself():
    assert categorical_kl(MIXED, MIXED) == 0
    assert categorical_kl([MIXED] * 4, [MIXED] * 4).shape == (4,)


def test_zero_probabilities_contribute_nothing():
    certain = [0.0, -np.inf]
    assert categorical_entropy(certain) == 0
    assert categorical_kl(certain, certain) == 0
    assert categorical_kl(certain, np.log([0.5, 0.5])) == pytest.approx(LN2)
    assert categorical_kl(np.log([0.5, 0.5]), certain) == np.inf
    assert categorical_log_prob(certain, [1.0, 0.0]) == 0
    assert categorical_log_prob(certain, [0.0, 1.0]) == -np.inf


def test_symexp_twohot_shows_nan():
    assert np.isnan(symexp_twohot_loss(np.zeros(255), np.nan, exponential_bins(255)))


def test_symexp_twohot_gradient():
    logits = np.array([0.0, 0.0, 0.0, 0.0, math.log(4)])
    result = gradient(lambda x: symexp_twohot_loss(x, 2.0, SMALL), logits)
    np.testing.assert_allclose(result, [0.125, 0.125, 0.125, 0.125 - 0.5, 0.5 - 0.5], atol=1e-9)
    np.testing.assert_array_equal(gradient(lambda target: symexp_twohot_loss(logits, target, SMALL), 2.0), 0)


def test_bernoulli_gradient_and_nan():
    logits = np.array([-3.0, 0.0, 2.0])
    np.testing.assert_allclose(
        gradient(lambda x: bernoulli_loss(x, [0.3] * 3), logits), bernoulli_mean(logits) - 0.3, atol=1e-8
    )
    assert np.isnan(bernoulli_loss([np.nan] * 2, [0.0, 1.0])).all()


def test_a_value_far_from_a_normal():
    assert normal_log_prob(0.0, 1.0, 1e200) == -np.inf


def test_normal_gradients_stop_at_the_sample():
    # d ln p / d mean = (value - mean) / std**2 = -1.25; through the sample as well it would be 0.
    result = gradient(lambda mean: normal_log_prob(mean, 0.8, normal_sample(mean, 0.8, -1.0)), 0.5)
    assert result == pytest.approx(-1.25, rel=1e-7)
    np.testing.assert_array_equal(gradient(lambda value: normal_log_prob(0.5, 0.8, value), -0.3), 0)


def test_squared_errors():
    assert np.isnan(mse_loss(np.inf, np.inf))
    assert gradient(lambda target: symlog_mse_loss(1.0, target, 0.5), 3.0) == 0
    assert gradient(lambda prediction: mse_loss(prediction, 3.0), 1.0) == pytest.approx(-4.0)


@pytest.mark.parametrize(
    ("call", "argument"),
    [
        (lambda: categorical_sample(np.zeros((2, 3)), 0.5), "uniform"),
        (lambda: straight_through(np.zeros((2, 3)), np.zeros(3)), "sample"),
        (lambda: categorical_log_prob(np.zeros((2, 3)), np.zeros((2, 2))), "onehot"),
        (lambda: categorical_kl(np.zeros((2, 3)), np.zeros(3)), "log_probs_q"),
        (lambda: symexp_twohot_loss(np.zeros((2, 5)), 1.0, SMALL), "target"),
        (lambda: symexp_twohot_mean(np.zeros((2, 4)), SMALL), "logits"),
        (lambda: bernoulli_loss(np.zeros(2), 1.0), "target"),
        (lambda: bounded_normal(np.zeros(2), np.zeros(3), 0.1, 1.0), "std"),
        (lambda: normal_sample(np.zeros(2), np.ones(2), 0.0), "normal"),
        (lambda: normal_log_prob(np.zeros(2), np.ones(2), 0.0), "value"),
        (lambda: mse_loss(np.zeros((2, 3)), np.zeros((2, 1))), "target"),
        (lambda: symlog_mse_loss(np.zeros(2), 0.0, 0.5), "target"),
        (lambda: unimix_log_probs(0.0, 0.01), "logits"),
    ],
)
def test_wrong_shapes(call, argument):
    with pytest.raises(ValueError, match=argument):
        call()
