"""equinox: linear and convolution layers, RMSNorm.

Written for equinox 0.13.8. Its layers work on one example, channels first, and keep kernels as [out, in, ...]: the
adapter swaps the axes and gives the layers the parameters. A transposed convolution is that of `lax.conv_transpose` on
a kernel that has been flipped.
"""

import equinox as eqx
import jax
import jax.numpy as jnp

__version__ = eqx.__version__
convert = jnp.asarray
KEY = jax.random.key(0)


def setup(dtype):
    if dtype == "float64":
        jax.config.update("jax_enable_x64", True)


def over_leading_axes(layer, x, own_axes):
    """Applies a layer for one example to every leading index of x."""
    y = jax.vmap(layer)(x.reshape(-1, *x.shape[-own_axes:]))
    return y.reshape(*x.shape[:-own_axes], *y.shape[1:])


def linear(x, kernel, bias):
    layer = eqx.nn.Linear(*kernel.shape, key=KEY)
    layer = eqx.tree_at(lambda layer: (layer.weight, layer.bias), layer, (kernel.T, bias))
    return over_leading_axes(layer, x, 1)


def rms_norm(x, scale, epsilon):
    layer = eqx.nn.RMSNorm(scale.shape, eps=epsilon, use_bias=False, dtype=x.dtype)
    return over_leading_axes(eqx.tree_at(lambda layer: layer.weight, layer, scale), x, 1)


def image_layer(kind, x, kernel, bias, stride, axes):
    height, width, inputs, outputs = kernel.shape
    layer = kind(inputs, outputs, (height, width), stride, padding="SAME", key=KEY)
    layer = eqx.tree_at(lambda layer: (layer.weight, layer.bias), layer, (kernel.transpose(axes), bias[:, None, None]))
    return jnp.moveaxis(over_leading_axes(layer, jnp.moveaxis(x, -1, -3), 3), -3, -1)


def convolution(x, kernel, bias, stride):
    return image_layer(eqx.nn.Conv2d, x, kernel, bias, stride, (3, 2, 0, 1))


def transposed_convolution(x, kernel, bias):
    return image_layer(eqx.nn.ConvTranspose2d, x, kernel[::-1, ::-1], bias, 2, (3, 2, 0, 1))
