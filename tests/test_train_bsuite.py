"""BSuite: protocol, the package's environments as Gymnasium's, and runs as the package's logger would write them."""

import dataclasses
import functools
import gzip
import importlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dreamer_spec.cli import main, parse
from dreamer_spec.commands.bsuite import rows
from dreamer_spec.disk import about
from dreamer_spec.envs import make_env, random_actions
from dreamer_spec.envs.suites.bsuite import MNIST, BsuiteEnv, difference, reseed
from dreamer_spec.errors import UserError
from dreamer_spec.scoring.bsuite import LOGGED, is_logged
from dreamer_spec.suites import protocol, settings, tasks_of
from spec import Vector, benchmarks, built_profiles

EXPERIMENTS = benchmarks()["bsuite"]["experiments"]


# Without the package


@pytest.mark.parametrize("profile", built_profiles())
def test_the_budget_holds_all_episodes(profile: str) -> None:
    assert set(tasks_of("bsuite")) == set(EXPERIMENTS)
    assert sum(entry["configurations"] for entry in EXPERIMENTS.values()) == 468
    for task, steps in {
        "catch": 100_000,
        "catch/19": 100_000,
        "memory_len/0": 30_000,
        "memory_len/22": 1_020_000,
    }.items():
        assert settings(f"bsuite:{task}", profile)["steps"] == steps
    for task in ("catch/20", "catch/-1", "catch/x", "tennis/0"):
        assert "steps" not in settings(f"bsuite:{task}", profile)


def test_a_run_logs_what_scores_are_made_of() -> None:
    run = parse(["--backend", "jax", "--task", "bsuite:deep_sea/20"])
    assert (run.steps, run.info_metrics, run.config.envs, run.config.replay_ratio) == (510_000, "bsuite/*", 1, 1024)
    assert run.eval_every == 51_000


def test_the_list_says_which_configurations_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tasks", "bsuite"]) == 0
    shown = capsys.readouterr().out
    assert "bsuite:catch/0 to /19, 10,000 episodes each\n" in shown
    assert "bsuite:cartpole/0 to /19, 1,000 episodes each\n" in shown
    assert "experiments" not in shown


class Layer:
    """What `reseed` sees of the package's environments."""

    def __init__(self, env: Any = None, draws: bool = True) -> None:
        self._mapping_rng = np.random.RandomState(42)
        if draws:
            self._rng = np.random.RandomState(7)
        if env:
            self._env = env

    def draw(self) -> float:
        return float(self._rng.rand())


@pytest.mark.covers("LOOP-33")
def test_each_layer_draws_from_the_seed_of_the_reset_and_its_configuration_stays() -> None:
    def drawn(seed: int) -> list[float]:
        game = Layer()
        outer = Layer(Layer(game, draws=False))
        outer.draw()
        reseed(outer, [seed, 0])
        assert game._mapping_rng.rand() == np.random.RandomState(42).rand()
        return [outer.draw(), game.draw()]

    assert drawn(1) == drawn(1)
    assert len({*drawn(1), *drawn(2)}) == 4


@pytest.mark.parametrize(("discount", "flags"), [(0.0, (True, False)), (1.0, (False, True))])
def test_discount_zero_is_terminal_and_any_other_end_is_not(discount: float, flags: tuple[bool, bool]) -> None:
    class Ends:
        def observation_spec(self) -> Any:
            return SimpleNamespace(shape=(2, 3))

        def action_spec(self) -> Any:
            return SimpleNamespace(num_values=4)

        def bsuite_info(self) -> dict[str, float]:
            return {"total_regret": 5.0, "best_episode": 9.0}

        def step(self, action: int) -> Any:
            observation = np.arange(6).reshape(2, 3)
            return SimpleNamespace(observation=observation, reward=1.0, discount=discount, last=lambda: True)

        def reset(self) -> Any:
            return self.step(0)

    env = BsuiteEnv(Ends(), 0)
    assert env.reset()[0].tolist() == [0, 1, 2, 3, 4, 5]
    observation, _, *ends, info = env.step(0)
    assert tuple(ends) == flags
    assert observation.dtype == np.float32
    assert info == {"bsuite": {"total_regret": 0.0}}


def test_what_an_episode_adds() -> None:
    before, after = {"total_regret": 3, "best_episode": 1.0}, {"total_regret": 5, "best_episode": 2.0}
    assert difference(before, after) == {"total_regret": 2.0}


