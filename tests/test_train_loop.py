"""The loop of `train` with a learner that keeps a diary: what is stored, when it trains, what a checkpoint carries
over."""

from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
from train_fakes import EPISODE, FakeLearner
from train_runs import BATCH_STEPS, Make, batches, logged, run_quietly, stored

from dreamer_spec.disk import checkpoint
from dreamer_spec.disk.incidents import load_incident, newest_incident
from dreamer_spec.envs import Environments, make_env
from dreamer_spec.errors import UserError
from dreamer_spec.training import evaluation, loop, setup
from reference_numpy.training_loop import derive_seed

# What is stored


@pytest.mark.covers("LOOP-2", "LOOP-3", "LOOP-6", "LOOP-7", "LOOP-9", "LOOP-10", "LOOP-11", "CON-9", "CON-10", "CON-11")
def test_streams_hold_every_observation_with_what_arrived_with_it(make: Make) -> None:
    state = run_quietly(make(replay_ratio=0))
    streams = stored(state)
    assert len(streams) == 2
    for worker, stream in enumerate(streams):
        assert len(stream["reward"]) == 30
        episode, time = np.divmod(np.arange(30), EPISODE + 1)
        assert stream["observation"].tolist() == np.stack([episode, time], axis=1).tolist()
        assert stream["reward"].tolist() == np.where(time == 0, 0, 10 * episode + time).tolist()
        assert stream["is_first"].tolist() == (time == 0).tolist()
        assert stream["is_last"].tolist() == (time == EPISODE).tolist()
        assert stream["is_terminal"].tolist() == ((time == EPISODE) & (episode % 2 == 0)).tolist()
        # The latents that the policy step made for this observation: its row's steps since the reset, the seed of the
        # call.
        seeds = [derive_seed(0, "policy", call) for call in range(30)]
        assert stream["deter"][:, 0].tolist() == time.tolist()
        assert stream["deter"][:, 1].tolist() == np.float32(seeds).tolist()
        expected = [
            3 * evaluation.random_actions(state.envs.spaces, np.random.default_rng(seed), 2)[worker] for seed in seeds
        ]
        assert stream["action"].tolist() == np.where((time == EPISODE)[:, None], 0, expected).tolist(), (
            "raw, and zeros at the end"
        )
    assert np.abs(streams[0]["action"]).max() > 1, "the test needs actions that would be clipped"


# When it trains


@pytest.mark.covers("LOOP-1", "LOOP-4")
def test_training_runs_between_the_records_of_the_workers(make: Make) -> None:
    """One policy step for all, then record by record as many train steps as are due: acting sees them all."""
    with ExitStack() as stack:
        state = setup.prepare(make(envs=3, steps=24, replay_ratio=BATCH_STEPS), FakeLearner, stack)
        add = state.replay.add_packed

        def note(packed: Any, row: int, worker: int) -> None:
            FakeLearner.diary.append((str(worker), None))
            add(packed, row, worker)

        state.replay.add_packed = note  # type: ignore[method-assign]
        loop.train(state)
    order = "".join(kind[0] for kind, _ in FakeLearner.diary)
    assert order == 4 * "p012" + "p012t" + 3 * "p0t1t2t"


# Evaluation


@pytest.mark.covers("LOOP-18")
def test_evaluation_plays_whole_episodes_and_changes_nothing(make: Make) -> None:
    def play(**given: Any) -> tuple[Any, list[dict[str, float]]]:
        state = run_quietly(make(**given))
        return state, logged(given["logdir"])

    root = make().logdir
    state, lines = play(logdir=root / "a", eval_every=20, eval_episodes=3)
    plain, _ = play(logdir=root / "b")
    evaluations = [line for line in lines if "evaluation/return" in line]
    assert [line["step"] for line in evaluations] == [20, 40]
    # Workers 0 and 1 play their first episode, worker 0 its second: 1+2+3+4, the same, 11+12+13+14; then episodes go on
    # counting.
    assert evaluations[0]["evaluation/return"] == pytest.approx((10 + 10 + 50) / 3)
    assert evaluations[0]["evaluation/return_max"] == 50
    assert state.counters.records == plain.counters.records
    assert state.counters.policy_steps == plain.counters.policy_steps
    assert [stream["reward"].tolist() for stream in stored(state)] == [
        stream["reward"].tolist() for stream in stored(plain)
    ]


def test_episodes_that_do_not_end_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation, "LONGEST_EPISODE", 50)
    envs = Environments(lambda index: make_env("train_fakes:Endless"), 1, False)
    with pytest.raises(UserError, match="time limit"):
        evaluation.play_randomly(envs, 1, 0)


# Logs


