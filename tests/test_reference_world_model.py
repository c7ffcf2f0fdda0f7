"""Exact properties of the world model's losses. The numbers of spec/06-world-model.md are in tests/test_examples.py."""

import math

import numpy as np
import pytest

from reference_numpy import rssm, world_model
from reference_numpy.distributions import bernoulli_loss
from reference_numpy.stop_gradient import recording, replaying
from spec import Discrete, Image, Spaces, Vector, load_config, parameter_table

ACTIONS = {"act": Discrete((3,))}
POSTERIOR = [0.0, math.log(3.0)]


def small_config(**overrides):
    values = {
        "units": 3,
        "deter": 4,
        "blocks": 2,
        "stoch": 2,
        "classes": 2,
        "cnn_depth": 2,
        "cnn_multipliers": (1, 1),
    } | overrides
    return load_config(size="tiny", **values)


def logits(*latents):
    return np.array([latents])


def test_clipping_is_per_element():
    """Summed KLs of 0.2, 0.4, 3 and 0.4 nats become 1, 1, 3, 1. Without mixture a binary posterior can have any KL
    below ln 2."""
    config = small_config(stoch=5, latent_unimix=0.0)
    rows = []
    for nats in (0.2, 0.4, 3.0, 0.4):
        low, high = 0.5, 1.0 - 1e-12
        for _ in range(200):  # bisection: KL(p, 1/2) = ln 2 - entropy(p)
            middle = (low + high) / 2
            kl = math.log(2) + middle * math.log(middle) + (1 - middle) * math.log(1 - middle)
            low, high = (middle, high) if kl < nats / 5 else (low, middle)
        rows.append([[math.log(low), math.log(1 - low)]] * 5)
    dynamics, representation = world_model.kl_losses(rows, np.zeros((4, 5, 2)), config)
    np.testing.assert_allclose(dynamics, [1.0, 1.0, 3.0, 1.0], rtol=1e-9)
    np.testing.assert_allclose(representation.mean(), 1.5, rtol=1e-9)


def slope(stoch, move_posterior, move_prior):
    """Central difference of both losses when the first logit of the first latent moves, with constants held."""
    config = small_config(stoch=stoch)
    posterior, prior = logits(*[POSTERIOR] * stoch), logits(*[[0.0, 0.0]] * stoch)
    with recording() as tape:
        world_model.kl_losses(posterior, prior, config)
    values = []
    for step in (1e-5, -1e-5):
        moved = [posterior.copy(), prior.copy()]
        moved[0][0, 0, 0] += move_posterior * step
        moved[1][0, 0, 0] += move_prior * step
        with replaying(tape):
            values.append(np.concatenate(world_model.kl_losses(*moved, config)))
    return ((values[0] - values[1]) / 2e-5).tolist()


def test_stop_gradients_of_the_kl():
    dynamics, representation = slope(10, 0, 1)
    assert (pytest.approx(0.99 * 0.25 * 0.495 / 0.5, rel=1e-6), 0.0) == (dynamics, representation)
    dynamics, representation = slope(10, 1, 0)
    assert dynamics == 0.0
    # d/dl of sum q (ln q - ln p): 0.99 * 0.25 * 0.75 * (ln(q_0 / p_0) - ln(q_1 / p_1))
    assert representation == pytest.approx(0.185625 * (math.log(0.505) - math.log(1.495)), rel=1e-6)


def test_free_nats_leave_no_gradient():
    assert slope(7, 0, 1) == [0.0, 0.0]
    assert slope(7, 1, 0) == [0.0, 0.0]


def test_kl_keeps_nan():
    dynamics, representation = world_model.kl_losses(
        logits([np.nan, 0], [0, 0]), logits([0, 0], [0, 0]), small_config()
    )
    assert np.isnan([dynamics, representation]).all()


def test_wrong_observations_are_refused():
    spaces = Spaces({"kind": Discrete((2, 3))}, ACTIONS)
    with pytest.raises(ValueError, match=r"observations\['kind'\], entry 1: expected values in 0 \.\. 2, got 3"):
        world_model.reconstruction_losses(
            {"kind": np.zeros((1, 5))}, {"kind": np.array([[0, 3]])}, spaces, small_config()
        )
    spaces = Spaces({"view": Image(2, 2, 1)}, ACTIONS)
    with pytest.raises(ValueError, match=r"observations\['view'\]: expected dtype uint8, got float32"):
        world_model.reconstruction_losses(
            {"view": np.zeros((1, 2, 2, 1))}, {"view": np.zeros((1, 2, 2, 1), np.float32)}, spaces, small_config()
        )


