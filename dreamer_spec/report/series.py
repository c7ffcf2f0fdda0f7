"""From the points of many runs to the few that a picture needs."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from dreamer_spec.report.runs import Curve

LARGEST = 1000  # raw points of a curve that are drawn


@dataclasses.dataclass(frozen=True)
class Band:
    """A line with what lies around it, all [n] and finite. bad: steps [m] at which some value was not finite."""

    steps: np.ndarray
    middle: np.ndarray
    low: np.ndarray
    high: np.ndarray
    bad: np.ndarray

    def __len__(self) -> int:
        return len(self.steps)


def means(curve: Curve, stretches: int, end: float) -> Band:
    """Mean, lowest and highest of the finite values in equal stretches of the steps 0 to `end`; empty stretches are
    left out."""
    finite = np.isfinite(curve.values)
    steps, values = curve.steps[finite], curve.values[finite]
    index = np.minimum((steps / max(end, 1) * stretches).astype(int), stretches - 1)
    starts = np.flatnonzero(np.diff(index, prepend=-1))
    if not len(starts):
        return Band(steps, steps, steps, steps, curve.steps[~finite])
    count = np.diff(starts, append=len(index))
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    # The mean of huge values can overflow, or leave their range by rounding.
    middle = np.clip(np.add.reduceat(values / count.repeat(count), starts), low, high)
    return Band(np.add.reduceat(steps, starts) / count, middle, low, high, curve.steps[~finite])


def over_values(curves: Sequence[Curve], stretches: int, end: float) -> Band:
    """The mean of the runs' means in each stretch, between the lowest and the highest value of any run."""
    bands = [means(curve, stretches, end) for curve in curves]
    steps, reach = _common_steps(bands, stretches), end / stretches
    low = _columns(bands, [band.low for band in bands], steps, reach)
    high = _columns(bands, [band.high for band in bands], steps, reach)
    return _over(bands, steps, _columns(bands, [band.middle for band in bands], steps, reach), low, high)


def over_runs(curves: Sequence[Curve], stretches: int, end: float) -> Band:
    """The mean of the runs' means in each stretch, between the lowest and the highest of these means."""
    bands = [means(curve, stretches, end) for curve in curves]
    steps = _common_steps(bands, stretches)
    middle = _columns(bands, [band.middle for band in bands], steps, end / stretches)
    return _over(bands, steps, middle, middle, middle)


def _over(bands: Sequence[Band], steps: np.ndarray, middle: np.ndarray, low: np.ndarray, high: np.ndarray) -> Band:
    """The mean over runs of `middle`, between the lowest of `low` and the highest of `high`, all [runs, n]."""
    bad = np.unique(np.concatenate([band.bad for band in bands]))
    if not len(steps):
        return Band(steps, steps, steps, steps, bad)
    known = np.isfinite(middle).any(0)  # Between the end of one run and the beginning of another there is nothing.
    with np.errstate(over="ignore"):
        mean = np.nanmean(middle[:, known], 0)
    return Band(steps[known], mean, np.nanmin(low[:, known], 0), np.nanmax(high[:, known], 0), bad)


def _common_steps(bands: Sequence[Band], stretches: int) -> np.ndarray:
    """Steps at which runs can be compared: those that they have, or as many as there are stretches."""
    steps = np.unique(np.concatenate([band.steps for band in bands]))
    return np.linspace(steps[0], steps[-1], stretches) if len(bands) > 1 and len(steps) > stretches > 1 else steps


def _columns(bands: Sequence[Band], values: Sequence[np.ndarray], steps: np.ndarray, reach: float) -> np.ndarray:
    """[runs, n]: what each run has at these steps, NaN further than `reach` before it begins or after it ends."""
    rows = np.full((len(bands), len(steps)), np.nan)
    for row, band, one in zip(rows, bands, values, strict=True):
        if len(band):
            near = (steps >= band.steps[0] - reach) & (steps <= band.steps[-1] + reach)
            row[near] = np.interp(steps[near], band.steps, one)
    return rows


def thinned(curve: Curve) -> Curve:
    """At most LARGEST of the finite points, evenly over their number."""
    keep = np.flatnonzero(np.isfinite(curve.values))
    if len(keep) > LARGEST:
        keep = keep[np.linspace(0, len(keep) - 1, LARGEST).round().astype(int)]
    return Curve(curve.steps[keep], curve.values[keep])


def stacked(curves: dict[str, list[Curve]], stretches: int, end: float) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Steps [n], and for each name its share [n] of the sum at these steps, from the means of all runs."""
    bands = {name: over_runs(runs, stretches, end) for name, runs in curves.items()}
    known = [band for band in bands.values() if len(band)]
    if not known:
        return np.empty(0), {}
    steps = _common_steps(known, stretches)
    parts = {
        name: np.interp(steps, band.steps, np.maximum(band.middle, 0)) for name, band in bands.items() if len(band)
    }
    total = sum(parts.values())
    keep = total > 0
    return steps[keep], {name: part[keep] / total[keep] for name, part in parts.items()}
