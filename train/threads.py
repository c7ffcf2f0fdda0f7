"""How many threads compute: no more than the cores that this process may use, and one where a model is too small to share its work."""

import os
from pathlib import Path

from spec import Config, Spaces

# Up to this many recurrent units, and without images, PyTorch is hardly faster with several threads on a quiet machine, and
# slower on a busy one: each of the thousands of small operations of a train step waits for the slowest thread.
SMALL = 256
VARIABLES = {"torch": "OMP_NUM_THREADS", "jax": "NPROC"}  # what the user may have set instead of --threads

# How long a thread of PyTorch (GNU OpenMP) spins for the next operation before it sleeps. By default it spins for so long that
# the threads keep each other from working where other processes want the cores: docs/runs.md has the numbers.
SPIN = ("GOMP_SPINCOUNT", "10000")


def choose(backend: str, config: Config, spaces: Spaces, wanted: int | None = None) -> int:
    """What is wanted (--threads), or what the backend's environment variable says, or what suits the model and the cores."""
    given = os.environ.get(VARIABLES[backend], "")
    if wanted or (given.isdecimal() and int(given)):
        return wanted or int(given)
    small = config.deter <= SMALL and not spaces.images
    return 1 if backend == "torch" and small else usable_cores()


def spin_briefly() -> None:
    """Before PyTorch is imported. What the user has set stays."""
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault(*SPIN)


def usable_cores(cgroups: Path = Path("/sys/fs/cgroup"), membership: Path = Path("/proc/self/cgroup")) -> int:
    """Cores that this process may use: its affinity, and the quota of its container; at least 1."""
    if hasattr(os, "process_cpu_count"):  # Python 3.13
        cores = os.process_cpu_count() or 1
    elif hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    return max(1, int(min([cores, *_quotas(cgroups, membership)])))


def _quotas(cgroups: Path, membership: Path) -> list[float]:
    """The quotas of CPU time of this process's control groups, in cores; of versions 1 and 2, up to the root."""
    quotas = []
    for line in (_text(membership) or "").splitlines():
        _, controllers, group = line.split(":", 2)
        if controllers and "cpu" not in controllers.split(","):
            continue
        root = cgroups / "cpu" if controllers else cgroups
        folder = root / group.strip("/")
        for place in (folder, *folder.parents):
            if controllers:
                words = [_text(place / f"cpu.cfs_{name}_us") or "" for name in ("quota", "period")]
            else:
                words = (_text(place / "cpu.max") or "").split()
            if len(words) == 2 and all(word.strip().isdecimal() for word in words) and int(words[1]):  # Without a quota: "max" or -1.
                quotas.append(int(words[0]) / int(words[1]))
            if place == root:
                break
    return quotas


def _text(path: Path) -> str | None:
    try:
        return path.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        return None
