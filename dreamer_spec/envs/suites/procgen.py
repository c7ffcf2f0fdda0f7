"""ProcGen as Gymnasium environments, from whichever build of its library there is for this Python.

The library begins the next level by itself, in the very step that ends an episode: that step draws the new level and
never the end of the old one. So the last record of an episode repeats the frame before it, because nothing of the next
episode may enter it ([LOOP-27]), and each episode gets a library object of its own, made from the seed of its reset
([LOOP-29], [LOOP-33]): about a millisecond, once the first one in a process has read the pictures.
"""

import contextlib
import importlib
import importlib.util
import sys
import types
from collections.abc import Iterator
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium import spaces as gym
from PIL import Image

from dreamer_spec.envs.suites import Play
from dreamer_spec.errors import UserError
from dreamer_spec.suites import tasks_of

ACTIONS = 15
DIFFICULTIES = ("easy", "hard")  # those that every game has


def make(
    play: Play, difficulty: str = "hard", levels: int = 0, timeout_is_terminal: bool = True
) -> gymnasium.Env[Any, Any]:
    """A game.

    difficulty: "easy" or "hard". levels: each episode is one of that many levels; 0 for all that there are.
    timeout_is_terminal: must be true, see D-114.

    Raises:
      UserError: no such game, or an argument that it cannot be played with.
    """
    games = tasks_of("procgen")
    if play.name not in games:
        raise UserError(f"unknown task {play.task!r}; known: {', '.join(games)}")
    if difficulty not in DIFFICULTIES:
        raise UserError(f"task {play.task}: difficulty is {difficulty!r}; expected {' or '.join(DIFFICULTIES)}")
    if type(levels) is not int or not 0 <= levels < 2**31:
        raise UserError(f"task {play.task}: levels is {levels!r}; expected their number, or 0 for all")
    if timeout_is_terminal is not True:
        raise UserError(
            f"task {play.task}: timeout_is_terminal is {timeout_is_terminal!r}, and only true is possible: ProcGen "
            f"does not tell a time-out from another end"
        )
    _package()
    return ProcgenEnv(play, {"distribution_mode": difficulty, "num_levels": levels, "start_level": 0})


class Game(Protocol):
    """One object of the library, with one game in it. It has begun its first level."""

    frame: np.ndarray
    """[512, 512, 3] uint8, of now; overwritten by the next step."""

    def step(self, action: int) -> tuple[float, bool, bool]:
        """-> (reward, whether the episode is over and `frame` shows the next one, whether its level was completed)."""

    def close(self) -> None: ...


class ProcgenEnv(gymnasium.Env[Any, Any]):
    """A game, seen in the picture that is drawn for people, made smaller: D-101.

    options: of the library. The info has `level_complete`: 1 at the end of an episode whose goal was reached.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 15}  # noqa: RUF012
    render_mode = "rgb_array"

    def __init__(self, play: Play, options: dict[str, Any]) -> None:
        self._name, self._options, self._side = play.name, options, play.image_size
        self.observation_space = gym.Dict({"image": gym.Box(0, 255, (self._side, self._side, 3), np.uint8)})
        self.action_space = gym.Discrete(ACTIONS)
        self._game: Game | None = None
        self._picture = np.zeros((512, 512, 3), np.uint8)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        super().reset(seed=seed)
        before, draw = self._game, seed if seed is not None else int(self.np_random.integers(2**31))
        self._game = _game(env_name=self._name, rand_seed=draw % 2**31, **self._options)
        if before is not None:
            before.close()  # Only now: with its last object the library forgets its pictures, and reads them anew.
        self._picture = self._game.frame.copy()
        return self._observation(), {}

    def step(self, action: int) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        assert self._game is not None, "step before reset"
        reward, over, complete = self._game.step(int(action))
        if not over:
            self._picture = self._game.frame.copy()
        return self._observation(), reward, over, False, {"level_complete": int(over and complete)}

    def _observation(self) -> dict[str, np.ndarray]:
        small = Image.fromarray(self._picture).resize((self._side, self._side), Image.Resampling.BILINEAR)
        return {"image": np.asarray(small)}

    def render(self) -> np.ndarray:
        return self._picture.copy()

    def close(self) -> None:
        if self._game is not None:
            self._game.close()
            self._game = None


# The two builds


def _package() -> Any:
    """The package of this Python.

    Raises:
      ModuleNotFoundError: it, or one that it needs, is missing.
    """
    if sys.version_info >= (3, 13):
        return importlib.import_module("procgen_gym")
    with _without("gym3.video_recorder", "imageio", VideoRecorderWrapper=None):
        importlib.import_module("gym3")
    with _without("procgen.gym_registration", "gym", register_environments=lambda: None):
        return importlib.import_module("procgen")


def _game(**options: Any) -> Game:
    return (NativeGame if sys.version_info >= (3, 13) else Gym3Game)(**options)


class Gym3Game:
    """Of `procgen-mirror`, whose interface is gym3's. options: of `ProcgenGym3Env`."""

    def __init__(self, **options: Any) -> None:
        self._env = _package().ProcgenGym3Env(1, num_threads=0, render_mode="rgb_array", **options)
        self._env.observe()
        self._info = self._env._info  # What observe has just written; get_info would have all of it drawn once more.
        self.frame: np.ndarray = self._info["rgb"][0]

    def step(self, action: int) -> tuple[float, bool, bool]:
        self._env.act(np.array([action], np.int32))
        reward, _, first = self._env.observe()
        return float(reward[0]), bool(first[0]), bool(self._info["prev_level_complete"][0])

    def close(self) -> None:
        self._env.close()


class NativeGame:
    """Of `procgen-gym`, which is a vector environment of Gymnasium. options: of `ProcgenVecEnv`."""

    def __init__(self, **options: Any) -> None:
        self._env = _package().ProcgenVecEnv(1, num_threads=0, render_mode="rgb_array", **options)
        self.frame: np.ndarray = self._env.reset()[1]["rgb"][0]

    def step(self, action: int) -> tuple[float, bool, bool]:
        _, reward, over, _, info = self._env.step(np.array([action], np.int32))
        self.frame = info["rgb"][0]
        return float(reward[0]), bool(over[0]), bool(info["prev_level_complete"][0])

    def close(self) -> None:
        self._env.close()


@contextlib.contextmanager
def _without(module: str, package: str, **contents: object) -> Iterator[None]:
    """While it lasts, a module is an empty one with these contents, if the package that it imports is missing.

    gym3 and procgen import, for functions that we do not use, packages that are not developed any more (gym) or not
    needed (imageio). What stands in is a module of theirs, so that whoever else asks for those packages finds them
    missing, as they are.
    """
    if module in sys.modules or importlib.util.find_spec(package) is not None:
        yield
        return
    sys.modules[module] = types.ModuleType(module)
    vars(sys.modules[module]).update(contents)
    try:
        yield
    finally:
        del sys.modules[module]
