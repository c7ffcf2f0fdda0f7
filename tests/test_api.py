"""Training, evaluation and policies from Python: what is refused and how, callbacks, signals, and the example of
docs/python.md."""

import ast
import importlib
import inspect
import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import gymnasium
import numpy as np
import pytest
from api_runs import FAKED, ROOT, options, script
from train_agents import save_checkpoint
from train_fakes import Counting, FakeLearner
from train_runs import logged

import dreamer_spec
import dreamer_spec.training.setup
from conformance.own_names import OURS
from dreamer_spec import Evaluation, Training, UserError, evaluate, load_policy, make_options, train
from dreamer_spec.cli import main, parse
from dreamer_spec.disk import checkpoint
from dreamer_spec.envs import make_env
from dreamer_spec.option_table import EVAL_OPTIONS, RUN_OPTIONS
from dreamer_spec.policy import Policy
from spec import load_config

PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
CONFIG = load_config("paper", "tiny", compute_dtype="float32", envs=2)
KNOWN = make_env("train_fakes:Counting").translation


@pytest.fixture(autouse=True)
def fake_learner(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(dreamer_spec.training.setup, "learner_class", lambda backend: FakeLearner)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def saved(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A checkpoint of random parameters, whose environment pays 10 and 50 in its first episodes."""
    monkeypatch.setattr(FakeLearner, "load_state_dict", lambda self, state: None)
    return save_checkpoint(tmp_path / "run", CONFIG, KNOWN.spaces, translation=KNOWN, task="train_fakes:Counting")


# The package


def test_importing_the_package_imports_nothing_else() -> None:
    code = (
        "import sys, dreamer_spec; dir(dreamer_spec); "
        "print([name for name in ('numpy', 'jax', 'torch', 'gymnasium', 'spec') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_type_checkers_see_what_is_there() -> None:
    tree = ast.parse((ROOT / "dreamer_spec" / "__init__.py").read_text(encoding="utf-8"))
    (shown,) = (node for node in tree.body if isinstance(node, ast.If))
    imported = {
        alias.name: node.module for node in shown.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    assert sorted(imported) == dreamer_spec.__all__
    for name, module in imported.items():
        assert getattr(dreamer_spec, name) is getattr(importlib.import_module(module), name)
    assert (ROOT / "dreamer_spec" / "py.typed").exists()
    with pytest.raises(AttributeError, match="no attribute 'lern'"):
        dreamer_spec.lern  # noqa: B018


def keywords(function: Callable[..., Any]) -> set[str]:
    return set(inspect.signature(function).parameters)


def test_keywords_are_the_options_of_the_commands() -> None:
    names = {option.name for options in RUN_OPTIONS.values() for option in options}
    assert keywords(make_options) - {"hyperparameters"} == names - {"seeds"}
    assert keywords(evaluate) - {"run"} == {option.name for option in EVAL_OPTIONS}
    kinds = {option.name: option.kind for options in RUN_OPTIONS.values() for option in options}
    for name, parameter in inspect.signature(make_options).parameters.items():
        if "Literal" in str(parameter.annotation):
            values, *_ = (
                part for part in (parameter.annotation, *get_args(parameter.annotation)) if get_origin(part) is Literal
            )
            assert get_args(values) == kinds[name].choices


# Options


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, []),
        ({"preset": "laptop", "task": "a:b"}, ["--preset", "laptop", "--task", "a:b"]),
        (
            {"steps": np.int64(7), "envs": 3, "learning_rate": 1, "cnn_outer": True, "cnn_multipliers": (2, 4)},
            ["--steps=7", "--envs=3", "--learning-rate=1", "--cnn-outer=true", "--cnn-multipliers=2,4"],
        ),
        (
            {"steps": 1e5, "env_timeout": 3, "restore_envs": False},
            ["--steps=1e5", "--env-timeout=3", "--no-restore-envs"],
        ),
        ({"from_": "runs/a", "logdir": Path("b")}, ["--from", "runs/a", "--logdir", "b"]),
        (
            {"observations": ["a", "b_*"], "leave_out": "c,d", "info_metrics": ["x", "y/*"]},
            ["--observations=a,b_*", "--leave-out=c,d", "--info-metrics=x,y/*"],
        ),
        (
            {"task": "a:b", "env_arg": {"level": 3, "name": "x"}},
            ["--task=a:b", "--env-arg=level=3", "--env-arg=name=x"],
        ),
    ],
)
def test_options_are_those_of_the_command_line(given: dict[str, Any], words: list[str]) -> None:
    made = make_options("torch", **given)
    assert made == parse(["--backend", "torch", *words])
    assert type(made.steps) is int


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"backend": "numpy"}, "backend is 'numpy'; expected one of jax, torch"),
        ({"steps": 0}, "steps is 0; expected a whole number of at least 1"),
        ({"steps": "100"}, "steps is '100'; expected a whole number"),
        ({"steps": 1.5}, "steps is 1.5; expected a whole number"),
        ({"steps": True}, "steps is True; expected a whole number"),
        ({"seed": float("nan")}, "seed is nan; expected a whole number"),
        ({"preflight": "no"}, "preflight is 'no'; expected true or false"),
        ({"env_timeout": -1}, "env_timeout is -1; expected a time in seconds"),
        ({"logdir": ""}, "logdir is ''; expected a folder, whose name is not empty"),
        ({"logdir": 3}, "logdir is 3; expected a folder"),
        ({"observations": []}, r"observations is \[\]; expected a list of keys, at least one"),
        ({"observations": 3}, "observations is 3; expected a list of keys"),
        ({"resume": "maybe"}, "resume is 'maybe'; expected one of auto, never, must"),
        ({"device": 0}, "device is 0; expected a text"),
        ({"env_arg": {"level": object()}}, "env_arg is .*; expected keyword arguments, their values numbers, texts"),
        ({"env_arg": {"a b": 1}}, "env_arg is .*; expected keyword arguments"),
        ({"env_arg": {3: 1}}, "env_arg is .*; expected keyword arguments"),
        ({"env_arg": {"level": {1: 2}}}, "env_arg is .*; expected keyword arguments"),
        ({"env_arg": {"level": float("inf")}}, "env_arg is .*; expected keyword arguments"),
        ({"env_arg": ["level=3"]}, "env_arg is .*; expected keyword arguments"),
        ({"learning_rate": "fast"}, "learning_rate is 'fast'; expected a number"),
        ({"learning_rate": -1.0}, "learning_rate is -1.0; expected a finite number, 0 or more"),
        ({"envs": 0}, "envs is 0; expected a whole number above 0"),
        ({"cnn_multipliers": "1,2"}, "cnn_multipliers is '1,2'; expected a list of whole numbers"),
        ({"compute_dtype": "int8"}, "compute_dtype is 'int8'; expected one of"),
        ({"size": "huge"}, "size is 'huge'; expected one of tiny, 1m"),
        ({"preset": "latop"}, "unknown preset 'latop'; did you mean laptop"),
        ({"preset": "laptop"}, "name yours, task MODULE:CALLABLE"),
        ({"step": 3}, "unknown option step; did you mean steps?"),
        ({"seeds": [0, 1]}, "seeds is .*; expected a list of different seeds|unknown option seeds; did you mean seed?"),
        ({"task": 3}, "task is 3; expected SUITE:NAME, or a function or class that makes a gymnasium.Env"),
        ({"task": Counting()}, "task is .*Counting.*; expected SUITE:NAME, or a function or class"),
    ],
)
def test_a_wrong_option_is_named(given: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message) as error:
        make_options(**{"backend": "jax", **given})
    assert "--" not in str(error.value)


def test_what_a_run_refuses_names_keywords() -> None:
    train(options())
    for given, message in [
        ({"resume": "never"}, "holds a run already, and resume is never; choose another logdir"),
        ({"logdir": "other", "device": "quantum:0"}, "does not run with device quantum:0"),
        ({"logdir": "other", "replay_capacity": 5}, "replay_capacity is 5"),
        ({"logdir": "other", "task": "train_fakes:Everything", "image_size": 50}, r"\(image_size\)"),
        ({"logdir": "other", "env_arg": {"level": 3}}, "env_arg level=3: .*unexpected keyword argument 'level'"),
    ]:
        with pytest.raises(UserError, match=message) as error:
            train(options(**given))
        assert "--" not in str(error.value)


# Callbacks


def test_a_callback_gets_every_line() -> None:
    seen: list[dict[str, float]] = []
    result = train(options(random_episodes=1), lambda step, metrics: seen.append({"step": step, **metrics}))
    lines = [{name: value for name, value in line.items() if name != "seconds"} for line in logged(result.logdir)]
    assert seen == lines
    assert {"random/return", "episode/return", "evaluation/return", "train/loss/total"} <= {
        name for line in seen for name in line
    }
    assert str(result) == f"at step 60: return 50, random 10, ratio 5; {result.logdir}"
    assert result.checkpoint == result.logdir / "checkpoints" / "000000000060"


@pytest.mark.parametrize("answer", [False, np.bool_(False)])
def test_a_callback_stops_the_run_which_is_saved(answer: object, capsys: pytest.CaptureFixture[str]) -> None:
    result = train(options(), lambda step, metrics: answer if step >= 30 else None)
    assert (result.finished, result.step, result.checkpoint.name) == (False, 30, "000000000030")
    assert str(result).startswith("stopped at step 30: return")
    assert "stopped by the callback at step 30, saved in" in capsys.readouterr().out
    assert checkpoint.open_checkpoint(result.checkpoint).info["counters"]["records"] == 30
    again = train(options())
    assert (again.finished, again.step) == (True, 60)
    whole = train(options(logdir="whole"))
    assert [line["step"] for line in logged(again.logdir)] == [line["step"] for line in logged(whole.logdir)]


@pytest.mark.parametrize("answer", [None, True, 0, "", np.bool_(True)])
def test_any_other_answer_goes_on(answer: object) -> None:
    assert train(options(), lambda step, metrics: answer).finished


def test_a_callback_may_stop_before_the_first_step_and_in_the_last_evaluation(
    capsys: pytest.CaptureFixture[str],
) -> None:
    result = train(options(random_episodes=1), lambda step, metrics: "random/return" not in metrics)
    assert (result.step, result.finished) == (0, False)
    late = train(options(logdir="late"), lambda step, metrics: step < 60 or "episode/return" in metrics)
    assert (late.step, late.finished) == (60, False)
    assert not any("evaluation/return" in line for line in logged(late.logdir))
    capsys.readouterr()
    assert train(options(logdir="late")).finished
    assert any("evaluation/return" in line for line in logged(late.logdir))


def test_what_a_callback_raises_comes_out_and_nothing_is_left_behind() -> None:
    before = handlers()

    def fail(step: int, metrics: dict[str, float]) -> None:
        if step >= 30:
            raise ZeroDivisionError("in the callback")

    with pytest.raises(ZeroDivisionError, match="in the callback"):
        train(options(), fail)
    assert handlers() == before
    assert train(options()).finished, "the log directory is free, and a new run begins"


# Signals


def handlers() -> list[Any]:
    return [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.covers("LOOP-48")
def test_a_signal_saves_and_is_raised(number: signal.Signals) -> None:
    before = handlers()
    signalled: list[int] = []

    def interrupt(step: int, metrics: dict[str, float]) -> None:
        if step >= 30 and not signalled:
            signalled.append(step)
            os.kill(os.getpid(), number)

    with pytest.raises(
        KeyboardInterrupt, match=r"the run is saved in runs/.*/checkpoints/0000000000\d\d; the same options"
    ):
        train(options(), interrupt)
    assert handlers() == before
    assert train(options()).finished


def test_ctrl_c_ends_a_script(tmp_path: Path) -> None:
    code = FAKED + "train(make_options('jax', Sleepy, **SHORT, processes='no'), lambda *_: print('line', flush=True))\n"
    process = script(tmp_path / "user", code + "print('went on')\n")
    assert process.stdout.readline()
    while "line" not in process.stdout.readline():
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=60)
    assert process.returncode in (-signal.SIGINT, 130)
    assert "interrupted at step" in out
    assert "went on" not in out
    last = error.splitlines()[-1]
    assert re.match(r"KeyboardInterrupt: the run is saved in runs/\S+; the same options continue it$", last)


def test_it_trains_twice_in_one_process_and_puts_the_signals_back() -> None:
    before = handlers()
    first, second = train(options(logdir="a")), train(options(logdir="b", seed=1))
    assert [result.finished for result in (first, second)] == [True, True]
    assert handlers() == before
    assert signal.set_wakeup_fd(-1) == -1


@pytest.mark.parametrize("processes", ["no", "yes"])
def test_it_trains_in_a_thread_where_signals_cannot_be_set(processes: str, saved: Path) -> None:
    """As in a notebook that runs cells in threads, or in a server."""
    before, results = handlers(), []

    def work() -> None:
        results.append(train(options(processes=processes), lambda step, metrics: step < 30))
        results.append(train(options(processes=processes)))
        results.append(evaluate(saved, 1, task=Counting, processes=processes))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join(120)
    stopped, finished, evaluation = results
    assert (stopped.finished, finished.finished, evaluation.returns) == (False, True, (10.0,))
    assert handlers() == before


# Evaluation and policies


def test_an_evaluation_is_that_of_the_command(saved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    played = evaluate(saved, 3, task=Counting, seed=4)
    assert (played.returns, played.lengths, played.mean) == ((10, 50, 10), (5, 5, 5), pytest.approx(70 / 3))
    assert played.standard_error == pytest.approx(40 / 3)
    assert (played.step, played.trained_by, played.checkpoint) == (1000, "jax", saved)
    assert str(played) == "return 23.33 ± 13 (min 10, max 50), length 5 (min 5, max 5)"
    main(["eval", str(saved), "--episodes", "3", "--task", "train_fakes:Counting", "--seed", "4", "--json", "out.json"])
    assert str(played) in capsys.readouterr().out
    assert json.loads(Path("out.json").read_text()) == json.loads(json.dumps(played.to_json()))
    assert evaluate(str(saved.parent.parent), 1, task="train_fakes:Counting").standard_error is None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"task": None}, "if you trust it, add task train_fakes:Counting"),
        ({"run": ""}, "run is ''; expected a run or a checkpoint, whose name is not empty"),
        ({"run": "nowhere"}, "no checkpoint in nowhere"),
        ({"episodes": 0}, "episodes is 0; expected a whole number of at least 1"),
        ({"mode": "yes"}, "mode is 'yes'; expected true or false"),
        ({"backend": "numpy"}, "backend is 'numpy'; expected one of jax, torch"),
        ({"video": "film.avi"}, "video film.avi: expected a file that ends in .gif or .mp4"),
        ({"time_limit": 0}, "time_limit is 0"),
        ({"task": lambda: gymnasium.make("CartPole-v1")}, "has the spaces"),
    ],
)
def test_what_cannot_be_evaluated_is_named(saved: Path, given: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message) as error:
        evaluate(**{"run": saved, "task": Counting, **given})
    assert "--" not in str(error.value)


def test_the_traceback_of_an_environment_is_shown(saved: Path) -> None:
    def unmakeable() -> Counting:
        raise ZeroDivisionError("deep inside")

    with pytest.raises(UserError, match="ZeroDivisionError: deep inside") as error:
        evaluate(saved, task=unmakeable)
    assert re.search(r"(?s)Traceback.*in unmakeable.*ZeroDivisionError: deep inside", "".join(error.value.__notes__))


def test_a_policy_comes_from_a_folder_a_run_or_a_checkpoint(saved: Path) -> None:
    main(["export", str(saved), "policy"])
    actions = []
    for path in ("policy", saved, saved.parent.parent):
        policy = load_policy(path)
        assert isinstance(policy, Policy)
        policy.reset(1, seed=3)
        actions.append(policy(policy.observation([np.zeros(2, np.float32)]), [True]).tolist())
    assert actions[0] == actions[1] == actions[2]
    with pytest.raises(UserError, match="cannot load the policy nowhere"):
        load_policy("nowhere")
    with pytest.raises(UserError, match="no checkpoint in"):
        load_policy(".")


def test_a_policy_needs_numpy_alone(saved: Path, tmp_path: Path) -> None:
    code = f"""
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top not in sys.stdlib_module_names and top not in {("numpy", "safetensors", *OURS)!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
from dreamer_spec import load_policy
policy = load_policy({str(saved)!r})
policy.reset(1)
print(policy(policy.observation([[0.0, 1.0]]), [True]).shape)
"""
    process = script(tmp_path / "user", code)
    out, error = process.communicate(timeout=60)
    assert (process.returncode, out) == (0, "(1, 2)\n"), error


# The page

TINY = """
from dreamer_spec.options import presets
presets()["laptop"].update(size="tiny", steps=64, eval_every=24, eval_episodes=1, random_episodes=1, preflight=False)
presets()["laptop"]["hyperparameters"] = {
    "deter": 16, "units": 8, "stoch": 3, "classes": 4, "bins": 31, "envs": 2, "batch_size": 2, "batch_length": 4,
    "replay_ratio": 1, "replay_capacity": 100,
}
"""


@pytest.mark.parametrize("name", ["train.py", "example.py"])
def test_the_example_of_the_page_runs(tmp_path: Path, name: str) -> None:
    """As it is printed, in a folder of the user's: as train.py, and beside a train.py that is another program. The
    preset that it names is made short."""
    folder = tmp_path / "user"
    (tmp_path / "short").mkdir()
    (tmp_path / "short" / "sitecustomize.py").write_text(TINY, encoding="utf-8")
    folder.mkdir()
    (folder / "train.py").write_text("raise SystemExit('another program')\n", encoding="utf-8")
    (example,) = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    assert 15 <= len(example.splitlines()) <= 35
    paths = os.pathsep.join([str(tmp_path / "short"), str(ROOT)])
    process = script(folder, example, name=name, environment={"PYTHONPATH": paths})
    out, error = process.communicate(timeout=300)
    assert process.returncode == 0, error
    assert error == ""
    assert f"{name.removesuffix('.py')}:make_env: torch on cpu" in out
    assert re.search(r"^return [\d.]+ ± [\d.]+ \(min \d+, max \d+\)", out, re.MULTILINE)


def test_the_page_names_what_there_is() -> None:
    attributes = [name for kind in (Training, Evaluation) for name in vars(kind) if not name.startswith("_")]
    fields = [name for kind in (Training, Evaluation) for name in kind.__dataclass_fields__]
    for name in {*dreamer_spec.__all__, *keywords(evaluate), *attributes, *fields}:
        assert re.search(rf"`{name}\b", PAGE), name
