"""What followed an action, of one environment and of several together."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from dreamer_spec.envs.adapter import Observation

Step = tuple[Observation, float, bool, bool, dict[str, Any]]


def is_last(step: Step) -> bool:
    return bool(step[2] or step[3])


@dataclasses.dataclass(frozen=True)
class Batch:
    """All of N steps but their observations. (An object, because Gymnasium would take a dictionary apart.)"""

    rewards: list[float]
    terminated: list[bool]
    truncated: list[bool]
    infos: list[dict[str, Any]]


def joined(steps: Sequence[Step]) -> Step:
    """N steps as one, with observations [N, ...] and a `Batch` in its info."""
    observations, *others = (list(column) for column in zip(*steps, strict=True))
    observation = {key: np.stack([own[key] for own in observations]) for key in observations[0]}
    return observation, 0.0, False, False, {"batch": Batch(*others)}


def separate(step: Step) -> list[Step]:
    """The steps of which `joined` made this one; itself, if it is of one environment."""
    batch: Batch | None = step[4].get("batch")
    if batch is None:
        return [step]
    observations = [{key: value[index] for key, value in step[0].items()} for index in range(len(batch.rewards))]
    return list(zip(observations, batch.rewards, batch.terminated, batch.truncated, batch.infos, strict=True))
