"""The command line of `train`: presets, hyperparameters, help, and one line with exit code 2 for each mistake."""

import dataclasses
import importlib.metadata
import re
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from train_fakes import FakeLearner

import dreamer_spec.commands
import dreamer_spec.training.setup
from dreamer_spec.cli import build_parser, main, parse
from dreamer_spec.commands import COMMANDS
from dreamer_spec.errors import UserError
from dreamer_spec.option_table import EVAL_OPTIONS, RUN_OPTIONS
from dreamer_spec.options import Options, presets
from spec import hyperparameters

SMALL = {"deter": 8, "units": 4, "stoch": 2, "classes": 2, "batch-size": 2, "batch-length": 3, "envs": 2}
SHORT = {"steps": 60, "eval-every": 0, "eval-episodes": 1, "random-episodes": 1}
FAST = ["--backend=jax", "--size=tiny", *(f"--{name}={value}" for name, value in {**SMALL, **SHORT}.items())]


@dataclasses.dataclass
class Report:
    passed: bool
    worst: float
    summary: str


@pytest.fixture(autouse=True)
def fakes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Report:
    """A learner that needs no backend, and a preflight that says what the test wants."""
    report = Report(True, 1e-7, "3 checks")
    module = types.ModuleType("conformance.preflight")
    module.preflight = lambda *arguments, **options: report  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "conformance.preflight", module)
    monkeypatch.setattr(dreamer_spec.training.setup, "learner_class", lambda backend: FakeLearner)
    monkeypatch.chdir(tmp_path)
    return report


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """What the command says on stderr; it must be one line, with exit code 2."""
    capsys.readouterr()
    assert main(arguments) == 2
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("train: error: ")
    assert "Traceback" not in captured.out
    return lines[0]


def test_a_run_ends_with_its_result(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*FAST, "--task", "train_fakes:Counting"]) == 0
    out = capsys.readouterr().out
    assert "preflight: 3 checks" in out
    assert out.splitlines()[-1] == "return 50, random 10, ratio 5 after 257 train steps"
    assert Path("runs/train_fakes-Counting-jax-seed0/curve.png").exists()


def test_the_same_command_continues(capsys: pytest.CaptureFixture[str]) -> None:
    main([*FAST, "--task", "train_fakes:Counting"])
    assert main([*FAST, "--task", "train_fakes:Counting", "--steps", "90"]) == 0
    assert "continuing at step 60 from runs/" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("task", "words"),
    [
        ("gym:NoSuchGame-v0", ["unknown task", "NoSuchGame"]),
        ("nonsense", ["unknown task", "`train tasks` lists"]),
        ("train_fakes:Sequences", ["unsupported space", "'words'", "Sequence"]),
        (
            "train_fakes:nan_observation",
            ["train_fakes:nan_observation", "environment", "step 7", "'observation'", "nan"],
        ),
        ("train_fakes:wrong_dtype", ["step 3", "'observation'", "dtype", "float32"]),
        ("train_fakes:wrong_shape", ["step 3", "'observation'", "(3,)", "(2,)"]),
    ],
)
@pytest.mark.parametrize("processes", ["no", "yes"])
def test_bad_environments(capsys: pytest.CaptureFixture[str], task: str, words: list[str], processes: str) -> None:
    line = refusal(capsys, *FAST, "--steps", "200", "--task", task, "--processes", processes, "--random-episodes", "0")
    assert all(word in line for word in words), line


def test_missing_extra(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "dm_env", None)
    monkeypatch.delitem(sys.modules, "dreamer_spec.envs.suites.dm_control", raising=False)
    assert "pip install 'dreamer-spec[dm-control]'" in refusal(
        capsys, *FAST, "--task", "dmc:walker-walk", "--processes", "no"
    )


