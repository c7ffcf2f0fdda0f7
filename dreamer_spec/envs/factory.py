"""Tasks by name.

gym:ID                   any registered Gymnasium id: gym:CartPole-v1, gym:ALE/Pong-v5; of a module: gym:module:ID
SUITE:NAME               a task of a suite with a protocol: atari:pong, dmc:walker-walk; `train tasks` lists them
MODULE:CALLABLE          your own, a function or class that returns a gymnasium.Env or a gymnasium.vector.VectorEnv:
                         my_package.my_module:make_env

A script may give the callable itself; its task is then its name.
"""

import contextlib
import functools
import importlib
import inspect
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import VectorEnv

from conformance.own_names import ours, ours_in
from dreamer_spec import arguments as keywords
from dreamer_spec.envs import suites
from dreamer_spec.envs.adapter import ContractEnv
from dreamer_spec.envs.contract_vector import Adapted, ContractVector
from dreamer_spec.envs.info import names_of
from dreamer_spec.envs.sending import known_here, register, require_sendable
from dreamer_spec.errors import UserError
from dreamer_spec.options import Options, names_code
from dreamer_spec.suites import SUITES

EXPECTED = "gym:ID, MODULE:CALLABLE or a SUITE:NAME that `train tasks` lists"

# Namespace of a Gymnasium id -> the package that registers it, and our extra that installs it. Folder inside Gymnasium
# -> our extra.
_NAMESPACES = {"ALE": ("ale_py", "atari")}
_EXTRAS = {"box2d": "box2d", "mujoco": "mujoco", "classic_control": "train"}


def env_maker(options: Options, render: bool = False) -> Callable[[int], Adapted]:
    """index -> the environment that these options describe, or a vector of all.

    Raises:
      UserError: a module that cannot be imported, because its name is ours; a callable that no process can be given.
    """
    module = options.task.removeprefix("gym:").partition(":")[0]
    if names_code(options.task) and options.make is None and (taken := ours(module)):
        raise UserError(
            f"task {options.task}: {taken} is the name of a package of dreamer-spec, which hides any other module of "
            f"that name; rename yours"
        )
    registered: list[EnvSpec] = []
    if options.processes != "no":
        try:
            require_sendable(options.make)
        except Exception as error:
            raise UserError(
                f"task {options.task} cannot be sent to a process of its own: {type(error).__name__}: {error}; let it "
                f"make inside what it takes from outside, or keep environments in this process: --processes no"
            ) from error
        registered = known_here()
    return functools.partial(
        make_env,
        options.task,
        image_size=options.image_size,
        action_repeat=options.action_repeat,
        info_metrics=names_of(options.info_metrics),
        render=render,
        arguments=options.env_arg,
        time_limit=options.time_limit,
        observations=options.observations,
        leave_out=options.leave_out,
        make=options.make,
        registered=registered,
        num_envs=options.config.envs,
    )


