"""What is read into a task's spaces, what is said of it, and that training, evaluation and an exported policy act alike in every one."""

import copy
import ctypes.util
import json
import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
import train_fakes
from gymnasium import spaces as gym
from train_fakes import FakeLearner
from train_runs import Make, run_quietly

from reference_numpy.training_loop import environment_action
from spec import Discrete, Image, Vector
from train import resume, setup
from train.cli import main
from train.envs import ContractEnv, make_env, translate
from train.errors import UserError
from train.policy import Policy
from train.translation import Translation

ROOT = Path(__file__).resolve().parent.parent
TWO = gym.Discrete(2)
F4, U1, I8 = np.float32, np.uint8, np.int64


def seen(space: gymnasium.Space, value: Any, image_size: int = 64) -> np.ndarray:
    return translate(space, TWO, image_size).observation(value)["observation"]


# Boxes that are observed


@pytest.mark.parametrize(
    ("low", "high", "shape", "dtype", "expected"),
    [
        (0, 255, (84, 84), U1, Image(64, 64, 1)),
        (0, 255, (16, 16, 15), U1, Image(64, 64, 15)),
        (0, 255, (3, 64, 48), U1, Image(64, 64, 3)),
        (0, 255, (4, 84, 84, 3), U1, Image(64, 64, 12)),
        (0, 255, (4, 3, 84, 84), U1, Image(64, 64, 12)),
        (0, 255, (84, 84, 3), F4, Image(64, 64, 3)),
        (0, 255, (84, 84, 3), I8, Image(64, 64, 3)),
        (0, 1, (128, 64, 4), F4, Image(64, 64, 4)),
        (0, 65535, (84, 84), np.uint16, Image(64, 64, 1)),
        # No image by their shape
        (0, 255, (15, 84, 3), U1, Vector(15 * 84 * 3)),
        (0, 255, (7, 7, 3), U1, Vector(147)),
        (0, 255, (84, 3, 84), U1, Vector(84 * 3 * 84)),
        (0, 255, (20, 20, 20), U1, Vector(8000)),
        (0, 255, (2, 2, 2, 20, 20), U1, Vector(3200)),
        (0, 255, (4096,), U1, Vector(4096)),
        # No image by their bounds
        (0, 1, (38, 38, 1), U1, Vector(38 * 38)),
        (0, 1, (38, 38), bool, Vector(38 * 38)),
        (0, 1, (38, 38), I8, Vector(38 * 38)),
        (0, 254, (38, 38), U1, Vector(38 * 38)),
        (1, 255, (38, 38), U1, Vector(38 * 38)),
        (-1, 1, (64, 64, 3), F4, Vector(64 * 64 * 3)),
        (-np.inf, np.inf, (64, 64, 3), F4, Vector(64 * 64 * 3)),
        (0, 2, (64, 64, 3), F4, Vector(64 * 64 * 3)),
        (0, 65535, (64, 64), F4, Vector(64 * 64)),
        # Boards of codes
        (0, 12, (8, 8), np.int8, Discrete((13,) * 64)),
        (1, 3, (38, 38, 1), U1, Discrete((3,) * 38 * 38)),
        (0, 31, (16, 16), U1, Discrete((32,) * 256)),
        (0, 31, (16, 17), U1, Vector(272)),
        (0, 32, (3, 3), U1, Vector(9)),
        (-1, 1, (3, 3), np.int8, Vector(9)),
        (0, 9, (5,), I8, Vector(5)),
        (0, 9, (5, 5), F4, Vector(25)),
    ],
)
@pytest.mark.covers("LOOP-55", "LOOP-57", "LOOP-31")
def test_what_a_box_becomes(low: float, high: float, shape: tuple[int, ...], dtype: Any, expected: object) -> None:
    assert translate(gym.Box(low, high, shape, dtype), TWO).spaces.observations == {"observation": expected}


