"""Checks of spec/03-layers.md."""

from collections.abc import Iterable
from typing import Any

import hypothesis.strategies as st
import numpy as np

from conformance.check import EPSILON, Run, check, round_to
from conformance.problems import random_parameters, small_config, spaces
from conformance.strategies import adversarial_numbers, arrays, normals, seeds
from reference_numpy import layers as reference
from reference_numpy import networks
from spec import Image, Spaces, Vector, parameter_table

LEADING = st.sampled_from([(), (2, 3)])
SUMS = ("linear", "block_linear", "convolution", "transposed_convolution")
SCALES = st.sampled_from([1e-3, 1.0, 300.0])
# Numbers in the chapter have seven digits.
LITERAL = {"float64": 4e-7, "float32": 4e-7, "bfloat16": EPSILON["bfloat16"]}
# A truncated normal weight in units of its standard deviation.
LARGEST = 2.273694468677113


def expect_sums(run: Run, function: str, arguments: tuple[Any, ...], terms: int, *, roundings: int = 2) -> None:
    """Compares a layer that sums `terms` products and a bias, [LAY-1]. In bfloat16 its result and that of its products
    may be rounded."""
    x, kernel, bias, *rest = arguments
    layer = getattr(reference, function)
    magnitude = layer(np.abs(x), np.abs(kernel), np.abs(bias), *rest)
    bound = roundings * 0.51 * EPSILON["bfloat16"] if run.dtype == "bfloat16" else (terms + 16) * EPSILON[run.dtype]
    run.expect(function, arguments, layer(*arguments), magnitude=magnitude, bound=bound)


def is_double(actual: Any, expected: np.ndarray) -> bool:
    """Whether somebody who was asked for bfloat16 computed in float64, as the reference always does."""
    return np.shape(actual) == expected.shape and np.allclose(actual, expected, rtol=1e-9, atol=0)


def pixels(height: int, width: int) -> np.ndarray:
    """[height, width, 1] with 10i + j at row i and column j."""
    return (10.0 * np.arange(height)[:, None] + np.arange(width))[..., None]


def one_tap(row: int, column: int) -> np.ndarray:
    kernel = np.zeros((5, 5, 1, 1))
    kernel[row, column] = 1
    return kernel


ONES = np.ones((5, 5, 1, 1))
NO_BIAS = np.zeros(1)


@check("LAY-2", "LAY-3", uses=["linear", "block_linear"], level=0)
def linear_literals(run: Run) -> None:
    """[1, 2] gives [9.5, 12, 14.5]; with two blocks [1, 2, 3, 4] gives [21, 4301]; one block is a linear layer."""
    kernel = np.array([[1.0, 2, 3], [4, 5, 6]])
    run.exact(
        "linear", run.call("linear", np.array([1.0, 2]), kernel, np.array([0.5, 0, -0.5])), np.array([9.5, 12, 14.5])
    )
    x, blocks = np.array([1.0, 2, 3, 4]), np.array([[[1.0], [10]], [[100], [1000]]])
    run.expect("block_linear", (x, blocks, np.array([0.0, 1])), np.array([21.0, 4301]), bound=LITERAL[run.dtype])
    blocks = np.array([[[1.0, 2], [0, 0]], [[0, 0], [3, 4]]])
    run.exact("positions", run.call("block_linear", x, blocks, np.array([1.0, 0, 0, 2])), np.array([2.0, 2, 12, 18]))
    run.exact(
        "one block",
        run.call("block_linear", np.array([1.0, 2]), kernel[None], np.array([0.5, 0, -0.5])),
        np.array([9.5, 12, 14.5]),
    )


