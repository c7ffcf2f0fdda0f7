"""Clipping, warmup, LaProp, steps: edge cases. The numbers of spec/09-optimizer.md are in tests/test_examples.py."""

import math

import numpy as np
import pytest

from reference_numpy.optimizer import adaptive_gradient_clip, laprop, learning_rate, optimizer_step
from spec.config import load_config

PAPER, OFFICIAL = load_config("paper"), load_config("official")


def updates_of(gradients, config):
    """The updates of one parameter over a list of gradients."""
    second_moment = momentum = np.zeros(1)
    for step, gradient in enumerate(gradients):
        update, second_moment, momentum = laprop([gradient], second_moment, momentum, step, config)
        yield update[0]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_non_finite_tensors_become_nan(bad):
    """[OPT-5]"""
    assert np.isnan(adaptive_gradient_clip([bad, 1.0], [3.0, 4.0], 0.3, 1e-3)).all()
    assert np.isnan(adaptive_gradient_clip([0.1, 0.1], [bad, 4.0], 0.3, 1e-3)).all()


def test_learning_that_a_warmup_costs():
    """[OPT-6]"""
    np.testing.assert_allclose(sum(1 - learning_rate(step, OFFICIAL) / 4e-5 for step in range(1000)), 500.5, rtol=1e-12)
    with pytest.raises(ValueError, match="step"):
        learning_rate(-1, PAPER)


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


@pytest.mark.covers("OPT-14")
def test_betas_outside_their_range_are_refused():
    """[OPT-14]"""
    for name in ("beta1", "beta2"):
        for value in (1, 1.5, -0.1):
            with pytest.raises(ValueError, match=name):
                load_config(**{name: value})


def fresh(params):
    zeros = {name: np.zeros_like(value) for name, value in params.items()}
    return {"step": 0, "second_moment": zeros, "momentum": dict(zeros)}


def test_a_step_leaves_its_arguments_alone():
    """[OPT-15]"""
    params, gradients = {"kernel": np.array([3.0, 4.0])}, {"kernel": np.array([6.0, -8.0])}
    optimizer_step(params, gradients, fresh(params), PAPER)
    np.testing.assert_array_equal(params["kernel"], [3, 4])
    np.testing.assert_array_equal(gradients["kernel"], [6, -8])


def test_steps_are_updates_times_the_learning_rate():
    """[OPT-15]: the parameter is large, so nothing is clipped."""
    gradients, params = (0.5, -0.25, 0.0), {"w": np.array([10.0])}
    state = fresh(params)
    for gradient in gradients:
        params, state = optimizer_step(params, {"w": np.array([gradient])}, state, PAPER)
    np.testing.assert_allclose((10 - params["w"]) / 4e-5, sum(updates_of(gradients, PAPER)), rtol=1e-9)
    assert state["step"] == 3


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
