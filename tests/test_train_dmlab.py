"""DeepMind Lab: what is ours of it, and the calls of the engine, which is not here, against its documented interface.

`Lab` below does what docs/users/python_api.md and python/dmlab_module.c of the engine's repository say: which arguments
are accepted, what raises, and when.
"""

import inspect
import sys
import types
import zlib
from typing import Any

import numpy as np
import pytest

from dreamer_spec.cli import parse
from dreamer_spec.envs import make_env
from dreamer_spec.envs.suites import Play
from dreamer_spec.envs.suites.dmlab import level_of, make, reads
from dreamer_spec.envs.suites.text import bucket, encode, tokens
from dreamer_spec.errors import UserError
from dreamer_spec.suites import protocol, tasks_of
from spec import Image, Vector, benchmarks

C_INT = 2**31
LENGTH = 21  # frames of an episode of the engine below


class Lab:
    """The engine's interface. An image shows the episode's seed and the frame."""

    made: list["Lab"]

    def __init__(
        self, level: str, observations: list[str], config: dict[str, str] | None = None, renderer: str = "software"
    ) -> None:
        assert isinstance(level, str)
        assert set(observations) <= {"RGB_INTERLEAVED", "INSTR"}
        if not all(isinstance(text, str) for pair in (config or {}).items() for text in pair):
            raise TypeError("config: keys and values must be strings")
        if renderer not in ("software", "hardware"):
            raise RuntimeError(f"Failed to connect RL API: {renderer}")
        self.level, self.names, self.config, self.renderer = level, observations, config or {}, renderer
        self.running, self.closed, self.frames, self.seed = False, False, 0, -1
        self.calls: list[tuple[list[int], int]] = []
        self.resets: list[tuple[int, int | None]] = []
        self.made.append(self)

    def reset(self, episode: int = -1, seed: int | None = None) -> None:
        if seed is not None and type(seed) is not int:
            raise ValueError(f"'seed' must be int or None, was '{type(seed).__name__}'.")
        assert seed is None or 0 <= seed < C_INT, "a C integer"
        self.resets.append((episode, seed))
        self.running, self.frames, self.seed = True, 0, -1 if seed is None else seed

    def is_running(self) -> bool:
        return self.running

    def step(self, action: np.ndarray, num_steps: int = 1) -> float:
        if not self.running:
            raise RuntimeError("Environment in wrong status to advance.")
        if action.dtype != np.intc:
            raise ValueError("action must have dtype np.intc")
        assert action.shape == (7,)
        assert num_steps > 0
        self.calls.append((action.tolist(), num_steps))
        played = min(num_steps, LENGTH - self.frames)
        self.frames += played
        self.running = self.frames < LENGTH
        return float(played)

    def observations(self) -> dict[str, Any]:
        if not self.running:
            raise RuntimeError("Environment in wrong status for call to observations()")
        side = (int(self.config.get("height", "240")), int(self.config.get("width", "320")))
        image = np.full((*side, 3), self.frames, np.uint8)
        image[0, 0] = self.seed % 251
        seen = {"RGB_INTERLEAVED": image, "INSTR": f"Pick the red ball {self.frames}"}
        return {name: seen[name] for name in self.names}

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> list[Lab]:
    """All instances of the engine that a test has made."""
    module = types.ModuleType("deepmind_lab")
    module.Lab = Lab  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "deepmind_lab", module)
    Lab.made = []
    return Lab.made


def played(name: str = "rooms_watermaze", **options: Any) -> Any:
    return make_env(f"dmlab:{name}", action_repeat=4, **options)


def chosen(number: int) -> np.ndarray:
    return np.eye(15, dtype=np.float32)[number]


# The instruction


def test_tokens_are_words_and_what_stands_between_them_and_spaces() -> None:
    assert tokens("dmlab", "Pick the RED_ball, 2 x!?") == ["pick", "the", "red_ball", ",", "2", "x", "!?"]
    assert tokens("dmlab", "  ") == tokens("dmlab", "") == []
    assert tokens("dmlab", "a\tb\nc  3é") == ["a", "\t", "b", "\n", "c", "3é"]


