"""Actions, actor and critic losses, slow critic: gradients by central differences, and edge cases.

The numbers of spec/08-behavior.md are in tests/test_examples.py.
"""

import math

import numpy as np
import pytest

from reference_numpy.behavior import (
    action_log_prob,
    actor_loss,
    critic_loss,
    replay_critic_loss,
    sample_action,
    update_slow_critic,
)
from reference_numpy.stop_gradient import recording, replaying
from spec.config import load_config
from spec.spaces import Discrete, Spaces, Vector

CONFIG = load_config()
OBSERVATIONS = {"x": Vector(1)}
MIXED = Spaces(OBSERVATIONS, {"turn": Vector(2), "buttons": Discrete((2, 3))})
ONE_NORMAL = Spaces(OBSERVATIONS, {"a": Vector(1)})
ONE_CATEGORICAL = Spaces(OBSERVATIONS, {"a": Discrete((2,))})
STD_AT_ZERO = 0.9 / (1 + math.exp(-2)) + 0.1


def derivative(function, x, step=1e-6):
    """Central difference at the scalar x, constants recorded at x."""
    with recording() as tape:
        function(x)
    with replaying(tape):
        upper = function(x + step)
    with replaying(tape):
        lower = function(x - step)
    return (upper - lower) / (2 * step)


def normal_outputs(mean=0.0, std=0.0):
    return {"a": {"mean": np.array([mean]), "std": np.array([std])}}


def test_score_gradient_of_a_sampled_action():
    """[BEH-5]: (a - mean) / std^2; with an attached sample it would be 0."""

    def log_prob(mean):
        outputs = normal_outputs(mean=mean)
        return action_log_prob(outputs, sample_action(outputs, [1.5], ONE_NORMAL, CONFIG), ONE_NORMAL, CONFIG)

    np.testing.assert_allclose(derivative(log_prob, 0.0), 1.5 / STD_AT_ZERO, atol=1e-6)


def test_actor_loss_gradients():
    """[BEH-10]: through log-probability and entropy only."""
    base = {"log_prob": -1.0, "entropy": 0.5, "returns": 3.0, "value": 1.0, "weight": 0.9}

    def loss(name):
        def function(x):
            arguments = {key: [[x if key == name else number]] for key, number in base.items()}
            return actor_loss(**arguments, scale=x if name == "scale" else 4.0, config=CONFIG)[0, 0]

        return function

    expected = {"log_prob": -0.45, "entropy": -0.9 * 3e-4, "returns": 0, "value": 0, "weight": 0, "scale": 0}
    got = {name: derivative(loss(name), base.get(name, 4.0)) for name in expected}
    assert got == pytest.approx(expected, abs=1e-9)


def test_critic_loss_gradients():
    """[BEH-13]: softmax minus twohot, twice, times the weight, for the logits; nothing for the rest."""
    zeros = np.zeros((1, 1, 255))

    def along(x, index):
        shifted = zeros.copy()
        shifted[0, 0, index] = x
        return shifted

    at_zero_bin = derivative(lambda x: critic_loss(along(x, 127), zeros, [[0.0]], [[0.5]], CONFIG)[0, 0], 0.0)
    np.testing.assert_allclose(at_zero_bin, 0.5 * 2 * (1 / 255 - 1), atol=1e-9)
    assert derivative(lambda x: critic_loss(zeros, along(x, 130), [[0.0]], [[0.5]], CONFIG)[0, 0], 0.0) == 0
    assert derivative(lambda x: critic_loss(along(1, 3), zeros, [[x]], [[0.5]], CONFIG)[0, 0], 0.3) == 0
    assert derivative(lambda x: critic_loss(zeros, zeros, [[0.0]], [[x]], CONFIG)[0, 0], 0.5) == 0


def test_flags_of_the_replay_critic_loss_are_booleans_or_numbers():
    """[BEH-14]"""
    logits = np.zeros((1, 3, 255))
    one, two = (
        replay_critic_loss(logits, logits, [[1.0, 2.0, 3.0]], flags, CONFIG)
        for flags in ([[0, 1, 0]], [[False, True, False]])
    )
    np.testing.assert_array_equal(one, two)


