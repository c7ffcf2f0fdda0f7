"""Returns: what actor and critic learn from. Chapter: spec/07-returns.md.

Plain arithmetic in float32 or better, constant in every gradient. [RET-17] [RET-18]
"""

import math

import torch
from torch import Tensor

from impl_torch.shapes import require, require_same_shape, widen
from spec import Config


def _require_steps(at_least: int, **arrays: Tensor) -> None:
    """Raises ValueError unless all arrays are [rows, steps] of one shape, with enough steps. [RET-20]"""
    name, first = next(iter(arrays.items()))
    fits = first.ndim == 2 and first.shape[1] >= at_least
    require(fits, name, f"shape [rows, steps] with at least {at_least} steps", list(first.shape))
    require_same_shape(**arrays)


def _backwards(offset: Tensor, slope: Tensor, last: Tensor) -> Tensor:
    """R_t = offset_t + slope_t R_{t+1}, where R behind the end is `last`: [N, H], [N, H], [N] -> [N, H].

    What does not depend on R is computed by the caller for all steps at once, so that a step is one operation.
    """
    results = []
    for a, b in zip(reversed(offset.unbind(1)), reversed(slope.unbind(1)), strict=True):  # [N] each
        last = torch.addcmul(a, b, last)  # a + b * last
        results.append(last)
    return torch.stack(results[::-1], 1) if results else offset


@torch.no_grad()
def lambda_return(reward: Tensor, continue_: Tensor, value: Tensor, discount: float, lambda_: float) -> Tensor:
    """Imagined λ-returns, all with arrival indices: [N, H+1] three times -> [N, H]. [RET-1] [RET-2] [RET-19] [RET-20]

    R_t = r_{t+1} + γ c_{t+1} ((1 - λ) v_{t+1} + λ R_{t+1}), R_H = v_H.
    """
    _require_steps(2, reward=reward, continue_=continue_, value=value)
    reward, continue_, value = (widen(x)[:, 1:] for x in (reward, continue_, value))  # of arrival: [N, H]
    discounts = discount * continue_
    return _backwards(reward + discounts * (1 - lambda_) * value, discounts * lambda_, value[:, -1])


@torch.no_grad()
def replay_lambda_return(
    reward: Tensor, is_last: Tensor, is_terminal: Tensor, annotation: Tensor, discount: float, lambda_: float
) -> Tensor:
    """λ-returns of replayed sequences with true flags: [B, T] four times -> [B, T-1]. [RET-9] [RET-10] [RET-19]

    annotation: the imagined return that starts at each step, in place of a value. λ is 0 where the arrival step ends an
    episode: what follows it in the sequence belongs to another. [RET-20]
    """
    _require_steps(1, reward=reward, is_last=is_last, is_terminal=is_terminal, annotation=annotation)
    annotation = widen(annotation)
    reward, is_last, is_terminal = (x.to(annotation.dtype)[:, 1:] for x in (reward, is_last, is_terminal))  # [B, T-1]
    discounts, lambdas = discount * (1 - is_terminal), lambda_ * (1 - is_last)
    return _backwards(reward + discounts * (1 - lambdas) * annotation[:, 1:], discounts * lambdas, annotation[:, -1])


@torch.no_grad()
def cumulative_weights(continue_: Tensor, discount: float) -> Tensor:
    """How far each imagined state counts: [N, H+1] -> [N, H]. [RET-7] [RET-8] [RET-20]"""
    _require_steps(2, continue_=continue_)
    require(0 < discount <= 1, "discount", "above 0 and at most 1", discount)
    return torch.cumprod(discount * widen(continue_)[:, :-1], 1) / discount


@torch.no_grad()
def percentile(values: Tensor, q: float) -> Tensor:
    """The q-th percentile of all values, interpolated linearly: [...] -> scalar, NaN for a NaN. [RET-12] [RET-13]"""
    return _percentile(widen(values).flatten().sort().values, q)


def _percentile(ordered: Tensor, q: float) -> Tensor:
    require(ordered.numel() > 0, "values", "at least one value", "none")
    require(0 <= q <= 100, "q", "0 to 100", q)
    position = q / 100 * (len(ordered) - 1)  # of sizes alone: in float64, and nothing is read from the device
    index = math.floor(position)
    fraction = position - index
    result = ordered[index] if fraction == 0 else (1 - fraction) * ordered[index] + fraction * ordered[index + 1]
    return result + (ordered[-1] - ordered[-1])  # NaN is sorted to the end


@torch.no_grad()
def update_return_range(low: Tensor, high: Tensor, returns: Tensor, config: Config) -> tuple[Tensor, Tensor]:
    """Moves both averages, scalars, towards the percentiles of all imagined returns [N, H]. [RET-14] [RET-15]"""
    ordered = widen(returns).flatten().sort().values  # once for both
    decay = config.return_decay
    return (
        decay * low + (1 - decay) * _percentile(ordered, config.return_percentile_low),
        decay * high + (1 - decay) * _percentile(ordered, config.return_percentile_high),
    )


@torch.no_grad()
def return_scale(low: Tensor, high: Tensor, limit: float) -> Tensor:
    """What advantages are divided by: max(limit, high - low), NaN for NaN. [RET-16]"""
    return (high - low).clamp(min=limit)
