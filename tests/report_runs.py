"""Runs as folders of files, for the tests of the report."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from dreamer_spec.report.page import render
from dreamer_spec.report.runs import Curve, find_logdirs, read_run

NOW = 2_000_000_000.0
NAN = float("nan")


def curve(steps: list[float], values: list[float]) -> Curve:
    return Curve(np.array(steps, float), np.array(values, float))


def make_run(path: Path, lines: list[dict[str, Any]], **about: Any) -> Path:
    """A log directory with these lines and, where something is to be known about it, a run.json."""
    path.mkdir(parents=True)
    (path / "metrics.jsonl").write_text("".join(json.dumps({"seconds": 1.0, **line}) + "\n" for line in lines))
    if about:
        base = {
            "format": 1,
            "task": "gym:X",
            "backend": "jax",
            "options": {"seed": 0, "steps": 100},
            "hyperparameters": {"units": 8},
        }
        (path / "run.json").write_text(json.dumps({**base, **about}))
    return path


def page(*paths: Path) -> str:
    return render([read_run(path) for path in find_logdirs(paths)], NOW)


# Curves
