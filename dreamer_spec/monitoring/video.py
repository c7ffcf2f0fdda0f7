"""A film of an episode: what the environment renders, or else the image that the agent sees. GIF, or MP4 with the extra
`video`."""

import importlib
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from PIL import Image as Pillow

from dreamer_spec.envs import Adapted, ContractEnv, ContractVector
from dreamer_spec.errors import UserError, writing

MOST_FRAMES = 400  # in memory: of a longer episode every second one is kept, or every fourth, ...
LONGEST_SIDE = 320  # pixels; larger frames are shrunk, much smaller ones are magnified
USUAL_FPS = 30


class Film:
    """The first whole episode of one environment, which must be in this process.

    path: FILE.gif or FILE.mp4.

    Raises:
      UserError: another ending, no such folder, or a package is missing.
    """

    def __init__(self, path: Path) -> None:
        if path.suffix.lower() not in (".gif", ".mp4"):
            raise UserError(f"--video {path}: expected a file that ends in .gif or .mp4")
        if not path.parent.is_dir():
            raise UserError(f"--video {path}: there is no folder {path.parent}")
        if path.suffix.lower() == ".mp4":
            _ffmpeg()
        self.path = path
        self.frames: list[np.ndarray] = []
        self.fps = float(USUAL_FPS)
        self._every, self._seen, self._complete = 1, 0, False

    def filming(self, make: Callable[[int], Adapted]) -> Callable[[int], Any]:
        """`make`, whose environment 0 is filmed.

        Raises:
          UserError: from the result, if it is a vector.
        """

        def filmed(index: int) -> Any:
            env = make(index)
            if isinstance(env, ContractVector):
                raise UserError(
                    f"task {env.task} is a vector environment, which cannot be filmed; give --task a function that "
                    f"returns one of its environments"
                )
            return env if index else _Filmed(env, self)

        return filmed

    def begin(self) -> None:
        """An episode begins. One that did not come to its end is forgotten."""
        if not self._complete:
            self.frames, self._every, self._seen = [], 1, 0

    def add(self, frame: Callable[[], np.ndarray], is_last: bool) -> None:
        """Another step of the episode; the frame [H, W, 3] uint8 is asked for if it is wanted."""
        if self._complete:
            return
        if self._seen % self._every == 0 or is_last:
            self.frames.append(_fitted(frame()))
        self._seen += 1
        self._complete = is_last
        if len(self.frames) >= MOST_FRAMES and not is_last:
            self.frames, self._every = self.frames[::2], 2 * self._every

    def save(self) -> str:
        """Writes the file, and says what it holds.

        Raises:
          UserError: the disk or the encoder refuses it.
        """
        seconds = self._every / self.fps
        with writing(self.path):
            if self.path.suffix.lower() == ".gif":
                first, *others = (Pillow.fromarray(frame) for frame in self.frames)
                duration = max(20, round(1000 * seconds))  # Browsers show less than 20 ms as 100.
                first.save(self.path, save_all=True, append_images=others, duration=duration, loop=0, format="GIF")
            else:
                _write_mp4(self.path, self.frames, 1 / seconds)
        shown = "" if self._every == 1 else f", one of {self._every}"
        return f"video of the first episode of environment 0: {self.path} ({len(self.frames)} frames{shown})"


class _Filmed(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An adapted environment that shows each of its steps to a film."""

    def __init__(self, env: ContractEnv, film: Film) -> None:
        super().__init__(env)
        self.task, self.spaces, self.translation, self.frame_skip = (
            env.task,
            env.spaces,
            env.translation,
            env.frame_skip,
        )
        self._film, self._picture = film, _source(env)
        film.fps = max(1.0, env.frames_per_second(USUAL_FPS))

    def reset(self, **given: Any) -> Any:
        observation, info = self.env.reset(**given)
        self._film.begin()
        self._film.add(lambda: self._picture(observation), False)
        return observation, info

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._film.add(lambda: self._picture(observation), terminated or truncated)
        return observation, reward, terminated, truncated, info


def _source(env: ContractEnv) -> Callable[[Any], np.ndarray]:
    """Where frames come from: observation -> frame.

    Raises:
      UserError: the environment renders nothing, and shows no image either.
    """
    if env.render_mode == "rgb_array":
        return lambda observation: _rendered(env)
    key = next(iter(env.spaces.images), None)
    if key is None:
        raise UserError(
            f"task {env.task}: --video needs an environment with render_mode 'rgb_array', or an observation "
            f"that is an image; this one has "
            f"render_mode {env.render_mode!r}. A function of your own may take render_mode as an argument, and "
            f"give it to its environment"
        )
    return lambda observation: _picture_of(observation[key])


def _rendered(env: ContractEnv) -> np.ndarray:
    try:
        frame = np.asarray(env.render())
    except Exception as error:
        raise UserError(f"task {env.task}: render raised {type(error).__name__}: {error}") from error
    if frame.dtype != np.uint8 or frame.ndim not in (2, 3) or 0 in frame.shape:
        raise UserError(
            f"task {env.task}: render returned {frame.dtype} of shape {frame.shape}; expected uint8 [H, W, 3]"
        )
    return _picture_of(frame)


def _picture_of(image: np.ndarray) -> np.ndarray:
    """uint8 [H, W] or [H, W, C] -> [H, W, 3]: colours, or the last channel in grey (of several frames the newest)."""
    image = image if image.ndim == 3 else image[..., None]
    return image[..., :3] if image.shape[2] in (3, 4) else np.repeat(image[..., -1:], 3, axis=2)


def _fitted(frame: np.ndarray) -> np.ndarray:
    """Shrunk, or magnified by a whole number, to `LONGEST_SIDE` at most; sides are even, as encoders of video want
    them."""
    scale = LONGEST_SIDE / max(frame.shape[:2])
    scale = scale if scale < 1 else int(scale)
    height, width = (max(2, round(side * scale / 2) * 2) for side in frame.shape[:2])
    kind = Pillow.Resampling.BILINEAR if scale < 1 else Pillow.Resampling.NEAREST
    return np.asarray(Pillow.fromarray(np.ascontiguousarray(frame)).resize((width, height), kind))


def _ffmpeg() -> Any:
    try:
        return importlib.import_module("imageio_ffmpeg")
    except ModuleNotFoundError as error:
        raise UserError(
            f"MP4 needs the package {error.name}: pip install 'dreamer-spec[video]'; GIF needs none"
        ) from error


def _write_mp4(path: Path, frames: list[np.ndarray], fps: float) -> None:
    height, width = frames[0].shape[:2]
    writer = _ffmpeg().write_frames(str(path), (width, height), fps=fps, macro_block_size=2, quality=7)
    for data in itertools.chain([None], (np.ascontiguousarray(frame) for frame in frames)):
        writer.send(data)
    writer.close()
