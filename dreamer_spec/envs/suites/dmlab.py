"""DeepMind Lab, the 30 levels of DMLab-30, as Gymnasium environments: [D-100].

The engine, `deepmind_lab`, has to be built from its source (docs/suites.md). What is called of it is its documented
Python interface: `Lab(level, observations, config, renderer)` with `reset`, `step`, `is_running`, `observations`.
"""

import importlib
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces as gym

from dreamer_spec.envs.suites import Play, text
from dreamer_spec.errors import UserError
from spec import benchmarks

FPS = 60  # of the levels
IMAGE, INSTRUCTION = "RGB_INTERLEAVED", "INSTR"  # the engine's names


def make(
    play: Play, timeout_is_terminal: bool = True, renderer: str = "software", dataset_path: str = ""
) -> gymnasium.Env[Any, Any]:
    """A level of DMLab-30, by its name. timeout_is_terminal: of every end, as all are by the level's clock.
    renderer: the engine's, "software" (OSMesa) or "hardware" (EGL). dataset_path: the folder of pictures that two of
    the psychlab levels show, where it is not written into the engine.

    Raises:
      UserError: no such level.
    """
    protocol = benchmarks()["dmlab"]
    if level_of(play.name) not in map(level_of, protocol["tasks"]):
        raise UserError(f"unknown task {play.task!r}; known: {', '.join(protocol['tasks'])}")
    engine = importlib.import_module("deepmind_lab")
    side = str(play.image_size)
    lab = engine.Lab(
        protocol["level_folder"] + level_of(play.name),
        [IMAGE, INSTRUCTION] if reads(play.name) else [IMAGE],
        config={"width": side, "height": side, "fps": str(FPS), "logLevel": "WARN", "datasetPath": dataset_path},
        renderer=renderer,
    )
    return DmLabEnv(lab, play, timeout_is_terminal)


def level_of(task: str) -> str:
    """The level that a task is trained on: the one for training where the task is named after its hold-out level."""
    return task.removesuffix("_test") + "_train" if task.endswith("_test") else task


def reads(task: str) -> bool:
    """Whether a level gives instructions."""
    prefix: str = benchmarks()["dmlab"]["text"]["levels"]
    return task.startswith(prefix)


class DmLabEnv(gymnasium.Env[Any, Any]):
    """A level. The engine repeats the action, sums the rewards and stops at the end of the episode ([LOOP-27]). It has
    no observation after the end: the last record shows the one before."""

    def __init__(self, lab: Any, play: Play, timeout_is_terminal: bool) -> None:
        self._lab, self._play, self._timeout_is_terminal = lab, play, timeout_is_terminal
        self._frames = 0
        self._seen: dict[str, np.ndarray] = {}
        self.render_mode = "rgb_array" if play.render else None
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": FPS / play.action_repeat}
        spaces: dict[str, gym.Space[Any]] = {"image": gym.Box(0, 255, (play.image_size, play.image_size, 3), np.uint8)}
        if reads(play.name):
            spaces["instruction"] = text.space("dmlab")
        self.observation_space = gym.Dict(spaces)
        self._actions = [np.array(action, np.intc) for action in benchmarks()["dmlab"]["actions"].values()]
        self.action_space = gym.Discrete(len(self._actions))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        self._lab.reset(episode=0, seed=seed)  # Its own count of episodes: none.
        self._frames = 0
        self._seen = self._observation()
        return self._seen, {}

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        limit = self._play.time_limit
        frames = min(self._play.action_repeat, limit - self._frames) if limit else self._play.action_repeat
        reward = self._lab.step(self._actions[int(action)], num_steps=frames)
        self._frames += frames
        ended = not self._lab.is_running()
        if not ended:
            self._seen = self._observation()
        terminated = ended and self._timeout_is_terminal
        return self._seen, reward, terminated, not terminated and (ended or self._frames == limit), {}

    def _observation(self) -> dict[str, np.ndarray]:
        found = self._lab.observations()
        said = {"instruction": text.encode("dmlab", found[INSTRUCTION])} if INSTRUCTION in found else {}
        return {"image": found[IMAGE], **said}

    def render(self) -> np.ndarray:
        return self._seen["image"]

    def close(self) -> None:
        self._lab.close()
