"""What a run writes: metrics.jsonl cut back to a checkpoint, TensorBoard, Weights & Biases; and what it shows."""

import errno
import io
import json
import math
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from dreamer_spec.errors import UserError
from dreamer_spec.monitoring import logger as module
from dreamer_spec.monitoring.logger import Display, Logger, iterate_metrics

ABOUT = {
    **dict.fromkeys(("task", "backend", "device", "profile", "size", "parameters", "command", "machine"), "-"),
    "id": "0123456789abcdef",
    "options": {"seed": 3},
    "hyperparameters": {"batch_size": 16},
}


def write(logdir: Path, steps: range, **arguments: Any) -> int:
    """Writes a line for each step; returns the position after the last."""
    logger = Logger(logdir, **arguments)
    for step in steps:
        logger.write(step, step / 10, {"train/loss/total": float(step)})
    position = logger.position()
    logger.close()
    return position


def test_a_resumed_file_is_byte_for_byte_that_of_the_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    position = write(tmp_path, range(3))
    saved = path.read_bytes()
    assert len(saved) == position
    assert saved.splitlines()[2] == b'{"step": 2, "seconds": 0.2, "train/loss/total": 2.0}'
    with path.open("ab") as file:
        file.write(b'{"step": 3, "seconds": 0.3}\n{"step": 4, "sec')
    logger = Logger(tmp_path, position)
    assert logger.warnings == []
    assert path.read_bytes() == saved
    logger.write(3, 0.3, {"train/loss/total": 3.0})
    logger.close()
    assert path.read_bytes() == saved + b'{"step": 3, "seconds": 0.3, "train/loss/total": 3.0}\n'


def test_a_new_run_begins_a_new_file(tmp_path: Path) -> None:
    write(tmp_path, range(3))
    assert write(tmp_path, range(0)) == 0
    assert (tmp_path / "metrics.jsonl").read_bytes() == b""


@pytest.mark.parametrize("length", [0, 60, 104])
def test_a_shorter_file_keeps_its_whole_lines_and_says_so(tmp_path: Path, length: int) -> None:
    path = tmp_path / "metrics.jsonl"
    position = write(tmp_path, range(3))
    content = path.read_bytes()
    whole = content[:length].rfind(b"\n") + 1
    path.write_bytes(content[:length])
    logger = Logger(tmp_path, position)
    logger.close()
    assert path.read_bytes() == content[:whole]
    [warning] = logger.warnings
    assert f"has {length} bytes, and {position} belong to the checkpoint" in warning


def test_a_missing_file_is_said(tmp_path: Path) -> None:
    logger = Logger(tmp_path, 100)
    logger.close()
    assert len(logger.warnings) == 1
    assert (tmp_path / "metrics.jsonl").read_bytes() == b""


def test_another_file_is_cut_to_whole_lines(tmp_path: Path) -> None:
    """Whoever edited it, a line that is half of the old and half of the new run must not come of it."""
    (tmp_path / "metrics.jsonl").write_text('{"step": 1}\n{"step": 2, "seconds": 1.0}\n')
    logger = Logger(tmp_path, 20)
    logger.close()
    assert (tmp_path / "metrics.jsonl").read_text() == '{"step": 1}\n'
    assert len(logger.warnings) == 1


def test_the_file_of_another_program_is_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text("user\n" * 2000)
    with pytest.raises(UserError, match=r"metrics.jsonl is not the file of this run: .* move it away"):
        Logger(tmp_path, 7015)
    assert path.read_text() == "user\n" * 2000


def test_position_is_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []
    logger = Logger(tmp_path)
    logger.write(1, 0.0, {"a": 1.0})
    monkeypatch.setattr("os.fsync", lambda number: synced.append((tmp_path / "metrics.jsonl").stat().st_size))
    assert synced == [] != [logger.position()] == synced
    logger.close()


def test_a_full_disk_is_a_user_error(tmp_path: Path) -> None:
    logger = Logger(tmp_path)
    logger._file.close()
    logger._file = Path("/dev/full").open("ab")  # noqa: SIM115
    with pytest.raises(UserError, match=r"cannot write .*metrics.jsonl: No space left"):
        logger.write(1, 0.0, {"a": 1.0})
    with pytest.raises(UserError, match=r"cannot write .*: No space left"):
        logger.close()


