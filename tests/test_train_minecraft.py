"""Minecraft Diamond: what is ours of it, and the calls of MineRL against a stand-in. MineRL's own Python layer is in
test_train_minerl.py; the game itself is in neither."""

import importlib
import importlib.metadata
import inspect
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from minecraft_play import ACTIONS, MILESTONES, chosen, played, sent

from dreamer_spec.cli import parse
from dreamer_spec.envs import make_env as make_task
from dreamer_spec.envs.suites import Play
from dreamer_spec.envs.suites.minecraft import (
    CHOICES,
    IDLE,
    KEYS,
    MinecraftEnv,
    counts,
    levels,
    make,
    one_hot,
    reached,
)
from dreamer_spec.errors import UserError
from dreamer_spec.suites import protocol
from spec import Image, Vector

ITEMS = sorted({"air", "dirt", "log", "log2", *MILESTONES})
EQUIPMENT = ["air", "iron_pickaxe", "other", "stone_pickaxe"]


# The protocol


def test_the_actions_are_the_twenty_five_of_the_decision() -> None:
    assert len(ACTIONS) == 25
    assert list(ACTIONS)[:12] == [
        *("noop", "attack", "look_up", "look_down", "look_left", "look_right"),
        *("forward", "back", "left", "right", "jump", "place_dirt"),
    ]
    for action in ACTIONS.values():
        assert set(action) <= {*KEYS, *CHOICES, "camera"}
    said = {name: action for name, action in ACTIONS.items() if set(action) & set(CHOICES)}
    assert len(said) == 14  # placing dirt, and the 13
    words = {"place": "place", "equip": "equip", "craft": "craft", "nearbyCraft": "craft", "nearbySmelt": "smelt"}
    for name, action in said.items():
        ((kind, item),) = action.items()
        assert name == f"{words[kind]}_{item}"
    looks = {name: action["camera"] for name, action in ACTIONS.items() if "camera" in action}
    assert looks == {"look_up": [-15, 0], "look_down": [15, 0], "look_left": [0, -15], "look_right": [0, 15]}


def test_the_milestones_are_the_papers_twelve() -> None:
    words = (
        "log, planks, stick, crafting table, wooden pickaxe, cobblestone, stone pickaxe, iron ore, furnace, "
        "iron ingot, iron pickaxe, diamond"
    )
    assert [item.replace("_", " ") for item in MILESTONES] == words.split(", ")


@pytest.mark.parametrize(("profile", "jump", "envs"), [("paper", 4, 64), ("official", 10, 16)])
def test_the_protocol_of_a_run(profile: str, jump: int, envs: int) -> None:
    run = parse(["--backend", "jax", "--task", "minecraft:diamond", "--profile", profile])
    assert (run.steps, run.time_limit, run.action_repeat, run.config.envs) == (100_000_000, 36_000, 1, envs)
    expected = {"jump_steps": jump, "break_speed": 100.0, "pitch_limit": 60, "health_reward": 0.01}
    assert run.env_arg == expected == protocol("minecraft", profile)["env"]
    assert run.info_metrics == "milestones/*"
    defaults = {name: entry.default for name, entry in inspect.signature(make).parameters.items() if name != "play"}
    assert defaults == protocol("minecraft", "paper")["env"]


# The rules


def test_an_action_presses_its_keys_and_no_other() -> None:
    for name, action in ACTIONS.items():
        (found,) = sent([name])
        assert list(found) == list(IDLE)
        assert found["camera"].dtype == np.float32
        changed = {key: value for key, value in found.items() if key != "camera" and value != IDLE[key]}
        assert changed == {key: value for key, value in action.items() if key != "camera"}
        np.testing.assert_array_equal(found["camera"], action.get("camera", [0, 0]))


@pytest.mark.parametrize("steps", [1, 4, 10])
def test_a_jump_is_held_with_forward_and_the_step_that_chose_it_counts(steps: int) -> None:
    found = sent(["jump", *["attack"] * 12], steps)
    assert [action["jump"] for action in found] == [1] * steps + [0] * (13 - steps)
    assert [action["forward"] for action in found] == [1] * steps + [0] * (13 - steps)
    assert [action["attack"] for action in found] == [0] + [1] * 12


def test_jumping_again_holds_it_anew() -> None:
    assert [action["jump"] for action in sent(["jump", "noop", "jump", *["noop"] * 5])] == [1] * 6 + [0] * 2


def test_the_view_stops_at_the_limit() -> None:
    found = sent(["look_down"] * 6 + ["look_up"] * 10 + ["look_left"] * 30 + ["look_down"])
    pitches = [int(action["camera"][0]) for action in found]
    assert pitches == [15] * 4 + [0] * 2 + [-15] * 8 + [0] * 2 + [0] * 30 + [15]
    assert [int(action["camera"][1]) for action in found] == [0] * 16 + [-15] * 30 + [0]
    assert [int(action["camera"][0]) for action in sent(["look_up"] * 3, pitch_limit=30)] == [-15, -15, 0]


