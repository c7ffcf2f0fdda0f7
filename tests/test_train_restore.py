"""Environments brought back to the middle of their episodes: what follows is what would have followed."""

import functools
import json
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import train_fakes

from dreamer_spec.envs import Environments, History, Record, history, make_env, random_actions
from reference_numpy.training_loop import derive_seed

COUNT = 2
AFTER = 50  # records that are compared

Make = Callable[..., Environments]


@pytest.fixture
def make() -> Iterator[Make]:
    """Environments that are closed when the test ends."""
    made: list[Environments] = []

    def environments(task: str, processes: bool = False, **options: Any) -> Environments:
        made.append(Environments(functools.partial(make_env, task, **options), COUNT, processes))
        return made[-1]

    yield environments
    for envs in made:
        envs.close()


def saved(entry: History | None) -> History | None:
    """Through JSON and an array, as in a checkpoint."""
    if entry is None:
        return None
    return History.from_json(json.loads(json.dumps(entry.to_json())), np.array(entry.actions))


def equal(first: Record, second: Record) -> bool:
    return {key: (value.dtype, value.shape, value.tobytes()) for key, value in first.items()} == {
        key: (value.dtype, value.shape, value.tobytes()) for key, value in second.items()
    }


TASKS = [
    ("gym:CartPole-v1", False, {}),
    ("gym:CartPole-v1", True, {}),
    ("dmc:cartpole-balance", False, {"action_repeat": 10}),
    ("train_fakes:Maze", False, {"action_repeat": 3, "image_size": 16}),
    ("train_fakes:Maze", True, {"action_repeat": 3, "image_size": 16}),
]


@pytest.mark.parametrize(("task", "processes", "options"), TASKS)
@pytest.mark.covers("LOOP-33", "LOOP-34")
def test_what_follows_a_restore_is_what_would_have_followed(
    make: Make, task: str, processes: bool, options: dict[str, int]
) -> None:
    """At the first record of all, in the middle, at an end, and at the reset after it."""
    if task.startswith("dmc:"):
        pytest.importorskip("dm_control")
    envs = make(task, processes, **options)
    rng = np.random.default_rng(0)
    records, histories, actions = [envs.reset([8, 9])], [envs.histories()], []
    end = None
    while end is None or len(records) < end + 2 + AFTER:
        actions.append(3 * random_actions(envs.spaces, rng, COUNT))
        envs.start(actions[-1])
        assert envs.histories() is not None
        records.append(envs.finish())
        histories.append(envs.histories())
        if end is None and records[-1]["is_last"][0]:
            end = len(records) - 1
    for moment in (0, 3, end, end + 1):
        again = make(task, processes, **options)
        record = again.restore([saved(entry) for entry in histories[moment]])
        assert record is not None
        assert equal(record, records[moment]), moment
        for action, expected in zip(actions[moment:][:AFTER], records[moment + 1 :][:AFTER], strict=True):
            assert equal(again.step(action), expected), moment
        assert [entry.actions.tolist() for entry in again.histories()] == [
            entry.actions.tolist() for entry in histories[moment + AFTER]
        ]


def test_a_history_is_that_of_the_records_that_were_given(make: Make) -> None:
    envs = make("train_fakes:Counting")
    envs.reset([8, 9])
    envs.step(np.full((2, 2), 0.5, np.float32))
    envs.start(np.ones((2, 2), np.float32))
    assert [entry.actions.tolist() for entry in envs.histories()] == [[[0.5, 0.5]], [[0.5, 0.5]]], (
        "the last action has no record yet"
    )
    for _ in range(4):
        envs.finish()
        envs.start(np.zeros((2, 2), np.float32))
    assert [entry.to_json() for entry in envs.histories()] == [{"seed": 8, "episode": 1}, {"seed": 9, "episode": 1}]
    assert [entry.actions.shape for entry in envs.histories()] == [(0, 2), (0, 2)], (
        "what led to a reset is no action of the episode"
    )


@pytest.mark.covers("LOOP-26", "LOOP-32", "LOOP-34")
def test_restarts_before_and_after_a_restore_have_seeds_of_their_own(make: Make) -> None:
    failing = np.float32([[0, 0.25], [0, 0]])
    calm = np.zeros((2, 2), np.float32)
    envs = make("train_fakes:Fragile")
    envs.reset([8, 9])
    records = [envs.step(action) for action in (calm, failing, calm)]
    histories = envs.histories()
    again = make("train_fakes:Fragile")
    record = again.restore(histories)
    assert record is not None
    assert record["observation"][:, 1].tolist() == records[-1]["observation"][:, 1].tolist()
    assert again.failures == 0
    for action in (calm, failing, calm, calm):
        assert again.step(action)["observation"][:, 1].tolist() == envs.step(action)["observation"][:, 1].tolist()
    once = derive_seed(8, "restart", 0)
    assert [entry.seed for entry in histories] == [once, 9]
    assert [entry.seed for entry in again.histories()] == [derive_seed(once, "restart", 0), 9]


@pytest.mark.covers("LOOP-34")
def test_an_environment_that_is_not_deterministic_gives_another_record(make: Make) -> None:
    envs = make("train_fakes:Unrepeatable")
    first = envs.reset([8, 9])
    again = make("train_fakes:Unrepeatable")
    record = again.restore(envs.histories())
    assert record is not None
    assert not equal(record, first)


@pytest.mark.parametrize("processes", [False, True])
@pytest.mark.covers("LOOP-34")
def test_what_cannot_be_replayed_is_not_restored(make: Make, processes: bool) -> None:
    """Nothing of the attempt remains when the environments are reset after it."""
    envs = make("train_fakes:Fragile", processes)
    fresh = envs.reset([8, 9])
    fitting = envs.histories()
    action = np.float32([[0, 0.25]])  # It raises.
    for histories in (
        [fitting[0]],
        [fitting[0], None],
        [fitting[0], History(9, 0, action)],
        [fitting[0], History(9, 0, action[:, :1])],
    ):
        assert envs.restore(histories) is None
        record = envs.reset([8, 9])
        assert record["observation"][:, 1].tolist() == fresh["observation"][:, 1].tolist()
        assert record["is_first"].all()
    assert envs.failures == 0


def test_an_episode_that_ends_too_early_is_not_restored(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train_fakes.Shrinking, "made", 0)
    envs = make("train_fakes:Shrinking")
    envs.reset([8, 9])
    for _ in range(7):
        envs.step(np.zeros((2, 2), np.float32))
    assert make("train_fakes:Shrinking").restore(envs.histories()) is None


def test_an_episode_that_is_too_long_has_no_history(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history, "LONGEST", 3)
    envs = make("train_fakes:Counting")
    envs.reset([8, 9])
    kept = []
    for _ in range(6):
        envs.step(np.zeros((2, 2), np.float32))
        kept.append([entry and len(entry.actions) for entry in envs.histories()])
    assert kept == [[1, 1], [2, 2], [3, 3], [None, None], [0, 0], [1, 1]]
