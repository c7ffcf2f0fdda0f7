"""What surrounds a run: signals, outputs that fail, trainers that are killed, limits of the system. With real
processes."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from train_surroundings import ROOT, arrived, is_running, start

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="signals and /proc of Linux")

INT, TERM, HUP = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
NO, YES = ("--processes", "no"), ("--processes", "yes")
BEFORE = "train: interrupted before training began: there was nothing to save, and nothing is lost\n"


# Signals


@pytest.mark.parametrize(
    ("number", "variables", "options"),
    [
        (INT, {"PREFLIGHT": "loop"}, NO),
        (TERM, {"PREFLIGHT": "loop"}, NO),
        (HUP, {"PREFLIGHT": "loop"}, NO),
        (TERM, {"STUCK": "make:loop"}, NO),
        (TERM, {"STUCK": "make:lock"}, YES),
        (INT, {"STUCK": "reset:sleep"}, NO),
        (TERM, {"STUCK": "step:loop"}, (*NO, "--random-episodes", "1")),
    ],
    ids=["preflight", "preflight", "preflight", "make", "trial", "reset", "random policy"],
)
@pytest.mark.covers("LOOP-48")
def test_a_signal_before_training_ends_it_with_a_word(
    tmp_path: Path, number: signal.Signals, variables: dict[str, str], options: tuple[str, ...]
) -> None:
    task = "Stuck" if "STUCK" in variables else "Counting"
    process = start(task, tmp_path / "run", *options, **variables)
    place = arrived(process, tmp_path / "run")
    process.send_signal(number)
    _, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (130, BEFORE)
    assert not is_running(place)


@pytest.mark.parametrize(
    ("first", "second", "how", "processes"),
    [
        (INT, TERM, "step:loop", NO),
        (INT, INT, "step:loop", NO),
        (TERM, HUP, "step:loop", NO),
        (HUP, TERM, "step:loop", NO),
        (TERM, INT, "step:library", NO),
        (INT, INT, "step:library", NO),
        (INT, TERM, "step:lock", YES),
        (TERM, TERM, "step:lock", YES),
    ],
)
@pytest.mark.covers("LOOP-48")
def test_a_second_signal_ends_the_process_at_once(
    tmp_path: Path, first: signal.Signals, second: signal.Signals, how: str, processes: tuple[str, ...]
) -> None:
    """Of whatever kind, while an environment hangs: in Python, in a library, in a process of its own."""
    process = start("Stuck", tmp_path / "run", *processes, STUCK=how)
    place = arrived(process, tmp_path / "run")
    process.send_signal(first)
    time.sleep(0.3)
    assert process.poll() is None, "the first waits for the environment"
    process.send_signal(second)
    process.communicate(timeout=60)
    assert process.returncode in (-second, 128 + second), "what the system does, or what a shell would call it"
    ends(place)


@pytest.mark.parametrize("number", [INT, TERM])
@pytest.mark.covers("LOOP-48")
def test_an_environment_cannot_keep_the_signals(tmp_path: Path, number: signal.Signals) -> None:
    """Libraries put in handlers of their own, or block signals for their threads."""
    process = start("Grasping", tmp_path / "run", *NO, "--steps", "1000000")
    arrived(process, tmp_path / "run")
    process.send_signal(number)
    out, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (130, "")
    assert "interrupted at step" in out


@pytest.mark.covers("LOOP-48")
def test_two_signals_within_one_call_of_a_library_are_two(tmp_path: Path) -> None:
    """As in a compilation before training."""
    process = start("Counting", tmp_path / "run", *NO, PREFLIGHT="library")
    arrived(process, tmp_path / "run")
    process.send_signal(INT)
    time.sleep(1)
    process.send_signal(INT)
    process.communicate(timeout=60)
    assert process.returncode == 128 + INT


@pytest.mark.covers("LOOP-48")
def test_a_terminal_that_is_closed_twice_is_closed_once(tmp_path: Path) -> None:
    """Shells pass the signal on, and the system sends it again when they are gone: the checkpoint is saved all the
    same."""
    process = start("Evaluated", tmp_path / "run", *NO, "--eval-episodes", "1000")
    arrived(process, tmp_path / "run")
    process.send_signal(HUP)
    process.send_signal(HUP)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "all training is saved" in out


@pytest.mark.parametrize("number", [INT, TERM])
@pytest.mark.covers("LOOP-48")
def test_a_signal_in_the_last_evaluation_ends_with_a_word(tmp_path: Path, number: signal.Signals) -> None:
    logdir = tmp_path / "run"
    process = start("Evaluated", logdir, *NO, "--eval-episodes", "1000")
    arrived(process, logdir)
    process.send_signal(number)
    out, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (130, "")
    line = out.splitlines()[-1]
    assert line.startswith(
        f"interrupted in the last evaluation, all training is saved in {logdir}/checkpoints/000000000060"
    )
    again = start("Counting", logdir, *NO)
    assert again.wait(60) == 2, "another task"


@pytest.mark.parametrize("processes", [NO, YES])
@pytest.mark.covers("LOOP-45", "LOOP-52")
def test_what_an_environment_does_to_its_process_does_not_reach_the_run(
    tmp_path: Path, processes: tuple[str, ...]
) -> None:
    """Its working directory, its outputs, its threads: a relative log directory is found, and no word goes into a file
    of the run."""
    logdir = tmp_path / "run"
    process = start("Unruly", Path(os.path.relpath(logdir, ROOT)), *processes, ARRIVED=str(tmp_path / "arrived"))
    process.communicate(timeout=60)
    assert process.returncode == 0
    assert finished(tmp_path)
    assert b"steps" not in b"".join(path.read_bytes()[:64] for path in (logdir / "replay").iterdir())
    again = start("Unruly", logdir, "--steps", "90", *processes)
    out, error = again.communicate(timeout=60)
    assert again.returncode == 0, out + error


def test_a_working_directory_that_is_removed_does_not_end_a_run(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    process = start(
        "Homeless",
        tmp_path / "run",
        *NO,
        shell=f'cd {tmp_path / "home"}; exec "$@"',
        PYTHONPATH=f"{ROOT}:{ROOT / 'tests'}",
    )
    _, error = process.communicate(timeout=60)
    assert process.returncode == 0, error
    assert finished(tmp_path)


# Workers end with their trainer


def ends(process: int) -> None:
    deadline = time.monotonic() + 30
    while is_running(process):
        assert time.monotonic() < deadline, f"process {process} is still there"
        time.sleep(0.02)


@pytest.mark.parametrize("how", ["make:sleep", "reset:loop", "step:loop", "step:sleep", "step:library", "step:lock"])
@pytest.mark.covers("LOOP-49")
def test_a_worker_ends_with_its_trainer(tmp_path: Path, how: str) -> None:
    """Whatever it is doing when the trainer is killed."""
    process = start("Stuck", tmp_path / "run", *YES, STUCK=how)
    worker = arrived(process, tmp_path / "run")
    assert worker != process.pid
    assert is_running(worker)
    process.kill()
    process.wait(60)
    ends(worker)


# Outputs that fail


def finished(tmp_path: Path) -> bool:
    return (tmp_path / "run" / "checkpoints" / "000000000060").is_dir() and (tmp_path / "run" / "curve.png").exists()


@pytest.mark.parametrize("buffered", ["", "1"])
@pytest.mark.covers("LOOP-45")
def test_a_reader_that_leaves_does_not_end_a_run(tmp_path: Path, buffered: str) -> None:
    """As with `train ... | head -2`. The environment says something at every step, too."""
    process = start("Talking", tmp_path / "run", *NO, PYTHONUNBUFFERED=buffered)
    assert process.stdout
    assert process.stdout.readline()
    process.stdout.close()
    assert process.stderr
    assert (process.stderr.read(), process.wait(60)) == ("", 0)
    assert finished(tmp_path)


@pytest.mark.parametrize("processes", [NO, YES])
@pytest.mark.covers("LOOP-45")
def test_a_full_disk_under_the_output_does_not_end_a_run(tmp_path: Path, processes: tuple[str, ...]) -> None:
    with open("/dev/full", "w") as full:
        assert start("Talking", tmp_path / "run", *processes, output=full).wait(60) == 0
    assert finished(tmp_path)


@pytest.mark.parametrize("redirection", [">&-", "2>&-", "<&- >&- 2>&-"])
@pytest.mark.covers("LOOP-45")
def test_closed_outputs_do_not_end_a_run_and_get_no_files(tmp_path: Path, redirection: str) -> None:
    """The first file that is opened must not become the standard output."""
    process = start("Talking", tmp_path / "run", *YES, shell=f'exec "$@" {redirection}')
    process.communicate(timeout=60)
    assert process.returncode == 0
    assert finished(tmp_path)
    assert all(b"a word" not in path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file())


@pytest.mark.parametrize("processes", [NO, YES])
@pytest.mark.covers("LOOP-45")
def test_characters_that_the_output_cannot_hold_are_escaped(tmp_path: Path, processes: tuple[str, ...]) -> None:
    process = start("Unprintable", tmp_path / "run", *processes, PYTHONIOENCODING="ascii", LC_ALL="C")
    out, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (0, "")
    assert r"the environment raised ValueError: \xb7 \udcff" in out
    assert "WordlessError: (no text: its __str__ raised ValueError)" in out
    assert finished(tmp_path)


@pytest.mark.covers("LOOP-45")
def test_a_terminal_with_a_live_display_that_goes_away_does_not_end_a_run(tmp_path: Path) -> None:
    """Rich draws from a thread of its own."""
    leader, terminal = os.openpty()
    process = start("Talking", tmp_path / "run", *NO, output=terminal, TERM="xterm")
    os.close(terminal)
    os.read(leader, 1)
    os.close(leader)
    assert process.wait(60) == 0
    assert finished(tmp_path)


# Causes stay visible


def test_a_path_that_is_too_long_for_a_socket_is_said(tmp_path: Path) -> None:
    long = tmp_path / ("x" * 108)
    long.mkdir()
    process = start("Counting", tmp_path / "run", *YES, TMPDIR=str(long))
    _, error = process.communicate(timeout=60)
    assert process.returncode == 2
    assert (
        "its process cannot be started: OSError: AF_UNIX path too long; set TMPDIR to a folder with a shorter path"
        in error
    )
    assert error.count("\n") == 1


def test_too_few_file_descriptors_are_said(tmp_path: Path) -> None:
    process = start("Counting", tmp_path / "run", *YES, "--envs", "30", shell='ulimit -n 40; exec "$@"')
    _, error = process.communicate(timeout=60)
    assert process.returncode == 2
    last = error.splitlines()[-1]
    assert (
        "its process cannot be started: OSError: [Errno 24] Too many open files; raise "
        "the limit of open files (ulimit -n)"
    ) in last


# The kit


def kit(*arguments: str, **streams: Any) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "conformance.cli", *arguments]
    return subprocess.Popen(command, cwd=ROOT, text=True, stderr=subprocess.PIPE, **streams)


CHECK = ("check", "numpy", "--only", "symlog", "--examples", "3")


def test_the_kit_says_what_it_can_and_writes_its_files(tmp_path: Path) -> None:
    names = ("json", "markdown", "junit", "html", "badge")
    files = [word for name in names for word in (f"--{name}", str(tmp_path / name))]
    with open("/dev/full", "w") as full:
        process = kit(*CHECK, *files, stdout=full)
        assert (process.communicate()[1], process.returncode) == ("", 0)
    assert all((tmp_path / name).stat().st_size for name in names)
    process = kit("report", str(tmp_path / "json"), "--out", str(tmp_path / "page"), stdout=subprocess.PIPE)
    assert process.stdout
    process.stdout.close()
    assert process.stderr
    assert (process.stderr.read(), process.wait()) == ("", 0)
    assert (tmp_path / "page").stat().st_size


@pytest.mark.parametrize("redirection", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_the_kit_goes_on_where_its_outputs_are_closed(redirection: str) -> None:
    command = ["sh", "-c", f'exec "$@" {redirection}', "sh", sys.executable, "-m", "conformance.cli", *CHECK]
    process = subprocess.run(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert (process.returncode, process.stderr) == (0, "")


HARD = """
import numpy as np

