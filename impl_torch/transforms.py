"""Transforms: numbers of any size. Chapter: spec/01-transforms.md."""

import functools

import numpy as np
import torch
from torch import Tensor

from impl_torch.shapes import require, require_shape, widen

Bins = np.ndarray | Tensor


def symlog(x: Tensor) -> Tensor:
    """sign(x) ln(1 + |x|), element by element, any shape. [TRA-1] [TRA-2] [TRA-3]"""
    x = widen(x)
    return torch.copysign(torch.log1p(x.abs()), x)


def symexp(x: Tensor) -> Tensor:
    """sign(x) (e^|x| - 1), element by element, any shape: the inverse of `symlog`. [TRA-1] [TRA-2] [TRA-4]"""
    x = widen(x)
    return torch.copysign(torch.expm1(x.abs()), x)


@functools.cache
def exponential_bins(bins: int) -> np.ndarray:
    """Positions [bins] in float64, read-only: symexp of even steps from -20 to 20, exactly antisymmetric.

    [TRA-5] [TRA-6]

    Raises:
      ValueError: an even number, or fewer than 3.
    """
    require(bins % 2 == 1 and bins >= 3, "bins", "an odd number of at least 3", bins)
    center = (bins - 1) // 2
    positive = np.expm1(20.0 * np.arange(1, center + 1) / center)
    result = np.concatenate([-positive[::-1], [0.0], positive])
    result.setflags(write=False)
    return result


@functools.cache
def standard_bins(bins: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """`exponential_bins` on a device, kept: to copy them there in every step would make an accelerator wait."""
    with torch.inference_mode(False):  # else a first call while acting would make a tensor that training cannot use
        return torch.tensor(exponential_bins(bins), dtype=dtype, device=device)


def twohot(x: Tensor, bins: Bins) -> Tensor:
    """Weights of the two bins around x: [...] and [K] -> [..., K]; the ends are clamped, NaN gives NaN.

    [TRA-1] [TRA-7] to [TRA-9] [TRA-13] [TRA-14]

    Raises:
      ValueError: bins that are not one-dimensional or fewer than 2.
    """
    indices, weights = twohot_sparse(x, bins)
    dense = weights.new_zeros((*weights.shape[:-1], len(bins))).scatter_(-1, indices, weights)
    return dense + (weights - weights).sum(-1, keepdim=True)  # 0, or NaN in all K entries


def twohot_sparse(x: Tensor, bins: Bins) -> tuple[Tensor, Tensor]:
    """The two entries of `twohot` that may differ from 0: their indices [..., 2] and weights [..., 2].

    A loss gathers these two of the 255 log-probabilities; the dense product would read, and differentiate, all of them.
    """
    require_shape("bins", bins.shape, "K")
    require(len(bins) >= 2, "bins", "at least 2 bins", len(bins))
    x = widen(x).detach()  # [...]
    bins = torch.as_tensor(bins, dtype=x.dtype, device=x.device)  # [K]
    x = torch.minimum(torch.maximum(x, bins[0]), bins[-1])
    lower = torch.searchsorted(bins, x, right=True) - 1  # the last bin that is <= x; a search puts NaN behind all bins
    lower = lower.clamp(0, len(bins) - 2)  # so that the top bin, and NaN, have an upper neighbour too
    indices = torch.stack([lower, lower + 1], -1)  # [..., 2]
    low, high = bins[indices].unbind(-1)  # [...] each
    return indices, torch.stack([high - x, x - low], -1) / (high - low).unsqueeze(-1)


def ordered_expectation(probs: Tensor, bins: Bins) -> Tensor:
    """The mean sum(probs * bins), [..., K] and [K] -> [...]; exactly 0 for mirror-symmetric probs.

    [TRA-1] [TRA-10] to [TRA-14]

    Raises:
      ValueError: bins that are not one-dimensional, fewer than 3 or even in number, or probs of another length.
    """
    require_shape("bins", bins.shape, "K")
    require(len(bins) % 2 == 1 and len(bins) >= 3, "bins", "an odd number of at least 3", len(bins))
    require_shape("probs", probs.shape, ..., len(bins))
    probs = widen(probs)
    bins = torch.as_tensor(bins, dtype=probs.dtype, device=probs.device)
    center = len(bins) // 2
    # The difference of each mirrored pair comes first: equal probabilities cancel before they meet a huge number, also
    # where a compiler fuses the product with the sum.
    difference = probs[..., center + 1 :] - probs[..., :center].flip(-1)  # [..., K // 2]
    return (difference * bins[center + 1 :]).sum(-1) + probs[..., center] * bins[center]
