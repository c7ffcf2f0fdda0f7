"""Transforms: numbers of any size. Chapter: spec/01-transforms.md."""

import functools

import numpy as np
import torch
from torch import Tensor

from impl_torch.shapes import expect, expect_last, widen

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
    """`bins` positions [bins], NumPy float64 (do not write to it): symexp of even steps from -20 to 20, exactly
    antisymmetric.

    [TRA-5] [TRA-6]

    Raises:
      ValueError: an even number, or fewer than 3.
    """
    expect(bins % 2 == 1 and bins >= 3, "bins", "an odd number of at least 3", bins)
    center = (bins - 1) // 2
    positive = np.expm1(20.0 * np.arange(1, center + 1) / center)
    result = np.concatenate([-positive[::-1], [0.0], positive])
    result.setflags(write=False)
    return result


@functools.cache
def standard_bins(bins: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """`exponential_bins` on a device, kept: copying them there in every step would make an accelerator wait."""
    with torch.inference_mode(False):  # else a first call while acting would make a tensor that training cannot use
        return torch.tensor(exponential_bins(bins), dtype=dtype, device=device)


def twohot(x: Tensor, bins: Bins) -> Tensor:
    """Weights of the two bins around x: [...] and [K] -> [..., K]; the ends are clamped, NaN gives NaN.

    [TRA-1] [TRA-7] [TRA-8] [TRA-9] [TRA-13] [TRA-14]

    Raises:
      ValueError: bins that are not one-dimensional or fewer than 2.
    """
    indices, weights = twohot_sparse(x, bins)
    dense = weights.new_zeros((*weights.shape[:-1], len(bins))).scatter_(-1, indices, weights)
    return dense + (weights - weights).sum(-1, keepdim=True)  # 0, or NaN in all K entries


def twohot_sparse(x: Tensor, bins: Bins) -> tuple[Tensor, Tensor]:
    """The two entries of `twohot` that may differ from 0: their indices [..., 2] and weights [..., 2]."""
    expect(bins.ndim == 1 and len(bins) >= 2, "bins", "shape [K] with K of at least 2", list(bins.shape))
    x = widen(x).detach()
    bins = torch.as_tensor(bins, dtype=x.dtype, device=x.device)
    x = torch.minimum(torch.maximum(x, bins[0]), bins[-1])
    lower = (torch.searchsorted(bins, x, right=True) - 1).clamp(
        0, len(bins) - 2
    )  # a search puts NaN behind the last bin
    indices = torch.stack([lower, lower + 1], -1)
    low, high = bins[indices].unbind(-1)
    return indices, torch.stack([high - x, x - low], -1) / (high - low).unsqueeze(-1)


def ordered_expectation(probs: Tensor, bins: Bins) -> Tensor:
    """The mean sum(probs * bins), [..., K] and [K] -> [...]; exactly 0 for mirror-symmetric probs.

    [TRA-1] [TRA-10] [TRA-11] [TRA-12] [TRA-13] [TRA-14]

    Raises:
      ValueError: bins that are not one-dimensional, fewer than 3 or even in number, or probs of another length.
    """
    expect(
        bins.ndim == 1 and len(bins) >= 3 and len(bins) % 2 == 1,
        "bins",
        "shape [K] with odd K of at least 3",
        list(bins.shape),
    )
    expect_last("probs", probs, len(bins))
    probs = widen(probs)
    bins = torch.as_tensor(bins, dtype=probs.dtype, device=probs.device)
    center = len(bins) // 2
    # The difference of each mirrored pair comes first: equal probabilities cancel before they meet a huge number,
    # however sums are fused.
    difference = probs[..., center + 1 :] - probs[..., :center].flip(-1)
    return (difference * bins[center + 1 :]).sum(-1) + probs[..., center] * bins[center]
