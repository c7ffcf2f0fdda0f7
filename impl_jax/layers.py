"""The parts that networks are built from. Chapter: spec/03-layers.md.

Parameters keep their own precision; every function converts them to the dtype of `x`, which the caller has put into the
compute dtype, and returns that dtype. [LAY-1]

Automatic differentiation would take the gradient of a float32 parameter back through that conversion, summed and
rounded in bfloat16. The gradients written by hand are there to sum them in float32 [CON-23], or to keep less in memory.
"""

import functools
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike

from impl_jax import convolutions
from impl_jax.shapes import require, require_shape, widen

Params = Mapping[str, jax.Array]

# Standard deviation of the standard normal truncated to two deviations.
_TRUNCATED_STD = 0.8796256610342398
_CHUNK_BYTES = 2 << 20  # of activations that `activate` differentiates at a time, see there


def _dot(x: jax.Array, y: jax.Array, axes: Any, blocks: Any = ((), ()), dtype: Any = None) -> jax.Array:
    """`lax.dot_general` over `axes` of x and y, for each of `blocks`; sums, and gives, `dtype` or that of x."""
    precision = convolutions.precision(x.dtype)
    return lax.dot_general(x, y, (axes, blocks), precision=precision, preferred_element_type=dtype)


# The adjoint of y = x W, here and for convolutions: dx = g Wᵀ and dW = xᵀ g, summed over all rows, with g = dL/dy.
# `preferred_element_type` lets the product of two bfloat16 arrays add up in float32 and stay float32.


