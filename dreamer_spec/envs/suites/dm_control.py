"""DeepMind Control Suite as Gymnasium environments.

Why not through Shimmy: its module imports interactive viewers and their packages, and a suite task needs only the lines
below.
"""

import importlib
import math
import os
import sys
from typing import Any

import dm_env
import gymnasium
import numpy as np
from gymnasium import spaces as gym

from dreamer_spec.envs.suites import Play
from dreamer_spec.errors import UserError

CAMERAS = {"quadruped": 2}  # D-109; camera 0 elsewhere
GLFW = ("glfw", "on", "enable", "enabled", "true", "1")  # its names as values of MUJOCO_GL


def make(play: Play) -> gymnasium.Env[Any, Any]:
    """A task DOMAIN-TASK, from vectors or, as `dmc_vision`, from images only.

    Raises:
      UserError: no such task, or this machine cannot render.
    """
    vision = play.suite == "dmc_vision"
    renders = play.render or vision
    suite = _import_suite(play.task, renders)
    domain, _, name = play.name.partition("-")
    domain = {"cup": "ball_in_cup"}.get(domain, domain)
    if (domain, name) not in suite.ALL_TASKS:
        known = ", ".join(sorted("-".join(entry) for entry in suite.ALL_TASKS if domain in ("", entry[0])))
        remedy = (
            f"known: {known}"
            if known
            else f"known domains: {', '.join(sorted({entry[0] for entry in suite.ALL_TASKS}))}"
        )
        raise UserError(f"unknown task {play.task!r}; {remedy}")
    env = suite.load(domain, name, task_kwargs={"time_limit": math.inf} if play.time_limit else None)
    if renders:
        _require_rendering(play.task, env.physics)
    else:
        _never_render(env.physics)
    return DmControlEnv(env, play, CAMERAS.get(domain, 0), "rgb_array" if renders else None)


class DmControlEnv(gymnasium.Env[Any, np.ndarray]):
    """A task of the suite. A time limit truncates: the suite keeps the discount at 1 there. What is repeated is not
    rendered: [LOOP-27]."""

    def __init__(self, env: Any, play: Play, camera: int, render_mode: str | None) -> None:
        self._env = env
        self.render_mode = render_mode
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 1 / env.control_timestep() / play.action_repeat}
        self._play, self._camera, self._frames = play, camera, 0
        self._sees = play.suite == "dmc_vision"
        if self._sees:
            self.observation_space = gym.Dict(
                {"image": gym.Box(0, 255, (play.image_size, play.image_size, 3), np.uint8)}
            )
        else:
            self.observation_space = gym.Dict({key: _unbounded(spec) for key, spec in env.observation_spec().items()})
        action = env.action_spec()
        low, high = (
            np.broadcast_to(bound, action.shape).astype(np.float64) for bound in (action.minimum, action.maximum)
        )
        self.action_space = gym.Box(low, high, dtype=np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            self._env.task.random.seed(seed)
        self._frames = 0
        return self._observation(self._env.reset()), {}

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        total = 0.0
        for _ in range(self._play.action_repeat):
            step = self._env.step(action)
            self._frames += 1
            total += step.reward
            terminated, truncated = step.last() and step.discount == 0, step.last() and step.discount != 0
            truncated = not terminated and (truncated or self._frames == self._play.time_limit)
            if terminated or truncated:
                break
        return self._observation(step), total, terminated, truncated, {}

    def _observation(self, step: dm_env.TimeStep) -> dict[str, np.ndarray]:
        if not self._sees:
            return step.observation
        size = self._play.image_size
        return {"image": self._env.physics.render(size, size, camera_id=self._camera)}

    def render(self) -> np.ndarray:
        return self._env.physics.render(240, 320, camera_id=self._camera)

    def close(self) -> None:
        self._env.close()


def _unbounded(spec: Any) -> gym.Box:
    return gym.Box(-np.inf, np.inf, spec.shape, np.float64)


# Rendering


def _import_suite(task: str, renders: bool) -> Any:
    """dm_control chooses what renders when it is imported. MUJOCO_GL, where the user has set it, decides. Otherwise EGL
    renders where there is no display, and nothing where nothing has to."""
    on_linux, has_display = (
        sys.platform == "linux",
        bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")),
    )
    if (
        renders and on_linux and not has_display and os.environ.get("MUJOCO_GL") in GLFW
    ):  # Trying it may end the process.
        raise _cannot_render(task, "GLFW needs a display, and DISPLAY is not set", renders)
    if not os.environ.get("MUJOCO_GL") and (not renders or (on_linux and not has_display)):
        os.environ["MUJOCO_GL"] = "egl" if renders else "disabled"
    try:
        return importlib.import_module("dm_control.suite")
    except ModuleNotFoundError:
        raise  # A package, which `dreamer_spec.envs.suites` says how to install.
    except (
        ImportError,
        AttributeError,
        RuntimeError,
    ) as error:  # What a wrong name or a missing graphics library looks like.
        raise _cannot_render(task, error, renders) from error


def _require_rendering(task: str, physics: Any) -> None:
    try:
        physics.render(8, 8)
    except Exception as error:  # Each library has its own, and MuJoCo one for all of them.
        raise _cannot_render(task, error, True) from error


def _never_render(physics: Any) -> None:
    """At each reset quadruped-escape uploads its terrain to the graphics library, "if we have a rendering context"; but
    asking for one makes one. Without it a reset takes a third of the time and half of the memory, and needs no graphics
    library."""
    kind = type(physics)
    physics.__class__ = type(kind.__name__, (kind,), {"contexts": None})


def _cannot_render(task: str, reason: object, renders: bool) -> UserError:
    value = os.environ.get("MUJOCO_GL", "")
    remedy = "set it to egl (Debian: libegl1 libgl1 libgl1-mesa-dri) or osmesa (libosmesa6)"
    unset = "" if renders else ", or unset it: nothing is rendered"
    return UserError(f"task {task}: dm_control cannot render with MUJOCO_GL={value!r} ({reason}); {remedy}{unset}")
