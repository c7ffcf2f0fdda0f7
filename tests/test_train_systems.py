"""The command where the system is not Linux, as far as one can pretend: tests/other_system.py says how far."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent

RUN = """
import other_system
import sys
from train_fakes import FakeLearner
import dreamer_spec.training.setup
from dreamer_spec.cli import main

dreamer_spec.training.setup.learner_class = lambda backend: FakeLearner
sys.exit(main(sys.argv[1:]))
"""

OPTIONS = (
    "--backend torch --task train_fakes:Maze --size tiny --deter 8 --units 4 --stoch 2 --classes 2 "
    "--batch-size 2 --batch-length 3"
)
OPTIONS += (
    " --envs 2 --image-size 16 --no-preflight --processes no --eval-every 0 --eval-episodes 1 --random-episodes 1"
)


def command(folder: Path, *words: str) -> str:
    """What the command says on a system without what Linux has."""
    environment = os.environ | {"PYTHONPATH": f"{HERE}{os.pathsep}{HERE.parent}", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", RUN, *words], cwd=folder, env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout


@pytest.mark.parametrize("name", ["", "eval", "export", "report", "resume", "inspect"])
def test_help(name: str, tmp_path: Path) -> None:
    assert "usage: train" in command(tmp_path, *([name] if name else []), "--help")


def test_a_run_goes_on_and_is_looked_at(tmp_path: Path) -> None:
    first = command(tmp_path, *OPTIONS.split(), "--steps", "80", "--logdir", "run", "--checkpoint-every", "0")
    assert "80 steps" in first
    second = command(tmp_path, "resume", "run", "--steps", "160", "--task", "train_fakes:Maze")
    assert "160 steps" in second
    assert "cannot be restored" not in second
    command(tmp_path, "report", "run")
    assert (tmp_path / "report.html").stat().st_size > 1000


def test_what_is_hidden_is_hidden(tmp_path: Path) -> None:
    """Or the tests above would show nothing."""
    probe = (
        "import other_system, os, signal, sys\nassert not hasattr(os, 'pread') and not "
        "hasattr(signal, 'SIGHUP')\nimport fcntl"
    )
    environment = os.environ | {"PYTHONPATH": str(HERE)}
    done = subprocess.run(
        [sys.executable, "-c", probe], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600
    )
    assert "No module named 'fcntl'" in done.stderr
