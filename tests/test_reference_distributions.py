"""Literal numbers of spec/02-distributions.md."""

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
    normal_entropy,
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


def test_unimix():
    np.testing.assert_allclose(np.exp(MIXED), [0.7953333333333333, 0.1023333333333333, 0.1023333333333333], rtol=1e-13)
    np.testing.assert_allclose(np.exp(unimix_log_probs([math.log(8), 0.0, 0.0], 0.0)), [0.8, 0.1, 0.1], rtol=1e-13)
    np.testing.assert_allclose(unimix_log_probs([7.0, -3.0], 1.0), [-LN2, -LN2])
    assert unimix_log_probs([1e4] + [0.0] * 63, 0.01)[1] == pytest.approx(-8.764053269347762)


def test_log_softmax_is_stable():
    np.testing.assert_array_equal(unimix_log_probs([1e4, -1e4], 0.0), [0.0, -2e4])
    np.testing.assert_allclose(unimix_log_probs([1e30, 1e30], 0.01), [-LN2, -LN2])
    np.testing.assert_allclose(unimix_log_probs([1001.0, 1002.0], 0.0), unimix_log_probs([1.0, 2.0], 0.0), rtol=1e-12)


def test_special_logits():
    np.testing.assert_array_equal(unimix_log_probs([0.0, -np.inf], 0.0), [0.0, -np.inf])
    np.testing.assert_allclose(np.exp(unimix_log_probs([0.0, -np.inf], 0.01)), [0.995, 0.005], rtol=1e-13)
    for bad in ([np.nan, 0.0], [np.inf, 0.0], [-np.inf, -np.inf]):
        for unimix in (0.0, 0.01):
            assert np.isnan(unimix_log_probs(bad, unimix)).all()


@pytest.mark.parametrize(("uniform", "index"), [(0.0, 0), (0.79, 0), (0.8, 1), (0.9, 2), (0.999, 2)])
def test_sample(uniform, index):
    np.testing.assert_array_equal(categorical_sample(MIXED, uniform), np.eye(3)[index])


def test_sample_at_boundaries_and_zero_probabilities():
    np.testing.assert_array_equal(categorical_sample(np.log([0.5, 0.5]), 0.5), [0, 1])
    np.testing.assert_array_equal(categorical_sample([-np.inf, 0.0], 0.0), [0, 1])
    np.testing.assert_array_equal(categorical_sample([0.0], 0.99), [1])
    np.testing.assert_array_equal(
        categorical_sample(np.log([[0.2, 0.5, 0.3]] * 4), [0.1, 0.2, 0.69, 0.71]).argmax(-1), [0, 1, 1, 2]
    )
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


def test_log_prob_entropy_kl():
    assert categorical_log_prob(MIXED, [0.0, 1.0, 0.0]) == pytest.approx(-2.27951982, abs=1e-8)
    assert categorical_log_prob(MIXED, [0.0, 0.0, 0.0]) == 0
    assert categorical_entropy(MIXED) == pytest.approx(0.6486682566634715, rel=1e-12)
    p, q = np.log([0.5, 0.5]), np.log([0.25, 0.75])
    assert categorical_kl(p, q) == pytest.approx(0.14384103622589042, rel=1e-12)
    assert categorical_kl(q, p) == pytest.approx(0.13081203594113697, rel=1e-12)
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


def test_largest_kl_of_a_mixture():
    p = unimix_log_probs([1e4] + [0.0] * 63, 0.01)
    assert categorical_kl(p, p[::-1]) == pytest.approx(8.666619141830282, rel=1e-12)


def test_symexp_twohot():
    logits = [0.0, 0.0, 0.0, 0.0, math.log(4)]
    assert symexp_twohot_loss(logits, 2.0, SMALL) == pytest.approx(2 * LN2, rel=1e-13)
    assert symexp_twohot_mean(logits, SMALL) == pytest.approx(1.125, rel=1e-13)
    bins = exponential_bins(255)
    np.testing.assert_allclose(
        symexp_twohot_loss(np.zeros((3, 255)), [0.0, 12.3, -1e12], bins), [5.541263545158426] * 3, rtol=1e-13
    )
    np.testing.assert_array_equal(symexp_twohot_mean(np.full((2, 255), 3.7), bins), [0.0, 0.0])
    assert np.isnan(symexp_twohot_loss(np.zeros(255), np.nan, bins))


