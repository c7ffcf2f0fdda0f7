"""Exact properties of the networks. More numbers of spec/05-networks.md are in tests/test_examples.py."""

import math

import numpy as np
import pytest

from reference_numpy import networks
from spec import Discrete, Image, Spaces, Vector, load_config, parameter_table
from spec.parameters import bottleneck

ACTIONS = {"turn": Vector(2), "buttons": Discrete((2, 3))}
SHAPES = [("strided", True), ("strided", False), ("pooled", True), ("pooled", False)]


def small_config(**overrides):
    values = {"units": 3, "deter": 4, "blocks": 2, "stoch": 2, "classes": 3, "cnn_depth": 2, "bins": 5} | overrides
    return load_config(size="tiny", **values)


def make_params(config, spaces, zero=False):
    generator = np.random.default_rng(0)
    return {
        name: np.zeros(entry.shape) if zero else generator.normal(size=entry.shape)
        for name, entry in parameter_table(config, spaces).items()
    }


def identity(x, *rest):
    return x


def test_feature():
    stoch = [[[0, 0, 1], [0, 1, 0]]]
    assert networks.feature([[0.5, -2.0]], stoch).tolist() == [[0.5, -2.0, 0, 0, 1, 0, 1, 0]]
    with pytest.raises(ValueError, match=r"stoch: expected shape \[2, S, C\]"):
        networks.feature(np.zeros((2, 4)), np.zeros((3, 2, 3)))


def test_vectors_share_one_mlp(monkeypatch):
    spaces = Spaces({"speed": Vector(2), "item": Discrete((3, 2))}, ACTIONS)
    names = []
    monkeypatch.setattr(networks, "mlp", lambda params, name, x, *rest: (names.append(name), x)[1])
    observations = {"speed": np.float32([[0.0, math.e - 1]]), "item": np.array([[2, 0]]), "reward": np.zeros(1)}
    assert networks.encoder({}, observations, spaces, small_config()).shape == (1, 7)
    assert names == ["encoder/vector"]


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.array([3, 0]), r"observations\['item'\], entry 0: expected values in 0 .. 2, got 3"),
        (np.array([0, 2]), r"observations\['item'\], entry 1: expected values in 0 .. 1, got 2"),
        (np.array([-1, 0]), r"observations\['item'\], entry 0: expected values in 0 .. 2, got -1"),
        (np.array([1.0, 0.0]), r"observations\['item'\]: expected an integer dtype, got float64"),
        (np.array([1]), r"observations\['item'\]: expected shape \[\.\.\., 2\], got \[1\]"),
    ],
)
def test_wrong_discrete_values_are_refused(value, message):
    spaces = Spaces({"item": Discrete((3, 2))}, ACTIONS)
    config = small_config()
    with pytest.raises(ValueError, match=message):
        networks.encoder(make_params(config, spaces), {"item": value}, spaces, config)


def test_images_are_uint8_and_scaled(monkeypatch):
    spaces = Spaces({"b": Image(2, 2, 1), "a": Image(2, 2, 2)}, ACTIONS)
    config = small_config(cnn_multipliers=(1, 1))
    seen = []
    original = networks.convolution
    monkeypatch.setattr(networks, "convolution", lambda x, *rest: (seen.append(x), original(x, *rest))[1])
    dark, bright = np.zeros((2, 2, 2), np.uint8), np.full((2, 2, 1), 255, np.uint8)
    bright[0, 0] = 128
    networks.encoder(make_params(config, spaces), {"a": dark, "b": bright}, spaces, config)
    np.testing.assert_allclose(seen[0][0, :, :, 2], [[0.0019607843, 0.5], [0.5, 0.5]])
    assert (seen[0][..., :2] == -0.5).all()
    with pytest.raises(ValueError, match=r"observations\['a'\]: expected dtype uint8, got float64"):
        networks.encoder(make_params(config, spaces), {"a": dark / 255, "b": bright}, spaces, config)


def test_missing_key_and_odd_sides_are_refused():
    spaces = Spaces({"view": Image(10, 8, 1)}, ACTIONS)
    config = small_config(cnn_multipliers=(1, 1, 1))  # two halvings
    with pytest.raises(ValueError, match="observations: missing 'view'; unknown 'sight'"):
        networks.encoder({}, {"sight": np.zeros((10, 8, 1), np.uint8)}, spaces, config)
    with pytest.raises(ValueError, match="multiples of 4"):
        networks.encoder({}, {"view": np.zeros((10, 8, 1), np.uint8)}, spaces, config)


