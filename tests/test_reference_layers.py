"""Literal numbers of spec/03-layers.md."""

import math

import numpy as np
import pytest

from reference_numpy.layers import (
    block_linear,
    convolution,
    dense,
    linear,
    max_pool,
    mlp,
    rms_norm,
    silu,
    transposed_convolution,
    truncated_normal,
    upsample,
)

ONES = np.ones((5, 5, 1, 1))
NO_BIAS = [0.0]


def tap(row, column):
    kernel = np.zeros((5, 5, 1, 1))
    kernel[row, column] = 1.0
    return kernel


def image(rows):
    return np.array(rows, dtype=np.float64)[..., None]


def test_linear():
    kernel, bias = [[1, 2, 3], [4, 5, 6]], [0.5, 0, -0.5]
    np.testing.assert_array_equal(linear([1, 2], kernel, bias), [9.5, 12, 14.5])
    np.testing.assert_array_equal(linear([[[1, 2], [0, 1]]], kernel, bias), [[[9.5, 12, 14.5], [4.5, 5, 5.5]]])


def test_block_linear():
    np.testing.assert_array_equal(block_linear([1, 2, 3, 4], [[[1], [10]], [[100], [1000]]], [0, 1]), [21, 4301])
    # Two outputs per block: the outputs of block 0 come first.
    kernel = [[[1, 2]], [[3, 4]]]
    np.testing.assert_array_equal(block_linear([[1, 10], [2, 0]], kernel, [0, 0, 0, 1]), [[1, 2, 30, 41], [2, 4, 0, 1]])


def test_one_block_is_linear():
    np.testing.assert_array_equal(block_linear([1, 2], [[[1, 2, 3], [4, 5, 6]]], [0.5, 0, -0.5]), [9.5, 12, 14.5])


def test_rms_norm():
    np.testing.assert_allclose(rms_norm([3, 4], [1, 1], 1e-4), [0.84852474, 1.13136632], atol=1e-8)
    np.testing.assert_allclose(rms_norm([3, 4], [2, -1], 0.0), [6 / math.sqrt(12.5), -4 / math.sqrt(12.5)])
    np.testing.assert_array_equal(rms_norm([0, 0], [1, 1], 1e-4), [0, 0])
    np.testing.assert_allclose(rms_norm([1e-5, 1e-5], [1, 1], 1e-4), [9.999995e-4] * 2, rtol=1e-12)


def test_silu():
    np.testing.assert_allclose(silu([1, -1, 2, -20]), [0.7310586, -0.2689414, 1.7615942, -4.1223072e-8], rtol=1e-6)
    np.testing.assert_array_equal(
        silu([0.0, -0.0, np.inf, -np.inf, np.nan, -1e30, 3e38]), [0, 0, np.inf, np.nan, np.nan, 0, 3e38]
    )


def test_convolution_with_stride_1_counts_taps():
    y = convolution(np.ones((4, 4, 1)), ONES, NO_BIAS, 1)
    np.testing.assert_array_equal(y[..., 0], np.outer([3, 4, 4, 3], [3, 4, 4, 3]))


def test_convolution_with_stride_2_counts_taps():
    y = convolution(np.ones((4, 4, 1)), ONES, NO_BIAS, 2)
    np.testing.assert_array_equal(y[..., 0], [[16, 12], [12, 9]])


@pytest.mark.parametrize(
    ("row", "column", "expected"),
    [(0, 0, [[0, 0], [0, 11]]), (1, 1, [[0, 2], [20, 22]]), (4, 4, [[33, 0], [0, 0]]), (1, 2, [[1, 3], [21, 23]])],
)
def test_where_the_taps_of_stride_2_look(row, column, expected):
    x = image([[10 * i + j for j in range(4)] for i in range(4)])
    np.testing.assert_array_equal(convolution(x, tap(row, column), NO_BIAS, 2)[..., 0], expected)


def test_where_the_taps_of_stride_1_look():
    x = image([[1, 2], [3, 4]])
    np.testing.assert_array_equal(convolution(x, tap(2, 2), [5.0], 1)[..., 0], [[6, 7], [8, 9]])
    np.testing.assert_array_equal(convolution(x, tap(2, 3), NO_BIAS, 1)[..., 0], [[2, 0], [4, 0]])
    np.testing.assert_array_equal(convolution(x, tap(1, 2), NO_BIAS, 1)[..., 0], [[0, 0], [1, 2]])


def test_convolution_mixes_channels_and_keeps_leading_axes():
    x = np.ones((2, 3, 4, 6, 2)) * [1.0, 10.0]
    kernel = np.zeros((5, 5, 2, 3))
    kernel[2, 2] = [[1, 0, 1], [0, 1, 1]]
    y = convolution(x, kernel, [0, 0, 100], 1)
    assert y.shape == (2, 3, 4, 6, 3)
    np.testing.assert_array_equal(y[1, 2, 3, 5], [1, 10, 111])
    assert convolution(x, kernel, [0, 0, 0], 2).shape == (2, 3, 2, 3, 3)


def test_transposed_convolution():
    weights = np.add.outer(10 * np.arange(5), np.arange(5))[..., None, None]
    np.testing.assert_array_equal(transposed_convolution([[[1.0]]], weights, NO_BIAS)[..., 0], [[11, 12], [21, 22]])
    np.testing.assert_array_equal(
        transposed_convolution(np.ones((2, 2, 1)), ONES, NO_BIAS)[..., 0], np.outer([1, 2, 2, 2], [1, 2, 2, 2])
    )
    np.testing.assert_array_equal(transposed_convolution(np.zeros((1, 1, 1)), ONES, [7.0])[..., 0], [[7, 7], [7, 7]])


