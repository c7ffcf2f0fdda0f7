"""Clipping, warmup, LaProp and the step: numbers from spec/09-optimizer.md."""

import math

import numpy as np
import pytest

from reference_numpy.optimizer import adaptive_gradient_clip, laprop, learning_rate, optimizer_step
from spec.config import load_config

PAPER, OFFICIAL = load_config("paper"), load_config("official")


def run_laprop(gradients, config):
    """Updates, second moments and momenta of one parameter over a list of gradients."""
    rows = []
    second_moment = momentum = np.zeros(1)
    for step, gradient in enumerate(gradients):
        update, second_moment, momentum = laprop([gradient], second_moment, momentum, step, config)
        rows.append((update[0], second_moment[0], momentum[0]))
    return np.array(rows)


@pytest.mark.parametrize(
    ("gradient", "parameter", "expected"),
    [
        ([6, 8], [3, 4], [0.9, 1.2]),
        ([0.6, 0.8], [3, 4], [0.6, 0.8]),
        ([0.9, 1.2], [3, 4], [0.9, 1.2]),
        ([0.003, 0.004], [0, 0], [0.00018, 0.00024]),
        ([0, 0], [0, 0], [0, 0]),
        ([[[6]], [[8]]], [[[3]], [[4]]], [[[0.9]], [[1.2]]]),
        (2.0, 0.5, 0.15),
    ],
)
def test_clip_by_hand(gradient, parameter, expected):
    """[OPT-1], [OPT-2], [OPT-4]: one norm for the whole tensor."""
    np.testing.assert_allclose(adaptive_gradient_clip(gradient, parameter, 0.3, 1e-3), expected, rtol=1e-14)


def test_clip_0_lets_no_gradient_through():
    """[OPT-4]"""
    np.testing.assert_array_equal(adaptive_gradient_clip([1.0, -2.0], [3.0, 4.0], 0.0, 1e-3), [0, 0])
    np.testing.assert_array_equal(adaptive_gradient_clip([0.0, 0.0], [0.0, 0.0], 0.0, 0.0), [0, 0])


def test_norms_survive_huge_and_tiny_entries():
    """[OPT-3]: the squares would be infinite, or zero."""
    np.testing.assert_allclose(adaptive_gradient_clip([6e200, 8e200], [3, 4], 0.3, 1e-3), [0.9, 1.2], rtol=1e-14)
    np.testing.assert_allclose(
        adaptive_gradient_clip([6e-200, 8e-200], [3e-200, 4e-200], 0.3, 0.0), [0.9e-200, 1.2e-200], rtol=1e-14
    )


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_non_finite_tensors_become_nan(bad):
    """[OPT-5]"""
    assert np.isnan(adaptive_gradient_clip([bad, 1.0], [3.0, 4.0], 0.3, 1e-3)).all()
    assert np.isnan(adaptive_gradient_clip([0.1, 0.1], [bad, 4.0], 0.3, 1e-3)).all()


def test_learning_rate():
    """[OPT-6]: the first warmup update has rate 0."""
    assert [learning_rate(step, PAPER) for step in (0, 1, 10**6)] == [4e-5] * 3
    np.testing.assert_allclose(
        [learning_rate(step, OFFICIAL) for step in (0, 1, 500, 1000, 5000)], [0, 4e-8, 2e-5, 4e-5, 4e-5], rtol=1e-15
    )
    assert learning_rate(0, OFFICIAL) == 0
    np.testing.assert_allclose(sum(1 - learning_rate(step, OFFICIAL) / 4e-5 for step in range(1000)), 500.5, rtol=1e-12)
    with pytest.raises(ValueError, match="step"):
        learning_rate(-1, PAPER)


def test_laprop_by_hand():
    """[OPT-8], [OPT-10], [OPT-11]: the table of the chapter. Adam's second update would be 0.2667."""
    expected = [[1, 0.0025, 0.1], [0.140310, 0.0031, 0.026659], [0.088535, 0.003069, 0.023993]]
    np.testing.assert_allclose(run_laprop([0.5, -0.25, 0.0], PAPER), expected, atol=5e-7)
    np.testing.assert_allclose(run_laprop([0.5, -0.25, 0.0], OFFICIAL)[:, 0], [1, 0.140763, 0.088821], atol=5e-7)


def test_first_update_is_the_sign():
    """[OPT-8]"""
    update, _, _ = laprop([1e-15, -3.0, 1e12], [0, 0, 0], [0, 0, 0], 0, PAPER)
    np.testing.assert_allclose(update, [1, -1, 1], rtol=2e-5)
    np.testing.assert_allclose(update[1:], [-1, 1], rtol=1e-15)


def test_dead_zone():
    """[OPT-9]: below 1e-16 a gradient is a zero, and every normalized entry keeps its bound."""
    update, second_moment, momentum = laprop([9e-17, -9e-17, 5e-324, 2e-16], np.zeros(4), np.zeros(4), 0, PAPER)
    np.testing.assert_array_equal(update[:3], [0, 0, 0])
    np.testing.assert_array_equal(second_moment[:3], [0, 0, 0])
    np.testing.assert_array_equal(momentum[:3], [0, 0, 0])
    np.testing.assert_allclose(update[3], 2e-16 / (2e-16 + 1e-20), rtol=1e-12)


