"""Checks of spec/05-networks.md."""

import dataclasses
import math
from typing import Any

import hypothesis.strategies as st
import numpy as np

from conformance.check import Run, check, round_to
from conformance.problems import random_observations, random_parameters, small_config
from conformance.strategies import adversarial_numbers, arrays, normals, seeds
from reference_numpy import networks as reference
from spec import Config, Discrete, Image, Spaces, Vector, parameter_table

# A capital letter sorts before all small ones. The mapping of observations is given in another order than the sorted
# one.
VECTORS: dict[str, Vector | Discrete] = {"position": Vector(3), "mode": Discrete((3, 2)), "Speed": Vector(2)}
IMAGES: dict[str, Image] = {"image": Image(8, 12, 3), "depth": Image(8, 12, 1)}
ACTIONS: dict[str, Vector | Discrete] = {"turn": Vector(2), "buttons": Discrete((2, 3)), "Arm": Vector(1)}
TASK = Spaces({**VECTORS, **IMAGES}, ACTIONS)
VECTOR_TASK = Spaces(VECTORS, ACTIONS)
IMAGE_TASK = Spaces(IMAGES, ACTIONS)
CONVOLUTIONS = (
    {"cnn_sampling": "strided", "cnn_outer": True, "cnn_multipliers": (1, 2, 3)},
    {"cnn_sampling": "strided", "cnn_outer": False, "cnn_multipliers": (2, 3)},
    {"cnn_sampling": "pooled", "cnn_outer": True, "cnn_multipliers": (1, 2, 3)},
    {"cnn_sampling": "pooled", "cnn_outer": False, "cnn_multipliers": (2, 3)},
)
HEADS = ("reward_head", "continue_head", "critic")
ROWS = 3
LARGEST = 3.4028234663852886e38  # of float32; bfloat16 rounds it to infinity


def config_of(run: Run, index: int | None = None, **overrides: Any) -> Config:
    """A small configuration with the convolutions of that index; with None, of the kind that the profile has."""
    index = own_convolutions(run)[0] if index is None else index
    return small_config(run.profile, run.dtype, **{"blocks": 2, **CONVOLUTIONS[index], **overrides})


def own_convolutions(run: Run) -> list[int]:
    """Which of CONVOLUTIONS is of the kind that the profile has. Code that has no other can be checked with it."""
    plain = small_config(run.profile)
    kinds = [(kind["cnn_sampling"], kind["cnn_outer"]) for kind in CONVOLUTIONS]
    return [kinds.index((plain.cnn_sampling, plain.cnn_outer))]


def other_convolutions(run: Run) -> list[int]:
    return [index for index in range(len(CONVOLUTIONS)) if index not in own_convolutions(run)]


def params_of(run: Run, config: Config, task: Spaces = TASK, seed: int = 0) -> dict[str, np.ndarray]:
    return random_parameters(np.random.default_rng(run.seed + seed), config, task, run.dtype)


def zero_parameters(config: Config, task: Spaces) -> dict[str, np.ndarray]:
    """All zero, but for the scales of RMSNorm, which are one."""
    return {
        name: np.full(entry.shape, float(entry.initializer == "ones"))
        for name, entry in parameter_table(config, task).items()
    }


def observations_of(seed: int, task: Spaces, leading: tuple[int, ...] = (ROWS,)) -> dict[str, np.ndarray]:
    drawn = random_observations(np.random.default_rng(seed), task, leading)
    return {key: drawn[key] for key in reversed(drawn)}


def features_of(run: Run, config: Config, *leading: int, seed: int = 0) -> np.ndarray:
    return run.cast(normals(run.seed + seed, *leading, config.feature_size))


def largest(result: Any) -> Any:
    """The largest number of every array of a nested result, but at least 1: a few numbers may happen to be all
    small."""
    return (
        {key: largest(value) for key, value in result.items()}
        if isinstance(result, dict)
        else max(1.0, np.abs(result).max())
    )


def activated(*values: float) -> np.ndarray:
    """RMSNorm with scale 1 and epsilon 0, then SiLU."""
    x = np.array(values) / math.sqrt(sum(value**2 for value in values) / len(values))
    return x / (1 + np.exp(-x))


