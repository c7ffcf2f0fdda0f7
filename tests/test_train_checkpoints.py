"""Checkpoints of `train` with a learner that keeps a diary: what they carry over, and what survives an interruption."""

import dataclasses
import json
import shutil
import subprocess
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from train_fakes import EPISODE, FakeLearner
from train_runs import Make, logged, run_quietly, stored

from dreamer_spec.disk import checkpoint
from dreamer_spec.errors import UserError
from dreamer_spec.training import loop, setup
from dreamer_spec.training.resume import save
from reference_numpy.training_loop import derive_seed


@pytest.mark.covers("LOOP-24", "LOOP-25", "LOOP-26")
def test_seeds_are_those_of_the_chapter_and_go_on_after_a_resume(make: Make) -> None:
    FakeLearner.seeds.clear()
    options = make(steps=40, eval_every=20, eval_episodes=2, seed=7)
    loop.run(options, FakeLearner)
    resumed = run_quietly(dataclasses.replace(options, steps=80))
    seeds = FakeLearner.seeds
    assert [seed for kind, seed in seeds if kind == "parameters"] == [derive_seed(7, "parameters", 0)] * 2
    steps = resumed.counters.train_steps
    assert steps > 0
    assert [seed for kind, seed in seeds if kind == "train"] == [derive_seed(7, "train", step) for step in range(steps)]
    acting = [seed for kind, seed in seeds if kind == "policy"]
    training = [derive_seed(7, "policy", step) for step in range(resumed.counters.policy_steps)]
    assert [seed for seed in acting if seed in training] == training
    evaluating = [derive_seed(7, "evaluation", step) for step in range(resumed.counters.evaluation_steps)]
    assert [seed for seed in acting if seed not in training] == evaluating
    assert len(evaluating) == 3 * EPISODE


def test_a_resumed_run_meets_new_episodes(make: Make) -> None:
    """Where its environments are not restored, they have seeds of their own: they do not begin as those of the first
    start did."""
    options = make(task="gym:CartPole-v1", steps=40, replay_ratio=0, restore_envs=False)
    loop.run(options, FakeLearner)
    streams = stored(run_quietly(dataclasses.replace(options, steps=80)))
    starts = {tuple(stream["observation"][0].tolist()) for stream in streams}
    assert len(starts) == len(streams) == 4


@pytest.mark.covers("LOOP-21", "LOOP-23")
def test_a_run_whose_environments_are_restored_continues_exactly(
    make: Make, capsys: pytest.CaptureFixture[str]
) -> None:
    """Streams, latents (the fake's carry counts steps), episodes and their scores are those of a run in one go."""
    options = make(task="gym:CartPole-v1", steps=46)
    whole = run_quietly(dataclasses.replace(options, steps=92, logdir=options.logdir / "whole"))
    loop.run(options, FakeLearner)
    resumed = run_quietly(dataclasses.replace(options, steps=92))
    assert "continuing at step 46" in capsys.readouterr().out
    assert resumed.counters.starts == 1
    for stream, expected in zip(stored(resumed), stored(whole), strict=True):
        assert stream.keys() == expected.keys()
        assert [key for key in stream if stream[key].tobytes() != expected[key].tobytes()] == []
    assert list(resumed.returns) == list(whole.returns)
    assert resumed.envs.histories()[0].seed == derive_seed(0, "environment", 0)


def test_a_run_is_continued_before_its_first_sequence_is_complete(make: Make) -> None:
    """The buffer then has length 0, which is not the same as no buffer."""
    options = make(task="gym:CartPole-v1", steps=2)
    loop.run(options, FakeLearner)
    assert len(stored(run_quietly(dataclasses.replace(options, steps=30)))) == 2


