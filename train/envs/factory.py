"""Tasks by name.

gym:ID              any registered Gymnasium id, also one that a module registers: gym:CartPole-v1, gym:ALE/Pong-v5, gym:module:ID
dmc:DOMAIN-TASK     DeepMind Control Suite from vectors: dmc:walker-walk
dmc_vision:DOMAIN-TASK   the same from 64 x 64 images only
MODULE:CALLABLE     your own: a function or class that, called without arguments, returns a gymnasium.Env: my_package.my_module:make_env
"""

import contextlib
import importlib
import inspect
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium

from train.envs.adapter import ContractEnv
from train.errors import UserError

SUITES = "gym:ID, dmc:DOMAIN-TASK, dmc_vision:DOMAIN-TASK or MODULE:CALLABLE"

# Namespace of a Gymnasium id -> the package that registers it, and our extra that installs it. Folder inside Gymnasium -> our extra.
_NAMESPACES = {"ALE": ("ale_py", "atari")}
_EXTRAS = {"box2d": "box2d", "mujoco": "mujoco", "classic_control": "train"}


def make_env(
    task: str, index: int = 0, image_size: int = 64, action_repeat: int = 1, info_metrics: Sequence[str] = (), render: bool = False
) -> ContractEnv:
    """The environment of a task string, adapted. `index` numbers the instances of a run, for messages. render: with the render mode
    "rgb_array", where the environment has one. The others: see `ContractEnv`.

    Raises:
      UserError: an unknown task, a package that is not installed (with the pip command), an unsupported space.
    """
    suite, separator, name = task.partition(":")
    if not separator or not suite or not name:
        raise UserError(f"unknown task {task!r}; expected {SUITES}")
    if suite == "gym":
        env = _make_gymnasium(task, name, render)
    elif suite in ("dmc", "dmc_vision"):
        env = _make_dm_control(task, name, vision=suite == "dmc_vision", image_size=image_size, render=render)
    else:
        env = _make_own(task, suite, name, render)
    return ContractEnv(env, task, index, image_size, action_repeat, info_metrics)


def _make_gymnasium(task: str, name: str, render: bool) -> gymnasium.Env[Any, Any]:
    namespace = name.split("/")[0]
    if namespace in _NAMESPACES:
        module, extra = _NAMESPACES[namespace]
        gymnasium.register_envs(_import(module, extra, task))
    if ":" in name:
        _import_own(task, name.split(":")[0])
    try:
        if render:
            with contextlib.suppress(TypeError):  # It takes no render_mode.
                return gymnasium.make(name, disable_env_checker=True, render_mode="rgb_array")
        return gymnasium.make(name, disable_env_checker=True)
    except gymnasium.error.DependencyNotInstalled as error:
        raise UserError(f"task {task} needs another package: {_gymnasium_extra(name) or error}") from error
    except ModuleNotFoundError as error:
        raise UserError(f"task {task} needs the package {error.name}: {_gymnasium_extra(name) or 'install it with pip'}") from error
    except gymnasium.error.Error as error:
        raise UserError(f"unknown task {task!r}: {error}") from error
    except RuntimeError as error:
        if "MUJOCO_GL" not in str(error):  # What MuJoCo says of a value that it does not know.
            raise
        raise UserError(f"task {task}: {error}; set it to egl, osmesa or disabled, or unset it") from error


def _gymnasium_extra(name: str) -> str:
    """How to install what an id of Gymnasium itself needs; empty for others."""
    spec = gymnasium.registry.get(name)
    entry_point = str(spec.entry_point) if spec else ""
    return next((_pip(extra) for folder, extra in _EXTRAS.items() if f"gymnasium.envs.{folder}" in entry_point), "")


def _make_dm_control(task: str, name: str, vision: bool, image_size: int, render: bool) -> gymnasium.Env[Any, Any]:
    domain, _, control_task = name.partition("-")
    try:
        adapter = importlib.import_module("train.envs.dm_control")
        env: gymnasium.Env[Any, Any] = adapter.make(task, domain, control_task, image_size if vision else None, render)
    except ModuleNotFoundError as error:
        raise UserError(f"task {task} needs the package {error.name}: {_pip('dm-control')}") from error
    return env


def _make_own(task: str, module_name: str, name: str, render: bool) -> gymnasium.Env[Any, Any]:
    module = _import_own(task, module_name)
    function = getattr(module, name, None)
    if not callable(function):
        raise UserError(f"unknown task {task!r}: the module {module_name!r} has no function or class {name!r}")
    env = function(render_mode="rgb_array") if render and "render_mode" in inspect.signature(function).parameters else function()
    if not isinstance(env, gymnasium.Env):
        raise UserError(f"task {task}: {name}() returned a {type(env).__name__}; expected a gymnasium.Env")
    return env


def _import_own(task: str, module_name: str) -> Any:
    """A module of the user's. A console script does not look for modules where it is started; they usually lie there."""
    here = str(Path.cwd())
    if here not in sys.path and "" not in sys.path:
        sys.path.insert(0, here)
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise  # The module is there; something that it imports is not.
        raise UserError(f"unknown task {task!r}: no suite and no module named {module_name!r}; expected {SUITES}") from error


def _import(module: str, extra: str, task: str) -> Any:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise UserError(f"task {task} needs the package {error.name}: {_pip(extra)}") from error


def _pip(extra: str) -> str:
    return f"pip install 'dreamer-spec[{extra}]'"