def test_transposed_convolution_is_the_adjoint():
    rng = np.random.default_rng(0)
    x, y, kernel = rng.normal(size=(3, 2, 4)), rng.normal(size=(6, 4, 2)), rng.normal(size=(5, 5, 2, 4))
    forward = np.sum(convolution(y, kernel, np.zeros(4), 2) * x)
    backward = np.sum(y * transposed_convolution(x, kernel.swapaxes(2, 3), np.zeros(2)))
    assert forward == pytest.approx(backward, rel=1e-12)


def test_pooling_and_upsampling():
    np.testing.assert_array_equal(max_pool(image([[1, 2, 0, -1], [3, 4, -5, -2]]))[..., 0], [[4, 0]])
    assert np.isnan(max_pool(image([[1, np.nan], [3, 4]]))).all()
    np.testing.assert_array_equal(upsample(image([[1, 2]]))[..., 0], [[1, 1, 2, 2], [1, 1, 2, 2]])
    assert upsample(np.zeros((7, 2, 3, 5))).shape == (7, 4, 6, 5)


def test_dense_and_mlp():
    eye = {"kernel": np.eye(2), "bias": np.array([0.0, 1.0]), "scale": np.array([1.0, 2.0])}
    params = {f"actor/hidden{layer}/{name}": value for layer in range(2) for name, value in eye.items()}
    once = dense(params, "actor/hidden0", [3.0, 3.0], 0.0)
    root = math.sqrt(12.5)
    np.testing.assert_allclose(once, silu([3 / root, 8 / root]), rtol=1e-14)
    np.testing.assert_array_equal(mlp(params, "actor", [3.0, 3.0], 2, 0.0), dense(params, "actor/hidden1", once, 0.0))
    with pytest.raises(KeyError, match="actor/hidden2/kernel"):
        mlp(params, "actor", [3.0, 3.0], 3, 0.0)
    with pytest.raises(ValueError, match="layers"):
        mlp(params, "actor", [3.0, 3.0], 0, 0.0)


def test_truncated_normal():
    expected = [-2.273694468677113, -0.7265726083068367, 0.0, 0.7265726083068367, 1.346064035128025]
    np.testing.assert_allclose(truncated_normal([0.0, 0.25, 0.5, 0.75, 0.9], 1, 1.0), expected, atol=1e-12)
    assert truncated_normal(0.9, 1024, 1.0) == pytest.approx(0.042064501097750784, rel=1e-12)
    assert truncated_normal(0.9, 1024, 0.01) == pytest.approx(0.00042064501097750784, rel=1e-12)
    np.testing.assert_array_equal(truncated_normal([[0.1, 0.9]], 4, 0.0), [[0.0, 0.0]])


def test_truncated_normal_has_its_standard_deviation():
    weights = truncated_normal((np.arange(20000) + 0.5) / 20000, 16, 1.0)
    assert np.mean(weights**2) == pytest.approx(1 / 16, rel=1e-4)
    assert np.abs(weights).max() <= 2.273694468677113 / 4


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: linear([1, 2, 3], np.zeros((2, 2)), [0, 0]), "x: expected shape"),
        (lambda: linear([1, 2], np.zeros((2, 2)), [0]), "bias: expected shape"),
        (lambda: linear([1, 2], np.zeros((1, 2, 2)), [0, 0]), "kernel: expected shape"),
        (lambda: block_linear([1, 2, 3], np.zeros((2, 2, 1)), [0, 0]), "x: expected shape"),
        (lambda: rms_norm([1, 2], [1], 1e-4), "x: expected shape"),
        (lambda: convolution(np.zeros((4, 4, 1)), np.zeros((3, 3, 1, 1)), NO_BIAS, 1), "kernel: expected shape"),
        (lambda: convolution(np.zeros((4, 4)), ONES, NO_BIAS, 1), "x: expected shape"),
        (lambda: convolution(np.zeros((4, 5, 1)), ONES, NO_BIAS, 2), "even"),
        (lambda: convolution(np.zeros((4, 4, 1)), ONES, NO_BIAS, 3), "stride: expected 1 or 2"),
        (lambda: transposed_convolution(np.zeros((4, 4, 2)), ONES, NO_BIAS), "x: expected shape"),
        (lambda: max_pool(np.zeros((3, 4, 1))), "even"),
        (lambda: truncated_normal(0.5, 0, 1.0), "fan_in"),
    ],
)
def test_wrong_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("leading", [(), (0,), (2, 0), (2, 3)])
def test_a_convolution_takes_any_leading_axes(leading: tuple[int, ...]) -> None:
    """No image, one, or many: each as if it were alone."""
    rng = np.random.default_rng(0)
    x, kernel, bias = rng.normal(size=(*leading, 6, 4, 3)), rng.normal(size=(5, 5, 3, 2)), rng.normal(size=2)
    for stride in (1, 2):
        y = convolution(x, kernel, bias, stride)
        assert y.shape == (*leading, 6 // stride, 4 // stride, 2)
        for place in np.ndindex(leading):
            np.testing.assert_allclose(y[place], convolution(x[place], kernel, bias, stride), rtol=1e-12)
