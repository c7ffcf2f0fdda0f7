"""Runs that go on: with the options of their start, with changed ones, or as a new run with the parameters of
another."""

import json
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from train_agents import plain_translation, random_learner_state
from train_fakes import FakeLearner
from train_runs import Make, batches, run_quietly

import dreamer_spec.training.setup
from dreamer_spec.cli import main
from dreamer_spec.disk import checkpoint
from dreamer_spec.disk.about import read_about, write_about
from dreamer_spec.errors import UserError
from dreamer_spec.options import Options, assemble_options, may_change
from dreamer_spec.training import loop
from impl_torch.learner import Learner as TorchLearner
from spec import Discrete, Spaces, Vector, hyperparameters, load_config

SPACES = Spaces({"observation": Vector(4)}, {"action": Discrete((2,))})
SMALL = [
    "--deter=8",
    "--units=4",
    "--stoch=2",
    "--classes=2",
    "--batch-size=2",
    "--batch-length=3",
    "--envs=2",
    "--no-preflight",
]
SHORT = ["--steps=60", "--eval-every=0", "--eval-episodes=1", "--random-episodes=1"]


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(dreamer_spec.training.setup, "learner_class", lambda backend: FakeLearner)
    monkeypatch.chdir(tmp_path)
    FakeLearner.diary.clear()


def starts(logdir: Path) -> list[dict[str, Any]]:
    about = read_about(logdir)
    assert about
    return about["starts"]


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    capsys.readouterr()
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


# What may change half way


OTHER: dict[type, Any] = {bool: lambda value: not value, list: lambda value: value[1:]}
OTHER |= {int: lambda value: value + 1, float: lambda value: value / 2 + 1e-3}


@pytest.mark.covers("LOOP-70")
@pytest.mark.parametrize("name", sorted(hyperparameters()))
def test_a_hyperparameter_either_changes_half_way_or_is_refused_by_name(name: str, tmp_path: Path) -> None:
    """All of them: what shapes, batches, environments and the stored data depend on must stay."""
    entry = hyperparameters()[name]
    saved = Options("jax", "a:b", load_config("paper", "tiny"), tmp_path, 60).identity()
    if "choices" in entry:
        other = next(choice for choice in entry["choices"] if choice != saved[name])
    else:
        other = OTHER[type(saved[name])](saved[name])
    info, given = {"identity": json.loads(json.dumps(saved))}, saved | {name: other}
    changed = entry["group"] in ("world_model", "behavior", "optimizer") or name == "replay_ratio"
    assert (name in may_change()) is changed
    if changed:
        checkpoint.require_same_identity(checkpoint.Checkpoint(tmp_path, info, sealed=None), given)
    else:
        with pytest.raises(UserError, match=f"{name}: .* may not change half way"):
            checkpoint.require_same_identity(checkpoint.Checkpoint(tmp_path, info, sealed=None), given)


