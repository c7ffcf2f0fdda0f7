"""The narrow interface between training and a backend.

A backend is a package with a class `Learner`: one agent and its optimizer on one device. Everything that crosses the
border is NumPy (or converts to it with `np.asarray`: a backend may return arrays that are still being computed). A
learner keeps no random state: whoever calls it gives the seed of each step ([LOOP-25]).
"""

import importlib
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from spec import Config, Spaces

Arrays = Mapping[str, np.ndarray]


class Learner(Protocol):
    """What `impl_jax.learner.Learner` and `impl_torch.learner.Learner` offer.

    seed: of the initial parameters. nonfinite: "stop" or "skip", what follows a train step whose total loss or gradient
    norm is not finite. Either way it changes nothing ([LOOP-40]); after "stop" no later train step does, until
    `load_state_dict` ([LOOP-41]).
    threads: that compute on the CPU; None leaves it to the library.
    """

    device: str

    def __init__(
        self,
        spaces: Spaces,
        config: Config,
        *,
        seed: int,
        device: str | None = None,
        nonfinite: str = "stop",
        threads: int | None = None,
    ) -> None: ...

    def initial_carry(self, envs: int) -> Any:
        """The carry of `envs` environments before their first step; opaque to the caller."""

    def save_carry(self, carry: Any) -> dict[str, np.ndarray]:
        """A carry as arrays, exactly: what is bfloat16 becomes float32."""

    def load_carry(self, arrays: Arrays) -> Any:
        """The inverse of `save_carry`, of this backend's or of another's carry."""

    def memory(self) -> int | None:
        """Bytes in use on the accelerator; None without one."""

    def policy(
        self, observation: Arrays, is_first: np.ndarray, carry: Any, seed: int, mode: bool = False
    ) -> tuple[np.ndarray, Arrays, Any]:
        """One acting step of N environments: [AGT] policy step.

        observation: key -> [N, ...]; is_first: bool [N]. Returns the flat action [N, A], the latents {"deter": [N, D]
        float32, "stoch": [N, S] class indices} and the new carry, which holds the action taken (reset wherever is_first
        is set next time).
        mode: the action is the mode of the actor instead of a sample ([LOOP-71]).
        Nothing in the learner changes: evaluating leaves training as it would have been ([LOOP-18]).
        """

    def train_step(self, batch: Arrays, seed: int) -> tuple[Mapping[str, Any], Arrays]:
        """One gradient step on a replay batch. Returns scalar metrics by name and the latents to write back
        {"deter": [B, T, D], "stoch": [B, T, S] class indices}; both may still be computing when this returns.

        The metric `skipped` is 1 where the update was not made, else 0. The latents of such a step are not to be
        written back ([LOOP-43]).
        """

    def gradients(self, batch: Arrays, seed: int) -> tuple[Mapping[str, float], dict[str, np.ndarray]]:
        """What `train_step` would compute now up to the gradients, with the same noise: metrics and gradients by
        canonical names.

        Changes nothing, and does so after a stop as well.
        """

    def predict(
        self, observation: Arrays, prev_action: np.ndarray, is_first: np.ndarray, context: int, seed: int
    ) -> dict[str, np.ndarray]:
        """The open-loop prediction of recorded sequences: [WM] open-loop prediction. Nothing in the learner changes.

        observation: key -> [B, T, ...], of which `context` steps are seen; prev_action: [B, T, A], the action before
        each observation;
        is_first: bool [B, T]. Returns by observation key [B, T, ...]: numbers in their own units, probabilities of a
        Discrete's classes [B, T, sum of classes], images in [0, 1]; and "reward" and "continue_" [B, T].

        Raises:
          ValueError: a missing key, a wrong shape, or a context that is not within the sequence.
        """

    def state_dict(self) -> dict[str, np.ndarray]:
        """The training state under its canonical names: [AGT-9]."""

    def load_state_dict(self, state: Arrays) -> None:
        """The inverse of `state_dict`.

        Raises:
          ValueError: a missing or unexpected name, or a wrong shape; the message lists them.
        """


def learner_class(backend: str) -> type[Learner]:
    """The `Learner` of the backend `jax` or `torch`. Importing it needs that backend's packages."""
    return importlib.import_module(f"impl_{backend}.learner").Learner
