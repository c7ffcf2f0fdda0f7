"""The checks, one module for each row of the grid. Importing this package registers all of them."""

from conformance.cases import (
    agent,
    behavior,
    distributions,
    gradients,
    layers,
    networks,
    notation,
    optimizer,
    replay,
    returns,
    rssm,
    training_loop,
    transforms,
    world_model,
)

__all__ = [
    "agent",
    "behavior",
    "distributions",
    "gradients",
    "layers",
    "networks",
    "notation",
    "optimizer",
    "replay",
    "returns",
    "rssm",
    "training_loop",
    "transforms",
    "world_model",
]
