"""Checks of spec/05-networks.md."""

import dataclasses
import math
from typing import Any

import hypothesis.strategies as st
import numpy as np

from conformance.case import Cases, Drawn, Equal, Setting, equal, exact, exactly, judged, refused, related
from conformance.check import check
from conformance.compare import BOUND, Comparisons, round_to
from conformance.problems import random_observations, random_parameters, small_config
from conformance.strategies import adversarial_numbers, arrays, normals, seeds
from conformance.worked import worked_cases
from reference_numpy import networks as reference
from spec import Config, Discrete, Image, Spaces, Vector, parameter_table

# A capital letter sorts before all small ones. The mapping of observations is given in another order than the sorted
# one.
VECTORS: dict[str, Vector | Discrete] = {"position": Vector(3), "mode": Discrete((3, 2)), "Speed": Vector(2)}
IMAGES: dict[str, Image] = {"image": Image(12, 16, 3), "depth": Image(12, 16, 1)}
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


def config_of(setting: Setting, index: int | None = None, **overrides: Any) -> Config:
    """A small configuration with the convolutions of that index; with None, of the kind that the profile has."""
    index = own_convolutions(setting)[0] if index is None else index
    return small_config(setting.profile, setting.dtype, **{"blocks": 2, **CONVOLUTIONS[index], **overrides})


def own_convolutions(setting: Setting) -> list[int]:
    """Which of CONVOLUTIONS is of the kind that the profile has. Code that has no other can be checked with it."""
    plain = small_config(setting.profile)
    kinds = [(kind["cnn_sampling"], kind["cnn_outer"]) for kind in CONVOLUTIONS]
    return [kinds.index((plain.cnn_sampling, plain.cnn_outer))]


def other_convolutions(setting: Setting) -> list[int]:
    return [index for index in range(len(CONVOLUTIONS)) if index not in own_convolutions(setting)]


def params_of(setting: Setting, config: Config, task: Spaces = TASK, seed: int = 0) -> dict[str, np.ndarray]:
    return random_parameters(np.random.default_rng(setting.seed + seed), config, task, setting.dtype)


def zero_parameters(config: Config, task: Spaces) -> dict[str, np.ndarray]:
    """All zero, but for the scales of RMSNorm, which are one."""
    return {
        name: np.full(entry.shape, float(entry.initializer == "ones"))
        for name, entry in parameter_table(config, task).items()
    }


def observations_of(seed: int, task: Spaces, leading: tuple[int, ...] = (ROWS,)) -> dict[str, np.ndarray]:
    drawn = random_observations(np.random.default_rng(seed), task, leading)
    return {key: drawn[key] for key in reversed(drawn)}


def features_of(setting: Setting, config: Config, *leading: int, seed: int = 0) -> np.ndarray:
    return setting.cast(normals(setting.seed + seed, *leading, config.feature_size))


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
def encoded_vector_literals(setting: Setting) -> Cases:
    """speed (0, e - 1) and item (2, 0) of Discrete((3, 2)) enter as (0, 0, 1, 1, 0, 0, 1): sorted keys, one-hots,
    symlog."""
    yield from worked_cases(
        setting, "networks", "vectors enter in sorted order", floor=1.25, bound=BOUND[setting.dtype]
    )


@check("NET-2", "NET-3", "NET-5", "NET-11", "NET-26", "CON-24", "CON-26", uses=["encoder"], level=1)
def encoder_of_vectors_matches(setting: Setting) -> Cases:
    """Tokens of vectors that hold zeros, subnormals and the largest float32, and of discrete entries; nothing else is
    read."""
    config = config_of(setting, encoder_layers=2)
    numbers = st.one_of(adversarial_numbers(finite=True), st.sampled_from([LARGEST, -LARGEST]))

    def case(seed: int, position: np.ndarray, speed: np.ndarray) -> Cases:
        params = params_of(setting, config, VECTOR_TASK, seed)
        vectors = {"position": position.astype(np.float32), "Speed": speed.astype(np.float32)}
        observations = observations_of(seed, VECTOR_TASK) | vectors
        expected = reference.encoder(params, observations, VECTOR_TASK, config)
        other = {
            "reward": np.full(ROWS, np.nan),
            "is_first": np.ones(ROWS, bool),
            "prev_action": np.full((ROWS, 8), np.nan),
        }
        yield equal("encoder", (params, other | observations, VECTOR_TASK, config), expected, magnitude="tensor")

    yield Drawn(case, seed=seeds(), position=arrays(numbers, (ROWS, 3)), speed=arrays(numbers, (ROWS, 2)))


