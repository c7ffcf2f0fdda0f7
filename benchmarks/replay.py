"""Measures the replay buffer of a run: `python -m benchmarks.replay`.

Records come from 16 environments; a batch is 16 sequences of 65 records. Three kinds of record: one image 64 x 64 x 3
and 24 floats with the latents of 12m (deter 2048, stoch 32), the same with latents of one number, and small ones (4
floats, latents of 8 numbers). Every case is filled first and runs in a process of its own, so that its resident memory
is its own. Prints a table and with `--out` writes JSON.

Columns `/cpu_s` count the processor time of the process instead of wall time: what a machine gives that nobody else
uses, and whose disk keeps up.

Resident memory is split as the kernel does: `own` belongs to the process, `mapped` are pages of chunk files, which the
kernel may drop.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import command
from dreamer_spec.replay import Replay
from dreamer_spec.system.machine import describe

WORKERS, ROWS, LENGTH = 16, 16, 64
KINDS = {
    "image": {"image": (64, 64, 3), "vector": 24, "deter": 2048, "stoch": 32},
    "image, no latents": {"image": (64, 64, 3), "vector": 24, "deter": 1, "stoch": 1},
    "small": {"image": None, "vector": 4, "deter": 8, "stoch": 4},
}


def records(kind: str, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Records of all workers, as a policy step gives them."""
    sizes: dict[str, Any] = KINDS[kind]
    image = {"image": rng.integers(0, 256, (WORKERS, *sizes["image"]), np.uint8)} if sizes["image"] else {}
    return image | {
        "vector": rng.normal(size=(WORKERS, sizes["vector"])).astype(np.float32),
        "reward": np.zeros(WORKERS, np.float32),
        **{flag: np.zeros(WORKERS, bool) for flag in ("is_first", "is_last", "is_terminal")},
        "action": rng.normal(size=(WORKERS, 6)).astype(np.float32),
        **latents(kind, rng, (WORKERS,)),
    }