@jax.custom_vjp
def product(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """[..., in] x [in, out] -> [..., out], in the dtype of x; the kernel's gradient in the kernel's dtype. [CON-23]"""
    return _dot(x, kernel.astype(x.dtype), ((x.ndim - 1,), (0,)))


def _product_bwd(saved: tuple[jax.Array, jax.Array], g: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, kernel = saved
    dx = _dot(g, kernel.astype(x.dtype), ((g.ndim - 1,), (1,)))
    return dx, product_kernel_gradient(x, g, kernel.dtype)


def product_kernel_gradient(x: jax.Array, g: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """[..., in], [..., out] -> [in, out], summed over the leading axes."""
    axes = tuple(range(x.ndim - 1))
    return _dot(x, g, (axes, axes), dtype=dtype)


product.defvjp(lambda x, kernel: (product(x, kernel), (x, kernel)), _product_bwd)


@jax.custom_vjp
def block_product(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """One product for each block: [G, n, in/G] x [G, in/G, out/G] -> [G, n, out/G]."""
    return _dot(x, kernel.astype(x.dtype), ((2,), (1,)), ((0,), (0,)))


def _block_product_bwd(saved: tuple[jax.Array, jax.Array], g: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, kernel = saved
    dx = _dot(g, kernel.astype(x.dtype), ((2,), (2,)), ((0,), (0,)))
    return dx, block_kernel_gradient(x, g, kernel.dtype)


def block_kernel_gradient(x: jax.Array, g: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """[G, n, in/G], [G, n, out/G] -> [G, in/G, out/G], summed over the rows."""
    return _dot(x, g, ((1,), (1,)), ((0,), (0,)), dtype)


block_product.defvjp(lambda x, kernel: (block_product(x, kernel), (x, kernel)), _block_product_bwd)


def column_sum(x: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """[n, c] -> [c], as a product with ones: on the CPU several times as fast as XLA's sum over rows, and as exact."""
    return _dot(jnp.ones((1, x.shape[0]), x.dtype), x, ((1,), (0,)), dtype=dtype)[0]


@jax.custom_vjp
def add_bias(x: jax.Array, bias: jax.Array) -> jax.Array:
    """x + bias, where the bias broadcasts; its gradient is summed in its own dtype. [CON-23]"""
    return x + bias.astype(x.dtype)


def _add_bias_bwd(bias: jax.Array, g: jax.Array) -> tuple[jax.Array, jax.Array]:
    if bias.ndim == 1:
        return g, column_sum(g.reshape(-1, g.shape[-1]), bias.dtype)
    shape = (1,) * (g.ndim - bias.ndim) + bias.shape  # of the GRU: [G, 1, out/G]
    axes = tuple(axis for axis in range(g.ndim) if shape[axis] == 1)
    return g, jnp.sum(g.astype(bias.dtype), axis=axes).reshape(bias.shape)


add_bias.defvjp(lambda x, bias: (add_bias(x, bias), bias), _add_bias_bwd)


def to_blocks(x: jax.Array, blocks: int) -> jax.Array:
    """[n, in] -> [G, n, in/G]: block-major, so that each block is a matrix of its own."""
    return x.reshape(x.shape[0], blocks, -1).transpose(1, 0, 2)


def from_blocks(x: jax.Array) -> jax.Array:
    """The inverse of `to_blocks`."""
    return x.transpose(1, 0, 2).reshape(x.shape[1], -1)


def linear(x: jax.Array, kernel: jax.Array, bias: jax.Array) -> jax.Array:
    """[..., in] -> [..., out] with kernel [in, out] and bias [out]. [LAY-2]"""
    require_shape("kernel", kernel.shape, "in", "out")
    require_shape("x", x.shape, ..., kernel.shape[0])
    require_shape("bias", bias.shape, kernel.shape[1])
    return add_bias(product(x, kernel), bias)


def block_linear(x: jax.Array, kernel: jax.Array, bias: jax.Array) -> jax.Array:
    """[..., in] -> [..., out] with kernel [G, in/G, out/G] and bias [out]: each piece of x by itself. [LAY-3]"""
    require_shape("kernel", kernel.shape, "G", "in/G", "out/G")
    blocks, inputs, outputs = kernel.shape
    require_shape("x", x.shape, ..., blocks * inputs)
    require_shape("bias", bias.shape, blocks * outputs)
    rows = to_blocks(x.reshape(-1, x.shape[-1]), blocks)  # [G, N, in/G]
    return add_bias(from_blocks(block_product(rows, kernel)).reshape(*x.shape[:-1], -1), bias)


def rms_norm(x: jax.Array, scale: jax.Array, epsilon: float) -> jax.Array:
    """x / sqrt(mean(x^2) + epsilon) * scale over the last axis, in float32 or better, rounded at the end. [LAY-4]"""
    require_shape("scale", scale.shape, "n")
    require_shape("x", x.shape, ..., len(scale))
    return rms_norm_over(x, scale, epsilon, (-1,))


def rms_norm_over(x: jax.Array, scale: jax.Array, epsilon: float, axes: tuple[int, ...]) -> jax.Array:
    """`rms_norm` over several axes, with a scale that broadcasts."""
    wide = widen(x)
    count = math.prod(x.shape[axis] for axis in axes)
    # The factor goes in before the square: a sum of many large squares would overflow where their mean does not.
    mean_square = jnp.sum(jnp.square(wide * count**-0.5), axis=axes, keepdims=True)
    return (wide * lax.rsqrt(mean_square + epsilon) * _rounded(scale, x.dtype)).astype(x.dtype)


def _rounded(scale: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """A scale in float32 or better, with the digits that it has in `dtype`. [LAY-1]

    Its gradient is not rounded [CON-23], as it would be by a conversion to `dtype` and back; and XLA may leave such a
    pair of conversions out.
    """
    wide = scale.astype(jnp.promote_types(dtype, jnp.float32))
    if wide.dtype == dtype:
        return wide
    digits = jnp.finfo(dtype)
    return wide + lax.stop_gradient(lax.reduce_precision(wide, digits.nexp, digits.nmant) - wide)


def silu(x: jax.Array) -> jax.Array:
    """x * sigmoid(x), elementwise. [LAY-5]"""
    return x * jax.nn.sigmoid(x)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def activate(x: jax.Array, scale: jax.Array, epsilon: float) -> jax.Array:
    """silu(rms_norm(x, scale)): [..., n] -> [..., n]. [LAY-4], [LAY-5]

    Its gradient computes both again from x, which is cheaper than keeping what lies between them in memory.
    """
    return silu(rms_norm(x, scale, epsilon))


def _activate_bwd(epsilon: float, saved: tuple[jax.Array, jax.Array], g: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The gradients by x and scale of y = silu(v) with v = u scale, u = ρ x, given g = dL/dy.

    With ρ = 1 / sqrt(mean(x²) + epsilon) over n entries, du_j/dx_k = ρ (δ_jk - u_j u_k / n). So, with s = g silu'(v)
    and a = s scale: dL/dx = ρ (a - u mean(a u)), dL/dscale = sum over rows of s u.
    """
    x, scale = saved

    def rows(x: jax.Array, g: jax.Array) -> tuple[jax.Array, jax.Array]:
        """[N, n], [N, n] -> [N, n], [n]."""
        wide, scale_, count = widen(x), _rounded(scale, x.dtype), x.shape[-1]
        inverse = lax.rsqrt(jnp.sum(jnp.square(wide * count**-0.5), -1, keepdims=True) + epsilon)  # ρ [N, 1]
        unit = wide * inverse  # u
        # v, rounded to the compute dtype: so SiLU has read it.
        normal = (unit * scale_).astype(x.dtype).astype(wide.dtype)
        gate = jax.nn.sigmoid(normal)
        slope = g.astype(wide.dtype) * gate * (1.0 + normal * (1.0 - gate))  # s; silu' = σ(v) (1 + v (1 - σ(v)))
        along = slope * scale_  # a
        dx = inverse * (along - unit * jnp.mean(along * unit, -1, keepdims=True))
        return dx.astype(x.dtype), column_sum(slope * unit, wide.dtype)

    def by_chunks(x: jax.Array, g: jax.Array) -> tuple[jax.Array, jax.Array]:
        """On the CPU a part at a time, so that what lies in between stays in the cache."""
        chunk = convolutions.divisor(x.shape[0], _CHUNK_BYTES // (x.shape[1] * x.dtype.itemsize))
        if chunk == x.shape[0]:
            return rows(x, g)

        def add(total: jax.Array, now: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
            dx, dscale = rows(now[0], now[1])
            return total + dscale, dx

        start = jnp.zeros(scale.shape, jnp.promote_types(x.dtype, jnp.float32))
        dscale, dx = lax.scan(add, start, tuple(a.reshape(-1, chunk, a.shape[1]) for a in (x, g)))
        return dx.reshape(x.shape), dscale

    flat = (a.reshape(-1, a.shape[-1]) for a in (x, g))
    dx, dscale = lax.platform_dependent(*flat, cpu=by_chunks, default=rows)
    return dx.reshape(x.shape), dscale.astype(scale.dtype)


activate.defvjp(lambda x, scale, epsilon: (activate(x, scale, epsilon), (x, scale)), _activate_bwd)


def convolution(x: jax.Array, kernel: jax.Array, bias: jax.Array, stride: int) -> jax.Array:
    """5 x 5 cross-correlation with zeros around: [..., H, W, in] -> [..., H/stride, W/stride, out]. [LAY-6]"""
    require(stride in (1, 2), "stride", "1 or 2", stride)
    images = _images(x, kernel, bias)
    if stride == 2:
        _require_even_sides(x)
    y = convolutions.same(images, kernel) if stride == 1 else convolutions.halve(images, kernel)
    return add_bias(y.reshape(*x.shape[:-3], *y.shape[1:]), bias)


def transposed_convolution(x: jax.Array, kernel: jax.Array, bias: jax.Array) -> jax.Array:
    """The adjoint of the convolution of stride 2: [..., H, W, in] -> [..., 2H, 2W, out]. [LAY-7]"""
    y = convolutions.double(_images(x, kernel, bias), kernel)
    return add_bias(y.reshape(*x.shape[:-3], *y.shape[1:]), bias)


def upsampled_convolution(x: jax.Array, kernel: jax.Array, bias: jax.Array) -> jax.Array:
    """convolution(upsample(x), kernel, bias, 1), the upsampled image never made: [..., H, W, in] -> [..., 2H, 2W, out].

    [LAY-14]
    """
    y = convolutions.same(_images(x, kernel, bias), convolutions.upsampling_kernel(kernel))  # [n, H, W, (2, 2, out)]
    y = convolutions.depth_to_space(y)
    return add_bias(y.reshape(*x.shape[:-3], *y.shape[1:]), bias)


def _images(x: jax.Array, kernel: jax.Array, bias: jax.Array) -> jax.Array:
    """x with its leading axes as one, after the checks of [LAY-15]."""
    require_shape("kernel", kernel.shape, 5, 5, "in", "out")
    require_shape("x", x.shape, ..., "H", "W", kernel.shape[2])
    require_shape("bias", bias.shape, kernel.shape[3])
    return x.reshape(-1, *x.shape[-3:])


def _require_even_sides(x: jax.Array) -> None:
    require(not (x.shape[-3] % 2 or x.shape[-2] % 2), "x", "an even height and width", list(x.shape))


def max_pool(x: jax.Array) -> jax.Array:
    """The maximum of each 2 x 2 window: [..., H, W, C] -> [..., H/2, W/2, C]. [LAY-12]

    With comparisons, whose gradient goes to the first maximum; `jnp.maximum` would share it among equals.
    """
    require_shape("x", x.shape, ..., "H", "W", "C")
    _require_even_sides(x)
    *leading, height, width, channels = x.shape
    x = x.reshape(*leading, height // 2, 2, width // 2, 2, channels)

    def first_maximum(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where((a >= b) | jnp.isnan(a), a, b)

    upper = first_maximum(x[..., 0, :, 0, :], x[..., 0, :, 1, :])
    return first_maximum(first_maximum(upper, x[..., 1, :, 0, :]), x[..., 1, :, 1, :])


def upsample(x: jax.Array) -> jax.Array:
    """Every pixel twice in both axes: [..., H, W, C] -> [..., 2H, 2W, C]. [LAY-13]"""
    require_shape("x", x.shape, ..., "H", "W", "C")
    *leading, height, width, channels = x.shape
    x = jnp.broadcast_to(x[..., :, None, :, None, :], (*leading, height, 2, width, 2, channels))
    return x.reshape(*leading, 2 * height, 2 * width, channels)


def dense(params: Params, name: str, x: jax.Array, epsilon: float) -> jax.Array:
    """Linear, RMSNorm, SiLU with the parameters under one name: [..., in] -> [..., out]. [LAY-8]"""
    return activate(linear(x, params[f"{name}/kernel"], params[f"{name}/bias"]), params[f"{name}/scale"], epsilon)


def mlp(params: Params, name: str, x: jax.Array, layers: int, epsilon: float) -> jax.Array:
    """The dense layers name/hidden0, name/hidden1, ...: [..., in] -> [..., out]. [LAY-8]"""
    require(layers >= 1, "layers", "at least 1", layers)
    for layer in range(layers):
        x = dense(params, f"{name}/hidden{layer}", x, epsilon)
    return x


def truncated_normal(uniform: ArrayLike, fan_in: int, outscale: float) -> jax.Array:
    """Initial weights from uniforms, any shape: standard deviation outscale / sqrt(fan_in). [LAY-9] to [LAY-11]"""
    require(fan_in >= 1, "fan_in", "at least 1", fan_in)
    uniform = widen(uniform)
    normal = math.sqrt(2) * lax.erf_inv((2.0 * uniform - 1.0) * math.erf(math.sqrt(2)))
    return jnp.clip(normal, -2.0, 2.0) * (outscale / (_TRUNCATED_STD * math.sqrt(fan_in)))