def test_symexp_twohot_gradient():
    logits = np.array([0.0, 0.0, 0.0, 0.0, math.log(4)])
    result = gradient(lambda x: symexp_twohot_loss(x, 2.0, SMALL), logits)
    np.testing.assert_allclose(result, [0.125, 0.125, 0.125, 0.125 - 0.5, 0.5 - 0.5], atol=1e-9)
    np.testing.assert_array_equal(gradient(lambda target: symexp_twohot_loss(logits, target, SMALL), 2.0), 0)


@pytest.mark.parametrize(
    ("logit", "target", "loss"),
    [
        (0.0, 1.0, LN2),
        (2.0, 1.0, 0.1269280110429725),
        (2.0, 0.0, 2.1269280110429727),
        (2.0, 0.997, 0.1329280110429725),
        (1e4, 0.0, 1e4),
        (-1e4, 1.0, 1e4),
        (1e4, 1.0, 0.0),
        (-1e4, 0.0, 0.0),
        (1e4, 1 - 1 / 333, 30.03003003003),
        (np.inf, 1.0, 0.0),
        (np.inf, 0.5, np.inf),
        (-np.inf, 0.0, 0.0),
        (-np.inf, 1.0, np.inf),
    ],
)
def test_bernoulli_loss(logit, target, loss):
    assert bernoulli_loss(logit, target) == pytest.approx(loss, rel=1e-12)


def test_bernoulli_gradient_and_mean():
    logits = np.array([-3.0, 0.0, 2.0])
    np.testing.assert_allclose(
        gradient(lambda x: bernoulli_loss(x, [0.3] * 3), logits), bernoulli_mean(logits) - 0.3, atol=1e-8
    )
    np.testing.assert_allclose(
        bernoulli_mean([-np.inf, -2.0, 0.0, 2.0, np.inf]), [0, 0.11920292202211755, 0.5, 0.8807970779778823, 1]
    )
    assert bernoulli_mean(-100.0) == pytest.approx(3.720075976020836e-44, rel=1e-12)
    assert np.isnan(bernoulli_loss([np.nan] * 2, [0.0, 1.0])).all()


def test_bounded_normal():
    mean, std = bounded_normal([0.0, 0.5, np.inf], [0.0, -np.inf, np.inf], 0.1, 1.0)
    np.testing.assert_allclose(mean, [0.0, 0.46211715726000974, 1.0], rtol=1e-13)
    np.testing.assert_allclose(std, [0.8927173701800941, 0.1, 1.0], rtol=1e-13)


def test_normal():
    assert normal_sample(0.5, 0.8, -1.0) == pytest.approx(-0.3)
    assert normal_log_prob(0.5, 0.8, -0.3) == pytest.approx(-1.195794981890463, rel=1e-12)
    np.testing.assert_allclose(normal_entropy([1.0, 0.1]), [1.4189385332046727, -0.8836465597893728], rtol=1e-13)
    assert normal_log_prob(0.0, 1.0, 1e200) == -np.inf


def test_normal_gradients_stop_at_the_sample():
    # d ln p / d mean = (value - mean) / std**2 = -1.25; through the sample as well it would be 0.
    result = gradient(lambda mean: normal_log_prob(mean, 0.8, normal_sample(mean, 0.8, -1.0)), 0.5)
    assert result == pytest.approx(-1.25, rel=1e-7)
    np.testing.assert_array_equal(gradient(lambda value: normal_log_prob(0.5, 0.8, value), -0.3), 0)


def test_squared_errors():
    np.testing.assert_array_equal(mse_loss([1.0, -2.0, np.inf], [3.0, -2.0, 1.0]), [4.0, 0.0, np.inf])
    assert np.isnan(mse_loss(np.inf, np.inf))
    assert symlog_mse_loss(1.0, 3.0, 0.5) == pytest.approx(0.07461166671651222, rel=1e-13)
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
