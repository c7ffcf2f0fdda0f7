"""What `run` of an adapter is given: environments, a learner and options."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from spec import Config, Spaces

Arrays = Mapping[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class RunOptions:
    """What a training run shall be.

    spaces: of the environments. config: `envs` workers, `replay_ratio`, `replay_capacity`, `batch_size` and
    `batch_length` are those of the run; the rest is the learner's. seed: of all randomness of the run [LOOP-24].
    steps: the budget, in records of all workers together, whatever the action repeat [LOOP-5]. directory: of the run,
    empty or absent at its start. What lies there when a run has ended is all that is needed to continue it: a call with
    the directory of an earlier one and more `steps` goes on from its last step [LOOP-23].
    evaluate_every: records between evaluations, 0 for none at all, not even at the end. evaluation_episodes: whole
    episodes of one evaluation. shared_environment: they are played in the environment of training, of which there is
    one [LOOP-66].
    random_episodes: whole episodes of a policy that ignores what it sees, played before the first policy step.
    nonfinite: "stop" or "skip", what follows a train step that was skipped because a number was not finite [LOOP-41],
    [LOOP-42]. begin_with: the directory of another run, whose parameters a new one begins with [LOOP-72].
    """

    spaces: Spaces
    config: Config
    seed: int
    steps: int
    directory: Path
    action_repeat: int = 1
    evaluate_every: int = 0
    evaluation_episodes: int = 0
    shared_environment: bool = False
    random_episodes: int = 0
    nonfinite: str = "stop"
    begin_with: Path | None = None


class RunEnvironment(Protocol):
    """An environment as Gymnasium has them, but for its spaces.

    low, high: bounds [size] of every Vector action; infinite where there is none.
    """

    spaces: Spaces
    low: Arrays
    high: Arrays

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Arrays, Mapping[str, Any]]:
        """Observation and info. The arrays are overwritten by the next call."""

    def step(self, action: Arrays) -> tuple[Arrays, float, bool, bool, Mapping[str, Any]]:
        """Observation, reward, terminated, truncated and info. action: key -> [size], in the environment's own units:
        numbers of a Vector, indices of a Discrete [LOOP-12]."""

    def close(self) -> None: ...


class RunLearner(Protocol):
    """An agent and its optimizer: what `conformance.adapter.Learner` has, and a carry that can be saved.

    Seeds are those of [LOOP-26]. Nothing but `train_step` and `load_state_dict` changes a learner.
    """

    def state_dict(self) -> Arrays:
        """The training state under its canonical names [AGT-9]."""

    def load_state_dict(self, state: Arrays) -> None:
        """Takes over a training state."""

    def train_step(self, batch: Arrays, seed: int) -> tuple[Arrays, Arrays]:
        """One update with a batch of [REP-14]. Returns metrics and the latents {"deter" [B, T, D], "stoch" [B, T, S]
        class indices}. Of the metrics, "skipped" is 1 where the update was not made, because "loss/total" or
        "gradient_norm" is not finite, and else 0 [LOOP-40]."""

    def initial_carry(self, envs: int) -> Any:
        """The carry of environments before their first step; opaque."""

    def save_carry(self, carry: Any) -> Arrays:
        """A carry as arrays."""

    def load_carry(self, arrays: Arrays) -> Any:
        """The inverse of `save_carry`."""

    def policy(
        self, observation: Arrays, is_first: np.ndarray, carry: Any, seed: int
    ) -> tuple[np.ndarray, Arrays, Any]:
        """One acting step of N environments: action [N, A], latents {"deter" [N, D], "stoch" [N, S]}, carry. The carry
        holds the action too; rows with `is_first` begin anew."""
