"""The last lines of a run and of several seeds: results with their uncertainty, and what to do next."""

import math
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from train_fakes import FakeLearner
from train_runs import SMALL, Make, logged

import dreamer_spec.training.setup
from dreamer_spec.cli import main, parse, parse_runs
from dreamer_spec.disk.checkpoint import candidates, open_checkpoint
from dreamer_spec.errors import UserError
from dreamer_spec.monitoring import outcome
from dreamer_spec.monitoring.outcome import Mean, Outcome, first_train_step, last_words, mean_of, read_outcome, summary
from dreamer_spec.training import loop

FAST = [
    "--backend=jax",
    "--size=tiny",
    "--no-preflight",
    "--steps=60",
    "--eval-every=0",
    "--eval-episodes=2",
    "--random-episodes=2",
]
FAST += [f"--{name.replace('_', '-')}={value}" for name, value in SMALL.items()]


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(dreamer_spec.training.setup, "learner_class", lambda backend: FakeLearner)
    monkeypatch.chdir(tmp_path)


# Uncertainty


def test_the_error_of_a_ratio_is_that_of_many_ratios() -> None:
    """Drawn again and again, means scatter as the propagated error says."""
    rng = np.random.default_rng(0)
    scores, randoms = rng.normal(80, 30, (4000, 20)), rng.normal(20, 8, (4000, 20))
    found = [
        Outcome(mean_of(list(score)), mean_of(list(random))).ratio
        for score, random in zip(scores, randoms, strict=True)
    ]
    ratios = np.array([ratio.value for ratio in found if ratio])
    errors = np.array([ratio.error for ratio in found if ratio and ratio.error is not None])
    assert len(ratios) == len(errors) == 4000
    assert np.mean(errors) == pytest.approx(np.std(ratios), rel=0.05)


@pytest.mark.parametrize(
    ("result", "words"),
    [
        (
            Outcome(Mean(187.3, 4.23), Mean(22.1, 1.3)),
            "return 187.3 ± 4.2, random 22.1 ± 1.3, ratio 8.475 ± 0.53 after 1,226 train steps",
        ),
        (Outcome(Mean(50, None), Mean(10, None)), "return 50, random 10, ratio 5 after 1,226 train steps"),
        (Outcome(Mean(50, None), None), "return 50 after 1,226 train steps"),
        (
            Outcome(Mean(5, 0.5), Mean(0.3, 0.2)),
            "return 5 ± 0.5, random 0.3 ± 0.2 after 1,226 train steps",
        ),  # may be 0 as well
        (Outcome(Mean(-5, 0.5), Mean(-9, 0.2)), "return -5 ± 0.5, random -9 ± 0.2 after 1,226 train steps"),
        (Outcome(None, Mean(9, 1)), "no episode has ended yet after 1,226 train steps"),
    ],
)
def test_last_words(result: Outcome, words: str) -> None:
    assert last_words(result, 1226) == words


def test_the_outcome_is_that_of_the_newest_evaluation_or_of_the_last_episodes(make: Make) -> None:
    options = make(eval_episodes=3, random_episodes=3, eval_every=30)
    loop.run(options, FakeLearner)
    last = [line for line in logged(options.logdir) if "evaluation/return" in line][-1]
    found = read_outcome(options.logdir)
    assert found.score == Mean(last["evaluation/return"], last["evaluation/return_standard_error"])
    assert found.random
    assert found.random.error is not None
    without = make(logdir=options.logdir.with_name("other"))
    loop.run(without, FakeLearner)
    returns = [line["episode/return"] for line in logged(without.logdir) if "episode/return" in line]
    assert read_outcome(without.logdir) == Outcome(mean_of(returns[-20:]), None)


# A run that does not train


@pytest.mark.covers("LOOP-13")
@pytest.mark.parametrize(("envs", "batch_length", "action_repeat"), [(1, 3, 1), (2, 3, 1), (3, 2, 2), (4, 5, 1)])
def test_the_first_train_step_is_where_it_is_said_to_be(
    make: Make, envs: int, batch_length: int, action_repeat: int
) -> None:
    """One step of the environments less, and there is none."""
    given = {"envs": envs, "batch_length": batch_length, "action_repeat": action_repeat, "task": "train_fakes:Endless"}
    first = first_train_step(make(**given))
    rounds = math.ceil(first / action_repeat / envs)
    for count, trains in ((rounds, True), (rounds - 1, False)):
        options = make(**given, steps=count * envs * action_repeat, logdir=Path(make().logdir.parent / str(count)))
        loop.run(options, FakeLearner)
        assert (open_checkpoint(options.logdir).info["counters"]["train_steps"] > 0) is trains


