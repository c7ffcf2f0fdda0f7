"""What bfloat16 must not round."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from impl_jax import layers as jax_layers
from impl_torch import layers as torch_layers


@pytest.mark.covers("CON-23")
@pytest.mark.parametrize("kind", ["stride 1", "stride 2", "transposed"])
def test_the_gradient_of_a_convolutions_bias_is_summed_in_float32(kind: str) -> None:
    generator = torch.Generator().manual_seed(0)
    x, kernel, bias = (torch.randn(*shape, generator=generator) for shape in ((3, 2, 16, 16, 4), (5, 5, 4, 6), (6,)))
    results = []
    for dtype in (torch.bfloat16, torch.float32):
        leaf = bias.clone().requires_grad_()
        if kind == "transposed":
            y = torch_layers.transposed_convolution(x.to(dtype), kernel, leaf)
        else:
            y = torch_layers.convolution(x.to(dtype), kernel, leaf, int(kind[-1]))
        weights = torch.rand(y.shape, generator=torch.Generator().manual_seed(1)).to(torch.bfloat16)
        y.backward(weights.to(dtype))
        results.append((y.detach().float().numpy(), leaf.grad.numpy(), weights.double().sum(tuple(range(4))).numpy()))
    (narrow, by_bias, expected), (wide, wide_by_bias, _) = results
    np.testing.assert_allclose(by_bias, expected, rtol=1e-6)
    np.testing.assert_allclose(wide_by_bias, expected, rtol=1e-6)
    np.testing.assert_allclose(narrow, wide, rtol=0.01, atol=0.2)


@pytest.mark.covers("LAY-1", "LAY-4", "CON-23")
@pytest.mark.parametrize("function", ["rms_norm", "silu of it"])
@pytest.mark.parametrize("backend", ["jax", "torch"])
def test_a_norm_reads_its_scale_in_bfloat16_and_has_its_gradient_in_float32(backend: str, function: str) -> None:
    """Rounding the scale beforehand changes neither values nor gradients; the gradient itself is not rounded."""
    rng = np.random.default_rng(0)
    x, scale, by_y = (rng.normal(1, 0.3, shape).astype(np.float32) for shape in ((50, 32), (32,), (50, 32)))
    rounded = torch.tensor(scale).bfloat16().float().numpy()
    assert not np.array_equal(scale, rounded)
    results = [_norm_and_gradients(backend, function, x, values, by_y) for values in (scale, rounded)]
    for part, expected in zip(*results, strict=True):
        np.testing.assert_array_equal(part, expected)
    by_scale = results[0][2]
    assert not np.array_equal(by_scale, torch.tensor(by_scale).bfloat16().float().numpy())


def _norm_and_gradients(
    backend: str, function: str, x: np.ndarray, scale: np.ndarray, by_y: np.ndarray
) -> list[np.ndarray]:
    """Value of the norm of x in bfloat16, and the gradients by x and scale."""
    if backend == "jax":
        norm = jax_layers.rms_norm if function == "rms_norm" else jax_layers.activate

        def pulled(x: jax.Array, scale: jax.Array, by_y: jax.Array) -> tuple[jax.Array, ...]:
            y, pullback = jax.vjp(lambda x, scale: norm(x, scale, 1e-4), x, scale)
            return y, *pullback(by_y)

        narrow = jnp.bfloat16
        return [np.asarray(part, np.float32) for part in jax.jit(pulled)(x.astype(narrow), scale, by_y.astype(narrow))]
    narrow_x, wide_scale = torch.tensor(x).bfloat16().requires_grad_(), torch.tensor(scale).requires_grad_()
    y = (torch_layers.rms_norm if function == "rms_norm" else torch_layers.norm_silu)(narrow_x, wide_scale, 1e-4)
    y.backward(torch.tensor(by_y).bfloat16())
    return [part.detach().float().numpy() for part in (y, narrow_x.grad, wide_scale.grad)]
