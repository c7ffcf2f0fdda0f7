"""An environment in the trainer's own process is a guest there: what it changes of the process is put back when it has had its turn."""

import contextlib
import os
import sys
from collections.abc import Iterator

from conformance.output import open_descriptors
from train import signals

_theirs: str | None = None  # the working directory that the guests went to, and are brought to again


@contextlib.contextmanager
def guest() -> Iterator[None]:
    """Inside runs code of environments. At the end the working directory, the standard streams and their descriptors, and the handlers of
    the signals that end a run are as they were: a log directory may be relative, and a new file must not get the number of an output.
    """
    global _theirs
    home, out, error = os.getcwd(), sys.stdout, sys.stderr
    if _theirs is not None:
        with contextlib.suppress(OSError):
            os.chdir(_theirs)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            here = os.getcwd()
            _theirs = here if here != home else None
        os.chdir(home)
        sys.stdout, sys.stderr = out, error
        open_descriptors()
        signals.take_back()
