"""`train sweep` with `[ray]`: a real Ray on this machine, whose workers and driver are ended in every way."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from dreamer_spec.errors import UserError
from dreamer_spec.sweeping import places
from dreamer_spec.sweeping.plan import Plan, read_plan
from dreamer_spec.sweeping.progress import newest
from dreamer_spec.sweeping.runner import log_of

ray: Any = pytest.importorskip("ray", reason="needs the extra ray")
pytestmark = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="finds the workers of Ray in /proc")

SMALL = {"preset": "cartpole", "steps": 100_000, "preflight": False, "random_episodes": 1, "eval_episodes": 1}
SAVED = "the same command continues from here"
MACHINE = {"RAY_AUTH_MODE": "disabled", "RAY_USAGE_STATS_ENABLED": "0", "OMP_NUM_THREADS": "1"}


class Driver:
    """A sweep of one run, in a process group of its own as in a terminal."""

    def __init__(self, folder: Path, steps: int = SMALL["steps"]) -> None:  # type: ignore[assignment]
        file = folder / "a.toml"
        options = "".join(f"{name} = {json.dumps(value)}\n" for name, value in {**SMALL, "steps": steps}.items())
        file.write_text(
            f'logdir = "{folder / "runs"}"\n[options]\n{options}[vary]\nbackend = ["torch"]\nseed = [0]\n'
            "[ray]\nnum_cpus = 1\n"
        )
        self.plan: Plan = read_plan(file)
        self.item = self.plan.items[0]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "dreamer_spec", "sweep", str(file)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, **MACHINE},
            start_new_session=True,
        )

    def said(self) -> str:
        """What the run said."""
        log = log_of(self.plan, self.item)
        return log.read_text() if log.exists() else ""

    def is_training(self) -> bool:
        return newest(self.item.options.logdir)[0] > 0

    def has_saved(self) -> bool:
        return (self.item.options.logdir / "checkpoints").is_dir() and SAVED in self.said()

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()


@pytest.fixture
def drivers() -> Iterator[Callable[..., Driver]]:
    started: list[Driver] = []

    def start(*arguments: Any) -> Driver:
        started.append(Driver(*arguments))
        return started[-1]

    yield start
    for driver in started:
        driver.end()


def wait_for(condition: Callable[[], bool], what: str, driver: Driver, seconds: float = 180.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"{what}: not within {seconds} s; the run said: {driver.said()[-2000:]}"
        time.sleep(0.1)


def worker_of(driver: Driver) -> int:
    """The process of Ray that has started the run."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_bytes().decode().split("\0")
            status = (folder / "status").read_text()
        except OSError:
            continue
        if places.APART in words and str(driver.item.options.logdir) in words:
            return int(status.partition("PPid:")[2].split()[0])
    raise AssertionError("no worker")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_stopping_a_sweep_ends_its_runs_with_a_checkpoint(
    tmp_path: Path, drivers: Callable[..., Driver], number: signal.Signals
) -> None:
    driver = drivers(tmp_path)
    wait_for(driver.is_training, "the run has begun", driver)
    if number == signal.SIGINT:
        os.killpg(driver.process.pid, number)  # as a terminal does, which knows nothing of drivers
    else:
        driver.process.send_signal(number)
    said, _ = driver.process.communicate(timeout=120)
    assert driver.process.returncode == 130, said
    assert driver.has_saved(), "the driver waits until it is written"
    assert "stopped" in said
    assert "the same command continues" in said


def test_a_run_ends_with_a_checkpoint_when_the_driver_dies(tmp_path: Path, drivers: Callable[..., Driver]) -> None:
    driver = drivers(tmp_path)
    wait_for(driver.is_training, "the run has begun", driver)
    driver.process.kill()
    wait_for(driver.has_saved, "it has saved", driver)


def test_a_run_whose_worker_is_killed_goes_on_from_its_checkpoint(
    tmp_path: Path, drivers: Callable[..., Driver]
) -> None:
    driver = drivers(tmp_path)
    wait_for(driver.is_training, "the run has begun", driver)
    os.kill(worker_of(driver), signal.SIGKILL)
    wait_for(driver.has_saved, "it has saved", driver)
    before = newest(driver.item.options.logdir)[0]
    wait_for(lambda: newest(driver.item.options.logdir)[0] > before, "it goes on", driver)
    assert "another process is training" not in driver.said()
    assert "continu" in driver.said().rpartition(SAVED)[2]
    driver.process.send_signal(signal.SIGTERM)
    said, _ = driver.process.communicate(timeout=120)
    assert driver.process.returncode == 130, said


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch) -> Iterator[places.Ray]:
    for name, value in MACHINE.items():
        monkeypatch.setenv(name, value)
    yield places.Ray({"num_cpus": 1})
    ray.shutdown()


def code_of(place: places.Ray, task: places.Task) -> int:
    end = time.monotonic() + 120
    while (code := place.code(task)) is None:
        assert time.monotonic() < end
        time.sleep(0.05)
    return code


def test_a_worker_is_replaced_a_few_times_and_a_task_that_waits_can_be_ended(place: places.Ray, tmp_path: Path) -> None:
    def dies(command: list[str], folder: str, log: str) -> int:
        os.kill(os.getpid(), signal.SIGKILL)
        return 0

    def raises(command: list[str], folder: str, log: str) -> int:
        raise OSError("no such disk")

    place._run = ray.remote(dies).options(max_retries=0)
    task = place.start([], tmp_path / "dies")
    assert (code_of(place, task), task.starts) == (1, places.MOST_STARTS)
    assert f"after {places.MOST_STARTS} starts" in (tmp_path / "dies").read_text()

    place._run = ray.remote(raises).options(max_retries=0)
    task = place.start([], tmp_path / "raises")
    assert (code_of(place, task), task.starts) == (1, 1), "what another worker would not do better"
    assert "no such disk" in (tmp_path / "raises").read_text()

    place._run = ray.remote(places.run_to_its_end).options(max_retries=0, num_cpus=10_000)
    task = place.start([], tmp_path / "waits")
    assert place.code(task) is None
    place.end(task)
    assert code_of(place, task) == 130


def test_what_ray_does_not_take_is_named() -> None:
    with pytest.raises(UserError, match="num_gpuss"):
        places.Ray({"num_gpuss": 1})
