"""Workers whose episodes end at different times, record by record: what the policy was given, what replay stored, what
the environments received."""

import itertools
from typing import Any

import numpy as np
import pytest
from train_fakes import FakeLearner
from train_paced import LENGTHS, WORKERS, Call, Moment, Paced, Recorder, moments, paced, reward, stop_after
from train_runs import BATCH_STEPS, SMALL, Make, batches, logged, run_quietly, stored

from dreamer_spec.training import loop, schedule
from reference_numpy.training_loop import derive_seed

__all__ = ["paced"]
CALLS = 61  # after 60 records all workers are reset together
STEPS = CALLS * WORKERS


def expected_moments(count: int, failed: int | None = None) -> list[list[Moment]]:
    """Of each record of each worker. failed: the record of worker 1 that is missing because its environment failed."""
    return [
        list(itertools.islice(moments(worker, seed, failed if worker == 1 else None), count))
        for worker, seed in enumerate(derive_seed(0, "environment", worker) for worker in range(WORKERS))
    ]


def policy_calls(purpose: str = "policy") -> list[Call]:
    """Those of training, or those of evaluation."""
    seeds = {derive_seed(0, purpose, number) for number in range(1000)}
    return [call for call in Recorder.calls if call.seed in seeds]


def assert_given(calls: list[Call], expected: list[list[Moment]]) -> None:
    """Every row of every policy step: the observation of its worker, its own reset, its own carry."""
    for number, call in enumerate(calls):
        before = calls[number - 1] if number else None
        for worker in range(WORKERS):
            now = expected[worker][number]
            where = f"policy step {number}, worker {worker}"
            led_here = before.action[worker].clip(-1, 1) if before and now.time else np.zeros(2)
            assert call.observation[worker].tolist() == [worker, *now, *led_here.tolist()], where
            assert call.is_first[worker] == (now.time == 0), where
            assert call.carry[worker].tolist() == (before.deter[worker].tolist() if before else [0] * 8), where
            assert call.deter[worker, 0] == now.time, f"{where}: steps since its reset"


# What is given and stored


@pytest.mark.parametrize("failed", [None, 6, 7], ids=["none fails", "one fails at another's reset", "one fails alone"])
@pytest.mark.covers("LOOP-2", "LOOP-3", "LOOP-7", "LOOP-8", "LOOP-9", "LOOP-10", "LOOP-29", "LOOP-32", "CON-12")
def test_every_worker_has_its_own_resets_carry_and_stream(paced: Make, failed: int | None) -> None:
    """failed: the record of worker 1 in whose place a new environment's reset comes."""
    if failed is not None:
        Paced.fails[1] = failed - failed // LENGTHS[1]  # resets are no steps
    state = run_quietly(paced(replay_ratio=0, steps=STEPS), Recorder)
    assert state.envs.failures == (failed is not None)
    expected = expected_moments(CALLS, failed)
    calls = policy_calls()
    assert len(calls) == len(Recorder.calls) == CALLS
    assert_given(calls, expected)
    for worker, stream in enumerate(stored(state)):
        code, time = np.array(expected[worker]).T
        last = time == LENGTHS[worker] - 1
        assert stream["observation"].tolist() == [call.observation[worker].tolist() for call in calls]
        assert stream["deter"].tolist() == [call.deter[worker].tolist() for call in calls]
        action = [call.action[worker] for call in calls]
        assert stream["action"].tolist() == np.where(last[:, None], 0, action).tolist()
        assert stream["reward"].tolist() == np.where(time == 0, 0, reward(code, time)).tolist()
        assert stream["is_first"].tolist() == (time == 0).tolist()
        assert stream["is_last"].tolist() == last.tolist()
        assert stream["is_terminal"].tolist() == (last & (code % 2 == 0)).tolist()
        assert 0 < stream["is_terminal"].sum() < last.sum(), "the test needs ends of both kinds"


@pytest.mark.covers("LOOP-1", "LOOP-3", "LOOP-4", "LOOP-13", "LOOP-14")
@pytest.mark.parametrize("stop", [None, 23])
def test_every_action_is_that_of_the_newest_parameters(
    paced: Make, monkeypatch: pytest.MonkeyPatch, stop: int | None
) -> None:
    """Each says how many updates were made before it. stop: the policy step after which the run is interrupted."""
    options = paced(replay_ratio=1.75 * BATCH_STEPS, steps=STEPS)  # one or two train steps after each record
    if stop is not None:
        stop_after(monkeypatch, stop)
        assert not loop.run(options, Recorder)
    state = run_quietly(options, Recorder)
    first = WORKERS * (SMALL["batch_length"] + 1) + BATCH_STEPS - WORKERS  # the record that fills the buffer
    due = [1 + int((records - first) * 1.75) if records >= first else 0 for records in range(0, STEPS, WORKERS)]
    assert due[-1] > 200
    assert [call.action[:, 1].tolist() for call in policy_calls()] == [[updates] * WORKERS for updates in due]
    for worker, stream in enumerate(stored(state)):
        last = np.array([time == LENGTHS[worker] - 1 for _, time in expected_moments(CALLS)[worker]])
        assert stream["action"][:, 1].tolist() == np.where(last, 0, due).tolist()
    assert_given(policy_calls(), expected_moments(CALLS))


# What is written back


