"""Saying something never fails: a command whose output nobody can take goes on to its end, and to its exit code."""

import contextlib
import io
import os
import sys
from typing import IO, Any, TextIO


class _Descriptor(io.FileIO):
    """A file descriptor that takes everything: what cannot be written (a closed pipe or terminal, a full disk) is
    dropped."""

    def write(self, data: Any) -> int:
        size = memoryview(data).nbytes
        try:
            written = super().write(data)
        except OSError:
            return size
        return size if written is None else written  # None: a pipe that does not block, and is full.


def never_fail() -> None:
    """From here on neither `print` to standard output or error, nor flushing them at the end of the process, raises an
    error.

    A character that their encoding lacks is written as its escape. A descriptor that was closed when the process began
    is opened on the null device: otherwise the next file to be opened would get its number, and what libraries print.
    Streams that somebody else has put in place of the process's own, as notebooks and tests do, stay as they are.
    """
    open_descriptors()
    sys.stdout = (
        sys.stdout or sys.__stdout__ or os.fdopen(1, "w", closefd=False)
    )  # None where its descriptor was closed
    sys.stderr = sys.stderr or sys.__stderr__ or os.fdopen(2, "w", closefd=False)
    if sys.stdout is sys.__stdout__ and isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout = _unfailing(sys.stdout)
    if sys.stderr is sys.__stderr__ and isinstance(sys.stderr, io.TextIOWrapper):
        sys.stderr = _unfailing(sys.stderr)


def open_descriptors() -> None:
    """Opens those of 0, 1 and 2 that are closed on the null device."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # Gets the lowest number that is free: this one.


def _unfailing(stream: io.TextIOWrapper) -> TextIO:
    """The same stream: same descriptor, encoding and buffering."""
    with contextlib.suppress(OSError):
        stream.flush()
    raw = _Descriptor(stream.fileno(), "w", closefd=False)
    return io.TextIOWrapper(
        raw if stream.write_through else io.BufferedWriter(raw),
        stream.encoding,
        errors="backslashreplace",
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )


class Unfailing(io.TextIOBase):
    """Any stream of text, such as a notebook's: what it cannot take is dropped, what it cannot encode is escaped."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return getattr(self._stream, "encoding", None) or "utf-8"

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError, ValueError):  # ValueError: it is closed.
            try:
                self._stream.write(text)
            except UnicodeEncodeError:
                self._stream.write(text.encode(self.encoding, "backslashreplace").decode(self.encoding))
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            self._stream.flush()

    def isatty(self) -> bool:
        try:
            return self._stream.isatty()
        except (OSError, ValueError, AttributeError):
            return False

    def fileno(self) -> int:
        return self._stream.fileno()
