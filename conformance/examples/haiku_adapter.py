"""haiku: the truncated-normal initializer, RMSNorm and linear layers.

Written for dm-haiku 0.0.17. The fan-in is what haiku computes from the shape of the kernel.
"""

import haiku as hk
import jax
import jax.numpy as jnp

from spec import parameter_table

__version__ = hk.__version__
convert = jnp.asarray


def setup(dtype):
    if dtype == "float64":
        jax.config.update("jax_enable_x64", True)


def apply(function, params, x):
    return hk.transform(lambda x: function()(x)).apply(params, None, x)


def linear(x, kernel, bias):
    return apply(lambda: hk.Linear(kernel.shape[1]), {"linear": {"w": kernel, "b": bias}}, x)


def rms_norm(x, scale, epsilon):
    return apply(lambda: hk.RMSNorm(axis=-1, eps=epsilon), {"rms_norm": {"scale": scale}}, x)


def draw_parameters(spaces, config, seed):
    def initial():
        kinds = {"zeros": hk.initializers.Constant(0.0), "ones": hk.initializers.Constant(1.0)}
        values = {}
        for name, entry in parameter_table(config, spaces).items():
            truncated = (
                hk.initializers.VarianceScaling(entry.outscale**2, "fan_in", "truncated_normal")
                if entry.outscale
                else kinds["zeros"]
            )
            values[name] = kinds.get(entry.initializer, truncated)(entry.shape, jnp.float32)
        return values

    return hk.transform(initial).apply({}, jax.random.key(seed))
