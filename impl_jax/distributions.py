"""What the networks' outputs mean: how to sample from them, and to score them. Chapter: spec/02-distributions.md.

Every function computes in float32, or in float64 for a float64 first argument. [DIS-1]
"""

import math

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jax.typing import ArrayLike

from impl_jax.shapes import require_same_shape, require_shape, widen
from impl_jax.transforms import ordered_expectation, symlog, twohot


def _constant(x: ArrayLike, like: jax.Array) -> jax.Array:
    """A constant in the dtype of another argument. [DIS-2]"""
    return stop_gradient(jnp.asarray(x).astype(like.dtype))


def _weighted_sum(weights: jax.Array, logarithms: jax.Array) -> jax.Array:
    """Sum of weight * logarithm over the last axis; a weight of 0 silences even an infinite logarithm. [DIS-4]

    The logarithm is replaced before it is multiplied: afterwards its gradient would be NaN already.
    """
    return jnp.sum(weights * jnp.where(weights == 0, 0.0, logarithms), axis=-1)


def unimix_log_probs(logits: ArrayLike, unimix: float) -> jax.Array:
    """ln((1 - unimix) softmax + unimix / C) over the last axis: [..., C] -> [..., C]. [DIS-5] to [DIS-7]"""
    logits = widen(logits)
    shifted = logits - stop_gradient(jnp.max(logits, axis=-1, keepdims=True))
    if unimix == 0:
        return shifted - jnp.log(jnp.sum(jnp.exp(shifted), axis=-1, keepdims=True))
    weights = jnp.exp(shifted)
    probs = weights / jnp.sum(weights, axis=-1, keepdims=True)
    return jnp.log((1.0 - unimix) * probs + unimix / logits.shape[-1])


def categorical_sample(log_probs: ArrayLike, uniform: ArrayLike) -> jax.Array:
    """One-hot samples by inverse CDF, constant: [..., C] and uniforms [...] -> [..., C]. [DIS-8], [CON-17]"""
    log_probs = stop_gradient(widen(log_probs))
    uniform = _constant(uniform, log_probs)
    require_shape("uniform", uniform.shape, *log_probs.shape[:-1])
    classes = log_probs.shape[-1]
    # Running sums as a product with a triangle of ones: faster than a scan over a few classes, and a class of
    # probability 0 has exactly the running sum of the class before it, so that it is never drawn.
    # The last sum is left out: it is 1 but for rounding, and could fall below the uniform number.
    triangle = jnp.triu(jnp.ones((classes, classes - 1), log_probs.dtype))
    cumulative = jnp.matmul(jnp.exp(log_probs), triangle, precision=jax.lax.Precision.HIGHEST)  # [..., C - 1]
    index = jnp.sum(cumulative <= uniform[..., None], axis=-1)  # [...]
    return (index[..., None] == jnp.arange(classes)).astype(log_probs.dtype)


def straight_through(log_probs: ArrayLike, sample: ArrayLike) -> jax.Array:
    """The sample's value with the probabilities' gradient: [..., C]. Section "World model learning". [DIS-9]"""
    log_probs = widen(log_probs)
    sample = _constant(sample, log_probs)
    require_same_shape(log_probs=log_probs, sample=sample)
    probs = jnp.exp(log_probs)
    return sample + (probs - stop_gradient(probs))  # in this order: the difference is exactly 0


def categorical_log_prob(log_probs: ArrayLike, onehot: ArrayLike) -> jax.Array:
    """The log-probability of one-hots: [..., C] -> [...], nats. [DIS-10]"""
    log_probs = widen(log_probs)
    onehot = _constant(onehot, log_probs)
    require_same_shape(log_probs=log_probs, onehot=onehot)
    return _weighted_sum(onehot, log_probs)


def categorical_entropy(log_probs: ArrayLike) -> jax.Array:
    """-sum p ln p: [..., C] -> [...], nats. [DIS-11]"""
    log_probs = widen(log_probs)
    return -_weighted_sum(jnp.exp(log_probs), log_probs)


def categorical_kl(log_probs_p: ArrayLike, log_probs_q: ArrayLike) -> jax.Array:
    """KL(p, q) over the last axis: [..., C] -> [...], nats, with gradients into both. [DIS-12]"""
    log_probs_p = widen(log_probs_p)
    log_probs_q = jnp.asarray(log_probs_q).astype(log_probs_p.dtype)
    require_same_shape(log_probs_p=log_probs_p, log_probs_q=log_probs_q)
    probs = jnp.exp(log_probs_p)
    possible = probs != 0
    return jnp.sum(probs * (jnp.where(possible, log_probs_p, 0.0) - jnp.where(possible, log_probs_q, 0.0)), axis=-1)