@check("NET-4", uses=["encoder"], level=1)
def integers_of_any_kind(setting: Setting) -> Cases:
    """A Discrete observation may have any integer dtype, and no other."""
    config = config_of(setting)
    params, observations = params_of(setting, config, VECTOR_TASK), observations_of(setting.seed, VECTOR_TASK)
    mode = observations["mode"]
    for dtype in (np.uint8, np.int32, np.int64):

        def same(c: Comparisons, before: np.ndarray, after: np.ndarray, dtype: type = dtype) -> None:
            c.exact(f"tokens of {np.dtype(dtype)}", after, before)

        inputs = (observations, observations | {"mode": mode.astype(dtype)})
        yield related(same, *(("encoder", (params, x, VECTOR_TASK, config)) for x in inputs))
    for real in (np.float32, np.float64):
        wrong = observations | {"mode": mode.astype(real)}
        yield refused("encoder", params, wrong, VECTOR_TASK, config, naming=["mode"])


@check("NET-2", "NET-24", uses=["encoder"], level=1)
def non_finite_vectors_show(setting: Setting) -> Cases:
    """NaN or infinity in a vector gives tokens that are not finite in its own row, and changes nothing in the
    others."""
    config = config_of(setting)
    params, observations = params_of(setting, config, VECTOR_TASK), observations_of(setting.seed, VECTOR_TASK)
    for bad in (np.nan, np.inf):

        def shows(c: Comparisons, before: np.ndarray, after: np.ndarray, bad: float = bad) -> None:
            tokens = np.asarray(after)
            c.holds(f"tokens with {bad} are not finite", not np.isfinite(tokens[1]).all())
            c.exact("tokens of the other rows", tokens[[0, 2]], np.asarray(before)[[0, 2]])

        position = observations["position"].copy()
        position[1, 2] = bad
        inputs = (observations, observations | {"position": position})
        yield related(shows, *(("encoder", (params, x, VECTOR_TASK, config)) for x in inputs))


@check("NET-6", "NET-8", "NET-9", "NET-10", uses=["encoder"], level=1)
def brightness_literals(setting: Setting) -> Cases:
    """Brightness 0, 1, 127, 128 and 255 enters as -0.5, -0.4961, -0.00196, 0.00196 and 0.5, also in a picture that
    holds nothing else."""
    task = Spaces({"image": Image(12, 12, 1)}, ACTIONS)
    config = config_of(setting, 1, cnn_multipliers=(2, 2), cnn_depth=1, norm_epsilon=0.0)
    params = zero_parameters(config, task) | {"encoder/image/conv0/bias": np.array([0.0, 1.0])}
    params["encoder/image/conv0/kernel"][1, 1, 0, 0] = 1  # the top left pixel of four, beside a constant channel
    params["encoder/image/conv1/kernel"][1, 1] = np.eye(2)
    entering = {0: -0.5, 1: -0.49607843137, 127: -0.00196078431, 128: 0.00196078431, 255: 0.5}
    # A picture without any number above 1 is scaled like all others.
    for brightness in ([0, 1, 127, 128, 255], [1, 0, 1, 1, 0]):
        image = np.broadcast_to(np.array(brightness, np.uint8)[:, None, None, None], (5, 12, 12, 1)).copy()
        pixels = np.array([activated(*activated(entering[number], 1)) for number in brightness])
        expected = np.tile(pixels, 9)  # all of 3 x 3 are equal
        bound = 1e-9 if setting.u < 1e-10 else None
        yield equal("encoder", (params, {"image": image}, task, config), expected, magnitude="tensor", bound=bound)