class WordlessError(Exception):
    def __str__(self):
        raise ValueError("no words")

def symlog(x):
    raise ValueError("\\u00b7 \\udcff")

def symexp(x):
    raise WordlessError
"""


def test_the_kit_reports_texts_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(HARD, encoding="utf-8")
    names = ("json", "markdown", "junit", "html", "badge")
    files = [word for name in names for word in (f"--{name}", str(tmp_path / name))]
    arguments = ("check", str(tmp_path / "mine.py"), "--only", "sym", "--examples", "3", "--edition", "paper")
    process = kit(*arguments, *files, stdout=subprocess.PIPE, env={**os.environ, "PYTHONIOENCODING": "ascii"})
    out, error = process.communicate()
    assert (process.returncode, error) == (1, "")
    assert r"ValueError: \xb7 \udcff" in out
    assert all((tmp_path / name).stat().st_size for name in names)


@pytest.mark.parametrize(
    "arguments", [("dreamer_spec", "--help"), ("conformance.cli", "--help"), ("conformance.cli", "new-adapter", "FILE")]
)
def test_output_commands_end_quietly_without_a_reader(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    command = [sys.executable, "-m", *(word.replace("FILE", str(tmp_path / "file.py")) for word in arguments)]
    process = subprocess.Popen(command, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout
    process.stdout.close()
    assert process.stderr
    assert (process.stderr.read(), process.wait()) == ("", 0)
