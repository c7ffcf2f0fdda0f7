"""Modules of users that bear the name of a package of ours: as tasks, as adapters, imported by either, and merely lying
where the command or a script is started."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from train_runs import SMALL

from conformance.candidate import load_candidate
from conformance.errors import UserError as ConformanceError
from conformance.own_names import OURS
from dreamer_spec import UserError, make_options
from dreamer_spec.envs import env_maker, make_env

ROOT = Path(__file__).resolve().parent.parent
HIDES = "of dreamer-spec, which hides any other module of that name; rename yours"
COMES_FIRST = "because Python looks there first; rename it, or start from another folder"

# The command as its script calls it: that lies elsewhere, so Python does not look where it is started.
CONSOLE = """
import sys
from dreamer_spec.training import setup
from dreamer_spec.cli import command
from train_fakes import FakeLearner

setup.learner_class = lambda backend: FakeLearner
sys.exit(command())
"""
SHORT = {**SMALL, "steps": 60, "eval_every": 0, "eval_episodes": 1, "random_episodes": 0}
RUN = ["--backend=jax", "--no-preflight", *(f"--{name.replace('_', '-')}={value}" for name, value in SHORT.items())]


def python(folder: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Where a user works. The command lies elsewhere."""
    (tmp_path / "console.py").write_text(CONSOLE, encoding="utf-8")
    (tmp_path / "user").mkdir()
    return tmp_path / "user"


def write(folder: Path, **modules: str) -> None:
    for name, text in modules.items():
        (folder / f"{name}.py").write_text(text, encoding="utf-8")


# Tasks


@pytest.mark.parametrize("name", OURS)
def test_a_task_cannot_bear_one_of_our_names(name: str) -> None:
    for task in (f"{name}:make_env", f"gym:{name}:Maze-v0", f"{name}.envs:make_env"):
        with pytest.raises(UserError) as error:
            env_maker(make_options("jax", task))
        assert str(error.value) == f"task {task}: {name} is the name of a package {HIDES}"


def test_other_names_are_free() -> None:
    for task in ("specs:make_env", "gym:CartPole-v1", "dmc:walker-walk", "my.spec:make_env"):
        assert env_maker(make_options("jax", task))


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("from spec import Robot", "cannot import name 'Robot' from 'spec'"),
        ("import conformance.robot", "No module named 'conformance.robot'"),
        ("import spec\nROBOT = spec.Robot", "module 'spec' has no attribute 'Robot'"),
        ("import spec\ndef make_env(): return spec.Robot()", "module 'spec' has no attribute 'Robot'"),
        ("def make_env():\n    from impl_jax import Robot", "cannot import name 'Robot' from 'impl_jax'"),
    ],
)
def test_a_task_that_means_a_module_of_its_own_gets_a_line(
    folder: Path, code: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(folder, own_names_task=code)
    monkeypatch.chdir(folder)
    with pytest.raises(UserError) as error:
        make_env("own_names_task:make_env")
    assert str(error.value).startswith(f"task own_names_task:make_env: {said}")
    assert str(error.value).endswith(HIDES)
    write(folder, own_names_other="import no_such_thing")
    with pytest.raises(ModuleNotFoundError, match="no_such_thing"):
        make_env("own_names_other:make_env")


# Where they merely lie


@pytest.mark.parametrize("processes", ["no", "yes"])
def test_the_command_does_not_see_what_lies_where_it_is_started(folder: Path, processes: str) -> None:
    """Neither do its worker processes, whose server Python starts with that folder first."""
    write(folder, **{name: f"raise SystemExit('{name} of the user')" for name in OURS if name != "dreamer_spec"})
    write(folder, my_task="from train_fakes import Counting")
    done = python(folder, "../console.py", *RUN, "--task=my_task:Counting", f"--processes={processes}")
    assert (done.returncode, done.stderr) == (0, "")
    assert "return 10 after" in done.stdout


@pytest.mark.parametrize("name", [name for name in OURS if name != "dreamer_spec"])
def test_where_python_looks_there_first_it_is_said_in_one_line(folder: Path, name: str) -> None:
    write(folder, **{name: ""})
    line = f"{folder / name}.py hides the package {name} of dreamer-spec, {COMES_FIRST}"
    done = python(folder, "-m", "dreamer_spec", "--version")
    assert (done.returncode, done.stderr) == (2, f"train: error: {line}\n")
    write(folder, train="from dreamer_spec import train")
    done = python(folder, "train.py")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == f"ImportError: {line}"
    if name != "conformance":
        done = python(folder, "-m", "conformance.cli", "docs")
        assert (done.returncode, done.stderr) == (2, f"conformance: error: {line}\n")


def test_folders_hide_packages_too_and_only_those_that_do(folder: Path) -> None:
    (folder / "spec").mkdir()
    assert python(folder, "-m", "dreamer_spec", "--version").returncode == 0, (
        "a folder of something else, such as texts"
    )
    write(folder / "spec", __init__="")
    done = python(folder, "-m", "dreamer_spec", "--version")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert f"{folder / 'spec' / '__init__.py'} hides the package spec" in done.stderr


# Adapters


@pytest.mark.parametrize("name", OURS)
def test_an_adapter_cannot_bear_one_of_our_names(folder: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    write(folder, **{name: "def symlog(x): return x"})
    monkeypatch.chdir(folder)
    for given in (f"{name}.py", str(folder / f"{name}.py"), name, f"{name}.adapter"):
        with pytest.raises(ConformanceError) as error:
            load_candidate(given, "float64")
        assert f"{given} cannot be an adapter: {name} is the name of a package of dreamer-spec; rename yours" in str(
            error.value
        )
        assert "--process" in str(error.value)
        assert "docs/adapters.md" in str(error.value)


@pytest.mark.parametrize("code", ["from spec import Robot", "import spec\nROBOT = spec.Robot"])
def test_an_adapter_that_means_a_module_of_its_own_gets_a_line_and_a_way_out(folder: Path, code: str) -> None:
    """In a process of its own, where ours is not, it finds its neighbour."""
    write(
        folder, own_names_adapter=f"{code}\nimport numpy as np\ndef symlog(x): return np.sign(x) * np.log1p(np.abs(x))"
    )
    write(folder, spec="Robot = 3")
    with pytest.raises(ConformanceError) as error:
        load_candidate(str(folder / "own_names_adapter.py"), "float64")
    assert "own_names_adapter.py: " in str(error.value)
    assert "spec is a package of dreamer-spec, which hides any other module of that name; rename yours" in str(
        error.value
    )
    assert "--process" in str(error.value)
    (folder / "serve.py").write_bytes((ROOT / "conformance" / "serve.py").read_bytes())
    check = ["-c", "import sys; sys.path.remove(''); from conformance.cli import main; sys.exit(main(sys.argv[1:]))"]
    check += [
        "check",
        "--only",
        "symlog",
        "--examples",
        "2",
        "--process",
        f"{sys.executable} serve.py own_names_adapter.py",
    ]
    done = python(folder, *check)
    assert done.returncode == 0, done.stdout + done.stderr