@check("NET-8", "NET-9", uses=["encoder"], level=1)
def pooling_comes_before_normalization(setting: Setting) -> Cases:
    """Convolution outputs (3, 0), (0, 4), (0, 0), (0, 0) are pooled to (3, 4) and then become (0.594189, 0.855420)."""
    task = Spaces({"image": Image(12, 12, 2)}, ACTIONS)
    config = config_of(setting, 3, cnn_multipliers=(2, 2), cnn_depth=1, norm_epsilon=0.0)
    params = zero_parameters(config, task) | {"encoder/image/conv0/bias": np.array([1.5, 2.0])}
    params["encoder/image/conv0/kernel"][2, 2] = np.diag([3.0, 4.0])
    params["encoder/image/conv1/kernel"][2, 2] = np.eye(2)
    image = np.zeros((1, 12, 12, 2), np.uint8)
    image[:, 0::2, 0::2, 0] = image[:, 0::2, 1::2, 1] = 255
    expected = np.tile(activated(*activated(3, 4)), 9)[None]  # all of 3 x 3 are equal
    yield equal("encoder", (params, {"image": image}, task, config), expected, magnitude="tensor")


@check("NET-6", "NET-26", uses=["encoder"], level=1)
def brightness_is_scaled_in_float32(setting: Setting) -> Cases:
    """The two greys nearest to 0 differ by 1/255 whatever the compute dtype: bfloat16 would halve or double one of
    them."""
    task = Spaces({"image": Image(12, 12, 1)}, ACTIONS)
    config = config_of(setting, norm_epsilon=1e-12)
    params = params_of(setting, config, task)
    params |= {
        name: np.zeros_like(value)
        for name, value in params.items()
        if name.startswith("encoder/image/") and name.endswith("bias")
    }
    observations = {"image": setting.rng().integers(127, 129, (ROWS, 12, 12, 1)).astype(np.uint8)}
    expected = reference.encoder(params, observations, task, config)
    # x / 255 - 1/2 loses the digits that cancel.
    bound = {"float64": 1e-11, "float32": 1e-3, "bfloat16": 0.125}[setting.dtype]
    yield equal("encoder", (params, observations, task, config), expected, magnitude="tensor", bound=bound)


@check("NET-3", *(f"NET-{n}" for n in range(6, 12)), "CON-6", uses=["encoder"], level=1)
def encoder_matches(setting: Setting) -> Cases:
    """Tokens of vectors and images together and of images alone, with the kind of convolutions that the profile has."""
    yield from encoders(setting, own_convolutions(setting))


@check("NET-8", "NET-9", uses=["encoder"], level=1)
def encoder_with_other_convolutions_matches(setting: Setting) -> Cases:
    """The same with the other choices of `cnn_sampling` and `cnn_outer`."""
    yield from encoders(setting, other_convolutions(setting))


def encoders(setting: Setting, kinds: list[int]) -> Cases:
    for index in kinds:
        for task in (TASK, IMAGE_TASK):
            config = config_of(setting, index)
            params, observations = params_of(setting, config, task, index), observations_of(setting.seed + index, task)
            expected = reference.encoder(params, observations, task, config)
            yield equal("encoder", (params, observations, task, config), expected, magnitude="tensor")


@check("NET-14", "NET-18", "NET-19", "NET-26", uses=["decoder"], level=1)
def decoder_literals(setting: Setting) -> Cases:
    """With zero weights: vectors and logits are the biases as they are, images the sigmoid of theirs, computed in
    float32 or better."""
    config = config_of(setting)
    biases = {
        "decoder/vector/out/position/bias": np.array([20.0, -3.0, 0.5]),
        "decoder/vector/out/Speed/bias": np.array([-200.0, 0.0]),
        "decoder/vector/out/mode/bias": np.array([1.0, 2.0, -300.0, 8.0, 0.25]),
        "decoder/image/out/bias": np.array([0.0, 8.0, -1.5, 6.0]),
    }
    feature = features_of(setting, config, ROWS)
    sigmoids = {"depth": [0.5], "image": [0.9996646498695336, 0.18242552380635635, 0.9975273768433653]}

    def keys(c: Comparisons, decoded: Any) -> None:
        c.holds("the keys are those of the observations", set(decoded) == set(TASK.observations))

    yield judged(
        "decoder",
        (zero_parameters(config, TASK) | biases, feature, TASK, config),
        keys,
        *(
            exactly(np.tile(biases[f"decoder/vector/out/{key}/bias"], (ROWS, 1)), at=(key,), where=key)
            for key in ("position", "Speed", "mode")
        ),
        *(
            Equal(np.broadcast_to(values, (ROWS, 12, 16, len(values))), at=(key,), where=key, bound=64 * setting.u)
            for key, values in sigmoids.items()
        ),
    )


