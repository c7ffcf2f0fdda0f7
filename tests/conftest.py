"""Fixtures that several files of tests share."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from train_fakes import FakeLearner
from train_runs import SMALL, Make

from train.options import Options, make_options


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    FakeLearner.diary.clear()

    def options(**given: Any) -> Options:
        overrides = {
            **SMALL,
            **{name: given.pop(name) for name in list(given) if name in SMALL or name in ("replay_ratio", "learning_rate")},
        }
        plain = {"task": "train_fakes:Counting", "steps": 60, "logdir": tmp_path / "run", "preflight": False, "log_every": 0.0}
        plain["replay_deter"] = "float32"  # Latents say which call made them.
        return make_options("jax", {**plain, "eval_every": 0, "eval_episodes": 0, "random_episodes": 0, **given}, overrides)

    yield options
    FakeLearner.loss = 1.0
