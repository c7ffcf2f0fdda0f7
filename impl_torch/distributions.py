"""Distributions: what the networks' outputs mean. Chapter: spec/02-distributions.md.

Samples and targets are constants. Everything is computed in float32 or float64 ([DIS-1]).
"""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F  # noqa: N812 (so it is called everywhere)
from torch import Tensor

from impl_torch.shapes import require_same_shape, require_shape, widen
from impl_torch.transforms import Bins, ordered_expectation, symlog, twohot_sparse

HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)
FEW_CLASSES = 16  # below this, see `_over_classes`


def _constant(x: Tensor, like: Tensor) -> Tensor:
    """x without a gradient, in the dtype of another argument. [DIS-2]"""
    return x.detach().to(like.dtype)


def unimix_log_probs(logits: Tensor, unimix: float) -> Tensor:
    """ln((1 - unimix) softmax(logits) + unimix / C) over the last axis: [..., C] -> [..., C]. [DIS-5] to [DIS-7]"""
    if unimix == 0:
        return _over_classes(F.log_softmax, widen(logits))
    return unimix_probs(logits, unimix).log()


def unimix_probs(logits: Tensor, unimix: float) -> Tensor:
    """The probabilities themselves, where a sample is all that is wanted: no logarithm, and no exponential of it."""
    probs = _over_classes(F.softmax, widen(logits))
    return (1 - unimix) * probs + unimix / logits.shape[-1] if unimix else probs


def _over_classes(function: Callable[[Tensor, int], Tensor], logits: Tensor) -> Tensor:
    """A softmax over the last axis, by way of the first for few classes: PyTorch's CPU code is many times faster there.

    Along the last axis it vectorizes over the classes, along the first over everything else.
    """
    if logits.shape[-1] >= FEW_CLASSES or logits.device.type != "cpu":
        return function(logits, -1)
    return function(logits.movedim(-1, 0).contiguous(), 0).movedim(0, -1)


def categorical_sample(log_probs: Tensor, uniform: Tensor) -> Tensor:
    """One-hot sample by inverse CDF, constant: [..., C] and [...] -> [..., C]. [DIS-2] [DIS-3] [DIS-8] [CON-17]"""
    require_shape("uniform", uniform.shape, *log_probs.shape[:-1])
    return sample_onehot(widen(log_probs.detach()).exp(), uniform)


def sample_onehot(probs: Tensor, uniform: Tensor) -> Tensor:
    """`categorical_sample` from probabilities."""
    # The last running sum is left out: it is 1 but for rounding, and could fall below the uniform number.
    below = torch.cumsum(probs[..., :-1], -1) <= uniform.to(probs.dtype).unsqueeze(-1)  # [..., C - 1]
    return torch.zeros_like(probs).scatter_(-1, below.sum(-1, keepdim=True), 1.0)


def straight_through(log_probs: Tensor, sample: Tensor) -> Tensor:
    """The sample, with the gradient of the probabilities: [..., C] twice -> [..., C]. [DIS-9]"""
    require_same_shape(log_probs=log_probs, sample=sample)
    probs = widen(log_probs).exp()
    return _constant(sample, probs) + (probs - probs.detach())  # in this order: the difference is exactly 0


def categorical_log_prob(log_probs: Tensor, onehot: Tensor) -> Tensor:
    """Log-probability of the chosen class: [..., C] twice -> [...]. [DIS-4] [DIS-10] [DIS-13]"""
    require_same_shape(log_probs=log_probs, onehot=onehot)
    log_probs = widen(log_probs)
    onehot = _constant(onehot, log_probs)
    # Here and below the logarithm is replaced before it is multiplied: 0 * -inf would be NaN, in the gradient too.
    return (onehot * log_probs.masked_fill(onehot == 0, 0)).sum(-1)


def categorical_entropy(log_probs: Tensor) -> Tensor:
    """-sum p ln p, in nats: [..., C] -> [...]. [DIS-4] [DIS-11] [DIS-13]"""
    log_probs = widen(log_probs)
    probs = log_probs.exp()
    return -(probs * log_probs.masked_fill(probs == 0, 0)).sum(-1)


def categorical_kl(log_probs_p: Tensor, log_probs_q: Tensor) -> Tensor:
    """sum p (ln p - ln q) over the last axis, in nats: [..., C] twice -> [...]. [DIS-4] [DIS-12] [DIS-13]"""
    require_same_shape(log_probs_p=log_probs_p, log_probs_q=log_probs_q)
    log_probs_p = widen(log_probs_p)
    probs = log_probs_p.exp()
    impossible = probs == 0
    difference = log_probs_p.masked_fill(impossible, 0) - log_probs_q.to(probs.dtype).masked_fill(impossible, 0)
    return (probs * difference).sum(-1)


