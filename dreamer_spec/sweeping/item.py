"""One run of a sweep, as a process: `python -m dreamer_spec.sweeping.item WORDS`, the words after `train`.

Its standard input is a pipe that the sweep holds. When that closes, because the sweep ends or has died, the run ends
as after a termination signal: with a checkpoint.
"""

import os
import signal
import sys
import threading


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
    from dreamer_spec.cli import command

    sys.argv = ["train", *sys.argv[1:]]
    command()


if __name__ == "__main__":
    main()
