"""The reference as a candidate: it must pass its own checks, and its mutants must not."""

from typing import Any

import numpy as np

from conformance.adapters.without_noise import WithoutNoise
from reference_numpy import (
    agent,
    behavior,
    distributions,
    layers,
    networks,
    optimizer,
    replay,
    returns,
    rssm,
    training_loop,
    transforms,
    world_model,
)

CHAPTERS = (
    transforms,
    distributions,
    layers,
    rssm,
    networks,
    world_model,
    returns,
    behavior,
    optimizer,
    agent,
    replay,
    training_loop,
)


# Unit directions: the error of the difference is about 1e-11 times the loss.
DIFFERENCE_STEP = 1e-5


class NumpyAdapter(WithoutNoise):
    """Offers every public function of reference_numpy under its name, looked up at each call so that a mutant takes
    effect."""

    def __getattr__(self, name: str) -> Any:
        if name in ("gradients", "train_step"):
            raise AttributeError(f"the reference has no automatic differentiation, so it cannot offer {name}")
        for chapter in CHAPTERS:
            if not name.startswith("_") and name in vars(chapter):
                return getattr(chapter, name)
        raise AttributeError(name)

    def imagine(self, params: Any, carry: Any, action: np.ndarray, uniform: np.ndarray, config: Any) -> Any:
        return rssm.imagine(params, carry, lambda feature, t: action[:, t], uniform, config)

    def loss_derivatives(self, params: Any, *arguments: Any) -> Any:
        *others, directions = arguments
        names: list[str] = []

        def means(point: Any) -> np.ndarray:
            losses = agent.losses(point, *others)[1]["losses"]
            names[:] = losses
            return np.array(list(losses.values()))

        columns = [agent.directional_derivative(means, params, direction, DIFFERENCE_STEP) for direction in directions]
        return dict(zip(names, np.array(columns).T, strict=True))

    def train_step_with(self, *arguments: Any) -> Any:
        return agent.train_step(*arguments)


def make_adapter(dtype: str, device: str | None) -> NumpyAdapter:
    """The reference computes in float64 on the CPU, whatever is asked."""
    del dtype, device
    return NumpyAdapter()
