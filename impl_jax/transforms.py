"""Numbers of any size: symlog, symexp, bins, twohot weights, ordered expectation. Chapter: spec/01-transforms.md."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from impl_jax.shapes import require, require_shape, widen


def symlog(x: ArrayLike) -> jax.Array:
    """sign(x) ln(1 + |x|), elementwise. Section "Robust predictions". [TRA-3]"""
    x = widen(x)
    return jnp.sign(x) * jnp.log1p(jnp.abs(x))


def symexp(x: ArrayLike) -> jax.Array:
    """sign(x) (e^|x| - 1), elementwise: the inverse of `symlog`. [TRA-4]"""
    x = widen(x)
    return jnp.sign(x) * jnp.expm1(jnp.abs(x))


def exponential_bins(bins: int) -> np.ndarray:
    """Positions [bins] in NumPy float64: symexp of even steps from -20 to 20, exactly antisymmetric. [TRA-5], [TRA-6]

    NumPy's, so that they are a constant of the compiled program and not computed by it.

    Raises:
      ValueError: an even number of bins, or less than three.
    """
    require(bins % 2 == 1 and bins >= 3, "bins", "an odd number of at least 3", bins)
    half = bins // 2
    positive = np.expm1(20.0 * np.arange(1, half + 1) / half)
    return np.concatenate([-positive[::-1], [0.0], positive])


def twohot(x: ArrayLike, bins: ArrayLike) -> jax.Array:
    """Weights of the two bins around each number, interpolated between them: [...] -> [..., K]. [TRA-7] to [TRA-9]

    Dense, with comparisons in place of a search and a scatter: XLA fuses comparisons with what reads the weights, and
    would write out what a scatter makes.

    Raises:
      ValueError: bins that are not a vector of at least two. [TRA-13]
    """
    x, bins = widen(x), jnp.asarray(bins)
    require_shape("bins", bins.shape, "K")
    require(len(bins) >= 2, "bins", "at least 2 bins", len(bins))
    bins = jax.lax.stop_gradient(bins.astype(x.dtype))
    x = jnp.clip(x, bins[0], bins[-1])[..., None]  # [..., 1]
    # The top bin gets a width too: a number at the upper end then has weight exactly 1 by the formula of any other bin.
    widths = jnp.append(jnp.diff(bins), jnp.ones((), x.dtype))  # [K]
    lower = jnp.maximum(jnp.sum(bins <= x, axis=-1, keepdims=True) - 1, 0)  # [..., 1]
    share = jnp.minimum((x - bins[lower]) / widths[lower], 1.0)  # [..., 1]: of the bin above
    index = jnp.arange(bins.shape[0])
    weights = jnp.where(index == lower, 1.0 - share, jnp.where(index == lower + 1, share, 0.0))  # [..., K]
    return jnp.where(jnp.isnan(x), x, weights)


def ordered_expectation(probs: ArrayLike, bins: ArrayLike) -> jax.Array:
    """Means over the bins: [..., K] -> [...], exactly 0 for mirror-symmetric probabilities. [TRA-10] to [TRA-12]

    Raises:
      ValueError: an even number of bins, or a last axis of another length. [TRA-13]
    """
    probs, bins = widen(probs), jnp.asarray(bins)
    require_shape("bins", bins.shape, "K")
    require(len(bins) % 2 == 1 and len(bins) >= 3, "bins", "an odd number of at least 3", len(bins))
    require_shape("probs", probs.shape, ..., len(bins))
    bins = jax.lax.stop_gradient(bins.astype(probs.dtype))
    half = len(bins) // 2
    # The difference of each mirrored pair comes first: of two products, XLA would fuse one with the sum and round the
    # other, and leave behind a rounding error where they should cancel.
    difference = probs[..., half + 1 :] - probs[..., :half][..., ::-1]  # [..., K // 2]
    return jnp.sum(difference * bins[half + 1 :], axis=-1) + probs[..., half] * bins[half]
