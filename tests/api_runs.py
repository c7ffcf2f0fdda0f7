"""Short runs from Python with the fake learner, and scripts of users, for the tests of dreamer_spec/api.py."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from train_fakes import Counting
from train_runs import SMALL

from dreamer_spec import Options, make_options

ROOT = Path(__file__).resolve().parent.parent
PATHS = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
SHORT: dict[str, Any] = {
    **SMALL,
    "steps": 60,
    "log_every": 0,
    "eval_every": 0,
    "eval_episodes": 1,
    "random_episodes": 0,
    "preflight": False,
}


def options(**given: Any) -> Options:
    return make_options(**{"backend": "jax", "task": Counting, "processes": "no", **SHORT, **given})


def script(folder: Path, code: str, *, name: str = "train.py", environment: dict[str, str] | None = None) -> Any:
    """A process that runs a script of a user's, who has installed the package."""
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(code, encoding="utf-8")
    return subprocess.Popen(
        [sys.executable, name],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": PATHS, "OMP_NUM_THREADS": "1", **(environment or {})},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


# What a script begins with that trains the fake learner.
FAKED = f"""
import dreamer_spec.training.setup
from dreamer_spec import make_options, train
from train_fakes import Counting, FakeLearner, Sleepy

dreamer_spec.training.setup.learner_class = lambda backend: FakeLearner
SHORT = {SHORT!r}
"""