@check("NET-3", "NET-5", "CON-25", uses=["encoder"], level=1)
def encoded_vector_literals(run: Run) -> None:
    """speed (0, e - 1) and item (2, 0) of Discrete((3, 2)) enter as (0, 0, 1, 1, 0, 0, 1): sorted keys, one-hots,
    symlog."""
    task = Spaces({"speed": Vector(2), "item": Discrete((3, 2))}, ACTIONS)
    config = config_of(run, units=7, encoder_layers=1, norm_epsilon=0.0)
    params = zero_parameters(config, task) | {"encoder/vector/hidden0/kernel": np.eye(7)}
    observations = {"speed": np.array([[0, math.e - 1]], np.float32), "item": np.array([[2, 0]])}
    expected = activated(0, 0, 1, 1, 0, 0, 1)[None]
    run.expect(
        "encoder",
        (params, observations, task, config),
        expected,
        magnitude="tensor",
        bound=1e-6 if run.u < 1e-10 else None,
    )


@check("NET-2", "NET-3", "NET-5", "NET-11", "NET-26", "CON-24", "CON-26", uses=["encoder"], level=1)
def encoder_of_vectors_matches(run: Run) -> None:
    """Tokens of vectors that hold zeros, subnormals and the largest float32, and of discrete entries; nothing else is
    read."""
    config = config_of(run, encoder_layers=2)
    numbers = st.one_of(adversarial_numbers(finite=True), st.sampled_from([LARGEST, -LARGEST]))

    @run.for_all(seed=seeds(), position=arrays(numbers, (ROWS, 3)), speed=arrays(numbers, (ROWS, 2)))
    def _(seed: int, position: np.ndarray, speed: np.ndarray) -> None:
        params = params_of(run, config, VECTOR_TASK, seed)
        vectors = {"position": position.astype(np.float32), "Speed": speed.astype(np.float32)}
        observations = observations_of(seed, VECTOR_TASK) | vectors
        expected = reference.encoder(params, observations, VECTOR_TASK, config)
        other = {
            "reward": np.full(ROWS, np.nan),
            "is_first": np.ones(ROWS, bool),
            "prev_action": np.full((ROWS, 8), np.nan),
        }
        run.expect("encoder", (params, other | observations, VECTOR_TASK, config), expected, magnitude="tensor")


@check("NET-4", uses=["encoder"], level=1)
def integers_of_any_kind(run: Run) -> None:
    """A Discrete observation may have any integer dtype, and no other."""
    config = config_of(run)
    params, observations = params_of(run, config, VECTOR_TASK), observations_of(run.seed, VECTOR_TASK)
    before = run.call("encoder", params, observations, VECTOR_TASK, config)
    for dtype in (np.uint8, np.int32, np.int64):
        mode = observations["mode"].astype(dtype)
        run.exact(
            f"tokens of {mode.dtype}",
            run.call("encoder", params, observations | {"mode": mode}, VECTOR_TASK, config),
            before,
        )
    for real in (np.float32, np.float64):
        run.refuses(
            "encoder",
            params,
            observations | {"mode": observations["mode"].astype(real)},
            VECTOR_TASK,
            config,
            naming=["mode"],
        )


@check("NET-2", "NET-24", uses=["encoder"], level=1)
def non_finite_vectors_show(run: Run) -> None:
    """NaN or infinity in a vector gives tokens that are not finite in its own row, and changes nothing in the
    others."""
    config = config_of(run)
    params, observations = params_of(run, config, VECTOR_TASK), observations_of(run.seed, VECTOR_TASK)
    before = np.asarray(run.call("encoder", params, observations, VECTOR_TASK, config))
    for bad in (np.nan, np.inf):
        position = observations["position"].copy()
        position[1, 2] = bad
        with np.errstate(invalid="ignore"):
            tokens = np.asarray(run.call("encoder", params, observations | {"position": position}, VECTOR_TASK, config))
        run.holds(f"tokens with {bad} are not finite", not np.isfinite(tokens[1]).all())
        run.exact("tokens of the other rows", tokens[[0, 2]], before[[0, 2]])


