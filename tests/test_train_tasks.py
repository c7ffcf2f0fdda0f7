"""What tasks take: arguments, time limits; and every task of DeepMind's suite, with its renderers."""

import ctypes.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from spec import Discrete
from train.envs import make_env
from train.errors import UserError

ROOT = Path(__file__).resolve().parent.parent
F4 = np.float32


@pytest.mark.parametrize("task", ["train_fakes:Counting", "gym:FrozenLake-v1", "dmc:cartpole-balance"])
def test_arguments_that_nobody_takes_are_named(task: str) -> None:
    if task.startswith("dmc"):
        pytest.importorskip("dm_control")
    with pytest.raises(UserError, match=r"does not take these arguments \(--env-arg wings=2\)"):
        make_env(task, env_args={"wings": 2})


def test_arguments_reach_the_environment() -> None:
    pytest.importorskip("dm_control")
    assert make_env("gym:FrozenLake-v1", env_args={"map_name": "8x8"}).spaces.observations == {"observation": Discrete((64,))}
    env = make_env("dmc:cartpole-balance", env_args={"time_limit": 0.1})
    env.reset(seed=0)
    assert [env.step(F4([0]))[3] for _ in range(10)] == [False] * 9 + [True]


@pytest.mark.parametrize(
    ("task", "action", "action_repeat", "steps"),
    [
        ("gym:MountainCar-v0", [0, 1, 0], 1, 250),  # longer than the registered limit of 200
        ("gym:MountainCar-v0", [0, 1, 0], 4, 63),
        ("train_fakes:Endless", [0, 0], 1, 250),
        ("train_fakes:Endless", [0, 0], 3, 84),
    ],
)
@pytest.mark.covers("LOOP-28")
def test_a_time_limit_counts_frames_whatever_the_task(task: str, action: list[float], action_repeat: int, steps: int) -> None:
    env = make_env(task, action_repeat=action_repeat, time_limit=250)
    env.reset(seed=0)
    ends = [env.step(F4(action))[2:4] for _ in range(steps)]
    assert ends == [(False, False)] * (steps - 1) + [(False, True)]


# DeepMind's suite

STEPPED = """
import sys
import numpy as np
from train.envs import make_env
for task in sys.argv[1:]:
    env, rng = make_env(f"dmc:{task}"), np.random.default_rng(0)
    env.reset(seed=0)
    total = 0.0
    for _ in range(30):
        _, reward, *_ = env.step(rng.uniform(-1, 1, env.spaces.action_size).astype(np.float32))
        total += reward
    env.reset()
    env.close()
    assert -1 <= total <= 31, (task, total)
    print(task)
"""


def step_all(tasks: list[str]) -> None:
    """In a process that has not chosen a renderer yet."""
    environment = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "DISPLAY")}
    done = subprocess.run([sys.executable, "-c", STEPPED, *tasks], cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.split() == tasks, done.stderr


@pytest.mark.covers("LOOP-58")
def test_every_task_of_the_suite() -> None:
    """Returns of 30 random steps are sane: rewards lie in [0, 1], but for the costs of lqr."""
    suite = pytest.importorskip("dm_control.suite")
    tasks = ["-".join(task) for task in suite.ALL_TASKS]
    assert "lqr-lqr_2_1" in tasks
    assert len(tasks) >= 50
    step_all([task for task in tasks if task != "quadruped-escape"])


@pytest.mark.skipif(not ctypes.util.find_library("EGL"), reason="needs EGL")
def test_a_task_that_renders_from_vectors_too() -> None:
    pytest.importorskip("dm_control")
    step_all(["quadruped-escape"])


@pytest.mark.parametrize("renderer", ["disabled", "glfw", "no_such_library"])
@pytest.mark.parametrize("task", ["dmc_vision:cartpole-balance", "dmc:quadruped-escape"])
def test_a_renderer_that_does_not_work_is_named(task: str, renderer: str, tmp_path: Path) -> None:
    pytest.importorskip("dm_control")
    environment = {name: value for name, value in os.environ.items() if name != "DISPLAY"} | {"MUJOCO_GL": renderer}
    command = [sys.executable, "-m", "train", "--backend", "torch", "--task", task, "--logdir", str(tmp_path / "run"), "--processes", "no"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"train: error: task {task} needs to render, and with MUJOCO_GL set to {renderer} dm_control cannot")
    assert "set MUJOCO_GL to egl" in last
    assert "Traceback" not in done.stderr
