"""Ctrl-C and what else ends a run: in training, in an evaluation, and in the last one."""

import dataclasses
import os
import signal
from typing import Any

import pytest
from train_fakes import FakeLearner
from train_runs import Make, batches, logged

from dreamer_spec.disk import checkpoint
from dreamer_spec.training import loop


def test_the_first_interrupt_saves(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    policy = FakeLearner.policy

    def interrupt(self: FakeLearner, *arguments: Any) -> Any:
        if sum(kind == "policy" for kind, _ in FakeLearner.diary) == 20:
            os.kill(os.getpid(), signal.SIGINT)
        return policy(self, *arguments)

    handler = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(FakeLearner, "policy", interrupt)
    assert not loop.run(make(), FakeLearner)
    saved = checkpoint.open_checkpoint(make().logdir)
    assert saved
    assert saved.info["counters"]["records"] == 42
    assert signal.getsignal(signal.SIGINT) is handler


@pytest.mark.covers("LOOP-23")
@pytest.mark.parametrize("policy_step", [9, 11], ids=["in the step before", "in its second step"])
def test_an_evaluation_that_was_interrupted_is_made_up_for(
    make: Make, monkeypatch: pytest.MonkeyPatch, policy_step: int
) -> None:
    """Evaluation is due at step 20, after 10 policy steps. Metrics are then those of a run in one go."""
    options = make(task="gym:CartPole-v1", eval_every=20, eval_episodes=4)
    whole = dataclasses.replace(options, logdir=options.logdir / "whole")
    loop.run(whole, FakeLearner)
    FakeLearner.diary.clear()
    policy = FakeLearner.policy

    def interrupt(self: FakeLearner, *arguments: Any) -> Any:
        if sum(kind == "policy" for kind, _ in FakeLearner.diary) == policy_step:
            os.kill(os.getpid(), signal.SIGINT)
        return policy(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(FakeLearner, "policy", interrupt)
        assert not loop.run(options, FakeLearner)
    saved = checkpoint.open_checkpoint(options.logdir)
    assert saved.info["counters"]["records"] == 20
    assert (saved.info["counters"]["evaluations"], saved.info["evaluation"]) == (0, None)
    assert not any("evaluation/return" in line for line in logged(options.logdir))
    assert loop.run(options, FakeLearner)
    lines, expected = (
        [
            {
                name: value
                for name, value in line.items()
                if name != "seconds" and not name.startswith(("speed/", "time/", "memory/"))
            }
            for line in logged(logdir)
        ]
        for logdir in (options.logdir, whole.logdir)
    )
    assert [line["step"] for line in expected if "evaluation/return" in line] == [20, 40, 60]
    assert lines == expected


def test_what_ends_the_last_evaluation_does_not_cost_the_training(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> list[float]:
        raise KeyboardInterrupt

    options = make(eval_episodes=2)
    with monkeypatch.context() as patch:
        patch.setattr("dreamer_spec.training.schedule.evaluate", fail)
        with pytest.raises(KeyboardInterrupt):
            loop.run(options, FakeLearner)
    saved = checkpoint.open_checkpoint(options.logdir)
    assert saved
    assert saved.info["counters"]["records"] == 60
    FakeLearner.diary.clear()
    assert loop.run(options, FakeLearner)
    assert batches() == []
    assert any("evaluation/return" in line for line in logged(options.logdir))
