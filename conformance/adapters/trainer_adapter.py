"""The trainer as a candidate: what `train` runs of the chapters on replay and the training loop.

Nothing is computed here. Functions are those that the modules of the trainer call, looked up there at each call; what
has another form in the trainer has its arguments and its result brought into that of the interface.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from dreamer_spec.envs import vector
from dreamer_spec.training import loop, setup
from dreamer_spec.translation import Entry, Translation
from spec import Spaces, Vector

CALLED_BY = {"ReplayRatio": setup, "can_train": loop, "derive_seed": loop, "step_flags": vector}
"""Function of the interface that the trainer calls as it is -> the module that calls it."""


class TrainerAdapter:
    """Offers the parts of a run that are functions of their arguments.

    What only a running loop shows, such as when it acts and what it saves, is tested in tests/.
    """

    def __getattr__(self, name: str) -> Any:
        if name not in CALLED_BY:
            raise AttributeError(name)
        return getattr(CALLED_BY[name], name)

    def Replay(self, capacity: int, length: int) -> Any:  # noqa: N802
        """Latents in float32, as with `--replay-deter float32`: the checks compare them bit by bit."""
        return setup.Replay(capacity, length, deter_dtype="float32")

    def make_record(
        self,
        observation: Mapping[str, Any],
        reward: float,
        flags: Mapping[str, bool],
        action: Any,
        deter: Any,
        stoch: Any,
    ) -> dict[str, np.ndarray]:
        """The record of one worker: what the environments give, and what is stored of it.

        stoch: one-hot [S, C]; a run gets the latents from its backend as class indices [S] already.
        """
        latents = {"deter": np.asarray(deter)[None], "stoch": np.argmax(stoch, axis=-1)[None]}
        record = loop.stored(vector.observed([observation], [reward], [flags]), np.asarray(action)[None], latents)
        return {key: value[0] for key, value in record.items()}

    def environment_action(
        self, action: Any, spaces: Spaces, low: Mapping[str, Any], high: Mapping[str, Any]
    ) -> dict[str, np.ndarray]:
        """What a task receives whose actions are a Dict of float64 and int64 arrays with these bounds: of each flat
        action [..., A] what `Translation.action` makes of it."""
        entries = {
            key: Entry((key,), (space.size,), "float64", tuple(low[key]), tuple(high[key]))
            if isinstance(space, Vector)
            else Entry((key,), (len(space.classes),), "int64", (0,))
            for key, space in spaces.actions.items()
        }
        translation = Translation(spaces, {}, entries)
        action = np.asarray(action)
        leading = action.shape[:-1]
        received = [translation.action(action[place]) for place in np.ndindex(leading)]
        return {key: np.reshape([one[key] for one in received], (*leading, -1)) for key in spaces.actions}


def make_adapter(dtype: str, device: str | None) -> TrainerAdapter:
    """Raises:
    ValueError: a precision other than float64, or a device other than the CPU: the trainer leaves both to its backend.
    """
    if dtype != "float64" or device not in (None, "cpu"):
        asked = f"--dtype {dtype}" if dtype != "float64" else f"--device {device}"
        raise ValueError(
            f"the trainer has no {asked}: what is checked of it computes in float64 on the CPU, and precision and "
            "device are the backend's; check jax or torch"
        )
    return TrainerAdapter()
