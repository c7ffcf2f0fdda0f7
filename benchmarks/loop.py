"""Measures the loop of `train`: `python -m benchmarks.loop --out docs/results/loop.json`.

Share: for how much of the wall time the learner computes train steps, with an environment that takes no time and with
one that sleeps 20 ms a step in a process of its own. Memory: a run that writes many times more to the replay buffer
than it may map. Each run is a process of its own; the numbers are those of its metrics.jsonl, the first lines
(compilation) left out.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces as gym

from benchmarks.machine import command
from dreamer_spec.monitoring.logger import iterate_metrics
from dreamer_spec.system.machine import describe

EPISODE = 200
SLOW_STEP = 0.02  # seconds


class Vectors(gymnasium.Env[Any, Any]):
    """24 random numbers, two continuous actions."""

    observation_space: gym.Space[Any] = gym.Box(-np.inf, np.inf, (24,), np.float32)
    action_space = gym.Box(-1, 1, (2,), np.float32)
    seconds = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._time = 0
        return self.observation(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._time += 1
        time.sleep(self.seconds)
        return self.observation(), float(action[0]), False, self._time == EPISODE, {}

    def observation(self) -> np.ndarray:
        return self.np_random.normal(size=24).astype(np.float32)


class SlowVectors(Vectors):
    seconds = SLOW_STEP


class Images(Vectors):
    """Images 64 x 64 x 3 of noise: nothing that could be compressed."""

    observation_space = gym.Box(0, 255, (64, 64, 3), np.uint8)

    def observation(self) -> np.ndarray:
        return self.np_random.integers(0, 256, (64, 64, 3), np.uint8)


def train(backend: str, task: str, folder: Path, *options: str) -> list[dict[str, float]]:
    """The metrics of a run without evaluations."""
    call = [
        sys.executable,
        "-m",
        "dreamer_spec",
        "--backend",
        backend,
        "--task",
        f"benchmarks.loop:{task}",
        "--logdir",
        str(folder),
    ]
    quiet = [
        "--eval-every",
        "0",
        "--eval-episodes",
        "0",
        "--random-episodes",
        "0",
        "--no-preflight",
        "--log-every",
        "2",
    ]
    result = subprocess.run([*call, *quiet, *options], capture_output=True, text=True, check=False)
    if result.returncode:
        raise RuntimeError(result.stderr.strip().splitlines()[-1])
    return [line for line in iterate_metrics(folder / "metrics.jsonl") if line and "speed/learner_share" in line]


def measure_share(backend: str, task: str, size: str, steps: int) -> dict[str, Any]:
    """Medians over the lines after the first ones, in which the train step is compiled."""
    with tempfile.TemporaryDirectory() as folder:
        options = ["--size", size, "--steps", str(steps), "--envs", "4", "--replay-ratio", "128", "--processes", "yes"]
        lines = train(backend, task, Path(folder) / "run", *options)
    trained = [line for line in lines if line.get("speed/train_steps", 0) > 0][2:]
    names = [name for name in trained[0] if name.startswith(("speed/", "time/"))]
    return {
        "backend": backend,
        "environment": task,
        "size": size,
        "lines": len(trained),
        **{name: round(float(np.median([line[name] for line in trained])), 4) for name in names},
    }


def measure_memory(backend: str, steps: int, limit: float) -> dict[str, Any]:
    """Resident memory over a run that hardly trains; limit: GiB."""
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder) / "run"
        model = [
            "--size",
            "tiny",
            "--envs",
            "8",
            "--replay-ratio",
            "1",
            "--processes",
            "no",
            "--replay-capacity",
            "1000000",
        ]
        lines = train(backend, "Images", directory, "--steps", str(steps), "--replay-memory", str(limit), *model)
        written = sum(file.stat().st_blocks * 512 for file in (directory / "replay").glob("chunk-*"))
    chosen = [lines[i] for i in np.unique(np.linspace(2, len(lines) - 1, 12).astype(int))]
    return {
        "backend": backend,
        "limit_gib": limit,
        "written_gib": round(written / 2**30, 2),
        "points": [[int(line["step"]), round(line["memory/resident"], 3)] for line in chosen],
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--backends", nargs="+", default=["jax", "torch"])
    parser.add_argument("--size", default="1m")
    parser.add_argument("--steps", type=int, default=2_500, help="of a run that measures the share")
    parser.add_argument("--memory-steps", type=int, default=150_000)
    parser.add_argument("--memory-limit", type=float, default=0.125, help="GiB of the buffer that may be mapped")
    parser.add_argument("--out", type=Path, default=None, help="JSON file for the results")
    options = parser.parse_args()
    shares, memory = [], []
    for backend in options.backends:
        for task in ("Vectors", "SlowVectors"):
            shares.append(measure_share(backend, task, options.size, options.steps))
            print(json.dumps(shares[-1]), flush=True)
    for backend in options.backends:
        memory.append(measure_memory(backend, options.memory_steps, options.memory_limit))
        print(json.dumps(memory[-1]), flush=True)
    if options.out:
        report = {"command": command("benchmarks.loop"), "machine": describe(), "shares": shares, "memory": memory}
        options.out.write_text(json.dumps(report, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
