"""What a run says of its environments: each space, what became of it, and what may surprise."""

import json
import re
import sys
import types
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
import train_fakes
from gymnasium import spaces as gym
from train_runs import Make, run_quietly

from dreamer_spec.envs import ContractEnv, make_env, translate
from dreamer_spec.errors import UserError

ROOT = Path(__file__).resolve().parent.parent
F4, U1, I8 = np.float32, np.uint8, np.int64


LINES = [
    "observation board: Box uint8 [9, 9] in [0, 2] -> 81 choices of 3 classes, as one-hots",
    "observation camera: Box uint8 [120, 160, 3] in [0, 255] -> image 64 x 64, 3 channels, resized from 120 x 160",
    "observation depth: Box uint16 [64, 64] in [0, 65535] -> image 64 x 64, 1 channel",
    "WARNING: observation depth: its 16 bits are rounded to 8",
    "observation goal: Box float32 [64, 64, 3] in [-1, 1] -> 12,288 real numbers",
    "WARNING: observation goal: 12,288 numbers without convolutions; an image is a Box of uint8 from 0 "
    "to 255, or of floats from 0 to 1, "
    "whose two sides are at least 16 and whose other axes are shorter",
    "observation map: Box int8 [38, 38] in [0, 1] -> 1,444 real numbers",
    "observation room: Discrete int64 from -2 -> 1 choice of 5 classes",
    "observation speed: Box float64 [6] in [-2, 2], [-1, 1] -> 6 real numbers",
    "observation view: Box uint8 [7, 7, 3] in [0, 255] -> 147 real numbers",
    "WARNING: observation view: too small for an image (sides of 16); if its numbers are codes, declare "
    "the highest of them as `high` of "
    "the Box",
    "observation window: Box uint8 [20, 20, 3] in [0, 255] -> image 64 x 64, 3 channels, resized from 20 x 20",
    (
        "WARNING: observation window: a small image; if its numbers are codes, declare the "
        "highest of them as `high` of the Box"
    ),
    "observation notes: left out",
    "action buttons: MultiDiscrete int64 [2] from 0 to 7 -> 2 choices of 2 to 3 classes",
    "action force: Box float64 [3] in [-1e+10, 1e+10], [0, inf], [-2, 2] -> 3 real numbers in [-1, 1], [0, 2], [-2, 2]",
    "WARNING: action force: 1 of 3 numbers without bounds below 1,000,000: moved in [-1, 1]; if that is not the range, "
    "declare it, for example with gymnasium.wrappers.TransformAction",
    "WARNING: action force: 1 of 3 numbers with one bound below 1,000,000: moved in the 2 units next to it; if that is "
    "not the range, declare it, for example with gymnasium.wrappers.TransformAction",
    "action gear: Box int64 in [-1, 3] -> 1 choice of 5 classes",
]


class Declared(train_fakes.Counting):
    """Every line that can be said of a space."""

    observation_space = gym.Dict(
        {
            "window": gym.Box(0, 255, (20, 20, 3), U1),
            "board": gym.Box(0, 2, (9, 9), U1),
            "camera": gym.Box(0, 255, (120, 160, 3), U1),
            "depth": gym.Box(0, 65535, (64, 64), np.uint16),
            "goal": gym.Box(-1, 1, (64, 64, 3), F4),
            "map": gym.Box(0, 1, (38, 38), np.int8),
            "notes": gym.Text(9),
            "room": gym.Discrete(5, start=-2),
            "speed": gym.Box(np.array([-2.0, -1, -1, -1, -1, -1]), np.array([2.0, 1, 1, 1, 1, 1]), dtype=np.float64),
            "view": gym.Box(0, 255, (7, 7, 3), U1),
        }
    )
    action_space = gym.Dict(
        {
            "force": gym.Box(np.array([-1e10, 0, -2]), np.array([1e10, np.inf, 2]), dtype=np.float64),
            "buttons": gym.MultiDiscrete([2, 3], start=[0, 7]),
            "gear": gym.Box(-1, 3, (), I8),
        }
    )


