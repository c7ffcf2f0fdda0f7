"""A training state as small as can be, of which nothing may be lost: every step changes each part of it, and what it
becomes depends on all parts and on every bit of the batch."""

import zlib
from collections.abc import Mapping

import numpy as np

Arrays = Mapping[str, np.ndarray]

# The groups of a training state, [AGT-9], by the beginnings of their names.
OPTIMIZER = ("optimizer/second_moment/", "optimizer/momentum/", "optimizer/step")
GROUPS = ("params/", "slow_critic/", *OPTIMIZER, "return_range/")


def fresh_state() -> dict[str, np.ndarray]:
    w = np.arange(6.0, dtype=np.float32).reshape(2, 3).T  # not contiguous
    zeros = {f"optimizer/{name}/w": np.zeros_like(w) for name in ("second_moment", "momentum")}
    return_range = {f"return_range/{end}": np.zeros((), np.float32) for end in ("low", "high")}
    return {"params/w": w, "slow_critic/w": w.copy(), **zeros, "optimizer/step": np.array(0), **return_range}


def next_state(state: Arrays, batch: Arrays, seed: int) -> dict[str, np.ndarray]:
    """The state after an update that has the form of the real ones: [OPT], [BEH]."""
    drawn, loss = np.random.default_rng(seed).random(), digest(batch)
    step = int(state["optimizer/step"]) + 1
    low, high = (
        np.float32(0.9 * state[f"return_range/{end}"] + 0.1 * bound)
        for end, bound in (("low", -loss), ("high", 3 + drawn))
    )
    w, slow = state["params/w"], state["slow_critic/w"]
    gradient = (loss + drawn + 0.1 * (w - slow)) / (1 + high - low)
    second_moment = 0.9 * state["optimizer/second_moment/w"] + 0.1 * gradient**2
    momentum = 0.9 * state["optimizer/momentum/w"] + 0.1 * gradient / (0.1 + np.sqrt(second_moment))
    w = (w - 0.1 * momentum / (1 - 0.9**step)).astype(np.float32)
    return {
        "params/w": w,
        "slow_critic/w": (0.9 * slow + 0.1 * w).astype(np.float32),
        "optimizer/second_moment/w": second_moment.astype(np.float32),
        "optimizer/momentum/w": momentum.astype(np.float32),
        "optimizer/step": np.array(step),
        "return_range/low": low,
        "return_range/high": high,
    }


def digest(arrays: Arrays) -> float:
    """A number in [0, 1) that any other bit of the arrays makes another one."""
    data = b"".join(name.encode() + np.asarray(arrays[name]).tobytes() for name in sorted(arrays))
    return zlib.crc32(data) / 2**32
