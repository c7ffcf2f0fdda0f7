"""Layers: exact properties and edge cases. The numbers of spec/03-layers.md are in tests/test_examples.py."""

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


def image(rows):
    return np.array(rows, dtype=np.float64)[..., None]


def test_silu_of_special_numbers():
    np.testing.assert_array_equal(
        silu([0.0, -0.0, np.inf, -np.inf, np.nan, -1e30, 3e38]), [0, 0, np.inf, np.nan, np.nan, 0, 3e38]
    )


def test_transposed_convolution_is_the_adjoint():
    rng = np.random.default_rng(0)
    x, y, kernel = rng.normal(size=(3, 2, 4)), rng.normal(size=(6, 4, 2)), rng.normal(size=(5, 5, 2, 4))
    forward = np.sum(convolution(y, kernel, np.zeros(4), 2) * x)
    backward = np.sum(y * transposed_convolution(x, kernel.swapaxes(2, 3), np.zeros(2)))
    assert forward == pytest.approx(backward, rel=1e-12)


def test_pooling_and_upsampling():
    assert np.isnan(max_pool(image([[1, np.nan], [3, 4]]))).all()
    assert upsample(np.zeros((7, 2, 3, 5))).shape == (7, 4, 6, 5)


def test_dense_and_mlp():
    eye = {"kernel": np.eye(2), "bias": np.array([0.0, 1.0]), "scale": np.array([1.0, 2.0])}
    params = {f"actor/hidden{layer}/{name}": value for layer in range(2) for name, value in eye.items()}
    once = dense(params, "actor/hidden0", [3.0, 3.0], 0.0)
    np.testing.assert_array_equal(mlp(params, "actor", [3.0, 3.0], 2, 0.0), dense(params, "actor/hidden1", once, 0.0))
    with pytest.raises(KeyError, match="actor/hidden2/kernel"):
        mlp(params, "actor", [3.0, 3.0], 3, 0.0)
    with pytest.raises(ValueError, match="layers"):
        mlp(params, "actor", [3.0, 3.0], 0, 0.0)


def test_truncated_normal_has_its_standard_deviation():
    weights = truncated_normal((np.arange(20000) + 0.5) / 20000, 16, 1.0)
    assert np.mean(weights**2) == pytest.approx(1 / 16, rel=1e-4)
    assert np.abs(weights).max() <= -truncated_normal(0.0, 16, 1.0)


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
