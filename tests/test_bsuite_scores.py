"""The scores of BSuite: those of the package, and what `train score` makes of them."""

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dreamer_spec.cli import main
from dreamer_spec.commands.bsuite import rows
from dreamer_spec.disk import about
from dreamer_spec.scoring.bsuite import Episodes, configuration, episodes_of, needed, score
from spec import benchmarks

EXPERIMENTS = benchmarks()["bsuite"]["experiments"]

# Name that the package counts -> what a bad and a good episode add to it.
BAD_AND_GOOD = {"total_regret": (2.0, 0.0), "total_bad_episodes": (1.0, 0.0), "total_perfect": (0.0, 1.0)}
OTHERS = {
    "bandit": (0.5, 0.0),
    "cartpole": (20.0, 900.0),
    "cartpole_swingup": (0.0, 500.0),
    "mountain_car": (-1000.0, -150.0),
    "discounting_chain": (1.0, 1.1),
}

# bsuite 0.3.6 (pandas 1.5.3, NumPy 1.26.4) of the rows that `train bsuite` writes of `player`, slow = 0.5 and slow = 1.
SCORES = {
    "bandit": (0.64716, 0.437155),
    "bandit_noise": (0.623542, 0.389919),
    "bandit_scale": (0.623542, 0.389919),
    "cartpole": (0.794966, 0.652522),
    "cartpole_noise": (0.784555, 0.605907),
    "cartpole_scale": (0.784555, 0.605907),
    "cartpole_swingup": (0.731304, 0.606268),
    "catch": (0.55895, 0.296444),
    "catch_noise": (0.529427, 0.237399),
    "catch_scale": (0.529427, 0.237399),
    "deep_sea": (1.0, 0.761905),
    "deep_sea_stochastic": (0.952381, 0.666667),
    "discounting_chain": (0.64765, 0.43755),
    "memory_len": (0.565217, 0.304348),
    "memory_size": (0.529412, 0.294118),
    "mnist": (0.732478, 0.572958),
    "mnist_noise": (0.719356, 0.525585),
    "mnist_scale": (0.719356, 0.525585),
    "mountain_car": (0.650503, 0.471918),
    "mountain_car_noise": (0.630391, 0.431705),
    "mountain_car_scale": (0.630391, 0.431705),
    "umbrella_distract": (0.304348, 0.217391),
    "umbrella_length": (0.304348, 0.217391),
}


def player(experiment: str, number: int, slow: float) -> Episodes:
    """Fails in a first part of its episodes, which differs between configurations, and then in every seventh."""
    count = episodes_of(experiment)
    episode = np.arange(count)
    bad = (episode < count * ((7 * number) % 11) / 10 * slow) | (episode % 7 == 6)
    kind = experiment.removesuffix("_noise").removesuffix("_scale")
    values = np.where(bad, *OTHERS.get(kind, BAD_AND_GOOD.get(needed(experiment), (0.0, 0.0))))
    counted = {name: values for name in [needed(experiment)] if name}
    has_no_other = kind in ("cartpole_swingup", "discounting_chain")  # rewards than what is counted
    return Episodes(number, values if has_no_other else np.zeros(count), counted)


def players(experiment: str, slow: float) -> list[Episodes]:
    return [player(experiment, number, slow) for number in range(EXPERIMENTS[experiment]["configurations"])]


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_scores_are_those_of_the_package(experiment: str) -> None:
    for slow, expected in zip((0.5, 1.0), SCORES[experiment], strict=True):
        assert score(experiment, players(experiment, slow)) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("experiment", [name for name in EXPERIMENTS if not name.startswith("deep_sea")])
def test_scores_are_those_of_the_package_that_is_installed(experiment: str) -> None:
    """Deep sea is left out: the package cannot score it with today's pandas."""
    pytest.importorskip("bsuite")
    pandas = importlib.import_module("pandas")
    settings = importlib.import_module("bsuite.sweep").SETTINGS
    frames = []
    for played in players(experiment, 0.7):
        name = f"{experiment}/{played.number}"
        best = experiment.startswith("cartpole")
        written = rows(played.returns, np.ones(len(played.returns)), played.counted, best, episodes_of(experiment))
        frames.append(pandas.DataFrame(written).assign(bsuite_id=name, bsuite_env=experiment, **settings[name]))
    analysis = importlib.import_module(f"bsuite.experiments.{experiment}.analysis")
    assert score(experiment, players(experiment, 0.7)) == pytest.approx(analysis.score(pandas.concat(frames)), abs=1e-9)


