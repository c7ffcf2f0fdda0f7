"""Crafter: seeds reproduce episodes, the limit truncates, death is terminal, and what was unlocked can be logged."""

from typing import Any

import numpy as np
import pytest

from dreamer_spec.envs import make_env
from dreamer_spec.envs.adapter import ContractEnv
from dreamer_spec.errors import UserError
from dreamer_spec.suites import protocol
from spec import Discrete, Image

pytest.importorskip("crafter", reason="Crafter is not installed: pip install 'dreamer-spec[crafter]'")

from dreamer_spec.envs.suites.crafter import CrafterEnv, OrderedObjects

ACTIONS = 17


def made(image_size: int = 64, time_limit: int = 10_000, **options: Any) -> ContractEnv:
    return make_env("crafter:reward", image_size=image_size, time_limit=time_limit, **options)


def game(env: ContractEnv) -> Any:
    assert isinstance(env._env, CrafterEnv)
    return env._env._env


def action(chosen: int) -> np.ndarray:
    return np.eye(ACTIONS, dtype=np.float32)[chosen]


def lived(seed: int, steps: int, look_every: int = 0) -> list[tuple[np.ndarray, float]]:
    """Records of random actions of a player who is healed all the time, so that a world goes on until lava ends it."""
    env, rng = made(), np.random.default_rng(seed)
    records = [(env.reset(seed=seed)[0]["image"], 0.0)]
    for step in range(steps):
        game(env)._player.health = 9
        observation, reward, dead, truncated, _ = env.step(action(int(rng.integers(ACTIONS))))
        assert not truncated
        records.append((observation["image"], reward))
        if dead:
            records.append((env.reset()[0]["image"], 0.0))
        if look_every and step % look_every == 0:
            assert env.render().shape == (576, 576, 3)
    return records


def alike(left: list[tuple[np.ndarray, float]], right: list[tuple[np.ndarray, float]]) -> bool:
    return all((a[0] == b[0]).all() and a[1] == b[1] for a, b in zip(left, right, strict=True))


def test_the_observation_and_the_actions_are_those_of_the_protocol() -> None:
    env = made()
    assert env.spaces.observations == {"image": Image(64, 64, 3)}
    assert env.spaces.actions == {"action": Discrete((ACTIONS,))}
    for profile in ("paper", "official"):
        found = protocol("crafter", profile)
        assert (found["image_size"], found["time_limit"]) == (64, game(env)._length)
    assert [made(side).reset(seed=0)[0]["image"].shape for side in (32, 96)] == [(32, 32, 3), (96, 96, 3)]
    with pytest.raises(UserError, match="unknown task 'crafter:reword'; known: reward"):
        make_env("crafter:reword")


@pytest.mark.covers("LOOP-33", "LOOP-34")
def test_seeds_reproduce_long_episodes_bit_for_bit() -> None:
    first = lived(6, 1500)
    assert alike(first, lived(6, 1500))
    assert not alike(first[:51], lived(1, 50))


@pytest.mark.covers("LOOP-33")
def test_who_looks_changes_nothing_at_night_either() -> None:
    """The night is noise of the game's own generator."""
    assert alike(lived(2, 300), lived(2, 300, look_every=7))


def test_each_chunk_lists_its_objects_in_the_order_in_which_they_came() -> None:
    """Python's sets of objects have an order that no seed decides."""
    env = made()
    env.reset(seed=0)
    chunks = game(env)._world._chunks
    assert len(chunks) > 10
    assert all(isinstance(objects, OrderedObjects) for objects in chunks.values())
    entries = [object() for _ in range(50)]
    held = OrderedObjects()
    for entry in entries:
        held.add(entry)
    held.remove(entries[3])
    held.add(entries[3])
    held.add(entries[0])
    assert list(held) == [*entries[:3], *entries[4:], entries[3]]
    with pytest.raises(KeyError):
        held.remove(object())


@pytest.mark.covers("LOOP-29", "LOOP-33")
def test_an_episode_does_not_depend_on_those_before() -> None:
    env = made()
    env.reset(seed=5)
    for _ in range(20):
        env.step(action(0))
    again = env.reset(seed=5, options={"episode": 3})[0]["image"]
    assert (again == made().reset(seed=5, options={"episode": 3})[0]["image"]).all()
    assert (again != env.reset()[0]["image"]).any()


@pytest.mark.covers("LOOP-28")
def test_the_limit_truncates_and_death_is_terminal() -> None:
    env = made(time_limit=12)
    env.reset(seed=0)
    assert [env.step(action(0))[2:4] for _ in range(12)] == [(False, False)] * 11 + [(False, True)]
    for deadly in (5, 12):  # before the limit, and at the same time
        env.reset(seed=0)
        for step in range(1, deadly + 1):
            if step == deadly:
                game(env)._player.health = 0
            ends = env.step(action(0))[2:4]
        assert ends == (True, False)


@pytest.mark.covers("LOOP-27")
def test_repeated_actions_sum_their_rewards_and_stop_at_the_end() -> None:
    env = made(time_limit=6, action_repeat=4)
    env.reset(seed=0)
    game(env)._player.health = 4  # of the 9 at the reset
    assert env.step(action(0))[1:4] == (pytest.approx(-0.5), False, False)
    assert env.step(action(0))[2:4] == (False, True)
    assert game(env)._step == 6


def test_rewards_are_health_and_achievements_and_these_can_be_logged() -> None:
    env, rng = made(info_metrics=("unlocked/*", "achievements/*")), np.random.default_rng(0)
    env.reset(seed=0)
    health, known, over = game(env)._player.health, set(), False
    while not over:
        _, reward, over, _, info = env.step(action(int(rng.integers(ACTIONS))))
        player = game(env)._player
        now = {name for name, count in player.achievements.items() if count > 0}
        assert reward == pytest.approx((player.health - health) / 10 + (now != known))
        health, known = player.health, now
    assert known
    values = info["metrics"].values
    unlocked = {name.removeprefix("unlocked/"): value for name, value in values.items() if name.startswith("unlocked/")}
    assert unlocked == {name: float(name in known) for name in player.achievements}
    assert len(unlocked) == 22
    assert values["achievements/wake_up"] == player.achievements["wake_up"]
