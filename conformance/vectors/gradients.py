"""Gradients of the losses that are functions of a few arrays, from differences of the reference with its stop-gradients
held constant."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from conformance.compare import Path
from conformance.interface import INTERFACE
from conformance.vectors.recording import Vector
from reference_numpy import behavior, distributions, world_model
from reference_numpy.stop_gradient import recording, replaying

BY: Mapping[str, tuple[str, ...]] = {
    "categorical_log_prob": ("log_probs",),
    "categorical_entropy": ("log_probs",),
    "categorical_kl": ("log_probs_p", "log_probs_q"),
    "symexp_twohot_loss": ("logits",),
    "bernoulli_loss": ("logit",),
    "normal_log_prob": ("mean", "std"),
    "normal_entropy": ("std",),
    "mse_loss": ("prediction",),
    "symlog_mse_loss": ("prediction",),
    "kl_losses": ("posterior_logits", "prior_logits"),
    "actor_loss": ("log_prob", "entropy", "returns", "value"),
    "critic_loss": ("logits", "slow_logits", "returns"),
    "replay_critic_loss": ("logits", "slow_logits", "returns"),
}
"""Losses -> the arguments that have gradients, or for which the chapter says that none flows."""

TOLERANCE = {"float64": 1e-7, "float32": 1e-4}
ERROR = 1e-9
"""A gradient is kept where two steps of the difference agree this well, relative to its largest entry."""
STEP = 1e-3
LARGEST_ARGUMENT = 512
SMALLEST_SCALE = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Gradient:
    """The derivative of the sum of all entries of the result at `of` by an argument, and what its tolerance is relative
    to."""

    of: Path
    by: str
    expected: np.ndarray
    scale: float
    tolerance: Mapping[str, float]


def gradients(vector: Vector) -> list[Gradient]:
    """The gradients of a vector whose function is a loss; those that cannot be found exactly, beside infinities and
    kinks, are left out."""
    found = []
    for by in BY.get(vector.function, ()):
        place = INTERFACE[vector.function].index(by)
        argument = np.asarray(vector.arguments[place], np.float64)
        if not vector.outputs or not 0 < argument.size <= LARGEST_ARGUMENT or not np.all(np.isfinite(argument)):
            continue
        steps = STEP * (np.abs(argument) if by == "std" else np.maximum(np.abs(argument), 1.0))
        with np.errstate(all="ignore"):
            derivatives = _derivatives(vector, place, argument, steps)
        for output, derivative in zip(vector.outputs, derivatives, strict=True):
            if derivative is not None:
                scale = max(SMALLEST_SCALE, float(np.abs(derivative).max()))
                found.append(Gradient(output.path, by, derivative, scale, TOLERANCE))
    return found


def _derivatives(vector: Vector, place: int, argument: np.ndarray, steps: np.ndarray) -> list[np.ndarray | None]:
    """For each output; None where the error is too large."""
    module = next(one for one in (distributions, world_model, behavior) if hasattr(one, vector.function))
    function = getattr(module, vector.function)

    def sums(moved: np.ndarray) -> np.ndarray:
        result = function(*vector.arguments[:place], moved, *vector.arguments[place + 1 :])
        return np.array([np.sum(_part(result, output.path)) for output in vector.outputs])

    with recording() as tape:
        sums(argument)
    coarse, fine = np.zeros((2, len(vector.outputs), argument.size))
    for index, step in enumerate(steps.flat):
        values = {}
        for half_steps in (-4, -2, -1, 1, 2, 4):
            moved = argument.copy()
            moved.flat[index] += half_steps * step / 2
            with replaying(list(tape)):
                values[half_steps] = sums(moved)
        # Differences of fourth order, with a step and with half of it.
        coarse[:, index] = (8 * (values[2] - values[-2]) - (values[4] - values[-4])) / (12 * step)
        fine[:, index] = (8 * (values[1] - values[-1]) - (values[2] - values[-2])) / (6 * step)
    exact = [
        np.all(np.abs(c - f) <= ERROR * max(SMALLEST_SCALE, np.abs(f).max())) for c, f in zip(coarse, fine, strict=True)
    ]
    return [f.reshape(argument.shape) if good else None for f, good in zip(fine, exact, strict=True)]


def _part(result: Any, path: Path) -> Any:
    for key in path:
        result = result[key]
    return result
