"""Exact properties of the recurrent model. The numbers of spec/04-rssm.md are in tests/test_examples.py."""

import math

import numpy as np
import pytest

from reference_numpy import rssm
from reference_numpy.stop_gradient import recording, replaying
from spec import Discrete, Spaces, Vector, load_config, parameter_table

TOKENS = 5
ACTION = 3


def small_config(**overrides):
    values = {"units": 3, "deter": 4, "blocks": 2, "stoch": 2, "classes": 3, "cnn_depth": 2} | overrides
    return load_config(size="tiny", **values)


def random_params(config, action=ACTION, tokens=TOKENS, seed=0):
    """Random RSSM parameters of every shape in the table, with `tokens` encoder outputs."""
    spaces = Spaces({"x": Vector(1)}, {"act": Vector(action)})
    generator = np.random.default_rng(seed)
    params = {}
    for name, entry in parameter_table(config, spaces).items():
        if name.startswith("rssm/"):
            shape = entry.shape if name != "rssm/posterior/hidden0/kernel" else (config.deter + tokens, config.units)
            params[name] = generator.normal(size=shape)
    return params


def zero_params(config, **kwargs):
    return {name: np.zeros_like(value) for name, value in random_params(config, **kwargs).items()}


def random_inputs(config, rows=3, steps=6, seed=1):
    generator = np.random.default_rng(seed)
    onehot = np.eye(config.classes)[generator.integers(config.classes, size=(rows, config.stoch))]
    return {
        "carry": {"deter": generator.normal(size=(rows, config.deter)), "stoch": onehot},
        "tokens": generator.normal(size=(rows, steps, TOKENS)),
        "prev_action": generator.normal(size=(rows, steps, ACTION)),
        "is_first": np.zeros((rows, steps), bool),
        "uniform": generator.uniform(size=(rows, steps, config.stoch)),
    }


def run(params, inputs, config):
    return rssm.observe(params, **inputs, config=config)


def test_input_of_the_blocks(monkeypatch):
    config = small_config(units=1)
    embeddings = {"rssm/embed_deter": [7.0], "rssm/embed_stoch": [8.0], "rssm/embed_action": [9.0]}
    seen = []
    original = rssm.block_linear
    monkeypatch.setattr(rssm, "dense", lambda params, name, x, epsilon: np.array(embeddings[name]))
    monkeypatch.setattr(rssm, "block_linear", lambda x, kernel, bias: (seen.append(x), original(x, kernel, bias))[1])
    rssm.core(zero_params(config), [1.0, 2.0, 3.0, 4.0], np.zeros((2, 3)), np.zeros(ACTION), config)
    assert seen[0].tolist() == [1, 2, 7, 8, 9, 3, 4, 7, 8, 9]


def test_embedded_values(monkeypatch):
    """The action is squashed with a constant denominator, and the latents are flattened class by class."""
    config = small_config()
    seen = {}
    original = rssm.dense
    monkeypatch.setattr(
        rssm, "dense", lambda params, name, x, epsilon: (seen.update({name: x}), original(params, name, x, epsilon))[1]
    )
    stoch = [[0, 1, 0], [0, 0, 1]]
    with recording() as tape:
        rssm.core(zero_params(config), np.zeros(4), stoch, [-3.0, 0.5, 2.0], config)
    assert seen["rssm/embed_action"].tolist() == [-1.0, 0.5, 1.0]
    assert seen["rssm/embed_stoch"].tolist() == [0, 1, 0, 0, 0, 1]
    with replaying(tape):
        rssm.core(zero_params(config), np.zeros(4), stoch, [-3.3, 0.6, 2.2], config)
    np.testing.assert_allclose(seen["rssm/embed_action"], [-1.1, 0.6, 1.1])


def test_logits_of_prior_and_posterior():
    config = small_config()
    bias = np.arange(6.0)
    params = zero_params(config) | {"rssm/prior/out/bias": bias, "rssm/posterior/out/bias": -bias}
    assert rssm.prior(params, np.ones((7, 4)), config)[6].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert rssm.posterior(params, np.ones((7, 4)), np.ones((7, TOKENS)), config)[6].tolist() == [
        [0, -1, -2],
        [-3, -4, -5],
    ]


