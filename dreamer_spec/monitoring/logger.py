"""What a run writes and shows: metrics.jsonl, TensorBoard events, Weights & Biases, and progress on the terminal."""

import io
import json
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any, BinaryIO, cast

import numpy as np
from PIL import Image
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn
from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.event_file_writer import EventFileWriter

from conformance.output import Unfailing
from dreamer_spec.disk.about import About
from dreamer_spec.disk.files import open_file, reading
from dreamer_spec.errors import UserError, writing

PLAIN_EVERY = 10.0  # seconds between lines where there is no terminal

Picture = Path | np.ndarray
Watch = Callable[[int, dict[str, float]], object]


class Logger:
    """LOGDIR/metrics.jsonl, one object per line, and the same numbers for TensorBoard and, if wanted, Weights & Biases.

    Every line has `step` (environment steps, with action repeat) and `seconds` (of training). The other names:
    docs/metrics.md. A number that is not finite stands there as NaN, Infinity or -Infinity, which Python reads and
    strict JSON does not know.

    position: the size of metrics.jsonl, in bytes, at the checkpoint that is continued: what came later is cut off, and
    the resumed run writes it again. TensorBoard is told to hide it, Weights & Biases keeps what it has. None begins a
    new file.
    wandb: a project of Weights & Biases; needs `about`, of dreamer_spec/disk/about.py, whose `id` lets a resumed run
    continue where it was.
    watch: called with step and metrics of each line, when it has been written; what it raises ends the run.
    warnings: what was wrong with the file. stopped: whether `watch` has returned False.

    Raises:
      UserError: the disk refuses it, the file is another program's, or Weights & Biases is not installed or does not
        let us in.
    """

    def __init__(
        self,
        logdir: Path,
        position: int | None = None,
        *,
        wandb: str | None = None,
        about: About | None = None,
        watch: Watch | None = None,
    ) -> None:
        self.stopped = False
        self._watch = watch
        self._path = logdir / "metrics.jsonl"
        with writing(self._path):
            self._file = _open_log(self._path)
            self.warnings = _cut(self._file, self._path, position or 0)
            last = _last_step(self._file)
            self._file.seek(0, os.SEEK_END)
        with writing(logdir):
            self._tensorboard = _TensorBoard(logdir.absolute(), last)  # a thread opens its files
        self._wandb = _Wandb(logdir, wandb, about or {}) if wandb else None

    def write(self, step: int, seconds: float, metrics: Mapping[str, float]) -> None:
        values = {name: float(value) for name, value in metrics.items()}
        line = json.dumps({"step": step, "seconds": round(seconds, 3), **values}) + "\n"
        with writing(self._path):
            self._file.write(line.encode())
            self._file.flush()
        with writing(self._path.parent):
            self._tensorboard.scalars(values, step)
        if self._wandb:
            self._wandb.log(values, step)
        if self._watch:
            answer = self._watch(step, values)
            self.stopped |= isinstance(answer, bool | np.bool_) and not answer

    def picture(self, name: str, picture: Picture, step: int) -> None:
        """An image for TensorBoard and Weights & Biases: a PNG or GIF file, or uint8 [H, W], [H, W, 1] or [H, W, 3]."""
        with writing(self._path.parent):
            self._tensorboard.image(name, picture, step)
        if self._wandb:
            self._wandb.log_picture(name, picture, step)

    def position(self) -> int:
        """The size of metrics.jsonl in bytes, all of which are on the disk: for the checkpoint."""
        with writing(self._path):
            self._file.flush()
            os.fsync(self._file.fileno())
        return self._file.tell()

    def close(self) -> None:
        """Writes what is still under way.

        Raises:
          UserError: the disk refuses it.
        """
        if self._wandb:
            self._wandb.close()
        with writing(self._path.parent):
            try:
                self._file.close()
            finally:
                self._tensorboard.close()