def latents(kind: str, rng: np.random.Generator, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    sizes: dict[str, Any] = KINDS[kind]
    deter = rng.random((*shape, sizes["deter"]), np.float32)
    return {"deter": deter, "stoch": rng.integers(0, 16, (*shape, sizes["stoch"]), np.int32)}


def resident() -> dict[str, float]:
    """Resident memory in MiB."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    values = {
        name: int(text.split()[0]) / 1024
        for name, _, text in (line.partition(":") for line in lines)
        if name.startswith("Rss")
    }
    return {"own_mib": round(values["RssAnon"]), "mapped_mib": round(values["RssFile"])}


def measure(kind: str, filled: int, seconds: float, limit: int, directory: Path) -> dict[str, Any]:
    """One case in this process: a buffer that holds `filled` records and is full, so that every record evicts one."""
    rng = np.random.default_rng(0)
    replay = Replay(filled, LENGTH, directory, memory_limit=limit)
    steps = [records(kind, rng) for _ in range(8)]
    start = time.perf_counter()
    rounds = filled // WORKERS + LENGTH
    for n in range(rounds):
        replay.add_batch(steps[n % 8])
    filling = rounds * WORKERS / (time.perf_counter() - start)
    bytes_of_record = replay.storage.layout.record_bytes if replay.storage else 0
    fresh = latents(kind, rng, (ROWS, LENGTH))
    batch = replay.sample(rng.random(ROWS))
    writes, draws, new_draws = [], [], []
    inserted, until = 0, time.perf_counter() + seconds
    start, cpu = time.perf_counter(), time.process_time()
    while time.perf_counter() < until:
        for n in range(64):
            replay.add_batch(steps[n % 8])
        inserted += 64 * WORKERS
    inserts, cpu_inserts = inserted / (time.perf_counter() - start), inserted / (time.process_time() - cpu)
    cpu, until = time.process_time(), time.perf_counter() + seconds
    draw_count = 0
    while time.perf_counter() < until:
        replay.sample(rng.random(ROWS), out=batch)
        draw_count += 1
    cpu_draws = draw_count / (time.process_time() - cpu)
    until = time.perf_counter() + 2 * seconds
    while time.perf_counter() < until:
        draws.append(timed(lambda: replay.sample(rng.random(ROWS), out=batch)))
        new_draws.append(timed(lambda: replay.sample(rng.random(ROWS))))
        writes.append(timed(lambda: replay.write_back(batch["ids"], fresh)))
    save = timed(lambda: replay.save("a"))
    journaled = []
    until = time.perf_counter() + seconds
    while time.perf_counter() < until:
        replay.sample(rng.random(ROWS), out=batch)
        journaled.append(timed(lambda: replay.write_back(batch["ids"], fresh)))
    return {
        "kind": kind,
        "records": filled,
        "record_bytes": bytes_of_record,
        "data_mib": round(filled * bytes_of_record / 2**20),
        "memory_limit_mib": limit >> 20,
        "filling_per_s": round(filling),
        "inserts_per_s": round(inserts),
        "inserts_per_cpu_s": round(cpu_inserts),
        "batches_per_cpu_s": round(cpu_draws),
        "batches_per_s": round(1 / statistics.median(draws)),
        "batches_per_s_mean": round(len(draws) / sum(draws)),
        "new_batches_per_s": round(1 / statistics.median(new_draws)),
        "write_back_ms": round(1e3 * statistics.median(writes), 2),
        "write_back_after_save_ms": round(1e3 * statistics.median(journaled), 2),
        "save_s": round(save, 2),
        "batch_mb": round(sum(array.nbytes for array in batch.values()) / 1e6, 1),
        **resident(),
    }


def timed(function: Any) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def run_case(kind: str, filled: int, options: argparse.Namespace, limit: int) -> dict[str, Any]:
    """One case in a process of its own."""
    with tempfile.TemporaryDirectory(prefix="replay-", dir=options.directory) as directory:
        call = [
            sys.executable,
            "-m",
            "benchmarks.replay",
            "--case",
            kind,
            "--records",
            str(filled),
            "--directory",
            directory,
        ]
        settings = ["--seconds", str(options.seconds), "--limits", str(limit >> 20)]
        result = subprocess.run([*call, *settings], capture_output=True, text=True, check=False)
    if result.returncode:
        return {"kind": kind, "records": filled, "error": result.stderr.strip().splitlines()[-1]}
    return json.loads(result.stdout.splitlines()[-1])


COLUMNS = (
    ("kind", 19),
    ("records", 9),
    ("data_mib", 9),
    ("memory_limit_mib", 17),
    ("filling_per_s", 14),
    ("inserts_per_s", 14),
    ("inserts_per_cpu_s", 18),
    ("batches_per_s", 14),
    ("batches_per_cpu_s", 18),
    ("batches_per_s_mean", 19),
    ("new_batches_per_s", 18),
    ("write_back_ms", 14),
    ("write_back_after_save_ms", 25),
    ("save_s", 7),
    ("own_mib", 8),
    ("mapped_mib", 11),
)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=tuple(KINDS))
    parser.add_argument("--records", nargs="+", type=int, default=[10_000, 100_000], help="stored records")
    parser.add_argument("--limits", nargs="+", type=int, default=[2048], help="memory limits in MiB")
    parser.add_argument("--seconds", type=float, default=3.0, help="of each kind of measurement")
    parser.add_argument(
        "--directory", type=Path, default=None, help="where the files are; the system's temporary directory"
    )
    parser.add_argument("--out", type=Path, default=None, help="JSON file for the results")
    parser.add_argument("--case", default=None, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case:
        case = measure(
            options.case, options.records[0], options.seconds, options.limits[0] << 20, options.directory / "replay"
        )
        print(json.dumps(case))
        return 0
    machine = describe()
    print(json.dumps(machine))
    print("".join(f"{name:>{width}}" for name, width in COLUMNS))
    results = []
    for kind in options.kinds:
        for limit in options.limits:
            for filled in options.records:
                results.append(run_case(kind, filled, options, limit << 20))
                print(
                    "".join(f"{results[-1].get(name, '-')!s:>{width}}" for name, width in COLUMNS),
                    results[-1].get("error", ""),
                    flush=True,
                )
    if options.out:
        options.out.write_text(
            json.dumps({"command": command("benchmarks.replay"), "machine": machine, "results": results}, indent=1)
            + "\n"
        )
    return 1 if any("error" in result for result in results) else 0


if __name__ == "__main__":
    sys.exit(main())
