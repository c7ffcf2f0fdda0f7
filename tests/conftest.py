"""Fixtures that several files of tests share."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache
from train_fakes import FakeLearner
from train_runs import SMALL, Make

from dreamer_spec.options import Options, assemble_options
from spec import hyperparameters


@pytest.fixture(autouse=True)
def forget_modules(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Tests write modules of the same names: what one has imported, the next must not find."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(tmp_path_factory.getbasetemp())):
            del sys.modules[name]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    FakeLearner.diary.clear()

    def options(**given: Any) -> Options:
        overrides = {**SMALL, **{name: given.pop(name) for name in list(given) if name in hyperparameters()}}
        plain = {
            "task": "train_fakes:Counting",
            "steps": 60,
            "logdir": tmp_path / "run",
            "preflight": False,
            "log_every": 0.0,
        }
        plain["replay_deter"] = "float32"  # Latents say which call made them.
        return assemble_options(
            "jax", {**plain, "eval_every": 0, "eval_episodes": 0, "random_episodes": 0, **given}, overrides
        )

    yield options
    FakeLearner.loss = 1.0


@pytest.fixture(scope="module")
def compile_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """JAX learners with the same configuration compile the same programs, whatever their seed: once in a file of
    tests."""
    settings = {
        "jax_compilation_cache_dir": str(tmp_path_factory.mktemp("compiled")),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
    }
    before = {name: getattr(jax.config, name) for name in settings}
    for values in (settings, before):
        for name, value in values.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()
        if values is settings:
            yield