@check("NET-6", "NET-8", "NET-9", "NET-10", uses=["encoder"], level=1)
def brightness_literals(run: Run) -> None:
    """Brightness 0, 1, 127, 128 and 255 enters as -0.5, -0.4961, -0.00196, 0.00196 and 0.5, also in a picture that
    holds nothing else."""
    task = Spaces({"image": Image(4, 4, 1)}, ACTIONS)
    config = config_of(run, 1, cnn_multipliers=(2, 2), cnn_depth=1, norm_epsilon=0.0)
    params = zero_parameters(config, task) | {"encoder/image/conv0/bias": np.array([0.0, 1.0])}
    params["encoder/image/conv0/kernel"][1, 1, 0, 0] = 1  # the top left pixel of four, beside a constant channel
    params["encoder/image/conv1/kernel"][1, 1] = np.eye(2)
    entering = {0: -0.5, 1: -0.49607843137, 127: -0.00196078431, 128: 0.00196078431, 255: 0.5}
    for brightness in (
        [0, 1, 127, 128, 255],
        [1, 0, 1, 1, 0],
    ):  # pictures without any number above 1 are scaled like all others
        image = np.broadcast_to(np.array(brightness, np.uint8)[:, None, None, None], (5, 4, 4, 1)).copy()
        expected = np.array([activated(*activated(entering[number], 1)) for number in brightness])
        bound = 1e-9 if run.u < 1e-10 else None
        run.expect("encoder", (params, {"image": image}, task, config), expected, magnitude="tensor", bound=bound)


@check("NET-8", "NET-9", uses=["encoder"], level=1)
def pooling_comes_before_normalization(run: Run) -> None:
    """Convolution outputs (3, 0), (0, 4), (0, 0), (0, 0) are pooled to (3, 4) and then become (0.594189, 0.855420)."""
    task = Spaces({"image": Image(4, 4, 2)}, ACTIONS)
    config = config_of(run, 3, cnn_multipliers=(2, 2), cnn_depth=1, norm_epsilon=0.0)
    params = zero_parameters(config, task) | {"encoder/image/conv0/bias": np.array([1.5, 2.0])}
    params["encoder/image/conv0/kernel"][2, 2] = np.diag([3.0, 4.0])
    params["encoder/image/conv1/kernel"][2, 2] = np.eye(2)
    image = np.zeros((1, 4, 4, 2), np.uint8)
    image[:, 0::2, 0::2, 0] = image[:, 0::2, 1::2, 1] = 255
    expected = activated(0.594189, 0.855420)[None]
    run.expect(
        "encoder",
        (params, {"image": image}, task, config),
        expected,
        magnitude="tensor",
        bound=2e-6 if run.u < 1e-10 else None,
    )


@check("NET-6", "NET-26", uses=["encoder"], level=1)
def brightness_is_scaled_in_float32(run: Run) -> None:
    """The two greys nearest to 0 differ by 1/255 whatever the compute dtype: bfloat16 would halve or double one of
    them."""
    task = Spaces({"image": Image(8, 8, 1)}, ACTIONS)
    config = config_of(run, norm_epsilon=1e-12)
    params = params_of(run, config, task)
    params |= {
        name: np.zeros_like(value)
        for name, value in params.items()
        if name.startswith("encoder/image/") and name.endswith("bias")
    }
    observations = {"image": run.rng().integers(127, 129, (ROWS, 8, 8, 1)).astype(np.uint8)}
    expected = reference.encoder(params, observations, task, config)
    bound = {"float64": 1e-11, "float32": 1e-3, "bfloat16": 0.125}[
        run.dtype
    ]  # x / 255 - 1/2 loses the digits that cancel
    run.expect("encoder", (params, observations, task, config), expected, magnitude="tensor", bound=bound)


@check("NET-3", *(f"NET-{n}" for n in range(6, 12)), "CON-6", uses=["encoder"], level=1)
def encoder_matches(run: Run) -> None:
    """Tokens of vectors and images together and of images alone, with the kind of convolutions that the profile has."""
    compare_encoders(run, own_convolutions(run))


@check("NET-8", "NET-9", uses=["encoder"], level=1)
def encoder_with_other_convolutions_matches(run: Run) -> None:
    """The same with the other choices of `cnn_sampling` and `cnn_outer`."""
    compare_encoders(run, other_convolutions(run))


def compare_encoders(run: Run, kinds: list[int]) -> None:
    for index in kinds:
        for task in (TASK, IMAGE_TASK):
            config = config_of(run, index)
            params, observations = params_of(run, config, task, index), observations_of(run.seed + index, task)
            expected = reference.encoder(params, observations, task, config)
            run.expect("encoder", (params, observations, task, config), expected, magnitude="tensor")


