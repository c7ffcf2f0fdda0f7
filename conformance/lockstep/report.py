"""A lockstep in plain JSON types, with curves short enough to keep."""

import math
from typing import Any

import numpy as np

from conformance.lockstep.run import Comparison, Lockstep
from conformance.results import finite

POINTS = 48


def report(lockstep: Lockstep) -> dict[str, Any]:
    """What was found on one problem. `steps` are the ends of intervals, and a curve holds the largest deviation in each
    of them."""
    ends = interval_ends(lockstep.steps)
    return {
        "baseline": lockstep.baseline,
        "redrawn_noise": lockstep.redrawn,
        "steps": ends,
        "comparisons": {
            name: {mode: _comparison(comparison, ends) for mode, comparison in modes.items()}
            for name, modes in lockstep.comparisons.items()
        },
    }


def _comparison(comparison: Comparison, ends: list[int]) -> dict[str, Any]:
    exceeded = comparison.exceeded
    return {
        "parted": comparison.parted,
        "exceeded": exceeded
        and {"step": exceeded.step, "tensor": exceeded.tensor.name, "deviation": finite(exceeded.tensor.deviation)},
        "worst": {
            group: {"deviation": finite(tensor.deviation), "step": step, "tensor": tensor.name}
            for group, (step, tensor) in comparison.worst.items()
        },
        "curves": {
            group: [finite(value) for value in reduce(curve, ends)] for group, curve in comparison.curves.items()
        },
    }


def interval_ends(steps: int) -> list[int]:
    """At most POINTS steps from 1 to the last, about equally far apart on a logarithmic axis."""
    return sorted({round(step) for step in np.geomspace(1, steps, POINTS)}) if steps else []


def reduce(curve: list[float], ends: list[int]) -> list[float]:
    """The maximum of each interval that the curve reaches into."""
    begins = [0, *ends[:-1]]
    return [max(part) for begin, end in zip(begins, ends, strict=True) if (part := curve[begin:end])]


def failures(lockstep: Lockstep) -> list[str]:
    """One line for each comparison that is beyond its bound, or whose samples parted in float64; empty below
    float64."""
    lines = []
    for name, modes in lockstep.comparisons.items():
        for mode, comparison in modes.items():
            where = f"{name} against {lockstep.baseline}, {mode}"
            if exceeded := comparison.exceeded:
                deviation = (
                    f"{exceeded.tensor.deviation:.1e}" if math.isfinite(exceeded.tensor.deviation) else "without limit"
                )
                lines.append(
                    f"{where}: step {exceeded.step}, {exceeded.tensor.name} deviates "
                    f"{deviation}, allowed {exceeded.bound:.1e}"
                )
            elif comparison.parted and lockstep.dtype == "float64":
                lines.append(
                    f"{where}: step {comparison.parted}, a sample of the drifted state falls into another class"
                )
    return lines
