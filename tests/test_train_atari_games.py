"""Atari games on the emulator of ale-py."""

import itertools
from typing import Any

import numpy as np
import pytest

from dreamer_spec.cli import parse
from dreamer_spec.envs import ContractEnv, Environments, env_maker, make_env, random_actions
from dreamer_spec.envs.suites import Play
from dreamer_spec.envs.suites.atari import AtariEnv, luminance, resized
from dreamer_spec.errors import UserError
from dreamer_spec.suites import protocol, tasks_of
from spec import Discrete, Image

ale_py = pytest.importorskip("ale_py")

TWO_PLAYERS = ("combat", "joust", "maze_craze", "warlords")
Step = tuple[dict[str, np.ndarray], float, bool, bool]


@pytest.fixture(scope="module")
def rom() -> Any:
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
    return ale_py.roms.get_rom_path("seaquest")


def made(task: str, *arguments: str) -> ContractEnv:
    """As a run has it: with the protocol of its suite."""
    return env_maker(parse(["--backend", "jax", "--task", task, *arguments]))(0)


def episode(env: ContractEnv, seed: int, steps: int = 5000) -> list[Step]:
    """Random actions, the same for each seed, to the end or for some steps."""
    found: list[Step] = [(env.reset(seed=seed)[0], 0.0, False, False)]
    for action in random_actions(env.spaces, np.random.default_rng(0), steps):
        found.append(env.step(action)[:4])
        if found[-1][2] or found[-1][3]:
            break
    return found


def same(first: list[Step], second: list[Step]) -> bool:
    return len(first) == len(second) and all(
        np.array_equal(mine[0]["image"], other[0]["image"]) and mine[1:] == other[1:]
        for mine, other in zip(first, second, strict=True)
    )


def test_every_game_of_the_paper_is_there() -> None:
    """Also those whose names differ between lists of games: jamesbond, montezuma_revenge, star_gunner, up_n_down."""
    actions = {}
    for game in tasks_of("atari"):
        env = made(f"atari:{game}")
        assert env.spaces.observations == {"image": Image(96, 96, 1)}
        (space,) = env.spaces.actions.values()
        assert isinstance(space, Discrete)
        (actions[game],) = space.classes
        steps = episode(env, 0, 10)
        assert len(steps) == 11, game
        assert steps[-1][0]["image"].max() > 0, game  # The first screen of amidar is black.
    assert {game: count for game, count in actions.items() if count != 18} == {"skiing": 9}


def test_every_game_of_atari100k_has_the_actions_that_it_needs() -> None:
    assert set(tasks_of("atari100k")) <= set(tasks_of("atari"))
    for game, count in (("pong", 6), ("freeway", 3), ("breakout", 4), ("alien", 18)):
        env = made(f"atari100k:{game}")
        assert env.spaces.observations == {"image": Image(64, 64, 3)}
        assert env.spaces.actions["action"] == Discrete((count,))


def test_other_games_can_be_played_and_those_without_rewards_are_refused() -> None:
    assert len(episode(make_env("atari:tetris"), 0, 3)) == 4
    for game in TWO_PLAYERS:
        with pytest.raises(UserError, match=f"task atari:{game}: the emulator has no rewards for this game"):
            make_env(f"atari:{game}")
    with pytest.raises(UserError, match=r"unknown task 'atari:james_bond'; did you mean jamesbond\?"):
        make_env("atari:james_bond")
    with pytest.raises(UserError, match="sticky_actions must be a probability"):
        make_env("atari:pong", arguments={"sticky_actions": 2})


@pytest.mark.covers("LOOP-33", "LOOP-34")
@pytest.mark.parametrize("task", ["atari:breakout", "atari100k:seaquest"])
def test_an_episode_is_a_function_of_its_seed_and_actions(task: str) -> None:
    """Whatever was played before it."""
    env = made(task)
    first = episode(env, 1)
    other = episode(env, 2)
    again, elsewhere = episode(env, 1), episode(made(task), 1)
    assert first[-1][2] or first[-1][3]
    assert same(first, again)
    assert same(first, elsewhere)
    assert not same(first, other)


@pytest.mark.covers("LOOP-33")
def test_the_memory_at_power_up_is_drawn_from_the_seed_too() -> None:
    """All that differs between episodes of a game without sticky actions and no-ops. The emulator's own seed of it is
    always the same."""
    env = make_env("atari100k:solaris", arguments={"noops": 0})
    images = [env.reset(seed=seed)[0]["image"] for seed in (0, 1, 2, 0)]
    assert np.array_equal(images[0], images[3])
    assert len({image.tobytes() for image in images}) == 3


def test_processes_play_the_same_episodes(capfd: pytest.CaptureFixture[str]) -> None:
    options = parse(["--backend", "jax", "--task", "atari:pong"])
    actions = np.random.default_rng(0).integers(0, 18, (30, 2))
    records = []
    for processes in (False, True):
        several = Environments(env_maker(options), 2, processes, task=options.task)
        try:
            several.reset([3, 4])
            records.append([several.step(np.eye(18, dtype=np.float32)[chosen]) for chosen in actions])
        finally:
            several.close()
    for here, there in zip(*records, strict=True):
        assert here.keys() == there.keys()
        assert all(np.array_equal(here[key], there[key]) for key in here)
    assert capfd.readouterr() == ("", ""), "nothing of ids of ale-py, which the process gets and the import registers"


