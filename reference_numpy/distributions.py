"""What the networks' outputs stand for: log-probabilities, samples, losses. Chapter: spec/02-distributions.md."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from reference_numpy.shapes import checked
from reference_numpy.stop_gradient import stop_gradient
from reference_numpy.transforms import ordered_expectation, symlog, twohot

Array = NDArray[np.float64]


def unimix_log_probs(logits: Any, unimix: float) -> Array:
    """Log-probabilities of a softmax mixed with the uniform distribution.
    Implements [DIS-1], [DIS-3], [DIS-5] to [DIS-7].

    Paper: section World model learning (1 % uniform) and section Distributions; D-21 to D-23.

    Args:
      logits: [..., C].
      unimix: share of the uniform distribution, 0 to 1.

    Returns:
      [..., C] natural logarithms; the plain log-softmax for unimix = 0.

    Raises:
      ValueError: logits has no axis.
    """
    logits = checked("logits", logits, ..., "C")
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        shifted = logits - np.max(logits, axis=-1, keepdims=True)
        log_softmax = shifted - np.log(np.sum(np.exp(shifted), axis=-1, keepdims=True))
        if unimix == 0:
            return log_softmax
        return np.log((1 - unimix) * np.exp(log_softmax) + unimix / logits.shape[-1])


def categorical_sample(log_probs: Any, uniform: Any) -> Array:
    """One-hot sample by inverse CDF, a constant. Implements [DIS-8], [CON-16], [CON-17].

    Args:
      log_probs: [..., C].
      uniform: [...], in [0, 1).

    Returns:
      [..., C], one-hot at the number of classes, the last one left out, whose cumulative probability is <= uniform.

    Raises:
      ValueError: the leading axes differ.
    """
    log_probs = checked("log_probs", log_probs, ..., "C")
    uniform = checked("uniform", uniform, *log_probs.shape[:-1])
    cumulative = np.cumsum(np.exp(log_probs), axis=-1)
    index = np.sum(cumulative[..., :-1] <= uniform[..., None], axis=-1)
    return stop_gradient(np.eye(log_probs.shape[-1])[index])


def straight_through(log_probs: Any, sample: Any) -> Array:
    """The sample as a number, the probabilities as a gradient. Implements [DIS-9].

    Paper: section World model learning ("straight-through gradients"); D-24.

    Args:
      log_probs: [..., C].
      sample: [..., C] one-hot, a constant.

    Returns:
      [..., C].

    Raises:
      ValueError: the shapes differ.
    """
    probs = np.exp(checked("log_probs", log_probs, ..., "C"))
    sample = checked("sample", sample, *probs.shape)
    return stop_gradient(sample) + (probs - stop_gradient(probs))


def categorical_log_prob(log_probs: Any, onehot: Any) -> Array:
    """Log-probability of a class. Implements [DIS-4], [DIS-10], [DIS-13].

    Args:
      log_probs: [..., C].
      onehot: [..., C], a constant.

    Returns:
      [...], in nats.

    Raises:
      ValueError: the shapes differ.
    """
    log_probs = checked("log_probs", log_probs, ..., "C")
    onehot = stop_gradient(checked("onehot", onehot, *log_probs.shape))
    return np.sum(_product(onehot, log_probs), axis=-1)


def categorical_entropy(log_probs: Any) -> Array:
    """Entropy. Implements [DIS-4], [DIS-11], [DIS-13].

    Args:
      log_probs: [..., C].

    Returns:
      [...], in nats.

    Raises:
      ValueError: log_probs has no axis.
    """
    log_probs = checked("log_probs", log_probs, ..., "C")
    return -np.sum(_product(np.exp(log_probs), log_probs), axis=-1)


def categorical_kl(log_probs_p: Any, log_probs_q: Any) -> Array:
    """Kullback-Leibler divergence of q from p, summed over the classes only. Implements [DIS-4], [DIS-12], [DIS-13].

    Paper: section World model learning; D-18.

    Args:
      log_probs_p: [..., C].
      log_probs_q: [..., C].

    Returns:
      [...], in nats.

    Raises:
      ValueError: the shapes differ.
    """
    log_probs_p = checked("log_probs_p", log_probs_p, ..., "C")
    log_probs_q = checked("log_probs_q", log_probs_q, *log_probs_p.shape)
    with np.errstate(invalid="ignore"):
        difference = log_probs_p - log_probs_q
    return np.sum(_product(np.exp(log_probs_p), difference), axis=-1)


def symexp_twohot_loss(logits: Any, target: Any, bins: Any) -> Array:
    """Cross-entropy towards the two-hot encoding of a number. Implements [DIS-4], [DIS-14].

    Paper: eq. twohotloss, section Robust predictions.

    Args:
      logits: [..., K].
      target: [...], a constant, in the unit of the bins.
      bins: [K].

    Returns:
      [...], in nats.

    Raises:
      ValueError: a shape does not fit.
    """
    bins = checked("bins", bins, "K")
    logits = checked("logits", logits, ..., len(bins))
    target = stop_gradient(checked("target", target, *logits.shape[:-1]))
    return -np.sum(_product(twohot(target, bins), unimix_log_probs(logits, 0.0)), axis=-1)


def symexp_twohot_mean(logits: Any, bins: Any) -> Array:
    """The number that a symexp-twohot output predicts. Implements [DIS-15].

    Paper: section Robust predictions (weighted average of the bins); D-47, D-48.

    Args:
      logits: [..., K].
      bins: [K], symmetric.

    Returns:
      [...], in the unit of the bins; exactly 0 for equal logits.

    Raises:
      ValueError: a shape does not fit.
    """
    bins = checked("bins", bins, "K")
    logits = checked("logits", logits, ..., len(bins))
    return ordered_expectation(np.exp(unimix_log_probs(logits, 0.0)), bins)


def bernoulli_loss(logit: Any, target: Any) -> Array:
    """Logistic regression on a target between 0 and 1. Implements [DIS-4], [DIS-16], [DIS-17], [DIS-25].

    Paper: section World model learning ("the continue predictor via logistic regression").

    Args:
      logit: [...].
      target: [...], 0 to 1, a constant.

    Returns:
      [...], in nats.

    Raises:
      ValueError: the shapes differ.
    """
    logit = checked("logit", logit, ...)
    target = stop_gradient(checked("target", target, *logit.shape))
    return _product(target, _softplus(-logit)) + _product(1 - target, _softplus(logit))


def bernoulli_mean(logit: Any) -> Array:
    """Probability of 1. Implements [DIS-18], [DIS-25].

    Args:
      logit: [...].

    Returns:
      [...], 0 to 1.
    """
    return _sigmoid(checked("logit", logit, ...))


def bounded_normal(mean: Any, std: Any, min_std: float, max_std: float) -> tuple[Array, Array]:
    """Mean and standard deviation of a continuous action from raw outputs. Implements [DIS-19], [DIS-25].

    Not in the paper; D-66.

    Args:
      mean: [...], raw output.
      std: [...], raw output.
      min_std: lower bound of the standard deviation.
      max_std: upper bound.

    Returns:
      A pair of [...]: the mean in [-1, 1] and the standard deviation.

    Raises:
      ValueError: the shapes differ.
    """
    mean = checked("mean", mean, ...)
    std = checked("std", std, *mean.shape)
    return np.tanh(mean), (max_std - min_std) * _sigmoid(std + 2.0) + min_std


def normal_sample(mean: Any, std: Any, normal: Any) -> Array:
    """Sample of a normal distribution, a constant. Implements [DIS-20], [DIS-25], [CON-18].

    Args:
      mean: [...].
      std: [...].
      normal: [...], standard normal noise.

    Returns:
      [...], neither truncated nor clipped.

    Raises:
      ValueError: the shapes differ.
    """
    mean = checked("mean", mean, ...)
    std = checked("std", std, *mean.shape)
    return stop_gradient(mean + std * checked("normal", normal, *mean.shape))


def normal_log_prob(mean: Any, std: Any, value: Any) -> Array:
    """Log-density of each dimension. Implements [DIS-21], [DIS-25].

    Args:
      mean: [...].
      std: [...], positive.
      value: [...], a constant.

    Returns:
      [...], in nats, not summed.

    Raises:
      ValueError: the shapes differ.
    """
    mean = checked("mean", mean, ...)
    std = checked("std", std, *mean.shape)
    value = stop_gradient(checked("value", value, *mean.shape))
    with np.errstate(over="ignore", invalid="ignore"):
        return -0.5 * ((value - mean) / std) ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi)


def normal_entropy(std: Any) -> Array:
    """Entropy of each dimension; negative for small standard deviations. Implements [DIS-22], [DIS-25].

    Args:
      std: [...], positive.

    Returns:
      [...], in nats, not summed.
    """
    std = checked("std", std, ...)
    return 0.5 + 0.5 * np.log(2 * np.pi) + np.log(std)


def mse_loss(prediction: Any, target: Any) -> Array:
    """Squared error of each element. Implements [DIS-23], [DIS-25].

    Args:
      prediction: [...].
      target: [...], a constant.

    Returns:
      [...].

    Raises:
      ValueError: the shapes differ.
    """
    prediction = checked("prediction", prediction, ...)
    target = stop_gradient(checked("target", target, *prediction.shape))
    with np.errstate(over="ignore", invalid="ignore"):
        return (prediction - target) ** 2


def symlog_mse_loss(prediction: Any, target: Any, scale: float) -> Array:
    """Scaled squared error of each element in symlog space. Implements [DIS-24], [DIS-25].

    Paper: eq. logpred, section Robust predictions (scale 1/2); D-14.

    Args:
      prediction: [...], in symlog space.
      target: [...], raw, a constant.
      scale: factor of the square.

    Returns:
      [...].

    Raises:
      ValueError: the shapes differ.
    """
    prediction = checked("prediction", prediction, ...)
    target = stop_gradient(checked("target", target, *prediction.shape))
    with np.errstate(over="ignore", invalid="ignore"):
        return scale * (prediction - symlog(target)) ** 2


def _sigmoid(x: Array) -> Array:
    """1 / (1 + exp(-x)), without overflow."""
    small = np.exp(-np.abs(x))
    return np.where(x < 0, small, 1.0) / (1.0 + small)


def _softplus(x: Array) -> Array:
    """ln(1 + exp(x)), without overflow."""
    return np.maximum(x, 0.0) + np.log1p(np.exp(-np.abs(x)))


def _product(weight: Array, x: Array) -> Array:
    """weight * x, where a weight of exactly 0 gives 0 whatever x is ([DIS-4])."""
    with np.errstate(invalid="ignore"):
        return np.where(weight == 0, 0.0, weight * x)