@check("NET-14", "NET-18", "NET-19", "NET-26", uses=["decoder"], level=1)
def decoder_literals(run: Run) -> None:
    """With zero weights: vectors and logits are the biases as they are, images the sigmoid of theirs, computed in
    float32 or better."""
    config = config_of(run)
    biases = {
        "decoder/vector/out/position/bias": np.array([20.0, -3.0, 0.5]),
        "decoder/vector/out/Speed/bias": np.array([-200.0, 0.0]),
        "decoder/vector/out/mode/bias": np.array([1.0, 2.0, -300.0, 8.0, 0.25]),
        "decoder/image/out/bias": np.array([0.0, 8.0, -1.5, 6.0]),
    }
    feature = features_of(run, config, ROWS)
    decoded = run.call("decoder", zero_parameters(config, TASK) | biases, feature, TASK, config)
    run.holds("the keys are those of the observations", set(decoded) == set(TASK.observations))
    for key in ("position", "Speed", "mode"):
        run.exact(key, decoded[key], np.tile(biases[f"decoder/vector/out/{key}/bias"], (ROWS, 1)))
    sigmoids = {"depth": [0.5], "image": [0.9996646498695336, 0.18242552380635635, 0.9975273768433653]}
    for key, values in sigmoids.items():
        run.compare(key, decoded[key], np.broadcast_to(values, (ROWS, 8, 12, len(values))), bound=64 * run.u)


@check("NET-16", "NET-17", "NET-19", uses=["decoder"], level=1)
def stem_literals(run: Run) -> None:
    """2 blocks, a 1 x 2 map of 4 channels: outputs 0 1 4 5 and 2 3 6 7 of the memory, 0 1 2 3 and 4 5 6 7 of the
    latents share a pixel."""
    task = Spaces({"wide": Image(4, 8, 3), "thin": Image(4, 8, 1)}, ACTIONS)
    config = config_of(run, 1, cnn_multipliers=(4, 4), cnn_depth=1, norm_epsilon=1e-20)
    params = zero_parameters(config, task)
    params["decoder/image/conv0/kernel"][1, 1] = params["decoder/image/out/kernel"][1, 1] = np.eye(
        4
    )  # pixel i becomes pixel 2i
    numbers = np.arange(8.0)
    cases = {
        "deter": ([0, 1, 4, 5], [2, 3, 6, 7]),
        "stoch": ([0, 1, 2, 3], [4, 5, 6, 7]),
    }
    for name, pixels in cases.items():
        expected = np.full((1, 4, 8, 4), 0.5)
        for column, values in zip((0, 4), pixels, strict=True):
            expected[0, 0, column] = 1 / (1 + np.exp(-activated(*activated(*values))))
        arguments = params | {f"decoder/image/{name}/bias": numbers}, features_of(run, config, 1), task, config
        run.expect("decoder", arguments, {"thin": expected[..., :1], "wide": expected[..., 1:]}, magnitude="tensor")


@check(*(f"NET-{n}" for n in range(13, 20)), "NET-1", uses=["decoder"], level=1)
def decoder_matches(run: Run) -> None:
    """Reconstructions of vectors and images together and of each alone, with the kind of convolutions that the profile
    has."""
    compare_decoders(run, own_convolutions(run), (TASK, IMAGE_TASK, VECTOR_TASK))


@check("NET-17", "NET-18", uses=["decoder"], level=1)
def decoder_with_other_convolutions_matches(run: Run) -> None:
    """Vectors and images together with the other choices of `cnn_sampling` and `cnn_outer`."""
    compare_decoders(run, other_convolutions(run), (TASK,))


def compare_decoders(run: Run, kinds: list[int], tasks: tuple[Spaces, ...]) -> None:
    for index in kinds:
        for task in tasks:
            config = config_of(run, index, decoder_layers=2 + index % 2)
            params, feature = params_of(run, config, task, index), features_of(run, config, ROWS, seed=index)
            expected = reference.decoder(params, feature, task, config)
            actual = run.expect("decoder", (params, feature, task, config), expected, magnitude=largest(expected))
            for key in task.images:
                run.holds(
                    f"{key} lies between 0 and 1", (np.asarray(actual[key]) >= 0) & (np.asarray(actual[key]) <= 1)
                )


