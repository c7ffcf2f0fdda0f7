"""Symlog, exponential bins, two-hot encoding and its mean. Chapter: spec/01-transforms.md."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from reference_numpy.shapes import checked, require

Array = NDArray[np.float64]


def symlog(x: Any) -> Array:
    """Symmetric logarithm, element by element. Implements [TRA-1], [TRA-2], [TRA-3].

    Paper: eq. symlog, section Robust predictions.

    Args:
      x: real numbers of any shape.

    Returns:
      The same shape: sign(x) ln(1 + |x|).
    """
    x = np.asarray(x, dtype=np.float64)
    return np.sign(x) * np.log1p(np.abs(x))


def symexp(x: Any) -> Array:
    """Inverse of symlog, element by element. Implements [TRA-1], [TRA-2], [TRA-4].

    Paper: eq. symlog, section Robust predictions.

    Args:
      x: real numbers of any shape.

    Returns:
      The same shape: sign(x) (exp(|x|) - 1), infinite where that overflows.
    """
    x = np.asarray(x, dtype=np.float64)
    with np.errstate(over="ignore"):
        return np.sign(x) * np.expm1(np.abs(x))


def exponential_bins(bins: int) -> Array:
    """The positions of the bins that rewards and values are distributed over. Implements [TRA-5], [TRA-6].

    Paper: section Robust predictions, B = symexp([-20 ... 20]).

    Args:
      bins: their number K, odd.

    Returns:
      [K], strictly increasing, each the exact negative of its mirror image.

    Raises:
      ValueError: an even number of bins, or less than 3.
    """
    require(bins % 2 == 1 and bins >= 3, "bins", "an odd number of at least 3", bins)
    centre = (bins - 1) // 2
    positive = symexp(20.0 * np.arange(1, centre + 1) / centre)
    return np.concatenate([-positive[::-1], [0.0], positive])


def twohot(x: Any, bins: Any) -> Array:
    """Weights of the two bins around each number, so that their mean is the number.
    Implements [TRA-7] to [TRA-9], [TRA-13], [TRA-14].

    Paper: eq. twohot, section Distributions; D-45, D-46.

    Args:
      x: [...], in the unit of the bins.
      bins: [K], strictly increasing.

    Returns:
      [..., K], zero except for the last bin that is <= x and its upper neighbour. Beyond the ends the end bin gets
      everything. NaN where x is NaN.

    Raises:
      ValueError: bins is not one-dimensional, or shorter than 2.
    """
    x = np.asarray(x, dtype=np.float64)
    bins = checked("bins", bins, "K")
    require(len(bins) >= 2, "bins", "at least 2 bins", len(bins))
    weights = np.zeros((*x.shape, len(bins)))
    for index in np.ndindex(x.shape):
        number = x[index]
        lower = int(np.sum(bins <= number)) - 1
        if np.isnan(number):
            weights[index] = np.nan
        elif lower < 0:
            weights[(*index, 0)] = 1.0
        elif lower == len(bins) - 1:
            weights[(*index, lower)] = 1.0
        else:
            width = bins[lower + 1] - bins[lower]
            weights[(*index, lower)] = (bins[lower + 1] - number) / width
            weights[(*index, lower + 1)] = (number - bins[lower]) / width
    return weights


def ordered_expectation(probs: Any, bins: Any) -> Array:
    """Mean of a distribution over symmetric bins, exactly 0 for symmetric probabilities.
    Implements [TRA-10] to [TRA-14].

    Paper: section Distributions (the order of summation); D-47.

    Args:
      probs: [..., K].
      bins: [K], K odd, each bin the negative of its mirror image.

    Returns:
      [...]: sum of probs * bins over the last axis, taken over mirrored pairs from small to large.

    Raises:
      ValueError: bins that are not one-dimensional, an even number, fewer than 3 or not symmetric; another last axis of
        probs.
    """
    bins = checked("bins", bins, "K")
    require(len(bins) % 2 == 1 and len(bins) >= 3, "bins", "an odd number of at least 3", len(bins))
    require(np.array_equal(bins, -bins[::-1]), "bins", "each bin the negative of its mirror image", bins.tolist())
    probs = checked("probs", probs, ..., len(bins))
    centre = len(bins) // 2
    total = np.zeros(probs.shape[:-1])
    for j in range(1, centre + 1):
        total = total + bins[centre + j] * (probs[..., centre + j] - probs[..., centre - j])
    return total + probs[..., centre] * bins[centre]
