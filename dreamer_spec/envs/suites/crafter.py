"""Crafter as a Gymnasium environment.

The package chooses among creatures in the order of a set of objects, which is that of their places in memory, so that
the same seed and actions lead to different episodes ([LOOP-33]). Here its world keeps them in the order in which they
came.
"""

import collections
from typing import Any

import crafter
import gymnasium
import numpy as np
from crafter import constants, engine
from gymnasium import spaces as gym

from dreamer_spec.envs.suites import Play
from dreamer_spec.errors import UserError

LENGTH = 10_000  # D-112
NATIVE = 64  # pixels; a smaller picture has no room for the numbers in the inventory
RENDERED = 576


def make(play: Play) -> gymnasium.Env[Any, Any]:
    """The task `reward`.

    Raises:
      UserError: no such task.
    """
    if play.name != "reward":
        raise UserError(f"unknown task {play.task!r}; known: reward")
    return CrafterEnv(max(play.image_size, NATIVE), play.time_limit or LENGTH)


class CrafterEnv(gymnasium.Env[Any, Any]):
    """The game with its reward: 1 for each achievement when it is unlocked, 0.1 for each point of health.

    side: of the image, in pixels. length: steps that truncate an episode. The info is the package's (`achievements`
    counts what was done, `inventory` what is carried), and `unlocked`: 1 or 0 for each achievement of the episode.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    render_mode = "rgb_array"

    def __init__(self, side: int, length: int) -> None:
        self._env = crafter.Env(size=(side, side), length=length, seed=0)
        self._env._world.__class__ = OrderedWorld  # The views hold this object already.
        self.observation_space = gym.Dict({"image": gym.Box(0, 255, (side, side, 3), np.uint8)})
        self.action_space = gym.Discrete(len(constants.actions))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        if seed is not None:
            self._env._seed, self._env._episode = seed, 0  # Of both the world is made.
        return {"image": self._env.reset()}, {}

    def step(self, action: int) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        image, reward, done, info = self._env.step(int(action))
        dead = info["discount"] == 0
        unlocked = {name: int(count > 0) for name, count in info["achievements"].items()}
        return {"image": image}, float(reward), dead, bool(done) and not dead, {**info, "unlocked": unlocked}

    def render(self) -> np.ndarray:
        """The darkness is noise from the generator that the game plays with: it must not see that it was looked at."""
        random = self._env._world.random
        before = random.get_state()
        picture: np.ndarray = self._env.render((RENDERED, RENDERED))
        random.set_state(before)
        return picture


class OrderedWorld(engine.World):
    """A world whose chunks list their objects in the order in which they came there."""

    def reset(self, seed: int | None = None) -> None:
        super().reset(seed)
        self._chunks: dict[Any, OrderedObjects] = collections.defaultdict(OrderedObjects)


class OrderedObjects(dict[Any, None]):
    """A set of objects, as much of one as a chunk needs."""

    def add(self, entry: object) -> None:
        self[entry] = None

    def remove(self, entry: object) -> None:
        del self[entry]
