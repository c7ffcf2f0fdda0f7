"""Every command line of the documents runs as it is printed.

What lies between ```sh and ``` is taken from the documents themselves, so a new line is tested without a word here.
Appended options make runs short; what a line needs beside the repository, such as a run or an adapter, is prepared in a
folder of its own.
"""

import importlib
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from dreamer_spec.cli import main, parse_runs

ROOT = Path(__file__).resolve().parent.parent
DOCUMENTS = (
    [ROOT / name for name in ("README.md", "CONTRIBUTING.md")]
    + sorted(ROOT.glob("docs/*.md"))
    + sorted(ROOT.glob("spec/*.md"))
)
BIN = Path(sys.executable).parent

TRAIN = (
    "--size tiny --deter 16 --units 8 --envs 1 --batch-size 2 --batch-length 4 "
    "--replay-ratio 1 --steps 40 --image-size 16"
)
TRAIN += " --eval-every 0 --eval-episodes 1 --random-episodes 1 --no-preflight"

# Begin of a line -> what is appended to it, so that it takes seconds. A second line begins with it: the longest fits.
SHORTER = {
    "train --": TRAIN,
    "train resume": "--steps 710",
    "train eval": "--episodes 2",
    "train sweep": "--dry-run",
    "conformance check": "--only transforms --examples 2",
    "conformance check --process": "--only transforms --examples 2 --timeout 300",
    "conformance lockstep": "--steps 2 --problems vector",
    "conformance mutants": "--only lambda",
    "conformance vectors": "--only symlog",
    "python -m benchmarks.learning": TRAIN,
}
# Begin of a line -> why it does not run here.
NOT_HERE = {
    "make ": "makes an environment of its own and downloads; what it calls is tested",
    "pip install": "downloads",
    "python -m docs.paper_": "reads what is not part of the project; tests/test_paper_scores.py",
    "export ": "sets variables for the lines after it",
}
SLOW = (
    "conformance lockstep",
    "conformance mutants",
    "python -m benchmarks",
    "train --backend jax",
)  # compile, or take a minute
FAILURES = {0, 1}  # of `conformance check`: 1 says that the candidate deviates, which an adapter of two functions does