@pytest.mark.covers("LOOP-70")
def test_changed_options_are_used_said_and_recorded(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    loop.run(make(), FakeLearner)
    options = make(steps=90, learning_rate=1e-3, replay_ratio=0.5, eval_every=30, checkpoint_every=0.0)
    before = len(batches())
    loop.run(options, FakeLearner)
    said = (
        "changed from here on: steps 60 -> 90; eval_every 0 -> 30; checkpoint_every 300.0 -> 0.0; "
        "learning_rate 4e-05 -> 0.001; replay_ratio 32.0 -> 0.5"
    )
    assert said in capsys.readouterr().out.splitlines()
    assert len(batches()) - before == 2  # 30 records x 0.5 / 6, and what the ratio before still owed
    first, second = starts(options.logdir)
    assert (first["changed"], second["step"]) == ({}, 60)
    assert second["changed"] == {
        "steps": [60, 90],
        "eval_every": [0, 30],
        "checkpoint_every": [300.0, 0.0],
        "learning_rate": [4e-05, 1e-3],
        "replay_ratio": [32.0, 0.5],
    }
    assert checkpoint.open_checkpoint(options.logdir).info["identity"]["learning_rate"] == 1e-3
    loop.run(options, FakeLearner)
    assert starts(options.logdir)[-1]["changed"] == {}


def test_a_change_is_told_against_the_checkpoint(make: Make) -> None:
    """Not against a start that came to nothing: run.json knows it, no parameter does."""
    loop.run(make(), FakeLearner)
    options = make(learning_rate=1e-3)
    write_about(options, spaces=SPACES, device="cpu", parameters=1, preflight=None, resumed_at=60)
    loop.run(options, FakeLearner)
    assert starts(options.logdir)[-1]["changed"] == {"learning_rate": [4e-05, 1e-3]}


@pytest.mark.parametrize("steps", [60, 10])
def test_steps_that_have_been_made_are_said(make: Make, capsys: pytest.CaptureFixture[str], steps: int) -> None:
    loop.run(make(), FakeLearner)
    saved = (make().logdir / "checkpoints" / "000000000060").stat().st_mtime_ns
    capsys.readouterr()
    assert loop.run(make(steps=steps), FakeLearner)
    out = capsys.readouterr().out
    assert f"the run is at step 60 and --steps is {steps}: nothing is left to train; a larger --steps goes on" in out
    assert "next:" in out
    assert "--steps 120" in out
    assert (make().logdir / "checkpoints" / "000000000060").stat().st_mtime_ns >= saved


# train resume


@pytest.mark.usefixtures("fakes")
def test_resume_takes_every_option_from_the_run(capsys: pytest.CaptureFixture[str]) -> None:
    command = [
        "--backend=jax",
        "--size=tiny",
        *SMALL,
        *SHORT,
        "--task=train_fakes:Counting",
        "--logdir=runs/a b",
        "--learning-rate=1e-3",
    ]
    assert main([*command, "--action-repeat=2", "--keep-checkpoints=3", "--seed=4"]) == 0
    before = read_about(Path("runs/a b"))
    assert main(["resume", "runs/a b", "--task", "train_fakes:Counting", "--steps=90", "--entropy_scale=1e-3"]) == 0
    out = capsys.readouterr().out
    assert "continuing at step 60 from runs/a b/checkpoints/000000000060" in out
    assert "changed from here on: steps 60 -> 90; entropy_scale 0.0003 -> 0.001" in out
    after = read_about(Path("runs/a b"))
    assert before
    assert after
    assert (after["id"], len(after["starts"])) == (before["id"], 2)
    assert after["options"] == before["options"] | {"steps": 90, "resume": "must"}
    assert after["hyperparameters"] == before["hyperparameters"] | {"entropy_scale": 1e-3}
    assert main(["resume", "runs/a b", "--task", "train_fakes:Counting"]) == 0
    assert read_about(Path("runs/a b"))["hyperparameters"]["entropy_scale"] == 1e-3


@pytest.mark.usefixtures("fakes")
def test_a_run_that_was_moved_goes_on_where_it_is() -> None:
    assert main(["--backend=jax", "--size=tiny", *SMALL, *SHORT, "--task=gym:CartPole-v1"]) == 0
    Path("runs/CartPole-v1-jax-seed0").rename("elsewhere")
    assert main(["resume", "elsewhere", "--steps=70"]) == 0
    assert not Path("runs/CartPole-v1-jax-seed0").exists()
    assert [start["step"] for start in starts(Path("elsewhere"))] == [0, 60]


@pytest.mark.usefixtures("fakes")
def test_what_cannot_be_resumed_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--backend=jax", "--size=tiny", *SMALL, *SHORT, "--task=train_fakes:Counting", "--logdir=run"])
    task = ["--task", "train_fakes:Counting"]
    assert "--task train_fakes:Counting" in refusal(capsys, "resume", "run")
    assert "batch_size: 2 in the checkpoint, 8 given. These may not change" in refusal(
        capsys, "resume", "run", *task, "--batch-size=8"
    )
    assert "task: train_fakes:Counting in the checkpoint" in refusal(
        capsys, "resume", "run", "--task", "train_fakes:Endless"
    )
    assert "seed: 0 in the checkpoint, 3 given" in refusal(capsys, "resume", "run", *task, "--seed=3")
    for name in ("--preset", "--logdir", "--from", "--seeds", "--resume"):  # with these a run begins
        assert f"unknown option {name}" in refusal(capsys, "resume", "run", *task, name, "1")
    assert "continued from its log directory, run" in refusal(capsys, "resume", "run/checkpoints/000000000060", *task)
    assert "nowhere has no run.json" in refusal(capsys, "resume", "nowhere")
    assert "unknown option --step; did you mean --steps?" in refusal(capsys, "resume", "run", "--step=7")
    assert "the following arguments are required: RUN" in refusal(capsys, "resume")
    for path in Path("run/checkpoints").iterdir():
        path.rename(f"run/{path.name}")
    line = refusal(capsys, "resume", "run", *task)
    assert (
        "run holds no checkpoint, so there is nothing to continue; the command that begins it: train --backend jax"
        in line
    )


@pytest.mark.usefixtures("fakes")
@pytest.mark.parametrize(
    "command", ["", "train --help", "train 'open", "rm -rf /", "train --backend jax --size giant", "train report a", 7]
)
def test_a_forged_command_runs_nothing(capsys: pytest.CaptureFixture[str], command: str | int) -> None:
    main(["--backend=jax", "--size=tiny", *SMALL, *SHORT, "--task=gym:CartPole-v1", "--logdir=run"])
    about = read_about(Path("run"))
    assert about
    Path("run/run.json").write_text(json.dumps(about | {"command": command}))
    assert "run" in refusal(capsys, "resume", "run")


@pytest.mark.usefixtures("fakes")
def test_a_forged_command_names_no_code_and_no_other_place(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    main(["--backend=jax", "--size=tiny", *SMALL, *SHORT, "--task=gym:CartPole-v1", "--logdir=run"])
    about = read_about(Path("run"))
    assert about
    (tmp_path / "evil.py").write_text("raise SystemExit('code of somebody else')")
    for task in ("evil:make", "gym:evil:Env-v0"):
        words = [*shlex.split(about["command"]), "--task", task, "--logdir", "other"]
        Path("run/run.json").write_text(json.dumps(about | {"command": shlex.join(words)}))
        assert f"if you trust it, add --task {task}" in refusal(capsys, "resume", "run")
    assert not Path("other").exists()


# A new run with the parameters of another


def agent_checkpoint(logdir: Path, config: Any, spaces: Spaces = SPACES, **changes: Any) -> Path:
    options = Options(backend="jax", config=config, logdir=logdir, steps=1000, task="gym:CartPole-v1")
    counters = {"records": 1000, "policy_steps": 9, "train_steps": 7}
    given = {"spaces": spaces.to_json(), "translation": plain_translation(spaces).to_json()}
    info = {"identity": options.identity(), **given, "backend": "jax", "counters": counters}
    return checkpoint.save(logdir, 1000, random_learner_state(config, spaces) | changes, {}, info, keep=2)


def tiny(tmp_path: Path, **given: Any) -> Options:
    overrides = {
        "deter": 8,
        "units": 4,
        "stoch": 2,
        "classes": 2,
        "batch_size": 2,
        "batch_length": 3,
        "envs": 2,
        "blocks": 2,
        "bins": 5,
    }
    plain = {
        "task": "gym:CartPole-v1",
        "size": "tiny",
        "steps": 60,
        "logdir": tmp_path / "new",
        "preflight": False,
        "device": "cpu",
    }
    settings = {**plain, "eval_every": 0, "eval_episodes": 0, "random_episodes": 0, **given}
    return assemble_options(
        "torch",
        settings,
        overrides | {name: settings.pop(name) for name in list(settings) if name in hyperparameters()},
    )


@pytest.mark.covers("LOOP-72")
@pytest.mark.parametrize("source", ["old", "old/checkpoints/000000001000"])
def test_a_new_run_begins_with_the_parameters_of_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], source: str
) -> None:
    """Parameters, slow critic and return range, bit for bit; a fresh optimizer, fresh counters, and another learning
    rate if wanted."""
    options = tiny(tmp_path, from_=tmp_path / source, learning_rate=1e-3)
    config = tiny(tmp_path).config
    agent_checkpoint(tmp_path / "old", config)
    saved = checkpoint.open_checkpoint(tmp_path / "old").learner
    begun: dict[str, np.ndarray] = {}
    policy = TorchLearner.policy

    def spy(learner: TorchLearner, *arguments: Any, **named: Any) -> Any:
        begun.update(() if begun else learner.state_dict())
        return policy(learner, *arguments, **named)

    monkeypatch.setattr(TorchLearner, "policy", spy)
    assert loop.run(options)
    for name, array in saved.items():
        if name.startswith("optimizer/"):
            assert not np.any(begun[name]), name
        else:
            np.testing.assert_array_equal(begun[name], array, err_msg=name)
    out = capsys.readouterr().out
    assert (
        f"beginning with the parameters of {tmp_path}/old/checkpoints/000000001000 (gym:CartPole-v1, step 1,000)" in out
    )
    about = read_about(options.logdir)
    assert about
    assert about["origin"] == {
        "from": str(tmp_path / source),
        "checkpoint": str(tmp_path / "old/checkpoints/000000001000"),
        "task": "gym:CartPole-v1",
        "step": 1000,
        "backend": "jax",
        "train_steps": 7,
    }
    # It goes on by itself, whether --from is given again or not, and wherever the other run is now.
    (tmp_path / "old").rename(tmp_path / "away")
    for given in ({"from_": tmp_path / source}, {}):
        state = run_to_the_end(tiny(tmp_path, learning_rate=1e-3, **given))
        assert state["optimizer/step"] > 0
        again = read_about(options.logdir)
        assert again
        assert again["origin"] == about["origin"]
    with pytest.raises(
        UserError, match=f"which began with the parameters of {tmp_path}/{source}, and --from is for a new run"
    ):
        loop.run(tiny(tmp_path, from_=tmp_path / "away", learning_rate=1e-3))