def test_a_gradient_after_a_long_silence_moves_at_most_by_the_bound():
    """[OPT-8]: |u| <= sqrt((1 - beta2^t) / (1 - beta2)), 10 in the long run."""
    update, _, momentum = laprop([1e-3], [0.0], [0.0], 10**5, PAPER)
    np.testing.assert_allclose(momentum, [1.0], rtol=1e-6)
    np.testing.assert_allclose(update, [1.0], rtol=1e-6)


def test_zero_gradients_give_zero_updates():
    """[OPT-10]: never 0/0, also with epsilon 0, and the momentum of earlier gradients fades."""
    config = load_config(laprop_epsilon=0)
    update, second_moment, momentum = laprop([0.0, -0.0], [0.0, 0.0], [0.0, 0.5], 7, config)
    np.testing.assert_array_equal(second_moment, [0, 0])
    np.testing.assert_allclose(momentum, [0, 0.45], rtol=1e-15)
    np.testing.assert_allclose(update, [0, 0.45 / (1 - 0.9**8)], rtol=1e-15)


@pytest.mark.covers("OPT-14")
def test_betas_of_0_and_1():
    """[OPT-8], [OPT-14]"""
    update, second_moment, _ = laprop([-2.0], [5.0], [7.0], 3, load_config(beta1=0, beta2=0))
    np.testing.assert_allclose([update[0], second_moment[0]], [-1, 4], rtol=1e-15)
    for name in ("beta1", "beta2"):
        for value in (1, 1.5, -0.1):
            with pytest.raises(ValueError, match=name):
                load_config(**{name: value})


def fresh(params):
    zeros = {name: np.zeros_like(value) for name, value in params.items()}
    return {"step": 0, "second_moment": zeros, "momentum": dict(zeros)}


def test_step_by_hand():
    """[OPT-2], [OPT-15], [OPT-16]: clipped per tensor, then the sign times the learning rate, biases and scales too."""
    params = {"kernel": np.array([3.0, 4.0]), "bias": np.array([0.0]), "scale": np.array([1.0, 1.0])}
    gradients = {"kernel": np.array([6.0, -8.0]), "bias": np.array([0.01]), "scale": np.array([0.0, 0.1])}
    new, state = optimizer_step(params, gradients, fresh(params), PAPER)
    np.testing.assert_allclose(new["kernel"], [3 - 4e-5, 4 + 4e-5], rtol=1e-15)
    np.testing.assert_allclose(new["bias"], [-4e-5], rtol=1e-12)
    np.testing.assert_allclose(new["scale"], [1, 1 - 4e-5], rtol=1e-15)
    assert state["step"] == 1
    np.testing.assert_allclose(state["second_moment"]["kernel"], [0.01 * 0.9**2, 0.01 * 1.2**2], rtol=1e-13)
    np.testing.assert_allclose(state["second_moment"]["bias"], [0.01 * 3e-4**2], rtol=1e-13)
    np.testing.assert_allclose(state["momentum"]["kernel"], [0.1, -0.1], rtol=1e-13)
    np.testing.assert_array_equal(params["kernel"], [3, 4])
    np.testing.assert_array_equal(gradients["kernel"], [6, -8])


def test_two_steps_by_hand():
    """[OPT-15]: the table of the chapter times the learning rate; the parameter is large, so nothing is clipped."""
    params = {"w": np.array([10.0])}
    state = fresh(params)
    for gradient in (0.5, -0.25, 0.0):
        params, state = optimizer_step(params, {"w": np.array([gradient])}, state, PAPER)
    np.testing.assert_allclose((10 - params["w"]) / 4e-5, [1 + 0.140310 + 0.088535], atol=2e-6)
    assert state["step"] == 3


def test_first_warmup_update_changes_the_state_only():
    """[OPT-6], [OPT-7]"""
    params = {"w": np.array([10.0])}
    new, state = optimizer_step(params, {"w": np.array([0.5])}, fresh(params), OFFICIAL)
    np.testing.assert_array_equal(new["w"], [10.0])
    np.testing.assert_allclose([state["second_moment"]["w"][0], state["momentum"]["w"][0]], [0.00025, 0.1], rtol=1e-12)
    assert state["step"] == 1


def test_non_finite_gradients_are_not_repaired():
    """[OPT-20]: their tensor is lost, the others are not, also with learning rate 0."""
    params = {"a": np.array([3.0, 4.0]), "b": np.array([1.0])}
    for config in (PAPER, OFFICIAL):
        new, state = optimizer_step(
            params, {"a": np.array([math.inf, 0.0]), "b": np.array([0.1])}, fresh(params), config
        )
        assert np.isnan(new["a"]).all()
        assert np.isnan(state["second_moment"]["a"]).all()
        assert np.isnan(state["momentum"]["a"]).all()
        np.testing.assert_allclose(new["b"], [1 - learning_rate(0, config)], rtol=1e-15)
        assert state["step"] == 1


def test_names_and_shapes_must_match():
    """[OPT-18]"""
    params = {"a": np.array([1.0])}
    with pytest.raises(ValueError, match="gradients: missing 'a'"):
        optimizer_step(params, {}, fresh(params), PAPER)
    with pytest.raises(ValueError, match="gradients: unknown 'critic/b'"):
        optimizer_step(params, {"a": np.ones(1), "critic/b": np.ones(1)}, fresh(params), PAPER)
    with pytest.raises(ValueError, match=r"gradients: 'a': expected shape \[1\], got \[2\]"):
        optimizer_step(params, {"a": np.ones(2)}, fresh(params), PAPER)
    with pytest.raises(ValueError, match="momentum"):
        optimizer_step(params, {"a": np.ones(1)}, {**fresh(params), "momentum": {}}, PAPER)