def test_scores_by_hand() -> None:
    regret = np.array([2.0, 0.0, 0.0, 0.0])
    assert score("catch", [Episodes(0, regret, {"total_regret": regret})]) == pytest.approx(1 - 0.5 / 1.6)
    perfect = {"total_perfect": np.array([0.0, 1.0, 1.0])}
    assert (
        score("memory_len", [Episodes(0, regret, perfect), Episodes(1, regret, {"total_perfect": regret * 0})]) == 0.5
    )
    raw = {"raw_return": np.array([1.0, 501.0])}
    assert score("cartpole", [Episodes(0, raw["raw_return"], raw)]) == pytest.approx((0.251 + 1) / 2)
    # The mean of five scales less half of their standard deviation, here 1 and 0.
    kinds = [Episodes(number, regret, {"total_regret": np.full(4, number // 4 / 2)}) for number in (0, 4)]
    assert score("bandit_noise", kinds) == pytest.approx((0.5 + 0.0) / 2)


def test_configurations_have_names() -> None:
    assert configuration("bsuite:catch") == configuration("bsuite:catch/0") == ("catch", 0)
    assert configuration("bsuite:memory_len/12") == ("memory_len", 12)
    for task in ("bsuite:tennis", "bsuite:catch/x", "bsuite:catch/-1", "bsuite:catch/", "gym:catch", ""):
        assert configuration(task) is None


def make_run(logdir: Path, task: str, played: Episodes, seed: int = 0, episodes: int | None = None) -> None:
    """A log directory as a run leaves it."""
    logdir.mkdir(parents=True)
    known = {"format": about.FORMAT, "task": task, "backend": "jax", "options": {"seed": seed}}
    (logdir / "run.json").write_text(json.dumps(known))
    lines = []
    for episode, value in enumerate(played.returns[:episodes]):
        line: dict[str, Any] = {"step": 10 * episode + 10, "seconds": 1.0, "episode/return": float(value)}
        line |= {f"episode/info/bsuite/{name}": float(each[episode]) for name, each in played.counted.items()}
        lines.append(json.dumps(line) + "\n")
    (logdir / "metrics.jsonl").write_text("".join(lines))


def test_an_experiment_is_scored_for_each_seed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two seeds of two configurations of catch, and half of the episodes of one of cartpole."""
    for seed, slow in ((0, 0.5), (1, 1.0)):
        for number in (1, 2):
            make_run(tmp_path / f"catch{number}-{seed}", f"bsuite:catch/{number}", player("catch", number, slow), seed)
    make_run(tmp_path / "cartpole", "bsuite:cartpole", player("cartpole", 0, 0.5), episodes=500)
    assert main(["score", str(tmp_path), "--json", str(tmp_path / "scores.json")]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    (suite,) = json.loads((tmp_path / "scores.json").read_text())["suites"]
    found = {task["task"]: task for task in suite["tasks"]}
    each = [score("catch", [player("catch", number, slow) for number in (1, 2)]) for slow in (0.5, 1.0)]
    assert found["catch"]["runs"] == pytest.approx(each)
    assert found["catch"]["score"] == pytest.approx(np.mean(each))
    assert found["catch"]["paper"]["dreamer"] == 0.96
    summaries = {summary["name"]: summary for summary in suite["summaries"]}
    both = [found["catch"]["score"], found["cartpole"]["score"]]
    assert summaries["basic"]["value"] == pytest.approx(np.mean(both))
    assert summaries["generalization"]["value"] == pytest.approx(found["cartpole"]["score"])
    assert summaries["task_mean"]["value"] == pytest.approx(100 * np.mean(both))
    assert summaries["task_mean"]["paper"]["dreamer"] == pytest.approx(100 * (0.96 + 0.93) / 2)
    categories = [np.mean(both), np.mean(both), found["cartpole"]["score"]]
    assert summaries["category_mean"]["value"] == pytest.approx(100 * np.mean(categories))
    assert "exploration" not in summaries
    assert "not all configurations were run: cartpole 1 of 20, catch 2 of 20" in shown
    assert f"fewer episodes than BSuite's score is made of: {tmp_path / 'cartpole'} (500 of 1,000)" in shown
    assert "the first 10,000 training episodes, scored by bsuite's own rules" in shown


def test_a_run_that_is_there_twice_counts_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number, seed in ((1, 0), (2, 0), (1, 1)):
        make_run(tmp_path / f"a{number}-{seed}", f"bsuite:catch/{number}", player("catch", number, 0.5), seed)
    make_run(tmp_path / "b", "bsuite:catch/1", player("catch", 9, 1.0))
    assert main(["score", str(tmp_path), "--json", str(tmp_path / "scores.json")]) == 0
    (suite,) = json.loads((tmp_path / "scores.json").read_text())["suites"]
    both, one = ([player("catch", number, 0.5) for number in numbers] for numbers in ((1, 2), (1,)))
    assert suite["tasks"][0]["runs"] == pytest.approx([score("catch", both), score("catch", one)])
    shown = " ".join(capsys.readouterr().out.split())
    assert "more than one run of bsuite:catch/1 with seed 0, of which the first counts" in shown
    assert "not every seed has the same configurations: catch" in shown
