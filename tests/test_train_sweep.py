"""`train sweep`: what a file describes, who runs it, and what is not run twice."""

import contextlib
import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from dreamer_spec.cli import main
from dreamer_spec.commands.sweep import _last_words
from dreamer_spec.disk.logdir import hold
from dreamer_spec.errors import UserError
from dreamer_spec.sweeping import progress, runner
from dreamer_spec.sweeping.places import Processes
from dreamer_spec.sweeping.plan import Plan, make_plan, read_plan
from dreamer_spec.sweeping.runner import Sweep, log_of
from dreamer_spec.system.signals import Signals

SMALL = {"preset": "cartpole", "steps": 300, "preflight": False, "random_episodes": 1, "eval_episodes": 1}
CONTENT: dict[str, Any] = {
    "logdir": "runs/a",
    "jobs": 2,
    "options": {**SMALL, "env_arg": {"sutton_barto_reward": True}},
    "vary": {"backend": ["jax", "torch"], "task": ["gym:CartPole-v1"], "seed": "0-1", "learning_rate": [1e-3, 1e-4]},
}


@pytest.fixture(autouse=True)
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "POLL", 0.01)


# What a file describes


def test_every_combination_is_a_run() -> None:
    plan = make_plan(CONTENT)
    assert (plan.logdir, plan.jobs, len(plan.items), plan.ray) == (Path("runs/a"), 2, 8, None)
    item = plan.items[5]
    assert item.name == "CartPole-v1-torch-seed0-learning_rate=0.0001"
    assert (item.options.backend, item.options.seed, item.options.config.learning_rate) == ("torch", 0, 1e-4)
    assert (item.options.steps, item.options.preflight) == (300, False)
    assert item.options.env_arg == {"sutton_barto_reward": True}
    assert item.options.logdir == Path("runs/a") / item.name
    assert "--no-preflight" in item.command
    assert item.command[-2:] == ("--logdir", str(item.options.logdir))
    assert {item.options.seed for item in plan.items} == {0, 1}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"vari": {}}, ["unknown key 'vari'", "did you mean vary?"]),
        ({"jobs": 0}, ["jobs is 0", "at least 1"]),
        ({"options": 3}, ["options is 3", "[options]"]),
        ({"vary": {"seed": 3}}, ["vary.seed is 3", "a list of values"]),
        ({"vary": {"seed": "3-1"}}, ["vary.seed", "0-4"]),
        ({"vary": {"backend": ["jax"], "seed": []}}, ["vary.seed is []"]),
        ({"vary": {"backend": ["jax"], "steps": [5]}}, ["steps", "[options] and in [vary]"]),
        ({"vary": {"backend": ["jax"], "logdir": ["a"]}}, ["logdir", "the sweep's own"]),
        ({"vary": {"backend": ["jax"], "learning_rat": [1]}}, ["learning_rat", "did you mean learning_rate?"]),
        ({"vary": {"backend": ["jax"], "learning_rate": ["x"]}}, ["learning_rate is 'x'"]),
        ({"vary": {"task": ["gym:A-v0"]}}, ["no backend"]),
        ({"vary": {"backend": ["jax", "jax"]}}, ["2 runs have the name"]),
        ({"vary": {"backend": ["jax"], "learning-rate": [1]}}, ["learning-rate", "did you mean learning_rate?"]),
        ({"vary": {"backend": ["jax"], "learning_rate": [-1e-5]}}, ["learning_rate is -1e-05", "0 or more"]),
        ({"vary": {"backend": ["jax"], "task": ["gym:A\0-v0"]}}, ["gym:A\\x00-v0", "the character 0"]),
        ({"vary": {"backend": ["jax"], "task": ["gym:" + "a" * 300]}}, ["the name aaa", "at most 200 bytes"]),
        ({"vary": {"backend": ["jax"], "learning_rate": [1] * 200, "seed": "0-99"}}, ["20,000", "at most 10,000"]),
        ({"logdir": 3}, ["logdir is 3", "the name of a folder"]),
        ({"logdir": ""}, ["logdir is ''", "the name of a folder"]),
    ],
)
def test_what_is_wrong_in_a_file_is_named(tmp_path: Path, change: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(UserError) as error:
        make_plan({**CONTENT, **change})
    assert all(word in str(error.value) for word in words), error.value


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text("a = ")
    for name in ("bad.toml", "missing.toml"):
        with pytest.raises(UserError, match=name):
            read_plan(tmp_path / name)


def test_a_dry_run_prints_commands_and_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "a.toml"
    file.write_text('[options]\nbackend = "jax"\ntask = "gym:A-v0"\n[vary]\nseed = [4]\n')
    assert main(["sweep", str(file), "--dry-run", "--logdir", str(tmp_path / "runs")]) == 0
    line = f"train --backend jax --task gym:A-v0 --seed 4 --logdir {tmp_path / 'runs' / 'A-v0-jax-seed4'}"
    assert capsys.readouterr().out.strip() == line
    assert not (tmp_path / "runs").exists()


# Who runs it


class Scripted:
    """A place whose runs end with the codes that it is given, after two looks. started: the seeds, in order."""

    def __init__(self, codes: dict[int, int]) -> None:
        self._codes, self.started, self.most = codes, list[int](), 0
        self._left: dict[int, int] = {}

    def start(self, command: Sequence[str], log: Path) -> int:
        seed = int(command[command.index("--seed") + 1])
        self.started.append(seed)
        self._left[seed] = 2
        self.most = max(self.most, len(self._left))
        return seed

    def code(self, handle: int) -> int | None:
        self._left[handle] -= 1
        if self._left[handle]:
            return None
        del self._left[handle]
        return self._codes.get(handle, 0)

    def end(self, handle: int) -> None:
        self._codes[handle], self._left[handle] = 130, 1


def plan_in(folder: Path, seeds: str = "0-4", jobs: int = 2, **options: Any) -> Plan:
    vary = {"backend": ["torch"], "seed": seeds}
    return make_plan({"logdir": str(folder), "jobs": jobs, "options": {**SMALL, **options}, "vary": vary})


def run(sweep: Sweep, signals: Signals | None = None) -> int:
    return sweep.run(signals or Signals(), lambda states: None)


def test_some_run_at_once_and_what_has_ended_is_not_run_again(tmp_path: Path) -> None:
    place = Scripted({1: 2})
    sweep = Sweep(plan_in(tmp_path), place)
    assert run(sweep) == 2
    assert (place.started, place.most) == ([0, 1, 2, 3, 4], 2)
    assert [state.phase for state in sweep.states] == ["done", "failed", "done", "done", "done"]
    again = Scripted({})
    assert run(Sweep(plan_in(tmp_path), again)) == 0
    assert again.started == [1]
    changed = Scripted({})
    assert run(Sweep(plan_in(tmp_path, learning_rate=1e-5), changed)) == 0
    assert changed.started == [0, 1, 2, 3, 4], "other options are other runs"


def test_a_signal_ends_the_runs_and_the_next_sweep_continues(tmp_path: Path) -> None:
    place, signals = Scripted({}), Signals()
    sweep = Sweep(plan_in(tmp_path), place)
    looks: Iterator[int] = iter(range(100))

    def show(states: Any) -> None:
        if next(looks) == 2:
            signals.received.append(int(signal.SIGTERM))

    assert sweep.run(signals, show) == 130
    phases = [state.phase for state in sweep.states]
    assert "stopped" in phases
    assert "waiting" in phases
    left = Scripted({})
    assert run(Sweep(plan_in(tmp_path), left)) == 0
    assert left.started == [seed for seed, phase in enumerate(phases) if phase != "done"]


def test_a_damaged_note_is_named(tmp_path: Path) -> None:
    (tmp_path / "sweep.json").write_text('{"format": 1, "ended": {"a": 3}}')
    with pytest.raises(UserError, match=r"sweep\.json"):
        Sweep(plan_in(tmp_path), Scripted({}))


def test_progress_is_a_line_for_every_change_where_nobody_can_see_a_table(tmp_path: Path) -> None:
    with open(tmp_path / "said", "w+") as file:
        with progress.shown(Console(file=file)) as show:
            Sweep(plan_in(tmp_path / "a", "0"), Scripted({})).run(Signals(), show)
        file.seek(0)
        assert [line.partition(": ")[2].strip() for line in file] == ["running", "done, no episode"]
    logdir = plan_in(tmp_path / "a", "0").items[0].options.logdir
    logdir.mkdir()
    lines = [{"step": 10, "episode/return": 3.0}, {"step": 20}]
    (logdir / "metrics.jsonl").write_text("\n".join(map(json.dumps, lines)) + '\n{"step')
    assert progress.newest(logdir) == (20, 3.0)


def test_runs_end_with_a_checkpoint_when_their_sweep_dies(tmp_path: Path) -> None:
    """SIGKILL, which nothing can answer: the pipe to the run closes all the same."""
    file = tmp_path / "a.toml"
    options = "".join(f"{name} = {json.dumps(value)}\n" for name, value in {**SMALL, "steps": 100_000}.items())
    file.write_text(f'logdir = "{tmp_path / "runs"}"\n[options]\n{options}[vary]\nbackend = ["torch"]\nseed = [0]\n')
    sweep = subprocess.Popen([sys.executable, "-m", "dreamer_spec", "sweep", str(file)], stdout=subprocess.DEVNULL)
    plan = read_plan(file)
    item = plan.items[0]
    _wait(lambda: progress.newest(item.options.logdir)[0] > 0, "the run has begun")
    sweep.kill()
    sweep.wait()
    _wait(lambda: (item.options.logdir / "checkpoints").is_dir(), "it has saved")
    log = log_of(plan, item)
    _wait(lambda: "the same command continues from here" in log.read_text(), "it has ended")


def _wait(condition: Any, what: str, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"{what}: not within {seconds} s"
        time.sleep(0.05)


def test_a_run_waits_for_the_one_before_it_which_still_saves(tmp_path: Path) -> None:
    plan = plan_in(tmp_path, "0")
    item, log, place = plan.items[0], tmp_path / "log", Processes(1)
    with contextlib.ExitStack() as stack:
        hold(item.options.logdir, stack)
        handle = place.start(item.command, log)
        _wait(lambda: "waits for another process" in log.read_text(), "it says that it waits")
        assert place.code(handle) is None
    _wait(lambda: place.code(handle) is not None, "it has ended")
    assert handle.returncode == 0, log.read_text()


def test_a_folder_that_another_sweep_uses_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "a.toml"
    file.write_text('[options]\nbackend = "torch"\n')
    with contextlib.ExitStack() as stack:
        hold(tmp_path / "runs", stack)
        assert main(["sweep", str(file), "--logdir", str(tmp_path / "runs")]) == 2
    assert "another process" in capsys.readouterr().err
    assert not (tmp_path / "runs" / "logs").exists()


def test_a_disk_that_refuses_the_note_ends_the_runs_under_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path) -> Any:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    place = Scripted({})
    sweep = Sweep(plan_in(tmp_path, "0-4", jobs=3), place)
    monkeypatch.setattr(runner, "replacing", full)
    with pytest.raises(UserError, match=r"sweep\.json: No space left"):
        run(sweep)
    assert "running" not in [state.phase for state in sweep.states]


def test_a_log_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    before = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    with pytest.raises(UserError, match="cannot write"):
        Processes(1).start((), tmp_path / "missing" / "log")
    assert before is None or os.sched_getaffinity(0) == before


def test_a_table_fits_into_a_narrow_terminal(tmp_path: Path) -> None:
    states = Sweep(plan_in(tmp_path, "0-49"), Scripted({})).states
    with open(tmp_path / "said", "w+") as file:
        Console(file=file, width=40, force_terminal=True).print(progress.table(states))
        file.seek(0)
        lines = file.read().splitlines()
    assert all(len(re.sub(r"\x1b\[[0-9;]*m", "", line)) <= 40 for line in lines)


def test_a_run_without_a_log_said_nothing(tmp_path: Path) -> None:
    assert _last_words(tmp_path / "log").startswith("it said nothing")
    (tmp_path / "log").write_bytes(b"first\n" * 20_000 + b"\xfflast\n\n")
    assert _last_words(tmp_path / "log").startswith("\ufffdlast (")


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system gives no process its cores")
def test_runs_share_the_cores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dreamer_spec.sweeping.places.RUN", ("-c", "import os, sys; print(os.sched_getaffinity(0))"))
    before = os.sched_getaffinity(0)
    place = Processes(len(before))
    runs = [place.start((), tmp_path / str(job)) for job in range(len(before))]
    _wait(lambda: all(place.code(run) == 0 for run in runs), "all have ended")
    shares = [set(eval((tmp_path / str(job)).read_text())) for job in range(len(before))]
    assert all(len(share) == 1 for share in shares)
    assert set().union(*shares) == before == os.sched_getaffinity(0)