def make_env(
    task: str,
    index: int = 0,
    image_size: int = 64,
    action_repeat: int = 1,
    info_metrics: Sequence[str] = (),
    render: bool = False,
    arguments: Mapping[str, Any] | None = None,
    time_limit: int | None = None,
    observations: Sequence[str] = (),
    leave_out: Sequence[str] = (),
    make: Callable[..., Any] | None = None,
    registered: Sequence[EnvSpec] = (),
    num_envs: int | None = None,
) -> Adapted:
    """The environment of a task string, or the vector that its callable returns, adapted. `index` numbers the instances
    of a run, for messages. render: with the render mode "rgb_array", where the environment has one. arguments: keyword
    arguments with which the environment is made. time_limit: frames after which an episode is truncated, in place of
    the suite's limit: [LOOP-62]. make: the callable that makes the environment; the task is only its name then.
    registered: ids that Gymnasium shall know. The others: see `ContractEnv`. num_envs: what a callable gets that has an
    argument of this name; [LOOP-74].

    Raises:
      UserError: an unknown task, a package that is not installed (with the pip command), arguments that the environment
      does not take, an unsupported space, an action repeat or a time limit for a vector.
    """
    register(registered)
    arguments = arguments or {}
    suite, separator, name = task.partition(":")
    env: gymnasium.Env[Any, Any] | VectorEnv[Any, Any, Any]
    if make is not None:
        env = _call(task, make, render, arguments, num_envs)
    elif not separator or not suite or not name:
        raise UserError(f"unknown task {task!r}; expected {EXPECTED}")
    elif suite == "gym":
        env, time_limit = _make_gymnasium(task, name, render, arguments, time_limit), None
    elif suite in SUITES:
        traits = SUITES[suite]
        own_repeat, own_limit = action_repeat if traits.repeats else 1, time_limit if traits.limits else None
        with _naming(task, arguments):
            env = suites.make(suites.Play(suite, name, image_size, own_repeat, own_limit, render), arguments)
        time_limit = None if traits.limits else time_limit
        action_repeat = 1 if traits.repeats else action_repeat
    else:
        env = _call(task, _find_own(task, suite, name), render, arguments, num_envs)
    choice = info_metrics, observations, leave_out
    if isinstance(env, VectorEnv):
        _refuse_wrapping(task, action_repeat, time_limit)
        return ContractVector(env, task, image_size, *choice)
    if time_limit:
        env = gymnasium.wrappers.TimeLimit(env, time_limit)
    return ContractEnv(env, task, index, image_size, action_repeat, *choice)


def _refuse_wrapping(task: str, action_repeat: int, time_limit: int | None) -> None:
    given = {"--action-repeat": action_repeat if action_repeat != 1 else None, "--time-limit": time_limit}
    for option, value in given.items():
        if value:
            raise UserError(
                f"task {task} is a vector environment, whose environments cannot be wrapped from outside: leave out "
                f"{option} {value}, and apply it inside the vector, such as by an argument (--env-arg) or in the "
                f"functions that make its environments"
            )


def _make_gymnasium(
    task: str, name: str, render: bool, arguments: Mapping[str, Any], time_limit: int | None
) -> gymnasium.Env[Any, Any]:
    namespace = name.split("/")[0]
    if namespace in _NAMESPACES:
        module, extra = _NAMESPACES[namespace]
        gymnasium.register_envs(_import(module, extra, task))
    if ":" in name:
        _import_own(task, name.split(":")[0])
    if "max_episode_steps" in arguments:  # Gymnasium's own, which would be set twice.
        raise UserError(f"--env-arg max_episode_steps is no argument of {task}; the option is --time-limit N")
    given = {"disable_env_checker": True, **arguments} | ({"max_episode_steps": time_limit} if time_limit else {})
    try:
        if render:
            with contextlib.suppress(TypeError):  # It takes no render_mode.
                return gymnasium.make(name, **{**given, "render_mode": "rgb_array"})
        with _naming(task, arguments):
            return gymnasium.make(name, **given)
    except gymnasium.error.DependencyNotInstalled as error:
        raise UserError(f"task {task} needs another package: {_gymnasium_extra(name) or error}") from error
    except ModuleNotFoundError as error:
        raise UserError(
            f"task {task} needs the package {error.name}: {_gymnasium_extra(name) or 'install it with pip'}"
        ) from error
    except gymnasium.error.Error as error:
        is_known = name.rpartition(":")[2] in gymnasium.registry
        raise UserError(
            f"{f'task {task}{_given(arguments)}' if is_known else f'unknown task {task!r}'}: {error}"
        ) from error
    except RuntimeError as error:
        if "MUJOCO_GL" not in str(error):  # What MuJoCo says of a value that it does not know.
            raise
        raise UserError(f"task {task}: {error}; set it to egl, osmesa or disabled, or unset it") from error


class Refusal(UserError):
    """An environment could not be made with its arguments. Not certainly because of them: another attempt may do
    better."""