def test_environments_that_lead_elsewhere_begin_anew(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    """`Counting` says how many episodes it has seen: in a new process, one."""
    loop.run(make(steps=46), FakeLearner)
    resumed = run_quietly(make(steps=92))
    assert "the environments are not deterministic" in capsys.readouterr().out
    assert resumed.counters.starts == 2
    assert len(stored(resumed)) == 4


def test_metrics_after_the_checkpoint_are_dropped_on_resume(make: Make) -> None:
    loop.run(make(), FakeLearner)
    path = make().logdir / "metrics.jsonl"
    kept = path.read_text()
    path.write_text(kept + json.dumps({"step": 70, "seconds": 1.0, "episode/return": -1.0}) + '\n{"step": 71, "sec')
    loop.run(make(steps=90), FakeLearner)
    lines = logged(path.parent)
    assert not any(line.get("episode/return") == -1.0 for line in lines)
    assert path.read_text().startswith(kept)
    assert lines[-1]["step"] == 90


def test_a_finished_run_says_its_result_again(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    options = make(eval_episodes=2, random_episodes=2)
    loop.run(options, FakeLearner)
    first = capsys.readouterr().out.splitlines()[-1]
    FakeLearner.diary.clear()
    assert loop.run(options, FakeLearner)
    assert capsys.readouterr().out.splitlines()[-1] == first
    assert FakeLearner.diary == []


def test_another_backend_may_continue(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    loop.run(make(), FakeLearner)
    loop.run(dataclasses.replace(make(steps=90), backend="torch"), FakeLearner)
    assert "which jax has trained so far" in capsys.readouterr().out


@pytest.mark.covers("LOOP-21")
def test_another_configuration_is_refused_with_all_differences(make: Make) -> None:
    loop.run(make(), FakeLearner)
    other = make(seed=1, bins=51, task="train_fakes:nan_observation")
    with pytest.raises(UserError) as error:
        loop.run(other, FakeLearner)
    assert all(
        words in str(error.value)
        for words in (
            "seed: 0 in the checkpoint, 1 given",
            "bins: 255 in the checkpoint, 51 given",
            "task: train_fakes:Counting in the checkpoint, train_fakes:nan_observation given",
        )
    )
    assert "batch_size" not in str(error.value)


def test_other_spaces_are_refused(make: Make) -> None:
    loop.run(make(), FakeLearner)
    saved = checkpoint.open_checkpoint(make().logdir)
    assert saved
    spaces = {
        "observations": {"observation": {"kind": "vector", "size": 3}},
        "actions": saved.info["spaces"]["actions"],
    }
    with pytest.raises(UserError, match=r'observations observation: {"kind": "vector", "size": 2} in the checkpoint'):
        checkpoint.require_same_spaces(saved, spaces)


@pytest.mark.parametrize("resume", ["never", "must"])
def test_resume_never_and_must(make: Make, resume: str) -> None:
    if resume == "never":
        loop.run(make(), FakeLearner)
    with pytest.raises(UserError, match=f"--resume is {resume}"):
        loop.run(make(resume=resume), FakeLearner)


def test_two_runs_do_not_share_a_log_directory(make: Make) -> None:
    with ExitStack() as stack:
        state = setup.prepare(make(), FakeLearner, stack)
        state.logger.write(1, 0.0, {"a": 1.0})
        written = (make().logdir / "metrics.jsonl").read_bytes()
        with pytest.raises(UserError, match="another process is training in"):
            loop.run(make(), FakeLearner)
        assert (make().logdir / "metrics.jsonl").read_bytes() == written
    assert loop.run(make(), FakeLearner)


@pytest.mark.covers("LOOP-22")
def test_a_checkpoint_is_complete_or_absent(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    loop.run(make(), FakeLearner)
    before = checkpoint.open_checkpoint(make().logdir)

    def fail(*_: Any) -> None:
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr("dreamer_spec.disk.folders.flush", fail)
        with pytest.raises(UserError, match="disk full"):
            loop.run(make(steps=90), FakeLearner)
    assert checkpoint.open_checkpoint(make().logdir) == before
    loop.run(make(steps=90), FakeLearner)
    assert sorted(path.name for path in (make().logdir / "checkpoints").iterdir()) == ["000000000060", "000000000090"]


def test_a_save_spares_what_is_not_ours(make: Make) -> None:
    directory = make().logdir / "checkpoints"
    (directory / "best").mkdir(parents=True)
    (directory / ".DS_Store").touch()
    loop.run(make(), FakeLearner)
    assert sorted(path.name for path in directory.iterdir()) == [".DS_Store", "000000000060", "best"]


@pytest.mark.covers("LOOP-22")
def test_a_step_that_is_saved_again_is_never_without_a_checkpoint(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    with ExitStack() as stack:
        state = setup.prepare(make(), FakeLearner, stack)
        loop.train(state)
        path = save(state)
        rename = Path.rename
        monkeypatch.setattr(Path, "rename", lambda self, target: 1 / 0 if target == path else rename(self, target))
        with pytest.raises(ZeroDivisionError):
            save(state)
    found = checkpoint.open_checkpoint(make().logdir)
    assert found
    assert found.path.name == f"{path.name}.old"
    assert found.info["replay"]


def test_what_a_killed_save_left_does_not_stop_the_next_one(make: Make) -> None:
    with ExitStack() as stack:
        state = setup.prepare(make(), FakeLearner, stack)
        loop.train(state)
        path = save(state)
        shutil.copytree(path, path.with_suffix(".old"))
        save(state)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def spoil(path: Path, damage: str) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content if damage == "a flipped bit" else content[:20])
    if damage == "missing":
        path.unlink()


@pytest.mark.parametrize("name", ["learner.safetensors", "loop.safetensors", "checkpoint.json", "SHA256SUMS"])
@pytest.mark.parametrize("damage", ["cut off", "a flipped bit", "missing"])
def test_a_damaged_checkpoint_falls_back_to_the_one_before(
    make: Make, name: str, damage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = run_quietly(make(steps=120, logdir=make().logdir / "whole"))
    loop.run(make(steps=60), FakeLearner)
    loop.run(make(steps=90), FakeLearner)
    newest = make().logdir / "checkpoints" / "000000000090"
    spoil(newest / name, damage)
    capsys.readouterr()
    resumed = run_quietly(make(steps=120))
    output = capsys.readouterr().out
    assert f"renamed to {newest}.damaged" in next(
        line for line in output.splitlines() if line.startswith("WARNING") and "damaged" in line
    )
    assert "continuing at step 60" in output
    assert (newest.parent / "000000000090.damaged").is_dir()
    assert (resumed.counters.records, resumed.counters.train_steps) == (120, whole.counters.train_steps)
    assert sum(len(stream["reward"]) for stream in stored(resumed)) == 120


@pytest.mark.covers("LOOP-53", "REP-37")
@pytest.mark.parametrize("which", ["newest", "all"])
@pytest.mark.parametrize("damage", ["cut off", "a flipped bit", "missing"])
def test_a_damaged_buffer_costs_no_checkpoint(
    make: Make, damage: str, which: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The newest state of the buffer that can be read is taken, or an empty one; parameters and counters are those of
    the checkpoint."""
    loop.run(make(steps=60), FakeLearner)
    loop.run(make(steps=90), FakeLearner)
    directory = make().logdir / "replay"
    states = sorted(directory.glob("saved-*"))
    for path in states if which == "all" else states[-1:]:
        spoil(path, damage)
    files = {path.name: path.read_bytes() for path in directory.iterdir()}
    trained = checkpoint.open_checkpoint(make().logdir).info["counters"]["train_steps"]
    capsys.readouterr()
    with ExitStack() as stack:
        resumed = setup.prepare(make(steps=120), FakeLearner, stack)
        loop.train(resumed)
        loop.finish(resumed)
        records = sum(len(stream["reward"]) for stream in stored(resumed))
    output = capsys.readouterr().out
    assert "continuing at step 90" in output
    assert any(str(states[-1]) in line for line in output.splitlines() if line.startswith("WARNING"))
    assert not list((make().logdir / "checkpoints").glob("*.damaged*"))
    assert resumed.counters.records == 120
    if which == "newest":
        assert records == 60 + 30
        assert resumed.counters.train_steps - trained == 30 * 32 // 6
    else:
        assert records == 30
        assert {path.name: path.read_bytes() for path in (directory / "damaged").iterdir()} == files
        assert 0 < resumed.counters.train_steps - trained < 30 * 32 // 6, (
            "steps until the buffer is filled again are not paid for"
        )
    loop.run(make(steps=150), FakeLearner)
    assert "replay" not in "".join(line for line in capsys.readouterr().out.splitlines() if "WARNING" in line)


def test_a_run_whose_checkpoints_are_all_damaged_does_not_begin_anew(make: Make) -> None:
    loop.run(make(), FakeLearner)
    (make().logdir / "checkpoints" / "000000000060" / "learner.safetensors").write_bytes(b"")
    for _ in range(2):
        with pytest.raises(UserError, match=r"damaged checkpoints only: .*000000000060.damaged"):
            loop.run(make(steps=90), FakeLearner)
    assert list((make().logdir / "replay").iterdir())


def test_a_checkpoint_of_another_format_is_refused(make: Make) -> None:
    loop.run(make(), FakeLearner)
    path = make().logdir / "checkpoints" / "000000000060" / "checkpoint.json"
    path.write_text(path.read_text().replace('"format": 4', '"format": 3'))
    with pytest.raises(UserError, match="format 3; this version reads format 4"):
        loop.run(make(steps=90), FakeLearner)


def test_the_newest_checkpoints_are_kept(make: Make) -> None:
    for steps in (20, 40, 60, 80):
        loop.run(make(steps=steps, keep_checkpoints=3), FakeLearner)
    names = sorted(path.name for path in (make().logdir / "checkpoints").iterdir())
    assert names == ["000000000040", "000000000060", "000000000080"]
    for name in names:
        path = make().logdir / "checkpoints" / name
        assert subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=path, check=False).returncode == 0