@check("NET-15", "NET-16", "NET-1", uses=["decoder"], level=1)
def image_decoder_separates_memory_and_latents(run: Run) -> None:
    """With only the memory's or only the latents' path, images depend on the first deter entries of the feature or on
    the others alone."""
    config = config_of(run)
    params, feature = params_of(run, config, IMAGE_TASK), features_of(run, config, ROWS)
    for path, kept in (("deter", slice(0, config.deter)), ("stoch", slice(config.deter, None))):
        other = "stoch" if path == "deter" else "deter"
        silenced = params | {
            f"decoder/image/{other}/{part}": 0 * params[f"decoder/image/{other}/{part}"] for part in ("kernel", "bias")
        }
        changed = features_of(run, config, ROWS, seed=1)
        changed[:, kept] = feature[:, kept]
        before = run.call("decoder", silenced, feature, IMAGE_TASK, config)
        after = run.call("decoder", silenced, changed, IMAGE_TASK, config)
        for key in IMAGES:
            run.exact(f"{key} by {path} alone", after[key], before[key])
            run.holds(f"{key} differs between rows", not np.array_equal(before[key][0], before[key][1]))


@check("NET-20", "NET-21", "NET-22", "NET-26", uses=[*HEADS, "actor"], level=1)
def heads_literals(run: Run) -> None:
    """With zero weights every head returns the biases of its output layer exactly: no tanh, no sigmoid, no mixture."""
    config = config_of(run)
    logits = np.arange(-15.0, 16) * 8
    params = zero_parameters(config, VECTOR_TASK) | {
        "reward/out/bias": logits,
        "critic/out/bias": -logits,
        "continue/out/bias": [-300.0],
    }
    biases: dict[str, dict[str, list[float]]] = {
        "Arm": {"mean": [300.0], "std": [-7.0]},
        "buttons": {"logits": [1.0, -100.0, 3.0, 0.0, 64.0]},
        "turn": {"mean": [5.0, -0.5], "std": [0.0, 9.0]},
    }
    for key, outputs in biases.items():
        params |= {f"actor/out/{key}/{output}/bias": np.array(values) for output, values in outputs.items()}
    params = {name: np.asarray(value, np.float64) for name, value in params.items()}
    feature = features_of(run, config, ROWS)
    run.exact("reward_head", run.call("reward_head", params, feature, config), np.tile(logits, (ROWS, 1)))
    run.exact("critic", run.call("critic", params, feature, config), np.tile(-logits, (ROWS, 1)))
    run.exact("continue_head", run.call("continue_head", params, feature, config), np.full(ROWS, -300.0))
    actual = run.call("actor", params, feature, VECTOR_TASK, config)
    run.holds("the keys are those of the actions", set(actual) == set(biases))
    for key, outputs in biases.items():
        run.holds(f"the outputs of {key}", set(actual[key]) == set(outputs))
        for output, values in outputs.items():
            run.exact(f"{key} {output}", actual[key][output], np.tile(values, (ROWS, 1)))


@check("NET-1", "NET-20", "NET-21", "NET-22", uses=[*HEADS, "actor"], level=1)
def heads_match(run: Run) -> None:
    """Random features of several scales, and other depths than usual."""
    layers = {f"{name}_layers": depth for name, depth in (("reward", 2), ("continue", 3), ("critic", 1), ("actor", 2))}

    @run.for_all(seed=seeds(), overrides=st.sampled_from([{}, layers]), scale=st.sampled_from([1e-2, 1.0, 30.0]))
    def _(seed: int, overrides: dict[str, Any], scale: float) -> None:
        config = config_of(run, **overrides)
        params = params_of(run, config, VECTOR_TASK, seed)
        feature = run.cast(normals(seed, ROWS, config.feature_size, scale=scale))
        for head in HEADS:
            expected = getattr(reference, head)(params, feature, config)
            run.expect(head, (params, feature, config), expected, magnitude=largest(expected))
        expected = reference.actor(params, feature, VECTOR_TASK, config)
        run.expect("actor", (params, feature, VECTOR_TASK, config), expected, magnitude=largest(expected))


@check("NET-23", uses=["critic"], level=1)
def critic_reads_the_slow_critic(run: Run) -> None:
    """The critic of a mapping that holds nothing but `critic/...`."""
    config = config_of(run)
    params, feature = params_of(run, config, VECTOR_TASK), features_of(run, config, ROWS)
    slow = {name: round_to(value * 1.25, "float32") for name, value in params.items() if name.startswith("critic/")}
    run.expect("critic", (slow, feature, config), reference.critic(slow, feature, config), magnitude="tensor")


