"""Records as in spec/00-notation.md of N workers side by side: what the environments gave, and what the policy adds."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Record = dict[str, np.ndarray]


def observed(
    observations: Sequence[Mapping[str, np.ndarray]], rewards: Sequence[float], flags: Sequence[Mapping[str, bool]]
) -> Record:
    """What came from the environments, [N, ...] each and in memory of its own. [LOOP-9], [LOOP-10], [CON-10]

    observations: key -> array, of each worker; the result has the keys in sorted order, as `Spaces` has them.
    rewards: what arrived with the observations; count as 0 at is_first. flags: `step_flags` of each worker.
    """
    return {
        **{key: np.stack([observation[key] for observation in observations]) for key in sorted(observations[0])},
        "reward": np.array(
            [0.0 if flag["is_first"] else reward for reward, flag in zip(rewards, flags, strict=True)], np.float32
        ),
        **{key: np.array([flag[key] for flag in flags], bool) for key in ("is_first", "is_last", "is_terminal")},
    }


def stored(record: Record, action: np.ndarray, latents: Mapping[str, Any]) -> Record:
    """What the buffer gets of the records of one policy step, [N, ...] each. [LOOP-3], [LOOP-9], [CON-9]

    record: of `observed`; shared with the result. action: flat actions [N, A] of the policy, copied; stored as zeros at
    is_last, where nothing can be done.
    latents: "deter" [N, D] and "stoch" [N, S] class indices, which the policy computed for these observations; copied.
    """
    return {
        **record,
        "action": np.where(record["is_last"][:, None], np.float32(0), np.asarray(action, np.float32)),
        "deter": np.array(latents["deter"], np.float32),
        "stoch": np.array(latents["stoch"]),
    }
