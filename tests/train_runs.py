"""Short runs of `train` with the fake learner, for the tests that look into them."""

import os
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from train_fakes import FakeLearner

from dreamer_spec.errors import UserError
from dreamer_spec.monitoring.logger import iterate_metrics
from dreamer_spec.options import Options
from dreamer_spec.training import loop, setup

SMALL = {
    "deter": 8,
    "units": 4,
    "stoch": 2,
    "classes": 2,
    "batch_size": 2,
    "batch_length": 3,
    "envs": 2,
    "replay_capacity": 500,
}
BATCH_STEPS = SMALL["batch_size"] * SMALL["batch_length"]

Make = Callable[..., Options]


def run_quietly(options: Options, learner: type[FakeLearner] = FakeLearner) -> Any:
    """The state of a run after its loop."""
    with ExitStack() as stack:
        state = setup.prepare(options, learner, stack)
        loop.train(state)
        return state


def batches() -> list[dict[str, np.ndarray]]:
    return [entry for kind, entry in FakeLearner.diary if kind == "train"]


def logged(logdir: Path) -> list[dict[str, float]]:
    """The lines of its metrics, none of which is damaged."""
    lines = list(iterate_metrics(logdir / "metrics.jsonl"))
    assert None not in lines
    return [line for line in lines if line]


def stored(state: Any) -> list[dict[str, np.ndarray]]:
    """The records of each stream of a replay buffer, in order."""
    saved = state.replay.replay.state_dict()
    keys = [name for name in saved if name.startswith("records/")]
    ends = np.cumsum(saved["streams"][:, 2])
    parts = [slice(end - count, end) for end, count in zip(ends, saved["streams"][:, 2], strict=True)]
    return [{name.removeprefix("records/"): saved[name][part] for name in keys} for part in parts]


def content(directory: Path) -> dict[str, Any]:
    """Every file, link and folder below a directory, with what is in it. The lock is left out: it is empty."""
    found = {}
    for path in sorted(directory.rglob("*")):
        what = os.readlink(path) if path.is_symlink() else path.read_bytes() if path.is_file() else None
        found[str(path.relative_to(directory))] = what
    found.pop(".lock", None)
    return found


def refused(options: Any) -> str:
    """The error of a run that changes nothing in its log directory."""
    before = content(options.logdir)
    with pytest.raises(UserError) as error:
        loop.run(options, FakeLearner)
    assert content(options.logdir) == before
    return str(error.value)