def test_a_full_disk_under_tensorboard_is_a_user_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    logger = Logger(tmp_path)
    monkeypatch.setattr(logger._tensorboard._writer, "add_event", refuse)
    with pytest.raises(UserError, match=rf"cannot write {tmp_path}: No space left"):
        logger.write(1, 0.0, {"a": 1.0})
    logger.close()


def test_damaged_lines_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(
        b'{"step": 1, "a": NaN}\n\xff\xfe\n[1]\n{"a": 1}\n{"step": "x"}\n{"step": 2, "a": "text", "b": '
        b'true}\n{"step": Infinity}\n'
        b'{"step": -1}\n{"step": 3, "seconds": NaN}\n{"step": 3, "a": 1' + b"0" * 400 + b'}\n{"st'
    )
    lines = [line for line in iterate_metrics(path) if line is not None]
    assert [line["step"] for line in lines] == [1, 2]
    assert math.isnan(lines[0]["a"])
    assert lines[1] == {"step": 2}
    assert sum(line is None for line in iterate_metrics(path)) == 9
    assert list(iterate_metrics(tmp_path / "missing")) == []


def events(logdir: Path) -> EventAccumulator:
    found = EventAccumulator(str(logdir), size_guidance={"scalars": 0, "images": 0})
    found.Reload()
    return found


def test_tensorboard_hides_what_a_resumed_run_does_again(tmp_path: Path) -> None:
    position = write(tmp_path, range(5))
    write(tmp_path, range(5, 9), position=position)
    write(tmp_path, range(5, 7), position=position)
    assert [(event.step, event.value) for event in events(tmp_path).Scalars("train/loss/total")] == [
        (step, step) for step in range(7)
    ]


def test_pictures_come_to_tensorboard_as_they_are(tmp_path: Path) -> None:
    array = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    animation = tmp_path / "a.gif"
    frames = [Image.fromarray(np.full((3, 5), value, np.uint8)) for value in (0, 255)]
    frames[0].save(animation, save_all=True, append_images=frames[1:])
    logger = Logger(tmp_path)
    logger.picture("prediction/array", array, 7)
    logger.picture("prediction/gray", array[..., :1], 7)
    logger.picture("prediction/file", animation, 8)
    logger.close()
    found = events(tmp_path)
    [event] = found.Images("prediction/array")
    assert (event.step, event.width, event.height) == (7, 6, 4)
    np.testing.assert_array_equal(np.array(Image.open(io.BytesIO(event.encoded_image_string))), array)
    [gray] = found.Images("prediction/gray")
    np.testing.assert_array_equal(np.array(Image.open(io.BytesIO(gray.encoded_image_string))), array[..., 0])
    assert found.Images("prediction/file")[0].encoded_image_string == animation.read_bytes()


# Weights & Biases


class FakeWandb(types.ModuleType):
    """Remembers what it was given. step: where the run that is continued stands."""

    class errors:  # noqa: N801
        class Error(Exception):
            pass

    def __init__(self, step: int = 0, refusal: str = "") -> None:
        super().__init__("wandb")
        self.step, self.refusal = step, refusal
        self.logged: list[tuple[int, dict[str, Any]]] = []
        self.given: dict[str, Any] = {}
        self.finished = False

    def init(self, **given: Any) -> "FakeWandb":
        if self.refusal:
            raise self.errors.Error(self.refusal)
        self.given = given
        return self

    def log(self, data: dict[str, Any], step: int) -> None:
        self.logged.append((step, data))

    def finish(self) -> None:
        self.finished = True

    def Image(self, data: Any) -> tuple[str, Any]:  # noqa: N802
        return "image", data

    def Video(self, data: Any, format: str) -> tuple[str, Any]:  # noqa: N802
        return format, data


def test_a_resumed_run_continues_its_wandb_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeWandb(step=3)
    monkeypatch.setitem(sys.modules, "wandb", fake)
    write(tmp_path, range(2, 5), wandb="project", about=ABOUT)
    assert (fake.given["project"], fake.given["id"], fake.given["resume"]) == ("project", ABOUT["id"], "allow")
    assert (fake.given["config"]["seed"], fake.given["config"]["batch_size"]) == (3, 16)
    assert fake.logged == [(3, {"train/loss/total": 3.0}), (4, {"train/loss/total": 4.0})], "it has step 2 already"
    assert fake.finished