@check("NET-16", "NET-17", "NET-19", uses=["decoder"], level=1)
def stem_literals(setting: Setting) -> Cases:
    """2 blocks, a 3 x 4 map of 4 channels: outputs 0 1 24 25 and 2 3 26 27 of the memory, 0 1 2 3 and 4 5 6 7 of the
    latents share a pixel, and so on row by row."""
    task = Spaces({"wide": Image(12, 16, 3), "thin": Image(12, 16, 1)}, ACTIONS)
    config = config_of(setting, 1, cnn_multipliers=(4, 4), cnn_depth=1, norm_epsilon=1e-20)
    params = zero_parameters(config, task)
    # Pixel i becomes pixel 4i in both directions.
    params["decoder/image/conv0/kernel"][1, 1] = params["decoder/image/out/kernel"][1, 1] = np.eye(4)
    numbers = np.arange(48.0)
    # Of each pixel the first channel, and what the other three are more than that.
    layouts = {"deter": (2, (0, 1, 24, 25)), "stoch": (4, (0, 1, 2, 3))}
    for name, (step, channels) in layouts.items():
        expected = np.full((1, 12, 16, 4), 0.5)
        for pixel in range(12):
            values = activated(*activated(*(step * pixel + channel for channel in channels)))
            expected[0, 4 * (pixel // 4), 4 * (pixel % 4)] = 1 / (1 + np.exp(-values))
        arguments = params | {f"decoder/image/{name}/bias": numbers}, features_of(setting, config, 1), task, config
        yield equal("decoder", arguments, {"thin": expected[..., :1], "wide": expected[..., 1:]}, magnitude="tensor")


@check(*(f"NET-{n}" for n in range(13, 20)), "NET-1", uses=["decoder"], level=1)
def decoder_matches(setting: Setting) -> Cases:
    """Reconstructions of vectors and images together and of each alone, with the kind of convolutions that the profile
    has."""
    yield from decoders(setting, own_convolutions(setting), (TASK, IMAGE_TASK, VECTOR_TASK))


@check("NET-17", "NET-18", uses=["decoder"], level=1)
def decoder_with_other_convolutions_matches(setting: Setting) -> Cases:
    """Vectors and images together with the other choices of `cnn_sampling` and `cnn_outer`."""
    yield from decoders(setting, other_convolutions(setting), (TASK,))


def decoders(setting: Setting, kinds: list[int], tasks: tuple[Spaces, ...]) -> Cases:
    for index in kinds:
        for task in tasks:
            config = config_of(setting, index, decoder_layers=2 + index % 2)
            params, feature = params_of(setting, config, task, index), features_of(setting, config, ROWS, seed=index)
            expected = reference.decoder(params, feature, task, config)
            golden = Equal(expected, magnitude=largest(expected))
            yield judged("decoder", (params, feature, task, config), golden, images_are_brightness)


def images_are_brightness(c: Comparisons, decoded: Any) -> None:
    for key in IMAGES:
        if key in decoded:
            image = np.asarray(decoded[key])
            c.holds(f"{key} lies between 0 and 1", (image >= 0) & (image <= 1))


@check("NET-15", "NET-16", "NET-1", uses=["decoder"], level=1)
def image_decoder_separates_memory_and_latents(setting: Setting) -> Cases:
    """With only the memory's or only the latents' path, images depend on the first deter entries of the feature or on
    the others alone."""
    config = config_of(setting)
    params, feature = params_of(setting, config, IMAGE_TASK), features_of(setting, config, ROWS)
    for path, kept in (("deter", slice(0, config.deter)), ("stoch", slice(config.deter, None))):
        other = "stoch" if path == "deter" else "deter"
        silenced = params | {
            f"decoder/image/{other}/{part}": 0 * params[f"decoder/image/{other}/{part}"] for part in ("kernel", "bias")
        }
        changed = features_of(setting, config, ROWS, seed=1)
        changed[:, kept] = feature[:, kept]

        def same(c: Comparisons, before: Any, after: Any, path: str = path) -> None:
            for key in IMAGES:
                c.exact(f"{key} by {path} alone", after[key], before[key])
                c.holds(f"{key} differs between rows", not np.array_equal(before[key][0], before[key][1]))

        yield related(same, *(("decoder", (silenced, x, IMAGE_TASK, config)) for x in (feature, changed)))


@check("NET-20", "NET-21", "NET-22", "NET-26", uses=[*HEADS, "actor"], level=1)
def heads_literals(setting: Setting) -> Cases:
    """With zero weights every head returns the biases of its output layer exactly: no tanh, no sigmoid, no mixture."""
    config = config_of(setting)
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
    feature = features_of(setting, config, ROWS)
    yield exact("reward_head", (params, feature, config), np.tile(logits, (ROWS, 1)))
    yield exact("critic", (params, feature, config), np.tile(-logits, (ROWS, 1)))
    yield exact("continue_head", (params, feature, config), np.full(ROWS, -300.0))

    def keys(c: Comparisons, actual: Any) -> None:
        c.holds("the keys are those of the actions", set(actual) == set(biases))
        for key, outputs in biases.items():
            c.holds(f"the outputs of {key}", set(actual[key]) == set(outputs))

    yield judged(
        "actor",
        (params, feature, VECTOR_TASK, config),
        keys,
        *(
            exactly(np.tile(values, (ROWS, 1)), at=(key, output), where=f"{key} {output}")
            for key, outputs in biases.items()
            for output, values in outputs.items()
        ),
    )


@check("NET-1", "NET-20", "NET-21", "NET-22", uses=[*HEADS, "actor"], level=1)
def heads_match(setting: Setting) -> Cases:
    """Random features of several scales, and other depths than usual."""
    layers = {f"{name}_layers": depth for name, depth in (("reward", 2), ("continue", 3), ("critic", 1), ("actor", 2))}

    def case(seed: int, overrides: dict[str, Any], scale: float) -> Cases:
        config = config_of(setting, **overrides)
        params = params_of(setting, config, VECTOR_TASK, seed)
        feature = setting.cast(normals(seed, ROWS, config.feature_size, scale=scale))
        for head in HEADS:
            expected = getattr(reference, head)(params, feature, config)
            yield equal(head, (params, feature, config), expected, magnitude=largest(expected))
        expected = reference.actor(params, feature, VECTOR_TASK, config)
        yield equal("actor", (params, feature, VECTOR_TASK, config), expected, magnitude=largest(expected))

    yield Drawn(case, seed=seeds(), overrides=st.sampled_from([{}, layers]), scale=st.sampled_from([1e-2, 1.0, 30.0]))


@check("NET-23", uses=["critic"], level=1)
def critic_reads_the_slow_critic(setting: Setting) -> Cases:
    """The critic of a mapping that holds nothing but `critic/...`."""
    config = config_of(setting)
    params, feature = params_of(setting, config, VECTOR_TASK), features_of(setting, config, ROWS)
    slow = {name: round_to(value * 1.25, "float32") for name, value in params.items() if name.startswith("critic/")}
    yield equal("critic", (slow, feature, config), reference.critic(slow, feature, config), magnitude="tensor")


@check("NET-24", uses=["encoder", "decoder", *HEADS, "actor"], level=1)
def leading_axes(setting: Setting) -> Cases:
    """No leading axes, or two of them."""
    config = config_of(setting)
    params = params_of(setting, config)
    for leading in ((), (2, 2)):
        observations, feature = observations_of(setting.seed, TASK, leading), features_of(setting, config, *leading)
        expected = reference.encoder(params, observations, TASK, config)
        yield equal("encoder", (params, observations, TASK, config), expected, magnitude="tensor")
        for network in (*HEADS, "decoder", "actor"):
            arguments = (params, feature, config) if network in HEADS else (params, feature, TASK, config)
            expected = getattr(reference, network)(*arguments)
            yield equal(network, arguments, expected, magnitude=largest(expected))


@check("NET-24", uses=["encoder", "decoder", *HEADS, "actor"], level=1)
def rows_do_not_influence_each_other(setting: Setting) -> Cases:
    """Other observations or features in one row change nothing in the others."""
    config = config_of(setting)
    params, observations = params_of(setting, config), observations_of(setting.seed, TASK)
    changed = {key: value.copy() for key, value in observations.items()}
    for value in changed.values():
        value[0] = 1
    feature = features_of(setting, config, ROWS)
    spoiled = feature.copy()
    spoiled[0] = np.nan
    for network in ("encoder", *HEADS, "decoder", "actor"):

        def same(c: Comparisons, before: Any, after: Any, network: str = network) -> None:
            for name, array in flat(before).items():
                c.exact(f"{network}{name}", flat(after)[name][1:], array[1:])

        inputs = (observations, changed) if network == "encoder" else (feature, spoiled)
        rest = (config,) if network in HEADS else (TASK, config)
        yield related(same, *((network, (params, x, *rest)) for x in inputs))


def flat(result: Any, name: str = "") -> dict[str, np.ndarray]:
    """The arrays of a nested result, by path."""
    if not isinstance(result, dict):
        return {name: np.asarray(result)}
    return {path: array for key, value in result.items() for path, array in flat(value, f"{name} {key}").items()}


@check("NET-12", uses=["encoder"], level=1)
def sides_that_cannot_be_halved(setting: Setting) -> Cases:
    """A height or width that is no multiple of two to the number of halvings is refused before any network runs."""
    for index in range(len(CONVOLUTIONS)):
        for height, width in ((10, 12), (8, 6), (9, 8)):
            task = Spaces({"image": Image(height, width, 1), "position": Vector(2)}, ACTIONS)
            yield refused("encoder", {}, observations_of(setting.seed, task), task, config_of(setting, index))


@check("NET-2", "NET-6", "NET-27", "CON-6", "CON-8", uses=["encoder"], level=1)
def encoder_refuses(setting: Setting) -> Cases:
    """A missing key, a shape that does not fit, different numbers of rows, and images that are not uint8 are
    refused."""
    config = config_of(setting)
    params, observations = params_of(setting, config), observations_of(setting.seed, TASK)
    for key, value in observations.items():
        missing = {name: x for name, x in observations.items() if name != key}
        yield refused("encoder", params, missing, TASK, config, naming=[key])
        shorter = value[..., :-1]
        naming = [key, ", ".join(map(str, shorter.shape))]
        yield refused("encoder", params, observations | {key: shorter}, TASK, config, naming=naming)
        for rows in (1, 2):
            yield refused("encoder", params, observations | {key: value[:rows]}, TASK, config)
    for dtype in (np.float32, np.int64, np.int8):
        wrong = observations | {"image": observations["image"].astype(dtype)}
        yield refused("encoder", params, wrong, TASK, config, naming=["image"])
    flipped = observations | {"image": observations["image"].swapaxes(1, 2).copy()}
    yield refused("encoder", params, flipped, TASK, config)


@check("NET-27", "CON-8", uses=["decoder", *HEADS, "actor"], level=1)
def features_of_other_sizes_are_refused(setting: Setting) -> Cases:
    """A feature that is not deter + stoch x classes long is refused."""
    config = config_of(setting)
    params = params_of(setting, config)
    wider = dataclasses.replace(config, deter=config.deter + 2)
    for size in (config.feature_size - 1, config.feature_size + 1, 1):
        for head in HEADS:
            yield refused(head, params, np.zeros((ROWS, size)), config, naming=["feature", f"{ROWS}, {size}"])
        for network in ("decoder", "actor"):
            yield refused(network, params, np.zeros((ROWS, size)), TASK, config, naming=["feature", f"{ROWS}, {size}"])
    yield refused("reward_head", params, np.zeros((ROWS, config.feature_size)), wider)
