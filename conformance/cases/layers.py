"""Checks of spec/03-layers.md."""

from collections.abc import Iterable
from typing import Any

import hypothesis.strategies as st
import numpy as np

from conformance.case import Case, Cases, Drawn, Equal, Setting, equal, exact, exactly, judged, refused, related
from conformance.check import check, script
from conformance.compare import EPSILON, WIDE, Comparisons, round_to
from conformance.problems import random_parameters, small_config, spaces
from conformance.script import Script
from conformance.strategies import adversarial_numbers, arrays, normals, seeds
from conformance.worked import worked, worked_cases
from reference_numpy import layers as reference
from reference_numpy import networks
from spec import Image, Spaces, Vector, parameter_table

LEADING = st.sampled_from([(), (2, 3)])
SUMS = ("linear", "block_linear", "convolution", "transposed_convolution")
SCALES = st.sampled_from([1e-3, 1.0, 300.0])
# Of a few operations.
LITERAL = {"float64": 1e-12, "float32": 4e-7, "bfloat16": EPSILON["bfloat16"]}


def equal_sums(setting: Setting, function: str, arguments: tuple[Any, ...], terms: int, *, roundings: int = 2) -> Case:
    """A layer that sums `terms` products and a bias, [LAY-1]. In bfloat16 its result and that of its products may be
    rounded."""
    x, kernel, bias, *rest = arguments
    layer, dtype = getattr(reference, function), setting.dtype
    magnitude = layer(np.abs(x), np.abs(kernel), np.abs(bias), *rest)
    bound = roundings * 0.51 * EPSILON[dtype] if dtype == "bfloat16" else (terms + 16) * EPSILON[dtype]
    return equal(function, arguments, layer(*arguments), magnitude=magnitude, bound=bound)


def is_double(actual: Any, expected: np.ndarray) -> bool:
    """Whether somebody who was asked for bfloat16 computed in float64, as the reference always does."""
    return np.shape(actual) == expected.shape and np.allclose(actual, expected, rtol=1e-9, atol=0)


def one_tap(row: int, column: int) -> np.ndarray:
    kernel = np.zeros((5, 5, 1, 1))
    kernel[row, column] = 1
    return kernel


def quantiles() -> np.ndarray:
    """Truncated normal weights of standard deviation 1 at the uniforms 0, 1/4, 1/2, 3/4 and 0.9."""
    return np.asarray(worked("layers", "initial weights")[0].expected)


@check("LAY-2", "LAY-3", uses=["linear", "block_linear"], level=0)
def linear_literals(setting: Setting) -> Cases:
    """[1, 2] gives [9.5, 12, 14.5]; with two blocks [1, 2, 3, 4] gives [21, 4301]; one block is a linear layer."""
    positions = ("two outputs per block", "one block is a linear map")
    yield from worked_cases(setting, "layers", "a linear map", *positions)
    large, _ = worked_cases(setting, "layers", "a block-linear map", bound=LITERAL[setting.dtype])
    _, small = worked_cases(setting, "layers", "a block-linear map")
    yield from (large, small)  # bfloat16 holds the numbers of the second alone


