"""Environments that crash, raise, hang or return invalid data: what `dreamer_spec.envs.Environments` makes of them."""

import functools
import os
import signal
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import train_fakes
from gymnasium import spaces as gym
from train_fakes import EPISODE, Fragile

from dreamer_spec import cli
from dreamer_spec.envs import ContractEnv, Environments, make_env, vector
from dreamer_spec.envs.worker import OwnProcess
from dreamer_spec.errors import UserError
from dreamer_spec.training.evaluation import play
from reference_numpy.training_loop import derive_seed

SEEDS = [3, 4, 5]
VICTIM = 1
TIMEOUT = 3.0  # seconds: enough to make a fake, also on a busy machine

Make = Callable[..., Environments]
Stream = list[dict[str, list[Any]]]


@pytest.fixture
def make() -> Iterator[Make]:
    """Environments that are closed when the test ends."""
    made: list[Environments] = []

    def environments(task: str, count: int, processes: bool, **options: Any) -> Environments:
        made.append(Environments(functools.partial(make_env, f"train_fakes:{task}"), count, processes, **options))
        return made[-1]

    yield environments
    for envs in made:
        envs.close()


def calm(count: int) -> np.ndarray:
    return np.zeros((count, 2), np.float32)


def trouble(kind: str, worker: int, count: int) -> np.ndarray:
    action = calm(count)
    action[worker, 1] = next(number for number, name in Fragile.TROUBLES.items() if name == kind)
    return action


def stream(records: list[dict[str, np.ndarray]], worker: int) -> Stream:
    return [{key: value[worker].tolist() for key, value in record.items()} for record in records]


KINDS = [
    ("error", False),
    ("invalid data", False),
    ("error", True),
    ("invalid data", True),
    ("timeout", True),
    ("crash", True),
]


@pytest.mark.parametrize(("kind", "processes"), KINDS)
@pytest.mark.covers("LOOP-32", "LOOP-33", "LOOP-26")
def test_a_failed_environment_begins_anew_and_the_others_do_not_notice(make: Make, kind: str, processes: bool) -> None:
    envs = make("Fragile", 3, processes, timeout=TIMEOUT)
    records = [envs.reset(SEEDS), *(envs.step(calm(3)) for _ in range(7))]  # Two records into the second episode.
    before = len(records)
    records += [envs.step(trouble(kind, VICTIM, 3)), *(envs.step(calm(3)) for _ in range(12))]
    calm_envs = make("Fragile", 3, False)
    expected = [calm_envs.reset(SEEDS), *(calm_envs.step(calm(3)) for _ in range(len(records) - 1))]
    for worker in (0, 2):
        assert stream(records, worker) == stream(expected, worker)
    again = make("Fragile", 1, False)
    restarted = [again.reset([derive_seed(SEEDS[VICTIM], "restart", 0)]), *(again.step(calm(1)) for _ in range(12))]
    assert stream(records, VICTIM)[:before] == stream(expected, VICTIM)[:before]
    assert stream(records, VICTIM)[before:] == stream(restarted, 0)
    assert [records[before][flag][VICTIM] for flag in ("is_first", "is_last", "reward")] == [True, False, 0]
    assert not records[before - 1]["is_last"][VICTIM], "abandoned"
    assert envs.failures == 1
    (failure,) = envs.take_failures()
    assert (failure.worker, failure.kind) == (VICTIM, kind)
    assert "task train_fakes:Fragile, environment 1, step 7: " in failure.message
    words = {
        "error": "ZeroDivisionError: inside",
        "invalid data": "the reward is nan",
        "timeout": "within 3 seconds",
        "crash": "SIGKILL",
    }
    assert words[kind] in failure.message
    assert ("train_fakes.py" in failure.details) == (kind == "error")
    assert envs.take_failures() == []


def test_processes_change_nothing(make: Make) -> None:
    first, second = (make("Maze", 2, processes) for processes in (False, True))
    action = np.tile(np.float32([0, 1, 0, 0.5, -0.5]), (2, 1))
    streams = [[envs.reset([0, 1]), *(envs.step(action) for _ in range(20))] for envs in (first, second)]
    ours, theirs = (
        [[(key, value.dtype, value.tobytes()) for key, value in record.items()] for record in records]
        for records in streams
    )
    assert ours == theirs


