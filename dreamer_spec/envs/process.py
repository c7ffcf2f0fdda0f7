"""What the processes of environments have in common: how they are started, how they begin, and that they end with their
trainer."""

import contextlib
import errno
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from multiprocessing import connection
from types import ModuleType

from conformance.output import never_fail
from dreamer_spec.envs.failure import describe
from dreamer_spec.system.signals import NUMBERS, unbroken

CLOSING = 5.0  # seconds that environments have to close by themselves
DYING = 5.0  # seconds that a process has to be gone after it was killed

REMEDIES = {
    errno.EMFILE: "raise the limit of open files (ulimit -n), or use fewer environments (--envs) or --processes no",
    errno.ENFILE: "the system has too many open files; use fewer environments (--envs) or --processes no",
    errno.EAGAIN: "raise the limit of processes (ulimit -u), or use fewer environments (--envs) or --processes no",
    errno.ENOMEM: "use fewer environments (--envs) or --processes no",
    errno.ENOSPC: "free space in the folder for temporary files or in /dev/shm, or use --processes no",
}


def start_method() -> str:
    """Workers must not be forks of this process: a backend has threads in it."""
    if sys.platform == "win32":
        return "spawn"
    multiprocessing.set_forkserver_preload(
        ["dreamer_spec.system.worker_threads", "dreamer_spec.envs"]
    )  # In this order.
    return "forkserver"


@contextlib.contextmanager
def starting() -> Iterator[None]:
    """Inside processes are started: no signal leaves one half made, and none imports the main module, which a script
    would be run by again that has no `if __name__ == "__main__"`. They need nothing of it: what a script defines comes
    to them by value.
    """
    with unbroken():
        main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = main


def not_started(error: BaseException) -> str:
    """Why a process could not be started, and what to do about it."""
    remedy = REMEDIES.get(getattr(error, "errno", None) or 0, "")
    if "AF_UNIX path too long" in str(error):
        remedy = "set TMPDIR to a folder with a shorter path, or use --processes no"
    if isinstance(error, EOFError | ConnectionError):
        remedy = "it ended before it answered; if it said why, that is above"
    return f"its process cannot be started: {describe(error)}" + (f"; {remedy}" if remedy else "")


def ended(code: int | None) -> str:
    """Why a process gives no answers any more."""
    if code is not None and code < 0:
        return f"its process was ended by {signal.Signals(-code).name} (killed, or out of memory?)"
    return f"its process ended with exit code {code}; if it said why, that is above"


def no_answer(seconds: float) -> str:
    return f"no answer within {seconds:g} seconds (--env-timeout)"


def begin_worker() -> None:
    """To be called first in a process of environments."""
    for number in NUMBERS:  # Sent to the whole group, they are for the trainer, which closes its workers.
        signal.signal(number, signal.SIG_IGN)
    never_fail()
    _end_with_trainer()


def _end_with_trainer() -> None:
    """Whatever this process does then, and also if the trainer was killed.

    A thread waits for that. It cannot run while code in C keeps Python's lock; on Linux the kernel itself kills the
    process.
    """
    trainer = multiprocessing.parent_process()
    if trainer is None:
        return
    if sys.platform == "linux":
        import fcntl

        # A pipe of which the trainer alone has the other end: the kernel signals that it is closed.
        fcntl.fcntl(trainer.sentinel, fcntl.F_SETOWN, os.getpid())
        fcntl.fcntl(trainer.sentinel, fcntl.F_SETSIG, signal.SIGKILL)
        fcntl.fcntl(trainer.sentinel, fcntl.F_SETFL, fcntl.fcntl(trainer.sentinel, fcntl.F_GETFL) | os.O_ASYNC)

    def wait() -> None:
        connection.wait([trainer.sentinel])
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
