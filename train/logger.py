"""What a run writes and shows: metrics.jsonl, TensorBoard events, and progress on the terminal."""

import json
import os
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from tensorboard.summary import Writer

PLAIN_EVERY = 10.0  # seconds between lines where there is no terminal


class Logger:
    """LOGDIR/metrics.jsonl, one object per line, and the same numbers for TensorBoard.

    Every line has `step` (environment steps, with action repeat) and `seconds` (of training). Beside them:
    `episode/return`, `episode/length` (one line per training episode), `evaluation/...`, `train/...` (means since the last such line),
    `speed/...` (per second), `random/return`.

    What was written after `position` is dropped: a run that ended without a checkpoint left it, and the resumed run writes it again. Events
    for TensorBoard stay as they are.
    """

    def __init__(self, logdir: Path, position: int | None = None) -> None:
        path = logdir / "metrics.jsonl"
        path.touch()
        os.truncate(path, min(position or 0, path.stat().st_size))
        self._file = path.open("a", encoding="utf-8")
        self._tensorboard = Writer(str(logdir))

    def write(self, step: int, seconds: float, metrics: Mapping[str, float]) -> None:
        line = {"step": step, "seconds": round(seconds, 3), **{name: float(value) for name, value in metrics.items()}}
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()
        for name, value in metrics.items():
            self._tensorboard.add_scalar(name, value, step)

    def position(self) -> int:
        """How long metrics.jsonl is, in bytes, all of it on the disk."""
        self._file.flush()
        os.fsync(self._file.fileno())
        return self._file.tell()

    def close(self) -> None:
        self._file.close()
        self._tensorboard.close()


def read_metrics(path: Path) -> list[dict[str, float]]:
    """The lines of a metrics.jsonl; a last line that was cut off in writing is left out."""
    lines: list[dict[str, float]] = []
    if path.exists():
        for text in path.read_text(encoding="utf-8").splitlines():
            try:
                lines.append(json.loads(text))
            except ValueError:
                break
    return lines


class Display:
    """A progress bar on a terminal, while the display is entered; elsewhere a line now and then."""

    def __init__(self, total: int) -> None:
        self._total = total
        self._console = Console()
        self._progress: Progress | None = None
        self._printed = time.monotonic()

    def __enter__(self) -> "Display":
        if self._console.is_terminal:
            columns = (BarColumn(bar_width=12), TaskProgressColumn(), TextColumn("{task.fields[text]}"))
            self._progress = Progress(*columns, console=self._console, transient=True)
            self._progress.start()
            self._task = self._progress.add_task("", total=self._total, text="")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._progress:
            self._progress.stop()

    def say(self, text: str) -> None:
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def update(self, step: int, facts: Iterable[str]) -> None:
        """To be called as often as one likes. facts: what to show, the most important first: a narrow terminal cuts the others off."""
        text = " · ".join([f"step {step:,}", *facts])
        if self._progress:
            self._progress.update(self._task, completed=min(step, self._total), text=text)
        elif time.monotonic() - self._printed >= PLAIN_EVERY:
            self._printed = time.monotonic()
            self.say(f"{100 * step // self._total:3d}%  {text}")


def duration(seconds: float) -> str:
    """3725.0 -> 1 h 02 min."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