def test_pictures_come_to_wandb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeWandb()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    logger = Logger(tmp_path, wandb="project", about=ABOUT)
    monkeypatch.setattr(logger, "_tensorboard", types.SimpleNamespace(image=lambda *_: None, close=lambda: None))
    logger.picture("a", Path("x.gif"), 1)
    logger.picture("b", Path("x.png"), 2)
    logger.close()
    assert fake.logged == [(1, {"a": ("gif", "x.gif")}), (2, {"b": ("image", "x.png")})]


def test_wandb_that_is_missing_or_refuses_is_a_user_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "wandb", FakeWandb(refusal="No API key configured."))
    with pytest.raises(UserError, match=r"No API key configured.*WANDB_MODE=offline"):
        Logger(tmp_path, wandb="project", about=ABOUT)
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(UserError, match=r"pip install 'dreamer-spec\[wandb\]'"):
        Logger(tmp_path, wandb="project", about=ABOUT)


# Display


def shown(monkeypatch: pytest.MonkeyPatch, *, terminal: bool) -> tuple[Display, io.StringIO]:
    text = io.StringIO()
    monkeypatch.setattr(module, "Console", lambda: Console(file=text, force_terminal=terminal, width=100))
    return Display(1000), text


def test_plain_progress_is_short(monkeypatch: pytest.MonkeyPatch) -> None:
    display, text = shown(monkeypatch, terminal=False)
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    display._printed = 0.0
    with display:
        display.phase("compiling the train step")
        display.phase("compiling the train step")
        for done in range(40):
            now[0] += 0.5
            display.phase("prefill", done, 40, "steps")
        for step in range(100):
            now[0] += 0.25
            display.update(step, ["return 3"])
    assert text.getvalue().splitlines() == [
        "compiling the train step",
        " 47%  prefill 19/40 steps",
        " 97%  prefill 39/40 steps",
        "  3%  step 39 · return 3",
        "  7%  step 79 · return 3",
    ]


def test_live_progress_says_the_phase(monkeypatch: pytest.MonkeyPatch) -> None:
    display, text = shown(monkeypatch, terminal=True)
    with display:
        display.phase("evaluation", 3, 20, "episodes")
        assert display._progress
        display._progress.refresh()
        assert "evaluation 3/20 episodes" in text.getvalue()
        assert " 15%" in text.getvalue()
        display.phase("compiling [the] train step")
        display._progress.refresh()
        assert "compiling [the] train step" in text.getvalue().rpartition("episodes")[2]
        display.update(250, ["return 3"])
        display._progress.refresh()
        assert " 25%" in text.getvalue().rpartition("compiling")[2]
        display.say("a line [of] its own")
    assert "a line [of] its own" in text.getvalue()
    display.phase("after the end")
    assert json.dumps(text.getvalue()).count("after the end") == 1


class Broken(io.StringIO):
    """What `error` is raised by every write."""

    def __init__(self, error: Exception) -> None:
        super().__init__()
        self._error = error

    def write(self, text: str) -> int:
        raise self._error


@pytest.mark.parametrize("terminal", [False, True])
@pytest.mark.parametrize(
    "error", [BrokenPipeError(), OSError(28, "No space left on device"), ValueError("I/O operation on closed file")]
)
@pytest.mark.covers("LOOP-45")
def test_a_display_that_nobody_can_see_goes_on(
    monkeypatch: pytest.MonkeyPatch, error: Exception, terminal: bool
) -> None:
    file = Broken(error)
    monkeypatch.setattr(module, "Console", lambda: Console(file=file, width=100))
    monkeypatch.setattr(file, "isatty", lambda: terminal)
    with Display(10) as display:
        display.say("a line")
        display.phase("compiling")
        display.update(3, ["return 3"])


@pytest.mark.covers("LOOP-45")
def test_what_an_encoding_lacks_is_escaped(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = io.BytesIO()
    file = io.TextIOWrapper(raw, "ascii")
    monkeypatch.setattr(module, "Console", lambda: Console(file=file, width=100))
    display = Display(10)
    display.say("\N{MIDDLE DOT} \udcff")
    display.say("more")
    assert raw.getvalue() == b"\\xb7 \\udcff\nmore\n"
