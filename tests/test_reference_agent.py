import copy
import math

import numpy as np
import pytest

from reference_numpy.agent import (
    directional_derivative,
    flatten_state,
    initial_parameters,
    initial_state,
    losses,
    policy_step,
    train_step,
    unflatten_state,
)
from reference_numpy.stop_gradient import recording, replaying, stop_gradient
from spec.config import load_config
from spec.parameters import parameter_table
from spec.spaces import Discrete, Image, Spaces, Vector

LN_255 = math.log(255)
TOY = Spaces({"vector": Vector(3)}, {"move": Discrete((2,))})
RICH = Spaces(
    {"image": Image(16, 16, 1), "code": Discrete((2, 3)), "vector": Vector(2)},
    {"turn": Vector(2), "buttons": Discrete((2, 3))},
)


def toy_config(**overrides):
    sizes = {"units": 4, "deter": 8, "blocks": 2, "stoch": 2, "classes": 3, "cnn_depth": 2}
    return load_config(size="tiny", **(sizes | {"imagination_horizon": 3} | overrides))


def fresh(config, spaces, noise=0.0, seed=0):
    """Initial parameters, moved away from their exact zeros if asked."""
    random = np.random.default_rng(seed)
    table = parameter_table(config, spaces)
    uniforms = {
        name: random.random(entry.shape) for name, entry in table.items() if entry.initializer == "truncated_normal"
    }
    params = initial_parameters(table, uniforms)
    return {name: value + noise * random.standard_normal(value.shape) for name, value in params.items()}


def make_batch(config, spaces, rows=2, length=4, seed=1, **changes):
    random = np.random.default_rng(seed)
    batch = {
        "reward": random.standard_normal((rows, length)),
        "is_first": np.zeros((rows, length), bool),
        "is_last": np.zeros((rows, length), bool),
        "is_terminal": np.zeros((rows, length), bool),
        "prev_action": random.standard_normal((rows, length, spaces.action_size)),
        "deter": random.standard_normal((rows, config.deter)),
        "stoch": random.integers(0, config.classes, (rows, config.stoch)),
    }
    for key, space in spaces.observations.items():
        shape = (rows, length, *space.array_shape)
        if isinstance(space, Image):
            batch[key] = random.integers(0, 256, shape).astype(np.uint8)
        elif isinstance(space, Discrete):
            batch[key] = random.integers(0, space.classes, shape)
        else:
            batch[key] = random.standard_normal(shape)
    return batch | changes


def make_noise(config, spaces, rows=2, length=4, seed=2):
    random = np.random.default_rng(seed)
    starts, horizon = rows * length, config.imagination_horizon
    return {
        "posterior": random.random((rows, length, config.stoch)),
        "prior": random.random((starts, horizon, config.stoch)),
        "action": random.random((starts, horizon, spaces.action_noise_size)),
    }


def evaluate(params, config, spaces, batch=None, noise=None, slow=None, return_range=(0.0, 0.0)):
    slow = initial_state(params)["slow_critic"] if slow is None else slow
    batch = make_batch(config, spaces) if batch is None else batch
    noise = make_noise(config, spaces, *batch["reward"].shape) if noise is None else noise
    return losses(params, slow, return_range, batch, noise, spaces, config)


def test_toy_table_of_the_chapter():
    table = parameter_table(toy_config(), TOY)
    assert len(table) == 79
    assert sum(math.prod(entry.shape) for entry in table.values()) == 3644
    assert table["rssm/hidden/kernel"].shape == (2, 16, 4)
    assert table["rssm/hidden/kernel"].fan_in == 32


def test_initial_parameters():
    params = fresh(toy_config(), TOY)
    assert np.all(params["rssm/gru/bias"] == 0.0)
    assert np.all(params["rssm/hidden/scale"] == 1.0)
    assert np.all(params["reward/out/kernel"] == 0.0)
    assert np.all(params["critic/out/kernel"] == 0.0)
    # cut at two of its own standard deviations, which the mended scale stretches to 2 / 0.8796
    assert 0.0 < np.abs(params["rssm/hidden/kernel"]).max() <= 2.2737 / math.sqrt(32)
    assert 0.0 < np.abs(params["actor/out/move/logits/kernel"]).max() <= 0.01 * 2.2737 / math.sqrt(4)
    table = parameter_table(toy_config(), TOY)
    with pytest.raises(ValueError, match="missing"):
        initial_parameters(table, {})


