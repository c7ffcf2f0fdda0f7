"""Adaptive gradient clipping and LaProp. Chapter: spec/09-optimizer.md.

The plain functions of the chapter work on one tensor. `adaptive_gradient_clipping` and `scale_by_laprop` are the same
as ordinary optax transformations over any tree of parameters, for use on their own:

    optax.chain(adaptive_gradient_clipping(0.3), scale_by_laprop(), optax.scale_by_learning_rate(4e-5))

One tensor at a time is no loss here: all of a train step is one program, in which XLA fuses what each tensor goes
through.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.typing import ArrayLike

from impl_jax.shapes import require, require_same_shape, require_shapes, wide_dtype, widen
from spec import Config

Arrays = Mapping[str, jax.Array]

_DEAD_ZONE = 1e-16  # gradients below it count as zero: their squares would leave the normal numbers of float32 [OPT-9]


def norm(x: ArrayLike) -> jax.Array:
    """The root of the sum of squares, taken of x / max|x|, so that squares neither overflow nor vanish. [OPT-3]"""
    x = widen(x)
    peak = jnp.max(jnp.abs(x))
    return peak * jnp.sqrt(jnp.sum(jnp.square(x / jnp.where(peak == 0, 1.0, peak))))


def _clip_factor(gradient: jax.Array, parameter: jax.Array, clip: float, epsilon: float) -> tuple[jax.Array, jax.Array]:
    """What to multiply a gradient with, and its norm. [OPT-1], [OPT-4], [OPT-5]"""
    length, size = norm(gradient), norm(parameter)
    threshold = clip * jnp.maximum(size, epsilon)
    # The divisor is replaced where the factor is not used: 0/0 must not arise.
    factor = jnp.where(length <= threshold, 1.0, threshold / jnp.where(length == 0, 1.0, length))
    return jnp.where(jnp.isfinite(length) & jnp.isfinite(size), factor, jnp.nan), length


def adaptive_gradient_clip(gradient: ArrayLike, parameter: ArrayLike, clip: float, epsilon: float) -> jax.Array:
    """The gradient, no longer than clip * max(epsilon, norm(parameter)); any shape. [OPT-1] to [OPT-5]"""
    gradient, parameter = widen(gradient), widen(parameter)  # [OPT-19]
    require_same_shape(parameter=parameter, gradient=gradient)
    return gradient * _clip_factor(gradient, parameter, clip, epsilon)[0]


def learning_rate(step: ArrayLike, config: Config) -> Any:
    """The learning rate of an update with `step` updates before it: a float for an int, else an array. [OPT-6]"""
    if config.warmup_steps == 0:
        return config.learning_rate
    if isinstance(step, int):
        return config.learning_rate * min(1.0, step / config.warmup_steps)
    slope = config.learning_rate / config.warmup_steps  # formed in float64 [OPT-19]
    return jnp.minimum(jnp.asarray(step).astype(wide_dtype(config)) * slope, config.learning_rate)


def _correction(beta: float, step: ArrayLike, dtype: jnp.dtype) -> jax.Array:
    """1 - beta^(step + 1), without the cancellation of forming the power first. [OPT-11]"""
    if beta == 0:
        return jnp.ones((), dtype)
    return -jnp.expm1((jnp.asarray(step).astype(dtype) + 1.0) * math.log(beta))


def _require_betas(beta1: float, beta2: float) -> None:
    """At 1 the bias correction would be 0/0. [OPT-14]"""
    for name, beta in (("beta1", beta1), ("beta2", beta2)):
        require(0 <= beta < 1, name, "at least 0 and below 1", beta)


def _laprop(
    gradient: jax.Array,
    second_moment: jax.Array,
    momentum: jax.Array,
    step: ArrayLike,
    beta1: float,
    beta2: float,
    epsilon: float,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(update, second moment, momentum) of one tensor in float32 or better: all that `laprop` does but its checks.

    v = beta2 v + (1 - beta2) g²,  m = beta1 m + (1 - beta1) g / (sqrt(v / c2) + epsilon),  update = m / c1, where c is
    1 - beta^(step + 1).
    """
    _require_betas(beta1, beta2)
    gradient = jnp.where(jnp.abs(gradient) < _DEAD_ZONE, 0.0, gradient)
    second_moment = beta2 * second_moment + (1.0 - beta2) * jnp.square(gradient)
    root = jnp.sqrt(second_moment / _correction(beta2, step, gradient.dtype)) + epsilon
    # Where the gradient is 0 its share is 0, not 0/0: [OPT-10].
    normalized = jnp.where(gradient == 0, 0.0, gradient / root)
    momentum = beta1 * momentum + (1.0 - beta1) * normalized
    return momentum / _correction(beta1, step, gradient.dtype), second_moment, momentum


