"""Times one whole train step of each backend: `python -m benchmarks.train_step` (or `make bench`).

Batch 16 x 64, horizon 15, six continuous actions, data in memory; the observation is a vector of 24 numbers or one 64 x
64 x 3 image. Every case runs in a process of its own, so that its peak memory is its own. Prints a table and with
`--out` writes JSON.
"""

import argparse
import json
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import command, matrix_rate
from dreamer_spec.backend import learner_class
from dreamer_spec.system.machine import describe
from dreamer_spec.system.threads import choose, spin_briefly
from spec import Config, Image, Spaces, Vector, load_config

OBSERVATIONS = {"vector": {"vector": Vector(24)}, "image": {"image": Image(64, 64, 3)}}


def random_batch(rng: np.random.Generator, config: Config, spaces: Spaces) -> dict[str, np.ndarray]:
    """A replay batch of random data without episode ends."""
    B, T = config.batch_size, config.batch_length
    batch: dict[str, np.ndarray] = {}
    for key, space in spaces.observations.items():
        shape = (B, T, *space.array_shape)
        batch[key] = (
            rng.integers(0, 256, shape).astype(np.uint8)
            if isinstance(space, Image)
            else rng.normal(size=shape).astype(np.float32)
        )
    return batch | {
        "reward": rng.normal(size=(B, T)).astype(np.float32),
        **{flag: np.zeros((B, T), bool) for flag in ("is_first", "is_last", "is_terminal")},
        "prev_action": rng.uniform(-1, 1, (B, T, spaces.action_size)).astype(np.float32),
        "deter": np.tanh(rng.normal(size=(B, config.deter))).astype(np.float32),
        "stoch": rng.integers(0, config.classes, (B, config.stoch)),
    }


def measure(
    backend: str,
    size: str,
    observation: str,
    profile: str,
    dtype: str,
    device: str | None,
    steps: int,
    threads: int | None = None,
    **overrides: Any,
) -> dict[str, Any]:
    """One case in this process: seconds from start to the end of the first step, median seconds of the others, peak
    memory."""
    start = time.perf_counter()
    config = load_config(profile, size, compute_dtype=dtype, **overrides)
    spaces = Spaces(OBSERVATIONS[observation], {"action": Vector(6)})
    spin_briefly()
    threads = choose(backend, config, spaces, threads)
    learner = learner_class(backend)(spaces, config, seed=0, device=device, threads=threads)
    batch = random_batch(np.random.default_rng(0), config, spaces)
    finish(learner.train_step(batch, 0))
    first = time.perf_counter() - start
    times = []
    for step in range(steps):
        begin = time.perf_counter()
        finish(learner.train_step(batch, step + 1))
        times.append(time.perf_counter() - begin)
    return {
        "backend": backend,
        "size": size,
        "observation": observation,
        "profile": profile,
        "dtype": dtype,
        "device": learner.device,
        "threads": threads,
        "batch": [config.batch_size, config.batch_length],
        "first_step_s": round(first, 2),
        "step_s": round(statistics.median(times), 4),
        "steps": steps,
        "peak_memory_gib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
        "device_memory_gib": None if learner.device == "cpu" else device_memory(backend),
    }


def finish(result: tuple[Any, Any]) -> None:
    """Waits until everything that a step returned is there."""
    metrics, latents = result
    for value in (*metrics.values(), *latents.values()):
        np.asarray(value)


def device_memory(backend: str) -> float | None:
    """Peak memory of the accelerator in GiB; None on the CPU."""
    if backend == "torch":
        import torch

        return round(torch.cuda.max_memory_allocated() / 2**30, 2) if torch.cuda.is_available() else None
    import jax

    statistics_ = jax.devices()[0].memory_stats() or {}
    return round(statistics_["peak_bytes_in_use"] / 2**30, 2) if "peak_bytes_in_use" in statistics_ else None


def run_case(arguments: list[str]) -> dict[str, Any]:
    """One case in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.train_step", "--case", *arguments]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        return {
            "error": result.stderr.strip().splitlines()[-1] if result.stderr.strip() else f"exit {result.returncode}"
        }
    return json.loads(result.stdout.splitlines()[-1])


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--backends", nargs="+", default=["jax", "torch"])
    parser.add_argument("--sizes", nargs="+", default=["1m", "12m"])
    parser.add_argument("--observations", nargs="+", default=["vector", "image"], choices=tuple(OBSERVATIONS))
    parser.add_argument("--profile", default="paper")
    parser.add_argument("--dtypes", nargs="+", default=["float32"])
    parser.add_argument("--device", default=None)
    parser.add_argument("--threads", type=int, default=None, help="as in training")
    parser.add_argument("--steps", type=int, default=6, help="steps timed after the first")
    parser.add_argument("--batch-size", type=int, default=16)
    parser.add_argument("--batch-length", type=int, default=64)
    parser.add_argument("--out", type=Path, default=None, help="JSON file for the results")
    parser.add_argument("--case", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    batch = {"batch_size": options.batch_size, "batch_length": options.batch_length}
    if options.case:
        case = (
            options.backends[0],
            options.sizes[0],
            options.observations[0],
            options.profile,
            options.dtypes[0],
            options.device,
        )
        print(json.dumps(measure(*case, options.steps, options.threads, **batch)))
        return 0
    machine = describe() | {"numpy_gflops": round(matrix_rate(), 1)}
    print(json.dumps(machine))
    print(f"{'backend':8}{'size':6}{'input':8}{'dtype':10}{'first step':>12}{'step':>10}{'peak memory':>14}")
    results = []
    for size in options.sizes:
        for observation in options.observations:
            for dtype in options.dtypes:
                for backend in options.backends:
                    names = ["--backends", backend, "--sizes", size, "--observations", observation, "--dtypes", dtype]
                    sizes = [f"--{key.replace('_', '-')}={value}" for key, value in batch.items()]
                    where = ["--device", options.device] if options.device else []
                    where += [f"--threads={options.threads}"] if options.threads else []
                    result = run_case(
                        [*names, *sizes, *where, "--profile", options.profile, "--steps", str(options.steps)]
                    )
                    results.append(
                        {"backend": backend, "size": size, "observation": observation, "dtype": dtype} | result
                    )
                    print_row(results[-1])
    if options.out:
        options.out.write_text(
            json.dumps({"command": command("benchmarks.train_step"), "machine": machine, "results": results}, indent=1)
            + "\n"
        )
    return 1 if any("error" in result for result in results) else 0


def print_row(result: dict[str, Any]) -> None:
    start = f"{result['backend']:8}{result['size']:6}{result['observation']:8}{result['dtype']:10}"
    if "error" in result:
        print(f"{start}  error: {result['error']}")
        return
    memory = result["device_memory_gib"] or result["peak_memory_gib"]
    print(f"{start}{result['first_step_s']:>10.1f} s{result['step_s']:>8.3f} s{memory:>10.2f} GiB", flush=True)


if __name__ == "__main__":
    sys.exit(main())