@pytest.mark.covers("LOOP-55", "LOOP-57")
def test_bounds_must_hold_everywhere() -> None:
    high = np.full((20, 20), 255, U1)
    high[3, 4] = 254
    assert translate(gym.Box(np.zeros((20, 20), U1), high, dtype=U1), TWO).spaces.observations["observation"] == Vector(400)
    low, high = np.array([[0, 5], [1, 0]]), np.array([[1, 9], [1, 3]])
    translation = translate(gym.Box(low, high, dtype=I8), TWO)
    assert translation.spaces.observations["observation"] == Discrete((2, 5, 1, 4))
    assert translation.observation(np.array([[1, 5], [1, 3]]))["observation"].tolist() == [1, 0, 0, 3]
    with pytest.raises(ValueError, match="'observation' holds 4, outside its space: 5 to 9"):
        translation.observation(np.array([[1, 4], [1, 3]]))


@pytest.mark.covers("CON-33", "LOOP-55")
def test_axes_that_are_neither_rows_nor_columns_become_channels_in_order() -> None:
    rng = np.random.default_rng(0)
    first = rng.integers(0, 256, (3, 16, 20), U1)
    assert (seen(gym.Box(0, 255, (3, 16, 20), U1), first, 16) == seen(gym.Box(0, 255, (16, 20, 3), U1), first.transpose(1, 2, 0), 16)).all()
    stack = rng.integers(0, 256, (2, 16, 16, 3), U1)
    joined = seen(gym.Box(0, 255, stack.shape, U1), stack, 16)
    assert (joined == np.concatenate(list(stack), axis=-1)).all()


@pytest.mark.covers("LOOP-56")
def test_images_of_other_types_are_rounded_to_bytes() -> None:
    bytes_ = np.random.default_rng(0).integers(0, 256, (16, 16, 3), U1)
    for space, value in (
        (gym.Box(0, 1, bytes_.shape, F4), bytes_.astype(F4) / F4(255)),
        (gym.Box(0, 1, bytes_.shape, np.float64), bytes_ / 255 + np.where(bytes_ > 100, 0.4, 0.0) / 255),
        (gym.Box(0, 255, bytes_.shape, F4), bytes_.astype(F4)),
        (gym.Box(0, 255, bytes_.shape, I8), bytes_.astype(I8)),
        (gym.Box(0, 65535, bytes_.shape, np.uint16), bytes_.astype(np.uint16) * 257),
    ):
        result = seen(space, value, 16)
        assert result.dtype == U1
        assert (result == bytes_).all(), space
    halves = np.full((16, 16), 0.5, np.float64) + np.arange(256).reshape(16, 16)[:, ::-1] % 2  # 0.5 and 1.5, to the even one
    assert np.unique(seen(gym.Box(0, 255, (16, 16), np.float64), halves, 16)).tolist() == [0, 2]


@pytest.mark.parametrize("wrong", [1.003, -0.003, np.nan, np.inf])
@pytest.mark.covers("LOOP-56", "LOOP-31")
def test_numbers_beyond_an_images_bounds_are_refused(wrong: float) -> None:
    space, image = gym.Box(0, 1, (16, 16), F4), np.full((16, 16), 0.5, F4)
    image[0, :2] = 1.001, -0.001  # what arithmetic leaves behind
    assert np.unique(seen(space, image, 16)).tolist() == [0, 128, 255]
    image[5, 5] = wrong
    with pytest.raises(ValueError, match=r"'observation' holds .*, outside the bounds of its space: 0 to 1"):
        seen(space, image, 16)


def test_an_even_image_stays_even_and_a_resized_one_is_the_nearest_whole_number() -> None:
    space = gym.Box(0, 255, (210, 160, 3), U1)
    for value in (0, 1, 127, 255):
        assert (seen(space, np.full(space.shape, value, U1)) == value).all()


