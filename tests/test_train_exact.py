"""A run that was interrupted is, in everything that it was given and made, the run that was not: workers in the middle
of different episodes, a training state that forgets nothing, evaluations, metrics."""

from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
from fake_state import GROUPS, fresh_state, next_state
from train_fakes import FakeLearner
from train_paced import WORKERS, Recorder, paced, stop_after
from train_runs import BATCH_STEPS, Make, batches, logged, stored

from dreamer_spec.disk import checkpoint
from dreamer_spec.options import Options
from dreamer_spec.training import loop, schedule, setup

__all__ = ["paced"]
STEPS = 31 * WORKERS
OF_TIME = ("seconds", "speed/", "time/", "memory/")  # metrics that say how long something took

Story = dict[str, Any]


@pytest.fixture
def whole(paced: Make, monkeypatch: pytest.MonkeyPatch) -> Story:
    """What a run in one go leaves behind."""
    monkeypatch.setattr(schedule, "show_predictions", lambda *_: {})  # pictures take long
    return story(options(paced, "whole"), 1)


def options(paced: Make, name: str) -> Options:
    given = {"eval_every": 60, "eval_episodes": 4, "random_episodes": 2, "replay_ratio": 1.25 * BATCH_STEPS}
    return paced(steps=STEPS, log_every=1e9, logdir=paced().logdir / name, **given)


def story(options: Options, starts: int) -> Story:
    """Everything that so many starts of a run were given and made, but for the time that it took."""
    for kept in (Recorder.calls, FakeLearner.diary, FakeLearner.seeds):
        kept.clear()
    for start in range(starts):
        with ExitStack() as stack:
            run = setup.prepare(options, Recorder, stack)
            assert loop.train(run) == (start == starts - 1)
            if start == starts - 1:
                assert loop.finish(run)
    saved = checkpoint.open_checkpoint(options.logdir)
    assert saved
    assert saved.info["counters"]["records"] == STEPS
    names = ("replay_ratio", "returns", "evaluation", "random_return", "environments", "metrics", "counters")
    counters = {name: count for name, count in saved.info["counters"].items() if name != "seconds"}
    return {
        **{f"learner: {name}": array.tobytes() for name, array in saved.learner.items()},
        **{f"loop: {name}": array.tobytes() for name, array in saved.loop.items()},
        **{f"info: {name}": saved.info[name] for name in names} | {"info: counters": counters},
        "policy steps": [[np.asarray(part).tolist() for part in call] for call in Recorder.calls],
        "batches": [{name: array.tobytes() for name, array in batch.items()} for batch in batches()],
        "seeds": [seed for seed in FakeLearner.seeds if seed[0] != "parameters"],
        "streams": [{name: array.tobytes() for name, array in stream.items()} for stream in stored(run)],
        "metrics": [
            {name: value for name, value in line.items() if not name.startswith(OF_TIME)}
            for line in logged(options.logdir)
        ],
    }


def differences(one: Story, other: Story) -> list[str]:
    assert one.keys() == other.keys()
    return [name for name in one if one[name] != other[name]]


@pytest.mark.covers("LOOP-21", "LOOP-23")
@pytest.mark.parametrize("stops", [(2,), (7,), (13,), (20,), (8, 24)])
def test_an_interrupted_run_is_the_run_that_was_not(
    paced: Make, whole: Story, monkeypatch: pytest.MonkeyPatch, stops: tuple[int, ...]
) -> None:
    """stops: policy steps. After 2 nothing can be trained yet, after 20 an evaluation is due."""
    stop_after(monkeypatch, *stops)
    assert differences(story(options(paced, "parts"), len(stops) + 1), whole) == []


@pytest.mark.parametrize("group", GROUPS)
def test_what_a_resume_loses_of_the_training_state_shows(
    paced: Make, whole: Story, monkeypatch: pytest.MonkeyPatch, group: str
) -> None:
    """So the test above can fail. Every group is lost in its turn."""
    load = FakeLearner.load_state_dict

    def load_without(self: FakeLearner, state: dict[str, np.ndarray]) -> None:
        load(self, {**state, **{name: array for name, array in fresh_state().items() if name.startswith(group)}})

    stop_after(monkeypatch, 13)
    monkeypatch.setattr(FakeLearner, "load_state_dict", load_without)
    found = differences(story(options(paced, "parts"), 2), whole)
    assert {"learner: params/w", "streams", "policy steps"} <= set(found)


def test_every_part_of_a_fake_state_matters() -> None:
    """So that a run shows the loss of any of them, however long after."""
    batch, state = {"reward": np.arange(3.0)}, fresh_state()
    for seed in range(5):
        state = next_state(state, batch, seed)
    assert all(array.all() and not np.array_equal(array, fresh_state()[name]) for name, array in state.items())
    expected = next_state(state, batch, 5)
    for group in GROUPS:
        lost = {**state, **{name: array for name, array in fresh_state().items() if name.startswith(group)}}
        after = next_state(lost, batch, 5)
        assert not np.array_equal(after["params/w"], expected["params/w"]), group
        assert not np.array_equal(after["slow_critic/w"], expected["slow_critic/w"]), group
    for other in (next_state(state, {"reward": np.float64([0, 1, 2 + 1e-9])}, 5), next_state(state, batch, 6)):
        assert not np.array_equal(other["params/w"], expected["params/w"])
