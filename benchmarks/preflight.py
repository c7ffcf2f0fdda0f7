"""Seconds of each part of the preflight: `python -m benchmarks.preflight --out docs/results/preflight.json`.

As before a run: batch 16 x 64, six continuous actions, a vector of 24 numbers or one 64 x 64 x 3 image. Every case runs
in a process of its own, so that JAX compiles all of it anew.
"""

import argparse
import itertools
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.machine import command, matrix_rate
from benchmarks.train_step import OBSERVATIONS
from dreamer_spec.system.machine import describe
from spec import Spaces, Vector, load_config


def measure(backend: str, size: str, observation: str, dtype: str) -> dict[str, Any]:
    """One case in this process.

    Raises:
      RuntimeError: the preflight failed.
    """
    spaces = Spaces(OBSERVATIONS[observation], {"action": Vector(6)})
    start = time.perf_counter()
    from conformance.preflight import preflight  # with the reference and all checks, which takes a moment

    report = preflight(backend, spaces, load_config("paper", size, compute_dtype=dtype))
    if not report.passed:
        raise RuntimeError(report.summary)
    return {"parts": report.seconds, "total": round(time.perf_counter() - start, 2)}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--sizes", nargs="+", default=["tiny", "1m", "12m"])
    parser.add_argument("--out", type=Path, default=None, help="JSON file for the results")
    parser.add_argument("--case", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case:
        print(json.dumps(measure(*options.case)))
        return
    machine = describe() | {"numpy_gflops": round(matrix_rate(), 1)}
    print(json.dumps(machine))
    results = []
    for size, *others in itertools.product(options.sizes, OBSERVATIONS, ("float32", "bfloat16"), ("jax", "torch")):
        observation, dtype, backend = others
        arguments = [sys.executable, "-m", "benchmarks.preflight", "--case", backend, size, observation, dtype]
        ran = subprocess.run(arguments, stdout=subprocess.PIPE, text=True, check=True)
        case = {"backend": backend, "size": size, "observation": observation, "dtype": dtype}
        results.append(case | json.loads(ran.stdout.splitlines()[-1]))
        print(results[-1], flush=True)
    if options.out:
        report = {"command": command("benchmarks.preflight"), "machine": machine, "results": results}
        options.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
