"""What happened in a run: every answer of an environment, every policy step and every train step, in their order."""

import dataclasses
import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np

Key = tuple[int, ...]
"""What an observation is recognized by: its episode's seed in three parts, its frame, and all that led to it."""


@dataclasses.dataclass(frozen=True, eq=False)
class Frame:
    """One answer of an environment.

    environment: its number. seed: of a reset, None for a step. action: that a step got. after_end: whether the episode
    had ended before.
    """

    environment: int
    key: Key
    observation: Mapping[str, np.ndarray]
    seed: int | None
    action: Mapping[str, np.ndarray] | None
    reward: float
    terminated: bool
    truncated: bool
    after_end: bool = False

    @property
    def is_reset(self) -> bool:
        return self.action is None


@dataclasses.dataclass(frozen=True, eq=False)
class Act:
    """One policy step of N environments.

    keys: of the observations. carry, carried: stamps of the carry that came and of the one that was returned [N].
    latents: the marks of the latents [N].
    """

    keys: list[Key]
    observation: Mapping[str, np.ndarray]
    is_first: np.ndarray
    carry: np.ndarray
    seed: int
    action: np.ndarray
    carried: np.ndarray
    latents: list[int]


@dataclasses.dataclass(frozen=True, eq=False)
class Train:
    """One train step. latents: marks of those that were returned, [B][T]. skipped: whether no update was made."""

    batch: Mapping[str, np.ndarray]
    seed: int
    skipped: bool
    latents: list[list[int]]


@dataclasses.dataclass
class Diary:
    """events: in their order. environments: how many were reset; failed: numbers of those that have failed.
    parameter_seeds: of the learners that were made. first_state, last_state: the training state before the first and
    after the last call that acts or trains. latents: by their marks, deter [D] and stoch [S]. result: what `run`
    returned."""

    events: list[Frame | Act | Train] = dataclasses.field(default_factory=list)
    environments: int = 0
    failed: list[int] = dataclasses.field(default_factory=list)
    parameter_seeds: list[int] = dataclasses.field(default_factory=list)
    first_state: Mapping[str, np.ndarray] | None = None
    last_state: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    latents: dict[int, tuple[np.ndarray, np.ndarray]] = dataclasses.field(default_factory=dict)
    result: Any = None

    @property
    def frames(self) -> list[Frame]:
        return [event for event in self.events if isinstance(event, Frame)]

    @property
    def acts(self) -> list[Act]:
        return [event for event in self.events if isinstance(event, Act)]

    @property
    def trains(self) -> list[Train]:
        return [event for event in self.events if isinstance(event, Train)]


def mark(*content: Any) -> int:
    """40 bits that any other content makes other ones."""
    digest = hashlib.blake2b(digest_size=5)
    for part in content:
        digest.update(part.tobytes() if isinstance(part, np.ndarray | np.generic) else repr(part).encode())
    return int.from_bytes(digest.digest(), "big")
