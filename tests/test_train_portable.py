"""One checkpoint for both backends: evaluated on either, and trained on by one what the other began."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import train_fakes
from train_agents import random_learner_state, save_checkpoint
from train_runs import logged

import dreamer_spec.training.separate_evaluation
from conformance.adapters import jax_adapter, torch_adapter
from conformance.problems import Problem, random_batch, small_config, train_noise, with_sampling_margin
from dreamer_spec.backend import learner_class
from dreamer_spec.cli import main
from dreamer_spec.disk import checkpoint
from dreamer_spec.disk.checkpoint import open_checkpoint
from dreamer_spec.envs import Environments, make_env
from dreamer_spec.replay import Replay
from dreamer_spec.training.separate_evaluation import Evaluation
from reference_numpy import agent as reference
from reference_numpy.training_loop import derive_seed
from spec import Config, Discrete, Image, Spaces, Vector, parameter_table

CONFIG = small_config("paper", "float32", envs=2)
COUNTING = Spaces({"observation": Vector(2)}, {"action": Vector(2)})
CARTPOLE = Spaces({"observation": Vector(4)}, {"action": Discrete((2,))})
ARM = Spaces({"position": Vector(3), "mode": Discrete((3, 2))}, {"arm": Vector(2), "buttons": Discrete((2, 3))})
ROBOT = Spaces({"position": Vector(3), "image": Image(16, 16, 3)}, {"arm": Vector(2), "buttons": Discrete((2, 3))})


# train eval


@pytest.fixture
def counting(tmp_path: Path) -> str:
    """Episode n of `Counting` has five records and the return 40 n + 10, whatever the agent does."""
    task = "train_fakes:Counting"
    return str(
        save_checkpoint(
            tmp_path / "run", CONFIG, COUNTING, task=task, backend="torch", translation=make_env(task).translation
        )
    )


COUNT = ["--task", "train_fakes:Counting", "--episodes"]


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    capsys.readouterr()
    assert main(["eval", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.covers("LOOP-20")
def test_an_evaluation_says_returns_and_lengths(
    counting: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["eval", counting, *COUNT, "3", "--json", str(tmp_path / "result.json"), "--seed", "4"]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert first == f"{counting}: train_fakes:Counting, step 1,000; 3 episodes with torch on cpu, seed 4"
    assert second == "return 23.33 ± 13 (min 10, max 50), length 5 (min 5, max 5)"
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["returns"] == [10, 50, 10]
    assert result["lengths"] == [5, 5, 5]
    assert math.isclose(result["return_standard_error"], 40 / 3)
    named = {name: result[name] for name in ("task", "step", "trained_by", "backend", "device", "seed")}
    assert named == {
        "task": "train_fakes:Counting",
        "step": 1000,
        "trained_by": "torch",
        "backend": "torch",
        "device": "cpu",
        "seed": 4,
    }


def test_one_episode_has_no_standard_error() -> None:
    played = Evaluation((7.5,), (3,), Path(), "a:b", 0, "jax", "jax", "cpu", 0, False, {}, None)
    assert played.summary()["return_standard_error"] is None
    assert str(played) == "return 7.5 (min 7.5, max 7.5), length 3 (min 3, max 3)"


@pytest.mark.covers("LOOP-18")
@pytest.mark.parametrize(("trained_by", "backend"), [("jax", "torch"), ("torch", "jax")])
def test_either_backend_evaluates_what_the_other_trained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], trained_by: str, backend: str
) -> None:
    path = save_checkpoint(tmp_path / "run", CONFIG, CARTPOLE, task="gym:CartPole-v1", backend=trained_by)
    before = {file: file.read_bytes() for file in path.iterdir()}
    for name in ("a", "b"):
        assert (
            main(
                ["eval", str(tmp_path / "run"), "--backend", backend, "--episodes", "2", "--json", str(tmp_path / name)]
            )
            == 0
        )
    assert f"2 episodes with {backend} on " in capsys.readouterr().out
    one, again = (json.loads((tmp_path / name).read_text()) for name in ("a", "b"))
    assert one == again, "the same seed gives the same episodes"
    assert [length - 1 for length in one["lengths"]] == one["returns"], (
        "CartPole pays 1 for every step, and the reset is a record"
    )
    assert {file: file.read_bytes() for file in path.iterdir()} == before


@pytest.mark.covers("LOOP-24", "LOOP-26")
def test_seeds_are_not_those_of_the_runs_own_evaluations(counting: str, monkeypatch: pytest.MonkeyPatch) -> None:
    reset, given = Environments.reset, []

    def recorded(self: Environments, seeds: list[int]) -> Any:
        given.append(list(seeds))
        return reset(self, seeds)

    monkeypatch.setattr(Environments, "reset", recorded)
    assert main(["eval", counting, *COUNT, "2"]) == 0
    separate = derive_seed(0, "training.separate_evaluation", 0)
    assert given == [[derive_seed(separate, "evaluation_environment", worker) for worker in range(2)]]
    assert not {derive_seed(0, "evaluation_environment", index) for index in range(10_000)}.intersection(given[0])


def test_a_checkpoint_does_not_choose_which_code_runs(
    counting: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "if you trust it, add --task train_fakes:Counting" in refusal(capsys, counting, "--episodes", "1")
    path = save_checkpoint(tmp_path / "other", CONFIG, CARTPOLE, task="gym:some_module:CartPole-v1")
    assert "runs code of that module" in refusal(capsys, str(path), "--episodes", "1")


def test_what_cannot_be_evaluated_is_named(counting: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    message = refusal(capsys, counting, "--episodes", "1", "--task", "gym:CartPole-v1")
    assert "Discrete(classes=(2,))" in message
    assert "Vector(size=2)" in message
    assert "--episodes: '0' is not a whole number of at least 1" in refusal(capsys, counting, "--episodes", "0")
    assert "see train eval --help" in refusal(capsys, counting, "--nonsense")
    assert "no checkpoint in" in refusal(capsys, str(tmp_path / "nowhere"), "--episodes", "1")
    assert "no device 'tpu9'" in refusal(capsys, counting, *COUNT, "1", "--device", "tpu9").replace("unknown", "no")
    strange = save_checkpoint(tmp_path / "strange", CONFIG, COUNTING, task="train_fakes:Counting", backend="os")
    assert "unknown backend 'os'" in refusal(capsys, str(strange), *COUNT, "1")


def test_an_action_that_is_not_finite_ends_the_evaluation(
    counting: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        dreamer_spec.training.separate_evaluation.Agent, "__call__", lambda self, record: np.full((1, 2), np.nan)
    )
    assert "the action is not finite" in refusal(capsys, counting, *COUNT, "1")


def test_an_evaluation_shows_its_progress_and_what_failed(
    counting: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("dreamer_spec.monitoring.logger.PLAIN_EVERY", 0.0)
    monkeypatch.setattr("dreamer_spec.envs.trial.SLOW_STEP", math.inf)  # So it is in this process.
    step, calls = train_fakes.Counting.step, []

    def fails_once(self: train_fakes.Counting, action: np.ndarray) -> Any:
        calls.append(action)
        return 1 / 0 if len(calls) == 3 else step(self, action)

    monkeypatch.setattr(train_fakes.Counting, "step", fails_once)
    assert main(["eval", counting, *COUNT, "1"]) == 0
    out = capsys.readouterr().out
    assert "  0%  evaluation 0/1 episodes" in out
    assert "environment 0 failed and was restarted (error): " in out
    assert "length 5 (min 5, max 5)" in out


@pytest.mark.covers("LOOP-46")
def test_an_environment_that_cannot_be_made_ends_the_evaluation(
    counting: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["eval", counting, "--episodes", "1", "--task", "train_surroundings:Unmakeable"]) == 2
    *trace, line = capsys.readouterr().err.splitlines()
    words = (
        "task train_surroundings:Unmakeable, environment 0, when it was made: the environment raised "
        "SystemExit: 0 (3 attempts)"
    )
    assert line == f"train: error: {words}"
    assert trace[0].startswith("Traceback")
    assert "train_surroundings.py" in "".join(trace)


# One checkpoint for both backends


def through_a_file(directory: Path, state: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    checkpoint.save(directory, 0, state, {}, {}, keep=1)
    return open_checkpoint(directory).learner


@pytest.mark.covers("AGT-9", "AGT-10")
def test_a_state_that_changes_hands_keeps_every_bit(tmp_path: Path) -> None:
    given = state = random_learner_state(CONFIG, ROBOT)
    for backend in ("jax", "torch", "jax"):
        learner = learner_class(backend)(ROBOT, CONFIG, seed=9, device="cpu")
        learner.load_state_dict(through_a_file(tmp_path, state))
        state = learner.state_dict()
    assert set(state) == set(given)
    for name, array in given.items():
        assert state[name].dtype == array.dtype
        np.testing.assert_array_equal(state[name], array, err_msg=name)


def with_margin(state: dict[str, Any], seed: int, config: Config, spaces: Spaces) -> Problem:
    """A batch and noise at a state, so that float32 moves no sample into another class."""

    def draw(attempt: int) -> Problem:
        rng = np.random.default_rng([seed, attempt])
        return Problem(spaces, config, state, random_batch(rng, config, spaces), train_noise(rng, config, spaces))

    return with_sampling_margin(draw, 1e-4)


@pytest.mark.covers("AGT-9", "AGT-29", "AGT-30", "AGT-31")
def test_training_goes_on_in_the_other_backend(tmp_path: Path) -> None:
    """Six train steps, the same batches and the same noise: on JAX, on PyTorch, and passed on after every second step.
    The losses are the same within float32, and so is all of the training state after them."""
    backends = {
        "jax": jax_adapter.make_adapter("float32", "cpu"),
        "torch": torch_adapter.make_adapter("float32", "cpu"),
    }
    table = parameter_table(CONFIG, ARM)
    plans = {
        "stays on jax": ["jax"] * 6,
        "stays on torch": ["torch"] * 6,
        "changes": ["jax", "jax", "torch", "torch", "jax", "jax"],
    }
    states = dict.fromkeys(plans, random_learner_state(CONFIG, ARM))
    for step in range(6):
        problem = with_margin(reference.unflatten_state(states["changes"], table), step, CONFIG, ARM)
        losses = {}
        for plan, chosen in plans.items():
            before = reference.unflatten_state(through_a_file(tmp_path / plan, states[plan]), table)
            after, aux = backends[chosen[step]].train_step(before, problem.batch, problem.noise, ARM, CONFIG)
            states[plan], losses[plan] = reference.flatten_state(after), aux["losses"]
        _, aux = reference.losses(*problem.loss_arguments)
        for name, expected in aux["losses"].items():
            for plan in plans:
                np.testing.assert_allclose(
                    losses[plan][name], expected, rtol=1e-4, atol=1e-5, err_msg=f"{name}, step {step}, {plan}"
                )
    for plan in ("stays on jax", "stays on torch"):
        for name, array in states["changes"].items():
            np.testing.assert_allclose(
                array, states[plan][name], rtol=1e-3, atol=1e-4 * np.abs(array).max(), err_msg=f"{name}, {plan}"
            )
    assert states["changes"]["optimizer/step"] == 16


RUN = {
    **{"task": "gym:CartPole-v1", "size": "tiny", "deter": 32, "units": 16, "stoch": 4, "classes": 4, "bins": 31},
    **{"imagination-horizon": 5, "batch-size": 4, "batch-length": 8, "envs": 1, "replay-ratio": 16, "warmup-steps": 10},
    **{"learning-rate": 1e-3, "eval-episodes": 0, "random-episodes": 0, "log-every": 0, "compute-dtype": "float32"},
}


@pytest.mark.slow
def test_a_run_that_changes_the_backend_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """CartPole for 300 steps on JAX, 300 on PyTorch, 300 on JAX again. Generators differ, so the losses cannot be
    equal: they lie no further from those just before than these lie from each other. A learner that had started over
    would be far outside."""
    common = [f"--{name}={value}" for name, value in RUN.items()]
    for backend, steps in (("jax", 300), ("torch", 600), ("jax", 900)):
        assert main(["--backend", backend, f"--steps={steps}", f"--logdir={tmp_path}", "--no-preflight", *common]) == 0
    out = capsys.readouterr().out
    assert "which jax has trained so far" in out
    assert "which torch has trained so far" in out

    saved = open_checkpoint(tmp_path)
    counters = saved.info["counters"]
    assert (counters["records"], counters["policy_steps"]) == (900, 900)
    assert counters["train_steps"] == 1 + (900 - (4 * 8 + 8)) * 16 // (4 * 8) == 431
    assert saved.info["replay_ratio"] == {"step": 900, "credit": "0"}
    with_latents = {"deter_dtype": saved.info["identity"]["replay_deter"], "classes": 4}
    replay = Replay.restore(
        tmp_path / "replay", saved.info["replay"], saved.info["identity"]["replay_capacity"], 8, **with_latents
    )
    assert len(replay.state_dict()["records/reward"]) == 900

    lines = [line for line in logged(tmp_path) if "train/loss/total" in line]
    assert len(lines) == 431
    losses = {
        step: np.array([line["train/loss/total"] for line in lines if step < line["step"] <= step + 50])
        for step in (250, 300, 550, 600)
    }
    for before, after in ((losses[250], losses[300]), (losses[550], losses[600])):
        spread = before.max() - before.min()
        assert before.min() - spread < after[:12].mean() < before.max() + spread
    assert lines[0]["train/loss/total"] > 1.5 * losses[300].max(), "what a learner that started over would show"


@pytest.mark.parametrize(("name", "reason"), [("", "Is a directory"), ("no/result.json", "there is no folder")])
def test_a_result_that_cannot_be_written_is_refused_before_an_episode(
    counting: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    reason: str,
) -> None:
    monkeypatch.setattr(dreamer_spec.training.separate_evaluation, "play", pytest.fail)
    assert reason in refusal(capsys, counting, *COUNT, "1", "--json", str(tmp_path / name))
