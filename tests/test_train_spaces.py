"""What is read into a task's spaces, what is said of it, and that training, evaluation and an exported policy act alike
in every one."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces as gym

from dreamer_spec.envs import translate
from dreamer_spec.errors import UserError
from reference_numpy.training_loop import environment_action
from spec import Discrete, Image, Vector

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
    assert translate(gym.Box(np.zeros((20, 20), U1), high, dtype=U1), TWO).spaces.observations["observation"] == Vector(
        400
    )
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
    assert (
        seen(gym.Box(0, 255, (3, 16, 20), U1), first, 16)
        == seen(gym.Box(0, 255, (16, 20, 3), U1), first.transpose(1, 2, 0), 16)
    ).all()
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
    halves = (
        np.full((16, 16), 0.5, np.float64) + np.arange(256).reshape(16, 16)[:, ::-1] % 2
    )  # 0.5 and 1.5, to the even one
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
        ([-1_000_000.5], [-999_999.0], (-1_000_000.5, -1_000_000.125, -999_999.75, -999_999)),
        ([999_999.0], [1_000_001.0], (999_999, 999_999.5, 1_000_000, 1_000_001)),
        ([-3e6], [-2e6], (-2e6 - 2, -2e6 - 1.5, -2e6 - 1, -2e6)),
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
    for flat in (*rng.normal(size=(200, 5)).astype(F4), np.full(5, 1e-20)):
        np.testing.assert_array_equal(
            translation.action(flat),
            environment_action(flat, translation.spaces, {"action": low}, {"action": high})["action"],
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
    observation = gym.Tuple(
        [gym.Dict({"b": gym.Tuple([gym.Box(-1, 1, (2,)), TWO]), "a": gym.Discrete(3, start=5)}), TWO]
    )
    action = gym.Dict({"x": gym.Tuple([gym.Discrete(2), gym.Box(0, 1, ()), gym.Tuple([gym.Discrete(2, start=7)])])})
    translation = translate(observation, action)
    assert list(translation.spaces.observations) == ["0_a", "0_b_0", "0_b_1", "1"]
    assert list(translation.spaces.actions) == ["x_0", "x_1", "x_2_0"]
    arrays = translation.observation(({"a": 7, "b": [np.float32([0.5, -0.5]), 1]}, 0))
    assert {key: value.tolist() for key, value in arrays.items()} == {
        "0_a": [2],
        "0_b_0": [0.5, -0.5],
        "0_b_1": [1],
        "1": [0],
    }
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
    {
        "arm": gym.Dict({"angle": gym.Box(-1, 1, (2,)), "name": gym.Text(5)}),
        "log": gym.Tuple([gym.Text(3), TWO]),
        "reward": TWO,
    }
)


@pytest.mark.parametrize(
    ("use", "leave_out", "left"),
    [
        (["arm_angle"], [], ["arm_angle"]),
        (["arm_*", "log_1"], ["*_name"], ["arm_angle", "log_1"]),
        ([], ["*name", "log_0", "rew?rd"], ["arm_angle", "log_1"]),
    ],
)
@pytest.mark.covers("LOOP-67")
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
@pytest.mark.covers("LOOP-67")
def test_a_key_that_is_not_there_is_named(use: list[str], leave_out: list[str], message: str) -> None:
    with pytest.raises(UserError) as error:
        translate(SENSORS, TWO, use=use, leave_out=leave_out)
    assert message in str(error.value)
