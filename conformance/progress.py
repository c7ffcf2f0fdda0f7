"""What a long command is doing, on standard error."""

import contextlib
import shutil
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator
from typing import TextIO

from conformance.check import Check
from conformance.output import Unfailing

PERIOD = 30.0  # seconds between two lines where they are not overwritten
LOOK_EVERY = 1.0  # seconds


class Progress(contextlib.AbstractContextManager["Progress"]):
    """A line that says what is under way.

    In a terminal it is overwritten, and erased at the end. Elsewhere, such as in the log of a CI service, it is a plain
    line at most every 30 seconds, also while nothing new is said: a command that ends sooner leaves no trace.
    """

    def __init__(self, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        """stream: standard error, unless given."""
        self._stream = Unfailing(sys.stderr if stream is None else stream)
        self._is_terminal = self._stream.isatty()
        self._clock, self._printed = clock, clock()
        self._text = self._line = ""
        self._lock, self._is_over = threading.Lock(), threading.Event()

    def __enter__(self) -> "Progress":
        if not self._is_terminal:
            threading.Thread(target=self._repeat, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        if self._line:
            self._overwrite("")
            self._stream.write("\r")
            self._stream.flush()

    def say(self, text: str) -> None:
        """What is under way from now on."""
        self._text = text
        self.show()

    def over(self, what: str, checks: Collection[Check]) -> Iterator[Check]:
        """Hands out the checks, and says which one is under way: `checks 34/250: losses.actor_matches`."""
        for number, check in enumerate(checks, 1):
            self.say(f"{what} {number}/{len(checks)}: {check.name}")
            yield check

    def show(self) -> None:
        """Writes what was said last, where it is time to."""
        with self._lock:
            if self._is_terminal:
                self._overwrite(self._text[: shutil.get_terminal_size().columns - 1])
            elif self._text and self._clock() - self._printed >= PERIOD:
                self._printed = self._clock()
                self._stream.write(f"{self._text}\n")
                self._stream.flush()

    def _overwrite(self, line: str) -> None:
        self._stream.write("\r" + line.ljust(len(self._line)))
        self._stream.flush()
        self._line = line

    def _repeat(self) -> None:
        while not self._is_over.wait(LOOK_EVERY):
            self.show()
