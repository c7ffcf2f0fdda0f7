"""Ctrl-C, termination signals and closed terminals: the first one asks the process to end, the second one ends it."""

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any

NUMBERS = tuple(
    int(getattr(signal, name)) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)  # Windows has no SIGHUP.
PATIENCE = 2.0  # seconds before it is said that the end takes longer


class Stopped(KeyboardInterrupt):
    """The first signal, where nobody has to be waited for. Its text says what became of the run."""


class Signals:
    """received: the signals so far; never more than one. is_polled: whether somebody looks at it, see `polled`."""

    def __init__(self) -> None:
        self.received: list[int] = []
        self.is_polled = False
        self._previous: dict[int, Any] = {}

    @contextlib.contextmanager
    def polled(self, yes: bool = True) -> Iterator[None]:
        """Inside, a signal raises nothing: whoever is inside looks at `received`, and ends when it may. Or not, inside
        of that."""
        before, self.is_polled = self.is_polled, yes
        try:
            yield
        finally:
            self.is_polled = before

    def take_back(self) -> None:
        if not self.received:
            for number in self._previous:
                signal.signal(number, self._receive)
            if hasattr(signal, "pthread_sigmask"):
                signal.pthread_sigmask(signal.SIG_UNBLOCK, self._previous)

    @contextlib.contextmanager
    def _caught(self) -> Iterator[None]:
        ours, theirs = socket.socketpair()
        theirs.setblocking(False)
        hang_up = getattr(signal, "SIGHUP", None)  # Under nohup a closed terminal is ignored, as it wants.
        numbers = [number for number in NUMBERS if number != hang_up or signal.getsignal(number) != signal.SIG_IGN]
        wakeup = signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
        threading.Thread(target=_end_at_the_second, args=(ours, numbers), daemon=True).start()
        try:
            for number in numbers:
                self._previous[number] = signal.signal(number, self._receive)
            yield
        finally:
            for number, handler in self._previous.items():
                signal.signal(number, signal.SIG_DFL if handler is None else handler)  # None: one that is not Python's
            signal.set_wakeup_fd(wakeup)
            theirs.close()  # The thread ends.

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self.received.append(number)
        for other in self._previous:
            signal.signal(other, signal.SIG_IGN if _is_the_same(number, other) else signal.SIG_DFL)
        if not self.is_polled:
            raise Stopped


def _is_the_same(first: int, second: int) -> bool:
    """A terminal that is closed is often announced twice: by the shell to its jobs, and by the system when the shell is
    gone."""
    return first == second == getattr(signal, "SIGHUP", None)


def _end_at_the_second(wakeup: socket.socket, numbers: list[int]) -> None:
    """Python calls handlers between its own instructions only. A compiler may take minutes for one: this thread hears
    of it before."""
    first = 0
    with wakeup:
        while True:
            try:
                received = wakeup.recv(1)
            except TimeoutError:
                print(
                    "train: ending when the step under way is done; a second signal ends the process at once",
                    file=sys.stderr,
                )
                wakeup.settimeout(None)
                continue
            if not received:
                return
            number = received[0]  # Others than these are those of somebody else's handlers.
            if number in numbers and first and not _is_the_same(first, number):
                os._exit(128 + number)
            if number in numbers and not first:
                first = number
                wakeup.settimeout(PATIENCE)


_active: list[Signals] = []


@contextlib.contextmanager
def stoppable() -> Iterator[Signals]:
    """Inside, the first signal raises `Stopped` wherever the process is, unless it is polled for. The next one, of
    whatever kind, ends the process at once, also within a long call of a library. (If the library lets other threads
    run, as compilers do.)

    Inside of another `stoppable` it is the same one. Outside of the main thread signals are somebody else's.
    """
    if _active:
        yield _active[-1]
        return
    signals = Signals()
    if threading.current_thread() is not threading.main_thread():
        yield signals
        return
    _active.append(signals)
    try:
        with signals._caught():
            yield signals
    finally:
        _active.remove(signals)


def take_back() -> None:
    """After code of others, which may have put in handlers of its own, or blocked the signals."""
    if _active and threading.current_thread() is threading.main_thread():
        _active[-1].take_back()


@contextlib.contextmanager
def unbroken() -> Iterator[None]:
    """Inside, a signal does not raise `Stopped`; it does at the end. For what must not be left half done, such as a new
    process."""
    if not _active:
        yield
        return
    signals = _active[-1]
    with signals.polled():
        yield
    if signals.received and not signals.is_polled:
        raise Stopped