@check("LAY-1", "LAY-2", "LAY-3", "LAY-16", "CON-30", uses=["linear", "block_linear"], level=0)
def linear_matches(setting: Setting) -> Cases:
    """Any leading axes, inputs of several magnitudes, few terms and many."""

    def case(seed: int, leading: tuple[int, ...], sizes: tuple[int, int], scale: float) -> Cases:
        inputs, outputs = sizes
        cast = setting.cast
        x = cast(normals(seed, *leading, inputs, scale=scale))
        kernel, bias = cast(normals(seed + 1, inputs, outputs)), cast(normals(seed + 2, outputs))
        yield equal_sums(setting, "linear", (x, kernel, bias), inputs)
        kernel, bias = cast(normals(seed + 3, 4, inputs // 4, outputs)), cast(normals(seed + 4, 4 * outputs))
        yield equal_sums(setting, "block_linear", (x, kernel, bias), inputs // 4)

    yield Drawn(case, seed=seeds(), leading=LEADING, sizes=st.sampled_from([(8, 5), (96, 3)]), scale=SCALES)


@check("LAY-1", "CON-23", uses=SUMS, level=0)
def long_sums_are_accurate(setting: Setting) -> Cases:
    """Thousands of positive products: sums that are kept in less than float32 stop growing."""
    rng, cast = setting.rng(), setting.cast
    x, kernel = cast(rng.uniform(0.5, 1, (2, 4096))), cast(rng.uniform(0.5, 1, (4096, 8)))
    yield equal_sums(setting, "linear", (x, kernel, np.zeros(8)), 4096, roundings=1)
    yield equal_sums(setting, "block_linear", (x, kernel.reshape(2, 2048, 8), np.zeros(16)), 2048, roundings=1)
    x, kernel = cast(rng.uniform(0.5, 1, (4, 4, 64))), cast(rng.uniform(0.5, 1, (5, 5, 64, 2)))
    yield equal_sums(setting, "convolution", (x, kernel, np.zeros(2), 1), 1600, roundings=1)
    yield equal_sums(setting, "convolution", (x, kernel, np.zeros(2), 2), 1600, roundings=1)
    yield equal_sums(setting, "transposed_convolution", (x, kernel, np.zeros(2)), 576, roundings=1)


@check("LAY-1", "LAY-4", "CON-22", uses=[*SUMS, "rms_norm", "silu", "dense"], level=0, dtypes=("bfloat16",))
def results_have_the_compute_dtype(setting: Setting) -> Cases:
    """Float32 parameters beside bfloat16 inputs are rounded to bfloat16, and so is the result; who computes in float64
    is let off."""
    rng = setting.rng()
    kernel, bias, scale = (round_to(rng.normal(size=shape), "float32") for shape in ((5, 5, 2, 3), (3,), (3,)))
    x = setting.cast(rng.normal(size=(4, 6, 2)))
    params = {"layer/kernel": kernel[0, 0], "layer/bias": bias, "layer/scale": scale}

    def rounded(function: str, *arguments: Any) -> Case:
        expected = getattr(reference, function)(*arguments)

        def is_bfloat16(c: Comparisons, result: np.ndarray) -> None:
            double = is_double(result, expected)
            same = np.array_equal(np.asarray(result, np.float64), round_to(result, "bfloat16"))
            c.holds(f"{function} gives bfloat16 numbers", double or same)

        return judged(function, arguments, is_bfloat16)

    yield rounded("linear", x, kernel[0, 0], bias)
    yield rounded("block_linear", x, kernel[:2, 0, :1], np.append(bias, bias))
    yield rounded("convolution", x, kernel, bias, 1)
    yield rounded("convolution", x, kernel, bias, 2)
    yield rounded("transposed_convolution", x, kernel, bias)
    yield rounded("rms_norm", setting.cast(rng.normal(size=(4, 3))), scale, 1e-4)
    yield rounded("dense", params, "layer", x, 1e-4)

    one = np.array([1.0])

    def difference(c: Comparisons, silu: np.ndarray, result: np.ndarray) -> None:
        # 1 + 2^-9 becomes 1: nothing is left of the difference.
        expected = np.array([2.0**-9 if is_double(silu, reference.silu(one)) else 0])
        c.exact("the kernel is rounded to bfloat16", result, expected)

    kernel = np.array([[1 + 2.0**-9], [-1]])
    yield related(difference, ("silu", (one,)), ("linear", (np.ones(2), kernel, np.zeros(1))))


@check("LAY-4", uses=["rms_norm"], level=0)
def rms_norm_literals(setting: Setting) -> Cases:
    """[3, 4] becomes [.8485247, 1.1313663]; epsilon rules tiny rows; zeros stay zero; no mean is taken off; a NaN
    spoils its row only."""
    rounding = LITERAL[setting.dtype]
    yield from worked_cases(setting, "layers", "a norm", "a norm where epsilon counts", bound=rounding)
    huge = setting.cast([[1e18, -1e18, 1e18, 1e18], [1.0, 1, -1, 1]])
    yield equal("rms_norm", (huge, np.ones(4), 1e-4), np.sign(huge), bound=max(rounding, 1e-4))
    broken, expected = np.array([[1.0, np.nan], [0, 0]]), np.array([[np.nan, np.nan], [0, 0]])
    yield exact("rms_norm", (broken, np.ones(2), 1e-4), expected, where="NaN")


@check("LAY-1", "LAY-4", "LAY-16", uses=["rms_norm"], level=0)
def rms_norm_matches(setting: Setting) -> Cases:
    """Rows of several magnitudes and any leading axes, each on its own, images too; in bfloat16 the scale and the
    result are rounded."""

    def case(seed: int, leading: tuple[int, ...], n: int, scale: float) -> Cases:
        rng = np.random.default_rng(seed)
        x = setting.cast(rng.normal(0.5, 1, (*leading, n)) * scale * 10 ** rng.uniform(-1, 1, (*leading, 1)))
        weight = round_to(rng.normal(1, 0.5, n), WIDE[setting.dtype])  # a parameter: float32 beside bfloat16 inputs
        expected = reference.rms_norm(x, weight, 1e-4)

        def rounded(c: Comparisons, actual: np.ndarray) -> None:
            right = expected if is_double(actual, expected) else reference.rms_norm(x, setting.cast(weight), 1e-4)
            c.compare("rms_norm", actual, right, bound=0.51 * EPSILON["bfloat16"])

        demand = rounded if setting.dtype == "bfloat16" else Equal(expected, bound=(n + 16) * setting.u)
        yield judged("rms_norm", (x, weight, 1e-4), demand)

    scale = st.sampled_from([1e-4, 1e-2, 1.0, 1e4])
    yield Drawn(case, seed=seeds(), leading=LEADING, n=st.sampled_from([5, 64]), scale=scale)


@check("LAY-5", uses=["silu"], level=0)
def silu_literals(setting: Setting) -> Cases:
    """silu of 1, -1, 2 and -20; zeros, infinities, NaN and huge numbers."""
    floor = (
        0.25 if setting.dtype == "bfloat16" else 0.0
    )  # beside 1, which a sigmoid may add, silu(-20) is nothing there
    yield from worked_cases(setting, "layers", "silu", floor=floor, bound=2 * LITERAL[setting.dtype])
    special = setting.cast([0.0, -0.0, np.inf, -np.inf, np.nan, -1e30, -3e38, 1e30, 3e38])
    yield exact("silu", (special,), np.array([0, 0, np.inf, np.nan, np.nan, 0, 0, special[7], special[8]]))


@check("LAY-5", uses=["silu"], level=0)
def silu_matches(setting: Setting) -> Cases:
    """Any numbers, any shape; small negative results keep their relative precision."""

    def case(x: np.ndarray) -> Cases:
        x = setting.cast(x)
        expected = reference.silu(x)
        size = np.where(np.isfinite(x), np.abs(x), 0)
        if setting.dtype == "bfloat16":
            yield equal("silu", (x,), expected, magnitude=size, bound=2 * EPSILON["bfloat16"])
        else:
            finite = np.where(np.isfinite(expected), np.abs(expected), 0)
            magnitude = np.minimum(16 * (1 + size) * finite + 128 * setting.tiny / setting.u, 1e300)
            yield equal("silu", (x,), expected, magnitude=magnitude, bound=setting.u)

    numbers = st.one_of(adversarial_numbers(), st.floats(-120, 20, width=32))
    yield Drawn(case, x=LEADING.flatmap(lambda shape: arrays(numbers, shape)))


@check("LAY-6", uses=["convolution"], level=0)
def convolution_literals(setting: Setting) -> Cases:
    """Padding 2 and 2 at stride 1, 1 and 2 at stride 2; taps are not flipped, rows and columns not exchanged; the bias
    comes once."""
    yield from worked_cases(setting, "layers", "counting taps at stride 1", "counting taps at stride 2")
    yield from worked_cases(setting, "layers", "where the taps of stride 1 look", "where the taps of stride 2 look")
    yield from worked_cases(setting, "layers", "channels and leading axes")
    no_taps, bias = np.zeros((5, 5, 1, 1)), np.array([2.5])
    yield exact("convolution", (np.ones((4, 4, 1)), no_taps, bias, 2), np.full((2, 2, 1), 2.5), where="bias")
    pixels = (10.0 * np.arange(4)[:, None] + np.arange(6))[..., None]
    shifted = np.pad(pixels[:3, 1:], ((1, 0), (0, 1), (0, 0)))
    yield exact("convolution", (pixels, one_tap(1, 3), np.zeros(1), 1), shifted, where="tap (1, 3) at stride 1")


@check("LAY-7", uses=["transposed_convolution"], level=0)
def transposed_convolution_literals(setting: Setting) -> Cases:
    """A pixel of 1 shows taps 1 and 2, not flipped; ones count the taps 1, 2, 2, 2; the bias comes once to every
    output."""
    yield from worked_cases(setting, "layers", "a transposed pixel", "counting transposed taps", "a transposed bias")
    pixel, corner = np.zeros((3, 2, 1)), np.zeros((6, 4, 1))
    pixel[2, 0] = 1
    corner[3, 1] = 1  # from the pixel (2, 0), as 2 * 2 - 1 and 2 * 0 + 1
    yield exact("transposed_convolution", (pixel, one_tap(0, 2), np.zeros(1)), corner, where="tap (0, 2)")


@check("LAY-1", "LAY-6", "LAY-7", "LAY-16", "CON-30", uses=["convolution", "transposed_convolution"], level=0)
def convolutions_match(setting: Setting) -> Cases:
    """Random images whose sides and channels all differ, with any leading axes."""

    def case(seed: int, leading: tuple[int, ...], scale: float) -> Cases:
        x = setting.cast(normals(seed, *leading, 4, 6, 3, scale=scale))
        kernel, bias = setting.cast(normals(seed + 1, 5, 5, 3, 2)), setting.cast(normals(seed + 2, 2))
        yield equal_sums(setting, "convolution", (x, kernel, bias, 1), 75)
        yield equal_sums(setting, "convolution", (x, kernel, bias, 2), 75)
        yield equal_sums(setting, "transposed_convolution", (x, kernel, bias), 27)

    yield Drawn(case, seed=seeds(), leading=LEADING, scale=SCALES)


@check("LAY-7", uses=["convolution", "transposed_convolution"], level=0)
def transposed_convolution_is_the_adjoint(setting: Setting) -> Cases:
    """<convolution(y, w, 2), x> is <y, transposed(x, w')>, w' being w with its last two axes exchanged."""

    def case(seed: int) -> Cases:
        y, x = setting.cast(normals(seed, 6, 8, 3)), setting.cast(normals(seed + 1, 3, 4, 2))
        kernel = setting.cast(normals(seed + 2, 5, 5, 3, 2))

        def adjoint(c: Comparisons, down: np.ndarray, up: np.ndarray) -> None:
            down, up = np.asarray(down, np.float64) * x, np.asarray(up, np.float64) * y
            magnitude = np.abs(down).sum() + np.abs(up).sum()
            c.compare("inner products", up.sum(), down.sum(), magnitude=magnitude)

        yield related(
            adjoint,
            ("convolution", (y, kernel, np.zeros(2), 2)),
            ("transposed_convolution", (x, kernel.swapaxes(2, 3).copy(), np.zeros(3))),
        )

    yield Drawn(case, seed=seeds())


IDENTITY = {"a/hidden0/kernel": np.eye(2), "a/hidden0/bias": np.zeros(2), "a/hidden0/scale": np.ones(2)}


@check("LAY-8", uses=["dense", "mlp"], level=0)
def dense_literals(setting: Setting) -> Cases:
    """Linear, then norm, then SiLU: [3, 4] through an identity becomes silu of [.8485247, 1.1313663]."""
    yield from worked_cases(setting, "layers", "a dense layer", "an MLP of one layer", bound=2 * LITERAL[setting.dtype])


@script("LAY-8", uses=["dense", "mlp"], level=0)
def missing_parameters_are_named(script: Script) -> None:
    """A layer whose parameter is missing raises a KeyError that names it."""
    calls: dict[str, tuple[Any, ...]] = {"dense": ("a/hidden1", np.ones(2), 1e-4), "mlp": ("a", np.ones(2), 2, 1e-4)}
    for function, arguments in calls.items():
        try:
            script.call(function, IDENTITY, *arguments)
        except KeyError as error:
            script.holds(f"{function} names the missing parameter", "a/hidden1/" in str(error))
        else:
            script.holds(f"{function} raises KeyError for a missing parameter", False)


@check("LAY-8", "LAY-16", uses=["dense", "mlp"], level=0)
def mlp_matches(setting: Setting) -> Cases:
    """One to three layers with biases, scales and sizes that differ, in their order, with any leading axes and
    epsilon."""

    def case(seed: int, leading: tuple[int, ...], layers: int, epsilon: float) -> Cases:
        params, rng, cast = {}, np.random.default_rng(seed), setting.cast
        for layer, (inputs, outputs) in enumerate(((5, 7), (7, 6), (6, 4))):
            name = f"net/hidden{layer}"
            params[f"{name}/kernel"] = cast(rng.normal(size=(inputs, outputs)))
            params[f"{name}/bias"] = cast(rng.normal(size=outputs))
            params[f"{name}/scale"] = cast(rng.normal(1, 0.5, outputs))
        x = cast(rng.normal(size=(*leading, 5)) * 3)
        expected = reference.mlp(params, "net", x, layers, epsilon)
        yield equal("mlp", (params, "net", x, layers, epsilon), expected, magnitude="tensor", factor=4)
        expected = reference.dense(params, "net/hidden0", x, epsilon)
        yield equal("dense", (params, "net/hidden0", x, epsilon), expected, magnitude="tensor", factor=2)

    layers, epsilon = st.sampled_from([1, 3]), st.sampled_from([1e-4, 0.5])
    yield Drawn(case, seed=seeds(), leading=LEADING, layers=layers, epsilon=epsilon)


@check("LAY-9", "LAY-11", uses=["truncated_normal"], level=0)
def truncated_normal_literals(setting: Setting) -> Cases:
    """The quantiles 0, 1/4, 1/2, 3/4 and 0.9; fan 1024 divides by 32; scale 0 gives exact zeros."""
    bound = 1e-10 if setting.dtype == "float64" else 8e-6
    yield from worked_cases(setting, "layers", "initial weights", floor=1.0, bound=bound)
    yield from worked_cases(setting, "layers", "initial weights of a fan", bound=bound)


@check("LAY-9", "LAY-11", uses=["truncated_normal"], level=0)
def truncated_normal_matches(setting: Setting) -> Cases:
    """Every quantile, the outermost too; increasing; never beyond 2.2737; the standard deviation is exact."""
    error = 1e-10 if setting.dtype == "float64" else 1e-5
    grid, largest = (np.arange(4096) + 0.5) / 4096, -quantiles()[0]

    def spread(c: Comparisons, weights: np.ndarray) -> None:
        weights = np.asarray(weights)
        c.compare("standard deviation", np.std(weights), 1.0, bound=1e-3)
        c.holds("increasing", np.diff(weights) > 0)

    right = Equal(reference.truncated_normal(grid, 1, 1.0), magnitude=1.0, bound=1.14 * error)
    yield judged("truncated_normal", (grid, 1, 1.0), right, spread)

    def case(uniform: np.ndarray, fan: int, scale: float) -> Cases:
        deviation = scale / np.sqrt(fan)

        def within_bounds(c: Comparisons, weights: np.ndarray) -> None:
            c.holds("within the bounds", np.abs(weights) <= largest * deviation * (1 + 4 * setting.u))

        expected = reference.truncated_normal(uniform, fan, scale)
        right = Equal(expected, magnitude=deviation, bound=1.14 * error)
        yield judged("truncated_normal", (uniform, fan, scale), right, within_bounds)

    edges = st.sampled_from([0.0, 2.0**-24, 2.0**-10, 0.5, 1 - 2.0**-10, 1 - 2.0**-23, 1 - 2.0**-24])
    numbers = st.one_of(edges, st.integers(0, 2**23 - 1).map(lambda k: k / 2.0**23))
    uniform = LEADING.flatmap(lambda shape: arrays(numbers, shape))
    yield Drawn(case, uniform=uniform, fan=st.sampled_from([1, 25, 1024]), scale=st.sampled_from([1.0, 0.01]))


@check("LAY-9", "LAY-10", uses=["initial_parameters"], level=1)
def fans_are_those_of_whole_layers(setting: Setting) -> Cases:
    """With every uniform at 0.9, each kernel is 1.3460640 times its scale over the root of its fan: all blocks, all 25
    taps together."""
    outscales = {"actor_outscale": 0.01, "reward_outscale": 0.0, "critic_outscale": 0.0}
    table = parameter_table(small_config(setting.profile, setting.dtype, **outscales), spaces())
    kernels = {name: entry for name, entry in table.items() if entry.initializer == "truncated_normal"}
    uniform = {name: np.full(entry.shape, 0.9) for name, entry in kernels.items()}
    demands, weight = [], quantiles()[4]
    for name, entry in table.items():
        axes = entry.shape
        if name.endswith("/kernel"):
            fan = {2: axes[0], 3: axes[0] * axes[1], 4: 25 * axes[-2]}[len(axes)]
            zero = name in ("reward/out/kernel", "critic/out/kernel")
            scale = 0.0 if zero else 0.01 if name.startswith("actor/out/") else 1.0
            expected = np.full(axes, weight * scale / np.sqrt(fan))
            demands.append(Equal(expected, (name,), where=name, magnitude=1 / np.sqrt(fan), bound=2e-5))
        else:
            demands.append(exactly(np.full(axes, 1.0 if name.endswith("/scale") else 0.0), (name,), name))
    yield judged("initial_parameters", (table, uniform), *demands)


@check("LAY-12", "LAY-13", uses=["max_pool", "upsample"], level=0)
def pooling_literals(setting: Setting) -> Cases:
    """[[1, 2], [3, 4]] pools to 4 and [[1, 2]] grows to [[1, 1, 2, 2], [1, 1, 2, 2]]; a NaN anywhere in a window
    shows."""
    yield from worked_cases(setting, "layers", "pooling", "upsampling")
    yield exact("max_pool", (np.full((2, 2, 1), -3.0),), np.full((1, 1, 1), -3.0), where="negative numbers")
    for row in range(2):
        for column in range(2):
            x = np.zeros((2, 4, 1))
            x[row, column] = np.nan
            yield exact("max_pool", (x,), np.array([[[np.nan], [0]]]), where="NaN")


@check("LAY-12", "LAY-13", "LAY-16", uses=["max_pool", "upsample"], level=0)
def pooling_matches(setting: Setting) -> Cases:
    """Every window, channel and leading axis on its own, exactly."""

    def case(seed: int, leading: tuple[int, ...]) -> Cases:
        x = setting.cast(normals(seed, *leading, 4, 6, 3))
        for function in ("max_pool", "upsample"):
            yield exact(function, (x,), getattr(reference, function)(x))

    yield Drawn(case, seed=seeds(), leading=LEADING)


@check("LAY-14", uses=["encoder", "decoder"], level=1)
def image_stages_match(setting: Setting) -> Cases:
    """Halving and doubling stages, and one at full resolution, part by part, of the kind that the profile has."""
    plain = small_config(setting.profile)
    yield from image_stages(setting, [(plain.cnn_sampling, plain.cnn_outer)])


@check("LAY-14", uses=["encoder", "decoder"], level=1)
def other_image_stages_match(setting: Setting) -> Cases:
    """The same with the other choices of `cnn_sampling` and `cnn_outer`."""
    plain = small_config(setting.profile)
    kinds = ((sampling, outer) for sampling in ("strided", "pooled") for outer in (False, True))
    yield from image_stages(setting, [kind for kind in kinds if kind != (plain.cnn_sampling, plain.cnn_outer)])


def image_stages(setting: Setting, kinds: Iterable[tuple[str, bool]]) -> Cases:
    task, rng, dtype = Spaces({"image": Image(16, 12, 2)}, {"action": Vector(1)}), setting.rng(), setting.dtype
    for sampling, outer in kinds:
        choices = {"cnn_sampling": sampling, "cnn_outer": outer, "cnn_multipliers": (1, 4), "blocks": 4}
        config = small_config(setting.profile, dtype, **choices)
        params = {name: setting.cast(value) for name, value in random_parameters(rng, config, task, dtype).items()}
        image = rng.integers(0, 256, (2, 16, 12, 2)).astype(np.uint8)
        x = image / 255 - 0.5
        for index in range(2):
            kernel, bias, scale = (params[f"encoder/image/conv{index}/{part}"] for part in ("kernel", "bias", "scale"))
            halving = index == 1 or not outer
            x = reference.convolution(x, kernel, bias, 2 if halving and sampling == "strided" else 1)
            x = reference.max_pool(x) if halving and sampling == "pooled" else x
            x = reference.silu(reference.rms_norm(x, scale, config.norm_epsilon))
        arguments, where = (params, {"image": image}, task, config), f"{sampling} encoder"
        yield equal("encoder", arguments, x.reshape(2, -1), where=where, magnitude="tensor", factor=4)
        feature = setting.cast(rng.normal(size=(2, config.feature_size)))
        expected, where = networks.decoder(params, feature, task, config), f"{sampling} decoder"
        yield equal("decoder", (params, feature, task, config), expected, where=where, magnitude="tensor", factor=4)


@check("LAY-15", "CON-8", uses=[*SUMS, "rms_norm", "max_pool", "upsample", "dense", "mlp", "truncated_normal"], level=0)
def layers_refuse_shapes(setting: Setting) -> Cases:
    """Sizes that do not fit, odd sides, other strides, images without channels, no layers and no fan are refused."""
    shape: tuple[int, ...]
    x, kernel, blocks, taps = (np.ones(shape) for shape in ((2, 4), (4, 6), (2, 2, 3), (5, 5, 2, 6)))
    bias = np.zeros(6)
    for shape in ((2, 3), (2, 1)):
        wrong: np.ndarray = np.ones(shape)
        yield refused("linear", wrong, kernel, bias)
        yield refused("block_linear", wrong, blocks, bias)
        yield refused("rms_norm", wrong, np.ones(4), 1e-4)
    for shape in ((1,), (3,), (1, 6), ()):
        wrong = np.zeros(shape)
        yield refused("linear", x, kernel, wrong)
        yield refused("block_linear", x, blocks, wrong)
        yield refused("rms_norm", np.ones((2, 6)), wrong, 1e-4)
        yield refused("convolution", np.ones((4, 4, 2)), taps, wrong, 1)
        yield refused("transposed_convolution", np.ones((4, 4, 2)), taps, wrong)
    yield refused("linear", x, blocks, bias)
    yield refused("block_linear", x, kernel, bias)
    for shape in ((3, 3, 2, 6), (5, 2, 6), (5, 5, 1, 6), (5, 4, 2, 6)):
        wrong = np.ones(shape)
        yield refused("convolution", np.ones((4, 4, 2)), wrong, bias, 2)
        yield refused("transposed_convolution", np.ones((4, 4, 2)), wrong, bias)
    for shape in ((3, 4, 2), (4, 3, 2)):
        yield refused("convolution", np.ones(shape), taps, bias, 2)
        yield refused("max_pool", np.ones(shape))
    yield refused("convolution", np.ones((4, 2)), taps, bias, 1)
    yield refused("transposed_convolution", np.ones((4, 2)), taps, bias)
    yield refused("max_pool", np.ones((4, 2)))
    yield refused("upsample", np.ones((4, 2)))
    for stride in (0, 3):
        yield refused("convolution", np.ones((6, 6, 2)), taps, bias, stride)
    params = {"a/hidden0/kernel": kernel, "a/hidden0/bias": bias, "a/hidden0/scale": bias}
    yield refused("dense", params, "a/hidden0", np.ones((2, 3)), 1e-4)
    yield refused("dense", {**params, "a/hidden0/scale": np.ones(1)}, "a/hidden0", x, 1e-4)
    yield refused("mlp", params, "a", x, 0, 1e-4)
    yield refused("truncated_normal", np.zeros(2), 0, 1.0)


@check("LAY-16", uses=[*SUMS, "rms_norm", "silu", "max_pool", "upsample"], level=0)
def rows_do_not_mix(setting: Setting) -> Cases:
    """A NaN in one element of a batch stays in it, and the other elements keep every bit."""
    rng, cast = setting.rng(), setting.cast
    x, image = cast(rng.normal(size=(3, 2, 4))), cast(rng.normal(size=(3, 2, 4, 6, 4)))
    kernel, taps = cast(rng.normal(size=(4, 6))), cast(rng.normal(size=(5, 5, 4, 6)))
    bias = cast(rng.normal(size=6))

    def spoiled(function: str, array: np.ndarray, *others: Any) -> Case:
        broken = array.copy()
        broken[1, 1] = np.nan

        def stays(c: Comparisons, before: np.ndarray, after: np.ndarray) -> None:
            expected = np.array(before, np.float64)
            expected[1, 1] = np.nan
            c.exact(function, after, expected)

        return related(stays, (function, (array, *others)), (function, (broken, *others)))

    yield spoiled("linear", x, kernel, bias)
    yield spoiled("block_linear", x, kernel.reshape(2, 2, 6), np.append(bias, bias))
    yield spoiled("rms_norm", x, kernel[:, 0], 1e-4)
    yield spoiled("silu", x)
    yield spoiled("convolution", image, taps, bias, 1)
    yield spoiled("convolution", image, taps, bias, 2)
    yield spoiled("transposed_convolution", image, taps, bias)
    yield spoiled("max_pool", image)
    yield spoiled("upsample", image)
