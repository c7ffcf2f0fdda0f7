"""`train eval --video`: the first episode of an environment, as a film that can be looked at and never grows without
bound."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import train_fakes
from gymnasium import spaces as gym
from PIL import Image as Pillow
from PIL import ImageSequence
from train_agents import save_checkpoint
from train_fakes import EPISODE, FakeLearner

import dreamer_spec.training.setup
from dreamer_spec.cli import main
from dreamer_spec.envs import make_env
from dreamer_spec.monitoring import video
from dreamer_spec.monitoring.video import Film
from spec import Config, Image, Spaces, Vector, load_config


class Rendering(train_fakes.Counting):
    """Shows its time as brightness."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    broken = False

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__()
        self.render_mode = render_mode

    def render(self) -> Any:
        if self.broken:
            raise ZeroDivisionError("no light")
        return np.full((24, 40, 3), 10 * self._time, np.uint8)


class Seeing(train_fakes.Counting):
    """Renders nothing, and shows an image."""

    observation_space = gym.Box(0, 255, (16, 16, 3), np.uint8)

    def reset(self, **given: Any) -> Any:
        super().reset(**given)
        return np.zeros((16, 16, 3), np.uint8), {}

    def step(self, action: np.ndarray) -> Any:
        return np.full((16, 16, 3), 20 * (self._time + 1), np.uint8), *super().step(action)[1:]


CONFIG = load_config("paper", "tiny", compute_dtype="float32", envs=2)
ACTION = {"action": Vector(2)}


@pytest.fixture
def play(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Runs `train eval` on a task of this module with a learner that acts randomly: its exit code, and what it said."""
    monkeypatch.setattr(dreamer_spec.training.setup, "learner_class", lambda backend: FakeLearner)
    monkeypatch.setattr(FakeLearner, "load_state_dict", lambda self, state: None)

    def run(name: str, path: str, spaces: Spaces | None = None, config: Config = CONFIG) -> tuple[int, str]:
        task = f"test_train_video:{name}"
        spaces = spaces or Spaces({"observation": Vector(2)}, ACTION)
        known = make_env(task, image_size=16).translation
        known = known if known.spaces == spaces else None
        checkpoint = save_checkpoint(tmp_path / "run", config, spaces, translation=known, task=task, image_size=16)
        arguments = ["eval", str(checkpoint), "--task", task, "--episodes", "3", "--video", str(tmp_path / path)]
        code = main(arguments)
        captured = capsys.readouterr()
        return code, captured.out + captured.err

    return run


def brightness(path: Path) -> list[int]:
    with Pillow.open(path) as film:
        return [int(np.asarray(frame.convert("L"))[0, 0]) for frame in ImageSequence.Iterator(film)]


def test_the_film_shows_what_the_environment_renders(play: Any, tmp_path: Path) -> None:
    code, said = play("Rendering", "film.gif")
    assert code == 0
    assert f"film.gif ({EPISODE + 1} frames)" in said
    assert brightness(tmp_path / "film.gif") == pytest.approx([10 * time for time in range(EPISODE + 1)], abs=3)
    with Pillow.open(tmp_path / "film.gif") as film:
        assert film.size == (320, 192), "magnified by a whole number"
        assert film.info["duration"] == 100, "ten steps a second"


def test_without_rendering_it_shows_what_the_agent_sees(play: Any, tmp_path: Path) -> None:
    code, _ = play("Seeing", "film.gif", Spaces({"observation": Image(16, 16, 3)}, ACTION))
    assert code == 0
    assert brightness(tmp_path / "film.gif") == pytest.approx([20 * time for time in range(EPISODE + 1)], abs=3)


@pytest.mark.parametrize(
    ("name", "path", "words"),
    [
        ("Counting", "film.gif", ["--video", "render_mode", "image"]),
        ("Rendering", "film.avi", ["film.avi", ".gif or .mp4"]),
        ("Rendering", "nowhere/film.gif", ["no folder", "nowhere"]),
        ("Dark", "film.gif", ["render raised ZeroDivisionError: no light"]),
    ],
)
def test_what_cannot_be_filmed_is_said_in_a_line(
    play: Any, tmp_path: Path, name: str, path: str, words: list[str]
) -> None:
    code, said = play(name, path)
    assert code == 2
    error = said.splitlines()[-1]
    assert error.startswith("train: error: ")
    for word in words:
        assert word in error
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


class Dark(Rendering):
    broken = True


Counting = train_fakes.Counting


def test_mp4_names_the_extra(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    code, said = play("Rendering", "film.mp4")
    assert code == 2
    assert "pip install 'dreamer-spec[video]'" in said


def test_mp4(play: Any, tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    assert play("Rendering", "film.mp4")[0] == 0
    frames, seconds = ffmpeg.count_frames_and_secs(str(tmp_path / "film.mp4"))
    assert frames == EPISODE + 1
    assert seconds == pytest.approx((EPISODE + 1) / 10, abs=0.11)


def test_a_long_episode_is_thinned_and_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "MOST_FRAMES", 8)
    film = Film(tmp_path / "film.gif")
    film.begin()
    for step in range(100):
        film.add(lambda step=step: np.full((4, 4, 3), step, np.uint8), step == 99)
        assert len(film.frames) <= 8
    shown = [int(frame[0, 0, 0]) for frame in film.frames]
    assert shown == [0, 16, 32, 48, 64, 80, 96, 99], "evenly, the first and the last among them"
    assert "one of 16" in film.save()


def test_only_the_first_episode_that_comes_to_its_end_is_kept(tmp_path: Path) -> None:
    film = Film(tmp_path / "film.gif")
    for episode, length in enumerate((3, 4, 5)):  # The first is abandoned.
        film.begin()
        for step in range(length):
            film.add(lambda episode=episode: np.full((4, 4, 3), episode, np.uint8), episode > 0 and step == length - 1)
    assert [int(frame[0, 0, 0]) for frame in film.frames] == [1] * 4


@pytest.mark.parametrize(
    ("shape", "size"),
    [((500, 1000), (160, 320)), ((64, 64), (320, 320)), ((201, 99), (200, 100)), ((8, 8), (320, 320))],
)
def test_frames_have_a_handy_size(shape: tuple[int, int], size: tuple[int, int]) -> None:
    assert video._fitted(np.zeros((*shape, 3), np.uint8)).shape[:2] == size


def test_a_gymnasium_id_is_made_to_render() -> None:
    from dreamer_spec.envs import make_env

    env = make_env("gym:CartPole-v1", render=True)
    env.reset(seed=0)
    assert env.render().shape == (400, 600, 3)
    assert make_env("gym:CartPole-v1").render_mode is None