@pytest.mark.parametrize("victim", [0, 1])
@pytest.mark.parametrize("stepping", [False, True])
@pytest.mark.covers("LOOP-32")
def test_a_worker_that_is_killed_is_replaced(make: Make, victim: int, stepping: bool) -> None:
    """In the middle of a step, and while it waits for an action."""
    envs = make("Sleepy", 2, True)
    envs.reset([0, 1])
    if not stepping:
        os.kill(worker_ids(envs)[victim], signal.SIGKILL)
    envs.start(calm(2))
    if stepping:
        os.kill(worker_ids(envs)[victim], signal.SIGKILL)
    record = envs.finish()
    assert record["is_first"].tolist() == [worker == victim for worker in (0, 1)]
    assert record["observation"][victim].tolist() == [0, 0]
    assert record["observation"][1 - victim].tolist() == [0, 1]
    assert envs.step(calm(2))["observation"][victim].tolist() == [0, 1]
    assert [(failure.worker, failure.kind) for failure in envs.take_failures()] == [(victim, "crash")]


def worker_ids(envs: Environments) -> list[int]:
    return [worker.process.pid for worker in envs._workers if isinstance(worker, OwnProcess)]


@pytest.mark.parametrize("processes", [False, True])
@pytest.mark.covers("LOOP-32")
def test_too_many_failures_stop_the_run_with_the_workers_traceback(make: Make, processes: bool) -> None:
    envs = make("Fragile", 2, processes, failures_allowed=2)
    envs.reset([0, 1])
    envs.step(calm(2))
    envs.step(trouble("error", 0, 2))
    envs.step(trouble("error", 1, 2))
    with pytest.raises(UserError) as error:
        envs.step(trouble("error", 0, 2))
    words = [
        "task train_fakes:Fragile, environment 0, step 2: ",
        "ZeroDivisionError",
        "failed 3 times",
        "2 are allowed",
        "--env-failures",
    ]
    assert all(word in str(error.value) for word in words), error.value
    assert error.value.details.startswith("Traceback")
    assert error.value.details.endswith("ZeroDivisionError: inside\nthe environment\n")
    assert "train_fakes.py" in error.value.details


def test_failures_are_told_in_the_order_of_the_environments(make: Make) -> None:
    envs = make("Fragile", 2, True)
    envs.reset([0, 1])
    envs.step(
        trouble("error", 0, 2) + trouble("error", 1, 2) + np.float32([[0.2, 0], [0, 0]])
    )  # The first takes a second.
    assert [failure.worker for failure in envs.take_failures()] == [0, 1]


@pytest.mark.covers("LOOP-32")
def test_failures_of_long_ago_are_forgotten(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vector, "WINDOW", 10)
    envs = make("Fragile", 2, False, failures_allowed=1)
    envs.reset([0, 1])
    for _ in range(3):
        envs.step(trouble("error", 0, 2))
        for _ in range(EPISODE + 2):  # At the end of an episode the action would be ignored.
            envs.step(calm(2))
    assert envs.failures == 3
    envs.step(trouble("invalid data", 1, 2))
    with pytest.raises(UserError, match="failed 2 times within 10 records"):
        envs.step(trouble("invalid data", 1, 2))


@pytest.mark.parametrize("processes", [False, True])
def test_an_environment_that_always_fails_stops_the_run(make: Make, processes: bool) -> None:
    envs = make("nan_observation", 2, processes, failures_allowed=1)
    envs.reset([0, 1])
    for _ in range(7):
        envs.step(calm(2))
    with pytest.raises(UserError, match=r"environment 1, step 7: observation 'observation' holds nan.*2 times"):
        envs.step(calm(2))


class Spoilt(train_fakes.Counting):
    """`spoil` makes an environment that cannot be made, cannot be reset, or has other spaces than the first."""

    def __init__(self, how: str) -> None:
        super().__init__()
        self._how = how
        if how == "make":
            raise RuntimeError("no such level")
        if how == "spaces":
            self.action_space = gym.Discrete(3)

    def reset(self, **kwargs: Any) -> Any:
        if self._how == "reset":
            raise RuntimeError("no such level")
        return super().reset(**kwargs)


def spoil(how: str, index: int) -> ContractEnv:
    return ContractEnv(Spoilt(how if index == 1 else ""), "t", index)


@pytest.mark.parametrize("processes", [False, True])
@pytest.mark.parametrize(("how", "attempts"), [("make", 3), ("reset", 3), ("spaces", 1)])
@pytest.mark.covers("LOOP-46")
def test_an_environment_that_gives_no_first_record_stops_the_run(how: str, attempts: int, processes: bool) -> None:
    """In three attempts, or at once where others would end alike. The first one has been made already: another is the
    trouble."""
    envs = Environments(functools.partial(spoil, how), 2, processes)
    try:
        with pytest.raises(
            UserError, match="environment 1 is not like the first" if how == "spaces" else "no such level"
        ) as error:
            envs.reset([0, 1])
        assert ("(3 attempts)" in str(error.value)) == (attempts == 3)
        assert ("test_train_workers.py" in error.value.details) == (how != "spaces")
    finally:
        envs.close()
    assert envs.failures == attempts


