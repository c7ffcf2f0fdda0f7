"""What a training loop must decide exactly: when to train, what to store, what the environment gets, and every seed.

Chapter: spec/12-training-loop.md. Paper: sections Implementation (Experience replay) and Critic learning (sampling of
actions).
"""

import hashlib
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reference_numpy.shapes import checked
from spec.config import Config
from spec.spaces import Discrete, Spaces


class ReplayRatio:
    """Counts how many train steps are due. Implements [LOOP-14] to [LOOP-16]; paper: Experience replay.

    Args:
      replay_ratio: time steps trained on for each environment step.
      batch_steps: time steps in a batch, batch_size * batch_length.

    Raises:
      ValueError: a negative ratio or no time steps.
    """

    def __init__(self, replay_ratio: float, batch_steps: int) -> None:
        if not 0 <= replay_ratio < float("inf") or batch_steps < 1:
            raise ValueError(f"expected replay_ratio >= 0 and batch_steps >= 1, got {replay_ratio} and {batch_steps}")
        self._ratio = Fraction(replay_ratio)  # exact, so that nothing drifts in a long run
        self._batch_steps = batch_steps
        self._step: int | None = None
        self._credit = Fraction(0)  # time steps that are owed

    def __call__(self, step: int) -> int:
        """Train steps to make now, at this environment step. Implements [LOOP-14], [LOOP-16].

        Raises:
          ValueError: the step is smaller than the one before.
        """
        if self._step is not None and step < self._step:
            raise ValueError(f"environment steps cannot go back: got {step} after {self._step}")
        if self._ratio == 0:
            if self._step is not None:
                self._step = step  # another ratio later does not pay for these steps
            return 0
        if self._step is None:
            self._step = step
            return 1
        self._credit += (step - self._step) * self._ratio
        self._step = step
        due = self._credit // self._batch_steps
        self._credit -= due * self._batch_steps
        return due

    def state_dict(self) -> dict[str, Any]:
        """The state in plain JSON types. Implements [LOOP-21]."""
        return {"step": self._step, "credit": str(self._credit)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on from a saved state, with the ratio of this object. Implements [LOOP-23]."""
        self._step = None if state["step"] is None else int(state["step"])
        self._credit = Fraction(state["credit"])


def can_train(items: int, config: Config) -> bool:
    """Whether the buffer holds enough sequences to train. Implements [LOOP-13].

    Args:
      items: number of start positions, `len(replay)`.

    Raises:
      ValueError: the buffer can never hold enough.
    """
    needed = config.batch_size * config.batch_length
    if config.replay_capacity < needed:
        raise ValueError(
            f"replay_capacity is {config.replay_capacity}; training starts at "
            f"batch_size * batch_length = {needed} items"
        )
    return items >= needed


def step_flags(reset: bool, terminated: bool, truncated: bool) -> dict[str, bool]:
    """The flags of an observation. Implements [LOOP-7], [LOOP-10], [CON-11].

    Args:
      reset: the observation came from a reset; then the other two do not matter.
      terminated, truncated: what the environment said with the observation.
    """
    ended, terminal = bool(terminated or truncated), bool(terminated)
    return {"is_first": bool(reset), "is_last": ended and not reset, "is_terminal": terminal and not reset}


def make_record(
    observation: Mapping[str, Any], reward: float, flags: Mapping[str, bool], action: Any, deter: Any, stoch: Any
) -> dict[str, NDArray[Any]]:
    """The record of one time step of one worker. Implements [LOOP-3], [LOOP-9], [CON-9], [CON-10].

    Args:
      observation: key -> array, without batch axis.
      reward: what arrived with the observation; counts as 0 at is_first.
      flags: is_first, is_last, is_terminal.
      action: flat action [A] of the policy step for this observation; stored as zeros at is_last.
      deter, stoch: latents [D] and one-hot [S, C] that the policy step computed for this observation.

    Raises:
      ValueError: the action, deter or stoch has a wrong number of axes.
    """
    action, deter = checked("action", action, "A"), checked("deter", deter, "D")
    stoch = checked("stoch", stoch, "S", "C")
    return {
        **{key: np.array(value) for key, value in observation.items()},
        **{name: np.array(flags[name], np.bool_) for name in ("is_first", "is_last", "is_terminal")},
        "reward": np.array(0.0 if flags["is_first"] else reward, np.float32),
        "action": np.array(np.zeros_like(action) if flags["is_last"] else action, np.float32),
        "deter": np.array(deter, np.float32),
        "stoch": np.argmax(stoch, axis=-1).astype(np.int32),
    }


def environment_action(
    action: Any, spaces: Spaces, low: Mapping[str, Any], high: Mapping[str, Any]
) -> dict[str, NDArray[Any]]:
    """What the environment receives for a flat action. Implements [LOOP-12], [CON-27].

    Args:
      action: [..., A].
      low, high: key -> bounds [size] of every Vector action, in the environment's units; may be infinite.

    Returns:
      Key -> [..., size] for a Vector, [..., len(classes)] int64 for a Discrete.

    Raises:
      ValueError: a wrong shape or a number that is not finite.
    """
    action = checked("action", action, ..., spaces.action_size)
    if not np.all(np.isfinite(action)):
        raise ValueError("the flat action holds numbers that are not finite: the parameters are probably broken")
    result: dict[str, NDArray[Any]] = {}
    start = 0
    for key, space in spaces.actions.items():
        part = action[..., start : start + space.encoded_size]
        start += space.encoded_size
        if isinstance(space, Discrete):
            choices = np.split(part, np.cumsum(space.classes)[:-1], axis=-1)
            result[key] = np.stack([np.argmax(choice, axis=-1) for choice in choices], axis=-1)
        else:
            result[key] = _rescale(
                part, checked(f"low[{key!r}]", low[key], space.size), checked(f"high[{key!r}]", high[key], space.size)
            )
    return result


def _rescale(part: NDArray[Any], low: NDArray[Any], high: NDArray[Any]) -> NDArray[Any]:
    """[-1, 1] to the range of each dimension: between its bounds, 2 wide at the only one, as it is without any."""
    clipped = np.clip(part, -1.0, 1.0)
    below, above = np.isfinite(low), np.isfinite(high)
    with np.errstate(invalid="ignore"):  # Not taken where it is infinite.
        lowest, highest = np.where(below, low, high - 2.0), np.where(above, high, low + 2.0)
        rescaled = np.clip(lowest + (clipped + 1.0) / 2.0 * (highest - lowest), lowest, highest)
    bounded: NDArray[Any] = np.where(below | above, rescaled, clipped)
    return bounded


def derive_seed(seed: int, purpose: str, index: int = 0) -> int:
    """A seed of its own for one use of randomness in a run. Implements [LOOP-24] to [LOOP-26].

    Returns:
      A number in [0, 2**31).
    """
    digest = hashlib.sha256(f"{seed}/{purpose}/{index}".encode("ascii")).digest()
    return int.from_bytes(digest[:4], "big") % 2**31
