"""Returns: imagined and replayed lambda-returns, weights, and the range of the returns. Chapter: spec/07-returns.md.

Everything is float32 or better, and a constant: who uses a result stops its gradient. [RET-17], [RET-18]
"""

import math

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike

from impl_jax.shapes import require, require_same_shape, widen
from spec import Config


def _require_steps(at_least: int, **arrays: jax.Array) -> None:
    """Raises ValueError unless all arrays are [rows, steps] of one shape, with enough steps. [RET-20]"""
    name, first = next(iter(arrays.items()))
    fits = first.ndim == 2 and first.shape[1] >= at_least
    require(fits, name, f"shape [rows, steps] with at least {at_least} steps", list(first.shape))
    require_same_shape(**arrays)


def _backwards(offset: jax.Array, slope: jax.Array, last: jax.Array) -> jax.Array:
    """R_t = offset_t + slope_t R_{t+1}, where R behind the end is `last`: [N, n], [N, n], [N] -> [N, n].

    What does not depend on R is computed by the caller for all steps at once: the loop is one multiplication and sum.
    """

    def step(later: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        result = now[0] + now[1] * later  # [N]
        return result, result

    return lax.scan(step, last, (offset.T, slope.T), reverse=True)[1].T  # a scan walks along the first axis


def lambda_return(
    reward: jax.Array, continue_: jax.Array, value: jax.Array, discount: float, lambda_: float
) -> jax.Array:
    """Imagined λ-returns, all with arrival indices: [N, H+1] three times -> [N, H]. [RET-1], [RET-2]

    R_t = r_{t+1} + γ c_{t+1} ((1 - λ) v_{t+1} + λ R_{t+1}), R_H = v_H. Section "Critic learning".
    """
    reward = widen(reward)
    continue_, value = (jnp.asarray(x).astype(reward.dtype) for x in (continue_, value))
    _require_steps(2, reward=reward, continue_=continue_, value=value)
    discounts = discount * continue_[:, 1:]  # [N, H]
    return _backwards(reward[:, 1:] + discounts * ((1.0 - lambda_) * value[:, 1:]), discounts * lambda_, value[:, -1])


def replay_lambda_return(
    reward: jax.Array,
    is_last: jax.Array,
    is_terminal: jax.Array,
    annotation: jax.Array,
    discount: float,
    lambda_: float,
) -> jax.Array:
    """λ-returns of replayed sequences: [B, T] four times -> [B, T-1]. Section "Critic learning". [RET-9], [RET-10]

    annotation: the imagined return that starts at each step, in place of a value. λ is 0 where the arrival step ends an
    episode: what follows it in the sequence belongs to another.
    """
    reward = widen(reward)
    is_last, is_terminal, annotation = (jnp.asarray(x).astype(reward.dtype) for x in (is_last, is_terminal, annotation))
    _require_steps(1, reward=reward, is_last=is_last, is_terminal=is_terminal, annotation=annotation)
    discounts, lambdas = discount * (1.0 - is_terminal[:, 1:]), lambda_ * (1.0 - is_last[:, 1:])  # [B, T-1]
    offset = reward[:, 1:] + discounts * ((1.0 - lambdas) * annotation[:, 1:])
    return _backwards(offset, discounts * lambdas, annotation[:, -1])


def cumulative_weights(continue_: jax.Array, discount: float) -> jax.Array:
    """How far each imagined state counts: [N, H+1] -> [N, H]. [RET-7]

    It is the product of discount * continue up to the state, without the discount of the first.

    Raises:
      ValueError: a discount that is not above 0 and at most 1. [RET-8]
    """
    continue_ = widen(continue_)
    _require_steps(2, continue_=continue_)
    require(0 < discount <= 1, "discount", "above 0 and at most 1", discount)
    return jnp.cumprod(discount * continue_[:, :-1], axis=1) / discount


def percentile(values: jax.Array, q: float) -> jax.Array:
    """The percentile q in 0 .. 100 over all values, by linear interpolation: [...] -> scalar. [RET-12], [RET-13]

    Raises:
      ValueError: no values, or q outside 0 .. 100.
    """
    values = widen(values).reshape(-1)
    require(values.size > 0, "values", "at least one value", "none")
    require(0 <= q <= 100, "q", "0 to 100", q)
    position = q / 100 * (values.size - 1)  # of sizes alone: in float64 however the values are stored
    index = math.floor(position)
    fraction = position - index
    ordered = jnp.sort(values)  # NaN comes last
    result = ordered[index] if fraction == 0 else (1 - fraction) * ordered[index] + fraction * ordered[index + 1]
    return jnp.where(jnp.isnan(ordered[-1]), ordered[-1], result)


def update_return_range(
    low: ArrayLike, high: ArrayLike, returns: jax.Array, config: Config
) -> tuple[jax.Array, jax.Array]:
    """Both averages, scalars, moved towards the percentiles of all imagined returns [N, H]. [RET-14], [RET-15]"""
    decay = config.return_decay
    returns = widen(returns)

    def update(old: ArrayLike, q: float) -> jax.Array:
        return decay * jnp.asarray(old).astype(returns.dtype) + (1 - decay) * percentile(returns, q)

    return update(low, config.return_percentile_low), update(high, config.return_percentile_high)


def return_scale(low: ArrayLike, high: ArrayLike, limit: float) -> jax.Array:
    """What advantages are divided by: max(limit, high - low). [RET-16]"""
    return jnp.maximum(widen(high) - widen(low), limit)
