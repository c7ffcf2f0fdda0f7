"""One run of a sweep, as a process: `python -m dreamer_spec.sweeping.item WORDS`, the words after `train`.

Its standard input is a pipe that the sweep holds. When that closes, because the sweep ends or has died, the run ends
as after a termination signal: with a checkpoint.

The run before it in the same folder may still be at that, if its sweep or its worker was killed: it is waited for.
"""

import os
import signal
import sys
import threading
from pathlib import Path

from dreamer_spec.disk.logdir import wait_until_free

PATIENCE = 120.0  # seconds for the checkpoint of the run before


def end_with(pipe: int) -> None:
    """Waits until the other end of the pipe is closed."""
    while os.read(pipe, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def main() -> None:
    pipe = os.dup(0)
    with open(os.devnull, "rb") as nothing:  # an environment that reads must not read what is ours
        os.dup2(nothing.fileno(), 0)
    os.set_inheritable(pipe, False)
    threading.Thread(target=end_with, args=(pipe,), daemon=True).start()
    wait_until_free(Path(sys.argv[sys.argv.index("--logdir") + 1]), PATIENCE)
    from dreamer_spec.cli import command

    sys.argv = ["train", *sys.argv[1:]]
    command()


if __name__ == "__main__":
    main()
