"""The checks, one module for each row of the grid. Importing this package registers all of them."""

from conformance.cases import (
    agent,
    behavior,
    distributions,
    given,
    gradients,
    layers,
    networks,
    notation,
    optimizer,
    replay,
    returns,
    rssm,
    sampling,
    training_loop,
    transforms,
    world_model,
)

__all__ = [
    "agent",
    "behavior",
    "distributions",
    "given",
    "gradients",
    "layers",
    "networks",
    "notation",
    "optimizer",
    "replay",
    "returns",
    "rssm",
    "sampling",
    "training_loop",
    "transforms",
    "world_model",
]