def test_initial_state_and_checkpoint_names():
    params = fresh(toy_config(), TOY)
    state = initial_state(params)
    assert state["optimizer"]["step"] == 0
    assert state["return_range"] == {"low": 0.0, "high": 0.0}
    np.testing.assert_array_equal(state["slow_critic"]["critic/hidden0/kernel"], params["critic/hidden0/kernel"])
    state["params"]["critic/hidden0/kernel"][...] = 7.0
    assert not np.any(state["slow_critic"]["critic/hidden0/kernel"] == 7.0)
    assert not np.any(params["critic/hidden0/kernel"] == 7.0)

    flat = flatten_state(state)
    assert len(flat) == 251
    assert flat["optimizer/step"].dtype == np.int64
    assert {array.dtype.name for name, array in flat.items() if name != "optimizer/step"} == {"float32"}
    assert flat["return_range/low"].shape == flat["optimizer/step"].shape == ()
    assert "slow_critic/critic/out/bias" in flat
    assert "optimizer/momentum/rssm/gru/kernel" in flat


def test_checkpoint_round_trip_and_refusal():
    table = parameter_table(toy_config(), TOY)
    flat = flatten_state(initial_state(fresh(toy_config(), TOY, noise=1.0)))
    flat["optimizer/step"] = np.array(12, np.int64)
    again = flatten_state(unflatten_state(flat, table))
    assert flat.keys() == again.keys()
    for name, array in flat.items():
        np.testing.assert_array_equal(array, again[name])
    with pytest.raises(ValueError, match="rssm/gru/bias"):
        unflatten_state({name: array for name, array in flat.items() if name != "params/rssm/gru/bias"}, table)
    with pytest.raises(ValueError, match="expected shape"):
        unflatten_state(flat | {"return_range/low": np.zeros(1)}, table)


def test_first_step_is_exact():
    """A fresh agent's losses: spec/10-agent.md, worked numbers."""
    config = toy_config()
    _, aux = evaluate(fresh(config, TOY), config, TOY)
    assert aux["losses"]["reward"] == pytest.approx(LN_255, rel=1e-14)
    assert aux["losses"]["replay_critic"] == pytest.approx(2 * LN_255, rel=1e-14)
    assert aux["losses"]["critic"] == pytest.approx(2 * LN_255 * aux["metrics"]["weight_mean"], rel=1e-14)
    assert aux["metrics"]["value_mean"] == 0.0
    assert aux["metrics"]["reward_mean"] == 0.0
    assert aux["metrics"]["return_mean"] == 0.0
    assert aux["metrics"]["return_scale"] == 1.0
    assert aux["return_range"] == (0.0, 0.0)
    assert aux["metrics"]["actor_entropy"] == pytest.approx(math.log(2), rel=1e-3)
    assert aux["losses"]["actor"] == pytest.approx(-3e-4 * math.log(2) * aux["metrics"]["weight_mean"], rel=1e-3)


def test_total_is_the_weighted_sum():
    config = toy_config()
    total, aux = evaluate(fresh(config, TOY, noise=0.5), config, TOY)
    scales = {"representation": 0.1, "replay_critic": 0.3}
    assert list(aux["losses"]) == [
        "reconstruction/vector",
        "reward",
        "continue",
        "dynamics",
        "representation",
        "actor",
        "critic",
        "replay_critic",
    ]
    assert total == pytest.approx(
        sum(scales.get(name, 1.0) * value for name, value in aux["losses"].items()), rel=1e-14
    )


@pytest.mark.parametrize("profile", ["paper", "official"])
def test_everything_at_once(profile):
    overrides = {"profile": profile} | ({"cnn_multipliers": [1, 2]} if profile == "official" else {})
    config = toy_config(**overrides)
    total, aux = evaluate(fresh(config, RICH, noise=0.1), config, RICH)
    assert math.isfinite(total)
    assert aux["deter"].shape == (2, 4, 8)
    assert aux["stoch"].shape == (2, 4, 2, 3)
    assert np.all(aux["stoch"].sum(-1) == 1.0)
    assert set(np.unique(aux["stoch"])) == {0.0, 1.0}
    assert {"reconstruction/code", "reconstruction/image", "reconstruction/vector"} <= set(aux["losses"])


def test_return_range_is_updated_before_use():
    config = toy_config()
    _, aux = evaluate(fresh(config, TOY), config, TOY, return_range=(-1.0, 3.0))
    assert aux["return_range"] == pytest.approx((-0.99, 2.97), rel=1e-14)
    assert aux["metrics"]["return_scale"] == pytest.approx(3.96, rel=1e-14)


def test_terminal_starts_train_nothing_with_true_flags():
    batch = make_batch(toy_config(), TOY, is_last=np.ones((2, 4), bool), is_terminal=np.ones((2, 4), bool))
    config = toy_config()
    _, aux = evaluate(fresh(config, TOY, noise=0.5), config, TOY, batch)
    assert aux["losses"]["critic"] == 0.0
    assert aux["losses"]["actor"] == 0.0
    assert aux["losses"]["replay_critic"] == 0.0
    config = toy_config(start_continue="predicted")
    _, aux = evaluate(fresh(config, TOY, noise=0.5), config, TOY, batch)
    assert aux["losses"]["critic"] > 0.0


