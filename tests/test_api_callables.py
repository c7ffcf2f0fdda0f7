"""Callables as tasks: functions and classes of modules, of scripts and of sessions, in this process and in others."""

import functools
import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import train_fakes
from api_runs import FAKED, PATHS, SHORT, options, script
from train_fakes import EPISODE, Counting, FakeLearner

import dreamer_spec
import dreamer_spec.training.setup
from dreamer_spec import UserError, train
from dreamer_spec.cli import main

LOCK = threading.Lock()


@pytest.fixture(autouse=True)
def fake_learner(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(dreamer_spec.training.setup, "learner_class", lambda backend: FakeLearner)
    monkeypatch.chdir(tmp_path)


class Nested:
    def __call__(self) -> Counting:
        return Counting()

    @classmethod
    def make(cls) -> Counting:
        return Counting()


def locked() -> Counting:
    with LOCK:
        return Counting()


def not_an_environment() -> int:
    return 3


@pytest.mark.parametrize(
    ("task", "name"),
    [
        (Counting, "train_fakes:Counting"),
        (Nested(), "test_api_callables:Nested"),
        (Nested.make, "test_api_callables:Nested.make"),
        (functools.partial(functools.partial(train_fakes.Faulty, 3), reward=1), "train_fakes:Faulty"),
        (lambda: Counting(), "test_api_callables:<lambda>"),
    ],
)
def test_a_callable_has_a_name(task: Any, name: str) -> None:
    made = options(task=task)
    assert (made.task, made.make) == (name, task)


@pytest.mark.parametrize("processes", ["no", "yes", "auto"])
def test_a_local_callable_makes_the_environments(processes: str) -> None:
    class Own(Counting):
        """Known here alone."""

        def __init__(self, bonus: float) -> None:
            super().__init__()
            self._bonus = bonus

        def step(self, action: np.ndarray) -> Any:
            observation, reward, *rest = super().step(action)
            return observation, reward + self._bonus, *rest

    result = train(options(task=lambda bonus: Own(bonus), env_arg={"bonus": 7}, processes=processes))
    assert result.score is not None
    assert result.score.value == 10 + 7 * EPISODE
    about = json.loads((result.logdir / "run.json").read_text(encoding="utf-8"))
    assert "make" not in about["options"]
    assert about["task"] == "test_api_callables:test_a_local_callable_makes_the_environments.<locals>.<lambda>"


def test_a_run_of_the_command_goes_on_with_the_callable_itself(tmp_path: Path) -> None:
    main(["--backend=jax", "--task=train_fakes:Counting", *words(SHORT), "--logdir=run"])
    result = train(options(logdir="run", steps=90))
    assert (result.step, result.finished) == (90, True)


def words(settings: dict[str, Any]) -> list[str]:
    given = {name.replace("_", "-"): value for name, value in settings.items()}
    return ["--no-preflight", *(f"--{name}={value}" for name, value in given.items() if name != "preflight")]


def test_a_callable_that_cannot_be_sent_is_refused_in_a_line() -> None:
    lock = threading.Lock()

    def holding() -> Counting:
        with lock:
            return Counting()

    assert train(options(task=locked, processes="yes")).finished, "this module is imported there"
    with pytest.raises(
        UserError, match=r"<locals>\.holding cannot be sent to a process of its own: .*lock.*: processes no"
    ):
        train(options(task=holding, processes="auto", logdir="other"))
    result = train(options(task=holding, processes="no", logdir="other"))
    assert result.finished


@pytest.mark.parametrize("processes", ["no", "yes"])
def test_a_callable_that_makes_something_else_is_named(processes: str) -> None:
    with pytest.raises(UserError, match=r"not_an_environment\(\) returned a int; expected a gymnasium.Env"):
        train(options(task=not_an_environment, processes=processes))


# Scripts of users


@pytest.mark.parametrize("processes", ["auto", "yes"])
def test_a_script_without_a_guard_is_not_run_again_by_its_processes(tmp_path: Path, processes: str) -> None:
    code = (
        FAKED
        + f"""
print("begins")
class Own(Counting):
    pass
def make_env():
    return Own()
print(train(make_options("jax", make_env, **SHORT, processes={processes!r})))
print(train(make_options("jax", make_env, **SHORT, processes={processes!r}, seed=1)))
"""
    )
    process = script(tmp_path / "user", code)
    out, error = process.communicate(timeout=120)
    assert (process.returncode, error) == (0, ""), error
    assert out.count("begins") == 1
    assert out.count("at step 60: return 10; runs/train-make_env-jax-seed") == 2


def test_a_session_without_a_file_has_local_callables_too(tmp_path: Path) -> None:
    """As in a notebook, whose functions are defined nowhere."""
    code = FAKED + "print(train(make_options('jax', lambda: Counting(), **SHORT, processes='yes', logdir='run')))\n"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": PATHS},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.endswith("at step 60: return 10; run\n")
    assert "__main__:<lambda>: jax on cpu" in done.stdout


@pytest.mark.parametrize("entry_point", ["Own", "'__main__:Own'"])
@pytest.mark.parametrize("task", ["'gym:Own-v0'", "lambda: gymnasium.make('Own-v0')"])
def test_what_a_script_has_registered_is_known_to_its_processes(tmp_path: Path, task: str, entry_point: str) -> None:
    code = f"""
import gymnasium
class Own(Counting):
    pass
gymnasium.register("Own-v0", entry_point={entry_point}, disable_env_checker=True)
gymnasium.register("Unsendable-v0", entry_point=lambda lock=__import__("threading").Lock(): lock)
print(train(make_options("jax", {task}, **SHORT, processes="yes")))
"""
    process = script(tmp_path / "user", FAKED + code)
    out, error = process.communicate(timeout=120)
    assert (process.returncode, error) == (0, ""), error
    assert "at step 60: return 10;" in out


def test_the_name_of_a_scripts_own_function_means_the_function(tmp_path: Path) -> None:
    """A checkpoint has it; `evaluate` asks for it."""
    code = """
def make_env():
    return Counting()
print(train(make_options("jax", "train:make_env", **SHORT, processes="yes")))
make_options("jax", "train:<lambda>")
"""
    process = script(tmp_path / "user", FAKED + code)
    out, error = process.communicate(timeout=120)
    assert "at step 60: return 10;" in out
    assert error.splitlines()[-1].endswith(
        "task is 'train:<lambda>', and this script has no function <lambda>; give the function itself"
    )
