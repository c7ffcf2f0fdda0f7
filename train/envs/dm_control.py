"""DeepMind Control Suite as Gymnasium environments.

Why not through Shimmy: its module imports interactive viewers and their packages, and a suite task needs only the lines below.
"""

import os
import sys
import warnings
from typing import Any

import dm_env
import gymnasium
import numpy as np
from gymnasium import spaces as gym

from train.errors import UserError

CAMERAS = {"quadruped": 2}  # D-109; camera 0 elsewhere
RENDER = ("quadruped-escape",)  # from vectors too: its terrain is drawn anew, and uploaded to the renderer, for every episode

GLFW = (
    "",
    "glfw",
    "on",
    "1",
    "enable",
    "enabled",
    "true",
)  # what MUJOCO_GL may say for it; unset, dm_control takes it where it is installed


def choose_renderer(renders: bool) -> None:
    """Before dm_control is imported: without a display, render through EGL, or not at all. MUJOCO_GL, where set, decides."""
    if sys.platform == "linux" and not os.environ.get("DISPLAY") and not os.environ.get("MUJOCO_GL"):
        os.environ["MUJOCO_GL"] = "egl" if renders else "disabled"


def cannot_render(task: str, error: Exception) -> UserError:
    chosen = os.environ.get("MUJOCO_GL")
    return UserError(
        f"task {task} needs to render, and with MUJOCO_GL {f'set to {chosen}' if chosen else 'not set'} dm_control cannot "
        f"({type(error).__name__}: {error!s:.300}); set MUJOCO_GL to egl (Debian: libegl1 libgl1) or osmesa (libosmesa6) where there is no "
        "display, to glfw where there is one"
    )


def make(task: str, domain: str, name: str, image_size: int | None, arguments: dict[str, Any], renders: bool) -> gymnasium.Env[Any, Any]:
    """The task `name` of `domain`; from vectors, or where image_size is given from images only.

    arguments: of the suite's task. renders: it cannot do without a renderer, which is tried once.

    Raises:
      UserError: no such task, or no renderer.
    """
    from dm_control import suite

    domain = {"cup": "ball_in_cup"}.get(domain, domain)
    if (domain, name) not in suite.ALL_TASKS:
        known = ", ".join(sorted("-".join(entry) for entry in suite.ALL_TASKS if domain in ("", entry[0])))
        remedy = f"known: {known}" if known else f"known domains: {', '.join(sorted({entry[0] for entry in suite.ALL_TASKS}))}"
        raise UserError(f"unknown task {task!r}; {remedy}")
    env = DmControlEnv(suite.load(domain, name, task_kwargs=arguments), image_size, CAMERAS.get(domain, 0))
    if renders:
        try:
            env.render_once()
        except Exception as error:  # Each library raises errors of its own, some of them plain Exceptions.
            raise cannot_render(task, error) from error
    return env


class DmControlEnv(gymnasium.Env[Any, np.ndarray]):
    """A task of the suite. A time limit truncates: the suite keeps the discount at 1 there."""

    def __init__(self, env: Any, image_size: int | None, camera: int) -> None:
        self._env = env
        self._image_size = image_size
        self._camera = camera
        if image_size is None:
            self.observation_space = gym.Dict({key: _unbounded(spec) for key, spec in env.observation_spec().items()})
        else:
            self.observation_space = gym.Dict({"image": gym.Box(0, 255, (image_size, image_size, 3), np.uint8)})
        action = env.action_spec()
        low, high = (np.broadcast_to(bound, action.shape).astype(np.float64) for bound in (action.minimum, action.maximum))
        self.action_space = gym.Box(low, high, dtype=np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            self._env.task.random.seed(seed)
        return self._observation(self._env.reset()), {}

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        step = self._env.step(action)
        terminated = step.last() and step.discount == 0
        return self._observation(step), step.reward, terminated, step.last() and not terminated, {}

    def render_once(self) -> None:
        """Raises what the renderer raises."""
        if os.environ.get("MUJOCO_GL", "") in GLFW:
            _require_display()
        self._env.physics.render(1, 1)

    def _observation(self, step: dm_env.TimeStep) -> dict[str, np.ndarray]:
        if self._image_size is None:
            return step.observation
        return {"image": self._env.physics.render(self._image_size, self._image_size, camera_id=self._camera)}

    def close(self) -> None:
        self._env.close()


def _require_display() -> None:
    """What GLFW says without one takes the process with it the second time that it is asked to draw."""
    try:
        import glfw
    except ImportError:  # Then dm_control has taken another.
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not glfw.init():
            raise RuntimeError("GLFW finds no display")


def _unbounded(spec: Any) -> gym.Box:
    return gym.Box(-np.inf, np.inf, spec.shape, np.float64)