def lines(document: Path) -> list[str]:
    """The command lines of a document, without comments, and those that go on in the next line joined."""
    blocks = re.findall(
        r"^```(?:sh|bash|console)\n(.*?)^```", document.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    found = (line.strip() for block in blocks for line in block.replace("\\\n", " ").splitlines())
    return [re.sub(r"\s+#.*$", "", line) for line in found if line and not line.startswith("#")]


COMMANDS = [(document.relative_to(ROOT), line) for document in DOCUMENTS for line in lines(document)]


def longest(table: dict[str, str], line: str) -> str | None:
    """The entry with the longest name that the line begins with."""
    return table.get(max((name for name in table if line.startswith(name)), key=len, default=""))


def parameters() -> Iterator[object]:
    for document, line in COMMANDS:
        if longest(NOT_HERE, line) is None:
            slow = [pytest.mark.slow] if line.startswith(SLOW) else []
            yield pytest.param(line, id=f"{document}: {line[:60]}", marks=slow)


def test_the_lines_are_found_and_those_that_do_not_run_have_a_reason() -> None:
    found = [line for _, line in COMMANDS]
    assert len(found) > 50
    assert {"train", "conformance", "python", "pip", "make", "export"} == {line.split()[0] for line in found}
    for table in (SHORTER, NOT_HERE):
        unused = [name for name in table if not any(line.startswith(name) for line in found)]
        assert unused == [], "no line begins with these any more"


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the lines name: runs, an adapter, results of it, an environment, other programs."""
    folder = tmp_path_factory.mktemp("prepared")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (adapter,) = re.findall(
        r"^```python\n(import numpy as np\nfrom my_dreamer import .*?)^```", readme, re.MULTILINE | re.DOTALL
    )
    (folder / "my_adapter.py").write_text(adapter)
    (folder / "my_dreamer.py").write_text("from reference_numpy import returns, transforms\n\nlosses = transforms\n")
    with (folder / "my_dreamer.py").open("a") as file:
        file.write("losses.lambda_return = returns.lambda_return\n")
    (folder / "my_module.py").write_text(
        """import gymnasium
from gymnasium import spaces


def make_env(level=1, goals=()):
    def seen(observation):
        return {"arm_angle": observation, "camera": observation[:2], "debug_time": observation[:1]}

    cartpole = gymnasium.make("CartPole-v1")
    box = cartpole.observation_space
    first, two = spaces.Box(box.low[:1], box.high[:1]), spaces.Box(box.low[:2], box.high[:2])
    parts = {"arm_angle": box, "camera": two, "debug_time": first}
    return gymnasium.wrappers.TransformObservation(cartpole, seen, spaces.Dict(parts))


def make_envs(num_envs, seed=0):
    return gymnasium.vector.SyncVectorEnv([make_env] * num_envs)
"""
    )
    (folder / "expected.toml").write_text("")
    sweeps = (ROOT / "docs" / "sweeps.md").read_text(encoding="utf-8")
    (folder / "control.toml").write_text(sweeps.partition("```toml\n")[2].partition("```")[0])
    (folder / "bin").mkdir()
    serve = f'#!/bin/sh\nexec "{sys.executable}" -m conformance.serve my_adapter.py\n'
    for path in (folder / "bin" / "COMMAND", folder / "my_dreamer"):
        path.write_text(serve)
    (folder / "ENV" / "bin").mkdir(parents=True)
    (folder / "ENV" / "bin" / "python").write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    for path in (folder / "bin" / "COMMAND", folder / "my_dreamer", folder / "ENV" / "bin" / "python"):
        path.chmod(0o755)
    for name in ("docs", "conformance", "benchmarks"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(folder / "conformance/examples/optax_adapter.py", folder / "conformance/examples/NAME_adapter.py")
    for name in ("a", "mine", "torchrl"):
        run(folder, f"conformance check my_adapter.py --only transforms --examples 2 --json {name}.json", FAILURES)
    for name in ("b", "theirs"):
        shutil.copy(folder / "a.json", folder / f"{name}.json")
    run(folder, f"train --backend torch {TRAIN} --steps 700 --logdir runs/CartPole-v1-jax-seed0")
    shutil.copytree(folder / "runs/CartPole-v1-jax-seed0", folder / "runs/CartPole-v1-torch-seed0")
    (folder / "runs" / "notes.txt").touch()
    return folder


def run(folder: Path, line: str, codes: set[int] | None = None) -> str:
    """Runs a line in a shell that finds our commands, and returns what it printed."""
    paths = [str(folder / "bin"), str(BIN), os.environ["PATH"]]
    environment = os.environ | {"PATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["bash", "-c", line], cwd=folder, env=environment, capture_output=True, text=True, timeout=1200
    )
    assert done.returncode in (codes or {0}), f"{line}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    assert "Traceback" not in done.stderr, done.stderr
    return done.stdout


@pytest.mark.parametrize("line", list(parameters()))
def test_a_line_runs_as_it_is_printed(prepared: Path, tmp_path: Path, line: str) -> None:
    folder = tmp_path / "here"
    shutil.copytree(prepared, folder)
    if line.startswith("conformance new-adapter"):
        (folder / "my_adapter.py").unlink()  # it writes a new one, and replaces none
    if line.startswith("conformance lockstep"):
        shutil.copy(
            ROOT / "tests" / "reference_adapter.py", folder / "my_adapter.py"
        )  # whole train steps, not two functions
    shorter = longest(SHORTER, line)
    separator = " --" if line.startswith("python -m benchmarks.learning") and " -- " not in line else ""
    line = line.replace("/opt/old_env/", "ENV/")
    run(folder, f"{line}{separator} {shorter or ''}", FAILURES if line.startswith("conformance check") else None)


@pytest.mark.parametrize("line", [line for _, line in COMMANDS if line.startswith("train --")])
def test_a_line_that_trains_runs_with_pytorch(
    prepared: Path, tmp_path: Path, line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As printed but for the backend: JAX compiles for longer than CI should wait. As printed they are slow tests."""
    assert parse_runs(shlex.split(line)[1:])
    shutil.copytree(prepared / "runs", tmp_path / "runs")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(prepared))
    assert main([*shlex.split(line)[1:], *TRAIN.split(), "--backend", "torch", "--device", "cpu"]) == 0


def test_lines_inside_of_sentences_are_understood() -> None:
    """`train --backend ...` between backticks: its options exist, and its values are values."""
    found = [
        words
        for document in DOCUMENTS
        for words in re.findall(r"`(train --[^`]+)`", document.read_text(encoding="utf-8"))
    ]
    complete = [
        " ".join(words.split()) for words in found if "--backend" in words and "|" not in words and "..." not in words
    ]
    assert len(complete) >= 3
    for words in complete:
        assert parse_runs(shlex.split(words)[1:]), words


def test_modules_inside_of_sentences_are_there() -> None:
    """`python -m benchmarks.loop ...`: it can be imported, and so can all that it needs."""
    names = {
        name
        for document in DOCUMENTS
        for name in re.findall(r"python -m ([a-z_]+\.[a-z_.]*[a-z_])", document.read_text(encoding="utf-8"))
    }
    assert len(names) >= 6
    for name in names - {"conformance.serve"}:  # a server begins when it is imported
        importlib.import_module(name)