def _open_log(path: Path) -> BinaryIO:
    """metrics.jsonl, for reading and writing; made if it is not there.

    Raises:
      OSError: the disk refuses it.
      UserError: a link or something else than a file stands there; it is left as it is.
    """
    if os.path.lexists(path) and (path.is_symlink() or not path.is_file()):
        raise UserError(
            f"{path} is no file of a run, but a {'link' if path.is_symlink() else 'directory or device'}: move it away"
        )
    flags = (
        os.O_RDWR
        | os.O_CREAT
        | getattr(os, "O_NOFOLLOW", 0)
        | getattr(os, "O_NONBLOCK", 0)
        | getattr(os, "O_BINARY", 0)
    )
    return os.fdopen(os.open(path, flags, 0o666), "rb+")


def _cut(file: BinaryIO, path: Path, position: int) -> list[str]:
    """Cuts metrics.jsonl back to so many bytes, and to whole lines if it is not what it was. Returns what is to be said
    about it.

    Raises:
      UserError: what would be kept does not end in a line of metrics, so it is somebody else's file; it is left as it
        is.
    """
    size = file.seek(0, os.SEEK_END)
    lines, _, rest = _tail(file, position).rpartition(b"\n")
    kept = min(size, position) - len(rest)
    if kept and _numbers(lines.rpartition(b"\n")[2]) is None:
        raise UserError(
            f"{path} is not the file of this run: its last line within {position:,} bytes is no metrics; move it away"
        )
    if kept == position:
        file.truncate(kept)
        return []
    file.truncate(kept)
    return [
        f"{path} has {size:,} bytes, and {position:,} belong to the checkpoint; {kept:,} bytes of whole lines were kept"
    ]


def _last_step(file: BinaryIO) -> int | None:
    """Of the last line, if there is one."""
    for text in _tail(file).splitlines()[-1:]:
        line = _numbers(text)
        return int(line["step"]) if line else None
    return None


def _tail(file: BinaryIO, end: float = math.inf) -> bytes:
    """What stands before so many bytes of a file, longer than any line of ours."""
    end = min(end, file.seek(0, os.SEEK_END))
    start = file.seek(max(0, int(end) - 2**20))
    return file.read(int(end) - start)


class _TensorBoard:
    """An event file. last: hides the events of later steps in earlier files."""

    def __init__(self, logdir: Path, last: int | None) -> None:
        self._writer = EventFileWriter(str(logdir))
        if last is not None:
            self._writer.add_event(
                Event(wall_time=time.time(), step=last + 1, session_log=SessionLog(status=SessionLog.START))
            )

    def scalars(self, metrics: Mapping[str, float], step: int) -> None:
        self._add([Summary.Value(tag=name, simple_value=value) for name, value in metrics.items()], step)

    def image(self, name: str, picture: Picture, step: int) -> None:
        encoded = picture.read_bytes() if isinstance(picture, Path) else _png(picture)
        with Image.open(io.BytesIO(encoded)) as image:
            width, height = image.size
        image_proto = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=encoded)
        self._add([Summary.Value(tag=name, image=image_proto)], step)

    def _add(self, values: list[Any], step: int) -> None:
        self._writer.add_event(Event(wall_time=time.time(), step=step, summary=Summary(value=values)))

    def close(self) -> None:
        self._writer.close()


class _Wandb:
    """A run of Weights & Biases. Its steps only grow: of what a resumed run does again, it keeps what it has."""

    def __init__(self, logdir: Path, project: str, about: About) -> None:
        try:
            import wandb
        except ModuleNotFoundError as error:
            raise UserError(f"--wandb needs the package {error.name}: pip install 'dreamer-spec[wandb]'") from error
        self._wandb = wandb
        config = {
            name: about[name]
            for name in ("task", "backend", "device", "profile", "size", "parameters", "command", "machine")
        }
        config |= {"seed": about["options"]["seed"], **about["hyperparameters"]}
        try:
            self._run = wandb.init(
                project=project,
                id=about["id"],
                name=logdir.name,
                dir=str(logdir),
                config=config,
                allow_val_change=True,
                resume="allow",
                settings={"console": "off"},
            )
        except wandb.errors.Error as error:
            raise UserError(
                f"Weights & Biases refuses the run: {error}; run `wandb login`, set "
                f"WANDB_MODE=offline, or leave out --wandb"
            ) from error
        self._begin = self._run.step

    def log(self, values: Mapping[str, Any], step: int) -> None:
        if step >= self._begin:
            self._run.log(dict(values), step=step)

    def log_picture(self, name: str, picture: Picture, step: int) -> None:
        is_gif = isinstance(picture, Path) and picture.suffix == ".gif"
        data = str(picture) if isinstance(picture, Path) else picture
        self.log({name: self._wandb.Video(data, format="gif") if is_gif else self._wandb.Image(data)}, step)

    def close(self) -> None:
        self._run.finish()