def test_the_encoding_by_hand() -> None:
    """The first numbers of NumPy's default generator with seed 0, and the published check value of CRC-32."""
    assert zlib.crc32(b"123456789") == 0xCBF43926
    assert bucket("dmlab", "123456789") == 0xCBF43926 % 65_536 == 0x3926
    table = np.random.default_rng(0).normal(0.0, 1.0, (65_536, 32)).astype(np.float32)
    assert table[0, 0] == np.float32(0.1257302210933933)
    found = encode("dmlab", "123456789 Red").reshape(32, 32)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found[0], table[0x3926])
    np.testing.assert_array_equal(found[1], table[zlib.crc32(b"red") & 0xFFFF])
    np.testing.assert_array_equal(found[2:], np.tile(table[0], (30, 1)))


def test_what_is_over_the_slots_is_dropped() -> None:
    words = " ".join(f"word{'a' * number}" for number in range(40))
    np.testing.assert_array_equal(encode("dmlab", words), encode("dmlab", " ".join(words.split()[:32])))
    assert (encode("dmlab", words) != encode("dmlab", " ".join(words.split()[:31]))).any()
    assert encode("dmlab", words).shape == encode("dmlab", "").shape == (1024,)


# The protocol


def test_the_actions_are_the_fifteen_of_the_table() -> None:
    """By what each does, from the decision's list: yaw, pitch, strafe, move, fire."""
    walk, strafe, fire = {"forward": 1, "back": -1}, {"strafe_left": -1, "strafe_right": 1}, {"fire": 1}
    turns = {"look_left": -10, "look_right": 10, "turn_left": -60, "turn_right": 60}
    expected = {
        **{name: [0, 0, 0, way, 0, 0, 0] for name, way in walk.items()},
        **{name: [0, 0, way, 0, 0, 0, 0] for name, way in strafe.items()},
        **{name: [yaw, 0, 0, 0, 0, 0, 0] for name, yaw in turns.items()},
        **{"look_down": [0, 10, 0, 0, 0, 0, 0], "look_up": [0, -10, 0, 0, 0, 0, 0]},
        **{f"forward_{name}": [yaw, 0, 0, 1, 0, 0, 0] for name, yaw in turns.items()},
        **{name: [0, 0, 0, 0, on, 0, 0] for name, on in fire.items()},
    }
    assert list(benchmarks()["dmlab"]["actions"].items()) == list(expected.items())


@pytest.mark.parametrize(("profile", "steps"), [("paper", 100_000_000), ("official", 104_000_000)])
def test_the_protocol_of_a_run(profile: str, steps: int) -> None:
    run = parse(["--backend", "jax", "--task", "dmlab:rooms_watermaze", "--profile", profile])
    assert (run.steps, run.action_repeat, run.image_size, run.time_limit) == (steps, 4, 64, None)
    assert run.env_arg == {"timeout_is_terminal": True} == protocol("dmlab", profile)["env"]
    assert set(run.env_arg) <= set(inspect.signature(make).parameters)


def test_hold_out_levels_are_trained_on_their_training_levels() -> None:
    changed = {task: level_of(task) for task in tasks_of("dmlab") if level_of(task) != task}
    assert changed == {
        "rooms_collect_good_objects_test": "rooms_collect_good_objects_train",
        "rooms_exploit_deferred_effects_test": "rooms_exploit_deferred_effects_train",
    }
    assert [task for task in tasks_of("dmlab") if reads(task)] == [
        "language_answer_quantitative_question",
        "language_execute_random_task",
        "language_select_described_object",
        "language_select_located_object",
    ]


# The engine's calls


def test_each_task_is_a_level_of_the_engine(engine: list[Lab]) -> None:
    for task in tasks_of("dmlab"):
        env = played(task)
        lab = engine[-1]
        assert lab.level == f"contributed/dmlab30/{level_of(task)}"
        assert (lab.config["width"], lab.config["height"], lab.config["fps"]) == ("64", "64", "60")
        assert lab.renderer == "software"
        text = {"instruction": Vector(1024)} if reads(task) else {}
        assert env.spaces.observations == {"image": Image(64, 64, 3), **text}
        assert env.spaces.action_size == 15
        assert set(env.reset(seed=1)[0]) == set(env.spaces.observations)
    assert played("rooms_collect_good_objects_train").spaces.action_size == 15


def test_each_action_is_what_the_table_says_for_four_frames(engine: list[Lab]) -> None:
    env = played()
    for number, action in enumerate(benchmarks()["dmlab"]["actions"].values()):
        env.reset(seed=0)
        env.step(chosen(number))
        assert engine[0].calls[-1] == (action, 4)