def test_a_run_without_train_steps_says_so_and_why(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    loop.run(make(steps=8, eval_episodes=2, random_episodes=2), FakeLearner)
    lines = capsys.readouterr().out.splitlines()
    why = (
        "training starts at step 12, when the buffer holds batch_size x batch_length = 6 sequences, and "
        "--steps is 8: raise --steps, or"
    )
    (before,) = [
        number for number, line in enumerate(lines) if line.startswith(f"WARNING: no train step will be made: {why}")
    ]
    (after,) = [
        number
        for number, line in enumerate(lines)
        if line.startswith(f"WARNING: no train step was made, the agent is as it began: {why}")
    ]
    assert before < after
    assert lines[-1].endswith("after 0 train steps")
    loop.run(make(steps=20), FakeLearner)
    assert "WARNING: no train step" not in capsys.readouterr().out


def test_a_replay_ratio_of_0_is_why(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    loop.run(make(replay_ratio=0.0), FakeLearner)
    out = capsys.readouterr().out
    assert "WARNING: no train step was made, the agent is as it began: --replay-ratio is 0" in out
    assert "will be made" not in out


# What to do next


def test_the_commands_that_are_named_run_as_they_are_printed(tmp_path: Path) -> None:
    """From the shell, with the program and the paths of the lines."""
    words = [
        "train",
        "--backend",
        "torch",
        "--size",
        "tiny",
        "--steps",
        "900",
        "--envs",
        "2",
        "--batch-size",
        "4",
        "--batch-length",
        "8",
    ]
    words += [
        "--task",
        "gym:CartPole-v1",
        "--logdir",
        "runs/my run",
        "--eval-episodes",
        "2",
        "--random-episodes",
        "2",
        "--replay-ratio",
        "1",
    ]
    command = [str(Path(sys.executable).with_name("train")), *words[1:], "--no-preflight", "--device", "cpu"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    first = next(number for number, line in enumerate(lines) if line.startswith("next: "))
    commands = [line[6:] for line in lines[first:-1]]
    assert [shlex.split(line)[1] for line in commands] == ["report", "eval", "export", "resume"]
    for line in commands:
        short = line.replace("--episodes 100", "--episodes 2").replace("--steps 1800", "--steps 910")
        subprocess.run(short, shell=True, cwd=tmp_path, capture_output=True, check=True)
    assert open_checkpoint(tmp_path / "runs/my run").info["counters"]["records"] == 910
    assert (tmp_path / "report.html").exists()
    assert (tmp_path / "policy" / "policy.json").exists()


def test_the_program_is_named_as_the_shell_finds_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = tmp_path / "train"
    program.touch(mode=0o755)
    monkeypatch.setattr(sys, "argv", [str(program)])
    monkeypatch.setenv("PATH", "/nowhere")
    assert outcome.program() == str(program)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert outcome.program() == "train"
    monkeypatch.setattr(sys, "argv", ["/somewhere/dreamer_spec/__main__.py"])
    assert outcome.program() == f"{sys.executable} -m dreamer_spec"


# Several seeds


@pytest.mark.parametrize(
    ("text", "seeds"),
    [("0-4", [0, 1, 2, 3, 4]), ("0,2,5", [0, 2, 5]), ("7", [7]), ("3,0-1", [3, 0, 1]), ("0, 1", [0, 1])],
)
def test_lists_of_seeds(text: str, seeds: list[int]) -> None:
    runs = parse_runs(["--backend", "torch", "--seeds", text])
    assert [options.seed for options in runs] == seeds
    assert [str(options.logdir) for options in runs] == [f"runs/CartPole-v1-torch-seed{seed}" for seed in seeds]
    assert [options.logdir for options in parse_runs(["--backend", "torch", "--seeds", text, "--logdir", "a"])] == [
        Path(f"a/seed{seed}") for seed in seeds
    ]


@pytest.mark.parametrize("text", ["4-0", "a", "", "1,,2", "-1", "1-", "0-5000", "1,1", "0-3,2", "1.5"])
def test_what_is_no_list_of_seeds_is_refused(text: str) -> None:
    with pytest.raises(UserError, match=r"--seeds.*is not a list of different seeds such as 0-4"):
        parse_runs(["--backend", "torch", f"--seeds={text}"])
    with pytest.raises(UserError, match="one of them is enough"):
        parse_runs(["--backend", "torch", "--seeds", "0-1", "--seed", "3"])


@pytest.mark.covers("LOOP-73")
@pytest.mark.usefixtures("fakes")
def test_each_seed_is_the_run_that_it_would_be_alone(capsys: pytest.CaptureFixture[str]) -> None:
    command = [*FAST, "--task=gym:CartPole-v1", "--log-every=0", "--processes=no"]
    assert main([*command, "--seeds", "0-2", "--logdir", "all"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert main([*command, "--seed", "1", "--logdir", "alone"]) == 0
    one, alone = (open_checkpoint(Path(name)) for name in ("all/seed1", "alone"))
    assert one.info["counters"] | {"seconds": 0} == alone.info["counters"] | {"seconds": 0}
    for arrays, others in ((one.loop, alone.loop), (one.learner, alone.learner)):
        assert arrays.keys() == others.keys()
        for name, array in arrays.items():
            np.testing.assert_array_equal(array, others[name])
    results = [read_outcome(Path(f"all/seed{seed}")) for seed in range(3)]
    assert [line for line in out if line.startswith("seed ")] == [
        *(f"seed {seed} ({seed + 1} of 3)" for seed in range(3)),
        *(f"seed {seed}: {last_words(results[seed], None)}; all/seed{seed}" for seed in range(3)),
    ]
    assert out[-1] == summary(dict(enumerate(results)))


def test_the_spread_is_over_seeds() -> None:
    results = {seed: Outcome(Mean(value, 0.5), Mean(2.0, 0.1)) for seed, value in enumerate((10, 20, 30))}
    assert summary(results) == "3 seeds: return 20 ± 5.8 (standard deviation 10, min 10, max 30), random 2 ± 0"
    assert summary({4: Outcome(Mean(10, 0.5), None)}) == "1 seed: return 10 (min 10, max 10)"
    assert summary({4: Outcome(None, None)}) == "1 seed: no episode has ended yet"


@pytest.mark.usefixtures("fakes")
def test_seeds_go_on_where_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    """The second command continues what there is, with more steps, and begins what there is not."""
    assert main([*FAST, "--task=train_fakes:Counting", "--seeds", "0,1"]) == 0
    capsys.readouterr()
    assert main([*FAST, "--task=train_fakes:Counting", "--seeds", "0-2", "--steps", "90"]) == 0
    out = capsys.readouterr().out
    assert out.count("continuing at step 60 from") == 2
    for seed in range(3):
        assert open_checkpoint(Path(f"runs/train_fakes-Counting-jax-seed{seed}")).info["counters"]["records"] == 90


@pytest.mark.usefixtures("fakes")
@pytest.mark.parametrize("error", [UserError("the disk\nis full", "details"), RuntimeError("out of memory")])
def test_one_seed_that_fails_does_not_lose_the_others(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    run = loop.run

    def fail_with_seed_1(options: object) -> bool:
        done = run(options)
        if options.seed == 1:
            raise error
        return done

    monkeypatch.setattr(loop, "run", fail_with_seed_1)
    assert main([*FAST, "--task=train_fakes:Counting", "--seeds", "0-2"]) == 2
    captured = capsys.readouterr()
    assert "seed 1 failed; runs/train_fakes-Counting-jax-seed1" in captured.out.splitlines()
    assert captured.out.splitlines()[-1].startswith("2 seeds: return ")
    assert (
        "train: error: seed 1: the disk is full" if isinstance(error, UserError) else "RuntimeError: out of memory"
    ) in captured.err
    assert len(candidates(Path("runs/train_fakes-Counting-jax-seed2"))) > 0


@pytest.mark.usefixtures("fakes")
def test_what_would_keep_every_seed_from_beginning_ends_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*FAST, "--task=gym:NoSuchGame-v0", "--seeds", "0-4"]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("train: error: ") == 1
    assert "seed 1 (2 of 5)" not in captured.out
    assert not Path("runs").exists()


@pytest.mark.usefixtures("fakes")
def test_an_interrupt_ends_all_seeds(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    run = loop.run
    monkeypatch.setattr(loop, "run", lambda options: run(options) and options.seed != 1)
    assert main([*FAST, "--task=train_fakes:Counting", "--seeds", "0-4"]) == 130
    out = capsys.readouterr().out.splitlines()
    assert "interrupted in seed 1; the same command continues from there" in out
    assert "seed 2 (3 of 5)" not in out
    assert out[-1].startswith("1 seed: return ")


def test_one_seed_is_a_run_as_always() -> None:
    assert parse_runs(["--backend", "jax", "--seeds", "3"]) == [parse(["--backend", "jax", "--seed", "3"])]
