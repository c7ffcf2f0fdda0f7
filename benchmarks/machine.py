"""The command that is running, and how fast the machine is today. What machine it is: `dreamer_spec.system.machine`."""

import shlex
import sys
import time

import numpy as np


def command(module: str) -> str:
    """The command line that is running, as one would type it in the root of the repository."""
    return f"python -m {module} {shlex.join(sys.argv[1:])}"


def matrix_rate(size: int = 2048, repeats: int = 5) -> float:
    """GFLOP/s of NumPy's float32 matrix product: what the machine gives today, with its other load."""
    a = np.random.default_rng(0).normal(size=(size, size)).astype(np.float32)
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        a @ a
        times.append(time.perf_counter() - start)
    return 2 * size**3 / min(times) / 1e9
