"""Whatever an environment raises, in its steps and before the first one: a failure like any other, and a line where it
cannot go on."""

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import train_fakes
from train_surroundings import is_running

from dreamer_spec.envs import ContractEnv, Environments, Failure, make_env, try_out
from dreamer_spec.errors import UserError
from dreamer_spec.system.signals import stoppable

TIMEOUT = 3.0  # seconds: enough to make a fake, also on a busy machine
CALM = np.zeros((1, 2), np.float32)


class Moody(train_fakes.Counting):
    """Cannot be made or reset until this has been tried as often as `patience` says, in whatever process."""

    def __init__(self, where: str, counter: Path, patience: int) -> None:
        super().__init__()
        self._where, self._counter, self._patience = where, counter, patience
        self._fail_in("make")

    def reset(self, **kwargs: Any) -> Any:
        self._fail_in("reset")
        return super().reset(**kwargs)

    def _fail_in(self, where: str) -> None:
        if where == self._where:
            with self._counter.open("ab") as file:
                file.write(b".")
            if self._counter.stat().st_size <= self._patience:
                raise SystemExit("not now")


def make_moody(where: str, counter: Path, patience: int, index: int) -> ContractEnv:
    return ContractEnv(Moody(where, counter, patience), "t", index)


@pytest.mark.parametrize("processes", [False, True])
@pytest.mark.parametrize("where", ["make", "reset"])
@pytest.mark.covers("LOOP-32", "LOOP-46")
def test_what_fails_now_and_then_before_the_first_record_is_tried_again(
    tmp_path: Path, where: str, processes: bool
) -> None:
    envs = Environments(functools.partial(make_moody, where, tmp_path / "counter", 2), 1, processes)
    try:
        assert envs.reset([0])["is_first"].all()
    finally:
        envs.close()
    assert envs.failures == 2
    assert [failure.kind for failure in envs.take_failures()] == ["error", "error"]


@pytest.mark.parametrize("processes", [False, True])
@pytest.mark.covers("LOOP-46")
def test_an_environment_that_cannot_be_made_says_why(tmp_path: Path, processes: bool) -> None:
    with pytest.raises(
        UserError, match=r"environment 0, when it was made: the environment raised SystemExit: not now \(3 attempts\)"
    ) as error:
        Environments(functools.partial(make_moody, "make", tmp_path / "counter", 9), 1, processes)
    assert "Moody" in error.value.details or "_fail_in" in error.value.details
    assert (tmp_path / "counter").stat().st_size == 3


@pytest.mark.covers("LOOP-46")
def test_no_more_attempts_than_failures_are_allowed(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"failed 1 times.*0 are allowed"):
        Environments(functools.partial(make_moody, "make", tmp_path / "counter", 9), 1, False, failures_allowed=0)


# Trials


@pytest.mark.parametrize(("task", "deserves"), [("Counting", False), ("Sleepy", True)])
def test_a_trial_finds_the_spaces_and_slow_steps(task: str, deserves: bool) -> None:
    trial = try_out(functools.partial(make_env, f"train_fakes:{task}"), pytest.fail, seed=0)
    assert trial.task == f"train_fakes:{task}"
    assert trial.translation.spaces == make_env("train_fakes:Counting").spaces
    assert trial.deserves_process == deserves


@pytest.mark.parametrize("where", ["reset", "step"])
@pytest.mark.covers("LOOP-32", "LOOP-46")
def test_an_environment_that_fails_in_its_trial_gets_a_process(tmp_path: Path, where: str) -> None:
    told: list[Failure] = []
    task = "train_fakes:wrong_dtype"
    make = (
        functools.partial(make_env, task)
        if where == "step"
        else functools.partial(make_moody, "reset", tmp_path / "counter", 9)
    )
    assert try_out(make, told.append, seed=0).deserves_process
    assert [failure.kind for failure in told] == ["invalid data" if where == "step" else "error"]


@pytest.mark.parametrize(("where", "words"), [("make", "when it was made"), ("reset", "at its first reset")])
@pytest.mark.covers("LOOP-46")
def test_a_trial_that_hangs_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str, words: str) -> None:
    monkeypatch.setenv("STUCK", f"{where}:loop")
    monkeypatch.setenv("ARRIVED", str(tmp_path / "arrived"))
    with pytest.raises(
        UserError, match=rf"task stuck, environment 0, {words}: no answer within 3 seconds \(--env-timeout\)$"
    ):
        try_out(functools.partial(make_stuck, dict(os.environ)), pytest.fail, "stuck", seed=0, timeout=TIMEOUT)
    assert not is_running(int((tmp_path / "arrived").read_text()))


def make_stuck(environment: dict[str, str], index: int) -> ContractEnv:
    os.environ.update(environment)  # The server that forks the processes may have begun before the test.
    return make_env("train_surroundings:Stuck", index)


class Unpicklable:
    def __init__(self, error: BaseException) -> None:
        self._error = error

    def __reduce__(self) -> Any:
        raise self._error


@pytest.mark.parametrize("error", [TypeError("not this"), SystemExit(0)])
@pytest.mark.covers("LOOP-32")
def test_a_function_that_cannot_be_pickled_is_said(error: BaseException) -> None:
    unpicklable = Unpicklable(error)
    with pytest.raises(UserError, match=f"its process cannot be started: .*{type(error).__name__}: {error}"):
        Environments(lambda index: ContractEnv(train_fakes.Counting(), str(unpicklable), index), 1, True)


# Whatever is raised


class Unspeakable(Exception):
    def __str__(self) -> str:
        raise ValueError("no words")

    __repr__ = __str__


class Evil:
    """An array that ends the process when NumPy asks for it."""

    def __array__(self, *arguments: Any, **more: Any) -> np.ndarray:
        raise SystemExit(0)