def symexp_twohot_loss(logits: ArrayLike, target: ArrayLike, bins: ArrayLike) -> jax.Array:
    """Cross-entropy between the twohot of a raw target and the softmax: [..., K], [...] -> [...], nats. [DIS-14]"""
    logits = widen(logits)
    target = _constant(target, logits)
    require_shape("logits", logits.shape, ..., jnp.size(bins))
    require_shape("target", target.shape, *logits.shape[:-1])
    return -_weighted_sum(twohot(target, bins), unimix_log_probs(logits, 0.0))


def symexp_twohot_mean(logits: ArrayLike, bins: ArrayLike) -> jax.Array:
    """The mean of the softmax over the bins: [..., K] -> [...], exactly 0 for mirror-symmetric logits. [DIS-15]"""
    logits = widen(logits)
    weights = jnp.exp(logits - stop_gradient(jnp.max(logits, axis=-1, keepdims=True)))
    # The division comes last: on the CPU, XLA divides some elements of a row by another route than their mirror images,
    # and the last bit of a weight times the outermost bin is as large as a reward.
    return ordered_expectation(weights, bins) / jnp.sum(weights, axis=-1)


@jax.custom_jvp
def _softplus(x: jax.Array) -> jax.Array:
    """ln(1 + e^x), with its derivative given: the automatic one of max and abs need not be 1/2 at 0. [DIS-17]"""
    return jnp.maximum(x, 0.0) + jnp.log1p(jnp.exp(-jnp.abs(x)))


@_softplus.defjvp
def _softplus_jvp(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    (x,), (tangent,) = primals, tangents
    return _softplus(x), jax.nn.sigmoid(x) * tangent


def bernoulli_loss(logit: ArrayLike, target: ArrayLike) -> jax.Array:
    """Binary cross-entropy of a logit with a target in [0, 1], elementwise, nats. [DIS-16], [DIS-17]"""
    logit = widen(logit)
    target = _constant(target, logit)
    require_same_shape(logit=logit, target=target)
    positive = target * jnp.where(target == 0, 0.0, _softplus(-logit))
    negative = (1.0 - target) * jnp.where(target == 1, 0.0, _softplus(logit))
    # What a target of 0 or 1 silences is its own term, not a NaN logit.
    return jnp.where(jnp.isnan(logit), logit, positive + negative)


def bernoulli_mean(logit: ArrayLike) -> jax.Array:
    """The probability of a logit, elementwise. [DIS-18]"""
    return jax.nn.sigmoid(widen(logit))


def bounded_normal(mean: ArrayLike, std: ArrayLike, min_std: float, max_std: float) -> tuple[jax.Array, jax.Array]:
    """Mean and standard deviation from two raw outputs, elementwise. [DIS-19]"""
    mean = widen(mean)
    std = jnp.asarray(std).astype(mean.dtype)
    require_same_shape(mean=mean, std=std)
    return jnp.tanh(mean), (max_std - min_std) * jax.nn.sigmoid(std + 2.0) + min_std


def normal_sample(mean: ArrayLike, std: ArrayLike, normal: ArrayLike) -> jax.Array:
    """mean + std * normal, elementwise, constant, neither truncated nor clipped. [DIS-20]"""
    mean = stop_gradient(widen(mean))
    std, normal = _constant(std, mean), _constant(normal, mean)
    require_same_shape(mean=mean, std=std, normal=normal)
    return mean + std * normal


def normal_log_prob(mean: ArrayLike, std: ArrayLike, value: ArrayLike) -> jax.Array:
    """Log-density of a value, elementwise, nats, with gradients into mean and std alone. [DIS-21]"""
    mean = widen(mean)
    std, value = jnp.asarray(std).astype(mean.dtype), _constant(value, mean)
    require_same_shape(mean=mean, std=std, value=value)
    return -0.5 * jnp.square((value - mean) / std) - jnp.log(std) - 0.5 * math.log(2 * math.pi)


def normal_entropy(std: ArrayLike) -> jax.Array:
    """Entropy of a normal, elementwise, nats; negative for small deviations. [DIS-22]"""
    return 0.5 + 0.5 * math.log(2 * math.pi) + jnp.log(widen(std))


def mse_loss(prediction: ArrayLike, target: ArrayLike) -> jax.Array:
    """(prediction - target)^2, elementwise. [DIS-23]"""
    prediction = widen(prediction)
    target = _constant(target, prediction)
    require_same_shape(prediction=prediction, target=target)
    return jnp.square(prediction - target)


def symlog_mse_loss(prediction: ArrayLike, target: ArrayLike, scale: float) -> jax.Array:
    """scale * (prediction - symlog(target))^2, elementwise: the prediction in symlog space, the target raw. [DIS-24]"""
    prediction = widen(prediction)
    target = _constant(target, prediction)
    require_same_shape(prediction=prediction, target=target)
    return scale * jnp.square(prediction - symlog(target))