@pytest.mark.covers("LOOP-61")
def test_what_was_understood_is_said_in_words() -> None:
    assert list(translate(Declared.observation_space, Declared.action_space, leave_out=["notes"]).lines) == LINES


class Growing(train_fakes.Counting):
    """The second instance has another range of actions."""

    made: ClassVar[int] = 0

    def __init__(self) -> None:
        super().__init__()
        type(self).made += 1
        if self.made == 2:
            self.action_space = gym.Box(-2, 2, (2,), F4)


def test_environments_of_evaluation_are_like_those_of_training(make: Make) -> None:
    Growing.made = 0
    expected = r"an environment of evaluation is not like those of training: action 'action' is .* -2.*, elsewhere"
    with pytest.raises(UserError, match=expected):
        run_quietly(make(task="test_train_understood:Growing", processes="no", eval_episodes=1))


@pytest.mark.covers("LOOP-61")
def test_a_run_says_what_it_understood_before_it_trains(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    options = make()
    lines = list(make_env(options.task).translation.lines)
    assert len(lines) == 3
    assert lines[2].startswith("WARNING: action action: 1 of 2 numbers without bounds below 1,000,000")
    run_quietly(options)
    said = capsys.readouterr().out.splitlines()
    first = said.index(lines[0])
    assert said[first : first + 3] == lines
    assert first < next(i for i, line in enumerate(said) if "logs in" in line)
    assert json.loads((options.logdir / "run.json").read_text())["understood"] == lines


class Codes(train_fakes.Counting):
    """Declares pixels, and shows codes."""

    observation_space = gym.Box(0, 255, (48, 48, 1), U1)
    most = 10

    def reset(self, **given: Any) -> Any:
        super().reset(**given)
        return np.full((48, 48, 1), self.most, U1), {}

    def step(self, action: np.ndarray) -> Any:
        return np.full((48, 48, 1), self.most, U1), *super().step(action)[1:]


@pytest.mark.covers("LOOP-61")
@pytest.mark.parametrize(("most", "warned"), [(10, True), (31, True), (32, False), (0, False)])
def test_images_that_hold_codes_are_warned_of(
    most: int, warned: bool, make: Make, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Codes, "most", most)
    run_quietly(make(task="test_train_understood:Codes", steps=4, image_size=16, processes="no"))
    line = (
        f"WARNING: observation observation: the first images hold no number above "
        f"{most} of 255; if its numbers are codes"
    )
    assert (line in capsys.readouterr().out) == warned


# The document

DOCUMENT = (ROOT / "docs" / "environments.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", DOCUMENT, re.MULTILINE | re.DOTALL)


def test_the_lines_of_the_document_are_what_is_said() -> None:
    observations = gym.Dict({"board": gym.Box(0, 2, (9, 9), np.int8), "camera": gym.Box(0, 255, (120, 160, 3), U1)})
    actions = gym.Dict({"steer": gym.Box(-1, 1, (1,)), "throttle": gym.Box(0, np.inf, (1,))})
    assert "\n".join(translate(observations, actions).lines) + "\n" == blocks("text")[0]


def test_the_wrapper_of_the_document_gives_a_range(monkeypatch: pytest.MonkeyPatch) -> None:
    class Valve(train_fakes.Counting):
        action_space = gym.Box(0, np.inf, (1,), F4)

    monkeypatch.setitem(sys.modules, "my_module", types.ModuleType("my_module"))
    monkeypatch.setitem(gymnasium.registry, "Valve-v0", gymnasium.envs.registration.EnvSpec("Valve-v0", Valve))
    scope: dict[str, Any] = {}
    (wrapper,) = [block for block in blocks("python") if "def make_env(" in block]
    exec(wrapper, scope)
    env = ContractEnv(scope["make_env"](), "t")
    assert not [line for line in env.translation.lines if line.startswith("WARNING")]
    assert env.translation.action(F4([1])).tolist() == [40]
