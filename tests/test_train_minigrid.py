"""MiniGrid: every id of the package, drawn with whole pixels, reproduced by its seed."""

import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest

from dreamer_spec.envs import make_env
from dreamer_spec.envs.adapter import ContractEnv
from dreamer_spec.errors import UserError
from dreamer_spec.suites import protocol, tasks_of
from spec import Discrete, Image, Vector

pytest.importorskip("minigrid", reason="MiniGrid is not installed: pip install 'dreamer-spec[minigrid]'")

from dreamer_spec.envs.suites.minigrid import MiniGridEnv
from dreamer_spec.envs.suites.text import encode, tokens

EMPTY = "MiniGrid-Empty-5x5-v0"
LEFT, FORWARD = 0, 2
SENT = f"""
import warnings
import gymnasium
from gymnasium.envs.registration import EnvSpec
from dreamer_spec.envs.sending import register
from dreamer_spec.envs import make_env
register([EnvSpec("{EMPTY}", "minigrid.envs:EmptyEnv")])
warnings.simplefilter("error")
make_env("minigrid:{EMPTY}")
"""


def made(name: str = EMPTY, image_size: int = 64, action_repeat: int = 1, **arguments: Any) -> ContractEnv:
    return make_env(f"minigrid:{name}", image_size=image_size, action_repeat=action_repeat, arguments=arguments)


def world(env: ContractEnv) -> Any:
    assert isinstance(env._env, MiniGridEnv)
    return env._env._world


def action(env: ContractEnv, chosen: int) -> np.ndarray:
    return np.eye(env.spaces.action_size, dtype=np.float32)[chosen]


def played(env: ContractEnv, seed: int, steps: int) -> list[Any]:
    rng = np.random.default_rng(seed)
    records: list[Any] = [(env.reset(seed=seed)[0],)]
    for _ in range(steps):
        records.append(env.step(action(env, int(rng.integers(env.spaces.action_size)))))
        if records[-1][2] or records[-1][3]:
            records.append((env.reset()[0],))
    return records


def known() -> list[str]:
    made()
    return [name for name, spec in gymnasium.registry.items() if str(spec.entry_point).startswith("minigrid.")]


def test_the_observation_is_drawn_with_whole_pixels_and_the_direction_is_beside_it() -> None:
    env = made()
    assert protocol("minigrid", "paper")["env"] == {"full_view": False}
    assert env.spaces.observations == {"direction": Discrete((4,)), "image": Image(64, 64, 3)}
    assert env.spaces.actions == {"action": Discrete((7,))}
    seen = env.reset(seed=0)[0]
    drawn = world(env).get_frame(tile_size=9, agent_pov=True)
    assert drawn.shape == (63, 63, 3)
    assert (seen["image"][:63, :63] == drawn).all()
    assert (seen["image"][63] == 0).all()
    assert (seen["image"][:, 63] == 0).all()
    assert seen["direction"] == 0
    turned = env.step(action(env, LEFT))[0]
    assert turned["direction"] == 3


def test_the_whole_grid_lies_in_the_middle_of_the_image() -> None:
    env = made("MiniGrid-UnlockPickup-v0", full_view=True)
    image = env.reset(seed=0)[0]["image"]
    drawn = world(env).get_frame(tile_size=5)
    assert drawn.shape == (30, 55, 3)
    assert (image[17:47, 4:59] == drawn).all()
    assert image.sum() == drawn.sum()
    directions = [env.step(action(env, LEFT))[0]["image"] for _ in range(4)]
    assert len({image.tobytes() for image in directions}) == 4


def test_what_cannot_be_played_is_refused() -> None:
    with pytest.raises(UserError, match=r"unknown task 'minigrid:MiniGrid-Empty-5x5'; did you mean MiniGrid-Empty-5x5"):
        made("MiniGrid-Empty-5x5")
    with pytest.raises(UserError, match="unknown task 'minigrid:CartPole-v1'; known are the 1"):
        made("CartPole-v1")
    with pytest.raises(UserError, match="image of 48 pixels is too small for 25 x 25 tiles; --image-size 50 or more"):
        made("MiniGrid-MultiRoom-N6-v0", image_size=48, full_view=True)


@pytest.mark.covers("LOOP-33", "LOOP-34")
def test_seeds_reproduce_the_episodes_of_every_id() -> None:
    """Those of WFC need pictures that the installed package does not have."""
    names = [name for name in known() if "-WFC-" not in name]
    assert len(names) > 150
    differ = 0
    for name in names:
        env = made(name)
        played(env, 5, 3)
        first = played(env, 1, 12)
        np.testing.assert_equal(first, played(made(name), 1, 12))
        differ += any((a[0]["image"] != b[0]["image"]).any() for a, b in zip(first, played(env, 2, 12), strict=False))
    assert differ > 150
    with pytest.raises(UserError, match=r"a file of the package minigrid is missing: .*png|imageio is missing"):
        made("MiniGrid-WFC-MazeSimple-v0")


@pytest.mark.parametrize("name", [*tasks_of("minigrid"), "MiniGrid-Fetch-5x5-N2-v0", "BabyAI-BossLevel-v0"])
def test_the_mission_is_told_where_it_changes(name: str) -> None:
    assert name in known()
    env = made(name)
    episodes = [env._env.reset(seed=seed) for seed in range(20)]
    missions = [info["mission"] for _, info in episodes]
    if "mission" not in env.spaces.observations:
        assert len(set(missions)) == 1
        return
    assert env.spaces.observations["mission"] == Vector(2048)
    assert max(len(tokens("minigrid", mission)) for mission in missions) <= 64
    for seen, mission in zip(episodes, missions, strict=True):
        np.testing.assert_array_equal(seen[0]["mission"], encode("minigrid", mission))
    assert len({seen[0]["mission"].tobytes() for seen in episodes}) == len(set(missions))


def test_ids_that_came_from_another_process_are_no_news() -> None:
    run = subprocess.run([sys.executable, "-c", SENT], capture_output=True, text=True, timeout=300)
    assert (run.returncode, run.stderr) == (0, "")


@pytest.mark.covers("LOOP-28")
def test_the_goal_is_terminal_and_the_limit_of_the_package_truncates() -> None:
    env = made()
    env.reset(seed=0)
    ends = [env.step(action(env, LEFT))[1:4] for _ in range(100)]
    assert ends == [(0.0, False, False)] * 99 + [(0.0, False, True)]
    env.reset(seed=0)
    way = [FORWARD, FORWARD, 1, FORWARD, FORWARD]
    ends = [env.step(action(env, chosen))[1:4] for chosen in way]
    assert ends[:-1] == [(0.0, False, False)] * 4
    assert ends[-1] == (pytest.approx(1 - 0.9 * 5 / 100), True, False)


@pytest.mark.covers("LOOP-27")
def test_repeated_actions_stop_at_the_end() -> None:
    env = made(action_repeat=3)
    env.reset(seed=0)
    ends = [env.step(action(env, LEFT))[2:4] for _ in range(34)]
    assert ends == [(False, False)] * 33 + [(False, True)]
    assert world(env).step_count == 100
