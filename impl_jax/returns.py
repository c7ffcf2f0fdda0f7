"""Returns: imagined and replayed lambda-returns, weights, and the range of the returns. Chapter: spec/07-returns.md.

Everything is float32 or better and a constant of the train step; who uses a result makes it constant. [RET-17],
[RET-18]
"""

import math

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike

from impl_jax.checks import require, require_same_shape
from impl_jax.transforms import real
from spec import Config


def _trajectories(least: int, **arrays: jax.Array) -> None:
    """Raises ValueError unless all arrays are [N, n] of one shape with n >= least. [RET-20]"""
    for name, array in arrays.items():
        expected = f"shape [rows, time] with {least} or more times"
        require(array.ndim == 2 and array.shape[1] >= least, name, expected, f"shape {list(array.shape)}")
    require_same_shape(**arrays)


def _backward(target: jax.Array, factor: jax.Array, last: jax.Array) -> jax.Array:
    """R_t = target_t + factor_t R_{t+1} backwards in time, where R after the end is `last`: [N, n], [N, n], [N] -> [N,
    n]."""

    def step(later: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        result = now[0] + now[1] * later
        return result, result

    return lax.scan(step, last, (target.T, factor.T), reverse=True)[1].T


def lambda_return(
    reward: jax.Array, continue_: jax.Array, value: jax.Array, discount: float, lambda_: float
) -> jax.Array:
    """Imagined returns: three [N, H+1] -> [N, H]; every quantity has the index of arrival. Section "Critic learning".
    [RET-1], [RET-2]"""
    reward = real(reward)
    continue_, value = (jnp.asarray(x).astype(reward.dtype) for x in (continue_, value))
    _trajectories(2, reward=reward, continue_=continue_, value=value)
    factor = discount * continue_[:, 1:]
    return _backward(reward[:, 1:] + factor * ((1.0 - lambda_) * value[:, 1:]), factor * lambda_, value[:, -1])


def replay_lambda_return(
    reward: jax.Array,
    is_last: jax.Array,
    is_terminal: jax.Array,
    annotation: jax.Array,
    discount: float,
    lambda_: float,
) -> jax.Array:
    """Returns along replayed sequences: four [B, T] -> [B, T-1]. Section "Critic learning". [RET-9], [RET-10]

    annotation: the imagined return that starts at each step, in place of a value.
    """
    reward = real(reward)
    is_last, is_terminal, annotation = (jnp.asarray(x).astype(reward.dtype) for x in (is_last, is_terminal, annotation))
    _trajectories(1, reward=reward, is_last=is_last, is_terminal=is_terminal, annotation=annotation)
    factor = discount * (1.0 - is_terminal[:, 1:])
    mix = lambda_ * (1.0 - is_last[:, 1:])
    return _backward(reward[:, 1:] + factor * ((1.0 - mix) * annotation[:, 1:]), factor * mix, annotation[:, -1])


def cumulative_weights(continue_: jax.Array, discount: float) -> jax.Array:
    """How far each imagined state counts: [N, H+1] -> [N, H], the product of discount * continue up to it, over
    discount. [RET-7]

    Raises:
      ValueError: a discount that is not above 0 and at most 1. [RET-8]
    """
    require(0 < discount <= 1, "discount", "above 0 and at most 1", discount)
    continue_ = real(continue_)
    _trajectories(2, continue_=continue_)
    return jnp.cumprod(discount * continue_[:, :-1], axis=1) / discount


def percentile(values: jax.Array, q: float) -> jax.Array:
    """The percentile q in 0 .. 100 over all values, by linear interpolation: [...] -> scalar. [RET-12], [RET-13]

    Raises:
      ValueError: no values, or q outside 0 .. 100.
    """
    values = real(values).reshape(-1)
    require(values.size > 0, "values", "at least one number", "none")
    require(0 <= q <= 100, "q", "0 to 100", q)
    # The place depends on sizes alone, so it is computed in float64 however the values are stored.
    place = q / 100 * (values.size - 1)
    below = math.floor(place)
    share = place - below
    ordered = jnp.sort(values)  # NaN comes last
    result = ordered[below] if share == 0 else (1 - share) * ordered[below] + share * ordered[below + 1]
    return jnp.where(jnp.isnan(ordered[-1]), ordered[-1], result)


def update_return_range(
    low: ArrayLike, high: ArrayLike, returns: jax.Array, config: Config
) -> tuple[jax.Array, jax.Array]:
    """The moving averages of both percentiles after the returns [N, H] of this step. Section "Actor learning".
    [RET-14], [RET-15]"""
    decay = config.return_decay
    returns = real(returns)

    def update(old: ArrayLike, q: float) -> jax.Array:
        return decay * jnp.asarray(old).astype(returns.dtype) + (1 - decay) * percentile(returns, q)

    return update(low, config.return_percentile_low), update(high, config.return_percentile_high)


def return_scale(low: ArrayLike, high: ArrayLike, limit: float) -> jax.Array:
    """What advantages are divided by: max(limit, high - low). [RET-16]"""
    return jnp.maximum(real(high) - real(low), limit)