# Actions


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        ([-3.0], [1.0], (-3, -2, -1, 1)),
        ([0.0], [np.inf], (0, 0.5, 1, 2)),
        ([-np.inf], [5.0], (3, 3.5, 4, 5)),
        ([-np.inf], [np.inf], (-1, -0.5, 0, 1)),
        ([-1e10], [1e10], (-1, -0.5, 0, 1)),
        ([float(np.finfo(F4).min)], [float(np.finfo(F4).max)], (-1, -0.5, 0, 1)),
        ([0.0], [1e6], (0, 0.5, 1, 2)),
        ([-999_999.0], [999_999.0], (-999_999, -499_999.5, 0, 999_999)),
        ([2e6], [3e6], (2e6, 2e6 + 0.5, 2e6 + 1, 2e6 + 2)),
        ([999_999.0], [1_000_000.5], (999_999, 999_999.375, 999_999.75, 1_000_000.5)),
        ([4.0], [4.0], (4, 4, 4, 4)),
    ],
)
@pytest.mark.covers("LOOP-12", "LOOP-58")
def test_what_the_numbers_of_an_action_become(low: list[float], high: list[float], expected: tuple[float, ...]) -> None:
    space = gym.Box(np.array(low), np.array(high), dtype=np.float64)
    translation = translate(TWO, space)
    for number, wanted in zip((-1, -0.5, 0, 1), expected, strict=True):
        action = translation.action(F4([number]))
        assert action.tolist() == [wanted]
        assert space.contains(action)
    assert (translation.action(F4([-7])), translation.action(F4([7]))) == (expected[0], expected[-1])


@pytest.mark.covers("LOOP-12")
def test_actions_agree_with_the_reference_in_every_kind_of_bounds() -> None:
    low, high = np.array([-3, 0, -np.inf, -np.inf, 0.5]), np.array([1, 1e3, np.inf, 0.5, np.inf])
    translation, rng = translate(TWO, gym.Box(low, high, dtype=np.float64)), np.random.default_rng(0)
    for flat in rng.normal(size=(200, 5)).astype(F4):
        np.testing.assert_array_equal(
            translation.action(flat), environment_action(flat, translation.spaces, {"action": low}, {"action": high})["action"]
        )


@pytest.mark.covers("LOOP-59")
def test_boxes_of_whole_numbers_are_choices() -> None:
    low, high = np.array([[-1, 0], [250, 3]]), np.array([[1, 0], [252, 258]])
    space = gym.Box(low, high, dtype=np.int16)
    translation = translate(TWO, space)
    assert translation.spaces.actions == {"action": Discrete((3, 1, 3, 256))}
    flat = np.concatenate([np.eye(3)[2], [1], np.eye(3)[0], np.eye(256)[255]])
    action = translation.action(flat)
    assert action.tolist() == [[1, 0], [250, 258]]
    assert space.contains(action)
    switches = translate(TWO, gym.Box(0, 1, (2,), bool))
    assert switches.action([0, 1, 1, 0]).tolist() == [True, False]
    with pytest.raises(UserError, match=r"at most 256 each; declare a Box of floats"):
        translate(TWO, gym.Box(0, 256, (1,), np.int16))


# Keys


@pytest.mark.covers("LOOP-60")
def test_tuples_and_dictionaries_keep_their_form() -> None:
    observation = gym.Tuple([gym.Dict({"b": gym.Tuple([gym.Box(-1, 1, (2,)), TWO]), "a": gym.Discrete(3, start=5)}), TWO])
    action = gym.Dict({"x": gym.Tuple([gym.Discrete(2), gym.Box(0, 1, ()), gym.Tuple([gym.Discrete(2, start=7)])])})
    translation = translate(observation, action)
    assert list(translation.spaces.observations) == ["0_a", "0_b_0", "0_b_1", "1"]
    assert list(translation.spaces.actions) == ["x_0", "x_1", "x_2_0"]
    arrays = translation.observation(({"a": 7, "b": [np.float32([0.5, -0.5]), 1]}, 0))
    assert {key: value.tolist() for key, value in arrays.items()} == {"0_a": [2], "0_b_0": [0.5, -0.5], "0_b_1": [1], "1": [0]}
    taken = translation.action(F4([0, 1, 0.5, 1, 0]))
    assert taken == {"x": (1, 0.75, (7,))}
    assert action.contains(taken)
    for wrong, message in (
        (({"a": 7, "b": [np.zeros(2), 1]},), r"'observation' is a tuple; its space is a Tuple of 2"),
        ({"a": 1}, r"'observation' is a dict; its space is a Tuple of 2"),
        (({"a": 7, "b": np.zeros(2)}, 0), r"'0/b' is a ndarray; its space is a Tuple of 2"),
        (({"b": [np.zeros(2), 1]}, 0), r"'0' lacks the keys a of its space"),
        (({"a": 7, "b": [np.zeros(2), 1], "c": 1}, 0), r"'0' has the keys c that its space does not have"),
    ):
        with pytest.raises(ValueError, match=message):
            translation.observation(wrong)


