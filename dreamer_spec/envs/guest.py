"""An environment in the trainer's own process is a guest there: what it changes of the process is put back when it has
had its turn."""

import contextlib
import os
import sys
from collections.abc import Iterator

from conformance.output import open_descriptors
from dreamer_spec.system import signals

_theirs: str | None = None  # the working directory that the guests went to, and are brought to again


def _directory() -> str | None:
    """None where it has been removed: a run whose log directory is absolute goes on without it."""
    try:
        return os.getcwd()
    except OSError:
        return None


@contextlib.contextmanager
def guest() -> Iterator[None]:
    """Inside runs code of environments. At the end the working directory, the standard streams and their descriptors,
    and the handlers of the signals that end a run are as they were: a log directory may be relative, and a new file
    must not get the number of an output. Threads that open files in the meantime need absolute paths.
    """
    global _theirs
    home, out, error = _directory(), sys.stdout, sys.stderr
    if _theirs is not None:
        with contextlib.suppress(OSError):
            os.chdir(_theirs)
    try:
        yield
    finally:
        if home is not None and (here := _directory()) != home:
            _theirs = here
            with contextlib.suppress(OSError):  # It has been removed.
                os.chdir(home)
        else:
            _theirs = None
        sys.stdout, sys.stderr = out, error
        open_descriptors()
        signals.take_back()