def test_missing_backend(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def learner_class(backend: str) -> Any:
        raise ModuleNotFoundError("No module named 'optax'", name="optax")

    monkeypatch.setattr(dreamer_spec.training.setup, "learner_class", learner_class)
    line = refusal(capsys, *FAST, "--task", "train_fakes:Counting")
    assert "the package optax: pip install 'dreamer-spec[jax]'" in line


def test_checkpoint_of_another_configuration(capsys: pytest.CaptureFixture[str]) -> None:
    main([*FAST, "--task", "train_fakes:Counting"])
    line = refusal(
        capsys, *FAST, "--task", "train_fakes:Counting", "--units", "8", "--batch-length", "2", "--free-nats", "2"
    )
    assert (
        "batch_length: 3 in the checkpoint, 2 given; units: 4 in the checkpoint, 8 given. These may not change half way"
        in line
    )
    assert "free_nats" not in line


def test_unwritable_log_directory(capsys: pytest.CaptureFixture[str]) -> None:
    Path("file").touch()
    line = refusal(capsys, *FAST, "--task", "train_fakes:Counting", "--logdir", "file/run")
    assert "cannot write to the log directory file/run" in line


def test_failed_preflight(capsys: pytest.CaptureFixture[str], fakes: Report) -> None:
    fakes.passed, fakes.worst, fakes.summary = False, 0.25, "[RET-2] lambda_return deviates"
    line = refusal(capsys, *FAST, "--task", "train_fakes:Counting")
    assert "[RET-2] lambda_return deviates" in line
    assert "0.25" in line
    assert main([*FAST, "--task", "train_fakes:Counting", "--no-preflight"]) == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--batch-size", "0"], ["batch_size is 0", "above 0"]),
        (["--batch-size", "many"], ["--batch-size", "'many'", "whole number"]),
        (["--learning-rate", "nan"], ["learning_rate", "nan"]),
        (["--compute-dtype", "int8"], ["--compute-dtype", "int8", "bfloat16"]),
        (["--cnn-outer", "maybe"], ["--cnn-outer", "maybe"]),
        (["--cnn-multipliers", "1,x"], ["--cnn-multipliers", "'1,x'"]),
        (["--replay-capacity", "5"], ["replay_capacity is 5", "6"]),
        (["--no-such-thing", "5"], ["--no-such-thing"]),
        (["--steps", "0"], ["--steps", "at least 1"]),
        (["--env-timeout", "1e308"], ["--env-timeout", "'1e308'", "1e+09"]),
        (["--env-timeout", "nan"], ["--env-timeout", "'nan'"]),
        (["--replay-memory", "1e308"], ["--replay-memory", "'1e308'", "1e+09"]),
        (["--logdir", ""], ["--logdir", "empty"]),
        (["--observations", ","], ["--observations", "','"]),
        (["--leave-out", ""], ["--leave-out", "''"]),
        (["--size", "huge"], ["--size", "huge", "200m"]),
        (["--preset", "nonsense"], ["'nonsense'", "cartpole"]),
        (["--device", "quantum:0"], ["--device quantum:0", "available"]),
        (["--backend", "numpy"], ["--backend", "numpy", "torch"]),
    ],
)
def test_invalid_options(capsys: pytest.CaptureFixture[str], arguments: list[str], words: list[str]) -> None:
    line = refusal(capsys, *FAST, "--task", "train_fakes:Counting", *arguments)
    assert all(word in line for word in words), line


def test_images_that_the_encoder_cannot_halve(capsys: pytest.CaptureFixture[str]) -> None:
    line = refusal(capsys, *FAST, "--task", "train_fakes:Everything", "--image-size", "50")
    assert "train_fakes:Everything" in line
    assert "50" in line


# What the options mean


