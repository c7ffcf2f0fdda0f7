"""ProcGen: an episode is a function of its reset's seed and its actions, and nothing of the next one enters it."""

import importlib
import importlib.util
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dreamer_spec.envs import make_env
from dreamer_spec.envs.adapter import ContractEnv
from dreamer_spec.envs.suites import Play, procgen
from dreamer_spec.errors import UserError
from dreamer_spec.suites import SUITES, install, protocol, tasks_of
from reference_numpy.training_loop import derive_seed
from spec import Discrete, Image

NOTHING, ACTIONS = 4, 15
needs_package = pytest.mark.skipif(
    any(importlib.util.find_spec(package) is None for package in SUITES["procgen"].needs),
    reason=f"ProcGen is not installed: {install('procgen')}",
)


def made(name: str, profile: str = "paper", action_repeat: int = 1, **arguments: Any) -> ContractEnv:
    found = protocol("procgen", profile)
    return make_env(
        f"procgen:{name}",
        image_size=found["image_size"],
        action_repeat=action_repeat,
        arguments={**found["env"], **arguments},
        info_metrics=("level_complete",),
    )


def action(chosen: int) -> np.ndarray:
    return np.eye(ACTIONS, dtype=np.float32)[chosen]


def played(env: ContractEnv, seed: int, steps: int) -> list[tuple[np.ndarray, float, bool, bool, dict[str, Any]]]:
    """Records, resets among them, of random actions that depend on the seed alone."""
    rng, records = np.random.default_rng(seed), [(env.reset(seed=seed)[0]["image"], 0.0, False, False, {})]
    for _ in range(steps):
        observation, *rest = env.step(action(int(rng.integers(ACTIONS))))
        records.append((observation["image"], *rest))
        if rest[1] or rest[2]:
            records.append((env.reset()[0]["image"], 0.0, False, False, {}))
    return records


def alike(left: list[Any], right: list[Any]) -> bool:
    same = ((a[0] == b[0]).all() and a[1:] == b[1:] for a, b in zip(left, right, strict=False))
    return len(left) == len(right) and all(same)


# Without the package


class FakeGame:
    """Frames that count the steps; the third action ends the episode and shows the next one."""

    def __init__(self, rand_seed: int, **_: Any) -> None:
        self.frame, self.closed, self._steps = np.full((512, 512, 3), rand_seed % 100, np.uint8), False, 0

    def step(self, action: int) -> tuple[float, bool, bool]:
        self._steps += 1
        over = self._steps == 3
        self.frame[:] = 200 if over else self.frame + 1
        return float(self._steps), over, True

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def games(monkeypatch: pytest.MonkeyPatch) -> list[FakeGame]:
    made: list[FakeGame] = []

    def make(**options: Any) -> FakeGame:
        assert not any(game.closed for game in made[-1:])  # The library keeps what it has read.
        made.append(FakeGame(**options))
        return made[-1]

    monkeypatch.setattr(procgen, "_package", lambda: None)
    monkeypatch.setattr(procgen, "_game", make)
    return made


@pytest.mark.covers("LOOP-11", "LOOP-27", "LOOP-29")
def test_nothing_of_the_next_episode_enters_the_last_record(games: list[FakeGame]) -> None:
    env = procgen.make(Play("procgen", "coinrun", image_size=8))
    first = env.reset(seed=7)[0]["image"]
    assert first.shape == (8, 8, 3)
    assert (first == 7).all()
    steps = [env.step(0) for _ in range(3)]
    assert [int(step[0]["image"].max()) for step in steps] == [8, 9, 9]
    assert [step[1:] for step in steps] == [
        (1.0, False, False, {"level_complete": 0}),
        (2.0, False, False, {"level_complete": 0}),
        (3.0, True, False, {"level_complete": 1}),
    ]
    assert (env.render() == 9).all()
    assert (env.reset(seed=2**31 + 5)[0]["image"] == 5).all()
    assert [game.closed for game in games] == [True, False]
    env.close()
    assert games[-1].closed