def symexp_twohot_loss(logits: Tensor, target: Tensor, bins: Bins) -> Tensor:
    """Cross entropy towards the twohot of a scalar target: [..., K], [...] and [K] -> [...]. [DIS-14] [DIS-4]"""
    require_shape("logits", logits.shape, ..., len(bins))
    require_shape("target", target.shape, *logits.shape[:-1])
    return twohot_cross_entropies(F.log_softmax(widen(logits), -1), target.unsqueeze(-1), bins).squeeze(-1)


def twohot_cross_entropies(log_probs: Tensor, targets: Tensor, bins: Bins) -> Tensor:
    """The same for n targets of each distribution: log-softmax [..., K], targets [..., n] -> [..., n].

    Only the two bins that have weight are read, and both losses of the critic share one log-softmax.
    """
    indices, weights = twohot_sparse(targets.to(log_probs.dtype), bins)  # [..., n, 2] twice
    picked = log_probs.gather(-1, indices.flatten(-2)).view_as(weights)  # [..., K] -> [..., 2n] -> [..., n, 2]
    return -(weights * picked.masked_fill(weights == 0, 0)).sum(-1)


def symexp_twohot_mean(logits: Tensor, bins: Bins) -> Tensor:
    """Mean of the softmax over the bins, exactly 0 for equal logits: [..., K] and [K] -> [...]. [DIS-15]"""
    return ordered_expectation(torch.softmax(widen(logits), -1), bins)


def bernoulli_loss(logit: Tensor, target: Tensor) -> Tensor:
    """Binary cross entropy with a target in [0, 1], element by element. [DIS-4] [DIS-16] [DIS-17]"""
    require_same_shape(logit=logit, target=target)
    logit = widen(logit)
    target = _constant(target, logit)
    # logsigmoid, and not the logarithm of the probability, which is 0 or 1 for a large logit.
    success = F.logsigmoid(logit).masked_fill(target == 0, 0)
    failure = F.logsigmoid(-logit).masked_fill(target == 1, 0)
    return -(target * success + (1 - target) * failure)


def bernoulli_mean(logit: Tensor) -> Tensor:
    """The probability sigmoid(logit), element by element. [DIS-18]"""
    return torch.sigmoid(widen(logit))


def bounded_normal(mean: Tensor, std: Tensor, min_std: float, max_std: float) -> tuple[Tensor, Tensor]:
    """Mean in [-1, 1] and standard deviation in [min_std, max_std] from two raw outputs [...] each. [DIS-19]"""
    require_same_shape(mean=mean, std=std)
    mean = widen(mean)
    return torch.tanh(mean), (max_std - min_std) * torch.sigmoid(std.to(mean.dtype) + 2) + min_std


def normal_sample(mean: Tensor, std: Tensor, normal: Tensor) -> Tensor:
    """mean + std * normal, constant, element by element. [DIS-20] [CON-18]"""
    require_same_shape(mean=mean, std=std, normal=normal)
    mean = widen(mean)
    return (mean + std.to(mean.dtype) * normal.to(mean.dtype)).detach()


def normal_log_prob(mean: Tensor, std: Tensor, value: Tensor) -> Tensor:
    """Log-density of each element, in nats, with no gradient into the value. [DIS-21]"""
    require_same_shape(mean=mean, std=std, value=value)
    mean = widen(mean)
    std = std.to(mean.dtype)
    return -0.5 * torch.square((_constant(value, mean) - mean) / std) - std.log() - HALF_LOG_TWO_PI


def normal_entropy(std: Tensor) -> Tensor:
    """1/2 + 1/2 ln(2 pi) + ln std of each element, in nats. [DIS-22]"""
    return 0.5 + HALF_LOG_TWO_PI + widen(std).log()


def mse_loss(prediction: Tensor, target: Tensor) -> Tensor:
    """Square of the difference, element by element. [DIS-23]"""
    require_same_shape(prediction=prediction, target=target)
    prediction = widen(prediction)
    return torch.square(prediction - _constant(target, prediction))


def symlog_mse_loss(prediction: Tensor, target: Tensor, scale: float) -> Tensor:
    """scale * (prediction - symlog(target))^2, element by element; the prediction is in symlog space. [DIS-24]"""
    require_same_shape(prediction=prediction, target=target)
    prediction = widen(prediction)
    return scale * torch.square(prediction - symlog(_constant(target, prediction)))
