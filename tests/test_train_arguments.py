"""Keyword arguments and time limits of environments: read, written, used, saved, and not changed half way."""

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import train_fakes
from train_agents import save_checkpoint
from train_fakes import EPISODE, FakeLearner
from train_runs import Make, logged

import dreamer_spec.training.setup
from dreamer_spec import arguments
from dreamer_spec.cli import main, parse
from dreamer_spec.disk import about
from dreamer_spec.disk.checkpoint import open_checkpoint
from dreamer_spec.disk.saved_agent import agent_of, check_info
from dreamer_spec.envs import ContractEnv, make_env
from dreamer_spec.envs.failure import Failure
from dreamer_spec.envs.trial import make_here
from dreamer_spec.errors import UserError
from dreamer_spec.policy import Policy, save
from dreamer_spec.report.page import render
from dreamer_spec.report.runs import read_run
from dreamer_spec.training import loop
from spec import Config, Discrete, Spaces, Vector, load_config

VALUES = [
    *(0, -3, 2**63 - 1, 0.5, True, None, "", "8x8", "a=b", "1", "true", '"quoted"', "[1", "NaN", "9" * 30),
    *([1, "a", {"b": []}], {}, "ä ö", "two words"),
]


class Adjustable(train_fakes.Endless):
    """Never ends by itself. `made` says with what the instances were made."""

    made: list[dict[str, Any]] = []  # noqa: RUF012

    def __init__(self, size: int = 2, name: str = "plain") -> None:
        super().__init__()
        if not isinstance(size, int):
            raise ValueError(f"size must be a number, not {size}")
        self.made.append({"size": size, "name": name})


class Moody(Adjustable):
    refusals = 2

    def __init__(self, size: int) -> None:
        if Moody.refusals:
            Moody.refusals -= 1
            raise ValueError("not now")
        super().__init__(size)


class Limited(train_fakes.Endless):
    """Keeps a limit of its own."""

    def step(self, action: np.ndarray) -> Any:
        *rest, _, info = super().step(action)
        return *rest, self._time == EPISODE, info


TASK = "test_train_arguments:Adjustable"
SPACES = Spaces({"observation": Vector(2)}, {"action": Vector(2)})


@pytest.fixture(autouse=True)
def forgotten() -> None:
    Adjustable.made.clear()


def episode(env: ContractEnv) -> tuple[int, bool, bool]:
    """Steps, terminated and truncated of an episode without actions."""
    env.reset(seed=0)
    terminated = truncated = False
    steps = 0
    while not (terminated or truncated):
        _, _, terminated, truncated, _ = env.step(np.zeros(env.spaces.action_size, np.float32))
        steps += 1
    return steps, terminated, truncated


@pytest.mark.parametrize("value", VALUES, ids=repr)
def test_what_is_written_is_read_again(value: Any) -> None:
    (text,) = arguments.write({"name": value})
    name, read = arguments.read(text)
    assert (name, type(read), read) == ("name", type(value), value)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        *(
            ("a=3", 3),
            ("a=8x8", "8x8"),
            ("a=[1, 2]", [1, 2]),
            ("a=false", False),
            ("a=False", "False"),
            ("a=null", None),
        ),
        *(("a=", ""), ("a=x=y", "x=y"), ('a="3"', "3"), ("a=NaN", "NaN"), ("a=1e3", 1000.0)),
    ],
)
def test_values_are_json_or_else_text(text: str, expected: Any) -> None:
    read = arguments.read(text)[1]
    assert (type(read), read) == (type(expected), expected)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--env-arg", "3"], "'3' is not NAME=VALUE"),
        (["--env-arg", "=3"], "'=3' is not NAME=VALUE"),
        (["--env-arg", "a-b=3"], "'a-b=3' is not NAME=VALUE"),
        (["--env-arg", f"a={2**63}"], "a cannot be saved"),
        (["--env-arg", "a=[1e999]"], "a cannot be saved"),
        (["--env-arg", 'a="\\ud800"'], "a cannot be saved"),
        (["--env-arg", "a=\udcff"], "a cannot be saved"),
        (["--env-arg", "a=1", "--env-arg", "a=2"], "--env-arg a was given twice: 1 and 2"),
        (["--time-limit", "0"], "--time-limit"),
        (["--time-limit", "1.5"], "--time-limit"),
    ],
)
def test_words_that_cannot_be_used_are_named(words: list[str], said: str) -> None:
    with pytest.raises(UserError) as error:
        parse(["--backend", "jax", "--task", TASK, *words])
    assert said in str(error.value)