@contextlib.contextmanager
def _naming(task: str, arguments: Mapping[str, Any]) -> Iterator[None]:
    """What the code of an environment raises of keyword arguments that it cannot use becomes a line that names them."""
    try:
        yield
    except (TypeError, ValueError, LookupError, AttributeError, AssertionError) as error:
        if not arguments:
            raise
        line = f"task {task}{_given(arguments)}: {type(error).__name__}: {error}"
        if "keyword argument" in str(error):
            raise UserError(line) from error
        raise Refusal(line, traceback.format_exc()) from error


@contextlib.contextmanager
def _not_ours(task: str) -> Iterator[None]:
    """What somebody's code raises that means a module of theirs, and gets our package of that name, becomes a line."""
    try:
        yield
    except (ImportError, AttributeError) as error:
        if taken := ours_in(error):
            raise UserError(
                f"task {task}: {error}: {taken} is a package of dreamer-spec, which hides any other module of that "
                f"name; rename yours"
            ) from error
        raise


def _given(arguments: Mapping[str, Any]) -> str:
    return "".join(f" --env-arg {argument}" for argument in keywords.write(arguments))


def _gymnasium_extra(name: str) -> str:
    """How to install what an id of Gymnasium itself needs; empty for others."""
    spec = gymnasium.registry.get(name)
    entry_point = str(spec.entry_point) if spec else ""
    return next((_pip(extra) for folder, extra in _EXTRAS.items() if f"gymnasium.envs.{folder}" in entry_point), "")


def _find_own(task: str, module_name: str, name: str) -> Callable[..., Any]:
    function = getattr(_import_own(task, module_name), name, None)
    if not callable(function):
        raise UserError(f"unknown task {task!r}: the module {module_name!r} has no function or class {name!r}")
    return function


def _call(
    task: str, function: Callable[..., Any], render: bool, arguments: Mapping[str, Any], num_envs: int | None
) -> gymnasium.Env[Any, Any] | VectorEnv[Any, Any, Any]:
    given = dict(arguments)
    if render and _takes(function, "render_mode"):
        given["render_mode"] = "rgb_array"
    if num_envs is not None and _takes(function, "num_envs"):
        given.setdefault("num_envs", num_envs)
    with _naming(task, arguments), _not_ours(task):
        env = function(**given)
    if not isinstance(env, gymnasium.Env | VectorEnv):
        name = task.partition(":")[2]
        raise UserError(
            f"task {task}: {name}() returned a {type(env).__name__}; expected a gymnasium.Env or a "
            f"gymnasium.vector.VectorEnv"
        )
    return env


def _takes(function: Callable[..., Any], name: str) -> bool:
    try:
        return name in inspect.signature(function).parameters
    except ValueError:  # Code in C may not say.
        return False


def _import_own(task: str, module_name: str) -> Any:
    """A module of the user's. A console script does not look for modules where it is started; they usually lie
    there."""
    if module_name.startswith(".") or "/" in module_name or module_name.endswith(".py"):
        module = Path(module_name).name.removesuffix(".py") or "my_module"
        raise UserError(
            f"unknown task {task!r}: {module_name!r} is a file, and a task names a module, "
            f"as `import` does: {module}:make_env"
        )
    with contextlib.suppress(FileNotFoundError):  # It has been removed.
        here = str(Path.cwd())
        if here not in sys.path and "" not in sys.path:
            sys.path.insert(0, here)
    try:
        with _not_ours(task):
            return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise  # The module is there; something that it imports is not.
        raise UserError(
            f"unknown task {task!r}: no suite and no module named {module_name!r}; expected {EXPECTED}"
        ) from error


def _import(module: str, extra: str, task: str) -> Any:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise UserError(f"task {task} needs the package {error.name}: {_pip(extra)}") from error


def _pip(extra: str) -> str:
    return f"pip install 'dreamer-spec[{extra}]'"