@pytest.mark.covers("LOOP-17", "LOOP-43")
@pytest.mark.parametrize("ratio", [0.5, 1, 5])
def test_latents_are_written_back_to_the_records_that_they_belong_to(paced: Make, ratio: float) -> None:
    """Each record has the latents of the last train step that saw it, or those with which it was stored."""
    state = run_quietly(paced(replay_ratio=ratio * BATCH_STEPS, steps=STEPS), Recorder)
    trained: dict[tuple[float, ...], int] = {}
    for update, batch in enumerate(batches(), 1):
        trained |= {tuple(row[:3]): update for row in batch["observation"].reshape(-1, 5).tolist()}
    assert len(trained) > STEPS * min(ratio, 1) / 3
    for worker, stream in enumerate(stored(state)):
        for number, (observed, latents) in enumerate(zip(stream["observation"], stream["deter"], strict=True)):
            update = trained.get(tuple(observed[:3].tolist()))
            time = int(observed[2])
            assert latents[0] == (time if update is None else 1000 + update), (worker, number)
            assert latents[1:6].tolist() == observed.tolist()
            stored_action, before = stream["action"][number], stream["action"][number - 1] * (time > 0)
            if update is not None:
                assert latents[6:].tolist() == before.tolist(), "the action before it"
            elif not stream["is_last"][number]:
                assert latents[6:].tolist() == stored_action.tolist()


# How often it trains


@pytest.mark.covers("LOOP-5", "LOOP-14")
@pytest.mark.parametrize("repeat", [1, 2, 4])
def test_the_replay_ratio_counts_records_and_not_frames(make: Make, repeat: int) -> None:
    state = run_quietly(make(replay_ratio=BATCH_STEPS, action_repeat=repeat, steps=60 * repeat, envs=1))
    assert (state.step, state.counters.records) == (60 * repeat, 60)
    assert state.counters.train_steps == len(batches()) == 1 + 60 - (BATCH_STEPS + SMALL["batch_length"])


# Evaluation

EVALUATED = {"eval_episodes": 7, "replay_ratio": BATCH_STEPS, "steps": STEPS}


@pytest.mark.covers("LOOP-18", "LOOP-19", "LOOP-20", "LOOP-26")
def test_evaluation_has_its_own_carry_environments_and_seeds(paced: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schedule, "show_predictions", lambda *_: {})  # pictures take long
    options = paced(eval_every=30, **EVALUATED)
    state = run_quietly(options, Recorder)
    assert not any(call.mode for call in Recorder.calls), "actions are sampled, in training and in evaluation"
    assert len(policy_calls()) == CALLS
    assert_given(policy_calls(), expected_moments(CALLS))
    calls = policy_calls("evaluation")
    assert [call.seed for call in calls] == [derive_seed(0, "evaluation", number) for number in range(len(calls))]
    scores = []
    begins = [number for number, call in enumerate(calls) if call.is_first.all()]
    for evaluation, (begin, end) in enumerate(itertools.pairwise([*begins, len(calls)])):
        seeds = [derive_seed(0, "evaluation_environment", WORKERS * evaluation + worker) for worker in range(WORKERS)]
        played = [list(itertools.islice(moments(*pair), end - begin)) for pair in enumerate(seeds)]
        assert_given(calls[begin:end], played)
        returns = [
            sum(reward(*moment) for moment in episode[1:])
            for worker, share in enumerate((3, 2, 2))  # of seven episodes
            for length in [LENGTHS[worker]]
            for episode in [
                list(itertools.islice(moments(worker, seeds[worker]), share * length))[first : first + length]
                for first in range(0, share * length, length)
            ]
        ]
        scores.append(np.mean(returns))
    lines = [line for line in logged(options.logdir) if "evaluation/return" in line]
    assert [line["step"] for line in lines] == [30, 60, 90, 120, 150, 180]
    assert [line["evaluation/return"] for line in lines] == pytest.approx(scores)
    updates = [call.action[0, 1] for call in calls if call.is_first.all()]
    assert updates == [max(0, line["step"] - (BATCH_STEPS + WORKERS * SMALL["batch_length"]) + 1) for line in lines]
    assert state.counters.evaluation_steps == len(calls)


@pytest.mark.covers("LOOP-18")
def test_a_run_with_evaluations_is_the_run_without_them(paced: Make) -> None:
    """All that training is given and makes, bit for bit; the training state tells batches and seeds apart."""
    runs: list[Any] = []
    for given in ({"eval_episodes": 0}, {"eval_every": 90, "random_episodes": 2}):
        Recorder.calls.clear()
        FakeLearner.diary.clear()
        options = paced(**{**EVALUATED, **given, "logdir": paced().logdir / str(len(runs))})
        state = run_quietly(options, Recorder)
        counters = {name: count for name, count in vars(state.counters).items() if name != "seconds"}
        counters |= {"evaluations": 0, "evaluation_steps": 0}
        calls = [[np.array(part).tolist() for part in call] for call in policy_calls()]
        episodes = [line for line in logged(options.logdir) if "episode/return" in line]
        lines = [{name: value for name, value in line.items() if name != "seconds"} for line in episodes]
        learned = {name: array.tobytes() for name, array in state.learner.state_dict().items()}
        streams = [{name: array.tobytes() for name, array in stream.items()} for stream in stored(state)]
        runs.append((counters, calls, lines, learned, streams))
    for one, other in zip(*runs, strict=True):
        assert one == other


@pytest.mark.covers("LOOP-20")
def test_episodes_are_scored_worker_by_worker(paced: Make) -> None:
    options = paced(replay_ratio=0, steps=STEPS)
    run_quietly(options, Recorder)
    expected = [
        (sum(reward(*moment) for moment in played[number - length + 2 : number + 1]), length)
        for number in range(CALLS)
        for played, length in zip(expected_moments(CALLS), LENGTHS, strict=True)
        if played[number].time == length - 1
    ]
    lines = [line for line in logged(options.logdir) if "episode/return" in line]
    assert [(line["episode/return"], line["episode/length"]) for line in lines] == expected
