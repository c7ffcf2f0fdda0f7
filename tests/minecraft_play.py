"""Minecraft Diamond as tests play it, with one engine or another."""

from typing import Any

import numpy as np
import pytest

from dreamer_spec.envs import ContractEnv, factory, suites
from dreamer_spec.envs.suites.minecraft import Held, MinecraftEnv, controls
from dreamer_spec.suites import protocol
from spec import benchmarks

ACTIONS = benchmarks()["minecraft"]["actions"]
MILESTONES = benchmarks()["minecraft"]["milestones"]


def sent(names: list[str], jump_steps: int = 4, pitch_limit: float = 60) -> list[dict[str, Any]]:
    """What the engine gets for actions, one after the other from a reset."""
    held, found = Held(), []
    for name in names:
        action, held = controls(ACTIONS[name], held, jump_steps, pitch_limit)
        found.append(action)
    return found


def played(
    engine: Any, monkeypatch: pytest.MonkeyPatch, time_limit: int | None = 36_000, **arguments: Any
) -> ContractEnv:
    """As a run plays it: through the factory, with an engine that is there already."""
    entry = {**protocol("minecraft", "paper")["env"], **arguments}
    del entry["break_speed"]
    monkeypatch.setattr(suites, "make", lambda play, _: MinecraftEnv(engine, play, **entry))
    return factory.make_env("minecraft:diamond", time_limit=time_limit)


def chosen(name: str) -> np.ndarray:
    return np.eye(25, dtype=np.float32)[list(ACTIONS).index(name)]
