"""Charts as SVG, drawn by templates/chart.svg. Colours are classes (c0, c1, ...), so that the page's style decides
about light and dark."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from markupsafe import Markup

from conformance import pages
from dreamer_spec.report.runs import Curve
from dreamer_spec.report.series import Band

COLORS = 8
LOG_RANGE = 50.0  # positive values that spread over more than this factor have a logarithmic axis
LARGEST_NUMBER, SMALLEST_ROOM = 1e300, 1e-30  # what an axis shows: arithmetic with its ends must not overflow or vanish
MOST_MARKS = 40  # crosses for values that are not finite

Show = Callable[[float], str]


@dataclasses.dataclass(frozen=True)
class Series:
    """What belongs to one group of runs. points: faint dots. dots: of its line every point is a dot, and the band is
    drawn as whiskers."""

    label: str
    color: int
    band: Band
    points: Sequence[Curve] = ()
    dots: bool = False


@dataclasses.dataclass(frozen=True)
class Frame:
    """The size of a chart in its own units, in which text is 11 high."""

    width: int
    height: int
    left: int = 46
    right: int = 10
    top: int = 10
    bottom: int = 24

    @property
    def is_large(self) -> bool:
        """Whether there is room for many numbers, and for words at the axis of steps."""
        return self.height > 200


LARGE, SMALL = Frame(420, 250, bottom=38), Frame(300, 150)


@dataclasses.dataclass(frozen=True)
class Shape:
    """A path. kind: its classes. label: of a line, for the page's script. moved: by how much it stands beside its
    steps."""

    kind: str
    path: str
    title: str = ""
    label: str | None = None
    moved: float = 0.0


@dataclasses.dataclass(frozen=True)
class Axis:
    """Maps values between low and high to positions between start and stop."""

    low: float
    high: float
    start: float
    stop: float
    log: bool = False

    def __call__(self, value: float | np.ndarray) -> np.ndarray:
        value = np.clip(value, self.low, self.high)
        scale = np.log if self.log else np.asarray
        share = (scale(value) - scale(self.low)) / (scale(self.high) - scale(self.low))
        return self.start + share * (self.stop - self.start)

    def moved(self, by: float) -> "Axis":
        return dataclasses.replace(self, start=self.start + by, stop=self.stop + by)

    def ticks(self, count: int) -> list[float]:
        return log_ticks(self.low, self.high, count) if self.log else linear_ticks(self.low, self.high, count)


def line_chart(
    series: Sequence[Series],
    frame: Frame,
    label: str,
    x_end: float,
    reference: float | None = None,
    limits: tuple[float, float] | None = None,
) -> Markup:
    """Lines with their bands over environment steps.

    label: for those who cannot see it. x_end: where the axis of steps ends. reference: where a dashed horizontal line
    is. limits: of the vertical axis, in place of those of the data.
    """
    low, high = limits or value_range(series, reference)
    log = limits is None and SMALLEST_ROOM < low < high / LOG_RANGE and high < LARGEST_NUMBER
    y = vertical_axis(low, high, frame, log)
    x = steps_axis(x_end, frame)
    shapes = [] if reference is None else [Shape("reference", f"M{x.start},{float(y(reference)):.1f}H{x.stop}")]
    shapes += [_points(curve, one.color, x, y) for one in series for curve in one.points]
    shapes += [shape for one in series if not one.dots for shape in _band(one, x, y)]
    for index, one in enumerate(series):
        by = 4.0 * (index - (len(series) - 1) / 2) if one.dots else 0.0  # so that whiskers do not hide each other
        shapes += _line(one, x.moved(by), y, by)
    bad = np.unique(np.concatenate([one.band.bad for one in series])) if series else np.empty(0)
    shapes += [_bad(at, x, frame) for at in bad[np.linspace(0, len(bad) - 1, min(len(bad), MOST_MARKS)).astype(int)]]
    # With its axes, the page's script can tell values from positions.
    numbers = [x.high, x.start, x.stop, y.low, y.high, y.start, y.stop, int(y.log)]
    axes = " ".join(f"{number:.9g}" for number in numbers)
    return _drawn(shapes, frame, label, x, y, axes=axes)


def stacked_chart(
    steps: np.ndarray, shares: Mapping[str, np.ndarray], colors: Mapping[str, int], label: str, x_end: float
) -> Markup:
    """Shares [n] of a whole over environment steps, one upon the other."""
    x, y = steps_axis(x_end, LARGE), Axis(0.0, 1.0, LARGE.height - LARGE.bottom, LARGE.top)
    shapes = []
    below = np.zeros(len(steps))
    for name, share in shares.items():
        above = below + share
        title = f"{name}: {np.mean(share):.1%} on average"
        shapes.append(Shape(f"area {_color(colors[name])}", outline(x(steps), y(above), y(below)), title))
        below = above
    return _drawn(shapes, LARGE, label, x, y, show="{:.0%}".format)


def _drawn(
    shapes: Sequence[Shape], frame: Frame, label: str, x: Axis, y: Axis, show: Show | None = None, axes: str = ""
) -> Markup:
    """The picture: a grid with the numbers at both axes, and the shapes upon it."""
    count = 5 if frame.is_large else 3
    heights, steps = y.ticks(count), x.ticks(count)
    show, show_step = show or tick_format(heights, y.log), tick_format(steps, False)
    values = {
        "heights": [(float(y(value)), show(value)) for value in heights],
        "steps": [(float(x(value)), show_step(value)) for value in steps],
    }
    return Markup(pages.render(__package__, "chart.svg", frame=frame, label=label, axes=axes, shapes=shapes, **values))


def _color(color: int) -> str:
    return f"c{color % COLORS}"


def _points(curve: Curve, color: int, x: Axis, y: Axis) -> Shape:
    positions = zip(x(curve.steps), y(curve.values), strict=True)
    return Shape(f"points {_color(color)}", "".join(f"M{across:.0f},{up:.1f}h0" for across, up in positions))


def _band(series: Series, x: Axis, y: Axis) -> list[Shape]:
    band = series.band
    if len(band) < 2 or np.array_equal(band.low, band.high):
        return []
    return [Shape(f"band {_color(series.color)}", outline(x(band.steps), y(band.high), y(band.low)))]


def _line(series: Series, x: Axis, y: Axis, moved: float) -> list[Shape]:
    """The line of a series, with whiskers below it and dots upon it where it is one of dots."""
    band, color = series.band, _color(series.color)
    if not len(band):
        return []
    across, up = x(band.steps), y(band.middle)
    dashed = " dashed" if series.color >= COLORS else ""
    shapes = [Shape(f"line {color}{dashed}", path(across, up), label=series.label, moved=moved)]
    if series.dots:
        ends = zip(across, y(band.low), y(band.high), strict=True)
        whiskers = "".join(f"M{at:.1f},{low:.1f}V{high:.1f}" for at, low, high in ends if low != high)
        shapes.insert(0, Shape(f"whisker {color}", whiskers))
    if series.dots or len(across) == 1:
        dots = (
            f"M{at - 3:.1f},{height:.1f}a3,3,0,1,0,6,0a3,3,0,1,0-6,0" for at, height in zip(across, up, strict=True)
        )
        shapes.append(Shape(f"dot {color}", "".join(dots)))
    return shapes


def _bad(step: float, x: Axis, frame: Frame) -> Shape:
    cross = f"M{float(x(step)) - 3:.1f},{frame.top - 6}l6,6m0,-6l-6,6"
    return Shape("bad", cross, f"not finite at step {step:,.0f}")


def outline(across: np.ndarray, up: np.ndarray, down: np.ndarray) -> str:
    """What lies between two lines."""
    return path(np.concatenate([across, across[::-1]]), np.concatenate([up, down[::-1]])) + "Z"


def path(across: np.ndarray, up: np.ndarray) -> str:
    return "M" + "L".join(f"{a:.1f},{b:.1f}" for a, b in zip(across, up, strict=True))


def value_range(series: Sequence[Series], reference: float | None = None) -> tuple[float, float]:
    """The lowest and the highest number of a chart; (0, 1) if there is none."""
    numbers = [
        array for one in series for array in (one.band.low, one.band.high, *(curve.values for curve in one.points))
    ]
    found = np.concatenate([*numbers, [] if reference is None else [reference]]) if numbers else np.empty(0)
    found = found[np.isfinite(found)]
    return (float(found.min()), float(found.max())) if len(found) else (0.0, 1.0)


def vertical_axis(low: float, high: float, frame: Frame, log: bool) -> Axis:
    """An axis that holds low to high with some room, and 0 if that is near."""
    start, stop = frame.height - frame.bottom, frame.top
    if log:
        return Axis(low / 1.1, high * 1.1, start, stop, log=True)
    low, high = (min(max(end, -LARGEST_NUMBER), LARGEST_NUMBER) for end in (low, high))
    if 0 < low < high / 3:
        low = 0.0
    room = max(0.05 * (high - low) or 0.05 * abs(high) or 1.0, SMALLEST_ROOM)
    return Axis(low if low == 0 else low - room, high + room, start, stop)


def steps_axis(end: float, frame: Frame) -> Axis:
    return Axis(0.0, max(end, 1.0), frame.left, frame.width - frame.right)


def linear_ticks(low: float, high: float, count: int) -> list[float]:
    """About so many round numbers from low to high."""
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = power * next(factor for factor in (1, 2, 2.5, 5, 10) if factor * power >= 0.8 * raw)
    first = math.ceil(low / step - 1e-9)
    return [index * step for index in range(first, math.floor(high / step + 1e-9) + 1)]


def log_ticks(low: float, high: float, count: int) -> list[float]:
    """Powers of ten, thinned out to about so many."""
    first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
    every = max(1, -(-(last - first) // count))
    return [10.0**power for power in range(first, last + 1, every)]


def tick_format(ticks: Sequence[float], log: bool) -> Show:
    """One way to write all numbers of an axis: 2,000, 40k, 1.5M, 0.25, 3e-05."""
    largest = max((abs(value) for value in ticks), default=0.0)
    step = min((b - a for a, b in itertools.pairwise(ticks)), default=1.0)
    if log or not 1e-4 <= largest < 1e12:
        return lambda value: f"{value:,.0f}" if 1 <= value < 1e5 else f"{value:.3g}"
    for size, suffix in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if largest >= size:
            unit = max(size, 1e3) if suffix != "k" else 1e3
            return lambda value: "0" if value == 0 else f"{value / unit:,.{_decimals(step / unit)}f}{suffix}"
    return lambda value: f"{value:,.{_decimals(step)}f}"


def _decimals(step: float) -> int:
    """How many decimals tell multiples of a step apart."""
    return next((digits for digits in range(6) if abs(step * 10**digits - round(step * 10**digits)) < 1e-6), 6)