@pytest.mark.parametrize(
    ("sampling", "multipliers", "outer", "sides", "strides"),
    [
        ("strided", (1, 2, 3, 4, 4), True, [64, 64, 32, 16, 8], [1, 2, 2, 2, 2]),
        ("pooled", (2, 3, 4, 4), False, [64, 32, 16, 8], [1, 1, 1, 1]),
    ],
)
def test_encoder_stages(monkeypatch, sampling, multipliers, outer, sides, strides):
    """Side and stride of each convolution for a 64 x 64 image, and the size of the tokens."""
    spaces = Spaces({"view": Image(64, 64, 3)}, ACTIONS)
    config = small_config(cnn_sampling=sampling, cnn_multipliers=multipliers, cnn_outer=outer)
    seen = []

    def convolution(x, kernel, bias, stride):
        seen.append((x.shape[1], stride))
        return np.zeros((*x.shape[:1], x.shape[1] // stride, x.shape[2] // stride, kernel.shape[-1]))

    monkeypatch.setattr(networks, "convolution", convolution)
    tokens = networks.encoder(make_params(config, spaces), {"view": np.zeros((1, 64, 64, 3), np.uint8)}, spaces, config)
    assert seen == list(zip(sides, strides, strict=True))
    assert tokens.shape == (1, 4 * 4 * 4 * 2)


def test_pooling_comes_before_normalization():
    """Identity kernels: two opposite pixels of one square are pooled channel by channel, and only then normalized."""
    spaces = Spaces({"view": Image(4, 4, 2)}, ACTIONS)
    config = small_config(blocks=1, cnn_sampling="pooled", cnn_multipliers=(1, 1), cnn_outer=True, norm_epsilon=1e-30)
    params = make_params(config, spaces, zero=True)
    for layer in ("conv0", "conv1"):
        params[f"encoder/image/{layer}/kernel"][2, 2] = np.eye(2)
        params[f"encoder/image/{layer}/scale"][:] = 1.0
    image = np.zeros((1, 4, 4, 2))
    image[0, 0, 0] = 3, -3  # the outer stage makes it (1, -1), and SiLU (0.731059, -0.268941)
    image[0, 1, 1] = -4, 4
    pooled = np.array([0.731059, 0.731059])
    expected = pooled / 0.731059
    result = networks._encode_image(params, image, config)
    np.testing.assert_allclose(result[0, 0, 0], expected / (1 + np.exp(-expected)), atol=1e-6)
    assert (result[0, 1, 1] == 0).all()


@pytest.mark.parametrize(
    ("sampling", "outer", "expected"),
    [
        ("pooled", True, "conv norm silu conv pool norm silu"),
        ("pooled", False, "conv pool norm silu conv pool norm silu"),
        ("strided", True, "conv norm silu conv norm silu"),
    ],
)
def test_order_inside_encoder_stages(monkeypatch, sampling, outer, expected):
    spaces = Spaces({"view": Image(4, 4, 2)}, ACTIONS)
    config = small_config(cnn_sampling=sampling, cnn_multipliers=(1, 1), cnn_outer=outer)
    seen = []
    for name, label in (("convolution", "conv"), ("max_pool", "pool"), ("rms_norm", "norm"), ("silu", "silu")):
        original = getattr(networks, name)
        monkeypatch.setattr(
            networks, name, lambda *rest, label=label, original=original: (seen.append(label), original(*rest))[1]
        )
    networks.encoder(make_params(config, spaces), {"view": np.zeros((4, 4, 2), np.uint8)}, spaces, config)
    assert " ".join(seen) == expected


def test_tokens_are_vectors_then_images(monkeypatch):
    spaces = Spaces({"view": Image(2, 4, 1), "zoom": Vector(1)}, ACTIONS)
    config = small_config(blocks=1, cnn_depth=1, cnn_multipliers=(1, 1))
    monkeypatch.setattr(networks, "_encode_image", lambda params, x, config: np.arange(4.0).reshape(1, 1, 2, 2))
    monkeypatch.setattr(networks, "mlp", lambda params, name, x, *rest: x)
    tokens = networks.encoder(
        {}, {"view": np.zeros((2, 4, 1), np.uint8), "zoom": np.zeros(1) + math.e - 1}, spaces, config
    )
    np.testing.assert_allclose(tokens, [1, 0, 1, 2, 3])


def test_reshape_of_the_stem(monkeypatch):
    spaces = Spaces({"view": Image(2, 4, 1)}, ACTIONS)
    config = small_config(cnn_multipliers=(1, 2), cnn_depth=2)
    assert bottleneck(config, spaces) == (1, 2, 4)
    monkeypatch.setattr(networks, "rms_norm", identity)
    monkeypatch.setattr(networks, "silu", identity)
    params = make_params(config, spaces, zero=True)
    feature = np.zeros((1, config.feature_size))
    for name, expected in (("deter", [[0, 1, 4, 5], [2, 3, 6, 7]]), ("stoch", [[0, 1, 2, 3], [4, 5, 6, 7]])):
        moved = params | {f"decoder/image/{name}/bias": np.arange(8.0)}
        stem = networks._stem(moved, feature[:, :4], feature[:, 4:], spaces, config)
        assert stem[0, 0].tolist() == expected


def test_stem_reads_memory_and_latents():
    spaces = Spaces({"view": Image(2, 4, 1)}, ACTIONS)
    config = small_config(cnn_multipliers=(1, 2))
    params = make_params(config, spaces)
    feature = np.random.default_rng(1).normal(size=config.feature_size)
    image = networks.decoder(params, feature, spaces, config)["view"]
    for part, blind in (
        (slice(0, 4), "decoder/image/deter/kernel"),
        (slice(4, None), "decoder/image/stoch_hidden/kernel"),
    ):
        moved = feature.copy()
        moved[part] += 1.0
        assert not np.array_equal(networks.decoder(params, moved, spaces, config)["view"], image)
        blinded = params | {blind: np.zeros_like(params[blind])}
        without = networks.decoder(blinded, feature, spaces, config)["view"]
        assert np.array_equal(networks.decoder(blinded, moved, spaces, config)["view"], without)


@pytest.mark.parametrize(("sampling", "outer"), SHAPES)
def test_decoder_shapes_and_split(sampling, outer):
    observations = {"b": Image(16, 8, 1), "a": Image(16, 8, 2), "vec": Vector(2), "kind": Discrete((2, 3))}
    spaces = Spaces(observations, ACTIONS)
    config = small_config(cnn_sampling=sampling, cnn_outer=outer, cnn_multipliers=(1, 2, 2))
    params = make_params(config, spaces, zero=True)
    params["decoder/image/out/bias"] = np.array([0.0, math.log(3.0), -1000.0])
    params["decoder/vector/out/vec/bias"] = np.array([1.0, 2.0])
    outputs = networks.decoder(params, np.zeros((3, 2, config.feature_size)), spaces, config)
    assert list(outputs) == ["a", "b", "kind", "vec"]
    assert outputs["b"].shape == (3, 2, 16, 8, 1)
    assert outputs["kind"].shape == (3, 2, 5)
    np.testing.assert_allclose(outputs["a"][2, 1, 15, 7], [0.5, 0.75])
    np.testing.assert_allclose(outputs["b"], 0.0)
    assert outputs["vec"][2, 1].tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ("sampling", "outer", "expected"),
    [
        ("pooled", True, ["upsample", "conv", "upsample", "conv", "conv"]),
        ("pooled", False, ["upsample", "conv", "upsample", "conv", "upsample", "conv"]),
        ("strided", True, ["transposed", "transposed", "conv"]),
        ("strided", False, ["transposed", "transposed", "transposed"]),
    ],
)
def test_decoder_stages(monkeypatch, sampling, outer, expected):
    spaces = Spaces({"view": Image(8, 8, 3)}, ACTIONS)
    config = small_config(cnn_sampling=sampling, cnn_outer=outer, cnn_multipliers=(1, 2, 3), blocks=1)
    seen, channels = [], []

    def spy(name, label, at_kernel):
        original = getattr(networks, name)

        def call(*arguments):
            seen.append(label)
            if at_kernel:
                channels.append(arguments[1].shape[2:])
            return original(*arguments)

        monkeypatch.setattr(networks, name, call)

    spy("upsample", "upsample", False)
    spy("convolution", "conv", True)
    spy("transposed_convolution", "transposed", True)
    image = networks.decoder(make_params(config, spaces), np.zeros(config.feature_size), spaces, config)["view"]
    assert image.shape == (8, 8, 3)
    assert seen == expected
    assert channels == [(6, 4), (4, 2), (2, 3)]


def test_heads():
    spaces = Spaces({"x": Vector(1)}, ACTIONS)
    config = small_config()
    params = make_params(config, spaces, zero=True)
    params["reward/out/bias"] = np.arange(5.0)
    params["critic/out/bias"] = -np.arange(5.0)
    params["continue/out/bias"] = np.array([6.0])
    params["actor/out/buttons/logits/bias"] = np.arange(5.0)
    params["actor/out/turn/mean/bias"] = np.array([10.0, -10.0])
    params["actor/out/turn/std/bias"] = np.array([20.0, -20.0])
    feature = np.ones((2, 3, config.feature_size))
    assert networks.reward_head(params, feature, config)[1, 2].tolist() == [0, 1, 2, 3, 4]
    assert networks.critic(params, feature, config)[1, 2].tolist() == [0, -1, -2, -3, -4]
    assert networks.continue_head(params, feature, config).tolist() == [[6.0] * 3] * 2
    outputs = networks.actor(params, feature, spaces, config)
    assert {key: list(value) for key, value in outputs.items()} == {"buttons": ["logits"], "turn": ["mean", "std"]}
    assert outputs["buttons"]["logits"][1, 2].tolist() == [0, 1, 2, 3, 4]
    assert outputs["turn"]["mean"][1, 2].tolist() == [10, -10]
    assert outputs["turn"]["std"][1, 2].tolist() == [20, -20]


def test_slow_critic_uses_the_same_names():
    spaces = Spaces({"x": Vector(1)}, ACTIONS)
    config = small_config()
    params = make_params(config, spaces)
    slow = {name: value for name, value in params.items() if name.startswith("critic/")}
    feature = np.random.default_rng(1).normal(size=(4, config.feature_size))
    assert np.array_equal(networks.critic(slow, feature, config), networks.critic(params, feature, config))


@pytest.mark.parametrize(("sampling", "outer"), SHAPES)
def test_leading_axes_are_independent(sampling, outer):
    spaces = Spaces({"view": Image(8, 4, 2), "vec": Vector(2), "kind": Discrete((2, 3))}, ACTIONS)
    config = small_config(cnn_sampling=sampling, cnn_outer=outer, cnn_multipliers=(1, 2))
    params = make_params(config, spaces)
    generator = np.random.default_rng(1)
    batch = {
        "view": generator.integers(256, size=(2, 3, 8, 4, 2), dtype=np.uint8),
        "vec": generator.normal(size=(2, 3, 2)),
        "kind": generator.integers(2, size=(2, 3, 2)),
    }
    tokens = networks.encoder(params, batch, spaces, config)
    one = networks.encoder(params, {key: value[1, 2] for key, value in batch.items()}, spaces, config)
    np.testing.assert_allclose(tokens[1, 2], one, rtol=1e-12)
    assert tokens.shape == (
        2,
        3,
        parameter_table(config, spaces)["rssm/posterior/hidden0/kernel"].shape[0] - config.deter,
    )
    feature = generator.normal(size=(2, 3, config.feature_size))
    together = networks.decoder(params, feature, spaces, config)
    alone = networks.decoder(params, feature[1, 2], spaces, config)
    for key in spaces.observations:
        np.testing.assert_allclose(together[key][1, 2], alone[key], rtol=1e-9, atol=1e-300)


def test_wrong_shapes_are_refused():
    spaces = Spaces({"a": Vector(2), "b": Vector(1)}, ACTIONS)
    config = small_config()
    params = make_params(config, spaces)
    with pytest.raises(ValueError, match=r"observations\['b'\]: expected shape \[5, 1\], got \[4, 1\]"):
        networks.encoder(params, {"a": np.zeros((5, 2)), "b": np.zeros((4, 1))}, spaces, config)
    for call in (networks.reward_head, networks.continue_head, networks.critic):
        with pytest.raises(ValueError, match=r"feature: expected shape \[\.\.\., 10\], got \[3, 9\]"):
            call(params, np.zeros((3, 9)), config)
