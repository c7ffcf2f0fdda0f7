"""Environments that misbehave outside of Python's usual ways, and real runs of them: for tests of what surrounds a
run."""

import ctypes
import hashlib
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from train_fakes import Counting

ROOT = Path(__file__).parent.parent
SIZES = {
    "deter": 8,
    "units": 4,
    "stoch": 2,
    "classes": 2,
    "batch-size": 2,
    "batch-length": 3,
    "envs": 2,
    "replay-capacity": 500,
}

# The command as it is, but for a learner that needs no backend; a preflight that lasts, if PREFLIGHT says so.
COMMAND = """
import os, signal, sys
if hasattr(signal, "SIGHUP"):
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # Under nohup it would be ignored.
from dreamer_spec import cli
from dreamer_spec.training import setup
from train_fakes import FakeLearner
from train_surroundings import arrive
setup.learner_class = lambda backend: FakeLearner
if "PREFLIGHT" in os.environ:
    setup._preflight = lambda *arguments: arrive(os.environ["PREFLIGHT"])
cli.command()
"""


def arrive(how: str) -> None:
    """Says through a file that it has come here, with the id of the process, and stays."""
    path = Path(os.environ["ARRIVED"])
    partial = path.with_name(f"{path.name}.{os.getpid()}")
    partial.write_text(str(os.getpid()), encoding="ascii")
    partial.rename(path)
    if how == "loop":
        while True:
            pass
    if how == "sleep":
        time.sleep(1000)
    if how == "library":  # One call that lets other threads run, as compilers do, and that no signal interrupts.
        hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)
    if how == "lock":  # One call that lets no other thread run.
        ctypes.PyDLL(None).sleep(1000)


class Talking(Counting):
    """Says something in every step."""

    def step(self, action: np.ndarray) -> Any:
        print("a word from the environment " * 100)
        return super().step(action)


class Unmakeable(Counting):
    """Asks the process to end as if all were well."""

    def __init__(self) -> None:
        sys.exit(0)


class WordlessError(Exception):
    def __str__(self) -> str:
        raise ValueError("no words")


class Unprintable(Counting):
    """Raises two errors, in whatever processes, that are hard to print."""

    def step(self, action: np.ndarray) -> Any:
        with open(os.environ["ARRIVED"], "ab") as file:
            file.write(b".")
        number = Path(os.environ["ARRIVED"]).stat().st_size
        if number == 8:
            raise ValueError("\N{MIDDLE DOT} \udcff")
        if number == 16:
            raise WordlessError
        return super().step(action)


class Evaluated(Counting):
    """Takes its time in the last evaluation: in all steps of this process after those of training."""

    steps = 0

    def step(self, action: np.ndarray) -> Any:
        Evaluated.steps += 1
        if Evaluated.steps > 60:
            arrive("")
            time.sleep(0.05)
        return super().step(action)


class Grasping(Counting):
    """Ignores and blocks the signals of the process that it is in, once."""

    done = mine = False

    def step(self, action: np.ndarray) -> Any:
        if self.mine:  # Its turn before this one has ended.
            arrive("")
            time.sleep(0.01)
        elif self._episode and not Grasping.done:
            Grasping.done = self.mine = True
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.SIG_IGN)
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])
        return super().step(action)


class Unruly(Counting):
    """Goes elsewhere, closes the outputs and puts another in their place, and leaves a thread behind: once in a
    process."""

    done = False

    def step(self, action: np.ndarray) -> Any:
        if self._episode == 1 and not Unruly.done:
            Unruly.done = True
            os.chdir("/")
            for descriptor in (1, 2):
                os.close(descriptor)
            sys.stdout = object()  # type: ignore[assignment]
            threading.Thread(target=time.sleep, args=(1000,)).start()
        if Unruly.done:
            assert os.getcwd() == "/"
        return super().step(action)


class Homeless(Counting):
    """Removes the directory that the run was started in."""

    done = False

    def step(self, action: np.ndarray) -> Any:
        if not Homeless.done:
            Homeless.done = True
            os.rmdir(os.getcwd())
        return super().step(action)


class Stuck(Counting):
    """STUCK says where ("make", "reset" or "step") and how."""

    def __init__(self) -> None:
        super().__init__()
        self._where, self._how = os.environ["STUCK"].split(":")
        self._stay("make")

    def reset(self, **kwargs: Any) -> Any:
        self._stay("reset")
        return super().reset(**kwargs)

    def step(self, action: np.ndarray) -> Any:
        self._stay("step")
        return super().step(action)

    def _stay(self, where: str) -> None:
        if where == self._where:
            arrive(self._how)


def start(
    task: str, logdir: Path, *more: str, output: Any = subprocess.PIPE, shell: str = 'exec "$@"', **variables: str
) -> "subprocess.Popen[str]":
    """A run of 60 steps with a fake learner, in a process of its own. shell: what starts "$@"."""
    sizes = [word for name, value in SIZES.items() for word in (f"--{name}", str(value))]
    run = [
        "--backend",
        "jax",
        "--task",
        f"train_surroundings:{task}",
        "--steps",
        "60",
        "--logdir",
        str(logdir),
        "--log-every",
        "0",
    ]
    schedule = ["--eval-every", "0", "--eval-episodes", "1", "--random-episodes", "0"]
    preflight = [] if "PREFLIGHT" in variables else ["--no-preflight"]
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT / "tests"),
        "ARRIVED": str(logdir.with_name("arrived")),
        **variables,
    }
    return subprocess.Popen(
        ["sh", "-c", shell, "sh", sys.executable, "-c", COMMAND, *run, *schedule, *preflight, *sizes, *more],
        cwd=ROOT,
        env=environment,
        stdout=output,
        stderr=subprocess.PIPE if output is subprocess.PIPE else output,
        text=True,
        errors="replace",
    )


def arrived(process: "subprocess.Popen[str]", logdir: Path) -> int:
    """Waits until the run has come to where it stays. The id of the process that is there: the trainer's or a
    worker's."""
    path = logdir.with_name("arrived")
    while not path.exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    return int(path.read_text(encoding="ascii"))


def is_running(process: int) -> bool:
    """Whether there is such a process that has not ended: not a zombie that nobody has waited for."""
    try:
        return Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