def run_to_the_end(options: Options) -> dict[str, np.ndarray]:
    assert loop.run(options)
    return checkpoint.open_checkpoint(options.logdir).learner


@pytest.mark.covers("LOOP-72")
def test_what_does_not_fit_is_named_and_nothing_is_begun(tmp_path: Path) -> None:
    options = tiny(tmp_path, from_=tmp_path / "old")

    def message() -> str:
        with pytest.raises(UserError) as error:
            loop.run(options)
        assert not options.logdir.exists()
        return str(error.value)

    assert "no checkpoint in" in message()
    agent_checkpoint(tmp_path / "old", options.config, Spaces({"observation": Vector(5)}, {"action": Discrete((2,))}))
    assert (
        'observations observation: {"kind": "vector", "size": 5} in the checkpoint, {"kind": "vector", "size": 4} given'
        in message()
    )
    agent_checkpoint(tmp_path / "old", tiny(tmp_path, units=8).config)
    assert re.search(r"has other parameters: \S+: .* in the checkpoint, .* given; .* and \d+ more", message())
    config = options.config
    agent_checkpoint(tmp_path / "old", config, **{"return_range/low": np.float32(np.nan)})
    assert "return_range/low is missing or not as it should be" in message()
    state = checkpoint.open_checkpoint(tmp_path / "old").learner
    name = next(name for name in state if name.startswith("slow_critic/"))
    agent_checkpoint(tmp_path / "old", config, **{name: np.zeros(7, np.float32)})
    assert f"{name} is missing or not as it should be" in message()
    name = next(name for name in state if name.startswith("params/critic/"))
    agent_checkpoint(tmp_path / "old", config, **{name: np.full_like(state[name], np.inf)})
    assert "numbers that are not finite" in message()


def test_from_is_for_a_run_that_has_not_begun(make: Make) -> None:
    run_quietly(make(checkpoint_every=0.0))
    with pytest.raises(UserError, match="which began with parameters of its own, and --from is for a new run"):
        loop.run(make(from_=Path("other")), FakeLearner)