def full_case(config, zero=False):
    spaces = Spaces({"view": Image(4, 4, 1), "x": Vector(2), "kind": Discrete((2, 3))}, ACTIONS)
    generator = np.random.default_rng(0)
    params = {
        name: np.zeros(entry.shape) if zero else generator.normal(size=entry.shape)
        for name, entry in parameter_table(config, spaces).items()
    }
    batch = {
        "view": np.full((2, 3, 4, 4, 1), 255, np.uint8),
        "x": np.zeros((2, 3, 2)),
        "kind": np.zeros((2, 3, 2), int),
        "reward": np.array([[0.0, 1.0, -5.0], [1e12, 0.5, 0.0]]),
        "is_first": np.array([[True, False, False], [False, False, True]]),
        "is_last": np.array([[False, False, True], [False, True, False]]),
        "is_terminal": np.array([[False, False, True], [False, False, False]]),
    }
    states = {
        "deter": generator.normal(size=(2, 3, 4)),
        "stoch": np.eye(2)[generator.integers(2, size=(2, 3, 2))],
        "logits": generator.normal(size=(2, 3, 2, 2)),
    }
    return params, batch, states, spaces


def test_losses_of_an_agent_that_knows_nothing():
    config = small_config()
    params, batch, states, spaces = full_case(config, zero=True)
    losses = world_model.world_model_losses(params, batch, states, spaces, config)
    expected = {
        "reconstruction/kind": math.log(2) + math.log(3),
        "reconstruction/view": 16 * 0.25,
        "reconstruction/x": 0.0,
        "reward": math.log(255),
        "continue": math.log(2),
        "dynamics": 1.0,
        "representation": 1.0,
    }
    assert list(losses) == list(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(losses[name], np.full((2, 3), value), rtol=1e-12, err_msg=name)


def test_continue_loss_follows_terminations_only():
    for kind, target in (("hard", 1.0), ("discounted", 1 - 1 / 333)):
        going_on, ending = bernoulli_loss([6.0, 6.0], [target, 0.0])
        config = small_config(continue_target=kind)
        params, batch, states, spaces = full_case(config, zero=True)
        params["continue/out/bias"] = np.array([6.0])
        losses = world_model.world_model_losses(params, batch, states, spaces, config)["continue"]
        np.testing.assert_allclose(losses, [[going_on, going_on, ending], [going_on] * 3], rtol=1e-12)


def test_weights_are_not_applied():
    params, batch, states, spaces = full_case(small_config())
    plain = world_model.world_model_losses(params, batch, states, spaces, small_config())
    names = ("reconstruction", "reward", "continue", "dynamics", "representation")
    scaled = world_model.world_model_losses(
        params, batch, states, spaces, small_config(**{f"{name}_scale": 7.0 for name in names})
    )
    assert all(np.array_equal(plain[name], scaled[name]) for name in plain)


def test_prior_comes_from_the_same_step():
    config = small_config(free_nats=0.0)
    params, batch, states, spaces = full_case(config)
    losses = world_model.world_model_losses(params, batch, states, spaces, config)
    prior = rssm.prior(params, states["deter"][1, 2], config)
    expected, _ = world_model.kl_losses(states["logits"][1, 2], prior, config)
    np.testing.assert_allclose(losses["dynamics"][1, 2], expected)


def test_missing_keys_and_wrong_shapes_are_refused():
    config = small_config()
    params, batch, states, spaces = full_case(config)
    for key in ("reward", "is_terminal", "x", "view"):
        with pytest.raises(ValueError, match=f"batch: missing '{key}'"):
            world_model.world_model_losses(
                params, {name: batch[name] for name in batch if name != key}, states, spaces, config
            )
    with pytest.raises(ValueError, match=r"batch\['reward'\]: expected shape \[2, 3\], got \[2, 3, 1\]"):
        world_model.world_model_losses(params, batch | {"reward": np.zeros((2, 3, 1))}, states, spaces, config)
    with pytest.raises(ValueError, match=r"prior_logits: expected shape \[3, 2, 2\], got \[1, 2, 2\]"):
        world_model.kl_losses(np.zeros((3, 2, 2)), np.zeros((1, 2, 2)), config)