@pytest.mark.covers("LOOP-34")
def test_an_episode_under_way_is_played_again() -> None:
    """By an emulator of its own, no-ops and sticky actions included."""
    options = parse(["--backend", "jax", "--task", "atari:alien", "--profile", "official"])
    first, second = (Environments(env_maker(options), 1, False, task=options.task) for _ in range(2))
    first.reset([5])
    actions = random_actions(first.spaces, np.random.default_rng(0), 60)[:, None]
    for action in actions[:40]:
        record = first.step(action)
    restored = second.restore(first.histories())
    assert restored is not None
    for action in actions[40:]:
        assert all(np.array_equal(restored[key], record[key]) for key in record)
        record, restored = first.step(action), second.step(action)


@pytest.mark.covers("LOOP-29")
def test_the_first_frame_shows_the_reset_screen() -> None:
    env = made("atari:ms_pacman")
    fresh = env.reset(seed=7)[0]["image"]
    assert np.array_equal(fresh, luminance(resized(env.render(), 96)))
    played = episode(env, 8, 200)
    assert not np.array_equal(played[-1][0]["image"], fresh)
    assert np.array_equal(env.reset(seed=7)[0]["image"], fresh)
    assert env.render().shape == (210, 160, 3)


@pytest.mark.covers("LOOP-28")
@pytest.mark.parametrize("suite", ["atari", "atari100k"])
@pytest.mark.parametrize(("profile", "terminal"), [("paper", False), ("official", True)])
def test_the_limit_truncates_or_terminates_by_profile(suite: str, profile: str, terminal: bool) -> None:
    """Frames before the first action, of the emulator's own in berzerk and of no-ops, are not counted."""
    assert protocol(suite, profile)["time_limit"] == 108_000
    env = made(f"{suite}:berzerk", "--profile", profile, "--time-limit", "42")
    for seed in range(2):
        steps = episode(env, seed)
        assert len(steps) == 1 + 11
        assert steps[-1][2:] == (terminal, not terminal)


def test_lives_do_not_end_an_episode() -> None:
    ale = ale_py.ALEInterface()
    play = Play("atari", "breakout", 8, 4)
    env = AtariEnv(ale, ale_py.roms.get_rom_path("breakout"), play, **protocol("atari", "paper")["env"])
    env.reset(seed=0)
    lives = [ale.lives()]
    for action in itertools.cycle((1, 3, 4)):
        terminated = env.step(np.array(action))[2]
        lives.append(ale.lives())
        if terminated:
            break
    assert sorted(set(lives)) == [0, 1, 2, 3, 4, 5]
    assert lives.index(0) == len(lives) - 1


def test_the_emulator_reads_the_probability_only_when_it_loads_a_game(rom: Any) -> None:
    """Why the authors' Atari100k is sticky, which asks for 0 after that: D-99."""
    for before, after, several in ((0.25, 0.0, True), (0.0, 0.25, False)):
        ale, episodes = ale_py.ALEInterface(), set()
        ale.setFloat("repeat_action_probability", before)
        ale.loadROM(rom)
        ale.setFloat("repeat_action_probability", after)
        start = ale.cloneState()  # without its generator
        for _ in range(5):
            ale.restoreState(start)
            for action in np.random.default_rng(0).integers(2, 6, 100):
                ale.act(action)
            episodes.add(ale.getRAM().tobytes())
        assert (len(episodes) > 1) is several


class Watched:
    """An emulator, and what it made of each action: `could` counts the frames in which the action before would have
    changed the memory otherwise than the action that was asked for, `did` those of them in which it was the action
    before. Another emulator, which always does as it is asked, tries out both."""

    def __init__(self, rom: Any) -> None:
        self.ale, self.oracle = ale_py.ALEInterface(), ale_py.ALEInterface()
        self.oracle.setFloat("repeat_action_probability", 0.0)
        self.oracle.loadROM(rom)
        self.could = self.did = 0
        self._before: set[Any] = set()  # what the action of the frame before may have been

    def __getattr__(self, name: str) -> Any:
        return getattr(self.ale, name)

    def loadROM(self, rom: Any) -> None:  # noqa: N802
        self.ale.loadROM(rom)
        self._before = {ale_py.Action.NOOP}

    def act(self, action: Any) -> int:
        state = self.ale.cloneState()
        memories = {candidate: self._tried(state, candidate) for candidate in self._before | {action}}
        reward = int(self.ale.act(action))
        memory = self.ale.getRAM().tobytes()
        if memories[action] not in [memories[candidate] for candidate in self._before]:
            self.could += 1
            self.did += memory != memories[action]
        self._before = {candidate for candidate, made in memories.items() if made == memory}
        assert self._before, "neither the action nor the one before"
        return reward

    def _tried(self, state: Any, action: Any) -> bytes:
        self.oracle.restoreState(state)
        self.oracle.act(action)
        return bytes(self.oracle.getRAM().tobytes())


@pytest.mark.parametrize("probability", [0.25, 0.6, 0.0])
def test_each_frame_keeps_the_action_before_with_the_probability_that_was_given(probability: float, rom: Any) -> None:
    """Drawn in each frame of a repeat: drawn once for all of them, at 0.25 it would be seen in 57 % of them."""
    watched = Watched(rom)
    arguments = {**protocol("atari", "paper")["env"], "sticky_actions": probability}
    env, rng = AtariEnv(watched, rom, Play("atari", "seaquest", 8, 4), **arguments), np.random.default_rng(0)
    for seed in range(4):
        env.reset(seed=seed)
        for action in rng.integers(3, 5, 250):  # right or left
            if env.step(np.array(action))[2]:
                break
    assert watched.could > 400
    error = 3 * np.sqrt(probability * (1 - probability) / watched.could)
    assert abs(watched.did / watched.could - probability) <= error, (watched.did, watched.could)
