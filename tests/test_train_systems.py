"""What `train` does on systems that lack calls of POSIX."""

import subprocess
import sys
from pathlib import Path

import pytest
from train_agents import save_checkpoint

from spec import Discrete, Spaces, Vector, load_config
from train.cli import main

ROOT = Path(__file__).resolve().parent.parent
WITHOUT_POSIX = """
import os, signal, socket, sys
for module in ("fcntl", "resource", "termios", "pwd", "grp"):
    sys.modules[module] = None
for module, names in (
    (signal, ("SIGHUP", "SIGKILL", "SIGQUIT", "SIGALRM", "SIGUSR1", "alarm", "setitimer", "pthread_sigmask")),
    (os, ("sysconf", "getuid", "fork", "killpg", "getpgid", "setsid", "pwrite", "pread", "posix_fallocate", "getloadavg",
          "sched_getaffinity", "mkfifo", "statvfs")),
    (socket, ("AF_UNIX",)),
):
    for name in names:
        delattr(module, name)
from train.cli import main
for line in sys.argv[1:]:
    assert main(line.split()) == 0, line
"""
POLICY = """
import numpy as np
from train.policy import Policy
policy = Policy.load("policy")
policy.reset(1)
action = policy(policy.observation([np.zeros(4, np.float32)]), [True])
assert policy.environment_action(action)[0] in (0, 1)
"""


def test_windows_trains_in_wsl_only_and_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    assert main(["--backend", "jax", "--logdir", str(tmp_path / "run")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("train: error: training does not run on Windows")
    assert "WSL 2" in line
    assert not (tmp_path / "run").exists()


def test_what_needs_no_buffer_runs_without_posix(tmp_path: Path) -> None:
    config = load_config("paper", "tiny", compute_dtype="float32", deter=16, units=8, stoch=3, classes=5, bins=31, envs=2)
    save_checkpoint(tmp_path / "run", config, Spaces({"observation": Vector(4)}, {"action": Discrete((2,))}), task="gym:CartPole-v1")
    lines = ["eval run --episodes 1 --backend torch", "export run policy", "inspect run/checkpoints/000000001000"]
    subprocess.run(
        [sys.executable, "-c", WITHOUT_POSIX + POLICY, *lines], check=True, cwd=tmp_path, env={"PYTHONPATH": str(ROOT), "PATH": ""}
    )


WITHOUT_PILLOW = """
import sys
sys.modules["PIL"] = None
import gymnasium
import numpy as np
from train.envs import ContractEnv

class Camera(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0, 255, (120, 160, 3), np.uint8)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        return np.full((120, 160, 3), 9, np.uint8), {}

observation, _ = ContractEnv(Camera(), "camera").reset()
assert observation["observation"].shape == (64, 64, 3) and (observation["observation"] == 9).all()
"""


def test_environments_need_gymnasium_and_numpy_only() -> None:
    subprocess.run([sys.executable, "-c", WITHOUT_PILLOW], check=True, env={"PYTHONPATH": str(ROOT), "PATH": ""})