SENSORS = gym.Dict(
    {"arm": gym.Dict({"angle": gym.Box(-1, 1, (2,)), "name": gym.Text(5)}), "log": gym.Tuple([gym.Text(3), TWO]), "reward": TWO}
)


@pytest.mark.parametrize(
    ("use", "leave_out", "left"),
    [
        (["arm_angle"], [], ["arm_angle"]),
        (["arm_*", "log_1"], ["*_name"], ["arm_angle", "log_1"]),
        ([], ["*name", "log_0", "rew?rd"], ["arm_angle", "log_1"]),
    ],
)
@pytest.mark.covers("LOOP-62")
def test_keys_are_chosen_and_left_out(use: list[str], leave_out: list[str], left: list[str]) -> None:
    """What is left out may be of any space and hold anything."""
    translation = translate(SENSORS, TWO, use=use, leave_out=leave_out)
    assert list(translation.spaces.observations) == left
    value = {"arm": {"angle": np.zeros(2), "name": object()}, "log": (None, 1), "reward": "high"}
    assert list(translation.observation(value)) == left
    del value["arm"]["name"]
    assert list(translation.observation(value)) == left
    with pytest.raises(ValueError, match="has the keys other"):
        translation.observation({**value, "other": 1})


@pytest.mark.parametrize(
    ("use", "leave_out", "message"),
    [
        (["arm"], [], "--observations arm: the observations are arm_angle, arm_name, log_0, log_1, reward"),
        ([], ["log_1", "camera*"], "--leave-out camera"),
        ([], ["*"], "at least one observation"),
        ([], ["reward"], "unsupported space of the observation 'arm_name'"),
    ],
)
@pytest.mark.covers("LOOP-62")
def test_a_key_that_is_not_there_is_named(use: list[str], leave_out: list[str], message: str) -> None:
    with pytest.raises(UserError) as error:
        translate(SENSORS, TWO, use=use, leave_out=leave_out)
    assert message in str(error.value)


# What is said