def laprop(
    gradient: ArrayLike, second_moment: ArrayLike, momentum: ArrayLike, step: ArrayLike, config: Config
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(update, new second moment, new momentum), without learning rate and sign; any shape. [OPT-8] to [OPT-14]

    Raises:
      ValueError: a beta of 1, or shapes that differ.
    """
    gradient = widen(gradient)
    second_moment, momentum = (jnp.asarray(x).astype(gradient.dtype) for x in (second_moment, momentum))
    require_same_shape(gradient=gradient, second_moment=second_moment, momentum=momentum)
    return _laprop(gradient, second_moment, momentum, step, config.beta1, config.beta2, config.laprop_epsilon)


def optimizer_step(
    params: Arrays, gradients: Arrays, state: Mapping[str, Any], config: Config
) -> tuple[dict[str, jax.Array], dict[str, Any]]:
    """Clips, normalizes and steps every tensor; returns new params and a new state. [OPT-15] to [OPT-20]

    state: {"step": int, "second_moment": name -> array, "momentum": name -> array}.

    Raises:
      ValueError: names or shapes that differ.
    """
    params, state, _ = optimizer_step_with_metrics(params, gradients, state, config)
    return params, state


def optimizer_step_with_metrics(
    params: Arrays, gradients: Arrays, state: Mapping[str, Any], config: Config
) -> tuple[dict[str, jax.Array], dict[str, Any], dict[str, jax.Array]]:
    """`optimizer_step`, and the norms of the whole gradient and update and the share of tensors that were clipped."""
    shapes = {name: x.shape for name, x in params.items()}
    moments = {"second_moment": state["second_moment"], "momentum": state["momentum"]}
    for what, tree in {"gradients": gradients, **moments}.items():
        require_shapes(what, tree, shapes)  # [OPT-18]
    step, rate = state["step"], learning_rate(state["step"], config)
    new: dict[str, dict[str, jax.Array]] = {"params": {}, "second_moment": {}, "momentum": {}}
    lengths, moves, factors = [], [], []
    for name, parameter in params.items():
        factor, length = _clip_factor(gradients[name], parameter, config.agc_clip, config.agc_epsilon)
        old = state["second_moment"][name], state["momentum"][name]
        update, new["second_moment"][name], new["momentum"][name] = laprop(gradients[name] * factor, *old, step, config)
        new["params"][name] = parameter - rate * update
        lengths.append(length)
        moves.append(jnp.sum(jnp.square(update)))
        factors.append(factor)
    metrics = {
        "gradient_norm": norm(jnp.stack(lengths)),
        "update_norm": jnp.sqrt(jnp.sum(jnp.stack(moves))) * rate,
        "clip_fraction": jnp.mean((jnp.stack(factors) < 1).astype(jnp.float32)),
    }
    return new.pop("params"), {"step": step + 1, **new}, metrics


def initial_optimizer_state(params: Arrays) -> dict[str, Any]:
    """Zeros of the parameters' shapes and step 0. [OPT-13]"""
    zeros = {
        kind: {name: jnp.zeros_like(parameter) for name, parameter in params.items()}
        for kind in ("second_moment", "momentum")
    }
    return {"step": jnp.zeros((), jnp.int32), **zeros}


def adaptive_gradient_clipping(clip: float, epsilon: float = 1e-3) -> optax.GradientTransformation:
    """`adaptive_gradient_clip` of every tensor of a tree by itself. [OPT-2]

    Unlike `optax.adaptive_grad_clip` it compares whole tensors, not units.
    """

    def update(
        updates: optax.Updates, state: optax.OptState, params: optax.Params | None = None
    ) -> tuple[optax.Updates, optax.OptState]:
        require(params is not None, "params", "the parameters, to compare the gradients with", None)

        def clipped(gradient: jax.Array, parameter: jax.Array) -> jax.Array:
            return adaptive_gradient_clip(gradient, parameter, clip, epsilon).astype(gradient.dtype)

        return jax.tree.map(clipped, updates, params), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), update)


class LaPropState(NamedTuple):
    """The state of `scale_by_laprop`: updates made so far, and both averages, uncorrected."""

    step: jax.Array
    second_moment: optax.Updates
    momentum: optax.Updates


def scale_by_laprop(beta1: float = 0.9, beta2: float = 0.99, epsilon: float = 1e-20) -> optax.GradientTransformation:
    """LaProp: normalized by their own recent size first, averaged over time second. [OPT-8] to [OPT-12]

    Raises:
      ValueError: a beta outside [0, 1).
    """
    _require_betas(beta1, beta2)

    def init(params: optax.Params) -> LaPropState:
        def zeros() -> optax.Updates:
            return jax.tree.map(lambda p: jnp.zeros_like(p, dtype=jnp.promote_types(p.dtype, jnp.float32)), params)

        return LaPropState(jnp.zeros((), jnp.int32), zeros(), zeros())

    def update(
        updates: optax.Updates, state: LaPropState, params: optax.Params | None = None
    ) -> tuple[optax.Updates, LaPropState]:
        gradients = jax.tree.map(widen, updates)
        results = jax.tree.map(
            lambda g, v, m: _laprop(g, v, m, state.step, beta1, beta2, epsilon),
            gradients,
            state.second_moment,
            state.momentum,
        )
        scaled, second_moment, momentum = jax.tree.transpose(
            jax.tree.structure(updates), jax.tree.structure((0, 0, 0)), results
        )
        scaled = jax.tree.map(lambda update, like: update.astype(like.dtype), scaled, updates)
        return scaled, LaPropState(state.step + 1, second_moment, momentum)

    return optax.GradientTransformation(init, update)


def dreamer_optimizer(config: Config) -> optax.GradientTransformation:
    """`optimizer_step` as one optax transformation."""
    return optax.chain(
        adaptive_gradient_clipping(config.agc_clip, config.agc_epsilon),
        scale_by_laprop(config.beta1, config.beta2, config.laprop_epsilon),
        optax.scale_by_learning_rate(lambda step: learning_rate(step, config)),
    )
