"""Everything to run once on a machine with an accelerator: `python -m benchmarks.gpu --out FOLDER`, ten minutes at
most.

Conformance of both backends on the device in float32 and bfloat16, the train-step benchmark at 12m and 200m, and a
short training with its learning curve. Needs no network and no installation: the repository on PYTHONPATH, and the
packages present. Conformance runs share the machine, everything else has it alone. Each part is a process with its
share of the time; one that fails or runs out of time is recorded as such, and the others go on. With `--small` the same
parts run with sizes that a CPU manages.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from dreamer_spec.system.machine import describe

Part = tuple[str, list[str]]
GRACE = 20.0  # seconds that an interrupted training has for its checkpoint


def stages(out: Path, backends: list[str], device: str | None, small: bool) -> list[list[Part]]:
    """Name and command line of each part, the most telling first. The parts of one stage run at once."""
    where = ["--device", device] if device else []

    def conformance(backend: str, dtype: str) -> Part:
        name = f"conformance-{backend}-{dtype}"
        kit = ["-m", "conformance.cli", "check", backend, "--dtype", dtype, "--examples", "5", *where]
        return name, [*kit, "--json", str(out / f"{name}.json")]

    def train_step(backend: str, size: str) -> Part:
        name = f"train-step-{backend}-{size}"
        case = ["--backends", backend, "--sizes", size, "--dtypes", "float32", "bfloat16", *where]
        batch = ["--batch-size", "4", "--batch-length", "16"] if small else []
        return name, ["-m", "benchmarks.train_step", *case, *batch, "--out", str(out / f"{name}.json")]

    def training(backend: str) -> Part:
        name, steps = f"training-{backend}", "1500" if small else "10000"
        return name, ["-m", "dreamer_spec", "--backend", backend, "--steps", steps, "--logdir", str(out / name), *where]

    return [
        [conformance(backend, dtype) for dtype in ("float32", "bfloat16") for backend in backends],
        *(
            [train_step(backend, size)]
            for size in (("tiny", "1m") if small else ("12m", "200m"))
            for backend in backends
        ),
        *([training(backend)] for backend in backends),
    ]


def run_part(part: Part, out: Path, seconds: float) -> dict[str, Any]:
    """Runs one part with its output in a log file."""
    name, command = part
    start = time.monotonic()
    environment = os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", "PYTHONUNBUFFERED": "1"}
    with open(out / f"{name}.log", "w", encoding="utf-8") as log:
        process = subprocess.Popen([sys.executable, *command], stdout=log, stderr=log, env=environment)
        try:
            code = process.wait(seconds)
            status = "passed" if code == 0 else f"exit code {code}"
        except subprocess.TimeoutExpired:
            status = f"stopped after {seconds:.0f} s"
            process.send_signal(signal.SIGINT)
            try:
                process.wait(GRACE)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
    last = (out / f"{name}.log").read_text(encoding="utf-8").strip().splitlines()[-1:] or [""]
    return {"part": name, "status": status, "seconds": round(time.monotonic() - start, 1), "last_line": last[0]}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for JSON, logs and pictures")
    parser.add_argument("--backends", nargs="+", default=["jax", "torch"])
    parser.add_argument(
        "--device", default=None, help="device as the backends name it; default: the backend's own choice"
    )
    parser.add_argument("--minutes", type=float, default=9.0, help="time for everything")
    parser.add_argument("--small", action="store_true", help="sizes for a CPU")
    parser.add_argument("--only", default="", help="only parts whose name contains this")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    deadline = time.monotonic() + 60 * options.minutes
    everything = stages(options.out, options.backends, options.device, options.small)
    selected = [found for stage in everything if (found := [part for part in stage if options.only in part[0]])]
    report: dict[str, Any] = {"machine": describe(), "parts": []}
    print(json.dumps(report["machine"]))
    for index, stage in enumerate(selected):
        left = deadline - time.monotonic()
        # A stage may take what is left, but leaves a third of an equal share to each one after it.
        share = left - (len(selected) - index - 1) * left / len(selected) / 3 - GRACE
        with ThreadPoolExecutor(len(stage)) as pool:
            for result in pool.map(lambda part, share=share: run_part(part, options.out, max(share, 1.0)), stage):
                report["parts"].append(result)
                print(json.dumps(result), flush=True)
        (options.out / "report.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return 0 if all(part["status"] == "passed" for part in report["parts"]) else 1


if __name__ == "__main__":
    sys.exit(main())
