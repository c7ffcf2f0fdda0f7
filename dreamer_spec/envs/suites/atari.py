"""Atari games as Gymnasium environments, on the Arcade Learning Environment: D-93 to D-99 of spec/decisions.md.

Why not through the environment of ale-py: it repeats actions without pooling, seeds the emulator but not its memory at
power-up, and counts frames of its own before an episode begins.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces as gym
from PIL import Image

from dreamer_spec.envs.suites import Play
from dreamer_spec.errors import UserError
from dreamer_spec.options import did_you_mean
from dreamer_spec.suites import protocol

POOLED = 2  # frames, the last of a repeat
LUMINANCE = (299, 587, 114)  # of red, green, blue, in thousandths
FRAMES_PER_SECOND = 60
SEEDS = 2**31  # of the emulator: 0 to one less


def make(play: Play, **arguments: Any) -> gymnasium.Env[Any, Any]:
    """A game by the name of its ROM, the paper's and all others that the emulator can score.

    arguments: see `AtariEnv`; those that are left out are the paper's.

    Raises:
      UserError: no such game, or one without rewards.
      ValueError: an argument that is out of its range.
    """
    import ale_py
    from ale_py import roms

    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
    known = roms.get_all_rom_ids()
    if play.name not in known:
        raise UserError(
            f"unknown task {play.task!r}{did_you_mean(play.name, known)}; `train tasks {play.suite}` lists the "
            f"paper's games, and {play.suite}:NAME plays every other of the package ale-py"
        )
    rom = roms.get_rom_path(play.name)
    assert rom is not None, "a known game"
    if ale_py.ALEInterface.isSupportedROM(rom) is None:  # Loading it would exit the process.
        raise UserError(f"task {play.task}: the emulator has no rewards for this game, a game for two")
    return AtariEnv(ale_py.ALEInterface(), rom, play, **{**protocol(play.suite, "paper")["env"], **arguments})


class AtariEnv(gymnasium.Env[Any, Any]):
    """A game, whose end is that of the game: lives and their loss are not seen, rewards are the game's.

    ale: an emulator; rom: the file that it plays. sticky_actions: probability that a frame takes the action of the
    frame before it, whatever was asked for; the emulator draws. noops: most frames without an action at the start, of
    which each number from 0 is as likely. full_action_set: every action that the game knows, 18 in most, or only those
    that make a difference in it. grayscale: one channel, or three. timeout_is_terminal: what the time limit means.
    """

    def __init__(
        self,
        ale: Any,
        rom: Any,
        play: Play,
        sticky_actions: float,
        noops: int,
        full_action_set: bool,
        grayscale: bool,
        timeout_is_terminal: bool,
    ) -> None:
        if not 0 <= sticky_actions < 1:
            raise ValueError(f"sticky_actions must be a probability below 1, and is {sticky_actions}")
        if noops < 0:
            raise ValueError(f"noops must be a number of frames, and is {noops}")
        self._ale, self._rom, self._play = ale, rom, play
        self._noops, self._grayscale, self._timeout_is_terminal = noops, grayscale, timeout_is_terminal
        self._frames = 0  # since the reset
        ale.setFloat("repeat_action_probability", sticky_actions)  # Read when a ROM is loaded, never after.
        ale.loadROM(rom)
        self._actions = ale.getLegalActionSet() if full_action_set else ale.getMinimalActionSet()
        self.action_space = gym.Discrete(len(self._actions))
        shape = (play.image_size, play.image_size, 1 if grayscale else 3)
        self.observation_space = gym.Dict({"image": gym.Box(0, 255, shape, np.uint8)})
        self.render_mode = "rgb_array" if play.render else None
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": FRAMES_PER_SECOND / play.action_repeat}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """The emulator takes seeds when it loads a ROM, and at no other time: one for the sticky actions, one for what
        its memory holds when it is switched on, from which some games draw. [LOOP-33]"""
        super().reset(seed=seed)
        sticky, memory = self.np_random.integers(SEEDS, size=2)
        self._ale.setInt("random_seed", int(sticky))
        self._ale.setInt("system_random_seed", int(memory))
        self._ale.loadROM(self._rom)
        for _ in range(self.np_random.integers(self._noops + 1)):
            self._ale.act(0)
            if self._ale.game_over():
                self._ale.reset_game()
        self._frames = 0
        return self._observation([self._ale.getScreenRGB()]), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """The screens that are pooled are those of the last frames of the repeat; of one that is cut short, its last
        one."""
        total, screens = 0.0, []
        for left in reversed(range(self._play.action_repeat)):
            total += self._ale.act(self._actions[action])
            self._frames += 1
            over, late = self._ale.game_over(), self._frames == self._play.time_limit
            if left < POOLED or over or late:
                screens.append(self._ale.getScreenRGB())
            if over or late:
                break
        terminated = over or (late and self._timeout_is_terminal)
        return self._observation(screens), total, terminated, late and not terminated, {}

    def _observation(self, screens: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        image = resized(pooled(screens), self._play.image_size)
        return {"image": luminance(image) if self._grayscale else image}

    def render(self) -> np.ndarray:
        """The screen as it is, [210, 160, 3] in most games."""
        screen: np.ndarray = self._ale.getScreenRGB()
        return screen


# An observation: [H, W, 3] of uint8, step by step


def pooled(screens: Sequence[np.ndarray]) -> np.ndarray:
    """The brightest of each pixel and channel: many games draw an object in every other frame only."""
    return np.maximum.reduce(screens)


def resized(image: np.ndarray, size: int) -> np.ndarray:
    """[H, W, 3] -> [size, size, 3], bilinearly, each channel for itself."""
    return np.asarray(Image.fromarray(image).resize((size, size), Image.Resampling.BILINEAR))


def luminance(image: np.ndarray) -> np.ndarray:
    """[H, W, 3] -> [H, W, 1], the weighted mean of the channels in exact numbers, what is after the point cut off."""
    return (image.astype(np.int32) @ np.array(LUMINANCE, np.int32) // 1000).astype(np.uint8)[..., None]
