"""Numbers of any size: symlog, symexp, the bins, twohot weights and the ordered expectation. Chapter:
spec/01-transforms.md."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from impl_jax.checks import require


def real(x: ArrayLike) -> jax.Array:
    """x in float32 or float64: everything but float64 is converted to float32. [TRA-1], [DIS-1]"""
    array = jnp.asarray(x)
    return array if array.dtype == jnp.float64 else array.astype(jnp.float32)


def symlog(x: ArrayLike) -> jax.Array:
    """sign(x) ln(1 + |x|), elementwise. Section "Robust predictions". [TRA-3]"""
    x = real(x)
    return jnp.sign(x) * jnp.log1p(jnp.abs(x))


def symexp(x: ArrayLike) -> jax.Array:
    """sign(x) (e^|x| - 1), elementwise: the inverse of `symlog`. [TRA-4]"""
    x = real(x)
    return jnp.sign(x) * jnp.expm1(jnp.abs(x))


def exponential_bins(bins: int) -> np.ndarray:
    """The positions of the twohot distributions: [bins], NumPy float64, antisymmetric, from -symexp(20) to symexp(20).
    [TRA-5], [TRA-6]

    Raises:
      ValueError: an even number of bins, or less than three.
    """
    require(bins % 2 == 1 and bins >= 3, "bins", "an odd number of at least 3", bins)
    half = bins // 2
    positive = np.expm1(20.0 * np.arange(1, half + 1) / half)
    return np.concatenate([-positive[::-1], [0.0], positive])


def twohot(x: ArrayLike, bins: ArrayLike) -> jax.Array:
    """Weights of the two bins around each number, interpolated between the bins themselves: [...] -> [..., K]. [TRA-7]
    to [TRA-9]

    Raises:
      ValueError: bins that are not a vector of at least two. [TRA-13]
    """
    x, bins = real(x), jnp.asarray(bins)
    require(
        bins.ndim == 1 and bins.shape[0] >= 2, "bins", "a vector of at least 2 numbers", f"shape {list(bins.shape)}"
    )
    bins = jax.lax.stop_gradient(bins.astype(x.dtype))
    x = jnp.clip(x, bins[0], bins[-1])[..., None]
    # The top bin gets a width too, so that a number at the upper end has weight exactly 1 by the same formula as at any
    # other bin.
    widths = jnp.append(jnp.diff(bins), jnp.ones((), x.dtype))
    lower = jnp.maximum(jnp.sum(bins <= x, axis=-1, keepdims=True) - 1, 0)
    share = jnp.minimum((x - bins[lower]) / widths[lower], 1.0)
    index = jnp.arange(bins.shape[0])
    weights = jnp.where(index == lower, 1.0 - share, jnp.where(index == lower + 1, share, 0.0))
    return jnp.where(jnp.isnan(x), x, weights)


def ordered_expectation(probs: ArrayLike, bins: ArrayLike) -> jax.Array:
    """The mean of distributions over the bins: [..., K] -> [...], exactly 0 for mirror-symmetric ones. [TRA-10] to
    [TRA-12]

    Raises:
      ValueError: an even number of bins, or a last axis of another length. [TRA-13]
    """
    probs, bins = real(probs), jnp.asarray(bins)
    valid = bins.ndim == 1 and bins.shape[0] >= 3 and bins.shape[0] % 2 == 1
    require(valid, "bins", "a vector with an odd number of at least 3 entries", f"shape {list(bins.shape)}")
    size = bins.shape[0]
    require(
        probs.ndim >= 1 and probs.shape[-1] == size, "probs", f"a last axis of {size}", f"shape {list(probs.shape)}"
    )
    bins = jax.lax.stop_gradient(bins.astype(probs.dtype))
    half = size // 2
    # Differences first: a fused multiply-add of the separate products would leave a rounding error behind where they
    # cancel.
    difference = probs[..., half + 1 :] - probs[..., :half][..., ::-1]
    return jnp.sum(difference * bins[half + 1 :], axis=-1) + probs[..., half] * bins[half]
