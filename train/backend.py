"""The narrow interface between training and a backend.

A backend is a package with a class `Learner`: one agent, its optimizer and its random numbers, on one device. Everything that crosses the
border is NumPy (or converts to it with `np.asarray`: a backend may return arrays that are still being computed).
"""

import importlib
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from spec import Config, Spaces

Arrays = Mapping[str, np.ndarray]


class Learner(Protocol):
    """What `impl_jax.learner.Learner` and `impl_torch.learner.Learner` offer.

    Random numbers are a function of the seed and of two counters that `state_dict` carries (policy calls and training steps), so that a
    resumed run draws what an uninterrupted one would have drawn.
    """

    device: str

    def __init__(self, spaces: Spaces, config: Config, *, seed: int, device: str | None = None) -> None: ...

    def initial_carry(self, envs: int) -> Any:
        """The carry of `envs` environments before their first step; opaque to the caller."""

    def policy(
        self, observation: Arrays, is_first: np.ndarray, carry: Any, evaluation_step: int | None = None
    ) -> tuple[np.ndarray, Arrays, Any]:
        """One acting step of N environments: [AGT] policy step.

        observation: key -> [N, ...]; is_first: bool [N]. Returns the flat action [N, A], the latents {"deter": [N, D] float32,
        "stoch": [N, S] class indices} and the new carry, which holds the action taken (reset wherever is_first is set next time).

        evaluation_step: number of this step among those of all evaluations. It then selects the random numbers, from a stream of its
        own, and nothing in the learner changes: evaluating leaves training as it would have been ([LOOP-18]).
        """

    def train_step(self, batch: Arrays) -> tuple[Mapping[str, Any], Arrays]:
        """One gradient step on a replay batch. Returns scalar metrics by name and the latents to write back
        {"deter": [B, T, D], "stoch": [B, T, S] class indices}; both may still be computing when this returns."""

    def state_dict(self) -> dict[str, np.ndarray]:
        """The training state under its canonical names ([AGT] training state), plus "counters/policy" and "counters/train"."""

    def load_state_dict(self, state: Arrays) -> None:
        """The inverse of `state_dict`.

        Raises:
          ValueError: a missing or unexpected name, or a wrong shape; the message lists them.
        """


def learner_class(backend: str) -> type[Learner]:
    """The `Learner` of the backend `jax` or `torch`. Importing it needs that backend's packages."""
    return importlib.import_module(f"impl_{backend}.learner").Learner
