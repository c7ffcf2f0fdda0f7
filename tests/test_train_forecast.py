"""What a run says of its needs: memory and disk before it trains, time after the first train steps."""

import collections
import dataclasses
import types
from typing import Any

import pytest
import train_fakes
from train_fakes import FakeLearner
from train_runs import Make, run_quietly

from dreamer_spec.envs import translate
from dreamer_spec.options import assemble_options
from dreamer_spec.training import forecast, loop
from dreamer_spec.training.state import Counters

Usage = collections.namedtuple("Usage", "total used free")


@pytest.mark.parametrize("deter", ["bfloat16", "float32"])
@pytest.mark.parametrize("env", ["Counting", "Maze"])
def test_the_bytes_of_a_record_are_those_of_the_buffer(make: Make, env: str, deter: str) -> None:
    options = make(task=f"train_fakes:{env}", replay_deter=deter, image_size=16)
    state = run_quietly(options)
    stored = state.replay.replay.storage.store.shape.layout.record_bytes
    assert forecast.record_bytes(state.envs.spaces, options) == stored


def said(
    monkeypatch: pytest.MonkeyPatch, make: Make, memory: int | None, free: int, parameters: int = 10**6, **given: Any
) -> list[str]:
    monkeypatch.setattr(forecast, "machine_memory", lambda: memory)
    monkeypatch.setattr(forecast.shutil, "disk_usage", lambda path: Usage(0, 0, free))
    spaces = translate(train_fakes.Counting.observation_space, train_fakes.Counting.action_space).spaces
    lines: list[str] = []
    forecast.say_memory(make(**given), spaces, parameters, lines.append)
    return lines


def test_a_run_says_what_it_needs(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = said(monkeypatch, make, 2**40, 2**40)
    for words in ("19.1 MiB", "1,000,000 parameters", "60 records", "replay buffer"):
        assert words in line
    assert "500 records" in said(monkeypatch, make, None, 2**40, steps=10**6)[0], "its capacity"
    assert "30 records" in said(monkeypatch, make, None, 2**40, action_repeat=2)[0]


def test_too_little_memory_or_disk_is_a_warning_that_names_the_remedy(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, warning = said(monkeypatch, make, 1200, 2**40, parameters=10)
    for words in ("WARNING", "1.17 KiB", "--size", "--replay-memory"):
        assert words in warning
    _, warning = said(monkeypatch, make, 2**40, 100)
    for words in ("WARNING", "100 bytes", "--logdir", "--replay-capacity"):
        assert words in warning


def fake_run(**counters: int) -> Any:
    lines: list[str] = []
    run = types.SimpleNamespace(
        warm=True,
        counters=Counters(**counters),
        options=types.SimpleNamespace(steps=100_000, action_repeat=2),
        display=types.SimpleNamespace(say=lines.append),
        said=lines,
    )
    run.step = 0
    return run


def test_the_time_is_measured_on_the_steps_that_follow_the_first_and_said_once() -> None:
    now = 100.0
    run, timer = fake_run(records=1000, train_steps=1), forecast.TimeForecast(lambda: now)
    run.warm = False
    timer.attend(run)
    run.warm = True
    timer.attend(run)  # The measurement begins: what came before, with its compilation, does not count.
    for _ in range(3):
        now += 5
        run.counters = dataclasses.replace(
            run.counters, records=run.counters.records + 50, train_steps=run.counters.train_steps + 5
        )
        run.step = 2 * run.counters.records
        timer.attend(run)
    assert run.said == ["at 20 steps/s the 97,800 steps that are left of 100,000 take 1 h 21 min, without evaluations"]


def test_an_evaluation_and_train_steps_that_are_due_do_not_spoil_it() -> None:
    now = 0.0
    run, timer = fake_run(records=1000, train_steps=1), forecast.TimeForecast(lambda: now)
    timer.attend(run)
    now, run.counters = 1000.0, Counters(records=1001, train_steps=20, evaluations=1)
    timer.attend(run)
    assert not run.said
    now, run.counters = 2000.0, Counters(records=2001, train_steps=20, evaluations=1, due=30)
    timer.attend(run)
    assert not run.said
    now, run.counters = 3000.0, Counters(records=3001, train_steps=50, evaluations=1)
    timer.attend(run)
    assert run.said[0].startswith("at 2 steps/s")


def test_days_are_a_warning() -> None:
    assert len(list(forecast.lines(1_000_000, 1_000_000, 100.0))) == 1
    line, warning = forecast.lines(1_000_000, 1_000_000, 1.0)
    assert "277 h 46 min" in line
    for words in ("WARNING", "11.6 days", "--preset laptop", "--replay-ratio"):
        assert words in warning


def test_a_run_forecasts(make: Make, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(forecast, "LONG_ENOUGH", 0.0)
    loop.run(make(steps=200, replay_ratio=32), FakeLearner)
    lines = capsys.readouterr().out.splitlines()
    assert sum("in the replay buffer" in line for line in lines) == 1
    assert sum("steps that are left of 200 take" in line for line in lines) == 1


def test_the_preset_for_a_laptop_needs_a_task_and_takes_any() -> None:
    options = assemble_options("torch", {"task": "my_module:make_env"}, {}, "laptop")
    assert (options.task, options.steps) == ("my_module:make_env", 100_000)
    assert options.config.replay_capacity >= options.steps, "nothing is forgotten"
