"""Minecraft Diamond as a Gymnasium environment, on MineRL: [D-102] to [D-106].

MineRL 0.4.4 has to be installed with JDK 8, and fetches the game (docs/suites.md). What it is given is a task of
its own kind, an `EnvSpec`; what comes of it is an environment of the Gym of before Gymnasium, with dictionaries.
"""

import contextlib
import importlib
import importlib.metadata
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces as gym

from dreamer_spec.envs.suites import Play
from dreamer_spec.errors import UserError
from spec import benchmarks

KEYS = ("forward", "back", "left", "right", "jump", "attack")
CHOICES = ("place", "equip", "craft", "nearbyCraft", "nearbySmelt")  # each takes the name of an item, or none
NONE, AIR, OTHER = "none", "air", "other"  # the engine's words
IDLE: Mapping[str, Any] = {**dict.fromkeys(KEYS, 0), "camera": (0, 0), **dict.fromkeys(CHOICES, NONE)}
FULL = {"health": ("life", 20), "hunger": ("food", 20), "breath": ("air", 300)}  # name -> the engine's, and the most
FPS = 20
DISTRIBUTIONS = ("minerl", "minerl-mirror")  # the second is the authors' build of the same version


def make(
    play: Play,
    jump_steps: int = 4,
    break_speed: float = 100.0,
    pitch_limit: float = 60,
    health_reward: float = 0.01,
) -> gymnasium.Env[Any, Any]:
    """The task `diamond`. jump_steps: control steps that jump, and forward with it, are held for, the first included.
    break_speed: how many times faster than in the game blocks break. pitch_limit: degrees that the view can be turned
    up or down. health_reward: for all of the health that there is.

    Raises:
      UserError: another task, or another version of the package.
    """
    protocol = benchmarks()["minecraft"]
    if play.name not in protocol["tasks"]:
        raise UserError(f"unknown task {play.task!r}; known: {', '.join(protocol['tasks'])}")
    found = _version()
    if f"minerl=={found}" != protocol["engine"]:
        raise UserError(f"task {play.task} needs {protocol['engine']}, and {found} is installed: see docs/suites.md")
    engine = engine_task(play.image_size, break_speed).make()
    return MinecraftEnv(engine, play, jump_steps, pitch_limit, health_reward)


class MinecraftEnv(gymnasium.Env[Any, Any]):
    """Dying ends an episode, breaking diamond ore does not ([D-106]). Each reset makes a new world from its seed; what
    happens in it is the game's, whose ticks and creatures have no seed: [LOOP-33] holds for the world alone.

    engine: MineRL's environment. The info of a step says, under "milestones", which have been reached.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012

    def __init__(self, engine: Any, play: Play, jump_steps: int, pitch_limit: float, health_reward: float) -> None:
        self._engine, self._jump_steps = engine, jump_steps
        self._pitch_limit, self._health_reward = pitch_limit, health_reward
        self.render_mode = "rgb_array" if play.render else None
        protocol, space = benchmarks()["minecraft"], engine.observation_space
        self._actions, self._milestones = list(protocol["actions"].values()), protocol["milestones"]
        self._items = [item for item in space["inventory"].spaces if item != "log2"]
        self._equipment = [str(item) for item in space["equipped_items"]["mainhand"]["type"].values]
        self._held = Held()
        self._most: dict[str, int] = {}
        self._seen: dict[str, Any] = {}
        sizes = {"inventory": len(self._items), "inventory_max": len(self._items), "equipped": len(self._equipment)}
        spaces: dict[str, gym.Space[Any]] = {
            "image": gym.Box(0, 255, (play.image_size, play.image_size, 3), np.uint8),
            **{name: gym.Box(0, np.inf, (size,), np.float32) for name, size in sizes.items()},
            **{name: gym.Box(0, np.inf, (), np.float32) for name in FULL},
        }
        self.observation_space = gym.Dict(spaces)
        self.action_space = gym.Discrete(len(self._actions))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            self._engine.seed(seed, seed_spaces=False)  # Of the next world alone; it forgets it then.
        found = self._engine.reset()
        self._held, self._most = Held(), counts(found["inventory"])
        self._seen = self._observation(found)
        return self._seen, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        sent, self._held = controls(self._actions[int(action)], self._held, self._jump_steps, self._pitch_limit)
        found, _, died, info = self._engine.step(sent)
        if "error" in info:  # With an observation that is not of this world.
            raise RuntimeError(f"MineRL lost its game: {info['error']}")
        now, health = counts(found["inventory"]), self._seen["health"]
        reward = float(len(reached(self._most, now, self._milestones)))
        self._most = {item: max(count, self._most[item]) for item, count in now.items()}
        self._seen = self._observation(found)
        reward += self._health_reward * float(self._seen["health"] - health)
        had = {item: float(self._most[item] > 0) for item in self._milestones}
        return self._seen, reward, bool(died), False, {"milestones": had}

    def _observation(self, found: Mapping[str, Any]) -> dict[str, Any]:
        now = counts(found["inventory"])
        return {
            "image": np.ascontiguousarray(found["pov"]),
            "inventory": np.array([now[item] for item in self._items], np.float32),
            "inventory_max": np.array([self._most[item] for item in self._items], np.float32),
            "equipped": one_hot(str(found["equipped_items"]["mainhand"]["type"]), self._equipment),
            **levels(found["life_stats"]),
        }

    def render(self) -> Any:
        return self._seen["image"]

    def close(self) -> None:
        self._engine.close()


def _version() -> str:
    for name in DISTRIBUTIONS:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            return importlib.metadata.version(name)
    raise ModuleNotFoundError("No module named 'minerl'", name="minerl")


# What the environment decides by


class Held(NamedTuple):
    """jump: control steps for which it is still held. pitch: degrees that the view is turned down."""

    jump: int = 0
    pitch: float = 0


def controls(action: Mapping[str, Any], held: Held, jump_steps: int, pitch_limit: float) -> tuple[dict[str, Any], Held]:
    """What the engine gets for an action of [minecraft.actions], and what is held after it. A look beyond the limit
    moves nothing."""
    sent = {**IDLE, **action}
    jump = jump_steps if sent["jump"] else held.jump
    if jump:
        sent |= {"jump": 1, "forward": 1}
    pitch, yaw = sent["camera"]
    if abs(held.pitch + pitch) > pitch_limit:
        pitch = 0
    sent["camera"] = np.array([pitch, yaw], np.float32)
    return sent, Held(max(jump - 1, 0), held.pitch + pitch)


def counts(inventory: Mapping[str, Any]) -> dict[str, int]:
    """Item -> how many, both kinds of log together: [D-105]."""
    found = {item: int(count) for item, count in inventory.items()}
    found["log"] += found.pop("log2")
    return found


def reached(most: Mapping[str, int], now: Mapping[str, int], milestones: Collection[str]) -> list[str]:
    """Milestones that are held now and never were before in the episode. most: the largest counts so far, the reset's
    included: what an episode begins with pays nothing."""
    return [item for item in milestones if now[item] > 0 and most[item] == 0]


def one_hot(name: str, names: Collection[str]) -> np.ndarray:
    found = np.array([name == one for one in names], np.float32)
    assert found.sum() == 1, f"{name} is not among the engine's"
    return found


def levels(stats: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Health, hunger and breath, as parts of a full bar."""
    return {name: np.asarray(float(stats[key]) / most, np.float32) for name, (key, most) in FULL.items()}