def _png(image: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image[..., 0] if image.shape[2:] == (1,) else image).save(buffer, "png")
    return buffer.getvalue()


def iterate_metrics(path: Path) -> Iterator[dict[str, float] | None]:
    """The lines of a metrics.jsonl one by one: the numbers of each by name, or None for a line that is damaged or cut
    off.

    Raises:
      Unreadable.
      ValueError: something else than a file stands there.
    """
    try:
        file = open_file(path)
    except FileNotFoundError:
        return
    with reading(path), file:
        yield from map(_numbers, file)


def _numbers(text: bytes) -> dict[str, float] | None:
    """The numbers of a line by name; None if it is damaged."""
    try:
        line = {name: float(value) for name, value in json.loads(text).items() if type(value) in (int, float)}
        return line if 0 <= line["step"] < math.inf and 0 <= line.get("seconds", 0.0) < math.inf else None
    except (ValueError, KeyError, AttributeError, RecursionError, OverflowError):
        return None


class Display:
    """What goes on, as a live line on a terminal, while the display is entered; elsewhere a line now and then. Never
    fails: [LOOP-45].

    total: environment steps of the run.
    """

    def __init__(self, total: int) -> None:
        self._total = total
        self._console = Console()
        self._console.file = cast(
            IO[str], Unfailing(self._console.file)
        )  # Rich ends the process where a reader has gone.
        self._progress: Progress | None = None
        self._phase = ""
        self._printed = time.monotonic()

    def __enter__(self) -> "Display":
        if self._console.is_terminal:
            columns = (
                SpinnerColumn(),
                BarColumn(bar_width=12),
                TaskProgressColumn(),
                TextColumn("{task.fields[text]}", markup=False),
            )
            self._progress = Progress(*columns, console=self._console, transient=True)
            self._progress.start()
            self._task = self._progress.add_task("", total=self._total, text="", visible=False)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._progress:
            self._progress.stop()
            self._progress = None

    def say(self, text: str) -> None:
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def update(self, step: int, facts: Iterable[str]) -> None:
        """Training goes on; to be called as often as one likes.

        facts: what to show, the most important first: a narrow terminal cuts the others off.
        """
        self._show("training", step, self._total, " · ".join([f"step {step:,}", *facts]))

    def phase(self, name: str, done: int = 0, total: int | None = None, unit: str = "", detail: str = "") -> None:
        """Something beside training goes on; to be called as often as one likes, and before anything that takes long.

        total: how much there is to do, in the unit; None if nobody knows, as with a compilation. Where there is no
        terminal, such a phase is said when it begins, because nobody may call again before it is over. detail: what has
        just been done.
        """
        text = name if total is None else f"{name} {done:,}/{total:,} {unit}".rstrip()
        self._show(name, done, total, f"{text}: {detail}" if detail else text)

    def _show(self, phase: str, done: int, total: int | None, text: str) -> None:
        begins, self._phase = phase != self._phase, phase
        if self._progress:
            if begins:
                self._progress.reset(self._task, total=total)
            self._progress.update(self._task, total=total, completed=min(done, total or done), text=text, visible=True)
        elif (begins and total is None) or time.monotonic() - self._printed >= PLAIN_EVERY:
            self._printed = time.monotonic()
            self.say(text if total is None else f"{100 * done // total if total else 100:3d}%  {text}")


def duration(seconds: float) -> str:
    """3725.0 -> 1 h 02 min."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
