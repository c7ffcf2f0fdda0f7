"""λ-returns, cumulative weights and the return range. Chapter: spec/07-returns.md.

Plain arithmetic; every result is a constant.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reference_numpy.shapes import checked, require
from spec.config import Config

Array = NDArray[np.float64]


def lambda_return(reward: Any, continue_: Any, value: Any, discount: float, lambda_: float) -> Array:
    """The λ-return of every imagined state but the last. Implements [RET-1] to [RET-4], [RET-17] to [RET-20].

    Paper: section Critic learning, equation of the critic loss with its indices corrected; D-03, D-04.

    Args:
      reward: [N, H+1], units of reward; entry t arrived with state t, entry 0 is not used.
      continue_: [N, H+1], probability that the episode continues from state t; entry 0 is not used.
      value: [N, H+1], units of reward, the live critic's mean; entry 0 is not used.
      discount: `config.imagined_discount`.
      lambda_: `config.return_lambda`.

    Returns:
      [N, H], units of reward; entry t belongs to state t and does not contain its own reward.

    Raises:
      ValueError: the shapes differ or are not [N, H+1] with at least one transition.
    """
    reward = _steps("reward", reward, at_least=2)
    continue_ = checked("continue_", continue_, *reward.shape)
    value = checked("value", value, *reward.shape)
    horizon = reward.shape[1] - 1
    returns = np.zeros((len(reward), horizon))
    later = value[:, horizon]
    for t in reversed(range(horizon)):
        future = (1 - lambda_) * value[:, t + 1] + lambda_ * later
        later = reward[:, t + 1] + discount * continue_[:, t + 1] * future
        returns[:, t] = later
    return returns


def replay_lambda_return(
    reward: Any, is_last: Any, is_terminal: Any, annotation: Any, discount: float, lambda_: float
) -> Array:
    """The λ-return of every replayed step but the last. Implements [RET-5], [RET-9] to [RET-11], [RET-17] to [RET-20].

    Paper: section Critic learning, the paragraph on the critic replay loss; D-54, D-55.

    Args:
      reward: [B, T], units of reward, as recorded; entry 0 is not used, here and below.
      is_last, is_terminal: [B, T], flags as booleans or 0 and 1.
      annotation: [B, T], units of reward: the imagined λ-return from each step, in place of its value.
      discount: `config.discount`, in every profile.
      lambda_: `config.return_lambda`.

    Returns:
      [B, T-1], units of reward; entry t belongs to step t.

    Raises:
      ValueError: the shapes differ or are not [B, T] with at least one step.
    """
    reward = _steps("reward", reward, at_least=1)
    is_last = checked("is_last", is_last, *reward.shape)
    is_terminal = checked("is_terminal", is_terminal, *reward.shape)
    annotation = checked("annotation", annotation, *reward.shape)
    last = reward.shape[1] - 1
    returns = np.zeros((len(reward), last))
    later = annotation[:, last]
    for t in reversed(range(last)):
        # Where the arrival step ends an episode only its annotation counts: what follows belongs to another episode.
        mix = lambda_ * (1 - is_last[:, t + 1])
        future = (1 - mix) * annotation[:, t + 1] + mix * later
        later = reward[:, t + 1] + discount * (1 - is_terminal[:, t + 1]) * future
        returns[:, t] = later
    return returns


def cumulative_weights(continue_: Any, discount: float) -> Array:
    """How far each imagined state counts in the losses. Implements [RET-4], [RET-6] to [RET-8], [RET-17] to [RET-20].

    Paper: not mentioned; D-08, D-09.

    Args:
      continue_: [N, H+1], between 0 and 1; entry H is not used.
      discount: `config.imagined_discount`.

    Returns:
      [N, H]: the discounted probability of being alive at each state, without the discount of the first.

    Raises:
      ValueError: a shape other than [N, H+1] with at least one transition, or a discount not above 0 and at most 1.
    """
    continue_ = _steps("continue_", continue_, at_least=2)
    require(0 < discount <= 1, "discount", "above 0 and at most 1", discount)
    horizon = continue_.shape[1] - 1
    weights = np.zeros((len(continue_), horizon))
    product = np.ones(len(continue_))
    for t in range(horizon):
        product = product * (discount * continue_[:, t])
        weights[:, t] = product / discount
    return weights


def percentile(values: Any, q: float) -> float:
    """A percentile by linear interpolation between the two nearest values. Implements [RET-12], [RET-13], [RET-17].

    Paper: Per(R, q) in section Actor learning; D-63.

    Args:
      values: [...], at least one value; all are taken together.
      q: 0 to 100 percent.

    Returns:
      A scalar in units of the values; NaN if one of them is NaN.

    Raises:
      ValueError: no values, or a q outside 0 to 100.
    """
    flat = np.sort(np.asarray(values, dtype=np.float64).reshape(-1))
    require(len(flat) > 0, "values", "at least one value", "none")
    require(0 <= q <= 100, "q", "0 to 100", q)
    if np.isnan(flat).any():
        return math.nan
    position = q / 100 * (len(flat) - 1)
    below = math.floor(position)
    fraction = position - below
    if fraction == 0:
        return float(flat[below])
    return float((1 - fraction) * flat[below] + fraction * flat[below + 1])


def update_return_range(low: Any, high: Any, returns: Any, config: Config) -> tuple[float, float]:
    """The averaged percentiles after the imagined returns of this step.
    Implements [RET-14], [RET-15], [RET-17] to [RET-19].

    Paper: section Actor learning, equation of S; D-59, D-63, D-64.

    Args:
      low, high: scalars, units of reward, 0 before the first step.
      returns: [N, H], units of reward.

    Returns:
      The new (low, high), for use in the same step, not debiased.

    Raises:
      ValueError: a wrong shape, or no returns.
    """
    returns = checked("returns", returns, "N", "H")
    low, high = float(checked("low", low)), float(checked("high", high))
    decay = config.return_decay
    new_low = decay * low + (1 - decay) * percentile(returns, config.return_percentile_low)
    new_high = decay * high + (1 - decay) * percentile(returns, config.return_percentile_high)
    return new_low, new_high


def return_scale(low: Any, high: Any, limit: float) -> float:
    """What the actor's advantages are divided by. Implements [RET-16] to [RET-19].

    Paper: max(1, S) in the actor loss, section Actor learning; D-61, D-62.

    Args:
      low, high: scalars, units of reward, the updated range.
      limit: `config.return_limit`, units of reward.

    Returns:
      The range but at least the limit; NaN if low or high is NaN.

    Raises:
      ValueError: low or high is not a scalar.
    """
    return float(np.maximum(limit, checked("high", high) - checked("low", low)))


def _steps(name: str, value: Any, at_least: int) -> Array:
    array = np.asarray(value, dtype=np.float64)
    fits = array.ndim == 2 and array.shape[1] >= at_least
    require(fits, name, f"shape [rows, steps] with at least {at_least} steps", list(array.shape))
    return array