def test_precedence_of_base_preset_and_command_line() -> None:
    default = parse(["--backend", "jax"])
    cartpole, base = presets()["cartpole"], presets()["base"]
    assert (default.task, default.steps) == (cartpole["task"], cartpole["steps"])
    assert default.config.envs == cartpole["hyperparameters"]["envs"]
    assert default.logdir == Path("runs/CartPole-v1-jax-seed0")

    paper = parse(["--backend", "torch", "--task", "dmc:cheetah-run", "--envs", "3", "--seed", "4"])
    assert (paper.task, paper.action_repeat, paper.steps) == ("dmc:cheetah-run", 2, 500_000)
    assert (paper.config.replay_ratio, paper.config.envs, paper.config.units) == (512, 3, 256)
    assert paper.logdir == Path("runs/dmc-cheetah-run-torch-seed4")

    own = parse(["--backend", "jax", "--task", "a:b", "--profile", "official"])
    assert own.steps == base["steps"]
    assert own.config.beta2 == 0.999


@pytest.mark.parametrize("name", [name for name in presets() if name != "base"])
def test_presets_are_valid(name: str) -> None:
    task = [] if "task" in presets()[name] else ["--task", "my_module:make_env"]
    assert parse(["--backend", "jax", "--preset", name, *task]).task


def test_a_preset_for_any_task_asks_for_one() -> None:
    with pytest.raises(UserError, match=r"preset laptop.*--task"):
        parse(["--backend", "jax", "--preset", "laptop"])


def test_every_hyperparameter_is_an_option_in_both_spellings() -> None:
    samples = {bool: "false", int: "2", float: "0.5", list: "1,2,3"}
    parser = build_parser()
    for name, entry in hyperparameters().items():
        text = entry["choices"][-1] if "choices" in entry else samples[type(entry["value"])]
        namespace = parser.parse_args(["--backend", "jax", f"--{name.replace('_', '-')}", text])
        assert getattr(namespace, name) is not None
    assert parse(["--backend", "jax", "--batch_size=8", "--replay_capacity", "1e5"]).config.batch_size == 8
    assert parse(["--backend", "jax", "--cnn-multipliers", "1,4"]).config.cnn_multipliers == (1, 4)


def test_the_first_version_is_not_for_training(capsys: pytest.CaptureFixture[str]) -> None:
    assert parse(["--backend", "jax", "--profile", "2024-04"]).config == dataclasses.replace(
        parse(["--backend", "jax"]).config,
        beta2=0.999,
        warmup_steps=1000,
        continue_target="discounted",
        vector_loss_scale=1.0,
    )
    assert main(["--backend", "jax", "--profile", "2023"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("train: error: the profile 2023 is for `conformance check` only")
    assert error.count("\n") == 1


def test_help_shows_meaning_symbol_and_default(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0
    text = " ".join(capsys.readouterr().out.split())
    for name, entry in hyperparameters().items():
        assert f"--{name.replace('_', '-')}" in text
        assert entry["help"] in text
    assert "beta_rep (default 0.1)" in text
    assert "(default 0.99; 2024-04: 0.999; official: 0.999)" in text
    assert "`train tasks` lists" in text


def test_help_writes_no_default_itself(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Other values in presets.toml and in `Options` are other words in `--help`; the table has none."""
    for options in (*RUN_OPTIONS.values(), EVAL_OPTIONS):
        for option in options:
            assert "default" not in option.meaning
            assert option.default is None or option.name not in presets()["base"], option.name
    monkeypatch.setitem(presets()["base"], "steps", 1234567)
    monkeypatch.setitem(presets()["base"], "env_timeout", 7.5)
    monkeypatch.setitem(hyperparameters()["free_nats"], "value", 1.25)
    with pytest.raises(SystemExit):
        main(["--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "environment steps, with action repeat (default 1,234,567)" in text
    assert "for a step is restarted (default 7.5)" in text
    assert "(default 1.25)" in text
    for field in dataclasses.fields(Options):
        option = next(
            (option for options in RUN_OPTIONS.values() for option in options if option.name == field.name), None
        )
        if option and isinstance(field.default, int | float | str) and not isinstance(field.default, bool):
            assert re.search(r"\(default [^()]+\)$", option.help), field.name


def test_whole_numbers_may_be_written_as_powers() -> None:
    assert parse(["--backend", "jax", "--steps", "1e5"]).steps == 100_000
    with pytest.raises(UserError, match=r"'1\.5'"):
        parse(["--backend", "jax", "--steps", "1.5"])


def test_the_command_itself_says_one_line() -> None:
    """Without any of this file's fakes, in a process of its own."""
    command = [
        sys.executable,
        "-m",
        "dreamer_spec",
        "--backend",
        "jax",
        "--task",
        "train_fakes:nan_observation",
        "--batch-size",
        "-1",
    ]
    done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parent.parent, check=False)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("train: error: hyperparameter batch_size is -1")
    assert np.all(done.stdout == "")


# Mistakes before there is a run


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["--backend is missing", "`train --backend jax` trains the default task", "train --help"]),
        (
            ["--task", "gym:A b", "--steps=9"],
            ["`train --backend jax --task 'gym:A b' --steps=9` trains with these options"],
        ),
        (["repot", "runs/a"], ["unknown command 'repot'; did you mean report?"]),
        (["runs/a"], ["unknown command 'runs/a' (see train --help)"]),
        (["--backend", "jax", "--learning-rat", "3"], ["unknown option --learning-rat; did you mean --learning-rate?"]),
        (["--backend", "jax", "--batch_siz=3"], ["unknown option --batch-siz; did you mean --batch-size?"]),
        (["--backend", "jax", "report"], ["unexpected 'report'"]),
        (
            ["eval", "runs/a", "--episode", "3"],
            ["unknown option --episode; did you mean --episodes? (see train eval --help)"],
        ),
        (["--backend", "jax", "--preset", "labtop"], ["unknown preset 'labtop'", "did you mean laptop?"]),
    ],
)
def test_mistyped_words_are_told_what_is_close(
    capsys: pytest.CaptureFixture[str], arguments: list[str], words: list[str]
) -> None:
    line = refusal(capsys, *arguments)
    assert all(word in line for word in words), line


