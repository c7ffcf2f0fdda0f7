"""The process interface: whatever the other side does, there is a result, and it says what happened."""

import contextlib
import json
import math
import shlex
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from conformance import process
from conformance.case import Setting
from conformance.cli import main
from conformance.compare import CandidateLost
from conformance.errors import UserError
from conformance.execute import Result, run_check, selected_checks
from conformance.problems import small_config, spaces
from conformance.process import RESTARTS, CandidateError, ProcessAdapter, encode_argument
from conformance.serve import decode, encode

FAKE = Path(__file__).resolve().parent / "fake_process.py"
ROOT = FAKE.parent.parent
CHECKS = {check.name: check for check in selected_checks("float64")}


def command(mode: str = "") -> str:
    return shlex.join([sys.executable, str(FAKE), mode])


@contextlib.contextmanager
def fake(mode: str = "", timeout: float = 60.0) -> Iterator[ProcessAdapter]:
    adapter = ProcessAdapter(command(mode), "float64", timeout)
    adapter._timeout = 0.5 if "hang" in mode else timeout
    try:
        yield adapter
    finally:
        adapter.close()


def result_of(adapter: object) -> Result:
    return run_check(CHECKS["transforms.symlog_matches"], adapter, Setting("float64", "paper", examples=2))


def test_a_right_implementation_passes() -> None:
    """Every request and every reply of this is valid: the fake holds them against the schema."""
    with fake() as adapter:
        assert (adapter.name, adapter.version, adapter.edition()) == ("fake", "0.1", "official")
        assert not hasattr(adapter, "symexp")
        assert not hasattr(adapter, "an_extra")
        assert result_of(adapter).status == "pass"
        running = adapter._connection
        assert running is not None
    assert running.process.wait(5) == 0


def test_what_is_sent_comes_back() -> None:
    """NaN, infinities, the sign of zero, every dtype and an empty array survive the way there and back."""
    numbers = np.array([[math.nan, math.inf, -math.inf], [-0.0, 5e-324, 1 / 3]])
    with fake() as adapter:
        for sent in (
            numbers,
            numbers.astype(np.float32),
            np.zeros((0, 3)),
            np.arange(3),
            np.arange(3, dtype=np.uint8),
            numbers > 0,
            numbers.T,
        ):
            came, single = adapter.kl_losses(sent, math.inf)
            assert came.dtype == sent.dtype
            assert came.shape == sent.shape
            assert came.tobytes() == sent.tobytes()
            assert single == math.inf
        deep = {"a": {"b": np.ones(2)}, "c": (1, 2.5, True)}
        came, several = adapter.kl_losses(deep, [np.ones(1), {"d": 0.5}])
        np.testing.assert_array_equal(came["a"]["b"], np.ones(2))
        assert came["c"] == (1, 2.5, True)
        assert several[1] == {"d": 0.5}


def test_the_format_of_an_array() -> None:
    expected = {"dtype": "float32", "shape": [2], "data": "AACAPwAAAMA="}  # 1.0 is 00 00 80 3f, -2.0 is 00 00 00 c0
    assert encode(np.array([1.0, -2.0], np.float32)) == expected
    assert encode(np.array([1.0, -2.0], ">f4")) == expected
    np.testing.assert_array_equal(decode(expected), np.array([1.0, -2.0]))
    assert encode(math.nan)["shape"] == encode(np.float64(0.5))["shape"] == []
    assert encode(0.5) == 0.5


def test_configurations_and_spaces() -> None:
    """They are plain JSON, with what is derived from them, and become namespaces."""
    config, task = small_config("paper"), spaces("both", "mixed")
    got = decode(json.loads(json.dumps(encode_argument(config))))
    assert (got.units, got.imagined_discount, got.feature_size) == (
        config.units,
        config.imagined_discount,
        config.feature_size,
    )
    assert got.cnn_multipliers == config.cnn_multipliers
    got = decode(json.loads(json.dumps(encode_argument(task))))
    assert list(got.observations) == list(task.observations)
    assert got.actions["buttons"].classes == (2, 3)
    assert got.images["image"].array_shape == (12, 16, 3)
    assert (got.action_size, got.action_noise_size) == (7, 4)


