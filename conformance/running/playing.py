"""A run of a candidate with the environments and the learner of the kit."""

import contextlib
import functools
import itertools
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from conformance.running.diary import Diary
from conformance.running.environment import SPACES, CountingEnvironment, World
from conformance.running.interface import RunOptions
from conformance.running.learner import DiaryLearner
from conformance.script import Script
from spec import Config, load_config

STEPS = 60
USUAL = World()
SIZES = {"deter": 8, "units": 4, "stoch": 2, "classes": 8, "bins": 5}


def config_of(script: Script, **given: Any) -> Config:
    """A small one with batches of 2 sequences of 3 steps; one train step for each record of three workers."""
    usual = {"batch_size": 2, "batch_length": 3, "envs": 3, "replay_ratio": 6.0, "replay_capacity": 500}
    return load_config(script.setting.profile, "tiny", **{**SIZES, **usual, **given})


class Runs:
    """Where runs lie, for one check."""

    def __init__(self, script: Script, root: Path) -> None:
        self._script, self._root = script, root
        self._nonces = itertools.count(1)

    def directory(self, name: str) -> Path:
        return self._root / name

    def play(self, name: str, config: Config, world: World = USUAL, skips: range = range(0), **options: Any) -> Diary:
        """Runs the candidate in the directory `name`, where an earlier call may have left a run. skips: see
        `DiaryLearner`. options: of `RunOptions`."""
        diary = Diary()
        environment = functools.partial(CountingEnvironment, diary, world, functools.partial(next, self._nonces))
        learner = functools.partial(DiaryLearner, diary, skips)
        given = {"seed": self._script.setting.seed, "steps": STEPS, **options}
        run_options = RunOptions(spaces=SPACES, config=config, directory=self.directory(name), **given)
        diary.result = self._script.call("run", environment, learner, run_options)
        return diary


@contextlib.contextmanager
def runs_of(script: Script) -> Iterator[Runs]:
    """A place for runs that is removed again."""
    with tempfile.TemporaryDirectory(prefix="dreamer-runs-", ignore_cleanup_errors=True) as root:
        yield Runs(script, Path(root))
