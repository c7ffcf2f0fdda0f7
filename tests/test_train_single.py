"""Runs with a single environment: training between its episodes, and evaluation in the only instance that there is."""

import functools
from contextlib import ExitStack
from typing import Any, ClassVar

import numpy as np
import pytest
import train_fakes
from train_fakes import FakeLearner
from train_runs import Make, batches, logged, run_quietly, stored

from dreamer_spec.envs import Environments, make_env
from dreamer_spec.errors import UserError
from dreamer_spec.training import loop, setup

RATIO = 3.0


class Watched(train_fakes.Maze):
    """Writes into the learner's diary when it is reset and stepped; only one may be open at a time."""

    open: ClassVar[int] = 0

    def __init__(self) -> None:
        super().__init__()
        type(self).open += 1
        assert self.open == 1, "there is one licence"

    def reset(self, **given: Any) -> Any:
        FakeLearner.diary.append(("reset", None))
        return super().reset(**given)

    def step(self, action: Any) -> Any:
        FakeLearner.diary.append(("step", None))
        return super().step(action)

    def close(self) -> None:
        type(self).open -= 1


@pytest.fixture(autouse=True)
def closed() -> Any:
    Watched.open = 0
    yield
    assert Watched.open == 0


@pytest.fixture
def single(make: Make) -> Make:
    return functools.partial(
        make, task="test_train_single:Watched", envs=1, image_size=16, replay_ratio=RATIO, steps=150, processes="no"
    )


def events() -> str:
    """r reset, p policy, s step, t train"""
    return "".join(kind[0] for kind, _ in FakeLearner.diary)


def expected_total(make: Make) -> int:
    FakeLearner.diary.clear()
    total = run_quietly(make()).counters.train_steps
    FakeLearner.diary.clear()
    return total


# Training between episodes


@pytest.mark.covers("LOOP-65")
def test_train_steps_wait_for_the_end_of_the_episode_and_none_is_lost(single: Make) -> None:
    total = expected_total(single)
    state = run_quietly(single(train_when="between-episodes"))
    assert state.counters.train_steps == len(batches()) == total > 10
    assert state.counters.due == 0
    episodes = events().split("r")[1:]
    assert len(episodes) > 5
    for episode in episodes[:-1]:
        played, _, rest = episode.partition("t")
        assert set(played) <= {"p", "s"}, "nothing is trained while the episode goes on"
        assert rest.strip("t") in ("", "p"), (
            "all of it at the end, before the last record is stored and before the reset"
        )
    assert sum("t" in episode for episode in episodes) > 2


