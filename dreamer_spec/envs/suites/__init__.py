"""Tasks of suites with a protocol, as Gymnasium environments: one module for each package that plays them.

A module has `make(play, **arguments)`, whose arguments are those of its protocol in spec/benchmarks.toml and change it
when given (`--env-arg`). It raises ModuleNotFoundError where its package is missing, and UserError for a name that the
suite does not have. What the environment draws depends on the seeds of its resets alone.
"""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium

from dreamer_spec.errors import UserError
from dreamer_spec.suites import SUITES, install


@dataclass(frozen=True)
class Play:
    """How a task is to be played.

    suite, name: of the task `SUITE:NAME`. image_size: side of images, in pixels. action_repeat: frames that each action
    is applied for, where the suite sees to it by itself; else 1. time_limit: frames that truncate an episode, where the
    suite sees to it by itself; None for the environment's own. render: whether `render` will be asked for a picture.
    """

    suite: str
    name: str
    image_size: int = 64
    action_repeat: int = 1
    time_limit: int | None = None
    render: bool = False

    @property
    def task(self) -> str:
        return f"{self.suite}:{self.name}"


def make(play: Play, arguments: Mapping[str, Any]) -> gymnasium.Env[Any, Any]:
    """The environment of a task.

    Raises:
      UserError: no such task, or its package is missing, with the command that installs it.
    """
    suite = SUITES[play.suite]
    try:
        module = importlib.import_module(f"{__name__}.{suite.module}")
        env: gymnasium.Env[Any, Any] = module.make(play, **arguments)
    except ModuleNotFoundError as error:
        raise UserError(f"task {play.task} needs the package {error.name}: {install(play.suite)}") from error
    return env