@check("NET-24", uses=["encoder", "decoder", *HEADS, "actor"], level=1)
def leading_axes(run: Run) -> None:
    """No leading axes, or two of them."""
    config = config_of(run)
    params = params_of(run, config)
    for leading in ((), (2, 2)):
        observations, feature = observations_of(run.seed, TASK, leading), features_of(run, config, *leading)
        expected = reference.encoder(params, observations, TASK, config)
        run.expect("encoder", (params, observations, TASK, config), expected, magnitude="tensor")
        for network in (*HEADS, "decoder", "actor"):
            arguments = (params, feature, config) if network in HEADS else (params, feature, TASK, config)
            expected = getattr(reference, network)(*arguments)
            run.expect(network, arguments, expected, magnitude=largest(expected))


@check("NET-24", uses=["encoder", "decoder", *HEADS, "actor"], level=1)
def rows_do_not_influence_each_other(run: Run) -> None:
    """Other observations or features in one row change nothing in the others."""
    config = config_of(run)
    params, observations, feature = (
        params_of(run, config),
        observations_of(run.seed, TASK),
        features_of(run, config, ROWS),
    )
    changed = {key: value.copy() for key, value in observations.items()}
    for value in changed.values():
        value[0] = 1
    before, after = (run.call("encoder", params, x, TASK, config) for x in (observations, changed))
    run.exact("encoder", np.asarray(after)[1:], np.asarray(before)[1:])
    spoiled = feature.copy()
    spoiled[0] = np.nan
    for network in (*HEADS, "decoder", "actor"):
        rest = (config,) if network in HEADS else (TASK, config)
        before, after = (flat(run.call(network, params, x, *rest)) for x in (feature, spoiled))
        for name in before:
            run.exact(f"{network}{name}", after[name][1:], before[name][1:])


def flat(result: Any, name: str = "") -> dict[str, np.ndarray]:
    """The arrays of a nested result, by path."""
    if not isinstance(result, dict):
        return {name: np.asarray(result)}
    return {path: array for key, value in result.items() for path, array in flat(value, f"{name} {key}").items()}


@check("NET-12", uses=["encoder"], level=1)
def sides_that_cannot_be_halved(run: Run) -> None:
    """A height or width that is no multiple of two to the number of halvings is refused before any network runs."""
    for index in range(len(CONVOLUTIONS)):
        for height, width in ((10, 12), (8, 6), (9, 8)):
            task = Spaces({"image": Image(height, width, 1), "position": Vector(2)}, ACTIONS)
            run.refuses("encoder", {}, observations_of(run.seed, task), task, config_of(run, index))


@check("NET-2", "NET-6", "NET-27", "CON-6", "CON-8", uses=["encoder"], level=1)
def encoder_refuses(run: Run) -> None:
    """A missing key, a shape that does not fit, different numbers of rows, and images that are not uint8 are
    refused."""
    config = config_of(run)
    params, observations = params_of(run, config), observations_of(run.seed, TASK)
    for key, value in observations.items():
        run.refuses(
            "encoder", params, {name: x for name, x in observations.items() if name != key}, TASK, config, naming=[key]
        )
        shorter = value[..., :-1]
        run.refuses(
            "encoder",
            params,
            observations | {key: shorter},
            TASK,
            config,
            naming=[key, ", ".join(map(str, shorter.shape))],
        )
        for rows in (1, 2):
            run.refuses("encoder", params, observations | {key: value[:rows]}, TASK, config)
    for dtype in (np.float32, np.int64, np.int8):
        run.refuses(
            "encoder",
            params,
            observations | {"image": observations["image"].astype(dtype)},
            TASK,
            config,
            naming=["image"],
        )
    flipped = observations | {"image": observations["image"].swapaxes(1, 2).copy()}
    run.refuses("encoder", params, flipped, TASK, config)


@check("NET-27", "CON-8", uses=["decoder", *HEADS, "actor"], level=1)
def features_of_other_sizes_are_refused(run: Run) -> None:
    """A feature that is not deter + stoch x classes long is refused."""
    config = config_of(run)
    params = params_of(run, config)
    wider = dataclasses.replace(config, deter=config.deter + 2)
    for size in (config.feature_size - 1, config.feature_size + 1, 1):
        for head in HEADS:
            run.refuses(head, params, np.zeros((ROWS, size)), config, naming=["feature", f"{ROWS}, {size}"])
        for network in ("decoder", "actor"):
            run.refuses(network, params, np.zeros((ROWS, size)), TASK, config, naming=["feature", f"{ROWS}, {size}"])
    run.refuses("reward_head", params, np.zeros((ROWS, config.feature_size)), wider)