def test_the_command_of_a_run_repeats_them(tmp_path: Path) -> None:
    words = [
        word
        for text in arguments.write({f"v{i}": value for i, value in enumerate(VALUES)})
        for word in ("--env-arg", text)
    ]
    options = parse(["--backend", "jax", "--task", TASK, "--time-limit", "20", *words])
    assert dict(options.env_arg) == {f"v{i}": value for i, value in enumerate(VALUES)}
    assert options.time_limit == 20
    assert parse(about.command_line(options)[1:]) == options


# Environments


def test_keyword_arguments_reach_the_environment() -> None:
    make_env(TASK, arguments={"size": 5, "name": "other"})
    assert Adjustable.made == [{"size": 5, "name": "other"}]
    assert make_env("gym:FrozenLake-v1", arguments={"map_name": "8x8"}).spaces.observations == {
        "observation": Discrete((64,))
    }


@pytest.mark.parametrize(
    ("task", "given", "words"),
    [
        ("gym:FrozenLake-v1", {"map_nam": "8x8"}, ["--env-arg map_nam=8x8", "unexpected keyword argument"]),
        ("gym:FrozenLake-v1", {"map_name": "9x9"}, ["--env-arg map_name=9x9", "KeyError"]),
        ("gym:CartPole-v1", {"id": 3}, ["--env-arg id=3"]),
        ("gym:CartPole-v1", {"max_episode_steps": 3}, ["max_episode_steps", "--time-limit"]),
        ("gym:NoSuchGame-v0", {"a": 3}, ["unknown task", "NoSuchGame"]),
        (TASK, {"sise": 3}, ["--env-arg sise=3", "unexpected keyword argument 'sise'"]),
        (TASK, {"name": "x", "size": "3"}, ["--env-arg name=x", '--env-arg size="3"', "size must be a number"]),
        ("dmc:cartpole-balance", {"random": 3}, ["--env-arg random=3", "unexpected keyword argument 'random'"]),
    ],
)
def test_what_an_environment_does_not_take_is_named(task: str, given: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(UserError) as error:
        make_env(task, arguments=given)
    for word in (task, *words):
        assert word in str(error.value)


def test_an_environment_that_refuses_its_arguments_now_and_then_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only a keyword that it does not have is certain to be refused again."""
    monkeypatch.setattr(Moody, "refusals", 2)
    told: list[Failure] = []
    env = make_here(lambda index: make_env("test_train_arguments:Moody", index, arguments={"size": 3}), told.append)
    assert env.spaces
    assert ["--env-arg size=3: ValueError: not now" in failure.message for failure in told] == [True, True]


def test_an_error_without_arguments_stays_what_it_is() -> None:
    gymnasium.register("Wrong-v0", Adjustable, kwargs={"size": "3"})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="must be a number"):
        make_env("gym:Wrong-v0")
    del gymnasium.registry["Wrong-v0"]


@pytest.mark.parametrize(("repeat", "steps"), [(1, 7), (3, 3), (10, 1)])
@pytest.mark.parametrize("task", [TASK, "gym:Pendulum-v1", "dmc:pendulum-swingup"])
@pytest.mark.covers("LOOP-62", "LOOP-28")
def test_a_time_limit_counts_frames_and_truncates(task: str, repeat: int, steps: int) -> None:
    if task.startswith("dmc"):
        pytest.importorskip("dm_control")
    assert episode(make_env(task, action_repeat=repeat, time_limit=7)) == (steps, False, True)


@pytest.mark.covers("LOOP-62")
def test_a_time_limit_may_be_longer_than_the_suites() -> None:
    assert episode(make_env("gym:Pendulum-v1", time_limit=250)) == (250, False, True)
    pytest.importorskip("dm_control")
    assert episode(make_env("dmc:pendulum-swingup", time_limit=1100)) == (1100, False, True)


@pytest.mark.covers("LOOP-62")
def test_a_limit_inside_an_environment_stays() -> None:
    assert episode(make_env("test_train_arguments:Limited", time_limit=EPISODE + 1)) == (EPISODE, False, True)
    assert episode(make_env("test_train_arguments:Limited", time_limit=EPISODE - 1)) == (EPISODE - 1, False, True)


# Runs


def test_a_report_tells_runs_apart_by_them(make: Make, tmp_path: Path) -> None:
    for size in (3, 4):
        loop.run(make(task=TASK, env_arg={"size": size}, time_limit=5, logdir=tmp_path / f"{size}"), FakeLearner)
    page = render([read_run(tmp_path / name) for name in ("3", "4")], 0.0)
    for size in (3, 4):
        assert f"<th>env_arg {{&#39;size&#39;: {size}}}" in page


@pytest.mark.covers("LOOP-63")
def test_a_run_uses_saves_and_keeps_them(make: Make) -> None:
    given = {"env_arg": {"size": 3}, "time_limit": 5}
    options = make(task=TASK, **given)
    loop.run(options, FakeLearner)
    assert all(entry == {"size": 3, "name": "plain"} for entry in Adjustable.made)
    assert {line["episode/length"] for line in logged(options.logdir) if "episode/length" in line} == {6}
    saved = about.read_about(options.logdir)
    assert saved is not None
    assert (saved["options"]["env_arg"], saved["options"]["time_limit"]) == ({"size": 3}, 5)
    assert "--env-arg size=3" in saved["command"]
    loop.run(make(task=TASK, steps=60, **given), FakeLearner)
    others: list[tuple[dict[str, Any], str]] = [
        ({"time_limit": 5}, "env_arg"),
        ({"env_arg": {"size": 4}, "time_limit": 5}, "env_arg"),
        ({"env_arg": {"size": 3}}, "time_limit"),
        ({"env_arg": {"size": 3}, "time_limit": 6}, "time_limit"),
    ]
    for other, name in others:
        with pytest.raises(UserError, match=f"{name}: .* may not change half way"):
            loop.run(make(task=TASK, steps=90, **other), FakeLearner)


CONFIG: Config = load_config("paper", "tiny", compute_dtype="float32", envs=1)


@pytest.mark.parametrize(
    ("words", "made", "length"),
    [
        (["--task", TASK], {"size": 3, "name": "saved"}, 6),
        (["--task", TASK, "--env-arg", "size=4"], {"size": 4, "name": "saved"}, 6),
        (["--task", TASK, "--time-limit", "9"], {"size": 3, "name": "saved"}, 10),
    ],
)
@pytest.mark.covers("LOOP-63")
def test_evaluation_uses_those_of_the_checkpoint_or_others(
    words: list[str], made: dict[str, Any], length: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dreamer_spec.training.setup, "learner_class", lambda backend: FakeLearner)
    monkeypatch.setattr(FakeLearner, "load_state_dict", lambda self, state: None)
    known = make_env(TASK).translation
    arguments = {"size": 3, "name": "saved"}
    checkpoint = save_checkpoint(
        tmp_path, CONFIG, SPACES, translation=known, task=TASK, env_arg=arguments, time_limit=5
    )
    Adjustable.made.clear()
    assert main(["eval", str(checkpoint), "--episodes", "1", "--json", str(tmp_path / "out.json"), *words]) == 0
    assert all(entry == made for entry in Adjustable.made)
    result = json.loads((tmp_path / "out.json").read_text())
    assert result["lengths"] == [length]
    assert result["env_arg"] == made


def test_another_task_has_arguments_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dreamer_spec.training.setup, "learner_class", lambda backend: FakeLearner)
    monkeypatch.setattr(FakeLearner, "load_state_dict", lambda self, state: None)
    known = make_env(TASK).translation
    checkpoint = save_checkpoint(
        tmp_path, CONFIG, SPACES, translation=known, task=TASK, env_arg={"size": 3}, time_limit=2
    )
    arguments = ["eval", str(checkpoint), "--episodes", "1", "--json", str(tmp_path / "out.json")]
    assert main([*arguments, "--task", "train_fakes:Counting"]) == 0
    result = json.loads((tmp_path / "out.json").read_text())
    assert (result["lengths"], result["env_arg"], result["time_limit"]) == ([EPISODE + 1], {}, None)


def test_a_policy_says_them(tmp_path: Path) -> None:
    checkpoint = save_checkpoint(tmp_path, CONFIG, SPACES, task=TASK, env_arg={"size": 3}, time_limit=5)
    save(tmp_path / "policy", agent_of(open_checkpoint(checkpoint)))
    info = Policy.load(tmp_path / "policy").info
    assert (info["env_arg"], info["time_limit"]) == ({"size": 3}, 5)


@pytest.mark.parametrize(
    ("name", "value"), [("env_arg", [1]), ("env_arg", {"a b": 1}), ("time_limit", 0), ("time_limit", "7")]
)
def test_a_checkpoint_that_says_something_else_is_refused(name: str, value: Any, tmp_path: Path) -> None:
    info = {
        "task": "a:b",
        "step": 0,
        "backend": "jax",
        "action_repeat": 1,
        "image_size": 64,
        "source": {},
        "versions": {},
    }
    check_info({**info, "env_arg": {}, "time_limit": None}, SPACES)
    with pytest.raises(ValueError, match=name if name == "time_limit" else "env_arg|keyword arguments"):
        check_info({**info, "env_arg": {}, "time_limit": None, name: value}, SPACES)