def test_posterior_reads_memory_then_tokens(monkeypatch):
    config = small_config()
    seen = []
    original = rssm.mlp
    monkeypatch.setattr(
        rssm, "mlp", lambda params, name, x, *rest: (seen.append(x), original(params, name, x, *rest))[1]
    )
    rssm.posterior(zero_params(config), [1.0, 2, 3, 4], [5.0, 6, 7, 8, 9], config)
    assert seen[0].tolist() == [1, 2, 3, 4, 5, 6, 7, 8, 9]


def test_straight_through_gradient():
    """dz/dlogit is that of the mixed probabilities: 0.99 * p * (1 - p) on the diagonal."""
    config = small_config(stoch=1, classes=2)
    params = zero_params(config) | {"rssm/posterior/out/bias": np.array([0.0, math.log(3.0)])}
    arguments = (
        {"deter": np.zeros((1, 4)), "stoch": np.zeros((1, 1, 2))},
        np.zeros((1, TOKENS)),
        np.zeros((1, ACTION)),
        [False],
        [[0.1]],
    )
    with recording() as tape:
        rssm.observe_step(params, *arguments, config)
    samples = []
    for step in (1e-5, -1e-5):
        moved = params | {"rssm/posterior/out/bias": np.array([step, math.log(3.0)])}
        with replaying(tape):
            samples.append(rssm.observe_step(moved, *arguments, config)[0]["stoch"][0, 0])
    slope = 0.99 * 0.25 * 0.75
    np.testing.assert_allclose((samples[0] - samples[1]) / 2e-5, [slope, -slope], rtol=1e-6)


def test_reset_equals_fresh_start():
    config = small_config()
    params, inputs = random_params(config), random_inputs(config)
    inputs["is_first"][1, 3] = True
    whole = run(params, inputs, config)

    rest = {name: inputs[name][:, 3:].copy() for name in ("tokens", "prev_action", "is_first", "uniform")}
    rest["is_first"][1, 0] = False
    rest["prev_action"][1, 0] = 0.0
    carry = {name: whole[name][:, 2].copy() for name in ("deter", "stoch")}
    carry["deter"][1] = 0.0
    carry["stoch"][1] = 0.0
    fresh = run(params, {"carry": carry, **rest}, config)
    for name in fresh:
        assert np.array_equal(whole[name][:, 3:], fresh[name]), name
    unreset = run(params, inputs | {"is_first": np.zeros((3, 6), bool)}, config)
    assert not np.array_equal(whole["deter"][1, 3], unreset["deter"][1, 3])
    assert np.array_equal(whole["deter"][[0, 2]], unreset["deter"][[0, 2]])


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_reset_ignores_what_was_there(bad):
    config = small_config()
    params, inputs = random_params(config), random_inputs(config)
    inputs["is_first"][:, 0] = True
    clean = run(params, inputs, config)
    inputs["carry"] = {name: np.full_like(value, bad) for name, value in inputs["carry"].items()}
    inputs["prev_action"][:, 0] = bad
    dirty = run(params, inputs, config)
    assert all(np.array_equal(clean[name], dirty[name]) for name in clean)


def test_observe_is_repeated_steps():
    config = small_config()
    params, inputs = random_params(config), random_inputs(config)
    inputs["is_first"][0, 2] = inputs["is_first"][2, 0] = True
    whole = run(params, inputs, config)
    carry = inputs["carry"]
    for t in range(6):
        arguments = (inputs[name][:, t] for name in ("tokens", "prev_action", "is_first", "uniform"))
        carry, logits = rssm.observe_step(params, carry, *arguments, config)
        for name, value in {**carry, "logits": logits}.items():
            assert np.array_equal(whole[name][:, t], value)
    np.testing.assert_array_equal(whole["stoch"].sum(-1), 1.0)
    assert set(np.unique(whole["stoch"])) == {0.0, 1.0}


