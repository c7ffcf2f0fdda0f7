"""The reference as a candidate: it must pass its own checks, and its mutants must not."""

from typing import Any

import numpy as np
from reference_numpy.agent import directional_derivative

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

ROWS = (transforms, distributions, layers, rssm, networks, world_model, returns, behavior, optimizer, agent, replay, training_loop)


class NumpyAdapter:
    """Offers every public function of reference_numpy under its name, looked up at each call so that a mutant takes effect."""

    def __getattr__(self, name: str) -> Any:
        for row in ROWS:
            if not name.startswith("_") and name in vars(row):
                return getattr(row, name)
        raise AttributeError(name)

    def imagine(self, params: Any, carry: Any, action: np.ndarray, uniform: np.ndarray, config: Any) -> Any:
        return rssm.imagine(params, carry, lambda feature, t: action[:, t], uniform, config)

    def loss_derivative(
        self, params: Any, slow_critic: Any, return_range: Any, batch: Any, noise: Any, spaces: Any, config: Any, direction: Any
    ) -> float:
        def total(point: Any) -> float:
            return agent.losses(point, slow_critic, return_range, batch, noise, spaces, config)[0]

        return directional_derivative(total, params, direction, 1e-6)


def make_adapter(dtype: str, device: str | None) -> NumpyAdapter:
    """The reference computes in float64 on the CPU, whatever is asked."""
    del dtype, device
    return NumpyAdapter()
