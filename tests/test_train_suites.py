"""Suites of tasks: what `--task SUITE:NAME` chooses, what wins over it, and what `train tasks` lists."""

import importlib.util
from typing import Any

import pytest

from dreamer_spec.cli import main, parse
from dreamer_spec.options import Options
from dreamer_spec.suites import SUITES, in_words, of_the_paper, protocol, suite_of, tasks_of
from spec import benchmarks, built_profiles, load_config

WITH_BUDGET = [suite for suite, entry in benchmarks().items() if "steps" in entry]


def options(task: str, *arguments: str) -> Options:
    return parse(["--backend", "jax", "--task", task, *arguments])


def words(found: Options) -> str:
    line = in_words(found.task, {**vars(found), **vars(found.config), **found.env_arg})
    assert line is not None
    return line


@pytest.mark.parametrize("profile", [profile for profile in built_profiles() if profile != "2024-04"])
@pytest.mark.parametrize("suite", WITH_BUDGET)
def test_a_task_is_played_by_the_protocol_of_its_suite(suite: str, profile: str) -> None:
    found = protocol(suite, profile)
    run = options(f"{suite}:{tasks_of(suite)[0]}", "--profile", profile)
    assert (run.steps, run.action_repeat) == (found["steps"], found["action_repeat"])
    assert (run.time_limit, run.image_size) == (found.get("time_limit"), found.get("image_size", 64))
    assert run.env_arg == found["env"]
    assert run.config == load_config(
        profile, found["size"], envs=found["envs"], replay_ratio=float(found["replay_ratio"])
    )
    assert ("(paper: " in words(run)) is (profile != "paper" and "official" in benchmarks()[suite])


@pytest.mark.parametrize(
    ("suite", "tasks", "steps", "repeat", "envs", "ratio", "size"),
    [
        ("minecraft", 1, 100_000_000, 1, 64, 32, "200m"),
        ("dmlab", 30, 100_000_000, 4, 16, 32, "200m"),
        ("procgen", 16, 50_000_000, 1, 16, 64, "200m"),
        ("atari", 57, 200_000_000, 4, 16, 32, "200m"),
        ("atari100k", 26, 400_000, 4, 1, 128, "200m"),
        ("bsuite", 23, None, 1, 1, 1024, "200m"),
        ("dmc", 18, 500_000, 2, 16, 512, "12m"),
        ("dmc_vision", 20, 1_000_000, 2, 16, 512, "12m"),
        ("crafter", 1, 1_000_000, 1, 1, 512, "200m"),
    ],
)
def test_the_protocols_are_the_papers_table(
    suite: str, tasks: int, steps: int | None, repeat: int, envs: int, ratio: int, size: str
) -> None:
    found = benchmarks()[suite]
    assert (len(found["tasks"]), len(set(found["tasks"])), found.get("steps")) == (tasks, tasks, steps)
    assert [found[name] for name in ("action_repeat", "envs", "replay_ratio", "size")] == [repeat, envs, ratio, size]


def test_control_from_vectors_lacks_the_two_quadruped_tasks() -> None:
    vision, vectors = (benchmarks()[suite]["tasks"] for suite in ("dmc_vision", "dmc"))
    assert [task for task in vision if task not in vectors] == ["quadruped-run", "quadruped-walk"]
    assert set(vectors) <= set(vision)


def test_a_suite_that_the_paper_does_not_have_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert [suite for suite in benchmarks() if not of_the_paper(suite)] == ["minigrid"]
    assert protocol("minigrid", "paper") == protocol("minigrid", "official")
    line = words(options("minigrid:MiniGrid-Empty-5x5-v0", "--steps", "1000"))
    assert "steps 1,000 (protocol: 500,000)" in line
    assert "paper" not in line
    assert main(["tasks", "minigrid"]) == 0
    shown = capsys.readouterr().out
    assert "The paper does not have this suite" in shown
    assert shown.splitlines()[-2:] == ["minigrid:BabyAI-OpenRedDoor-v0", "and every id that the package registers"]


def test_presets_and_options_win_over_the_suite() -> None:
    """A preset says how long and how large, the suite still how the task is played; single arguments can be changed."""
    run = options("atari:pong", "--preset", "laptop", "--env-arg", "noops=7", "--replay-ratio", "8")
    assert (run.steps, run.config.envs, run.config.units) == (100_000, 4, load_config("paper", "1m").units)
    assert (run.action_repeat, run.image_size, run.config.replay_ratio) == (4, 96, 8)
    assert run.env_arg == {**benchmarks()["atari"]["env"], "noops": 7}
    line = words(run)
    for part in ("protocol of atari: steps 100,000 (paper: 200,000,000)", "action_repeat 4,", "noops 7 (paper: 0)"):
        assert part in line
    assert "size 1m (paper: 200m)" in line
    assert suite_of("gym:CartPole-v1") is suite_of("atari") is suite_of("my_module:make") is None


def test_the_list_says_what_to_install(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def find(name: str, *_: Any) -> Any:
        return None if name in ("crafter", SUITES["procgen"].needs[0]) else object()

    monkeypatch.setattr(importlib.util, "find_spec", find)
    monkeypatch.setenv("COLUMNS", "160")
    assert main(["tasks"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line.split()}
    assert set(SUITES) <= set(lines)
    assert "installed" in lines["atari"]
    assert "pip install 'dreamer-spec[crafter]'" in lines["crafter"]
    assert "pip install --no-deps procgen-" in lines["procgen"]
    assert "not in the paper" in lines["minigrid"]
    assert "not in the paper" not in lines["crafter"]
    assert main(["tasks", "atari100k"]) == 0
    shown = capsys.readouterr().out
    assert "env.noops" in shown
    assert [line for line in shown.splitlines() if line.startswith("atari100k:")] == [
        f"atari100k:{task}" for task in tasks_of("atari100k")
    ]


def test_a_mistyped_suite_is_told_what_is_close(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tasks", "atari10k"]) == 2
    assert "unknown suite 'atari10k'; did you mean atari100k?" in capsys.readouterr().err
