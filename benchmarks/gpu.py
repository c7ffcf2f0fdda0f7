"""Everything to run once on a machine with an accelerator: `python -m benchmarks.gpu --out FOLDER`, ten minutes at most.

Conformance of both backends on the device in float32 and bfloat16, the train-step benchmark at 12m and 200m, and a short training with its
learning curve. Needs no network and no installation: the repository on PYTHONPATH, and the packages present. Each part runs in a process of
its own with its share of the time; a part that fails or runs out of time is recorded as such, and the others go on. With `--small` the same
parts run with sizes that a CPU manages.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.machine import describe


def accelerator() -> str | None:
    """Name and memory of the first NVIDIA device."""
    try:
        command = ["nvidia-smi", "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip().splitlines()[0]
    except (OSError, subprocess.CalledProcessError, IndexError):
        return None


def parts(out: Path, backends: list[str], device: str | None, small: bool) -> list[tuple[str, list[str]]]:
    """Name and command line of each part, the most telling first."""
    where = ["--device", device] if device else []
    sizes, batch = (["tiny", "1m"], ["--batch-size", "4", "--batch-length", "16"]) if small else (["12m", "200m"], [])
    found: list[tuple[str, list[str]]] = []
    for backend in backends:
        for dtype in ("float32", "bfloat16"):
            command = ["-m", "conformance.cli", "run", "--backend", backend, "--dtype", dtype, "--examples", "5", *where]
            found.append((f"conformance-{backend}-{dtype}", command))
    for size in sizes:
        for backend in backends:
            command = [
                "-m",
                "benchmarks.train_step",
                "--backends",
                backend,
                "--sizes",
                size,
                "--dtypes",
                "float32",
                "bfloat16",
                *batch,
                *where,
            ]
            found.append((f"train-step-{backend}-{size}", [*command, "--out", str(out / f"train-step-{backend}-{size}.json")]))
    for backend in backends:
        run = ["-m", "train", "--backend", backend, "--logdir", str(out / f"training-{backend}"), *where]
        found.append((f"training-{backend}", [*run, *(["--steps", "1500"] if small else [])]))
    return found


def run_part(name: str, command: list[str], out: Path, seconds: float) -> dict[str, Any]:
    """Runs one part with its output in a log file."""
    start = time.monotonic()
    environment = os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", "PYTHONUNBUFFERED": "1"}
    with open(out / f"{name}.log", "w", encoding="utf-8") as log:
        try:
            code = subprocess.run(
                [sys.executable, *command], stdout=log, stderr=log, env=environment, timeout=seconds, check=False
            ).returncode
            status = "passed" if code == 0 else f"exit code {code}"
        except subprocess.TimeoutExpired:
            status = f"stopped after {seconds:.0f} s"
    last = (out / f"{name}.log").read_text(encoding="utf-8").strip().splitlines()[-1:] or [""]
    return {"part": name, "status": status, "seconds": round(time.monotonic() - start, 1), "last_line": last[0]}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for JSON, logs and pictures")
    parser.add_argument("--backends", nargs="+", default=["jax", "torch"])
    parser.add_argument("--device", default=None, help="device as the backends name it; default: the backend's own choice")
    parser.add_argument("--minutes", type=float, default=9.5, help="time for everything")
    parser.add_argument("--small", action="store_true", help="sizes for a CPU")
    parser.add_argument("--only", default="", help="only parts whose name contains this")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    deadline = time.monotonic() + 60 * options.minutes
    selected = [part for part in parts(options.out, options.backends, options.device, options.small) if options.only in part[0]]
    report: dict[str, Any] = {"accelerator": accelerator(), "machine": describe(), "parts": []}
    print(json.dumps({key: report[key] for key in ("accelerator", "machine")}))
    for index, (name, command) in enumerate(selected):
        left = deadline - time.monotonic()
        # A part may take what is left, but leaves a third of an equal share to each part after it.
        share = left - (len(selected) - index - 1) * left / len(selected) / 3
        report["parts"].append(run_part(name, command, options.out, share))
        print(json.dumps(report["parts"][-1]), flush=True)
        (options.out / "report.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return 0 if all(part["status"] == "passed" for part in report["parts"]) else 1


if __name__ == "__main__":
    sys.exit(main())