LINES = [
    "observation board: Box uint8 [9, 9] in [0, 2] -> 81 choices of 3 classes, as one-hots",
    "observation camera: Box uint8 [120, 160, 3] in [0, 255] -> image 64 x 64, 3 channels, resized from 120 x 160",
    "observation depth: Box uint16 [64, 64] in [0, 65535] -> image 64 x 64, 1 channel",
    "WARNING: observation depth: its 16 bits are rounded to 8",
    "observation goal: Box float32 [64, 64, 3] in [-1, 1] -> 12,288 real numbers",
    "WARNING: observation goal: 12,288 numbers without convolutions; an image is a Box of uint8 from 0 to 255, or of floats from 0 to 1, "
    "whose two sides are at least 16 and whose other axes are shorter",
    "observation map: Box int8 [38, 38] in [0, 1] -> 1,444 real numbers",
    "observation room: Discrete int64 from -2 -> 1 choice of 5 classes",
    "observation speed: Box float64 [6] in [-2, 2], [-1, 1] -> 6 real numbers",
    "observation view: Box uint8 [7, 7, 3] in [0, 255] -> 147 real numbers",
    "WARNING: observation view: too small for an image (sides of 16); if its numbers are codes, declare the highest of them as `high` of "
    "the Box",
    "observation window: Box uint8 [20, 20, 3] in [0, 255] -> image 64 x 64, 3 channels, resized from 20 x 20",
    "WARNING: observation window: a small image; if its numbers are codes, declare the highest of them as `high` of the Box",
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


@pytest.mark.covers("LOOP-61")
def test_a_run_says_what_it_understood_before_anything_else(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    options = make()
    lines = list(make_env(options.task).translation.lines)
    assert len(lines) == 3
    assert lines[2].startswith("WARNING: action action: 1 of 2 numbers without bounds below 1,000,000")
    run_quietly(options)
    assert capsys.readouterr().out.splitlines()[:3] == lines
    assert json.loads((options.logdir / "run.json").read_text())["understood"] == lines


# Training, evaluation and export


class Kinds(gymnasium.Env[Any, Any]):
    """Every kind of space, and a diary of what it returned and received."""

    returned: ClassVar[list[Any]] = []
    received: ClassVar[list[Any]] = []
    observation_space = gym.Dict(
        {
            "camera": gym.Box(0, 255, (20, 30, 3), U1),
            "floats": gym.Box(0, 1, (3, 16, 16), F4),
            "frames": gym.Box(0, 255, (2, 16, 18, 1), I8),
            "depth": gym.Box(0, 65535, (16, 16), np.uint16),
            "board": gym.Box(1, 4, (3, 3), np.int8),
            "mixed": gym.Box(np.array([[0, 5], [1, 0]]), np.array([[1, 9], [1, 3]]), dtype=I8),
            "vector": gym.Box(-np.inf, np.inf, (2, 3), np.float64),
            "scalar": gym.Box(-1, 1, (), F4),
            "flags": gym.Box(0, 1, (4,), bool),
            "body": gym.Tuple([gym.Discrete(5, start=-3), gym.Dict({"items": gym.MultiDiscrete([[2, 3]], start=[[1, -1]])})]),
            "touch": gym.MultiBinary((2, 2)),
            "notes": gym.Text(5),
        }
    )
    action_space = gym.Dict(
        {
            "bounded": gym.Box(np.array([[-3, 0.1]]), np.array([[1, 0.3]]), dtype=np.float64),
            "single": gym.Box(0, 5, (2,), F4),
            "half": gym.Box(-2, 2, (1,), np.float16),
            "open": gym.Box(np.array([-np.inf, 0, -np.inf, -1e10]), np.array([np.inf, np.inf, 5, 1e10]), dtype=np.float64),
            "scalar": gym.Box(-1, 1, (), F4),
            "discrete": gym.Discrete(4, start=-2),
            "several": gym.MultiDiscrete([[2, 3], [4, 2]], start=[[0, 1], [-5, 9]]),
            "binary": gym.MultiBinary(3),
            "whole": gym.Box(np.array([[-1, 7]]), np.array([[1, 7]]), dtype=np.int16),
            "switch": gym.Box(0, 1, (2,), bool),
            "nested": gym.Tuple([gym.Dict({"left": gym.Discrete(2), "right": gym.Box(0, 9, (1,), F4)}), gym.Discrete(2, start=1)]),
        }
    )

    def __init__(self, length: int = 5) -> None:
        self._length = length

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._time = 0
        self.observation_space.seed(seed)
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        self.received.append(copy.deepcopy(action))
        self._time += 1
        return self._observation(), 1.0, False, self._time == self._length, {}

    def _observation(self) -> Any:
        value = {**self.observation_space.sample(), "notes": object()}
        self.returned.append(value)
        return value


def bits(value: Any) -> Any:
    """Structure, types, shapes, dtypes and bytes."""
    if isinstance(value, dict):
        return {key: bits(value[key]) for key in sorted(value)}
    if isinstance(value, tuple):
        return tuple(map(bits, value))
    return type(value).__name__, value.dtype.str, value.shape, value.tobytes()


@pytest.mark.covers("LOOP-12", "LOOP-31", "LOOP-60", "LOOP-63", "CON-34")
def test_training_evaluation_and_an_exported_policy_act_alike(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each flat action, and each observation, that passed the environment of a run or of `train eval` is what the policy folder makes."""
    monkeypatch.setattr(sys, "path", [str(ROOT / "tests"), *sys.path])
    monkeypatch.setitem(sys.modules, "kinds", sys.modules[__name__])
    passed: list[tuple[np.ndarray, Any, dict[str, np.ndarray], Any]] = []  # flat action, received; arrays, returned
    step = ContractEnv.step

    def watched(env: ContractEnv, action: np.ndarray) -> Any:
        result = step(env, action)
        passed.append((np.array(action), Kinds.received[-1], copy.deepcopy(result[0]), Kinds.returned[-1]))
        return result

    monkeypatch.setattr(ContractEnv, "step", watched)
    run, folder = str(tmp_path / "run"), tmp_path / "policy"
    words = "--size tiny --deter 16 --units 8 --stoch 3 --classes 5 --bins 31 --envs 2 --batch-size 2 --batch-length 4 --replay-ratio 1"
    words += " --steps 40 --image-size 16 --leave-out notes --env-arg length=6 --no-preflight --processes no --eval-episodes 0"
    words += " --random-episodes 0 --compute-dtype float32"
    assert main(["--backend", "torch", "--task", "kinds:Kinds", "--logdir", run, *words.split()]) == 0
    trained = len(passed)
    assert main(["eval", run, "--episodes", "1", "--task", "kinds:Kinds"]) == 0  # One is played in this process.
    assert trained >= 30
    assert len(passed) - trained == 6
    assert main(["export", run, str(folder)]) == 0
    policy = Policy.load(folder)
    for flat, received, arrays, returned in passed:
        (action,) = policy.environment_action(flat[None])
        assert bits(action) == bits(received)
        row = {key: value[0] for key, value in policy.observation([returned]).items()}
        assert bits(row) == bits(arrays)
    assert len({str(bits(received)) for _, received, _, _ in passed}) > 20, "the actions must differ"
    assert policy.info["environment"] == {"observations": [], "leave_out": ["notes"], "env_args": {"length": 6}, "time_limit": None}
    # The policy acts alone.
    env = Kinds()
    observation, _ = env.reset(seed=0)
    policy.reset(1)
    for time in range(5):
        action = policy(policy.observation([observation]), [time == 0])
        observation, *_ = env.step(policy.environment_action(action)[0])


@pytest.mark.covers("LOOP-63")
def test_a_translation_survives_its_description() -> None:
    translation = translate(Kinds.observation_space, Kinds.action_space, 16, leave_out=["notes"])
    assert Translation.from_json(json.loads(json.dumps(translation.to_json())), translation.spaces) == translation


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("observations", "camera", "shape"), [20, 30, 4]),
        (("observations", "camera", "shape"), [8, 30, 3]),
        (("observations", "camera", "low"), []),
        (("observations", "camera", "high"), [0]),
        (("observations", "camera", "dtype"), "object"),
        (("observations", "camera", "scalar"), True),
        (("observations", "board", "low"), [0.5]),
        (("observations", "board", "low"), [2**63]),
        (("observations", "body_0", "path"), ["body", 2]),
        (("observations", "body_0", "path"), ["body"]),
        (("observations", "body_0", "path"), [["body"]]),
        (("observations", "vector", "shape"), [2, 4]),
        (("observations", "touch"), None),
        (("actions", "bounded", "high"), [0, 0]),
        (("actions", "bounded", "high"), [1e999, 1]),
        (("actions", "bounded", "high"), [1, 2, 3]),
        (("actions", "discrete", "path"), ["single"]),
        (("actions", "discrete"), {"path": []}),
        (("left_out",), [["body"]]),
        (("left_out",), [[-1]]),
        (("left_out",), "notes"),
        (("more",), 1),
    ],
)
@pytest.mark.covers("LOOP-63")
def test_a_description_that_does_not_fit_is_refused(place: tuple[str, ...], value: Any) -> None:
    translation = translate(Kinds.observation_space, Kinds.action_space, 16, leave_out=["notes"])
    description = json.loads(json.dumps(translation.to_json()))
    entry = description
    for key in place[:-1]:
        entry = entry[key]
    entry[place[-1]] = value
    with pytest.raises(ValueError, match="translation"):
        Translation.from_json(description, translation.spaces)


@pytest.mark.covers("LOOP-64")
@pytest.mark.parametrize(
    ("attribute", "space", "words"),
    [
        ("action_space", gym.Box(F4([0, -np.inf]), F4([20, np.inf])), ["actions action", "20.0", "10.0"]),
        ("observation_space", gym.Box(-np.inf, np.inf, (2, 1), F4), ["observations observation", "[2, 1]"]),
        ("observation_space", gym.Dict({"observation": gym.Box(-np.inf, np.inf, (2,), F4)}), ["observations observation", "path"]),
    ],
)
def test_a_run_goes_on_in_the_same_environment_only(
    make: Make, monkeypatch: pytest.MonkeyPatch, attribute: str, space: gymnasium.Space, words: list[str]
) -> None:
    options = make(processes="no")
    with ExitStack() as stack:
        resume.save(setup.prepare(options, FakeLearner, stack))
    monkeypatch.setattr(train_fakes.Counting, attribute, space)
    with pytest.raises(UserError) as error:
        run_quietly(options)
    assert all(word in str(error.value) for word in ["another configuration", *words]), error.value


# Options


@pytest.mark.parametrize("task", ["kinds:Kinds", "gym:FrozenLake-v1", "dmc:cartpole-balance"])
def test_arguments_that_nobody_takes_are_named(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if task.startswith("dmc"):
        pytest.importorskip("dm_control")
    monkeypatch.setitem(sys.modules, "kinds", sys.modules[__name__])
    with pytest.raises(UserError, match=r"does not take these arguments \(--env-arg wings=2\)"):
        make_env(task, env_args={"wings": 2})


def test_arguments_reach_the_environment() -> None:
    pytest.importorskip("dm_control")
    assert make_env("gym:FrozenLake-v1", env_args={"map_name": "8x8"}).spaces.observations == {"observation": Discrete((64,))}
    env = make_env("dmc:cartpole-balance", env_args={"time_limit": 0.1})
    env.reset(seed=0)
    assert [env.step(F4([0]))[3] for _ in range(10)] == [False] * 9 + [True]


@pytest.mark.parametrize(
    ("task", "action", "action_repeat", "steps"),
    [
        ("gym:MountainCar-v0", [0, 1, 0], 1, 250),  # longer than the registered limit of 200
        ("gym:MountainCar-v0", [0, 1, 0], 4, 63),
        ("train_fakes:Endless", [0, 0], 1, 250),
        ("train_fakes:Endless", [0, 0], 3, 84),
    ],
)
@pytest.mark.covers("LOOP-28")
def test_a_time_limit_counts_frames_whatever_the_task(task: str, action: list[float], action_repeat: int, steps: int) -> None:
    env = make_env(task, action_repeat=action_repeat, time_limit=250)
    env.reset(seed=0)
    ends = [env.step(F4(action))[2:4] for _ in range(steps)]
    assert ends == [(False, False)] * (steps - 1) + [(False, True)]


# DeepMind's suite

STEPPED = """
import sys
import numpy as np
from train.envs import make_env
for task in sys.argv[1:]:
    env, rng = make_env(f"dmc:{task}"), np.random.default_rng(0)
    env.reset(seed=0)
    total = 0.0
    for _ in range(30):
        _, reward, *_ = env.step(rng.uniform(-1, 1, env.spaces.action_size).astype(np.float32))
        total += reward
    env.reset()
    env.close()
    assert -1 <= total <= 31, (task, total)
    print(task)
"""


def step_all(tasks: list[str]) -> None:
    """In a process that has not chosen a renderer yet."""
    environment = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "DISPLAY")}
    done = subprocess.run([sys.executable, "-c", STEPPED, *tasks], cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.split() == tasks, done.stderr


@pytest.mark.covers("LOOP-58")
def test_every_task_of_the_suite() -> None:
    """Returns of 30 random steps are sane: rewards lie in [0, 1], but for the costs of lqr."""
    suite = pytest.importorskip("dm_control.suite")
    tasks = ["-".join(task) for task in suite.ALL_TASKS]
    assert "lqr-lqr_2_1" in tasks
    assert len(tasks) >= 50
    step_all([task for task in tasks if task != "quadruped-escape"])


@pytest.mark.skipif(not ctypes.util.find_library("EGL"), reason="needs EGL")
def test_a_task_that_renders_from_vectors_too() -> None:
    pytest.importorskip("dm_control")
    step_all(["quadruped-escape"])


@pytest.mark.parametrize("renderer", ["disabled", "glfw", "no_such_library"])
@pytest.mark.parametrize("task", ["dmc_vision:cartpole-balance", "dmc:quadruped-escape"])
def test_a_renderer_that_does_not_work_is_named(task: str, renderer: str, tmp_path: Path) -> None:
    pytest.importorskip("dm_control")
    environment = {name: value for name, value in os.environ.items() if name != "DISPLAY"} | {"MUJOCO_GL": renderer}
    command = [sys.executable, "-m", "train", "--backend", "torch", "--task", task, "--logdir", str(tmp_path / "run"), "--processes", "no"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"train: error: task {task} needs to render, and with MUJOCO_GL set to {renderer} dm_control cannot")
    assert "set MUJOCO_GL to egl" in last
    assert "Traceback" not in done.stderr