@pytest.mark.parametrize(
    ("name", "arguments", "words"),
    [
        ("coinrum", {}, "unknown task 'procgen:coinrum'; known: bigfish, "),
        ("coinrun", {"difficulty": "extreme"}, "difficulty is 'extreme'; expected easy or hard"),
        ("coinrun", {"levels": -1}, "levels is -1; expected their number, or 0 for all"),
        ("coinrun", {"levels": True}, "levels is True"),
        ("coinrun", {"timeout_is_terminal": False}, "only true is possible"),
    ],
)
def test_what_cannot_be_played_is_refused(name: str, arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(UserError, match=words):
        make_env(f"procgen:{name}", arguments=arguments)


def test_a_missing_package_is_named_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    for package in SUITES["procgen"].needs[:2]:
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(UserError, match=r"needs the package \w+: pip install --no-deps procgen-"):
        make_env("procgen:coinrun")


def test_what_stands_in_for_a_module_is_gone_afterwards() -> None:
    with procgen._without("shelf.wing", "no_such_package", answer=42):
        assert importlib.import_module("shelf.wing").answer == 42
    assert "shelf.wing" not in sys.modules
    with procgen._without("shelf.wing", "numpy"):
        assert "shelf.wing" not in sys.modules


# With it

IMPORTED = """
import sys
for name in ("gym", "imageio"):
    sys.modules[name] = None  # as if it was not installed
from dreamer_spec.envs import make_env
make_env("procgen:coinrun").reset(seed=0)
left = {name for name in sys.modules if name.partition(".")[0] in ("gym", "imageio")}
assert left == {"gym", "imageio"}, left
assert sys.modules["gym"] is sys.modules["imageio"] is None
assert not {"gym3.video_recorder", "procgen.gym_registration"} & set(sys.modules)
"""
FRAMES = """
import hashlib, sys
from test_train_procgen import made, played
made(sys.argv[1]).reset(seed=int(sys.argv[2]))
image = hashlib.sha256()
for record in played(made("starpilot"), 3, 150):
    image.update(record[0].tobytes() + repr(record[1:]).encode())
print(image.hexdigest())
"""


def in_a_process(code: str, *arguments: str) -> str:
    here = Path(__file__).parent
    run = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=300, cwd=here
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


@needs_package
def test_old_packages_need_not_be_there_and_nothing_pretends_to_be_them() -> None:
    in_a_process(IMPORTED)


@needs_package
@pytest.mark.parametrize("profile", ["paper", "official"])
def test_the_observation_and_the_actions_are_those_of_the_protocol(profile: str) -> None:
    env = made("coinrun", profile)
    assert env.spaces.observations == {"image": Image(96, 96, 3)}
    assert env.spaces.actions == {"action": Discrete((ACTIONS,))}
    assert protocol("procgen", profile)["env"] == {"difficulty": "hard", "levels": 0, "timeout_is_terminal": True}
    image = env.reset(seed=0)[0]["image"]
    assert image.dtype == np.uint8
    assert len(np.unique(image)) > 50
    assert env.render().shape == (512, 512, 3)


@needs_package
@pytest.mark.covers("LOOP-33", "LOOP-34")
@pytest.mark.parametrize("name", tasks_of("procgen"))
def test_seeds_reproduce_episodes_whatever_was_played_before(name: str) -> None:
    used = made(name)
    played(used, 8, 20)
    first, again = played(used, 3, 70), played(made(name), 3, 70)
    assert alike(first, again)
    assert not alike(first, played(used, 4, 70))


@needs_package
@pytest.mark.covers("LOOP-34")
def test_seeds_reproduce_episodes_in_another_process() -> None:
    assert in_a_process(FRAMES, "maze", "5") == in_a_process(FRAMES, "chaser", "6")


@needs_package
@pytest.mark.covers("LOOP-11", "LOOP-29")
def test_an_episode_ends_with_its_own_frame_and_the_next_begins_with_its_first() -> None:
    env, rng = made("starpilot"), np.random.default_rng(0)
    before = env.reset(seed=1)[0]["image"]
    alone = procgen._game(
        env_name="starpilot", rand_seed=derive_seed(1, "episode", 0), distribution_mode="hard", num_levels=0
    )
    over, total = False, 0.0
    while not over:
        chosen = int(rng.integers(ACTIONS))
        observation, reward, over, truncated, info = env.step(action(chosen))
        assert (reward, over) == alone.step(chosen)[:2]
        total += reward
        if not over:
            before = observation["image"]
    assert total > 0
    assert not truncated
    assert info["metrics"].values == {"level_complete": 0.0}
    assert (observation["image"] == before).all()  # The game shows the next level already.
    assert abs(alone.frame.mean() - env.render().mean()) > 0.1
    begun = env.reset()[0]["image"]
    assert (begun == made("starpilot").reset(seed=1, options={"episode": 1})[0]["image"]).all()
    assert (begun != before).any()


@needs_package
@pytest.mark.covers("LOOP-28")
def test_a_time_out_is_terminal() -> None:
    env = made("maze")
    env.reset(seed=0)
    ends = [env.step(action(NOTHING))[2:4] for _ in range(500)]
    assert ends == [(False, False)] * 499 + [(True, False)]


@needs_package
@pytest.mark.covers("LOOP-27")
def test_repeated_actions_sum_their_rewards_and_stop_at_the_end() -> None:
    def episode(repeat: int) -> tuple[list[float], int]:
        env = made("starpilot", action_repeat=repeat)
        env.reset(seed=1)
        rng, rewards, over = np.random.default_rng(0), [], False
        while not over:
            chosen = int(rng.integers(ACTIONS))
            for _ in range(4 // repeat):
                _, reward, over, _, _ = env.step(action(chosen))
                rewards.append(reward)
                if over:
                    break
        return rewards, len(rewards)

    (single, frames), (summed, records) = episode(1), episode(4)
    assert records == -(-frames // 4)
    assert summed == [sum(single[start : start + 4]) for start in range(0, frames, 4)]
    assert frames % 4 != 0  # else it would not show


@needs_package
def test_levels_and_difficulty_are_arguments() -> None:
    first = {seed: made("maze", levels=1).reset(seed=seed)[0]["image"] for seed in (0, 1)}
    assert (first[0] == first[1]).all()
    hard, easy = (made("maze", difficulty=difficulty, levels=1) for difficulty in ("hard", "easy"))
    assert (hard.reset(seed=0)[0]["image"] == first[0]).all()
    assert (easy.reset(seed=0)[0]["image"] != first[0]).any()


@needs_package
def test_an_episode_that_reaches_its_goal_says_so() -> None:
    ends = [record for record in played(made("maze", difficulty="easy"), 0, 3000) if record[2]]
    assert len(ends) >= 5
    completed = [(record[4]["metrics"].values["level_complete"] == 1, record[1] == 10) for record in ends]
    assert {(True, True), (False, False)} >= set(completed)
    assert (True, True) in completed