def test_replay_critic_loss_of_no_steps():
    """[BEH-14]: T = 1."""
    assert replay_critic_loss(
        np.zeros((2, 0, 255)), np.zeros((2, 0, 255)), np.zeros((2, 0)), np.zeros((2, 0)), CONFIG
    ).shape == (2, 0)


def test_replay_critic_loss_gradients():
    """[BEH-15]"""
    zeros = np.zeros((1, 1, 255))

    def along(x):
        shifted = zeros.copy()
        shifted[0, 0, 127] = x
        return shifted

    through = derivative(lambda x: replay_critic_loss(along(x), zeros, [[0.0]], [[0]], CONFIG)[0, 0], 0.0)
    np.testing.assert_allclose(through, 2 * (1 / 255 - 1), atol=1e-9)
    assert derivative(lambda x: replay_critic_loss(zeros, along(x), [[0.0]], [[0]], CONFIG)[0, 0], 0.0) == 0
    assert derivative(lambda x: replay_critic_loss(along(1), zeros, [[x]], [[0]], CONFIG)[0, 0], 0.3) == 0


@pytest.mark.parametrize(
    "critic",
    [
        {"critic/a": [1.0]},
        {"critic/a": [1.0], "critic/b": [1.0, 2.0]},
        {"critic/a": [1.0], "critic/b": [1.0], "critic/c": [1.0]},
    ],
)
def test_update_slow_critic_refuses_other_names_and_shapes(critic):
    """[BEH-20]"""
    with pytest.raises(ValueError, match=r"critic/[bc]"):
        update_slow_critic({"critic/a": [1.0], "critic/b": [1.0]}, critic, 0.98)


def test_nan_is_not_repaired():
    """[BEH-24]: also under weight 0."""
    loss = actor_loss([[-1.0, -1.0]], [[0.0, 0.0]], [[math.nan, 1.0]], [[0.0, 0.0]], [[0.0, 0.0]], 1.0, CONFIG)
    np.testing.assert_array_equal(np.isnan(loss), [[True, False]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sample_action({}, [0.5], ONE_CATEGORICAL, CONFIG), "outputs: missing 'a'"),
        (lambda: sample_action({"a": {"mean": [0.0]}}, [0.5], ONE_NORMAL, CONFIG), r"outputs\['a'\]"),
        (lambda: sample_action({"a": {"logits": [0.0]}}, [0.5], ONE_CATEGORICAL, CONFIG), "logits"),
        (lambda: sample_action(normal_outputs(), [0.5, 0.5], ONE_NORMAL, CONFIG), "noise"),
        (lambda: action_log_prob(normal_outputs(), [[0.5]], ONE_NORMAL, CONFIG), "action"),
        (lambda: actor_loss([[0.0]], [0.0], [[0]], [[0]], [[0]], 1.0, CONFIG), "entropy"),
        (lambda: actor_loss([[0.0]], [[0.0]], [[0]], [[0, 1]], [[0]], 1.0, CONFIG), "value"),
        (lambda: actor_loss([[0.0]], [[0.0]], [[0]], [[0]], [[0]], [1.0], CONFIG), "scale"),
        (lambda: critic_loss(np.zeros((1, 1, 254)), np.zeros((1, 1, 255)), [[0]], [[0]], CONFIG), "logits"),
        (lambda: critic_loss(np.zeros((1, 1, 255)), np.zeros((1, 2, 255)), [[0]], [[0]], CONFIG), "slow_logits"),
        (lambda: replay_critic_loss(np.zeros((1, 1, 255)), np.zeros((1, 1, 255)), [[0, 1]], [[0]], CONFIG), "returns"),
    ],
)
def test_wrong_shapes_are_named(call, message):
    """[BEH-23]"""
    with pytest.raises(ValueError, match=message):
        call()
