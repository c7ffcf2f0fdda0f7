"""Minecraft Diamond on MineRL's own Python layer, where it is installed: its spaces, its commands, the schema of its
missions. The game itself is not in it."""

import copy
import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from minecraft_play import ACTIONS, MILESTONES, chosen, played, sent

from dreamer_spec.envs.suites import minecraft
from dreamer_spec.envs.suites.minecraft import IDLE


def minerl(name: str = "") -> Any:
    minecraft._name_old_types()
    pytest.importorskip("minerl.herobraine.env_spec", reason="MineRL 0.4.4 is not installed")
    return importlib.import_module(f"minerl{name}")


def real_task() -> Any:
    minerl()
    return minecraft.engine_task(64, 100.0)


def test_the_engines_spaces_take_every_action_and_have_every_item() -> None:
    task = real_task()
    nothing = task.action_space.no_op()
    assert {key: value for key, value in nothing.items() if key != "camera"} == {
        key: value for key, value in IDLE.items() if key != "camera"
    }
    for name in ACTIONS:
        for action in sent(["jump", name]):
            assert all(action[key] in task.action_space[key] for key in action), name
    items = task.observation_space["inventory"].spaces
    assert {*MILESTONES, "air", "log", "log2"} <= set(items)
    assert list(items) == sorted(items)
    assert len(items) == 392


def test_the_mission_is_valid_by_the_engines_schema_and_says_what_the_protocol_says() -> None:
    etree = pytest.importorskip("lxml.etree")
    folder = Path(minerl().__file__).parent / "Malmo" / "Schemas"
    schema = etree.XMLSchema(etree.parse(str(folder / "Mission.xsd")))
    mission = etree.fromstring(real_task().to_xml().encode())
    assert schema.validate(mission), schema.error_log
    names = {"m": "http://ProjectMalmo.microsoft.com"}
    assert [float(found.text) for found in mission.findall(".//m:BreakSpeedMultiplier", names)] == [100.0]
    assert [found.get("forceReset") for found in mission.findall(".//m:DefaultWorldGenerator", names)] == ["true"]
    assert [int(found.text) for found in mission.findall(".//m:VideoProducer/m:Width", names)] == [64]
    assert mission.findall(".//m:RewardForCollectingItem", names) == []
    assert mission.findall(".//m:AgentQuitFromTouchingBlockType", names) == []


def test_an_episode_through_the_engines_python_layer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything but the game: the observation that MineRL has recorded takes its place, changed by the test."""
    fake = minerl(".env._fake")

    class Recorded(fake._FakeSingleAgentEnv):  # type: ignore[misc, name-defined]
        def __init__(self, **arguments: Any) -> None:
            super().__init__(**arguments)
            self.commands: list[str] = []
            self.said: list[str] = []

        def _get_fake_malmo_data(self) -> dict[str, Any]:
            return copy.deepcopy(self._fake_malmo_data)

        def _process_action(self, actor_name: str, action_in: dict[str, Any]) -> str:
            assert self._check_action(actor_name, action_in, self.task)
            self.commands.append(super()._process_action(actor_name, action_in))
            return self.commands[-1]

        def _send_mission(self, instance: Any, mission: Any, token: str) -> None:
            self.said.append(f"{token}:{self._seed}")

    engine = Recorded(env_spec=real_task())
    env = played(engine, monkeypatch)
    record, _ = env.reset(seed=0)
    items = [item for item in engine.observation_space["inventory"].spaces if item != "log2"]
    equipment = engine.observation_space["equipped_items"]["mainhand"]["type"].values.tolist()
    assert record["inventory"].shape == record["inventory_max"].shape == (391,)
    assert (record["inventory"][items.index("compass")], record["inventory"][items.index("air")]) == (1, 364)
    assert record["equipped"].shape == (393,)
    assert [float(record[bar][0]) for bar in ("health", "hunger", "breath")] == [1, 1, 1]
    assert record["image"].shape == (64, 64, 3)
    assert record["image"].std() > 0
    data = engine._fake_malmo_data
    for index, kind in enumerate(("log", "log2", "planks"), 1):
        data["inventory"][index] |= {"type": kind, "quantity": index}
    data["equipped_items"]["mainhand"] |= {"type": "stone_pickaxe", "metadata": 0}
    data |= {"life": 16.0, "food": 10, "air": 30}
    record, reward, terminated, truncated, _ = env.step(chosen("jump"))
    assert reward == pytest.approx(2 - 0.01 * 4 / 20)
    assert (terminated, truncated) == (False, False)
    assert (record["inventory"][items.index("log")], record["inventory"][items.index("planks")]) == (3, 3)
    assert equipment[record["equipped"].argmax()] == "stone_pickaxe"
    np.testing.assert_allclose([record[bar][0] for bar in ("health", "hunger", "breath")], [0.8, 0.5, 0.1], atol=1e-7)
    for name in ACTIONS:
        env.step(chosen(name))
    expected = {
        "craft_planks": "craft planks",
        "craft_furnace": "craftNearby furnace",
        "smelt_iron_ingot": "smeltNearby iron_ingot",
        "equip_stone_pickaxe": "equip stone_pickaxe",
        "place_dirt": "place dirt",
        "look_left": "camera 0.0 -15.0",
        "attack": "attack 1",
    }
    for name, command in expected.items():
        assert command in engine.commands[1 + list(ACTIONS).index(name)].splitlines(), name
    assert engine.said[0].rpartition(":")[2].isdigit()
