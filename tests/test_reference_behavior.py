"""Actions, actor and critic losses, slow critic: numbers from spec/08-behavior.md, and gradients by central
differences."""

import math

import numpy as np
import pytest

from reference_numpy.behavior import (
    action_entropy,
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
STD_AT_ZERO = 0.8927173701800941
LN3 = math.log(3)


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


def test_normal_action_is_not_clipped():
    """[BEH-4]: mean 0, standard deviation 0.892717, noise 1.5."""
    action = sample_action(normal_outputs(), [1.5], ONE_NORMAL, CONFIG)
    np.testing.assert_allclose(action, [1.3390760552701413], rtol=1e-14)


def test_normal_log_prob_is_that_of_the_raw_sample():
    """[BEH-6]"""
    action = sample_action(normal_outputs(), [1.5], ONE_NORMAL, CONFIG)
    log_prob = action_log_prob(normal_outputs(), action, ONE_NORMAL, CONFIG)
    np.testing.assert_allclose(log_prob, -1.125 - math.log(STD_AT_ZERO) - 0.9189385332046727, rtol=1e-14)
    np.testing.assert_allclose(log_prob, -1.930453, atol=5e-7)


def test_normal_entropy_between_its_bounds():
    """[BEH-7]: -0.883647 at the smallest deviation, 1.418939 at the largest."""
    entropies = [action_entropy(normal_outputs(std=std), ONE_NORMAL, CONFIG) for std in (-800.0, 0.0, 800.0)]
    np.testing.assert_allclose(entropies, [-0.883647, 1.305453, 1.418939], atol=5e-7)


@pytest.mark.parametrize(("uniform", "index"), [(0.0, 0), (0.74, 0), (0.7476, 1), (0.999, 1)])
def test_discrete_action_uses_the_mixture(uniform, index):
    """[BEH-2], [BEH-3]: 0.75 and 0.25 become 0.7475 and 0.2525."""
    action = sample_action({"a": {"logits": [LN3, 0.0]}}, [uniform], ONE_CATEGORICAL, CONFIG)
    np.testing.assert_array_equal(action, np.eye(2)[index])


def test_discrete_log_prob_and_entropy_use_the_mixture():
    """[BEH-2], [BEH-6], [BEH-7]"""
    outputs = {"a": {"logits": [[LN3, 0.0], [LN3, 0.0]]}}
    np.testing.assert_allclose(
        action_log_prob(outputs, np.eye(2), ONE_CATEGORICAL, CONFIG), [-0.291021, -1.376344], atol=5e-7
    )
    np.testing.assert_allclose(action_entropy(outputs, ONE_CATEGORICAL, CONFIG), [0.565065, 0.565065], atol=5e-7)
    plain = load_config("official")
    np.testing.assert_allclose(
        action_log_prob(outputs, np.eye(2), ONE_CATEGORICAL, plain), np.log([0.75, 0.25]), rtol=1e-14
    )


def test_flat_action_layout_and_noise_order():
    """[BEH-1]: buttons before turn; uniform, uniform, normal, normal."""
    outputs = {
        "turn": {"mean": [[0.0, 0.0]], "std": [[0.0, 0.0]]},
        "buttons": {"logits": [[0.0, 0.0, 0.0, 0.0, 0.0]]},
    }
    action = sample_action(outputs, [[0.6, 0.1, 2.0, -1.0]], MIXED, CONFIG)
    np.testing.assert_allclose(action, [[0, 1, 1, 0, 0, 2 * STD_AT_ZERO, -STD_AT_ZERO]], rtol=1e-14)
    # ln 1/2 + ln 1/3, and two normals: noise 2 and -1.
    expected = -math.log(6) - 2.5 - 2 * math.log(STD_AT_ZERO) - math.log(2 * math.pi)
    np.testing.assert_allclose(action_log_prob(outputs, action, MIXED, CONFIG), [expected], rtol=1e-14)
    np.testing.assert_allclose(
        action_entropy(outputs, MIXED, CONFIG), [math.log(6) + 2 * 1.305453290244865], rtol=1e-14
    )


def test_a_single_class_takes_its_uniform():
    """[BEH-1]: the noise of a certain choice is consumed."""
    spaces = Spaces(OBSERVATIONS, {"a": Discrete((1, 2))})
    np.testing.assert_array_equal(
        sample_action({"a": {"logits": [0.0, 0.0, 0.0]}}, [0.9, 0.2], spaces, CONFIG), [1, 1, 0]
    )


def test_score_gradient_of_a_sampled_action():
    """[BEH-5]: (a - mean) / std^2; with an attached sample it would be 0."""

    def log_prob(mean):
        outputs = normal_outputs(mean=mean)
        return action_log_prob(outputs, sample_action(outputs, [1.5], ONE_NORMAL, CONFIG), ONE_NORMAL, CONFIG)

    np.testing.assert_allclose(derivative(log_prob, 0.0), 1.680263, atol=1e-6)


def test_actor_loss_by_hand():
    """[BEH-9]: advantage 0.5, entropy with a plus inside the minus."""
    loss = actor_loss([[-0.2910209737]], [[0.5650650455]], [[3]], [[1]], [[0.9]], 4.0, CONFIG)
    np.testing.assert_allclose(loss, [[0.130806870602]], rtol=1e-9)


def test_actor_loss_falls_with_entropy_and_is_zero_without_weight():
    """[BEH-9]"""
    loss = actor_loss([[0.0, 0.0, -5.0]], [[1.0, 2.0, 1.0]], [[0, 0, 9]], [[0, 0, 0]], [[1, 1, 0]], 1.0, CONFIG)
    np.testing.assert_allclose(loss, [[-3e-4, -6e-4, 0]], rtol=1e-12)


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


def test_critic_loss_at_initialization():
    """[BEH-12]: two cross entropies of ln 255, whatever the target."""
    logits = np.zeros((1, 3, 255))
    loss = critic_loss(logits, logits, [[0.0, 123.0, -1e9]], [[1, 0.5, 0]], CONFIG)
    np.testing.assert_allclose(loss, [[11.082527090, 5.541263545, 0]], rtol=1e-9)


def test_slow_critic_target_is_the_twohot_of_its_mean():
    """[BEH-12]: halves on bins 127 and 129 become 0.927147 on 128 and 0.072853 on 129."""
    slow = np.full((1, 1, 255), -1e4)
    slow[0, 0, [127, 129]] = 0.0
    logits = np.zeros((1, 1, 255))
    logits[0, 0, 127] = 0.25
    # Return 0 sits on bin 127. The regularizer pulls on bins 128 and 129, whose logits are 0.
    log_sum = math.log(254 + math.exp(0.25))
    loss = critic_loss(logits, slow, [[0.0]], [[1.0]], CONFIG)
    np.testing.assert_allclose(loss, [[(log_sum - 0.25) + log_sum]], rtol=1e-12)
    logits[0, 0, 128] = 1.0
    log_sum = math.log(253 + math.exp(0.25) + math.e)
    loss = critic_loss(logits, slow, [[0.0]], [[1.0]], CONFIG)
    np.testing.assert_allclose(loss, [[(log_sum - 0.25) + (log_sum - 0.927146815)]], rtol=1e-9)
    switched_off = critic_loss(logits, slow, [[0.0]], [[1.0]], load_config(slow_critic_scale=0))
    np.testing.assert_allclose(switched_off, [[log_sum - 0.25]], rtol=1e-12)


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


def test_replay_critic_loss_masks_last_steps():
    """[BEH-14]: the flag of the step itself, as number or boolean."""
    logits = np.zeros((1, 3, 255))
    for flags in ([[0, 1, 0]], [[False, True, False]]):
        loss = replay_critic_loss(logits, logits, [[1.0, 2.0, 3.0]], flags, CONFIG)
        np.testing.assert_allclose(loss, [[11.082527090, 0, 11.082527090]], rtol=1e-9)
        np.testing.assert_allclose(loss.mean(), 2 / 3 * 11.082527090, rtol=1e-9)


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


def test_update_slow_critic():
    """[BEH-19]"""
    updated = update_slow_critic(
        {"critic/out/bias": [1.0, 5.0]}, {"critic/out/bias": [2.0, 5.0], "actor/out/bias": [9.0]}, 0.98
    )
    assert set(updated) == {"critic/out/bias"}
    np.testing.assert_allclose(updated["critic/out/bias"], [1.02, 5.0], rtol=1e-15)


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