@pytest.mark.covers("LOOP-21", "LOOP-23", "LOOP-65")
@pytest.mark.parametrize("stop_at", [4, 9, 15, 30])
def test_a_run_that_is_interrupted_among_train_steps_that_are_due_goes_on_with_the_rest(
    single: Make, stop_at: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    run_quietly(single(train_when="between-episodes"))
    whole, records = batches(), None
    FakeLearner.diary.clear()
    learn = loop.learn

    def learn_and_stop(run: Any) -> None:
        learn(run)
        if run.counters.train_steps == stop_at:
            run.signals.append(2)

    monkeypatch.setattr(loop, "learn", learn_and_stop)
    options = single(train_when="between-episodes", logdir=tmp_path / "other")
    assert not loop.run(options, FakeLearner)
    with ExitStack() as stack:
        state = setup.prepare(options, FakeLearner, stack)
        assert state.counters.train_steps == stop_at
        loop.train(state)
        (records,) = stored(state)
    again = batches()
    assert len(again) == len(whole)
    for one, other in zip(whole, again, strict=True):
        assert all(one[key].tobytes() == other[key].tobytes() for key in one)
    assert len(records["reward"]) == 150


def test_what_is_due_is_paid_when_the_option_is_given_up(single: Make) -> None:
    """A checkpoint with train steps that wait, continued by a run that trains always."""
    total = expected_total(functools.partial(single, steps=160))
    with ExitStack() as stack:
        state = setup.prepare(single(train_when="between-episodes", steps=160), FakeLearner, stack)
        while not state.counters.due:
            loop.act(state)
            state.record = state.envs.finish()
        loop.resume.save(state)
    state = run_quietly(single(steps=160))
    assert (state.counters.train_steps, state.counters.due) == (total, 0)


# Evaluation in the only environment


EVALUATED = {"eval_every": 40, "eval_episodes": 2, "random_episodes": 2}


@pytest.mark.covers("LOOP-18", "LOOP-66")
@pytest.mark.parametrize("train_when", ["always", "between-episodes"])
def test_training_is_the_same_as_with_an_environment_of_its_own_for_evaluation(
    make: Make, train_when: str, tmp_path: Any
) -> None:
    single = functools.partial(
        make,
        task="train_fakes:Maze",
        envs=1,
        image_size=16,
        replay_ratio=RATIO,
        steps=150,
        train_when=train_when,
        **EVALUATED,
    )
    streams, trained, evaluations = {}, {}, {}
    for where in ("own", "shared"):
        FakeLearner.diary.clear()
        state = run_quietly(single(eval_env=where, logdir=tmp_path / where))
        streams[where], trained[where] = stored(state), batches()
        evaluations[where] = [line["step"] for line in logged(tmp_path / where) if "evaluation/return" in line]
    for one, other in (
        *zip(streams["own"], streams["shared"], strict=True),
        *zip(trained["own"], trained["shared"], strict=True),
    ):
        assert all(one[key].tobytes() == other[key].tobytes() for key in one)
    (stream,) = streams["shared"]
    ends = np.flatnonzero(stream["is_last"]) + 1
    assert len(evaluations["shared"]) == len(evaluations["own"]) == 3
    for early, late in zip(evaluations["own"], evaluations["shared"], strict=True):
        assert late in ends, "at the end of a training episode"
        assert early <= late <= early + 14, "the first that comes"
    assert stream["is_first"].tolist() == [True, *stream["is_last"][:-1]]


@pytest.mark.covers("LOOP-66")
def test_there_is_never_a_second_instance_and_training_begins_its_episodes_itself(single: Make) -> None:
    options = single(eval_env="shared", **EVALUATED)
    loop.run(options, FakeLearner)
    lines = logged(options.logdir)
    assert sum("evaluation/return" in line for line in lines) == 4
    assert lines[0]["random/return"]


@pytest.mark.covers("LOOP-23", "LOOP-66")
def test_a_run_goes_on_exactly_after_its_last_evaluation(
    make: Make, tmp_path: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    single = functools.partial(
        make, task="train_fakes:Maze", envs=1, image_size=16, replay_ratio=RATIO, eval_env="shared", **EVALUATED
    )
    (whole,) = stored(run_quietly(single(steps=150, logdir=tmp_path / "whole")))
    loop.run(single(steps=75, logdir=tmp_path / "parts"), FakeLearner)
    (parts,) = stored(run_quietly(single(steps=150, logdir=tmp_path / "parts")))
    assert "cannot be restored" not in capsys.readouterr().out
    assert all(
        whole[key].tobytes() == parts[key].tobytes() for key in ("reward", "is_first", "is_last", "action", "view")
    )


def test_lent_environments_come_back_as_they_were() -> None:
    envs = Environments(functools.partial(make_env, "train_fakes:Maze", image_size=16), 1, False)
    other = Environments(functools.partial(make_env, "train_fakes:Maze", image_size=16), 1, False)
    action = np.zeros((1, envs.spaces.action_size), np.float32)
    record = envs.reset([5])
    assert other.reset([5])["view"].tobytes() == record["view"].tobytes()
    while not record["is_last"][0]:
        record, same = envs.step(action), other.step(action)
    before = envs.histories()
    with envs.lend():
        envs.reset([99])
        for _ in range(30):
            envs.step(action + 1)
    (kept,), (was,) = envs.histories(), before
    assert kept is not None
    assert was is not None
    assert (kept.seed, kept.episode, kept.actions.tobytes()) == (was.seed, was.episode, was.actions.tobytes())
    for _ in range(40):
        record, same = envs.next_episodes() if record["is_last"][0] else envs.step(action), other.step(action)
        assert {key: value.tobytes() for key, value in record.items()} == {
            key: value.tobytes() for key, value in same.items()
        }


@pytest.mark.parametrize(("option", "value"), [("train_when", "between-episodes"), ("eval_env", "shared")])
def test_several_environments_are_refused_with_the_remedy(make: Make, option: str, value: str) -> None:
    with pytest.raises(UserError, match=rf"--{option.replace('_', '-')} {value} .*this run has 2; add --envs 1"):
        loop.run(make(**{option: value}), FakeLearner)