@check("LAY-1", "LAY-2", "LAY-3", "LAY-16", "CON-30", uses=["linear", "block_linear"], level=0)
def linear_matches(run: Run) -> None:
    """Any leading axes, inputs of several magnitudes, few terms and many."""

    @run.for_all(seed=seeds(), leading=LEADING, sizes=st.sampled_from([(8, 5), (96, 3)]), scale=SCALES)
    def _(seed: int, leading: tuple[int, ...], sizes: tuple[int, int], scale: float) -> None:
        inputs, outputs = sizes
        x = run.cast(normals(seed, *leading, inputs, scale=scale))
        kernel, bias = run.cast(normals(seed + 1, inputs, outputs)), run.cast(normals(seed + 2, outputs))
        expect_sums(run, "linear", (x, kernel, bias), inputs)
        kernel, bias = run.cast(normals(seed + 3, 4, inputs // 4, outputs)), run.cast(normals(seed + 4, 4 * outputs))
        expect_sums(run, "block_linear", (x, kernel, bias), inputs // 4)


@check("LAY-1", "CON-23", uses=SUMS, level=0)
def long_sums_are_accurate(run: Run) -> None:
    """Thousands of positive products: sums that are kept in less than float32 stop growing."""
    rng = run.rng()
    x, kernel = run.cast(rng.uniform(0.5, 1, (2, 4096))), run.cast(rng.uniform(0.5, 1, (4096, 8)))
    expect_sums(run, "linear", (x, kernel, np.zeros(8)), 4096, roundings=1)
    expect_sums(run, "block_linear", (x, kernel.reshape(2, 2048, 8), np.zeros(16)), 2048, roundings=1)
    x, kernel = run.cast(rng.uniform(0.5, 1, (4, 4, 64))), run.cast(rng.uniform(0.5, 1, (5, 5, 64, 2)))
    expect_sums(run, "convolution", (x, kernel, np.zeros(2), 1), 1600, roundings=1)
    expect_sums(run, "convolution", (x, kernel, np.zeros(2), 2), 1600, roundings=1)
    expect_sums(run, "transposed_convolution", (x, kernel, np.zeros(2)), 576, roundings=1)


@check("LAY-1", "LAY-4", "CON-22", uses=[*SUMS, "rms_norm", "silu", "dense"], level=0, dtypes=("bfloat16",))
def results_have_the_compute_dtype(run: Run) -> None:
    """Float32 parameters beside bfloat16 inputs are rounded to bfloat16, and so is the result; who computes in float64
    is let off."""
    rng = run.rng()
    kernel, bias, scale = (round_to(rng.normal(size=shape), "float32") for shape in ((5, 5, 2, 3), (3,), (3,)))
    x = run.cast(rng.normal(size=(4, 6, 2)))
    params = {"layer/kernel": kernel[0, 0], "layer/bias": bias, "layer/scale": scale}
    for function, arguments in (
        ("linear", (x, kernel[0, 0], bias)),
        ("block_linear", (x, kernel[:2, 0, :1], np.append(bias, bias))),
        ("convolution", (x, kernel, bias, 1)),
        ("convolution", (x, kernel, bias, 2)),
        ("transposed_convolution", (x, kernel, bias)),
        ("rms_norm", (run.cast(rng.normal(size=(4, 3))), scale, 1e-4)),
        ("dense", (params, "layer", x, 1e-4)),
    ):
        result = np.asarray(run.call(function, *arguments), np.float64)
        double = is_double(result, getattr(reference, function)(*arguments))
        run.holds(f"{function} gives bfloat16 numbers", double or np.array_equal(result, round_to(result, "bfloat16")))
    # 1 + 2^-9 becomes 1: nothing is left of the difference.
    one = np.array([1.0])
    in_double = is_double(run.call("silu", one), reference.silu(one))
    difference = run.call("linear", np.ones(2), np.array([[1 + 2.0**-9], [-1]]), np.zeros(1))
    run.exact("the kernel is rounded to bfloat16", difference, np.array([2.0**-9 if in_double else 0]))


@check("LAY-4", uses=["rms_norm"], level=0)
def rms_norm_literals(run: Run) -> None:
    """[3, 4] becomes [.8485247, 1.1313663]; epsilon rules tiny rows; zeros stay zero; no mean is taken off; a NaN
    spoils its row only."""
    rounding = LITERAL[run.dtype]
    scale = np.array([1.0, 1])
    run.expect("rms_norm", (np.array([3.0, 4]), scale, 1e-4), np.array([0.8485247, 1.1313663]), bound=rounding)
    run.expect(
        "rms_norm", (np.array([3.0, 4]), np.array([2.0, -0.5]), 1e-4), np.array([1.6970494, -0.5656832]), bound=rounding
    )
    tiny = np.full(2, 1e-5)
    run.expect("rms_norm", (tiny, scale, 1e-4), np.full(2, 9.999995e-4), bound=2 * rounding)
    run.exact("zeros", run.call("rms_norm", np.zeros((2, 3)), np.ones(3), 1e-4), np.zeros((2, 3)))
    run.expect("rms_norm", (np.full(3, 2.0), np.ones(3), 1e-4), np.full(3, 0.9999875), bound=rounding)
    huge = run.cast([[1e18, -1e18, 1e18, 1e18], [1.0, 1, -1, 1]])
    run.expect("rms_norm", (huge, np.ones(4), 1e-4), np.sign(huge), bound=max(rounding, 1e-4))
    broken = run.call("rms_norm", np.array([[1.0, np.nan], [0, 0]]), scale, 1e-4)
    run.exact("NaN", broken, np.array([[np.nan, np.nan], [0, 0]]))


@check("LAY-1", "LAY-4", "LAY-16", uses=["rms_norm"], level=0)
def rms_norm_matches(run: Run) -> None:
    """Rows of several magnitudes and any leading axes, each on its own, images too; in bfloat16 the scale and the
    result are rounded."""

    @run.for_all(
        seed=seeds(), leading=LEADING, n=st.sampled_from([5, 64]), scale=st.sampled_from([1e-4, 1e-2, 1.0, 1e4])
    )
    def _(seed: int, leading: tuple[int, ...], n: int, scale: float) -> None:
        rng = np.random.default_rng(seed)
        x = run.cast(rng.normal(0.5, 1, (*leading, n)) * scale * 10 ** rng.uniform(-1, 1, (*leading, 1)))
        # A parameter: float32 beside bfloat16 inputs.
        weight = round_to(rng.normal(1, 0.5, n), "float64" if run.dtype == "float64" else "float32")
        actual = run.call("rms_norm", x, weight, 1e-4)
        double = is_double(actual, reference.rms_norm(x, weight, 1e-4))
        bound = 0.51 * EPSILON["bfloat16"] if run.dtype == "bfloat16" else (n + 16) * run.u
        run.compare(
            "rms_norm", actual, reference.rms_norm(x, weight if double else run.cast(weight), 1e-4), bound=bound
        )


@check("LAY-5", uses=["silu"], level=0)
def silu_literals(run: Run) -> None:
    """silu of 1, -1, 2 and -20; zeros, infinities, NaN and huge numbers."""
    bound = 2 * LITERAL[run.dtype]
    x, expected = np.array([1.0, -1, 2]), np.array([0.7310586, -0.2689414, 1.7615942])
    run.expect("silu", (x,), expected, bound=bound)
    if run.dtype != "bfloat16":
        run.expect("silu", (np.array([-20.0]),), np.array([-4.1223072e-8]), bound=5e-6)
    special = run.cast([0.0, -0.0, np.inf, -np.inf, np.nan, -1e30, -3e38, 1e30, 3e38])
    expected = np.array([0, 0, np.inf, np.nan, np.nan, 0, 0, special[7], special[8]])
    run.exact("silu", run.call("silu", special), expected)


@check("LAY-5", uses=["silu"], level=0)
def silu_matches(run: Run) -> None:
    """Any numbers, any shape; small negative results keep their relative precision."""

    @run.for_all(
        x=LEADING.flatmap(lambda shape: arrays(st.one_of(adversarial_numbers(), st.floats(-120, 20, width=32)), shape))
    )
    def _(x: np.ndarray) -> None:
        x = run.cast(x)
        expected = reference.silu(x)
        size = np.where(np.isfinite(x), np.abs(x), 0)
        if run.dtype == "bfloat16":
            run.expect("silu", (x,), expected, magnitude=size, bound=2 * EPSILON["bfloat16"])
        else:
            magnitude = 16 * (1 + size) * np.where(np.isfinite(expected), np.abs(expected), 0) + 128 * run.tiny / run.u
            run.expect("silu", (x,), expected, magnitude=np.minimum(magnitude, 1e300), bound=run.u)


@check("LAY-6", uses=["convolution"], level=0)
def convolution_literals(run: Run) -> None:
    """Padding 2 and 2 at stride 1, 1 and 2 at stride 2; taps are not flipped, rows and columns not exchanged; the bias
    comes once."""
    ones = np.ones((4, 4, 1))
    taps = np.array([3.0, 4, 4, 3])
    run.exact("stride 1", run.call("convolution", ones, ONES, NO_BIAS, 1)[..., 0], np.outer(taps, taps))
    taps = np.array([4.0, 3])
    run.exact("stride 2", run.call("convolution", ones, ONES, NO_BIAS, 2)[..., 0], np.outer(taps, taps))
    run.exact("bias", run.call("convolution", ones, 0 * ONES, np.array([2.5]), 2)[..., 0], np.full((2, 2), 2.5))
    seen = {
        (0, 0): [[0, 0], [0, 11]],
        (1, 1): [[0, 2], [20, 22]],
        (4, 4): [[33, 0], [0, 0]],
        (1, 2): [[1, 3], [21, 23]],
    }
    for tap, image in seen.items():
        run.exact(
            f"tap {tap} at stride 2",
            run.call("convolution", pixels(4, 4), one_tap(*tap), NO_BIAS, 2)[..., 0],
            np.array(image),
        )
    expected = np.pad(pixels(4, 6)[:, 1:, 0], ((1, 0), (0, 1)))[:4]
    run.exact(
        "tap (1, 3) at stride 1", run.call("convolution", pixels(4, 6), one_tap(1, 3), NO_BIAS, 1)[..., 0], expected
    )


@check("LAY-7", uses=["transposed_convolution"], level=0)
def transposed_convolution_literals(run: Run) -> None:
    """A pixel of 1 shows taps 1 and 2, not flipped; ones count the taps 1, 2, 2, 2; the bias comes once to every
    output."""
    kernel = (10.0 * np.arange(5)[:, None] + np.arange(5))[..., None, None]
    one = np.ones((1, 1, 1))
    run.exact(
        "one pixel", run.call("transposed_convolution", one, kernel, NO_BIAS)[..., 0], np.array([[11, 12], [21, 22]])
    )
    taps = np.array([1.0, 2, 2, 2])
    run.exact(
        "ones", run.call("transposed_convolution", np.ones((2, 2, 1)), ONES, NO_BIAS)[..., 0], np.outer(taps, taps)
    )
    run.exact(
        "bias",
        run.call("transposed_convolution", np.ones((2, 3, 1)), 0 * ONES, np.array([2.5]))[..., 0],
        np.full((4, 6), 2.5),
    )
    corner = np.zeros((4, 4))
    corner[3, 1] = 1  # from the pixel (2, 0), as 2 * 2 - 1 and 2 * 0 + 1
    pixel = np.zeros((3, 2, 1))
    pixel[2, 0] = 1
    run.exact("tap (0, 2)", run.call("transposed_convolution", pixel, one_tap(0, 2), NO_BIAS)[:4, :, 0], corner)


@check("LAY-1", "LAY-6", "LAY-7", "LAY-16", "CON-30", uses=["convolution", "transposed_convolution"], level=0)
def convolutions_match(run: Run) -> None:
    """Random images whose sides and channels all differ, with any leading axes."""

    @run.for_all(seed=seeds(), leading=LEADING, scale=SCALES)
    def _(seed: int, leading: tuple[int, ...], scale: float) -> None:
        x = run.cast(normals(seed, *leading, 4, 6, 3, scale=scale))
        kernel, bias = run.cast(normals(seed + 1, 5, 5, 3, 2)), run.cast(normals(seed + 2, 2))
        expect_sums(run, "convolution", (x, kernel, bias, 1), 75)
        expect_sums(run, "convolution", (x, kernel, bias, 2), 75)
        expect_sums(run, "transposed_convolution", (x, kernel, bias), 27)


@check("LAY-7", uses=["convolution", "transposed_convolution"], level=0)
def transposed_convolution_is_the_adjoint(run: Run) -> None:
    """<convolution(y, w, 2), x> is <y, transposed(x, w')>, w' being w with its last two axes exchanged."""

    @run.for_all(seed=seeds())
    def _(seed: int) -> None:
        y, x, kernel = (
            run.cast(normals(seed, 6, 8, 3)),
            run.cast(normals(seed + 1, 3, 4, 2)),
            run.cast(normals(seed + 2, 5, 5, 3, 2)),
        )
        down = np.asarray(run.call("convolution", y, kernel, np.zeros(2), 2), np.float64) * x
        up = (
            np.asarray(run.call("transposed_convolution", x, kernel.swapaxes(2, 3).copy(), np.zeros(3)), np.float64) * y
        )
        run.compare("inner products", up.sum(), down.sum(), magnitude=np.abs(down).sum() + np.abs(up).sum())


@check("LAY-8", uses=["dense", "mlp"], level=0)
def dense_literals(run: Run) -> None:
    """Linear, then norm, then SiLU: [3, 4] through an identity becomes silu of [.8485247, 1.1313663]; a missing
    parameter is named."""
    params = {"a/hidden0/kernel": np.eye(2), "a/hidden0/bias": np.zeros(2), "a/hidden0/scale": np.ones(2)}
    bound = 2 * LITERAL[run.dtype]
    expected = np.array([0.5941859, 0.8554159])
    run.expect("dense", (params, "a/hidden0", np.array([3.0, 4]), 1e-4), expected, bound=bound)
    run.expect("mlp", (params, "a", np.array([3.0, 4]), 1, 1e-4), expected, bound=bound)
    for function, arguments in (
        ("dense", (params, "a/hidden1", np.ones(2), 1e-4)),
        ("mlp", (params, "a", np.ones(2), 2, 1e-4)),
    ):
        try:
            run.call(function, *arguments)
        except KeyError as error:
            run.holds(f"{function} names the missing parameter", "a/hidden1/" in str(error))
        else:
            run.holds(f"{function} raises KeyError for a missing parameter", False)


@check("LAY-8", "LAY-16", uses=["dense", "mlp"], level=0)
def mlp_matches(run: Run) -> None:
    """One to three layers with biases, scales and sizes that differ, in their order, with any leading axes and
    epsilon."""

    @run.for_all(seed=seeds(), leading=LEADING, layers=st.sampled_from([1, 3]), epsilon=st.sampled_from([1e-4, 0.5]))
    def _(seed: int, leading: tuple[int, ...], layers: int, epsilon: float) -> None:
        params, rng = {}, np.random.default_rng(seed)
        for layer, (inputs, outputs) in enumerate(((5, 7), (7, 6), (6, 4))):
            name = f"net/hidden{layer}"
            params[f"{name}/kernel"] = run.cast(rng.normal(size=(inputs, outputs)))
            params[f"{name}/bias"], params[f"{name}/scale"] = (
                run.cast(rng.normal(size=outputs)),
                run.cast(rng.normal(1, 0.5, outputs)),
            )
        x = run.cast(rng.normal(size=(*leading, 5)) * 3)
        expected = reference.mlp(params, "net", x, layers, epsilon)
        run.expect("mlp", (params, "net", x, layers, epsilon), expected, magnitude="tensor", factor=4)
        expected = reference.dense(params, "net/hidden0", x, epsilon)
        run.expect("dense", (params, "net/hidden0", x, epsilon), expected, magnitude="tensor", factor=2)


@check("LAY-9", "LAY-11", uses=["truncated_normal"], level=0)
def truncated_normal_literals(run: Run) -> None:
    """The quantiles 0, 1/4, 1/2, 3/4 and 0.9; fan 1024 divides by 32; scale 0 gives exact zeros; scalars stay
    scalars."""
    bound = 2e-7 if run.dtype == "float64" else 1.2e-5
    quantiles = np.array([-2.2736945, -0.7265726, 0, 0.7265726, 1.3460640])
    uniform = np.array([0, 0.25, 0.5, 0.75, round_to(0.9, "float32")])
    run.expect("truncated_normal", (uniform, 1, 1.0), quantiles, magnitude=1.0, bound=bound)
    run.expect("truncated_normal", (uniform[4], 1024, 1.0), 0.0420645, magnitude=1 / 32, bound=4e-6 + bound)
    run.expect(
        "truncated_normal", (uniform[:, None], 4, 0.01), 0.005 * quantiles[:, None], magnitude=0.005, bound=bound
    )
    run.exact("scale 0", run.call("truncated_normal", uniform, 7, 0.0), np.zeros(5))


@check("LAY-9", "LAY-11", uses=["truncated_normal"], level=0)
def truncated_normal_matches(run: Run) -> None:
    """Every quantile, the outermost too; increasing; never beyond 2.2737; the standard deviation is exact."""
    error = 1e-10 if run.dtype == "float64" else 1e-5
    grid = (np.arange(4096) + 0.5) / 4096
    weights = np.asarray(
        run.expect(
            "truncated_normal",
            (grid, 1, 1.0),
            reference.truncated_normal(grid, 1, 1.0),
            magnitude=1.0,
            bound=1.14 * error,
        )
    )
    run.compare("standard deviation", np.std(weights), 1.0, bound=1e-3)
    run.holds("increasing", np.diff(weights) > 0)

    edges = st.sampled_from([0.0, 2.0**-24, 2.0**-10, 0.5, 1 - 2.0**-10, 1 - 2.0**-23, 1 - 2.0**-24])
    strategy = st.one_of(edges, st.integers(0, 2**23 - 1).map(lambda k: k / 2.0**23))

    @run.for_all(
        uniform=LEADING.flatmap(lambda shape: arrays(strategy, shape)),
        fan=st.sampled_from([1, 25, 1024]),
        scale=st.sampled_from([1.0, 0.01]),
    )
    def _(uniform: np.ndarray, fan: int, scale: float) -> None:
        deviation = scale / np.sqrt(fan)
        expected = reference.truncated_normal(uniform, fan, scale)
        drawn = run.expect("truncated_normal", (uniform, fan, scale), expected, magnitude=deviation, bound=1.14 * error)
        run.holds("within the bounds", np.abs(drawn) <= LARGEST * deviation * (1 + 4 * run.u))


@check("LAY-9", "LAY-10", uses=["initial_parameters"], level=1)
def fans_are_those_of_whole_layers(run: Run) -> None:
    """With every uniform at 0.9, each kernel is 1.3460640 times its scale over the root of its fan: all blocks, all 25
    taps together."""
    task, config = (
        spaces(),
        small_config(run.profile, run.dtype, actor_outscale=0.01, reward_outscale=0.0, critic_outscale=0.0),
    )
    table = parameter_table(config, task)
    uniform = {
        name: np.full(entry.shape, 0.9) for name, entry in table.items() if entry.initializer == "truncated_normal"
    }
    params = run.call("initial_parameters", table, uniform)
    for name, entry in table.items():
        *others, part = name.split("/")
        if part == "kernel":
            axes = entry.shape
            fan = {2: axes[0], 3: axes[0] * axes[1], 4: 25 * axes[-2]}[len(axes)]
            scale = (
                0.01
                if name.startswith("actor/out/")
                else 0.0
                if "/".join(others) in ("reward/out", "critic/out")
                else 1.0
            )
            expected = np.full(axes, 1.3460640 * scale / np.sqrt(fan))
            run.compare(name, params[name], expected, magnitude=1 / np.sqrt(fan), bound=2e-5)
        else:
            run.exact(name, params[name], np.full(entry.shape, 1.0 if part == "scale" else 0.0))


@check("LAY-12", "LAY-13", uses=["max_pool", "upsample"], level=0)
def pooling_literals(run: Run) -> None:
    """[[1, 2], [3, 4]] pools to 4 and [[1, 2]] grows to [[1, 1, 2, 2], [1, 1, 2, 2]]; a NaN anywhere in a window
    shows."""
    run.exact("max_pool", run.call("max_pool", np.array([[[1.0], [2]], [[3], [4]]])), np.array([[[4]]]))
    run.exact(
        "upsample", run.call("upsample", np.array([[[1.0], [2]]]))[..., 0], np.array([[1, 1, 2, 2], [1, 1, 2, 2]])
    )
    run.exact("negative numbers", run.call("max_pool", np.full((2, 2, 1), -3.0)), np.full((1, 1, 1), -3.0))
    for row in range(2):
        for column in range(2):
            x = np.zeros((2, 4, 1))
            x[row, column] = np.nan
            run.exact("NaN", run.call("max_pool", x)[..., 0], np.array([[np.nan, 0]]))


@check("LAY-12", "LAY-13", "LAY-16", uses=["max_pool", "upsample"], level=0)
def pooling_matches(run: Run) -> None:
    """Every window, channel and leading axis on its own, exactly."""

    @run.for_all(seed=seeds(), leading=LEADING)
    def _(seed: int, leading: tuple[int, ...]) -> None:
        x = run.cast(normals(seed, *leading, 4, 6, 3))
        for function in ("max_pool", "upsample"):
            run.exact(function, run.call(function, x), getattr(reference, function)(x))


@check("LAY-14", uses=["encoder", "decoder"], level=1)
def image_stages_match(run: Run) -> None:
    """Halving and doubling stages, and one at full resolution, part by part, of the kind that the profile has."""
    plain = small_config(run.profile)
    compare_image_stages(run, [(plain.cnn_sampling, plain.cnn_outer)])


@check("LAY-14", uses=["encoder", "decoder"], level=1)
def other_image_stages_match(run: Run) -> None:
    """The same with the other choices of `cnn_sampling` and `cnn_outer`."""
    plain = small_config(run.profile)
    kinds = ((sampling, outer) for sampling in ("strided", "pooled") for outer in (False, True))
    compare_image_stages(run, [kind for kind in kinds if kind != (plain.cnn_sampling, plain.cnn_outer)])


def compare_image_stages(run: Run, kinds: Iterable[tuple[str, bool]]) -> None:
    task, rng = Spaces({"image": Image(8, 4, 2)}, {"action": Vector(1)}), run.rng()
    for sampling, outer in kinds:
        config = small_config(
            run.profile, run.dtype, cnn_sampling=sampling, cnn_outer=outer, cnn_multipliers=(1, 4), blocks=4
        )
        params = {name: run.cast(value) for name, value in random_parameters(rng, config, task, run.dtype).items()}
        image = rng.integers(0, 256, (2, 8, 4, 2)).astype(np.uint8)
        x = image / 255 - 0.5
        for index in range(2):
            kernel, bias, scale = (params[f"encoder/image/conv{index}/{part}"] for part in ("kernel", "bias", "scale"))
            halving = index == 1 or not outer
            x = reference.convolution(x, kernel, bias, 2 if halving and sampling == "strided" else 1)
            x = reference.max_pool(x) if halving and sampling == "pooled" else x
            x = reference.silu(reference.rms_norm(x, scale, config.norm_epsilon))
        tokens = run.call("encoder", params, {"image": image}, task, config)
        run.compare(f"{sampling} encoder", tokens, x.reshape(2, -1), magnitude="tensor", factor=4)
        feature = run.cast(rng.normal(size=(2, config.feature_size)))
        expected = networks.decoder(params, feature, task, config)
        run.compare(
            f"{sampling} decoder",
            run.call("decoder", params, feature, task, config),
            expected,
            magnitude="tensor",
            factor=4,
        )


@check("LAY-15", "CON-8", uses=[*SUMS, "rms_norm", "max_pool", "upsample", "dense", "mlp", "truncated_normal"], level=0)
def layers_refuse_shapes(run: Run) -> None:
    """Sizes that do not fit, odd sides, other strides, images without channels, no layers and no fan are refused."""
    shape: tuple[int, ...]
    x, kernel, blocks, taps, bias = (
        np.ones((2, 4)),
        np.ones((4, 6)),
        np.ones((2, 2, 3)),
        np.ones((5, 5, 2, 6)),
        np.zeros(6),
    )
    for shape in ((2, 3), (2, 1)):
        wrong: np.ndarray = np.ones(shape)
        run.refuses("linear", wrong, kernel, bias)
        run.refuses("block_linear", wrong, blocks, bias)
        run.refuses("rms_norm", wrong, np.ones(4), 1e-4)
    for shape in ((1,), (3,), (1, 6), ()):
        wrong = np.zeros(shape)
        run.refuses("linear", x, kernel, wrong)
        run.refuses("block_linear", x, blocks, wrong)
        run.refuses("rms_norm", np.ones((2, 6)), wrong, 1e-4)
        run.refuses("convolution", np.ones((4, 4, 2)), taps, wrong, 1)
        run.refuses("transposed_convolution", np.ones((4, 4, 2)), taps, wrong)
    run.refuses("linear", x, blocks, bias)
    run.refuses("block_linear", x, kernel, bias)
    for shape in ((3, 3, 2, 6), (5, 2, 6), (5, 5, 1, 6), (5, 4, 2, 6)):
        wrong = np.ones(shape)
        run.refuses("convolution", np.ones((4, 4, 2)), wrong, bias, 2)
        run.refuses("transposed_convolution", np.ones((4, 4, 2)), wrong, bias)
    for shape in ((3, 4, 2), (4, 3, 2)):
        run.refuses("convolution", np.ones(shape), taps, bias, 2)
        run.refuses("max_pool", np.ones(shape))
    run.refuses("convolution", np.ones((4, 2)), taps, bias, 1)
    run.refuses("transposed_convolution", np.ones((4, 2)), taps, bias)
    run.refuses("max_pool", np.ones((4, 2)))
    run.refuses("upsample", np.ones((4, 2)))
    for stride in (0, 3):
        run.refuses("convolution", np.ones((6, 6, 2)), taps, bias, stride)
    params = {"a/hidden0/kernel": kernel, "a/hidden0/bias": bias, "a/hidden0/scale": bias}
    run.refuses("dense", params, "a/hidden0", np.ones((2, 3)), 1e-4)
    run.refuses("dense", {**params, "a/hidden0/scale": np.ones(1)}, "a/hidden0", x, 1e-4)
    run.refuses("mlp", params, "a", x, 0, 1e-4)
    run.refuses("truncated_normal", np.zeros(2), 0, 1.0)


@check("LAY-16", uses=[*SUMS, "rms_norm", "silu", "max_pool", "upsample"], level=0)
def rows_do_not_mix(run: Run) -> None:
    """A NaN in one element of a batch stays in it, and the other elements keep every bit."""
    rng = run.rng()
    x, image = run.cast(rng.normal(size=(3, 2, 4))), run.cast(rng.normal(size=(3, 2, 4, 6, 4)))
    kernel, taps, bias = (
        run.cast(rng.normal(size=(4, 6))),
        run.cast(rng.normal(size=(5, 5, 4, 6))),
        run.cast(rng.normal(size=6)),
    )
    cases: tuple[tuple[str, np.ndarray, tuple[Any, ...]], ...] = (
        ("linear", x, (kernel, bias)),
        ("block_linear", x, (kernel.reshape(2, 2, 6), np.append(bias, bias))),
        ("rms_norm", x, (kernel[:, 0], 1e-4)),
        ("silu", x, ()),
        ("convolution", image, (taps, bias, 1)),
        ("convolution", image, (taps, bias, 2)),
        ("transposed_convolution", image, (taps, bias)),
        ("max_pool", image, ()),
        ("upsample", image, ()),
    )
    for function, array, others in cases:
        expected = np.array(run.call(function, array, *others), np.float64)
        spoiled = array.copy()
        spoiled[1, 1] = np.nan
        expected[1, 1] = np.nan
        run.exact(function, run.call(function, spoiled, *others), expected)
