"""MiniGrid and BabyAI as environments with an image: no suite of the paper.

What the package observes are codes of tiles; here they are drawn. A tile has a whole number of pixels and the rest of
the image is black, so that the same tile looks the same wherever it lies: scaled to the side of the image it would not.
"""

import importlib
import warnings
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces as gym

from dreamer_spec.envs.suites import Play, text
from dreamer_spec.errors import UserError
from dreamer_spec.options import did_you_mean

LEAST_TILE = 2  # pixels; with 1, which way the agent looks would not be seen


def make(play: Play, full_view: bool = False) -> gymnasium.Env[Any, Any]:
    """Any environment that the package registers, by its id.

    full_view: the image shows the whole grid, and not what the agent sees.

    Raises:
      UserError: no such id, one that the package cannot make, an image too small for the grid.
    """
    known = _registered()
    if play.name not in known:
        raise UserError(
            f"unknown task {play.task!r}{did_you_mean(play.name, known)}; known are the {len(known)} ids of the "
            f"package, such as {known[0]}"
        )
    try:
        env = gymnasium.make(play.name, render_mode="rgb_array" if play.render else None, disable_env_checker=True)
        env.reset(seed=0)
    except FileNotFoundError as error:  # Those of WFC begin with pictures that the package as it is installed lacks.
        raise UserError(f"task {play.task}: a file of the package minigrid is missing: {error.filename}") from error
    except gymnasium.error.DependencyNotInstalled as error:
        raise UserError(f"task {play.task}: {error}") from error
    return MiniGridEnv(env, play, full_view)


class MiniGridEnv(gymnasium.Env[Any, Any]):
    """image: what the agent sees, or the whole grid. direction: where it looks, which the former does not show.
    mission: the goal as numbers, unless it always says the same. As text it stands in the info.
    """

    def __init__(self, env: Any, play: Play, full_view: bool) -> None:
        self._env, self._world, self._full = env, env.unwrapped, full_view
        self.metadata, self.render_mode = env.metadata, env.render_mode
        tiles = max(self._world.width, self._world.height) if full_view else self._world.agent_view_size
        self._side, self._tile = play.image_size, play.image_size // tiles
        if self._tile < LEAST_TILE:
            raise UserError(
                f"task {play.task}: an image of {self._side} pixels is too small for {tiles} x {tiles} tiles; "
                f"--image-size {LEAST_TILE * tiles} or more"
            )
        self._tells = _varies(env.observation_space["mission"])
        spaces = {
            "image": gym.Box(0, 255, (self._side, self._side, 3), np.uint8),
            "direction": env.observation_space["direction"],
        }
        self.observation_space = gym.Dict(spaces | ({"mission": text.space("minigrid")} if self._tells else {}))
        self.action_space = env.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        seen, info = self._env.reset(seed=seed)
        return self._observation(seen), {**info, "mission": seen["mission"]}

    def step(self, action: int) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        seen, reward, terminated, truncated, info = self._env.step(action)
        return self._observation(seen), float(reward), terminated, truncated, {**info, "mission": seen["mission"]}

    def _observation(self, seen: dict[str, Any]) -> dict[str, Any]:
        drawn = self._world.get_frame(highlight=self._world.highlight, tile_size=self._tile, agent_pov=not self._full)
        height, width = drawn.shape[:2]
        image = np.zeros((self._side, self._side, 3), np.uint8)
        top, left = (self._side - height) // 2, (self._side - width) // 2
        image[top : top + height, left : left + width] = drawn
        mission = {"mission": text.encode("minigrid", seen["mission"])} if self._tells else {}
        return {"image": image, "direction": seen["direction"], **mission}

    def render(self) -> Any:
        return self._env.render()

    def close(self) -> None:
        self._env.close()


def _varies(mission: Any) -> bool:
    """Whether the goal can change with the episode. BabyAI's space does not know: it takes any text."""
    return bool(mission.ordered_placeholders) or "a text of its own" in mission


def _registered() -> list[str]:
    """The ids of the package, which registers them when it is imported."""
    with warnings.catch_warnings():
        # A process of an environment may know them already, from the one that began it.
        warnings.filterwarnings("ignore", ".*Overriding environment")
        importlib.import_module("minigrid")
    return [name for name, spec in gymnasium.registry.items() if str(spec.entry_point).startswith("minigrid.")]