def test_discount_enters_once():
    """Without terminals the true start flag gives weight 1 (hard) or gamma (discounted) at index 0."""
    for target, expected in (("hard", 1.0), ("discounted", 1 - 1 / 333)):
        config = toy_config(continue_target=target, imagination_horizon=1)
        _, aux = evaluate(fresh(config, TOY, noise=0.5), config, TOY)
        assert aux["metrics"]["weight_mean"] == pytest.approx(expected, rel=1e-14)


def test_reset_at_the_first_step_forgets_the_context():
    config = toy_config()
    params = fresh(config, TOY, noise=0.5)
    is_first = np.zeros((2, 4), bool)
    is_first[:, 0] = True
    one, two = make_batch(config, TOY, is_first=is_first), make_batch(config, TOY, is_first=is_first)
    two["deter"] = two["deter"] + 5.0
    two["stoch"] = (two["stoch"] + 1) % 3
    two["prev_action"][:, 0] = -9.0
    assert evaluate(params, config, TOY, one)[0] == evaluate(params, config, TOY, two)[0]
    two["prev_action"][:, 1] = -9.0
    assert evaluate(params, config, TOY, one)[0] != evaluate(params, config, TOY, two)[0]


def test_a_single_trained_step_has_no_replay_critic_loss():
    config = toy_config()
    _, aux = evaluate(fresh(config, TOY), config, TOY, make_batch(config, TOY, length=1))
    assert aux["losses"]["replay_critic"] == 0.0


def test_policy_step_rows_and_resets():
    config = toy_config()
    params, random = fresh(config, RICH, noise=0.3), np.random.default_rng(0)
    observation = {key: make_batch(config, RICH, rows=3, length=1)[key][:, 0] for key in RICH.observations}
    carry = {"deter": random.standard_normal((3, 8)), "stoch": np.eye(3)[random.integers(0, 3, (3, 2))]}
    noise = {"posterior": random.random((3, 2)), "action": random.random((3, RICH.action_noise_size))}
    prev_action, is_first = random.standard_normal((3, RICH.action_size)), np.array([True, False, False])
    after, action = policy_step(params, carry, prev_action, observation, is_first, noise, RICH, config)
    assert action.shape == (3, 7)
    assert action[:, :2].sum(-1).tolist() == [1.0, 1.0, 1.0]
    other = {"deter": carry["deter"].copy(), "stoch": carry["stoch"].copy()}
    other["deter"][0], other["stoch"][0], prev_action[0] = np.inf, 0.0, np.nan
    again, same_action = policy_step(params, other, prev_action, observation, is_first, noise, RICH, config)
    for key in after:
        np.testing.assert_array_equal(after[key], again[key])
    np.testing.assert_array_equal(action, same_action)
    prev_action[1] = 0.0
    changed, _ = policy_step(params, other, prev_action, observation, is_first, noise, RICH, config)
    assert np.any(changed["deter"][1] != after["deter"][1])
    np.testing.assert_array_equal(changed["deter"][2], after["deter"][2])


def groups(params):
    """The columns of the table "What reaches what"."""

    def group(name):
        first, _, rest = name.partition("/")
        return "prior" if rest.startswith("prior/") else first

    return {name: group(name) for name in params}


REACH = {
    "reconstruction/vector": {"encoder", "rssm", "decoder"},
    "reward": {"encoder", "rssm", "reward"},
    "continue": {"encoder", "rssm", "continue"},
    "dynamics": {"encoder", "rssm", "prior"},
    "representation": {"encoder", "rssm"},
    "actor": {"actor"},
    "critic": {"critic"},
    "replay_critic": {"encoder", "rssm", "critic"},
}


def test_gradients_reach_exactly_what_the_table_says():
    config = toy_config(free_nats=0.0)
    params = fresh(config, TOY, noise=0.5)
    slow = initial_state(fresh(config, TOY, noise=0.5, seed=9))["slow_critic"]
    batch, noise, random = make_batch(config, TOY), make_noise(config, TOY), np.random.default_rng(5)

    def values(point):
        return losses(point, slow, (0.0, 0.0), batch, noise, TOY, config)[1]["losses"]

    with recording() as tape:
        values(params)
    reached = {name: set() for name in REACH}
    for group in sorted(set(groups(params).values())):
        direction = {
            name: random.standard_normal(params[name].shape) for name, g in groups(params).items() if g == group
        }
        results = []
        for sign in (1, -1):
            with replaying(tape):
                results.append(values(params | {name: params[name] + sign * 1e-5 * u for name, u in direction.items()}))
        for name in REACH:
            if results[0][name] != results[1][name]:
                reached[name].add(group)
    assert reached == REACH