def test_help_names_the_commands_and_what_each_does(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    for name, what in COMMANDS.items():
        assert re.search(rf"^  train {name} +{re.escape(what)}$", text, re.MULTILINE), name
    modules = {path.stem for path in Path(dreamer_spec.commands.__path__[0]).glob("*.py")} - {"__init__"}
    assert modules == set(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_its_help(capsys: pytest.CaptureFixture[str], name: str) -> None:
    with pytest.raises(SystemExit) as stop:
        main([name, "--help"])
    assert stop.value.code == 0
    assert f"usage: train {name} " in capsys.readouterr().out


def test_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out == f"dreamer-spec {importlib.metadata.version('dreamer-spec')}\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ["--task", "gym:NoSuchGame-v0"],
        ["--task", "train_fakes:Sequences"],
        ["--task", "train_fakes:Counting", "--device", "quantum:0"],
        ["--task", "train_fakes:Everything", "--image-size", "50"],
        ["--task", "train_fakes:Counting", "--replay-capacity", "5"],
        ["--task", "train_fakes:Counting", "--resume", "must"],
    ],
)
def test_what_was_mistyped_leaves_no_log_directory(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> None:
    refusal(capsys, *FAST, *arguments)
    assert list(Path().iterdir()) == []


def test_a_failed_preflight_leaves_no_log_directory(capsys: pytest.CaptureFixture[str], fakes: Report) -> None:
    fakes.passed = False
    refusal(capsys, *FAST, "--task", "train_fakes:Counting")
    assert list(Path().iterdir()) == []


def test_a_run_that_another_process_began_meanwhile_stays(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the look at the log directory and its lock."""
    main([*FAST, "--task", "train_fakes:Counting"])
    before = sorted(Path("runs").rglob("*"))
    exists = Path.exists
    monkeypatch.setattr(
        Path, "exists", lambda path, **given: exists(path, **given) and path.name != "train_fakes-Counting-jax-seed0"
    )
    line = refusal(capsys, *FAST, "--task", "train_fakes:Counting")
    assert "another process has begun a run in runs/train_fakes-Counting-jax-seed0 meanwhile" in line
    assert sorted(Path("runs").rglob("*")) == before