# What the engine is told


def engine_task(side: int, break_speed: float) -> Any:
    """The task in MineRL's terms: a new world of the ordinary kind, nothing in the hands, day and night pass, creatures
    appear. What is not said here is empty."""
    _name_old_types()
    hero = "minerl.herobraine.hero"
    base = importlib.import_module("minerl.herobraine.env_spec").EnvSpec
    handlers, mc = importlib.import_module(f"{hero}.handlers"), importlib.import_module(f"{hero}.mc")
    handler = importlib.import_module(f"{hero}.handler").Handler

    class BreakSpeed(handler):  # type: ignore[misc, valid-type]
        """In the mission's schema, but not among the package's handlers."""

        def to_string(self) -> str:
            return "break_speed"

        def xml_template(self) -> str:
            return f"<BreakSpeedMultiplier>{break_speed}</BreakSpeedMultiplier>"

    def items_of(choice: str) -> list[str]:
        used = {action[choice] for action in benchmarks()["minecraft"]["actions"].values() if choice in action}
        return [NONE, *sorted(used)]

    kinds = {
        "place": handlers.PlaceBlock,
        "equip": handlers.EquipAction,
        "craft": handlers.CraftAction,
        "nearbyCraft": handlers.CraftNearbyAction,
        "nearbySmelt": handlers.SmeltItemNearby,
    }
    said = {
        "create_observables": lambda: [
            handlers.POVObservation((side, side)),
            handlers.FlatInventoryObservation(mc.ALL_ITEMS),
            handlers.EquippedItemObservation(mc.ALL_ITEMS, _default=AIR, _other=OTHER),
            handlers.ObservationFromLifeStats(),
        ],
        "create_actionables": lambda: [
            *(handlers.KeybasedCommandAction(key, mc.INVERSE_KEYMAP[key]) for key in KEYS),
            handlers.CameraAction(),
            *(kind(items_of(choice), _other=NONE, _default=NONE) for choice, kind in kinds.items()),
        ],
        "create_agent_start": lambda: [BreakSpeed()],
        "create_server_world_generators": lambda: [handlers.DefaultWorldGenerator(force_reset=True)],
        "create_server_initial_conditions": lambda: [
            handlers.TimeInitialCondition(allow_passage_of_time=True, start_time=0),
            handlers.SpawningInitialCondition(allow_spawning=True),
        ],
        "create_server_quit_producers": lambda: [handlers.ServerQuitWhenAnyAgentFinishes()],
    }
    members = {name: _method(said.get(name, list)) for name in base.__abstractmethods__}
    return type("Diamond", (base,), members)("MineRLDiamond-v1")


def _method(function: Any) -> Any:
    return lambda self, *_: function()


def _name_old_types() -> None:
    """The package uses names that NumPy has dropped since."""
    for name, kind in {"float": float, "int": int, "bool": bool}.items():
        if not hasattr(np, name):
            setattr(np, name, kind)
