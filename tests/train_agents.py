"""Checkpoints of agents with random parameters, for the tests of what is made of a checkpoint."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from conformance.problems import random_state
from dreamer_spec.disk import checkpoint
from dreamer_spec.options import Options
from dreamer_spec.training.state import Counters
from dreamer_spec.translation import Entry, Target, Translation
from reference_numpy.agent import flatten_state
from spec import Config, Discrete, Image, Spaces, Vector


def random_learner_state(config: Config, spaces: Spaces, seed: int = 0) -> dict[str, np.ndarray]:
    """A training state in the middle of training, under the names of a checkpoint; no parameter is zero."""
    return flatten_state(random_state(np.random.default_rng(seed), config, spaces, "float32"))


def plain_translation(spaces: Spaces) -> Translation:
    """Of a task whose values have the form of the spaces already: a Dict, or where a key is `observation` or `action`
    that alone."""

    def entry(key: str, space: Target, acts: bool) -> Entry:
        path = () if key in ("observation", "action") else (key,)
        match space:
            case Discrete(classes):
                return Entry(path, () if len(classes) == 1 else space.array_shape, "int64", (0,), (), len(classes) == 1)
            case Vector():
                return Entry(path, space.array_shape, "float32", *(((-1.0,), (1.0,)) if acts else ()))
            case Image():
                return Entry(path, space.array_shape, "uint8", (0.0,), (255.0,))

    return Translation(
        spaces,
        {key: entry(key, space, False) for key, space in spaces.observations.items()},
        {key: entry(key, space, True) for key, space in spaces.actions.items()},
    )


def save_checkpoint(
    logdir: Path,
    config: Config,
    spaces: Spaces,
    *,
    backend: str = "jax",
    seed: int = 0,
    translation: Translation | None = None,
    **given: Any,
) -> Path:
    """Writes a checkpoint at step 1000. translation: `plain_translation` without it. given: fields of Options."""
    options = Options(backend=backend, config=config, logdir=logdir, steps=1000, seed=seed, **given)
    info = {
        "identity": options.identity(),
        "spaces": spaces.to_json(),
        "translation": (translation or plain_translation(spaces)).to_json(),
        "backend": backend,
        "counters": dataclasses.asdict(Counters(records=1000 // options.action_repeat, train_steps=10)),
    }
    loop = {"drawn/reward": np.zeros((2, 3), np.float32), "carry/action": np.zeros((2, spaces.action_size), np.float32)}
    return checkpoint.save(logdir, 1000, random_learner_state(config, spaces, seed), loop, info, keep=2)
