"""Adaptive gradient clipping and LaProp. Chapter: spec/09-optimizer.md."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reference_numpy.shapes import checked, require, require_shapes
from spec.config import Config

Array = NDArray[np.float64]

DEAD_ZONE = 1e-16  # [OPT-9]: below this the square of a gradient would leave the normal numbers of float32


def adaptive_gradient_clip(gradient: Any, parameter: Any, clip: float, epsilon: float) -> Array:
    """The gradient of one tensor, shortened where it is too long for the tensor.
    Implements [OPT-1] to [OPT-5], [OPT-19].

    Paper: Methods, Implementation, paragraph Optimizer; D-74.

    Args:
      gradient: [...], loss per unit of the parameter.
      parameter: [...], the same shape.
      clip: largest ratio of the two norms.
      epsilon: smallest norm that the parameter is taken to have.

    Returns:
      [...]; all NaN where one of the norms is not finite.

    Raises:
      ValueError: the shapes differ.
    """
    parameter = checked("parameter", parameter, ...)
    gradient = checked("gradient", gradient, *parameter.shape)
    length, size = _norm(gradient), _norm(parameter)
    if not (math.isfinite(length) and math.isfinite(size)):
        return np.full(gradient.shape, np.nan)
    threshold = clip * max(epsilon, size)
    if length <= threshold:
        return gradient.copy()
    return np.asarray(gradient * (threshold / length))


def learning_rate(step: int, config: Config) -> float:
    """The learning rate of the update that follows `step` earlier ones. Implements [OPT-6].

    Paper: not mentioned; D-75.

    Args:
      step: number of updates made before, 0 or more.

    Returns:
      A scalar.

    Raises:
      ValueError: a negative step.
    """
    _require_step(step)
    if config.warmup_steps == 0:
        return config.learning_rate
    return config.learning_rate * min(1.0, step / config.warmup_steps)


def laprop(gradient: Any, second_moment: Any, momentum: Any, step: int, config: Config) -> tuple[Array, Array, Array]:
    """The normalized, then averaged gradient of one tensor. Implements [OPT-8] to [OPT-13], [OPT-19], [OPT-20].

    Paper: Methods, Implementation, paragraph Optimizer; D-72, D-73.

    Args:
      gradient: [...], already clipped.
      second_moment: [...], the average of squared gradients, 0 at first.
      momentum: [...], the average of normalized gradients, 0 at first.
      step: number of updates made before, 0 or more.

    Returns:
      The update (to be multiplied by the learning rate and subtracted), the new second moment and the new momentum,
      each [...].

    Raises:
      ValueError: the shapes differ, or the step is negative.
    """
    gradient = checked("gradient", gradient, ...)
    second_moment = checked("second_moment", second_moment, *gradient.shape)
    momentum = checked("momentum", momentum, *gradient.shape)
    _require_step(step)
    updates = step + 1
    gradient = np.where(np.abs(gradient) < DEAD_ZONE, 0.0, gradient)
    second_moment = config.beta2 * second_moment + (1 - config.beta2) * gradient**2
    root = np.sqrt(second_moment / (1 - config.beta2**updates)) + config.laprop_epsilon
    # A zero gradient is a zero by definition: with epsilon 0 the quotient could be 0/0.
    normalized = np.where(gradient == 0, 0.0, gradient / np.where(gradient == 0, 1.0, root))
    momentum = config.beta1 * momentum + (1 - config.beta1) * normalized
    update = momentum / (1 - config.beta1**updates)
    return update, second_moment, momentum


def optimizer_step(
    params: Mapping[str, Any], gradients: Mapping[str, Any], state: Mapping[str, Any], config: Config
) -> tuple[dict[str, Array], dict[str, Any]]:
    """One update of every parameter. Implements [OPT-2], [OPT-7], [OPT-15] to [OPT-21].

    Paper: Methods, Implementation, paragraph Optimizer; D-12, D-73 to D-75.

    Args:
      params: name -> array, every tensor of the parameter table.
      gradients: name -> array of the same shape.
      state: {"step": int, "second_moment": name -> array, "momentum": name -> array}.

    Returns:
      The new params and the new state; the arguments are left as they are.

    Raises:
      ValueError: names or shapes do not match.
    """
    shapes = {name: np.shape(value) for name, value in params.items()}
    require_shapes("gradients", gradients, shapes)
    require_shapes("second_moment", state["second_moment"], shapes)
    require_shapes("momentum", state["momentum"], shapes)
    step = int(state["step"])
    rate = learning_rate(step, config)
    new_params: dict[str, Array] = {}
    second_moments: dict[str, Array] = {}
    momenta: dict[str, Array] = {}
    for name in params:
        clipped = adaptive_gradient_clip(gradients[name], params[name], config.agc_clip, config.agc_epsilon)
        update, second_moments[name], momenta[name] = laprop(
            clipped, state["second_moment"][name], state["momentum"][name], step, config
        )
        new_params[name] = np.asarray(params[name], dtype=np.float64) - rate * update
    return new_params, {"step": step + 1, "second_moment": second_moments, "momentum": momenta}


def _norm(tensor: Array) -> float:
    """The root of the sum of squares over all entries, without overflow of the squares ([OPT-3])."""
    if tensor.size == 0:
        return 0.0
    peak = float(np.max(np.abs(tensor)))
    if peak == 0 or not math.isfinite(peak):
        return peak
    return peak * float(np.sqrt(np.sum((tensor / peak) ** 2)))


def _require_step(step: int) -> None:
    require(step >= 0, "step", "the number of updates made before, 0 or more", step)