def test_rows_are_sums_at_the_episodes_that_the_package_logs() -> None:
    assert [episode for episode in range(1, 41) if is_logged(episode)] == [
        *range(1, 11),
        *(12, 14, 17, 20, 25, 30, 40),
    ]
    returns = np.arange(1.0, 16.0)
    found = rows(returns, 2 * np.ones(15), {"raw_return": np.r_[5.0, np.zeros(14)]}, True, 12)
    assert [row["episode"] for row in found] == [*range(1, 11), 12]
    assert found[-1] == {
        "episode": 12,
        "episode_return": 12.0,
        "episode_len": 2.0,
        "steps": 24.0,
        "total_return": 78.0,
        "raw_return": 5.0,
        "best_episode": 5.0,
    }
    assert "best_episode" not in rows(returns, returns, {"raw_return": returns}, False, 12)[0]


def logged(logdir: Path, task: str, episodes: list[dict[str, float]]) -> None:
    """A log directory as a run leaves it."""
    logdir.mkdir(parents=True)
    (logdir / "run.json").write_text(json.dumps({"format": about.FORMAT, "task": task}))
    lines = [json.dumps({"step": step, "seconds": 1.0, **numbers}) for step, numbers in enumerate(episodes, 1)]
    (logdir / "metrics.jsonl").write_text("".join(f"{line}\n" for line in lines))


def test_what_cannot_be_scored_is_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    episode = {"episode/return": 1.0, "episode/length": 10.0}
    full = {**episode, "episode/info/bsuite/total_regret": 0.0}
    logged(tmp_path / "other", "gym:CartPole-v1", [episode])
    logged(tmp_path / "bare", "bsuite:catch", [episode])
    logged(tmp_path / "cartpole", "bsuite:cartpole", [full])
    logged(tmp_path / "young", "bsuite:catch/1", [{"train/loss": 1.0}])
    for folder in ("one", "two"):
        logged(tmp_path / folder, "bsuite:catch", [full])
    for logdirs, words in [
        (["other"], "is a run of gym:CartPole-v1; expected bsuite:EXPERIMENT/NUMBER"),
        (["bare"], "--info-metrics 'bsuite/*'"),
        (["cartpole"], "--info-metrics 'bsuite/*'"),
        (["young"], "no episode has ended"),
        (["one", "two"], "are both of bsuite:catch/0"),
    ]:
        assert main(["bsuite", *(str(tmp_path / name) for name in logdirs), "--csv", str(tmp_path / "csv")]) == 2
        assert words in capsys.readouterr().err
    assert main(["bsuite", str(tmp_path / "one"), "--csv", str(tmp_path / "csv")]) == 0
    text = (tmp_path / "csv" / "bsuite_id_-_catch-0.csv").read_text()
    assert text.splitlines()[0] == "episode,episode_return,episode_len,steps,total_return,total_regret"
    assert text.splitlines()[1] == "1,1.0,9.0,9.0,1.0,0.0"


# With it


def package(name: str = "bsuite") -> Any:
    pytest.importorskip("bsuite")
    return importlib.import_module(name)


def configurations() -> dict[str, dict[str, Any]]:
    return dict(package("bsuite.sweep").SETTINGS)


Policy = Callable[[np.ndarray, np.random.Generator], int]


@dataclasses.dataclass(frozen=True)
class Episode:
    observations: np.ndarray
    rewards: list[float]
    terminated: bool
    info: dict[str, float]


def play(env: Any, seed: int, choose: Callable[[np.ndarray], int]) -> Episode:
    """One episode of a Gymnasium environment, to its end."""
    observation, _ = env.reset(seed=seed)
    observations, rewards = [observation], []
    while True:
        observation, reward, terminated, truncated, info = env.step(choose(observation))
        observations.append(observation)
        rewards.append(float(reward))
        if terminated or truncated:
            return Episode(np.stack(observations), rewards, terminated, info.get("bsuite", {}))


def test_the_protocol_lists_what_the_package_has() -> None:
    sweep = package("bsuite.sweep")
    known = {name: [one for one in sweep.SETTINGS if one.split("/")[0] == name] for name in EXPERIMENTS}
    assert sum(map(len, known.values())) == len(sweep.SETTINGS) == 468
    for name, entry in EXPERIMENTS.items():
        assert entry["configurations"] == len(known[name])
        assert {sweep.EPISODES[one] for one in known[name]} == {entry["episodes"]}
        if isinstance(entry["longest"], list):
            assert len(entry["longest"]) == entry["configurations"]


def longest_of(name: str) -> int:
    experiment, _, number = name.partition("/")
    longest = EXPERIMENTS[experiment]["longest"]
    return int(longest[int(number)] if isinstance(longest, list) else longest)


