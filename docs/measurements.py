"""The tables of what `benchmarks` and lockstep measured: header and rows, from the files in docs/results."""

import json
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).resolve().parent / "results"

Table = tuple[list[str], list[list[str]]]


def train_step() -> Table:
    """`make bench`, one line for each case."""
    report = json.loads((RESULTS / "train-step.json").read_text(encoding="utf-8"))
    header = ["backend", "size", "observation", "dtype", "train step", "start to first step", "peak memory"]
    rows = []
    for entry in report["results"]:
        times = [f"{entry['step_s']:.2f} s", f"{entry['first_step_s']:.0f} s", f"{entry['peak_memory_gib']:.1f} GiB"]
        rows.append([entry[name] for name in header[:4]] + times)
    return header, rows


def preflight() -> Table:
    """A committed run of `benchmarks.preflight`: seconds of each part, "" where a precision does without it."""
    report = json.loads((RESULTS / "preflight.json").read_text(encoding="utf-8"))
    parts = ("networks", "losses and gradient", "learner", "batch", "gradient")
    rows = []
    for entry in report["results"]:
        seconds = [entry["parts"].get(part) for part in parts]
        rows.append(
            [entry[name] for name in ("size", "observation", "dtype", "backend")]
            + ["" if value is None else f"{value:.1f}" for value in (*seconds, entry["total"])]
        )
    return ["size", "observation", "dtype", "backend", *parts, "in all"], rows


def learning() -> Table:
    """The last evaluation of every run in the committed learning curves."""
    rows = []
    for path in sorted(RESULTS.glob("learning-*.json")):
        for run in json.loads(path.read_text(encoding="utf-8"))["runs"]:
            if run["evaluation/return"]:
                step, minutes, value = run["evaluation/return"][-1]
                random, times = (f"{run['random']:.4g}", f"{value / run['random']:.1f}") if run["random"] else ("", "")
                name = path.stem.removeprefix("learning-")
                rows.append(
                    [name, run["backend"], str(run["seed"]), f"{step:,}", f"{minutes:.1f}", f"{value:g}", random, times]
                )
    return ["curve", "backend", "seed", "steps", "minutes", "return", "random policy", "ratio"], rows


def replay(name: str) -> Table:
    """A committed run of `benchmarks.replay`."""
    rows = []
    for entry in json.loads((RESULTS / f"replay-{name}.json").read_text(encoding="utf-8"))["results"]:
        counts = [entry[key] for key in ("records", "inserts_per_s", "batches_per_s")]
        times = [
            f"{entry['write_back_ms']:.2g} ms",
            f"{entry['write_back_after_save_ms']:.2g} ms",
            f"{entry['save_s']:.2g} s",
        ]
        memory = [f"{entry[key]:,} MiB" for key in ("data_mib", "memory_limit_mib", "own_mib", "mapped_mib")]
        rows.append([entry["kind"], *(f"{count:,}" for count in counts), *times, *memory])
    header = [
        "record",
        "stored",
        "inserts/s",
        "batches/s",
        "write-back",
        "after a save",
        "save",
        "data",
        "limit",
        "own memory",
        "mapped",
    ]
    return header, rows


def loop_shares() -> Table:
    """The shares of a committed run of `benchmarks.loop`."""
    rows = []
    for entry in _loop()["shares"]:
        numbers = [
            f"{entry['speed/steps']:.0f}",
            f"{entry['speed/train_steps']:.1f}",
            f"{entry['speed/learner_share']:.1%}",
        ]
        parts = [f"{entry[f'time/{part}']:.1%}" for part in ("policy", "environments", "replay", "train", "other")]
        environment = {"Vectors": "no time", "SlowVectors": "20 ms a step"}[entry["environment"]]
        rows.append([entry["backend"], environment, *numbers, *parts])
    header = [
        "backend",
        "environment",
        "steps/s",
        "train steps/s",
        "learner's share",
        "policy",
        "environments",
        "replay",
        "train",
        "other",
    ]
    return header, rows


def loop_memory() -> Table:
    """The memory of a committed run of `benchmarks.loop`."""
    rows = [
        [entry["backend"], f"{step:,}", f"{size:.2f} GiB"]
        for entry in _loop()["memory"]
        for step, size in entry["points"]
    ]
    return ["backend", "environment steps", "memory of the process"], rows


def _loop() -> dict[str, Any]:
    return json.loads((RESULTS / "loop.json").read_text(encoding="utf-8"))


def lockstep(mode: str, dtypes: tuple[str, ...]) -> Table:
    """The worst deviation of each group in the first 100 steps, and after them."""
    columns: dict[str, dict[str, list[str]]] = {}
    for dtype in dtypes:
        for problem, found in json.loads((RESULTS / f"lockstep-{dtype}.json").read_text(encoding="utf-8"))[
            "problems"
        ].items():
            early = sum(step <= 100 for step in found["steps"])
            for name, modes in found["comparisons"].items():
                curves = modes[mode]["curves"].items()
                columns[f"{name}, {dtype}, {problem}"] = {
                    group: [_worst(curve[:early]), _worst(curve[early:])] for group, curve in curves
                }
    groups = next(iter(columns.values()))
    return ["group", *columns], [[group, *(" / ".join(cells[group]) for cells in columns.values())] for group in groups]


def _worst(curve: list[float | None]) -> str:
    if not curve:
        return "parted"
    return "∞" if None in curve else f"{max(value for value in curve if value is not None):.0e}".replace("0e+00", "0")
