"""Tasks by name.

gym:ID              any registered Gymnasium id, also one that a module registers: gym:CartPole-v1, gym:ALE/Pong-v5, gym:module:ID
dmc:DOMAIN-TASK     DeepMind Control Suite from vectors: dmc:walker-walk
dmc_vision:DOMAIN-TASK   the same from 64 x 64 images only
MODULE:CALLABLE     your own: a function or class that returns a gymnasium.Env: my_package.my_module:make_env

Keyword arguments (--env-arg) go to gymnasium.make, to the suite as task_kwargs, or to the function.
"""

import functools
import importlib
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium

from train.envs.adapter import ContractEnv
from train.errors import UserError
from train.options import Options

ENVIRONMENT = ("image_size", "action_repeat", "observations", "leave_out", "env_args", "time_limit")  # of Options
SUITES = "gym:ID, dmc:DOMAIN-TASK, dmc_vision:DOMAIN-TASK or MODULE:CALLABLE"

# Namespace of a Gymnasium id -> the package that registers it, and our extra that installs it. Folder inside Gymnasium -> our extra.
_NAMESPACES = {"ALE": ("ale_py", "atari")}
_EXTRAS = {"box2d": "box2d", "mujoco": "mujoco", "classic_control": "train"}


def env_maker(options: Options) -> Callable[[int], ContractEnv]:
    """index -> the environment that these options describe."""
    return functools.partial(make_env, options.task, **{name: getattr(options, name) for name in ENVIRONMENT})


def make_env(
    task: str,
    index: int = 0,
    image_size: int = 64,
    action_repeat: int = 1,
    observations: Sequence[str] = (),
    leave_out: Sequence[str] = (),
    env_args: Mapping[str, Any] | None = None,
    time_limit: int | None = None,
) -> ContractEnv:
    """The environment of a task string, adapted. `index` numbers the instances of a run, for messages; the others are as in Options.

    Raises:
      UserError: an unknown task, a package that is not installed (with the pip command), arguments that it does not take, an unsupported
        space.
    """
    suite, separator, name = task.partition(":")
    if not separator or not suite or not name:
        raise UserError(f"unknown task {task!r}; expected {SUITES}")
    given = dict(env_args or {})
    try:
        if suite == "gym":
            env = _make_gymnasium(task, name, {**given, **({} if time_limit is None else {"max_episode_steps": time_limit})})
        elif suite in ("dmc", "dmc_vision"):
            env = _make_dm_control(task, name, given, vision=suite == "dmc_vision", image_size=image_size)
        else:
            env = _make_own(task, suite, name, given)
    except TypeError as error:
        if given and "argument" in str(error):
            shown = ", ".join(f"{name}={value!r:.40}" for name, value in given.items())
            message = f"task {task} does not take these arguments (--env-arg {shown}): {error}"
            raise UserError(message, traceback.format_exc()) from error
        raise
    if time_limit is not None and suite != "gym":
        env = gymnasium.wrappers.TimeLimit(env, time_limit)
    return ContractEnv(env, task, index, image_size, action_repeat, observations, leave_out)


def _make_gymnasium(task: str, name: str, arguments: dict[str, Any]) -> gymnasium.Env[Any, Any]:
    namespace = name.split("/")[0]
    if namespace in _NAMESPACES:
        module, extra = _NAMESPACES[namespace]
        gymnasium.register_envs(_import(module, extra, task))
    if ":" in name:
        _import_own(task, name.split(":")[0])
    try:
        return gymnasium.make(name, **{"disable_env_checker": True, **arguments})
    except gymnasium.error.DependencyNotInstalled as error:
        raise UserError(f"task {task} needs another package: {_gymnasium_extra(name) or error}") from error
    except ModuleNotFoundError as error:
        raise UserError(f"task {task} needs the package {error.name}: {_gymnasium_extra(name) or 'install it with pip'}") from error
    except gymnasium.error.Error as error:
        raise UserError(f"unknown task {task!r}: {error}") from error


def _gymnasium_extra(name: str) -> str:
    """How to install what an id of Gymnasium itself needs; empty for others."""
    spec = gymnasium.registry.get(name)
    entry_point = str(spec.entry_point) if spec else ""
    return next((_pip(extra) for folder, extra in _EXTRAS.items() if f"gymnasium.envs.{folder}" in entry_point), "")


def _make_dm_control(task: str, name: str, arguments: dict[str, Any], vision: bool, image_size: int) -> gymnasium.Env[Any, Any]:
    adapter = _import("train.envs.dm_control", "dm-control", task)
    renders = vision or name in adapter.RENDER
    adapter.choose_renderer(renders)
    try:
        _import("dm_control.suite", "dm-control", task)
    except (ImportError, AttributeError, RuntimeError) as error:  # What a missing graphics library looks like.
        raise adapter.cannot_render(task, error) from error
    domain, _, control_task = name.partition("-")
    return adapter.make(task, domain, control_task, image_size if vision else None, arguments, renders)


def _make_own(task: str, module_name: str, name: str, arguments: dict[str, Any]) -> gymnasium.Env[Any, Any]:
    module = _import_own(task, module_name)
    function = getattr(module, name, None)
    if not callable(function):
        raise UserError(f"unknown task {task!r}: the module {module_name!r} has no function or class {name!r}")
    env = function(**arguments)
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