@pytest.mark.covers("LOOP-20")
def test_metrics_curve_and_last_words(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    options = make(eval_episodes=2, random_episodes=2)
    assert loop.run(options, FakeLearner)
    lines = logged(options.logdir)
    episodes = [line for line in lines if "episode/return" in line]
    assert [line["episode/return"] for line in episodes] == [10, 10, 50, 50, 90, 90, 130, 130, 170, 170, 210, 210]
    assert {line["episode/length"] for line in episodes} == {5}
    assert any(line.get("train/loss/total") == 1.0 for line in lines)
    assert [line["step"] for line in lines] == sorted(line["step"] for line in lines)
    assert (options.logdir / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert list(options.logdir.glob("events.out.tfevents.*"))
    assert capsys.readouterr().out.splitlines()[-1] == "return 50 ± 0, random 10 ± 0, ratio 5 ± 0 after 257 train steps"


def test_a_line_holds_the_means_since_the_line_before(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    train_step = FakeLearner.train_step

    def numbered(self: FakeLearner, *arguments: Any) -> Any:
        monkeypatch.setattr(FakeLearner, "loss", float(len(batches())))
        return train_step(self, *arguments)

    monkeypatch.setattr(FakeLearner, "train_step", numbered)
    options = make(log_every=0.0, replay_ratio=BATCH_STEPS * 2)
    run_quietly(options)
    means = [line["train/loss/total"] for line in logged(options.logdir) if "train/loss/total" in line]
    assert len(means) > 10
    first = 0.0
    for mean in means:  # of the losses first, first + 1, ... up to the next line's
        following = 2 * mean - first + 1
        assert following > first
        first = following
    assert first == len(batches())


@pytest.mark.parametrize(("episodes", "error"), [(3, 40 / 3), (1, None)])
def test_the_standard_error_of_an_evaluation(make: Make, episodes: int, error: float | None) -> None:
    """Returns 10, 50 and 10: their sample's standard deviation is 40 / √3. One return has none."""
    options = make(eval_episodes=episodes)
    assert loop.run(options, FakeLearner)
    (line,) = [line for line in logged(options.logdir) if "evaluation/return" in line]
    assert line.get("evaluation/return_standard_error") == (error and pytest.approx(error))


def test_a_loss_that_is_not_finite_stops_the_run_and_spares_the_checkpoint(make: Make) -> None:
    options = make(steps=30)
    loop.run(options, FakeLearner)
    before = checkpoint.open_checkpoint(options.logdir)
    FakeLearner.loss = float("nan")
    with pytest.raises(UserError, match=r"not finite: loss/total.*train inspect"):
        loop.run(make(steps=60), FakeLearner)
    assert checkpoint.open_checkpoint(options.logdir) == before
    incident = load_incident(newest_incident(options.logdir))
    met = batches()[incident.info["train_step"]]
    assert incident.batch.keys() == met.keys()
    assert all((incident.batch[key] == met[key]).all() for key in met)


@pytest.mark.covers("LOOP-42", "LOOP-43")
def test_by_option_a_step_that_is_not_finite_is_skipped(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    train_step = FakeLearner.train_step

    def sometimes(self: FakeLearner, *arguments: Any) -> Any:
        FakeLearner.loss = float("nan") if len(batches()) % 3 == 2 else 2.0
        return train_step(self, *arguments)

    monkeypatch.setattr(FakeLearner, "train_step", sometimes)
    options = make(nonfinite="skip", log_every=1e9)
    assert loop.run(options, FakeLearner)
    (line,) = [line for line in logged(options.logdir) if "train/skipped" in line]
    steps = len(batches())
    assert line["train/skipped"] == pytest.approx((steps // 3) / steps)
    assert line["train/loss/total"] == 2.0


def test_evaluation_refuses_an_action_that_is_not_finite(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dreamer_spec.training.evaluation.Agent.__call__", lambda self, record: np.full((2, 2), np.nan))
    with pytest.raises(UserError, match="diverged: the policy's action"):
        loop.run(make(eval_episodes=2), FakeLearner)


def test_a_gradient_that_is_not_finite_is_not_saved(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    train_step = FakeLearner.train_step

    def overflow(self: FakeLearner, *arguments: Any) -> Any:
        metrics, latents = train_step(self, *arguments)
        return {**metrics, "gradient_norm": np.float32(np.inf), "skipped": np.float32(1)}, latents

    monkeypatch.setattr(FakeLearner, "train_step", overflow)
    options = make(log_every=1e9)
    with pytest.raises(UserError, match="not finite: gradient_norm"):
        loop.run(options, FakeLearner)
    assert not checkpoint.candidates(options.logdir)