def test_every_configuration_plays_and_none_outlasts_its_budget() -> None:
    """Where the length depends on what is done, staying still is longest, or a pole that is balanced."""
    for name in configurations():
        experiment = name.split("/")[0]
        if experiment.startswith("mnist"):
            continue
        package_env = package().load(experiment, configurations()[name])
        env = BsuiteEnv(package_env, 0)
        stay = 1 if env.action_space.n == 3 else 0
        balances = experiment.startswith("cartpole") and "swingup" not in experiment
        episode = play(env, 3, balance if balances else lambda _, stay=stay: stay)
        assert len(episode.rewards) == longest_of(name), name
        assert episode.terminated
        assert episode.observations.shape == (len(episode.rewards) + 1, *env.observation_space.shape)
        assert episode.observations.dtype == np.float32


def balance(observation: np.ndarray) -> int:
    """Keeps the pole of cartpole up and the cart in the middle."""
    x, x_dot, sine, _, theta_dot, _ = observation
    push = 3 * x + 3 * x_dot + 10 * sine + 2 * theta_dot
    return 2 if push > 0 else 0


@pytest.mark.covers("LOOP-33", "LOOP-34")
def test_an_episode_is_a_function_of_its_seed_and_its_actions() -> None:
    """Whatever was played before it, and in another instance. Configurations that draw nothing repeat themselves."""
    still = {"bandit", "bandit_scale", "deep_sea", "discounting_chain"}
    for name, arguments in configurations().items():
        experiment = name.split("/")[0]
        if experiment.startswith("mnist") or not name.endswith("/3"):
            continue
        envs = [BsuiteEnv(package().load(experiment, arguments), 3) for _ in range(2)]
        for seed in (11, 12):
            play(envs[0], seed, lambda _: 0)

        def found(env: BsuiteEnv, seed: int) -> Episode:
            return play(env, seed, functools.partial(at_random, env, np.random.default_rng(0)))

        first, again = found(envs[0], 5), found(envs[1], 5)
        assert first.rewards == again.rewards, name
        np.testing.assert_array_equal(first.observations, again.observations)
        others = [found(envs[1], seed) for seed in range(6, 12)]
        same = all(
            one.rewards == first.rewards and np.array_equal(one.observations, first.observations) for one in others
        )
        assert same is (experiment in still), name


def test_equal_configurations_draw_differently_from_one_seed() -> None:
    package()
    assert configurations()["catch/0"] == configurations()["catch/1"]
    envs = [make_env(f"bsuite:{task}") for task in ("catch", "catch/0", "catch/1")]
    starts = [[env.reset(seed=seed)[0]["observation"].argmax() for seed in range(20)] for env in envs]
    assert starts[0] == starts[1] != starts[2]


@pytest.mark.parametrize(("task", "size", "actions"), [("catch", 50, 3), ("catch/0", 50, 3), ("deep_sea/1", 144, 2)])
def test_a_task_is_a_configuration(task: str, size: int, actions: int) -> None:
    package()
    env = make_env(f"bsuite:{task}")
    assert env.spaces.observations == {"observation": Vector(size)}
    assert env.spaces.action_size == actions
    record, _ = env.reset(seed=0)
    assert record["observation"].sum() == (2 if task.startswith("catch") else 1)
    for action in random_actions(env.spaces, np.random.default_rng(0), 9):
        record, reward, terminated, truncated, _ = env.step(action)
    assert (terminated, truncated) == (task.startswith("catch"), False)
    assert abs(reward) <= 1


@pytest.mark.parametrize(
    ("task", "words"),
    [
        ("catch/20", "its numbers are 0 to 19"),
        ("catch/", "its numbers are 0 to 19"),
        ("tennis", "known: bandit, bandit_noise"),
    ],
)
def test_an_unknown_configuration_is_a_line(task: str, words: str) -> None:
    package()
    with pytest.raises(UserError, match=words):
        make_env(f"bsuite:{task}")


def test_without_the_files_of_mnist_nothing_is_downloaded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    datasets = package("bsuite.utils.datasets")

    def load_mnist(directory: str = str(tmp_path)) -> None:
        raise AssertionError("would download")

    monkeypatch.setattr(datasets, "load_mnist", load_mnist)
    (tmp_path / "train-images-idx3-ubyte.gz").write_bytes(b"")
    with pytest.raises(UserError, match=r"lacks train-labels-idx1-ubyte.gz, .*put the four files") as caught:
        make_env("bsuite:mnist_noise/3")
    assert str(tmp_path) in str(caught.value)


