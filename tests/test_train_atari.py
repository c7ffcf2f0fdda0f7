"""What Atari's protocol makes of an emulator's frames, on an emulator of ours: needs no package."""

import collections
import sys
from typing import Any

import numpy as np
import pytest
from PIL import Image

from dreamer_spec.envs import make_env
from dreamer_spec.envs.suites import Play
from dreamer_spec.envs.suites.atari import AtariEnv, luminance, pooled, resized
from dreamer_spec.errors import UserError
from dreamer_spec.suites import protocol
from spec import built_profiles

PROTOCOL = protocol("atari", "paper")["env"]
GAME_OVER = 1000  # frames of the emulator below


class Emulator:
    """Frame n since the start has reward n and a screen of the brightness n; the game ends with frame `ends`. `calls`:
    all of them but those that look."""

    def __init__(self, ends: int = GAME_OVER) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self.ends, self.frame = ends, 0

    def setFloat(self, name: str, value: float) -> None:  # noqa: N802
        self.calls.append((name, value))

    setInt = setFloat  # noqa: N815

    def loadROM(self, rom: str) -> None:  # noqa: N802
        self.calls.append(("load", rom))
        self.frame = 0

    def reset_game(self) -> None:
        self.calls.append(("reset",))
        self.frame = 0

    def act(self, action: int) -> int:
        self.calls.append(("act", action))
        self.frame += 1
        return self.frame

    def game_over(self) -> bool:
        return self.frame == self.ends

    def getLegalActionSet(self) -> list[int]:  # noqa: N802
        return list(range(18))

    def getMinimalActionSet(self) -> list[int]:  # noqa: N802
        return [0, 5, 7]

    def getScreenRGB(self) -> np.ndarray:  # noqa: N802
        return np.full((210, 160, 3), self.frame % 256, np.uint8)

    def counted(self) -> collections.Counter[str]:
        return collections.Counter(str(call[0]) for call in self.calls)


def playing(emulator: Emulator, repeat: int = 4, limit: int | None = None, **arguments: Any) -> AtariEnv:
    play = Play("atari", "pong", image_size=12, action_repeat=repeat, time_limit=limit)
    return AtariEnv(emulator, "pong.bin", play, **{**PROTOCOL, **arguments})


def brightness(observation: dict[str, np.ndarray]) -> int:
    """Of an image of one color."""
    (value,) = np.unique(observation["image"])
    return int(value)


# Images


@pytest.mark.parametrize("side", [64, 96])
def test_images_are_resized_by_pillow_in_colors_and_then_lose_them(side: int) -> None:
    """Luminance before resizing, or rounded, gives other numbers."""
    image = np.random.default_rng(0).integers(0, 256, (210, 160, 3)).astype(np.uint8)
    small = np.asarray(Image.fromarray(image, "RGB").resize((side, side), Image.Resampling.BILINEAR))
    assert np.array_equal(resized(image, side), small)
    red, green, blue = np.moveaxis(small.astype(int), -1, 0)
    expected = (299 * red + 587 * green + 114 * blue) // 1000
    assert np.array_equal(luminance(small)[..., 0], expected)
    assert luminance(small).dtype == np.uint8
    weights = np.array([0.299, 0.587, 0.114])
    assert np.array_equal(luminance(small)[..., 0], (small * weights + 1e-9).sum(-1).astype(np.uint8))
    assert not np.array_equal(luminance(small)[..., 0], np.round(small @ weights))
    gray = np.repeat(luminance(image), 3, axis=-1)
    assert not np.array_equal(luminance(small)[..., 0], resized(gray, side)[..., 0])


def test_luminance_of_a_gray_is_that_gray() -> None:
    grays = np.arange(256, dtype=np.uint8).reshape(16, 16, 1)
    assert np.array_equal(luminance(np.repeat(grays, 3, axis=-1)), grays)
    colors = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255], [1, 1, 0]]], np.uint8)
    assert luminance(colors).ravel().tolist() == [76, 149, 29, 0]


def test_the_maximum_is_that_of_each_channel() -> None:
    """A red and a blue object that take turns are both there, the one over the other in both colors; the maximum of
    luminance would show the brighter one."""
    first, second = np.zeros((2, 1, 3, 3), np.uint8)
    first[0, :2], second[0, 1:] = (200, 0, 0), (0, 0, 250)
    assert pooled([first, second]).tolist() == [[[200, 0, 0], [200, 0, 250], [0, 0, 250]]]
    assert np.array_equal(pooled([second]), second)


# Steps


@pytest.mark.covers("LOOP-27", "LOOP-29")
def test_a_reset_shows_the_start_and_a_step_the_last_two_of_its_frames() -> None:
    emulator = Emulator()
    env = playing(emulator, noops=0)
    assert brightness(env.reset(seed=0)[0]) == 0
    observation, reward, *flags, _ = env.step(np.array(2))
    assert (brightness(observation), reward, flags) == (4, 1 + 2 + 3 + 4, [False, False])
    assert emulator.calls[-4:] == [("act", 2)] * 4
    for before, brightest in ((252, 255), (253, 1)):  # then 253, 254, 255, 0, and 254, 255, 0, 1
        emulator.frame = before
        assert brightness(env.step(np.array(2))[0]) == brightest
    assert brightness(env.reset(seed=0)[0]) == 0