@pytest.mark.covers("LOOP-27", "LOOP-29")
@pytest.mark.parametrize("terminal", [True, False])
def test_the_last_observation_is_repeated_at_the_end(engine: list[Lab], terminal: bool) -> None:
    env = played("language_execute_random_task", arguments={"timeout_is_terminal": terminal})
    for _ in range(2):  # alike in every episode
        records, rewards, ends = [env.reset(seed=5)[0]], [], []
        while not ends or not any(ends[-1]):
            record, reward, *end, _ = env.step(chosen(0))
            records.append(record)
            rewards.append(reward)
            ends.append(tuple(end))
        assert rewards == [4, 4, 4, 4, 4, 1]
        assert ends == [(False, False)] * 5 + [(terminal, not terminal)]
        assert [int(record["image"][1, 1, 0]) for record in records] == [0, 4, 8, 12, 16, 20, 20]
        np.testing.assert_array_equal(records[-2]["instruction"], encode("dmlab", "Pick the red ball 20"))
        np.testing.assert_array_equal(records[-1]["instruction"], records[-2]["instruction"])


@pytest.mark.covers("LOOP-28")
def test_a_time_limit_counts_frames_and_truncates(engine: list[Lab]) -> None:
    env = played(time_limit=10)
    for _ in range(2):
        env.reset(seed=0)
        found = [env.step(chosen(0))[1:4] for _ in range(3)]
        assert found == [(4, False, False), (4, False, False), (2, False, True)]
    env = played(time_limit=LENGTH)
    env.reset(seed=0)
    assert [env.step(chosen(0))[1:4] for _ in range(6)][-1] == (1, True, False)


@pytest.mark.covers("LOOP-33")
def test_every_reset_gives_the_engine_its_seed_and_no_count_of_episodes(engine: list[Lab]) -> None:
    first, second = played(), played()
    shown = []
    for env in (first, second):
        env.reset(seed=3)
        shown.append([env.reset()[0]["image"][0, 0, 0] for _ in range(20)])
    assert engine[0].resets == engine[1].resets
    seeds = [seed for _, seed in engine[0].resets]
    assert len(set(seeds)) == 21
    assert {episode for episode, _ in engine[0].resets} == {0}
    assert shown[0] == shown[1]
    assert shown[0] == [seed % 251 for seed in seeds[1:] if seed is not None]


def test_rendering_shows_what_was_seen_and_closing_closes(engine: list[Lab]) -> None:
    env = played(render=True, image_size=32)
    record, _ = env.reset(seed=0)
    assert env.render_mode == "rgb_array"
    np.testing.assert_array_equal(env.render(), record["image"])
    assert env.frames_per_second(30) == 15
    assert played().render_mode is None
    env.close()
    assert engine[0].closed


def test_the_renderer_and_the_pictures_can_be_chosen(engine: list[Lab]) -> None:
    played(arguments={"renderer": "hardware", "dataset_path": "/pictures"})
    assert engine[0].renderer == "hardware"
    assert engine[0].config["datasetPath"] == "/pictures"
    played()
    assert engine[1].config["datasetPath"] == ""


def test_an_unknown_level_is_a_line(engine: list[Lab]) -> None:
    with pytest.raises(UserError, match="unknown task 'dmlab:rooms_water'; known: explore_goal_locations_large"):
        played("rooms_water")
    assert engine == []


def test_without_the_engine_the_page_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "deepmind_lab", None)
    with pytest.raises(UserError, match=r"needs the package deepmind_lab: see docs/suites.md"):
        played()


def test_the_stand_in_refuses_what_the_engine_refuses(engine: list[Lab]) -> None:
    """Otherwise the tests above could not fail."""
    lab = Lab("level", ["RGB_INTERLEAVED"])
    action = np.zeros(7, np.intc)
    for call, kind in [
        (lambda: lab.step(action), RuntimeError),
        (lambda: lab.observations(), RuntimeError),
        (lambda: lab.reset(seed="1"), ValueError),  # type: ignore[arg-type]
        (lambda: Lab("level", [], {"width": 64}), TypeError),  # type: ignore[dict-item]
    ]:
        with pytest.raises(kind):
            call()
    lab.reset(seed=1)
    with pytest.raises(ValueError, match="intc"):
        lab.step(action.astype(np.int64))
    assert Play("dmlab", "a").task == "dmlab:a"