def test_the_configurations_of_mnist_play_from_its_files(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Small files of the same format stand in for those of MNIST."""
    datasets = package("bsuite.utils.datasets")
    count, load = 20, datasets.load_mnist
    for name in MNIST:
        is_images = "images" in name
        header = [2051, count, 28, 28] if is_images else [2049, count]
        data = np.arange(count * 784) % 256 if is_images else np.arange(count) % 10
        with gzip.open(tmp_path / f"{name}.gz", "wb") as file:
            file.write(np.array(header, ">u4").tobytes() + data.astype(np.uint8).tobytes())

    def load_mnist(directory: str = str(tmp_path)) -> Any:
        return load(directory)

    monkeypatch.setattr(datasets, "load_mnist", load_mnist)
    for name in (name for name in configurations() if name.startswith("mnist")):
        env = make_env(f"bsuite:{name}")
        assert env.spaces.observations == {"observation": Vector(784)}
        first, other = env.reset(seed=1)[0], [env.reset(seed=seed)[0]["observation"] for seed in range(2, 9)]
        np.testing.assert_array_equal(first["observation"], env.reset(seed=1)[0]["observation"])
        assert any((first["observation"] != one).any() for one in other)
        assert env.step(np.eye(10, dtype=np.float32)[3])[2:4] == (True, False)


def at_random(env: BsuiteEnv, rng: np.random.Generator, _: np.ndarray) -> int:
    return int(rng.integers(env.action_space.n))


def remembered(observation: np.ndarray) -> int:
    """Of memory_len: the bit that the first observation showed."""
    if observation[2]:
        remembered.bit = int(observation[2] > 0)  # type: ignore[attr-defined]
    return int(remembered.bit)  # type: ignore[attr-defined]


def caught(observation: np.ndarray) -> int:
    """Of catch: towards the ball."""
    board = observation.reshape(10, 5)
    ball, paddle = np.argmax(board[:9].sum(0)), np.argmax(board[9])
    return int(1 + np.sign(ball - paddle))


def arm(observation: np.ndarray) -> int:
    """Of bandit/0: the one that pays."""
    return int(np.argmax(package().load("bandit", configurations()["bandit/0"])._rewards))


@pytest.mark.parametrize(
    ("task", "policy", "good", "bad"),
    [
        ("catch/0", caught, (1, 1), (0, 0.15)),
        ("bandit/0", arm, (1, 1), (0, 0.2)),
        ("cartpole/0", balance, (0.95, 1), (0, 0.1)),
        ("memory_len/2", remembered, (1, 1), (0, 0)),
        ("umbrella_length/0", None, None, (0, 0)),
    ],
)
def test_the_package_scores_the_files(
    task: str, policy: Any, good: tuple[float, float] | None, bad: tuple[float, float], tmp_path: Path
) -> None:
    """What `train bsuite` makes of the metrics of a run are the rows that the package's logger wrote of the same
    episodes, and the package's score of them is that of a good or of a bad player."""
    wrappers, loading = package("bsuite.utils.wrappers"), package("bsuite.logging.csv_load")
    analysis = package("bsuite.experiments.summary_analysis")
    experiment = task.split("/")[0]
    players = {"good": (policy, good)} if good else {}
    for player, (choose, limits) in {**players, "bad": (None, bad)}.items():
        written: list[dict[str, float]] = []
        logger = SimpleNamespace(write=written.append)
        env = BsuiteEnv(wrappers.Logging(package().load(experiment, configurations()[task]), logger), 0)
        chance = functools.partial(at_random, env, np.random.default_rng(1))
        episodes = [play(env, seed, choose or chance) for seed in range(30 if experiment == "cartpole" else 150)]
        lines = [
            {"episode/return": math.fsum(episode.rewards), "episode/length": len(episode.rewards) + 1}
            | {f"episode/info/bsuite/{name}": value for name, value in episode.info.items()}
            for episode in episodes
        ]
        logged(tmp_path / player, f"bsuite:{task}", lines)
        results = tmp_path / f"csv-{player}"
        assert main(["bsuite", str(tmp_path / player), "--csv", str(results)]) == 0
        frame, _ = loading.load_bsuite(str(results))
        assert len(frame) == len(written)
        for name in written[0]:
            np.testing.assert_allclose(frame[name], [row[name] for row in written], rtol=1e-12, atol=1e-12)
        (score,) = analysis.bsuite_score(frame)["score"]
        assert limits[0] <= score <= limits[1], player


def test_the_protocol_is_the_same_in_both_profiles() -> None:
    assert protocol("bsuite", "paper") == protocol("bsuite", "official")
    assert len(LOGGED) == 14