@pytest.mark.parametrize("reset", [False, True])
def test_gradient_does_not_cross_a_reset(reset):
    config = small_config()
    params, inputs = random_params(config), random_inputs(config)
    inputs["is_first"][:, 2] = reset
    with recording() as tape:
        before = run(params, inputs, config)
    moved = inputs["tokens"].copy()
    moved[:, :2] += 0.1
    with replaying(tape):
        after = run(params, inputs | {"tokens": moved}, config)
    assert not np.array_equal(before["logits"][:, 0], after["logits"][:, 0])
    assert np.array_equal(before["deter"][:, 2:], after["deter"][:, 2:]) == reset


def test_initial_carry_is_constant():
    config = small_config()
    params, inputs = random_params(config), random_inputs(config)
    with recording() as tape:
        before = run(params, inputs, config)
    carry = {name: value + 0.1 for name, value in inputs["carry"].items()}
    with replaying(tape):
        after = run(params, inputs | {"carry": carry}, config)
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_imagine():
    config = small_config()
    params, inputs = random_params(config), random_inputs(config)
    generator = np.random.default_rng(2)
    uniform, actions = generator.uniform(size=(3, 4, 2)), 2 * generator.normal(size=(4, 3, ACTION))
    calls = []

    def policy(feature, t):
        calls.append((t, feature))
        return actions[t]

    with recording() as tape:
        states = rssm.imagine(params, inputs["carry"], policy, uniform, config)
    assert {name: value.shape for name, value in states.items()} == {
        "deter": (3, 5, 4),
        "stoch": (3, 5, 2, 3),
        "action": (3, 4, ACTION),
    }
    assert [t for t, _ in calls] == [0, 1, 2, 3]
    assert np.array_equal(states["deter"][:, 0], inputs["carry"]["deter"])
    assert np.array_equal(states["stoch"][:, 0], inputs["carry"]["stoch"])
    for t in range(4):
        assert np.array_equal(states["action"][:, t], actions[t])
        assert np.array_equal(
            calls[t][1], np.concatenate([states["deter"][:, t], states["stoch"][:, t].reshape(3, 6)], -1)
        )
        deter = rssm.core(params, states["deter"][:, t], states["stoch"][:, t], actions[t], config)
        assert np.array_equal(states["deter"][:, t + 1], deter)
        probs = np.exp(rssm.unimix_log_probs(rssm.prior(params, deter, config), config.latent_unimix))
        index = (np.cumsum(probs, -1)[..., :-1] <= uniform[:, t, :, None]).sum(-1)
        assert np.array_equal(states["stoch"][:, t + 1], np.eye(3)[index])

    moved = {name: value + 0.01 for name, value in params.items()}
    with replaying(tape):
        replayed = rssm.imagine(moved, inputs["carry"], policy, uniform, config)
    assert all(np.array_equal(states[name], replayed[name]) for name in states)


def test_zeros_as_a_discrete_action_differ_from_class_zero():
    config = small_config()
    spaces = Spaces({"x": Vector(1)}, {"act": Discrete((3,))})
    assert spaces.action_size == ACTION
    params, inputs = random_params(config), random_inputs(config, steps=1)
    inputs["is_first"][:] = True
    reset = run(params, inputs, config)
    zeros = {"deter": np.zeros((3, 4)), "stoch": np.zeros((3, 2, 3))}
    inputs = inputs | {
        "carry": zeros,
        "is_first": np.zeros((3, 1), bool),
        "prev_action": np.tile([1.0, 0, 0], (3, 1, 1)),
    }
    assert not np.array_equal(reset["deter"], run(params, inputs, config)["deter"])


@pytest.mark.parametrize(
    ("name", "shape"),
    [("tokens", (3, 6, 4)), ("prev_action", (3, 5, 3)), ("is_first", (3,)), ("uniform", (3, 6, 2, 3))],
)
def test_wrong_shapes_are_refused(name, shape):
    config = small_config()
    params, inputs = random_params(config), random_inputs(config)
    with pytest.raises(ValueError, match=rf"{name}: expected shape .* got"):
        run(params, inputs | {name: np.zeros(shape)}, config)


def test_wrong_carry_is_refused():
    config = small_config()
    params, inputs = random_params(config), random_inputs(config)
    inputs["carry"]["stoch"] = inputs["carry"]["stoch"].reshape(3, 6)
    with pytest.raises(ValueError, match=r"carry\['stoch'\]: expected shape \[3, 2, 3\], got \[3, 6\]"):
        run(params, inputs, config)
