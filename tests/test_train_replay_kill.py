"""A process that is killed at any moment leaves a buffer that comes back as it was at the last save."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from replay_machine import latents, record

from dreamer_spec.replay import Replay

CAPACITY, LENGTH, WORKERS = 200, 5, 3
SIZES = {"chunk_records": 16, "block_records": 8}


def steps(replay: Replay, directory: Path, start: int, stop: int) -> None:
    """Records, train steps and saves number start .. stop - 1: what step n does follows from n and from what the buffer
    holds."""
    for n in range(start, stop):
        rng = np.random.default_rng(n)
        for worker in range(WORKERS):
            replay.add(record(rng, n), worker)
        if len(replay):
            ids = replay.sample(rng.random(4))["ids"]
            replay.write_back(ids, latents(rng, (4, LENGTH)))
        if n % 7 == 0:
            save(replay, directory, n)


def save(replay: Replay, directory: Path, n: int) -> None:
    checkpoint, temporary = directory / f"{n:06d}.json", directory / "new.tmp"
    temporary.write_text(json.dumps(replay.save(str(n))))
    temporary.rename(checkpoint)
    kept = sorted(directory.glob("*.json"))[-2:]
    for other in set(directory.glob("*.json")) - set(kept):
        other.unlink()
    replay.keep([str(int(path.stem)) for path in kept])


def resumed(directory: Path) -> tuple[Replay, int]:
    newest = max(directory.glob("*.json"))
    replay = Replay.restore(
        directory / "replay", json.loads(newest.read_text()), CAPACITY, LENGTH, continue_streams=True
    )
    for other in directory.glob("*.json"):
        assert other <= newest
    return replay, int(newest.stem) + 1


def child(directory: Path) -> None:
    if list(directory.glob("*.json")):
        replay, start = resumed(directory)
        assert not replay.warnings, replay.warnings
    else:
        replay, start = Replay(CAPACITY, LENGTH, directory / "replay", **SIZES), 0
        save(replay, directory, 0)
        start = 1
    print("started", flush=True)
    steps(replay, directory, start, 10**9)


def compare_after_kills(directory: Path, kills: int) -> None:
    directory.mkdir()
    chance = random.Random(0)
    for _ in range(kills):
        command = [sys.executable, __file__, str(directory)]
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        ) as process:
            assert process.stdout
            assert process.stdout.readline() == "started\n"
            time.sleep(chance.uniform(0, 0.3))
            process.send_signal(signal.SIGKILL)
    replay, end = resumed(directory)
    assert replay.warnings == []
    uninterrupted = Replay(CAPACITY, LENGTH, directory / "other", **SIZES)
    (directory / "saves").mkdir()
    save(uninterrupted, directory / "saves", 0)
    steps(uninterrupted, directory / "saves", 1, end)
    expected, actual = uninterrupted.state_dict(), replay.state_dict()
    assert actual.keys() == expected.keys()
    for key in expected:
        np.testing.assert_array_equal(actual[key], expected[key], err_msg=key)
    uniform = np.random.default_rng(0).random(50)
    drawn, wanted = replay.sample(uniform), uninterrupted.sample(uniform)
    assert all(np.array_equal(drawn[key], wanted[key]) for key in wanted)


@pytest.mark.covers("REP-29")
def test_killed_at_random_moments(tmp_path: Path) -> None:
    compare_after_kills(tmp_path / "run", 4)


@pytest.mark.slow
def test_killed_at_many_random_moments(tmp_path: Path) -> None:
    compare_after_kills(tmp_path / "run", 100)


if __name__ == "__main__":
    child(Path(sys.argv[1]))