def test_both_kinds_of_log_are_counted_together() -> None:
    found = counts({"log": np.array(2), "log2": np.array(3), "air": np.array(30)})
    assert found == {"log": 5, "air": 30}


def test_a_milestone_is_reached_once_and_not_by_what_was_there() -> None:
    none = dict.fromkeys(ITEMS, 0)
    assert reached(none, {**none, "log": 3, "dirt": 9}, MILESTONES) == ["log"]
    assert reached({**none, "log": 1}, {**none, "log": 3}, MILESTONES) == []
    assert reached(none, {**none, "planks": 4, "stick": 1}, MILESTONES) == ["planks", "stick"]


def test_bars_are_parts_of_a_full_one() -> None:
    found = levels({"life": np.array(20), "food": np.array(5), "air": np.array(150), "xp": np.array(7)})
    assert {name: float(value) for name, value in found.items()} == {"health": 1, "hunger": 0.25, "breath": 0.5}
    assert one_hot("air", EQUIPMENT).tolist() == [1, 0, 0, 0]
    with pytest.raises(AssertionError, match="compass"):
        one_hot("compass", EQUIPMENT)


# The engine's calls


class Engine:
    """MineRL's environment as far as it is used: an environment of the old Gym. `coming` is what the next steps give,
    changes of an observation each, with `died` and `info` beside."""

    def __init__(self) -> None:
        types = SimpleNamespace(values=np.array(EQUIPMENT))
        inventory = SimpleNamespace(spaces=dict.fromkeys(ITEMS))
        self.observation_space = {"inventory": inventory, "equipped_items": {"mainhand": {"type": types}}}
        self.calls: list[Any] = []
        self.coming: list[dict[str, Any]] = []
        self.inventory: dict[str, int] = dict.fromkeys(ITEMS, 0)
        self.life, self.equipped, self.done = 20.0, "air", True

    def seed(self, seed: int | None = None, seed_spaces: bool = True) -> None:
        assert type(seed) is int
        assert not seed_spaces
        self.calls.append(("seed", seed))

    def reset(self) -> dict[str, Any]:
        self.calls.append("reset")
        self.inventory, self.life, self.equipped = dict.fromkeys(ITEMS, 0) | {"air": 36}, 20.0, "air"
        self.done = False
        return self._observation()

    def step(self, action: dict[str, Any]) -> tuple[dict[str, Any], float, bool, dict[str, Any]]:
        if self.done:
            raise RuntimeError("Attempted to step an environment server with done=True")
        self.calls.append(action)
        change = dict(self.coming.pop(0)) if self.coming else {}
        self.done, info = change.pop("died", False), change.pop("info", {})
        self.life, self.equipped = change.pop("life", self.life), change.pop("equipped", self.equipped)
        self.inventory |= change
        return self._observation(), 0.0, self.done, info

    def _observation(self) -> dict[str, Any]:
        return {
            "pov": np.zeros((64, 64, 3), np.uint8)[::-1],
            "inventory": {item: np.array(count) for item, count in self.inventory.items()},
            "equipped_items": {"mainhand": {"type": self.equipped, "damage": np.array(0)}},
            "life_stats": {"life": np.array(self.life), "food": np.array(20), "air": np.array(300)},
        }

    def close(self) -> None:
        self.calls.append("close")


def test_the_spaces(monkeypatch: pytest.MonkeyPatch) -> None:
    env = played(Engine(), monkeypatch)
    bars = dict.fromkeys(("health", "hunger", "breath"), Vector(1))
    items = Vector(len(ITEMS) - 1)
    assert env.spaces.observations == {
        **{"image": Image(64, 64, 3), "inventory": items, "inventory_max": items, "equipped": Vector(4), **bars}
    }
    assert env.spaces.action_size == 25


def test_an_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    """Milestones pay 1, once; ten hearts pay a hundredth; the maximum remembers; diamond ore ends nothing."""
    engine = Engine()
    env = played(engine, monkeypatch)
    first, _ = env.reset(seed=0)
    place = [item for item in ITEMS if item != "log2"].index
    assert first["inventory"][place("air")] == 36
    engine.coming = [
        {"log2": 1},
        {"log": 2},
        {"log": 0, "log2": 0, "planks": 4, "life": 10.0},
        {"planks": 0},
        {"planks": 4, "life": 15.0},
        {"diamond": 1, "equipped": "iron_pickaxe"},
        {"life": 0.0, "died": True},
    ]
    steps = [env.step(chosen("attack")) for _ in range(7)]
    rewards = [reward for _, reward, *_ in steps]
    np.testing.assert_allclose(rewards, [1, 0, 1 - 0.005, 0, 0.0025, 1, -0.0075], atol=1e-7)
    assert [step[2:4] for step in steps] == [(False, False)] * 6 + [(True, False)]
    records = [record for record, *_ in steps]
    assert [record["inventory"][place("log")] for record in records] == [1, 3, 0, 0, 0, 0, 0]
    assert [record["inventory_max"][place("log")] for record in records] == [1, 3, 3, 3, 3, 3, 3]
    assert [float(record["health"][0]) for record in records] == [1, 1, 0.5, 0.5, 0.75, 0.75, 0]
    assert [EQUIPMENT[record["equipped"].argmax()] for record in records] == ["air"] * 5 + ["iron_pickaxe"] * 2
    assert records[0]["inventory"].dtype == np.float32
    np.testing.assert_array_equal(records[0]["hunger"], [1])