@pytest.mark.covers("LOOP-26", "LOOP-32", "LOOP-33")
def test_a_reset_that_fails_too_is_tried_with_another_seed() -> None:
    seeds: list[int] = []

    class Stubborn(Fragile):
        def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
            assert seed is not None
            seeds.append(seed)
            if len(seeds) in (2, 3):
                raise RuntimeError("not now")
            return super().reset(seed=seed)

    envs = Environments(lambda index: ContractEnv(Stubborn(), "t", index), 1, False)
    envs.reset([783237557])
    assert envs.step(trouble("error", 0, 1))["is_first"].all()
    assert envs.failures == 3
    once = derive_seed(783237557, "restart", 0)
    twice = derive_seed(once, "restart", 0)
    workers = [783237557, once, twice, derive_seed(twice, "restart", 0)]
    assert seeds[:2] == [1184808864, 1758740972], "the worked numbers of the chapter"
    assert seeds == [derive_seed(seed, "episode", 0) for seed in workers]
    assert len(set(seeds)) == 4


@pytest.mark.parametrize("processes", [False, True])
def test_a_reset_begins_everywhere_anew(make: Make, processes: bool) -> None:
    """Whatever was before: the end of an episode, restarts, actions whose records nobody asked for."""

    def begin() -> list[list[float]]:
        records = [envs.reset([0, 1]), *(envs.step(calm(2)) for _ in range(EPISODE))]
        assert [record["is_first"].tolist() for record in records] == [[True, True], *[[False, False]] * EPISODE]
        assert records[-1]["is_last"].all()
        # `Counting` numbers its episodes from when it was made; the random numbers are those of the seed.
        return [record["observation"][:, 1].tolist() for record in records]

    envs = make("Fragile", 2, processes)
    first = begin()
    assert begin() == first
    envs.step(calm(2))
    envs.step(trouble("error", 0, 2))
    envs.start(calm(2))
    assert begin() == first


@pytest.mark.parametrize(("task", "pending"), [("Fragile", True), ("Clinging", False), ("Counting", True)])
def test_closing_never_hangs(make: Make, monkeypatch: pytest.MonkeyPatch, task: str, pending: bool) -> None:
    monkeypatch.setattr(vector, "CLOSING", 0.5)
    envs = make(task, 2, True)
    envs.reset([0, 1])
    processes = [worker.process for worker in envs._workers if isinstance(worker, OwnProcess)]
    if pending:
        envs.start(trouble("timeout", 0, 2))
    envs.close()
    assert [process.exitcode for process in processes] == [-signal.SIGKILL] * 2
    envs.close()


def test_closing_lets_the_environments_close() -> None:
    """And in this process those that were made but never reset too."""
    closed: list[str] = []

    class Polite(train_fakes.Counting):
        def close(self) -> None:
            closed.append("closed")
            raise RuntimeError("but not without complaint")

    Environments(lambda index: ContractEnv(Polite(), "t", index), 2, False).close()
    assert closed == ["closed"]


def test_workers_outlive_the_signals_that_are_for_the_trainer(make: Make) -> None:
    """Sent to the whole process group, they must not end the workers before the trainer has saved."""
    envs = make("Counting", 2, True)
    envs.reset([0, 1])
    for worker in worker_ids(envs):
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(worker, number)
    assert envs.step(calm(2))["reward"].tolist() == [1, 1]
    assert envs.failures == 0


@pytest.mark.parametrize("processes", [False, True])
@pytest.mark.covers("LOOP-20", "LOOP-32")
def test_an_abandoned_episode_has_no_score(make: Make, processes: bool) -> None:
    """The first is abandoned after rewards 1 and 2. The new environment plays 1 + 2 + 3 + 4, then 11 + 12 + 13 + 14."""
    envs = make("Fragile", 1, processes)
    actions = iter([calm(1), calm(1), trouble("error", 0, 1)])
    assert play(envs, lambda record: next(actions, calm(1)), 2, [0]) == [10, 50]
    assert envs.failures == 1
    assert EPISODE == 4


def test_details_of_an_error_are_printed_before_its_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(arguments: object) -> None:
        raise UserError("one line\nonly", "Traceback:\n  File ...\n")

    monkeypatch.setattr(cli, "parse_runs", fail)
    assert cli.main(["--backend", "jax"]) == 2
    assert capsys.readouterr().err == "Traceback:\n  File ...\ntrain: error: one line only\n"
