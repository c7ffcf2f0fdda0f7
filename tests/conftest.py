"""Fixtures that several files of tests share."""

import gc
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from train_fakes import FakeLearner
from train_runs import SMALL, Make

from dreamer_spec.options import Options, assemble_options
from spec import hyperparameters

QUICK = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"


def pytest_configure(config: pytest.Config) -> None:
    """JAX compiles without optimizations that take longer than the tests' small programs, and each program once for all
    processes of a session. Small products take one thread: several, in several processes, wait for each other."""
    if hasattr(config, "workerinput"):
        return  # of pytest-xdist: it has the environment already
    for library in ("OMP", "MKL", "OPENBLAS"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    folder = tempfile.TemporaryDirectory(prefix="compiled-")
    config.add_cleanup(folder.cleanup)
    os.environ |= {"JAX_COMPILATION_CACHE_DIR": folder.name, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    trial = {**os.environ, "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {QUICK}".strip()}
    if not subprocess.run(
        [sys.executable, "-c", "import jax; jax.devices()"], env=trial, capture_output=True
    ).returncode:
        os.environ |= trial  # a version of XLA that does not know a flag ends the process


@pytest.fixture(scope="module", autouse=True)
def keep_collections_short() -> Iterator[None]:
    """What libraries and caches hold after a file of tests, millions of objects, later collections need not visit."""
    yield
    gc.collect()
    gc.freeze()


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