@pytest.mark.covers("LOOP-29")
def test_an_episode_keeps_nothing_of_the_one_before(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = Engine()
    env = played(engine, monkeypatch)
    env.reset(seed=0)
    engine.coming = [{"log": 5, "life": 3.0}]
    env.step(chosen("jump"))
    for _ in range(4):
        env.step(chosen("look_down"))
    record, _ = env.reset()
    assert record["inventory_max"].sum() == record["inventory"].sum() == 36
    engine.coming = [{"log": 1}]
    assert env.step(chosen("look_down"))[1] == 1
    assert (engine.calls[-1]["jump"], engine.calls[-1]["camera"][0]) == (0, 15)


def test_the_factor_of_health_and_the_jump_are_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = Engine()
    env = played(engine, monkeypatch, health_reward=0.1, jump_steps=10, pitch_limit=15)
    env.reset(seed=0)
    engine.coming = [{"life": 18.0}]
    assert env.step(chosen("jump"))[1] == pytest.approx(-0.01)
    for _ in range(10):
        env.step(chosen("look_up"))
    assert [call["jump"] for call in engine.calls[2:]] == [1] * 10 + [0]
    assert [int(call["camera"][0]) for call in engine.calls[2:]] == [0, -15] + [0] * 9


@pytest.mark.covers("LOOP-28")
def test_the_limit_is_a_truncation(monkeypatch: pytest.MonkeyPatch) -> None:
    env = played(Engine(), monkeypatch, time_limit=3)
    env.reset(seed=0)
    assert [env.step(chosen("noop"))[2:4] for _ in range(3)] == [(False, False)] * 2 + [(False, True)]


@pytest.mark.covers("LOOP-33")
def test_every_reset_asks_for_the_world_of_its_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    engines = [Engine(), Engine()]
    for engine in engines:
        env = played(engine, monkeypatch)
        env.reset(seed=3)
        env.reset()
        env.reset()
    calls = engines[0].calls
    assert calls == engines[1].calls
    assert [call if call == "reset" else call[0] for call in calls] == ["seed", "reset"] * 3
    seeds = [call[1] for call in calls[::2]]
    assert len(set(seeds)) == 3
    assert all(0 <= seed < 2**31 for seed in seeds)


@pytest.mark.covers("LOOP-32")
def test_a_lost_game_is_a_failure_and_no_record(monkeypatch: pytest.MonkeyPatch) -> None:
    """The engine says it in the info, beside an observation that was drawn at random."""
    engine = Engine()
    env = played(engine, monkeypatch)
    env.reset(seed=0)
    engine.coming = [{"died": True, "diamond": 7, "info": {"error": "Connection timed out!"}}]
    with pytest.raises(RuntimeError, match="MineRL lost its game: Connection timed out!"):
        env.step(chosen("noop"))


def test_the_milestones_are_in_the_info_of_every_step() -> None:
    engine = Engine()
    env = MinecraftEnv(engine, Play("minecraft", "diamond", render=True), 4, 60, 0.01)
    record, _ = env.reset(seed=0)
    assert env.render_mode == "rgb_array"
    assert env.render() is record["image"]
    engine.coming = [{"log": 1}, {"log": 0}]
    for _ in range(2):
        info = env.step(0)[4]
        assert info == {"milestones": {item: float(item == "log") for item in MILESTONES}}
    env.close()
    assert engine.calls[-1] == "close"


def test_there_is_one_task_and_without_the_engine_the_page_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="unknown task 'minecraft:wood'; known: diamond"):
        make_task("minecraft:wood")
    monkeypatch.setitem(sys.modules, "minerl", None)
    monkeypatch.setitem(sys.modules, "minerl.herobraine.env_spec", None)
    with pytest.raises(UserError, match=r"needs the package minerl\S*: see docs/suites.md"):
        make_task("minecraft:diamond")


def test_the_authors_build_of_the_package_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if name == "minerl":
            raise importlib.metadata.PackageNotFoundError(name)
        return "0.4.3"

    monkeypatch.setattr(importlib.metadata, "version", version)
    with pytest.raises(UserError, match=r"needs minerl==0.4.4, and 0.4.3 is installed"):
        make_task("minecraft:diamond")


def test_another_version_of_the_package_is_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "version", lambda _: "1.0.2")
    with pytest.raises(UserError, match=r"needs minerl==0.4.4, and 1.0.2 is installed: see docs/suites.md"):
        make_task("minecraft:diamond")