RAISED = [
    SystemExit(0),
    GeneratorExit(),
    KeyboardInterrupt(),
    BaseException("b"),
    Unspeakable(),
    RuntimeError("\udcff"),
    RuntimeError("x" * 10**6),
]


@pytest.mark.parametrize("error", RAISED, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("processes", [False, True])
@pytest.mark.covers("LOOP-32")
def test_whatever_an_environment_raises_is_a_failure(processes: bool, error: BaseException) -> None:
    with stoppable():  # Where Ctrl-C does not raise a KeyboardInterrupt, so one is the environment's.
        details = assert_restarted(
            lambda index: ContractEnv(train_fakes.Faulty(2, error=error), "t", index), processes, type(error).__name__
        )
    assert "train_fakes.py" in details or len(str(error)) > 1_000


@pytest.mark.parametrize("processes", [False, True])
@pytest.mark.covers("LOOP-32")
def test_an_observation_that_raises_is_a_failure(processes: bool) -> None:
    assert "__array__" in assert_restarted(make_evil, processes, "SystemExit: 0")


def make_evil(index: int) -> ContractEnv:
    return ContractEnv(train_fakes.Faulty(2, observation=Evil()), "t", index)


def assert_restarted(make: Callable[[int], ContractEnv], processes: bool, words: str) -> str:
    """Returns the traceback."""
    envs = Environments(make, 1, processes)
    try:
        envs.reset([0])
        flags = [envs.step(CALM)["is_first"].item() for _ in range(3)]
    finally:
        envs.close()
    assert flags == [False, True, False]
    (failure,) = envs.take_failures()
    assert failure.kind == "error"
    assert failure.message.startswith("task t, environment 0, step 2: the environment raised ")
    assert words in failure.message
    assert len(failure.message) < 2_000
    assert len(failure.details) <= 20_000
    return failure.details


@pytest.mark.covers("LOOP-32")
def test_a_process_that_ends_without_a_word_is_not_said_to_have_said_something() -> None:
    class Leaving(train_fakes.Counting):
        def step(self, action: np.ndarray) -> Any:
            os._exit(0)

    envs = Environments(lambda index: ContractEnv(Leaving(), "t", index), 1, True)
    try:
        envs.reset([0])
        assert envs.step(CALM)["is_first"].all()
    finally:
        envs.close()
    (failure,) = envs.take_failures()
    assert failure.kind == "crash"
    assert (
        failure.message
        == "task t, environment 0, step 1: its process ended with exit code 0; if it said why, that is above"
    )


@pytest.mark.covers("LOOP-32")
def test_ctrl_c_is_no_failure() -> None:
    envs = Environments(
        lambda index: ContractEnv(train_fakes.Faulty(1, error=KeyboardInterrupt()), "t", index), 1, False
    )
    envs.reset([0])
    with pytest.raises(KeyboardInterrupt):
        envs.step(CALM)


def test_an_environment_that_cannot_be_closed_is_left() -> None:
    class Clingy(train_fakes.Counting):
        def close(self) -> None:
            raise SystemExit(0)

    Environments(lambda index: ContractEnv(Clingy(), "t", index), 1, False).close()


# Flags


class Flagged(train_fakes.Counting):
    """`Counting` whose flags are what it is told."""

    def __init__(self, **flags: Any) -> None:
        super().__init__()
        self._flags = flags

    def step(self, action: np.ndarray) -> Any:
        observation, reward, _, _, info = super().step(action)
        return observation, reward, self._flags.get("terminated", False), self._flags.get("truncated", False), info


RIGHT_FLAGS = [bool, np.bool_, int, np.int8, lambda flag: np.array(flag), lambda flag: np.array([[flag]], np.uint8)]


@pytest.mark.parametrize("name", ["terminated", "truncated"])
@pytest.mark.parametrize("kind", RIGHT_FLAGS)
@pytest.mark.covers("LOOP-47")
def test_flags_may_be_booleans_or_whole_numbers(name: str, kind: Callable[[bool], Any]) -> None:
    for flag in (False, True):
        env = ContractEnv(Flagged(**{name: kind(flag)}), "t")
        env.reset(seed=0)
        flags = dict(zip(("terminated", "truncated"), env.step(CALM[0])[2:4], strict=True))
        assert flags == {"terminated": False, "truncated": False, name: flag}
        assert all(type(value) is bool for value in flags.values())


WRONG_FLAGS = [
    float("nan"),
    0.0,
    1.0,
    "False",
    "",
    None,
    2,
    -1,
    [],
    [False, True],
    {},
    np.zeros(2, bool),
    np.float32(1),
    np.array("x"),
]


@pytest.mark.parametrize("name", ["terminated", "truncated"])
@pytest.mark.parametrize("value", WRONG_FLAGS, ids=repr)
@pytest.mark.covers("LOOP-47")
def test_other_flags_are_invalid_data(name: str, value: Any) -> None:
    env = ContractEnv(Flagged(**{name: value}), "t")
    env.reset(seed=0)
    with pytest.raises(UserError) as error:
        env.step(CALM[0])
    assert str(error.value) == f"task t, environment 0, step 1: {name} is {f'{value!r}'[:80]}; expected True or False"


def test_a_wrong_flag_is_seen_in_every_repetition_of_an_action() -> None:
    """Also where the other flag ends the episode first, and in any of the repeated frames."""
    for flags in ({"terminated": True, "truncated": "False"}, {"truncated": float("nan")}):
        env = ContractEnv(Flagged(**flags), "t", action_repeat=3)
        env.reset(seed=0)
        with pytest.raises(UserError, match="truncated is"):
            env.step(CALM[0])
