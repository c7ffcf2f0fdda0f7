"""How many threads compute: at most the cores that this process may use. The same on a busy machine and on a quiet one,
or a resumed run could not be bit for bit what it would have been."""

import os
from typing import TYPE_CHECKING

from dreamer_spec.system import cgroups

if TYPE_CHECKING:  # The command imports this module before NumPy.
    from spec import Config, Spaces

# Up to this many recurrent units, and without images, PyTorch uses one thread: several are hardly faster on a quiet
# machine, and far slower on a busy one, where each of the thousands of small operations of a train step waits for the
# slowest thread. Larger models leave a core to the environments and to whatever else runs, for the same reason. Numbers
# are in docs/runs.md.
SMALL = 256
VARIABLES = {"torch": "OMP_NUM_THREADS", "jax": "NPROC"}  # what the user may have set instead of --threads

# How long a thread of PyTorch (GNU OpenMP) spins for the next operation before it sleeps. By default it spins for so
# long that the threads keep each other from working where other processes want the cores: docs/runs.md has the numbers.
SPIN = ("GOMP_SPINCOUNT", "10000")


def choose(backend: str, config: "Config", spaces: "Spaces", wanted: int | None = None) -> int:
    """What is wanted (--threads), or what the backend's environment variable says, or what suits the model and the
    cores."""
    given = os.environ.get(VARIABLES[backend], "")
    if wanted or (given.isdecimal() and int(given)):
        return wanted or int(given)
    if backend == "jax":  # its threads do not wait for each other after every operation
        return usable_cores()
    return 1 if config.deter <= SMALL and not spaces.images else max(1, usable_cores() - 1)


def spin_briefly() -> None:
    """Before PyTorch is imported. What the user has set stays."""
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault(*SPIN)


def limit_numpy() -> None:
    """Before NumPy is imported: its linear algebra, which preflight computes with, leaves a core to others too."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", str(max(1, usable_cores() - 1)))


def usable_cores() -> int:
    """Cores that this process may use: its affinity, and the quota of its container; at least 1."""
    if hasattr(os, "process_cpu_count"):  # Python 3.13
        cores = os.process_cpu_count() or 1
    elif hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    return max(1, int(min([cores, *cgroups.quotas()])))