def test_derivative_of_the_total_is_consistent():
    """The same at two step sizes, and linear in the direction."""
    config = toy_config(free_nats=0.1)
    params = fresh(config, TOY, noise=0.3)
    random = np.random.default_rng(3)
    u, v = ({name: random.standard_normal(value.shape) for name, value in params.items()} for _ in range(2))
    both = {name: u[name] + 2 * v[name] for name in params}
    batch, noise, slow = make_batch(config, TOY), make_noise(config, TOY), initial_state(params)["slow_critic"]

    def total(point):
        return losses(point, slow, (0.0, 0.0), batch, noise, TOY, config)[0]

    along = {name: directional_derivative(total, params, w, 1e-6) for name, w in (("u", u), ("v", v), ("both", both))}
    assert along["u"] == pytest.approx(directional_derivative(total, params, u, 1e-5), rel=1e-6)
    assert along["both"] == pytest.approx(along["u"] + 2 * along["v"], rel=1e-5)
    assert abs(along["u"]) > 1e-2


def test_derivative_by_hand():
    """Fresh reward head, all rewards 0: softmax minus twohot is 1/255 - 1 at the centre bin and 1/255 elsewhere."""
    config = toy_config()
    params, batch = fresh(config, TOY), make_batch(toy_config(), TOY, reward=np.zeros((2, 4)))
    for index, expected in ((127, 1 / 255 - 1), (3, 1 / 255)):
        direction = {"reward/out/bias": np.eye(255)[index]}
        derivative = directional_derivative(
            lambda point: evaluate(point, config, TOY, batch)[0], params, direction, 1e-4
        )
        assert derivative == pytest.approx(expected, abs=1e-8)


def test_directional_derivative_holds_constants():
    def function(params):
        x = params["x"]
        return float(np.sum(x**2 * stop_gradient(x)) + params["y"])

    params = {"x": np.array([2.0, -1.0]), "y": np.array(5.0)}
    # d/dx x^2 sg(x) = 2 x sg(x) = 8 and 2
    assert directional_derivative(function, params, {"x": np.array([1.0, 0.0])}, 1e-3) == pytest.approx(8.0, rel=1e-10)
    assert directional_derivative(function, params, {"x": np.array([0.5, 3.0]), "y": 1.0}, 1e-3) == pytest.approx(
        11.0, rel=1e-10
    )
    with pytest.raises(ValueError, match="unknown"):
        directional_derivative(function, params, {"z": 1.0}, 1e-3)
    with pytest.raises(ValueError, match="step"):
        directional_derivative(function, params, {"y": 1.0}, 0.0)


def test_train_step():
    config = toy_config()
    state = initial_state(fresh(config, TOY))
    before = copy.deepcopy(state)
    batch, noise = make_batch(config, TOY), make_noise(config, TOY)
    gradients = {name: np.zeros_like(value) for name, value in state["params"].items()}
    gradients["critic/out/bias"] = np.full(255, -1.0)
    after, aux = train_step(state, batch, noise, gradients, TOY, config)
    for name, value in before["params"].items():
        np.testing.assert_array_equal(state["params"][name], value)
        if name != "critic/out/bias":
            np.testing.assert_array_equal(after["params"][name], value)
    # the first update has size 1 whatever the gradient, and the slow critic follows the new parameters at once
    np.testing.assert_allclose(after["params"]["critic/out/bias"], 4e-5, rtol=1e-12)
    np.testing.assert_allclose(after["slow_critic"]["critic/out/bias"], 8e-7, rtol=1e-12)
    assert after["optimizer"]["step"] == 1
    assert state["optimizer"]["step"] == 0
    assert aux["losses"]["reward"] == pytest.approx(LN_255)
    again, _ = train_step(after, batch, noise, gradients, TOY, config)
    assert again["optimizer"]["step"] == 2
    assert flatten_state(again).keys() == flatten_state(before).keys()


def test_errors_name_the_argument():
    config = toy_config()
    params = fresh(config, TOY)
    for name, wrong in (
        ("deter", np.zeros((2, 7))),
        ("prev_action", np.zeros((2, 4, 1))),
        ("is_last", np.zeros((2, 3), bool)),
    ):
        with pytest.raises(ValueError, match=name):
            evaluate(params, config, TOY, make_batch(config, TOY, **{name: wrong}))
    with pytest.raises(ValueError, match="stoch"):
        evaluate(params, config, TOY, make_batch(config, TOY, stoch=np.full((2, 2), 3)))
    batch = make_batch(config, TOY)
    del batch["is_terminal"]
    with pytest.raises(ValueError, match="is_terminal"):
        evaluate(params, config, TOY, batch)
    noise = make_noise(config, TOY)
    noise["prior"] = noise["prior"][:, :2]
    with pytest.raises(ValueError, match="prior"):
        evaluate(params, config, TOY, noise=noise)
