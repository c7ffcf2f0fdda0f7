"""Run first in a process: hides from our code what Linux has and other systems do not. The packages that we use are
imported before.

What cannot be pretended: that a file which is open or mapped can be neither removed nor renamed (Windows), paths, and
other processes.
"""

import builtins
import importlib.abc
import io
import os
import signal
import sys
from typing import Any

import filelock
import gymnasium  # noqa: F401
import matplotlib.pyplot  # noqa: F401
import rich.progress  # noqa: F401
import safetensors.numpy  # noqa: F401
from PIL import Image  # noqa: F401
from torch.utils.tensorboard.writer import SummaryWriter  # noqa: F401

MODULES = ("fcntl", "resource", "pwd", "grp", "termios", "pty", "tty")
CALLS = (
    "sysconf sched_getaffinity getuid geteuid getgid pread pwrite posix_fallocate fork "
    "forkpty setsid killpg getpgid openpty "
)
CALLS += "O_NOFOLLOW O_NONBLOCK O_DIRECTORY O_CLOEXEC O_ASYNC getloadavg nice uname"
SIGNALS = "SIGHUP SIGKILL SIGALRM SIGUSR1 SIGUSR2 SIGCHLD SIGPIPE SIGQUIT setitimer alarm pthread_sigmask siginterrupt"


class _Missing(importlib.abc.MetaPathFinder):
    def find_spec(self, fullname: str, path: Any, target: Any = None) -> None:
        if fullname in MODULES:
            raise ModuleNotFoundError(f"No module named {fullname!r}", name=fullname)


def hide() -> None:
    sys.meta_path.insert(0, _Missing())
    for name in MODULES:
        sys.modules.pop(name, None)
    for module, names in ((os, CALLS), (signal, SIGNALS)):
        for name in names.split():
            if hasattr(module, name):
                delattr(module, name)
    filelock.FileLock = filelock.SoftFileLock  # type: ignore[misc]  # That of this system needs what is hidden.
    real = io.open

    def without_kernel(file: Any, *args: Any, **given: Any) -> Any:
        if str(file).startswith(("/proc/", "/sys/", "/dev/shm")):
            raise FileNotFoundError(2, "No such file or directory", str(file))
        return real(file, *args, **given)

    builtins.open = io.open = without_kernel  # type: ignore[assignment]


hide()
