"""`train score`: the statistics, which episodes count, and what is printed and written."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_runs import NAN, make_run

from dreamer_spec.cli import main
from dreamer_spec.errors import UserError
from dreamer_spec.report.runs import Curve, read_run
from dreamer_spec.scoring.protocol import Note, Protocol, RunScore, score_run
from dreamer_spec.scoring.statistics import Estimate, bootstrap, estimate, interquartile_mean, summarize
from dreamer_spec.scoring.suites import SUMMARIES, Summary, split_task, window_of

PLAIN = {statistic: Summary(f"task_{statistic}", "", False, statistic) for statistic in ("mean", "median", "iqm")}


def arrays(*tasks: Sequence[float]) -> list[np.ndarray]:
    return [np.array(runs, float) for runs in tasks]


def of_means(scores: Sequence[np.ndarray]) -> np.ndarray:
    """The mean over tasks, as `train score` computes it."""
    return summarize(PLAIN["mean"], [""] * len(scores), scores)


# Statistics


def test_mean_and_median_are_over_tasks_of_the_means_over_runs() -> None:
    scores = arrays([1, 3], [10], [3, 6, 9])
    assert summarize(PLAIN["mean"], ["a", "b", "c"], scores) == 6  # (2 + 10 + 6) / 3
    assert summarize(PLAIN["median"], ["a", "b", "c"], scores) == 6
    assert summarize(PLAIN["median"], ["a", "b"], scores[:2]) == 6  # between 2 and 10


def test_the_interquartile_mean_is_that_of_the_middle_half() -> None:
    assert interquartile_mean(arrays([8, 1], [4, 2], [100, 3], [7, 5])) == pytest.approx(4.75)  # 3, 4, 5, 7
    assert interquartile_mean(arrays([1, 2, 3])) == pytest.approx(2)  # a quarter of 1 and 3, half of their weight
    assert interquartile_mean(arrays([1, 2, 3, 4, 50])) == pytest.approx(3)


def test_every_task_weighs_the_same_in_the_interquartile_mean() -> None:
    """0 weighs 1/2 and 1, 2, 3 weigh 1/6 each: inside of the middle half are 1/4, 1/6 and 1/12."""
    assert interquartile_mean(arrays([0], [1, 2, 3])) == pytest.approx((1 / 6 + 2 / 12) / 0.5)
    assert interquartile_mean(arrays([0], [1, 1, 2, 2, 3, 3])) == pytest.approx((1 / 6 + 2 / 12) / 0.5)


def test_the_interquartile_mean_is_the_trimmed_mean_of_scipy() -> None:
    trim_mean = pytest.importorskip("scipy.stats").trim_mean
    random = np.random.default_rng(0)
    for runs in (4, 8):
        scores = random.normal(size=(5, 3, runs))  # five resamples of three tasks
        found = interquartile_mean([scores[:, task] for task in range(3)])
        assert found == pytest.approx(trim_mean(scores.reshape(5, -1), 0.25, axis=1), rel=1e-12)


def test_normalization_and_caps() -> None:
    mean, capped = SUMMARIES["atari"][0], SUMMARIES["atari"][-1]
    pong = arrays([-20.7, 14.6, 32.25])  # random, gamer, 1.5 times as far
    assert mean.normalized(["pong"], pong)[0] == pytest.approx([0, 100, 150])
    assert capped.normalized(["pong"], arrays([-62.4, 21, 40]))[0] == pytest.approx([-100, 100, 100]), "above only"
    task_mean = SUMMARIES["dmc"][0]
    assert task_mean.normalized(["walker-walk"], arrays([936]))[0] == 936
    assert (mean.unit, task_mean.unit) == ("%", "")


def test_a_cap_is_on_the_mean_of_a_task_but_on_each_run_in_the_interquartile_mean() -> None:
    """Runs at 0 and 200 % of the human: a task at 100 %."""
    human_mean, _, human_iqm = SUMMARIES["dmlab"]
    low, high = 0.1, 100.0
    runs = arrays([low, low + 2 * (high - low)])
    assert summarize(human_mean, ["skymaze_irreversible_path_hard"], runs) == pytest.approx(100)
    assert summarize(human_iqm, ["skymaze_irreversible_path_hard"], runs) == pytest.approx(50)


def test_the_bootstrap_of_two_runs() -> None:
    """The mean of two draws from 0 and 1 is 0 with a chance of 1/4."""
    assert bootstrap(of_means, arrays([0, 1])) == (0, 1)
    assert bootstrap(of_means, arrays([0, 1]), level=0.4) == (0.5, 0.5)


def test_the_bootstrap_draws_within_tasks() -> None:
    """Tasks that do not vary have no interval, however far they are apart; each task keeps its number of runs."""
    assert bootstrap(of_means, arrays([1, 1], [100, 100, 100])) == (50.5, 50.5)
    assert bootstrap(of_means, arrays([1], [0, 4])) == (0.5, 2.5)


def test_a_single_run_of_every_task_has_no_interval() -> None:
    assert bootstrap(of_means, arrays([1], [100])) is None
    assert estimate(PLAIN["median"], ["a", "b"], arrays([1], [100])) == Estimate(50.5, None)


def test_the_bootstrap_is_the_same_every_time_and_follows_its_seed() -> None:
    scores = arrays(np.random.default_rng(1).normal(size=7))
    assert bootstrap(of_means, scores) == bootstrap(of_means, scores)
    assert bootstrap(of_means, scores, seed=1) != bootstrap(of_means, scores)


@pytest.mark.parametrize("seed", range(3))
def test_the_bootstrap_agrees_with_scipy_where_there_is_one_task(seed: int) -> None:
    """An end is a quantile of 10,000 means, with a standard error of 0.027 of their deviation; both sides have it, and
    five times their difference is 0.19."""
    stats = pytest.importorskip("scipy.stats")
    runs = np.random.default_rng(seed).normal(size=12)
    theirs = stats.bootstrap((runs,), np.mean, n_resamples=10_000, method="percentile", rng=seed).confidence_interval
    ours = bootstrap(of_means, [runs])
    assert ours == pytest.approx((theirs.low, theirs.high), abs=0.2 * np.std(runs) / np.sqrt(len(runs)))


def test_intervals_hold_the_truth_about_as_often_as_they_say() -> None:
    """Of 300 studies with ten runs of two tasks, whose mean is 0: the percentile interval of ten runs is a little too
    narrow and holds it in some 90 % instead of 95; four standard errors (1.7 % each) below that is 83."""
    random = np.random.default_rng(0)
    studies = [bootstrap(of_means, list(random.normal(size=(2, 10))), resamples=1000, seed=n) for n in range(300)]
    inside = np.mean([interval is not None and interval[0] <= 0 <= interval[1] for interval in studies])
    assert 0.83 <= inside <= 0.99


# Tasks


def test_tasks_are_found_by_their_names() -> None:
    assert split_task("dmc:walker-walk") == ("dmc", "walker-walk")
    assert split_task("dmc_vision:walker-walk") == ("dmc_vision", "walker-walk")
    assert split_task("atari:pong") == ("atari", "pong")
    assert split_task("dmlab:rooms_collect_good_objects_train") == ("dmlab", "rooms_collect_good_objects_test")
    assert split_task("minecraft:diamond") == ("minecraft", "diamond")
    assert split_task("bsuite:catch") == split_task("bsuite:catch/3") == ("bsuite", "catch")
    for task in ("atari:adventure", "atari100k:zaxxon", "dmc:quadruped-run", "bsuite:tennis/0", "crafter:reward"):
        assert split_task(task) == ("", task), "the paper has no score of it"
    for task in ("gym:CartPole-v1", "my_module:make_env", "atari", ""):
        assert split_task(task) == ("", task)
    assert (window_of("atari"), window_of("atari100k"), window_of("")) == (0.01, 0.025, 0.05)


# Which episodes count


def run(path: Path, returns: list[tuple[float, float]], step: float = 1000, **about: Any) -> RunScore:
    """The score of a run of 1,000 steps with these training episodes, which is at `step`."""
    protocol = about.pop("protocol", Protocol(0.1))
    lines = [{"step": at, "episode/return": value} for at, value in returns] + [{"step": step, "speed/steps": 1.0}]
    options = {"seed": 0, "steps": 1000, "action_repeat": 2}
    return score_run(read_run(make_run(path, lines, **{"options": options, **about})), protocol)


def test_the_episodes_in_the_window_count(tmp_path: Path) -> None:
    found = run(tmp_path / "a", [(899, 0), (900, 1), (950, 2), (1000, 6)])
    assert (found.score, found.returns, found.first, found.last, found.notes) == (3, 3, 900, 1000, ())


def test_the_last_round_of_all_environments_counts(tmp_path: Path) -> None:
    """Four environments with two steps an action add 8 at once, and the last time begins below the budget."""
    returns = [(950.0, 1.0), (1007.0, 3.0), (1008.0, 100.0)]
    found = run(tmp_path / "a", returns, step=1008, hyperparameters={"envs": 4})
    assert (found.score, found.returns) == (2, 2)


def test_an_unfinished_run_is_scored_where_it_is(tmp_path: Path) -> None:
    found = run(tmp_path / "a", [(399, 0), (400, 1), (500, 2)], step=500)
    assert (found.score, found.first, found.last) == (1.5, 400, 500), "a tenth of the budget, not of the steps"
    assert found.notes == (Note("unfinished, so that the window ends at the last step", "500 of 1,000"),)


def test_without_an_episode_in_the_window_the_last_one_counts(tmp_path: Path) -> None:
    found = run(tmp_path / "a", [(100, 1), (200, 2), (200, 4)])
    assert (found.score, found.returns) == (3, 2), "those of two environments that ended together"
    assert found.notes == (Note("no training episode ended in the window: scored is the last before it", "step 200"),)


def test_what_is_not_known_is_said(tmp_path: Path) -> None:
    found = run(tmp_path / "a", [(1000, NAN), (990, 5)], options={"seed": 0})
    assert (found.score, found.last) == (5, 1000)
    assert [note.what for note in found.notes] == [
        "of unknown budget, so that the window ends at the last step",
        "returns that are not finite are left out",
    ]
    nothing = run(tmp_path / "b", [])
    assert (nothing.score, nothing.returns, nothing.notes) == (None, 0, (Note("no episode has ended"),))


def test_evaluations_instead_of_training_episodes(tmp_path: Path) -> None:
    lines = [{"step": 500, "evaluation/return": 1.0}, {"step": 1000, "evaluation/return": 7.0, "episode/return": 0.0}]
    path = make_run(tmp_path / "a", lines, options={"seed": 0, "steps": 1000})
    assert score_run(read_run(path), Protocol(0.1, "evaluation")).score == 7
    assert score_run(read_run(path), Protocol(0.5, "evaluation")).score == 4


def test_each_suite_has_its_window(tmp_path: Path) -> None:
    returns = [(955.0, 1.0), (965.0, 2.0), (985.0, 3.0), (995.0, 4.0)]
    scores = {
        task: run(tmp_path / task, returns, task=task, protocol=Protocol()).score
        for task in ("gym:X", "dmc:walker-walk", "procgen:maze", "atari:pong")
    }
    assert scores == {"gym:X": 2.5, "dmc:walker-walk": 3, "procgen:maze": 3.5, "atari:pong": 4}


# The command


MACHINE = {"processor": "a processor", "cores": 2, "memory_gib": 8.0, "system": "Linux", "commit": "abc1234"}


def study(folder: Path) -> Path:
    """Two tasks of the control suite, two seeds each, and one task that the paper does not have."""
    scores = {("dmc:walker-walk", 0): 900, ("dmc:walker-walk", 1): 1000, ("dmc:hopper-hop", 0): 100}
    scores |= {("dmc:hopper-hop", 1): 200, ("gym:X", 0): 50}
    for number, ((task, seed), score) in enumerate(scores.items()):
        make_run(
            folder / f"run{number}",
            [{"step": 490_000, "episode/return": float(score)}, {"step": 500_000, "speed/steps": 1.0}],
            task=task,
            options={"seed": seed, "steps": 500_000, "action_repeat": 2},
            command=f"train --backend jax --task {task} --size tiny --seed {seed} --logdir somewhere",
            machine={**MACHINE, "versions": {"jax": "1.0", "other": "2"}, "python": "3.11"},
            device="cpu",
        )
    return folder


def test_scores_beside_those_of_the_paper(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    assert main(["score", str(study(tmp_path / "runs"))]) == 0
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert "dmc: 2 of 18 tasks" in lines
    assert "walker-walk 2 2 950 70.71 64 952 942 969 936" in lines
    assert "hopper-hop 2 2 150 70.71 0 36 68 80 113" in lines
    # The mean over the two tasks of the paper's columns, not the printed one over 18.
    assert "task mean 550.0 500.0 to 600.0 32 494 505 524.5 524.5" in lines
    assert "task interquartile mean 550.0 500.0 to 600.0" in lines
    assert "gym:X 1 1 50" in lines


def test_every_score_carries_its_statement(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = {kind: tmp_path / f"scores.{kind}" for kind in ("md", "csv", "json")}
    arguments = ["score", str(study(tmp_path / "runs")), "--markdown", str(files["md"])]
    assert main([*arguments, "--csv", str(files["csv"]), "--json", str(files["json"])]) == 0
    texts = [capsys.readouterr().out, *(path.read_text(encoding="utf-8") for path in files.values())]
    for text in (text.replace("\\", "") for text in texts):
        for said in (
            "mean return of the training episodes that ended in the window",
            "dmc: the last 4 % of 500,000 environment steps",
            "other tasks: the last 5 % of 500,000 environment steps",
            "5 training episodes; 1 to 1 a run",
            "0, 1 (dmc:walker-walk, dmc:hopper-hop)",
            "95%, percentiles of 10,000 resamples",
            "a processor, 2 cores, 8 GiB, Linux; jax on cpu",
            "abc1234",
            "Python 3.11, jax 1.0",
            "train --backend jax --task TASK --size tiny --seed SEED",
            "train score",
        ):
            assert said in text
    data = json.loads(texts[-1])
    assert [entry["suite"] for entry in data["suites"]] == ["dmc", ""]
    assert data["suites"][0]["summaries"][0]["paper_is"] == "from its rows for the same tasks"
    assert data["runs"][0]["command"].endswith("--seed 0 --logdir somewhere")
    rows = list(csv.DictReader(line for line in texts[2].splitlines() if not line.startswith("#")))
    assert [(row["kind"], row["name"], row["value"], row["paper_dreamer"]) for row in rows][:3] == [
        ("task", "hopper-hop", "150.0", "113.0"),
        ("task", "walker-walk", "950.0", "936.0"),
        ("summary", "task_mean", "550.0", "524.5"),
    ]


def test_runs_that_are_not_alike_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = study(tmp_path / "runs")
    for name, changes in (
        ("other", {"backend": "torch", "options": {"seed": 0, "steps": 1_000_000, "action_repeat": 2}}),
        ("third", {"task": "dmc:cheetah-run", "options": {"seed": 5, "steps": 500_000, "action_repeat": 2}}),
    ):
        lines = [{"step": 499_000, "episode/return": 1.0}]
        make_run(folder / name, lines, **{"task": "dmc:walker-walk", **changes})
    make_run(folder / "begun", [{"step": 5, "speed/steps": 1.0}], task="dmc:acrobot-swingup")
    make_run(folder / "catch", [{"step": 100, "episode/return": 1.0}], task="bsuite:catch/0")
    assert main(["score", str(folder)]) == 0
    out = capsys.readouterr().out
    for said in (
        "the runs differ in backend: jax, torch",
        "the runs differ in steps: ",
        "more than one run of dmc:walker-walk with seed 0",
        "the paper's budget is 500,000 environment steps, here it is 1,000,000",
        "the intervals are too narrow, because these tasks have one run: cheetah-run",
        "without any score: acrobot-swingup",
        f"no episode has ended: {folder / 'begun'}",
        f"unfinished, so that the window ends at the last step: {folder / 'begun'} (5 of 100), ",
        f"without what BSuite counts for its score; run with --info-metrics 'bsuite/*': {folder / 'catch'}",
    ):
        assert said in out, out


def test_a_whole_suite_stands_beside_what_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from spec.paper_scores import paper_tables

    for task, score in paper_tables()["procgen"].column("dreamer").items():
        lines = [{"step": 50_000_000, "episode/return": score}]
        make_run(tmp_path / task, lines, task=f"procgen:{task}", options={"seed": 0, "steps": 50_000_000})
    assert main(["score", str(tmp_path), "--json", str(tmp_path / "scores.json")]) == 0
    assert "procgen: all 16 tasks" in capsys.readouterr().out
    [suite] = json.loads((tmp_path / "scores.json").read_text())["suites"]
    mean = suite["summaries"][0]
    assert mean["value"] == pytest.approx(66.01, abs=0.005)
    assert (mean["interval"], mean["paper"]["dreamer"], mean["paper_is"]) == (None, 66.01, "as printed")


@pytest.mark.parametrize("kind", ["png", "pdf", "svg"])
def test_learning_curves_are_drawn(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"curves.{kind}"
    assert main(["score", str(study(tmp_path / "runs")), "--plot", str(path)]) == 0
    begins = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}
    assert path.read_bytes().startswith(begins[kind])


def test_the_curve_is_the_mean_over_runs_and_their_deviation() -> None:
    from dreamer_spec.scoring.plot import mean_curve

    first = Curve(np.array([1.0, 1.5, 51.0]), np.array([1.0, 3.0, 9.0]))  # the bins are two steps wide
    second = Curve(np.array([0.0, 99.0, 100.0]), np.array([4.0, 5.0, 7.0]))
    steps, mean, deviation = mean_curve([first, second, Curve(np.array([5.0]), np.array([NAN]))], 100)
    assert steps.tolist() == [1, 51, 99]
    assert mean.tolist() == [3, 9, 6]  # of 2 and 4; the first alone; the second alone
    assert deviation == pytest.approx([np.sqrt(2), 0, 0])


def test_mistakes_are_a_line_each(tmp_path: Path) -> None:
    from dreamer_spec.commands import score

    folder = str(study(tmp_path / "runs"))
    make_run(tmp_path / "begun", [{"step": 5, "speed/steps": 1.0}], task="gym:X")
    for arguments, message in (
        ([folder, "--window", "0"], "above 0 and at most 1"),
        ([folder, "--window", "5%"], "above 0 and at most 1"),
        ([folder, "--window", "nan"], "above 0 and at most 1"),
        ([folder, "--episodes", "all"], "invalid choice"),
        ([folder, "--plot", "curves.jpg"], "expected .png, .pdf or .svg"),
        ([folder, "--csv", str(tmp_path / "no" / "x.csv")], "there is no folder"),
        ([str(tmp_path / "nothing")], "is not there"),
        ([str(tmp_path / "begun")], "no run has a score: .*no episode has ended|unfinished"),
    ):
        with pytest.raises(UserError, match=message):
            score.main(arguments)
