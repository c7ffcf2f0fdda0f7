"""Real runs, killed with SIGKILL at random moments and started again: in the end everything is bit for bit as if
nothing had happened."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file

from dreamer_spec.disk import checkpoint
from dreamer_spec.replay import Replay

ROOT = Path(__file__).parent.parent
STEPS, CAPACITY = 320, 200
SMALL = {
    **{"deter": 16, "units": 8, "stoch": 4, "classes": 4, "bins": 15, "envs": 2},
    **{"batch_size": 2, "batch_length": 8, "imagination_horizon": 3},
}
OF_TIME = ("seconds", "speed/", "time/", "memory/")  # metrics that say how long something took

pytestmark = pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGKILL")


def command(backend: str, logdir: Path, *more: str) -> list[str]:
    sizes = [word for name, value in SMALL.items() for word in (f"--{name.replace('_', '-')}", str(value))]
    run = f"--task gym:CartPole-v1 --steps {STEPS} --seed 3 --no-preflight --device cpu --replay-ratio 5"
    schedule = f"--log-every 0 --eval-every 200 --eval-episodes 2 --random-episodes 2 --replay-capacity {CAPACITY}"
    python = [sys.executable, "-m", "dreamer_spec", "--backend", backend, "--logdir", str(logdir)]
    return [*python, *run.split(), *schedule.split(), *sizes, *more]


def start(call: list[str], output: Path) -> "subprocess.Popen[bytes]":
    with output.open("ab") as file:
        return subprocess.Popen(call, cwd=ROOT, stdout=file, stderr=subprocess.STDOUT)


def finish(call: list[str], output: Path) -> None:
    assert start(call, output).wait() == 0, output.read_text()


def metrics(logdir: Path) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in (logdir / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if not name.startswith(OF_TIME)} for line in lines]


def assert_same_run(logdir: Path, other: Path) -> None:
    """Parameters, moments, records of the moment, carries, the batch drawn ahead, the whole buffer, counters and every
    line of metrics."""
    runs = [checkpoint.open_checkpoint(path) for path in (logdir, other)]
    for name in ("learner.safetensors", "loop.safetensors"):
        first, second = (load_file(run.path / name) for run in runs)
        assert first.keys() == second.keys()
        assert [key for key in first if first[key].tobytes() != second[key].tobytes()] == []
    for name in ("replay_ratio", "returns", "evaluation", "random_return", "environments", "metrics"):
        assert runs[0].info[name] == runs[1].info[name], name
    counters = [{name: value for name, value in run.info["counters"].items() if name != "seconds"} for run in runs]
    assert counters[0] == counters[1]
    assert metrics(logdir) == metrics(other)
    states = []
    for run, path in zip(runs, (logdir, other), strict=True):
        capacity, length, classes = CAPACITY, SMALL["batch_length"], SMALL["classes"]
        replay = Replay.restore(
            path / "replay", run.info["replay"], capacity, length, continue_streams=True, classes=classes
        )
        assert replay.warnings == []
        states.append(
            replay.state_dict()
            | {"queue": np.array(replay.items.queue), "workers": np.array(list(replay.current.items()))}
        )
    for key, array in states[0].items():
        np.testing.assert_array_equal(array, states[1][key], err_msg=key)


def kill_and_resume(backend: str, kills: int, folder: Path, seed: int) -> int:
    """Kills a run that often, lets it end, and compares. Returns how often it went on from a checkpoint."""
    folder.mkdir(exist_ok=True)
    whole, broken = folder / "whole", folder / "broken"
    began = time.monotonic()
    finish(command(backend, whole, "--checkpoint-every", "1e9"), folder / "whole.txt")
    lasts = time.monotonic() - began
    rng, output = random.Random(seed), folder / "broken.txt"
    call = command(backend, broken, "--checkpoint-every", "0.1")
    for _ in range(kills):
        process = start(call, output)
        try:
            process.wait(rng.uniform(0.1, 1.1) * lasts)
        except subprocess.TimeoutExpired:
            process.kill()
        assert process.wait() in (0, -signal.SIGKILL), output.read_text()
    finish(call, output)
    assert_same_run(whole, broken)
    return output.read_text().count("continuing at step")


@pytest.mark.covers("LOOP-21", "LOOP-22", "LOOP-23", "REP-29", "REP-33")
@pytest.mark.parametrize("backend", ["jax", "torch"])
def test_a_killed_run_continues_bit_by_bit(backend: str, tmp_path: Path) -> None:
    assert kill_and_resume(backend, 2, tmp_path, seed=0) > 0


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["jax", "torch"])
def test_many_killed_runs_continue_bit_by_bit(backend: str, tmp_path: Path) -> None:
    resumed = 0
    for run in range(10):
        resumed += kill_and_resume(backend, 10, tmp_path / str(run), seed=run + 1)
        shutil.rmtree(tmp_path / str(run))
        print(
            (
                f"{backend}: {run + 1} runs, {10 * (run + 1)} kills, {resumed} times continued "
                f"from a checkpoint, all equal bit by bit"
            ),
            flush=True,
        )
    assert resumed > 50


HANG_UP = """
import os, pty, signal, sys
log, size, *call = sys.argv[1:]
child, terminal = pty.fork()
if not child:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # Under nohup it would be ignored.
    os.execv(call[0], call)
while not os.path.exists(log) or os.stat(log).st_size < int(size):
    os.read(terminal, 4096)
os.close(terminal)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


def test_a_closed_terminal_saves_and_leaves(tmp_path: Path) -> None:
    """As when a connection is lost: the signal comes from the system, and nothing can be written to the terminal any
    more."""
    call, output = command("torch", tmp_path / "run", "--checkpoint-every", "1e9"), tmp_path / "output.txt"
    log = tmp_path / "run" / "metrics.jsonl"
    assert start([sys.executable, "-c", HANG_UP, str(log), "10000", *call], output).wait() == 130, output.read_text()
    finish(call, output)
    assert "continuing at step" in output.read_text()
    finish(command("torch", tmp_path / "whole", "--checkpoint-every", "1e9"), tmp_path / "whole.txt")
    assert_same_run(tmp_path / "run", tmp_path / "whole")


def test_a_signal_saves_and_leaves(tmp_path: Path) -> None:
    call, output, log = (
        command("torch", tmp_path / "run", "--checkpoint-every", "1e9"),
        tmp_path / "output.txt",
        tmp_path / "run" / "metrics.jsonl",
    )
    for number, size in ((signal.SIGTERM, 10_000), (signal.SIGINT, 50_000)):
        process = start(call, output)
        while not log.exists() or log.stat().st_size < size:
            assert process.poll() is None, output.read_text()
            time.sleep(0.02)
        process.send_signal(number)
        assert process.wait() == 130
        assert "the same command continues from here" in output.read_text()
    finish(call, output)
    finish(command("torch", tmp_path / "whole", "--checkpoint-every", "1e9"), tmp_path / "whole.txt")
    assert output.read_text().count("continuing at step") == 2
    assert_same_run(tmp_path / "run", tmp_path / "whole")
