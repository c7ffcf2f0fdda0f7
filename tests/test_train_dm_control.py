"""The DeepMind Control Suite: every task acts from vectors without a graphics library, and what MUJOCO_GL says is used
or named."""

import json
import os
import subprocess
import sys
from typing import Any

import pytest

from spec import Image, Spaces

pytest.importorskip("dm_control")

STEPS = """
import json, sys
import numpy as np
from dreamer_spec.envs import make_env, random_actions
from dreamer_spec.errors import UserError

for task in sys.argv[1:] or [f"dmc:{domain}-{name}" for domain, name in __import__("dm_control.suite").suite.ALL_TASKS]:
    try:
        env = make_env(task, image_size=16)
        record = env.reset(seed=0)[0]
        rewards = []
        for action in random_actions(env.spaces, np.random.default_rng(0), 30):
            record, reward, terminated, truncated, _ = env.step(action)
            rewards.append(reward)
        shapes = {key: list(value.shape) for key, value in record.items()}
        facts = {"spaces": env.spaces.to_json(), "shapes": shapes, "rewards": rewards, "end": terminated or truncated}
        print(json.dumps({"task": task, **facts}))
        env.close()
    except UserError as error:
        print(json.dumps({"task": task, "error": str(error)}))
"""


def stepped(*tasks: str, **environment: str) -> list[dict[str, Any]]:
    """What becomes of the tasks, all if none is named, in a process of their own: what renders is chosen once in a
    process."""
    unset = {"MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM"}
    variables = {name: value for name, value in os.environ.items() if name not in unset} | environment
    result = subprocess.run(
        [sys.executable, "-c", STEPS, *tasks], env=variables, capture_output=True, text=True, timeout=600
    )
    assert result.returncode == 0, result.stderr
    return [json.loads(line) for line in result.stdout.splitlines()]


@pytest.mark.covers("LOOP-58")
def test_every_task_of_the_suite_steps_without_a_graphics_library() -> None:
    """quadruped-escape included, which would upload its terrain to one."""
    results = stepped(MUJOCO_GL="disabled")
    assert len({result["task"] for result in results}) > 50
    for result in results:
        assert "error" not in result, result
        spaces = Spaces.from_json(result["spaces"])
        assert {key: list(space.array_shape) for key, space in spaces.observations.items()} == result["shapes"]
        assert -1 <= sum(result["rewards"]) <= 31, result  # rewards lie in [0, 1], but for the costs of lqr
        assert not result["end"], result
        assert len(result["rewards"]) == 30


@pytest.mark.parametrize("task", ["dmc:quadruped-escape", "dmc:lqr-lqr_2_1", "dmc:humanoid-stand"])
def test_tasks_from_vectors_need_no_setting(task: str) -> None:
    (result,) = stepped(task)
    assert len(result["rewards"]) == 30


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("glfw", "DISPLAY is not set"),
        ("disabled", "No OpenGL"),
        ("nonsense", "must be one of"),
        ("on", "DISPLAY is not set"),
    ],
)
def test_what_cannot_render_is_a_line(value: str, reason: str) -> None:
    (result,) = stepped("dmc_vision:cartpole-balance", MUJOCO_GL=value)
    for words in ("dmc_vision:cartpole-balance", f"MUJOCO_GL={value!r}", reason, "set it to egl", "osmesa"):
        assert words in result["error"]


def test_a_value_that_dm_control_does_not_know_is_a_line_from_vectors_too() -> None:
    (result,) = stepped("dmc:cartpole-balance", MUJOCO_GL="nonsense")
    assert "MUJOCO_GL='nonsense'" in result["error"]
    assert "or unset it" in result["error"]


def test_a_value_that_mujoco_does_not_know_is_a_line() -> None:
    (result,) = stepped("gym:HalfCheetah-v5", MUJOCO_GL="nonsense")
    for words in ("gym:HalfCheetah-v5", "MUJOCO_GL", "nonsense", "set it to egl"):
        assert words in result["error"]


def test_images_without_a_display() -> None:
    (result,) = stepped("dmc_vision:quadruped-escape")
    if "error" in result:
        assert "MUJOCO_GL='egl'" in result["error"]
        pytest.skip(result["error"])
    assert Spaces.from_json(result["spaces"]).observations == {"image": Image(16, 16, 3)}
    assert result["shapes"] == {"image": [16, 16, 3]}
