"""Charts as SVG. Colours are classes (c0, c1, ...), so that the page's style decides about light and dark."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape

import numpy as np

from dreamer_spec.report.runs import Curve
from dreamer_spec.report.series import Band

COLORS = 8
LOG_RANGE = 50.0  # positive values that spread over more than this factor have a logarithmic axis
LARGEST_NUMBER, SMALLEST_ROOM = 1e300, 1e-30  # what an axis shows: arithmetic with its ends must not overflow or vanish
MOST_MARKS = 40  # crosses for values that are not finite


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


LARGE, SMALL = Frame(420, 250, bottom=38), Frame(300, 150)


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
    *,
    x_end: float,
    x_label: str = "",
    reference: float | None = None,
    limits: tuple[float, float] | None = None,
) -> str:
    """Lines with their bands over environment steps.

    label: for those who cannot see it. x_end: where the axis of steps ends. reference: where a dashed horizontal line
    is. limits: of the vertical axis, in place of those of the data.
    """
    low, high = limits or value_range(series, reference)
    log = limits is None and SMALLEST_ROOM < low < high / LOG_RANGE and high < LARGEST_NUMBER
    y = vertical_axis(low, high, frame, log)
    x = Axis(0.0, max(x_end, 1.0), frame.left, frame.width - frame.right)
    parts = [grid(x, y, frame, x_label)]
    if reference is not None:
        parts.append(
            f'<path class="reference" d="M{frame.left},{float(y(reference)):.1f}H{frame.width - frame.right}"/>'
        )
    parts += [_points(curve, one.color, x, y) for one in series for curve in one.points]
    parts += [_band(one, x, y) for one in series if not one.dots]
    for index, one in enumerate(series):
        by = 4.0 * (index - (len(series) - 1) / 2) if one.dots else 0.0  # so that whiskers do not hide each other
        parts += [_whiskers(one, x.moved(by), y) if one.dots else "", _line(one, x.moved(by), y, by)]
    bad = np.unique(np.concatenate([one.band.bad for one in series])) if series else np.empty(0)
    parts += [_bad(step, x, frame) for step in bad[np.linspace(0, len(bad) - 1, min(len(bad), MOST_MARKS)).astype(int)]]
    return svg(frame, label, parts, x, y)


def stacked_chart(
    steps: np.ndarray,
    shares: Mapping[str, np.ndarray],
    colors: Mapping[str, int],
    frame: Frame,
    label: str,
    x_end: float,
) -> str:
    """Shares [n] of a whole over environment steps, one upon the other."""
    x = Axis(0.0, max(x_end, 1.0), frame.left, frame.width - frame.right)
    y = Axis(0.0, 1.0, frame.height - frame.bottom, frame.top)
    parts = []
    below = np.zeros(len(steps))
    for name, share in shares.items():
        above = below + share
        outline = path(np.concatenate([x(steps), x(steps)[::-1]]), np.concatenate([y(above), y(below)[::-1]])) + "Z"
        title = f"<title>{escape(name)}: {np.mean(share):.1%} on average</title>"
        parts.append(f'<path class="area c{colors[name] % COLORS}" d="{outline}">{title}</path>')
        below = above
    parts.insert(0, grid(x, y, frame, "", show=lambda value: f"{value:.0%}"))
    return svg(frame, label, parts, None, None)


def svg(frame: Frame, label: str, parts: Iterable[str], x: Axis | None, y: Axis | None) -> str:
    """The picture. With its axes, the page's script can tell values from positions."""
    data = ""
    if x and y:
        numbers = [x.high, x.start, x.stop, y.low, y.high, y.start, y.stop, int(y.log)]
        data = f' data-axes="{" ".join(f"{number:.9g}" for number in numbers)}"'
    size = f'viewBox="0 0 {frame.width} {frame.height}"'
    return f'<svg role="img" aria-label="{escape(label)}" {size}{data}>{"".join(parts)}</svg>'


def grid(x: Axis, y: Axis, frame: Frame, x_label: str, show: Callable[[float], str] | None = None) -> str:
    """Horizontal lines, and the numbers at both axes."""
    parts = []
    ticks = y.ticks(5 if frame.height > 200 else 3)
    show = show or tick_format(ticks, y.log)
    for value in ticks:
        at = float(y(value))
        parts.append(f'<path class="grid" d="M{frame.left},{at:.1f}H{frame.width - frame.right}"/>')
        parts.append(f'<text x="{frame.left - 5}" y="{at + 3.5:.1f}" text-anchor="end">{show(value)}</text>')
    base = frame.height - frame.bottom
    parts.append(f'<path class="axis" d="M{frame.left},{base}H{frame.width - frame.right}"/>')
    ticks = x.ticks(5 if frame.width > 400 else 3)
    show_steps = tick_format(ticks, False)
    for value in ticks:
        at = float(x(value))
        anchor = "end" if at > frame.width - 24 else "middle"
        parts.append(f'<path class="axis" d="M{at:.1f},{base}v3"/>')
        parts.append(
            f'<text x="{min(at, frame.width - 1):.1f}" y="{base + 14}" '
            f'text-anchor="{anchor}">{show_steps(value)}</text>'
        )
    if x_label:
        middle = (frame.left + frame.width - frame.right) / 2
        parts.append(f'<text x="{middle:.0f}" y="{frame.height - 6}" text-anchor="middle">{escape(x_label)}</text>')
    return "".join(parts)


def _points(curve: Curve, color: int, x: Axis, y: Axis) -> str:
    positions = zip(x(curve.steps), y(curve.values), strict=True)
    dots = "".join(f"M{across:.0f},{up:.1f}h0" for across, up in positions)
    return f'<path class="points c{color % COLORS}" d="{dots}"/>' if dots else ""


def _band(series: Series, x: Axis, y: Axis) -> str:
    band = series.band
    if len(band) < 2 or np.array_equal(band.low, band.high):
        return ""
    across = x(band.steps)
    outline = path(np.concatenate([across, across[::-1]]), np.concatenate([y(band.high), y(band.low)[::-1]]))
    return f'<path class="band c{series.color % COLORS}" d="{outline}Z"/>'


def _whiskers(series: Series, x: Axis, y: Axis) -> str:
    band = series.band
    ends = zip(x(band.steps), y(band.low), y(band.high), strict=True)
    lines = "".join(f"M{across:.1f},{low:.1f}V{high:.1f}" for across, low, high in ends if low != high)
    return f'<path class="whisker c{series.color % COLORS}" d="{lines}"/>' if lines else ""


def _line(series: Series, x: Axis, y: Axis, moved: float) -> str:
    if not len(series.band):
        return ""
    across, up = x(series.band.steps), y(series.band.middle)
    color = f"c{series.color % COLORS}" + (" dashed" if series.color >= COLORS else "")
    parts = [
        f'<path class="line {color}" data-label="{escape(series.label)}" '
        f'data-moved="{moved:g}" d="{path(across, up)}"/>'
    ]
    if series.dots or len(across) == 1:
        parts += [f'<circle class="{color}" cx="{a:.1f}" cy="{b:.1f}" r="3"/>' for a, b in zip(across, up, strict=True)]
    return "".join(parts)


def _bad(step: float, x: Axis, frame: Frame) -> str:
    title = f"<title>not finite at step {step:,.0f}</title>"
    return f'<path class="bad" d="M{float(x(step)) - 3:.1f},{frame.top - 6}l6,6m0,-6l-6,6">{title}</path>'


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


def tick_format(ticks: Sequence[float], log: bool) -> Callable[[float], str]:
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
