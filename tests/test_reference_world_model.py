"""Numbers of spec/06-world-model.md that a reader can check by hand, and exact properties of the reference."""

import math

import numpy as np
import pytest

from reference_numpy import rssm, world_model
from reference_numpy.stop_gradient import recording, replaying
from spec import Discrete, Image, Spaces, Vector, load_config, parameter_table

ACTIONS = {"act": Discrete((3,))}
POSTERIOR = [0.0, math.log(3.0)]
ONE_KL = 0.128082135


def small_config(profile="paper", **overrides):
    values = {
        "units": 3,
        "deter": 4,
        "blocks": 2,
        "stoch": 2,
        "classes": 2,
        "cnn_depth": 2,
        "cnn_multipliers": (1, 1),
    } | overrides
    return load_config(profile, size="tiny", **values)


def logits(*latents):
    return np.array([latents])


@pytest.mark.parametrize(("kind", "going_on"), [("hard", 1.0), ("discounted", 1 - 1 / 333)])
def test_continue_target(kind, going_on):
    target = world_model.continue_target([[False, True], [True, False]], small_config(continue_target=kind))
    assert target.tolist() == [[going_on, 0.0], [0.0, going_on]]


@pytest.mark.parametrize(("stoch", "value"), [(2, 1.0), (7, 1.0), (8, 8 * ONE_KL), (10, 1.280821352)])
def test_kl_is_summed_over_latents_then_clipped(stoch, value):
    config = small_config(stoch=stoch)
    dynamics, representation = world_model.kl_losses(
        logits(*[POSTERIOR] * stoch), logits(*[[0.0, 0.0]] * stoch), config
    )
    np.testing.assert_allclose(dynamics, [value], rtol=1e-8)
    assert np.array_equal(dynamics, representation)


def test_kl_goes_from_posterior_to_prior():
    config = small_config(free_nats=0.0)
    forward, _ = world_model.kl_losses(logits(POSTERIOR, POSTERIOR), logits([0, 0], [0, 0]), config)
    backward, _ = world_model.kl_losses(logits([0, 0], [0, 0]), logits(POSTERIOR, POSTERIOR), config)
    np.testing.assert_allclose([forward[0], backward[0]], [2 * ONE_KL, 2 * 0.140535321], rtol=1e-8)


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
    assert (pytest.approx(0.245025, rel=1e-6), 0.0) == (dynamics, representation)
    dynamics, representation = slope(10, 1, 0)
    assert dynamics == 0.0
    # d/dl of sum q (ln q - ln p): 0.99 * 0.25 * 0.75 * (ln(q_0 / p_0) - ln(q_1 / p_1))
    assert representation == pytest.approx(0.185625 * (math.log(0.505) - math.log(1.495)), rel=1e-6)


def test_free_nats_leave_no_gradient():
    assert slope(7, 0, 1) == [0.0, 0.0]
    assert slope(7, 1, 0) == [0.0, 0.0]


def test_kl_keeps_nan_and_is_bounded():
    dynamics, representation = world_model.kl_losses(
        logits([np.nan, 0], [0, 0]), logits([0, 0], [0, 0]), small_config()
    )
    assert np.isnan([dynamics, representation]).all()
    config = load_config(size="200m")
    first, last = np.full((32, 64), -1e4), np.full((32, 64), -1e4)
    first[:, 0] = last[:, -1] = 1e4
    np.testing.assert_allclose(world_model.kl_losses(first, last, config)[0], 277.331813, rtol=1e-8)


@pytest.mark.parametrize(("profile", "value"), [("paper", 0.977056), ("official", 1.954111)])
def test_vector_loss(profile, value):
    spaces = Spaces({"x": Vector(2)}, ACTIONS)
    losses = world_model.reconstruction_losses({"x": [[1.0, 0.0]]}, {"x": [[10.0, 0.0]]}, spaces, small_config(profile))
    np.testing.assert_allclose(losses["x"], [value], atol=1e-6)


@pytest.mark.parametrize("profile", ["paper", "official"])
def test_discrete_loss(profile):
    spaces = Spaces({"kind": Discrete((2, 3))}, ACTIONS)
    prediction = [[0.0, math.log(3.0), 0.0, 0.0, 0.0]]
    losses = world_model.reconstruction_losses(
        {"kind": prediction}, {"kind": np.array([[0, 2]])}, spaces, small_config(profile)
    )
    np.testing.assert_allclose(losses["kind"], [math.log(4) + math.log(3)])
    with pytest.raises(ValueError, match=r"observations\['kind'\], entry 1: expected values in 0 \.\. 2, got 3"):
        world_model.reconstruction_losses({"kind": prediction}, {"kind": np.array([[0, 3]])}, spaces, small_config())


def test_image_loss():
    spaces = Spaces({"b": Image(2, 2, 1), "a": Image(2, 2, 3)}, ACTIONS)
    dark, bright = np.zeros((1, 2, 2, 3), np.uint8), np.zeros((1, 2, 2, 1), np.uint8)
    bright[0, 1, 1] = 255
    predictions = {"a": np.full((1, 2, 2, 3), 0.1), "b": np.full((1, 2, 2, 1), 0.5)}
    losses = world_model.reconstruction_losses(predictions, {"a": dark, "b": bright}, spaces, small_config())
    np.testing.assert_allclose(losses["a"], [12 * 0.01])
    np.testing.assert_allclose(losses["b"], [4 * 0.25])
    with pytest.raises(ValueError, match=r"observations\['b'\]: expected dtype uint8, got float32"):
        world_model.reconstruction_losses(
            predictions, {"a": dark, "b": bright.astype(np.float32)}, spaces, small_config()
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
    for kind, going_on in (("hard", 0.002475685), ("discounted", 0.002475685 + 6 / 333)):
        config = small_config(continue_target=kind)
        params, batch, states, spaces = full_case(config, zero=True)
        params["continue/out/bias"] = np.array([6.0])
        losses = world_model.world_model_losses(params, batch, states, spaces, config)["continue"]
        np.testing.assert_allclose(losses, [[going_on, going_on, 6.002475685], [going_on] * 3], rtol=1e-7)


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
