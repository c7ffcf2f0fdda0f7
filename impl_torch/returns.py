"""Returns: what actor and critic learn from. Chapter: spec/07-returns.md. Plain arithmetic, constant in every gradient
([RET-18])."""

import math

import torch
from torch import Tensor

from impl_torch.shapes import expect, expect_same_shape, widen
from spec import Config


def _check(least: int, first: str, **arrays: Tensor) -> None:
    shape = arrays[first].shape
    expect(len(shape) == 2 and shape[1] >= least, first, f"two axes, the second of at least {least}", list(shape))
    expect_same_shape(**arrays)


def _backwards(offset: Tensor, slope: Tensor, last: Tensor) -> Tensor:
    """R[:, t] = offset[:, t] + slope[:, t] * R[:, t + 1] with R behind the end = last: [N, H] twice and [N] -> [N,
    H]."""
    results = []
    for a, b in zip(reversed(offset.unbind(1)), reversed(slope.unbind(1)), strict=True):
        last = torch.addcmul(a, b, last)
        results.append(last)
    return torch.stack(results[::-1], 1) if results else offset


@torch.no_grad()
def lambda_return(reward: Tensor, continue_: Tensor, value: Tensor, discount: float, lambda_: float) -> Tensor:
    """Imagined λ-returns, all with arrival indices: [N, H+1] three times -> [N, H]. [RET-1] [RET-2] [RET-17] [RET-19]
    [RET-20]"""
    _check(2, "reward", reward=reward, continue_=continue_, value=value)
    reward, continue_, value = (widen(x)[:, 1:] for x in (reward, continue_, value))
    discounts = discount * continue_
    return _backwards(reward + discounts * (1 - lambda_) * value, discounts * lambda_, value[:, -1])


@torch.no_grad()
def replay_lambda_return(
    reward: Tensor, is_last: Tensor, is_terminal: Tensor, annotation: Tensor, discount: float, lambda_: float
) -> Tensor:
    """λ-returns of replayed sequences with true flags: [B, T] four times -> [B, T-1]. [RET-9] [RET-10] [RET-17]
    [RET-19] [RET-20]"""
    _check(1, "reward", reward=reward, is_last=is_last, is_terminal=is_terminal, annotation=annotation)
    annotation = widen(annotation)
    reward, is_last, is_terminal = (x.to(annotation.dtype)[:, 1:] for x in (reward, is_last, is_terminal))
    discounts, lambdas = discount * (1 - is_terminal), lambda_ * (1 - is_last)
    return _backwards(reward + discounts * (1 - lambdas) * annotation[:, 1:], discounts * lambdas, annotation[:, -1])


@torch.no_grad()
def cumulative_weights(continue_: Tensor, discount: float) -> Tensor:
    """How far each imagined state counts: [N, H+1] -> [N, H]. [RET-7] [RET-8] [RET-17] [RET-20]"""
    _check(2, "continue_", continue_=continue_)
    expect(0 < discount <= 1, "discount", "above 0 and at most 1", discount)
    return torch.cumprod(discount * widen(continue_)[:, :-1], 1) / discount


@torch.no_grad()
def percentile(values: Tensor, q: float) -> Tensor:
    """The q-th percentile of all values, interpolated linearly: [...] -> scalar, NaN if any value is NaN. [RET-12]
    [RET-13]"""
    return _percentile(widen(values).flatten().sort().values, q)


def _percentile(ordered: Tensor, q: float) -> Tensor:
    expect(ordered.numel() > 0, "values", "at least one entry", "none")
    expect(0 <= q <= 100, "q", "between 0 and 100", q)
    position = q / 100 * (len(ordered) - 1)
    index = math.floor(position)
    fraction = position - index
    result = ordered[index] if fraction == 0 else (1 - fraction) * ordered[index] + fraction * ordered[index + 1]
    return result + (ordered[-1] - ordered[-1])  # NaN is sorted to the end


@torch.no_grad()
def update_return_range(low: Tensor, high: Tensor, returns: Tensor, config: Config) -> tuple[Tensor, Tensor]:
    """Moves both averages towards the percentiles of all imagined returns [N, H]; scalars. [RET-14] [RET-15]
    [RET-17]"""
    ordered = widen(returns).flatten().sort().values
    decay = config.return_decay
    return (
        decay * low + (1 - decay) * _percentile(ordered, config.return_percentile_low),
        decay * high + (1 - decay) * _percentile(ordered, config.return_percentile_high),
    )


@torch.no_grad()
def return_scale(low: Tensor, high: Tensor, limit: float) -> Tensor:
    """What advantages are divided by: max(limit, high - low), NaN for NaN. [RET-16]"""
    return (high - low).clamp(min=limit)