@pytest.mark.covers("LOOP-27")
@pytest.mark.parametrize("repeat", [1, 2, 3, 4])
@pytest.mark.parametrize("ends", [1, 2, 3, 4])
def test_a_game_that_ends_within_a_repeat_ends_the_step_and_shows_its_last_screen(ends: int, repeat: int) -> None:
    emulator = Emulator(ends)
    env = playing(emulator, repeat, noops=0)
    env.reset(seed=0)
    for _ in range((ends - 1) // repeat):
        assert env.step(np.array(0))[2] is False
    observation, reward, terminated, truncated, _ = env.step(np.array(0))
    assert (terminated, truncated, emulator.counted()["act"]) == (True, False, ends)
    assert brightness(observation) == ends
    assert reward == sum(range((ends - 1) // repeat * repeat + 1, ends + 1))


@pytest.mark.covers("LOOP-28")
@pytest.mark.parametrize("terminal", [False, True])
def test_the_limit_counts_frames_since_the_reset_and_means_what_the_protocol_says(terminal: bool) -> None:
    emulator = Emulator()
    env = playing(emulator, limit=10, noops=30, timeout_is_terminal=terminal)
    for _ in range(3):
        env.reset(seed=1)
        started = emulator.frame
        assert started > 0, "frames without an action"
        flags = [env.step(np.array(0))[2:4] for _ in range(3)]
        assert flags == [(False, False), (False, False), (terminal, not terminal)]
        assert emulator.frame == started + 10


@pytest.mark.covers("LOOP-28")
def test_a_game_that_ends_at_the_limit_is_over() -> None:
    env = playing(Emulator(ends=10), limit=10, noops=0)
    env.reset(seed=0)
    assert [env.step(np.array(0))[2:4] for _ in range(3)][-1] == (True, False)


def test_rewards_are_as_large_as_the_game_gives_them() -> None:
    emulator = Emulator()
    env = playing(emulator, repeat=1)
    env.reset(seed=0)
    emulator.frame = 699
    assert env.step(np.array(0))[1] == 700


# Resets


@pytest.mark.covers("LOOP-33")
def test_the_emulator_gets_its_settings_before_it_loads_the_game() -> None:
    """It would accept them after it, and go on as before."""
    emulator = Emulator()
    env = playing(emulator, sticky_actions=0.25)
    assert emulator.calls == [("repeat_action_probability", 0.25), ("load", "pong.bin")]
    seen = []
    for seed in (5, 6, 5):
        emulator.calls.clear()
        env.reset(seed=seed)
        (sticky, first), (memory, second), load = emulator.calls
        assert (sticky, memory, load) == ("random_seed", "system_random_seed", ("load", "pong.bin"))
        assert all(type(value) is int and 0 <= value < 2**31 for value in (first, second))
        seen.append((first, second))
    assert seen[0] == seen[2]
    assert len({*seen[0], *seen[1]}) == 4


def test_every_number_of_frames_without_an_action_is_as_likely() -> None:
    env, found = playing(emulator := Emulator(), noops=10), collections.Counter[int]()
    for seed in range(1100):
        emulator.calls.clear()
        env.reset(seed=seed)
        assert {call[1] for call in emulator.calls if call[0] == "act"} <= {0}
        found[emulator.counted()["act"]] += 1
    assert set(found) == set(range(11))
    chi_square = sum((count - 100) ** 2 / 100 for count in found.values())
    assert chi_square < 29.6, found  # of 10 degrees of freedom: exceeded once in 1000


def test_a_game_that_ends_without_an_action_begins_again() -> None:
    emulator = Emulator(ends=3)
    env = playing(emulator, noops=30)
    for seed in range(20):
        emulator.calls.clear()
        observation = env.reset(seed=seed)[0]
        counted = emulator.counted()
        assert counted["reset"] == counted["act"] // 3
        assert brightness(observation) == counted["act"] % 3


# Tasks


@pytest.mark.parametrize("profile", built_profiles())
@pytest.mark.parametrize("suite", ["atari", "atari100k"])
def test_the_protocols_are_arguments(suite: str, profile: str) -> None:
    found = protocol(suite, profile)
    emulator = Emulator()
    play = Play(suite, "pong", found["image_size"], found["action_repeat"], found["time_limit"])
    env = AtariEnv(emulator, "pong.bin", play, **found["env"])
    channels, actions = (1, 18) if suite == "atari" else (3, 3)
    assert env.observation_space["image"].shape == (found["image_size"],) * 2 + (channels,)
    assert env.observation_space.contains(env.reset(seed=0)[0])
    assert env.action_space.n == actions
    assert ("repeat_action_probability", found["env"]["sticky_actions"]) in emulator.calls
    assert env.metadata["render_fps"] == 15


def test_actions_are_numbers_within_the_set() -> None:
    emulator = Emulator()
    env = playing(emulator, full_action_set=False)
    env.reset(seed=0)
    env.step(np.array(2))
    assert emulator.calls[-1] == ("act", 7)


@pytest.mark.parametrize(("arguments", "word"), [({"noops": -1}, "noops"), ({"sticky_actions": 1.0}, "sticky_actions")])
def test_arguments_out_of_range_are_refused(arguments: dict[str, Any], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        playing(Emulator(), **arguments)


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ale_py", None)
    with pytest.raises(UserError, match=r"atari:pong needs the package ale_py: pip install 'dreamer-spec\[atari\]'"):
        make_env("atari:pong")
