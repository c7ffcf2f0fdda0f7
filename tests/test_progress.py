"""What a long command says while it works, on standard error."""

import io
import threading
from pathlib import Path

import pytest
from adapters import CHECKS
from report_data import ADAPTER

from conformance import progress as module
from conformance.cli import main
from conformance.progress import PERIOD, Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def screen(written: str) -> str:
    """What a terminal shows of one line."""
    shown = ""
    for part in written.split("\r"):
        shown = part + shown[len(part) :]
    return shown.rstrip()


def test_a_terminal_shows_one_line_that_is_overwritten_and_erased() -> None:
    stream = Terminal()
    names = ("returns.lambda_return_matches", "layers.silu_literals")
    with Progress(stream) as progress:
        shown = [
            (check.name, screen(stream.getvalue()))
            for check in progress.over("checks", [CHECKS[name] for name in names])
        ]
    assert shown == [(name, f"checks {number}/2: {name}") for number, name in enumerate(names, 1)]
    assert "\n" not in stream.getvalue()
    assert stream.getvalue().endswith("\r")
    assert screen(stream.getvalue()) == ""


def test_a_line_fits_into_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "12")
    stream = Terminal()
    Progress(stream).say("checks 1/2: returns.lambda_return_matches")
    assert screen(stream.getvalue()) == "checks 1/2:"


def test_elsewhere_there_is_a_line_at_most_every_period() -> None:
    stream, clock = io.StringIO(), Clock()
    progress = Progress(stream, clock)
    progress.show()
    progress.say("checks 1/3: a")
    assert stream.getvalue() == "", "what is soon over leaves no trace"
    clock.now += PERIOD
    progress.say("checks 2/3: b")
    progress.say("checks 3/3: c")
    assert stream.getvalue() == "checks 2/3: b\n"
    clock.now += PERIOD - 1
    progress.show()
    assert stream.getvalue() == "checks 2/3: b\n"
    clock.now += 1
    progress.show()
    assert stream.getvalue() == "checks 2/3: b\nchecks 3/3: c\n"


def test_nothing_is_said_before_there_is_something_to_say() -> None:
    stream, clock = io.StringIO(), Clock()
    progress = Progress(stream, clock)
    clock.now += PERIOD
    progress.show()
    assert stream.getvalue() == ""


def test_a_step_that_takes_long_is_said_again(monkeypatch: pytest.MonkeyPatch) -> None:
    class Stream(io.StringIO):
        is_said_again = threading.Event()

        def write(self, text: str) -> int:
            clock.now += PERIOD
            if self.getvalue():
                self.is_said_again.set()
            return super().write(text)

    monkeypatch.setattr(module, "LOOK_EVERY", 0.01)
    stream, clock = Stream(), Clock()
    with Progress(stream, clock) as progress:
        clock.now += PERIOD
        progress.say("diagnosis 1/1: a")
        assert stream.is_said_again.wait(30)
    assert set(stream.getvalue().splitlines()) == {"diagnosis 1/1: a"}


def test_a_stream_that_is_closed_does_no_harm() -> None:
    stream = Terminal()
    with Progress(stream) as progress:
        stream.close()
        progress.say("checks 1/2: a")


def test_a_check_says_what_it_does_on_standard_error_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.py").write_text(ADAPTER, encoding="utf-8")
    check = ["check", str(tmp_path / "mine.py"), "--only", "returns.lambda_return_l", "--examples", "2"]
    assert main(check) == 1
    quick = capsys.readouterr()
    assert quick.err == ""
    monkeypatch.setattr(module, "PERIOD", 0.0)
    assert main(check) == 1
    slow = capsys.readouterr()
    assert slow.out == quick.out
    name = "returns.lambda_return_literals"
    said = dict.fromkeys(slow.err.splitlines())  # the same line may come again
    assert list(said) == [
        f"checks 1/1: {name}",
        "diagnosis",
        f"diagnosis, recording 1/1: {name}",
        f"diagnosis, comparing 1/1: {name}",
    ]