BROKEN = {
    "crash": ("ended with exit code 3", "Segmentation of reality"),
    "hang": ("no reply within 0.5 s",),
    "half line": ("ended with exit code 0 in the middle of a line",),
    "half line and hang": ("no reply within 0.5 s", "bytes of an unfinished line"),
    "close": ("closed its standard output",),
    "endless unexpected output": ("more than 100 lines on standard output are no messages, the last: 'nothing'",),
    "wrong id": ("answered request 7777 where 2 was asked",),
    "neither": ("either a result or an error", "answer"),
    "error without a message": ("either a result or an error",),
    "huge line": ("a line is longer than 1,000,000 bytes",),
    "deep and hang": ("no reply within 0.5 s",),
    "flood": ("more than 100 lines on standard output are no messages, the last: 'nothing'",),
}


@pytest.mark.parametrize("mode", BROKEN)
def test_a_lost_process_is_a_result(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It says at which function and why, and the process is gone."""
    monkeypatch.setattr(process, "MESSAGE_BYTES", 1_000_000)
    with fake(mode) as adapter:
        connection = adapter._connection
        assert connection is not None
        result = result_of(adapter)
        assert result.status == "error"
        assert result.message.startswith("the process was lost at run symlog: ")
        for words in BROKEN[mode]:
            assert words in result.message
        assert connection.process.poll() is not None
        assert adapter._starts == 1, "hypothesis went on to search for a smaller case"


@pytest.mark.parametrize(
    ("mode", "message"),
    [
        ("too few bytes", "bytes, got"),
        ("unknown dtype", "expected one of the dtypes bool, "),
        ("text", "expected numbers, got str"),
        ("many values", "more than 200,000 values in one result"),
        ("huge number", "a whole number of more than 64 bits"),
        ("impossible shape", ""),
        ("null", "expected numbers, got None"),
    ],
)
def test_a_result_that_cannot_be_read(mode: str, message: str) -> None:
    """The process goes on: only this call has no result."""
    with fake(mode) as adapter:
        connection = adapter._connection
        with pytest.raises(CandidateError, match=f"^symlog: .*{message}"):
            adapter.symlog(np.ones(2))
        assert adapter._connection is connection


@pytest.mark.parametrize(
    ("mode", "raised"), [("ValueError", ValueError), ("KeyError", KeyError), ("TypeError", CandidateError)]
)
def test_errors_of_the_other_side(mode: str, raised: type[Exception]) -> None:
    with fake(mode) as adapter, pytest.raises(raised, match="fake refuses x"):
        adapter.symlog(np.ones(2))


@pytest.mark.parametrize(("mode", "raised"), [("long error", CandidateError), ("long refusal", ValueError)])
def test_a_long_error_is_cut(mode: str, raised: type[Exception]) -> None:
    with fake(mode) as adapter, pytest.raises(raised) as found:
        adapter.symlog(np.ones(2))
    assert len(str(found.value)) < 2 * process.TEXT
    assert "0,000,000 characters)" in str(found.value)


def test_a_kind_that_is_no_text_loses_the_process() -> None:
    with (
        fake("a list as kind") as adapter,
        pytest.raises(CandidateLost, match="an error with kind and message as text"),
    ):
        adapter.symlog(np.ones(2))


def test_the_whole_conversation_has_a_limit() -> None:
    """Whatever each reply takes: what comes after the limit is a result too, and at once."""
    with fake() as adapter:
        assert result_of(adapter).status == "pass"
        assert 0 < adapter._waited < process.IN_ALL * adapter._timeout
        adapter._waited = process.IN_ALL * adapter._timeout + 1
        result = result_of(adapter)
        assert result.status == "error"
        assert result.message == "its replies have taken more than 6000 s in all, 100 times --timeout"


def test_unexpected_output_is_shown_and_left_out(capfd: pytest.CaptureFixture[str]) -> None:
    with fake("unexpected output") as adapter:
        assert adapter.symlog(np.zeros(2)).tolist() == [0, 0]
    shown = capfd.readouterr().err
    assert "loading weights..." in shown
    assert ": 42\n" in shown
    assert '{"level": "info"}' in shown


def test_the_next_check_gets_a_new_process_a_few_times() -> None:
    with fake("crash") as adapter:
        for _ in range(RESTARTS + 1):
            assert "exit code 3" in result_of(adapter).message
        message = result_of(adapter).message
        assert message == "the process is not started again: it was lost 6 times"


def test_a_process_that_does_not_read_is_no_hang() -> None:
    """A message larger than any pipe is written to it, and the time runs out."""
    with fake("stops reading") as adapter:
        assert adapter.symlog(np.zeros(2)).tolist() == [0, 0]
        adapter._timeout = 0.5
        before = time.monotonic()
        with pytest.raises(CandidateLost, match="no reply within"):
            adapter.symlog(np.zeros(1_000_000))
        assert time.monotonic() - before < 30


@pytest.mark.parametrize("mode", ["does not stop", "flood"])
def test_a_process_that_does_not_stop_is_ended(mode: str) -> None:
    with fake(mode) as adapter:
        running = adapter._connection
        assert running is not None
    assert running.process.poll() is not None
    assert running._lines.qsize() < 100_000, "what is not asked for fills the memory"


def test_ctrl_c_while_waiting_for_the_end_ends_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    with fake() as adapter:
        running = adapter._connection
        assert running is not None

        def interrupted(deadline: float) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr(running, "receive", interrupted)
        with pytest.raises(KeyboardInterrupt):
            adapter.close()
    assert running.process.poll() is not None


@pytest.mark.parametrize(
    ("mode", "message"), [("odd edition", "expected a name or nothing, got 3"), ("refuses edition", "fake refuses x")]
)
def test_an_edition_that_is_none(mode: str, message: str) -> None:
    with fake(mode) as adapter, pytest.raises(UserError, match=f"^edition: .*{message}"):
        adapter.edition()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (command("dies at once"), "ended with exit code 1 | its standard error ended with: | no such licence"),
        (command("old protocol"), "it speaks protocol 0, and the kit 1"),
        (
            command("a million functions"),
            "expected at most 5,000 functions with names of at most 200 characters, got 1,000,000",
        ),
        (command("long name"), "expected the name as text of at most 200 characters"),
        (command("reads nothing"), "no reply within 0.5 s"),
        (command("refuses start"), "the process was lost at start: refuses start: fake refuses x"),
        ("no-such-program --now", "cannot run 'no-such-program --now'"),
        ("", "cannot run ''"),
        ("python 'unfinished", "No closing quotation"),
    ],
)
def test_a_process_that_does_not_start(line: str, message: str) -> None:
    with pytest.raises(UserError) as raised:
        ProcessAdapter(line, "float64", 0.5 if "reads nothing" in line else 60.0)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("timeout", [0.0, -1.0, math.nan])
def test_a_timeout_is_a_time(timeout: float) -> None:
    with pytest.raises(UserError, match="--timeout: expected seconds above 0, got"):
        ProcessAdapter(command(), "float64", timeout)


def test_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--process", command(), "--only", "symlog_matches"]) == 0
    assert "fake 0.1 claims the edition official" in capsys.readouterr().out
    assert main(["check", "--process", command("crash"), "--only", "symlog_matches"]) == 1
    assert main(["check", "--process", command("dies at once")]) == 2
    assert main(["check", "numpy", "--process", command()]) == 2
    assert main(["check"]) == 2
    assert "give either a candidate" in capsys.readouterr().err
