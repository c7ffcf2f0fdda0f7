"""The charts of one task: returns first, then every metric."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from dreamer_spec.report.catalogue import Metric, find, sections
from dreamer_spec.report.results import number
from dreamer_spec.report.runs import Curve, Group
from dreamer_spec.report.series import Band, over_runs, over_values, stacked, thinned
from dreamer_spec.report.svg import LARGE, SMALL, Series, line_chart, stacked_chart, value_range

SMOOTH, FINE = 50, 100  # stretches of a curve: for the noisy returns, and for other metrics
EPISODES_EACH = 5  # on average in a stretch at least
OTHER = "other"
MOST = 200  # metrics of a section that are drawn
TIME_COLORS = {"train": 0, "environments": 1, "policy": 2, "replay": 4, "evaluation": 3, "checkpoint": 5, "log": 7}
TIME_OTHER = 6  # the colour of the rest

EPISODE, EVALUATION, RANDOM = "episode/return", "evaluation/return", "random/return"
ERROR = "evaluation/return_standard_error"
ABOVE = (EPISODE, EVALUATION, ERROR, RANDOM)  # what the charts of returns show


@dataclasses.dataclass(frozen=True)
class Figure:
    """A chart with its caption. metric: whose meaning stands below."""

    name: str
    notes: list[str]
    picture: Markup
    metric: Metric | None = None


@dataclasses.dataclass(frozen=True)
class Charts:
    """Of a section of metrics. legend: colour and words. left_out: how many metrics are not drawn."""

    title: str
    about: str
    figures: list[Figure]
    legend: list[tuple[int, str]]
    left_out: int


@dataclasses.dataclass(frozen=True)
class Task:
    """reference: what a random policy gets, "" if nobody has tried."""

    name: str
    groups: Sequence[Group]
    returns: list[Figure]
    reference: str
    metrics: list[Charts]

    @property
    def legend(self) -> list[tuple[int, str]]:
        return [(group.color, group.label) for group in self.groups]

    @property
    def several_seeds(self) -> bool:
        return any(len(group.runs) > 1 for group in self.groups)


def task_charts(name: str, groups: Sequence[Group]) -> Task:
    """The returns of a task's groups over environment steps, then every metric in its section."""
    curves = [curve for group in groups for run in group.runs for curve in run.curves.values()]
    end = max((float(curve.steps[-1]) for curve in curves), default=0.0)
    random = [value for group in groups for value in group.last(RANDOM)]
    reference = float(np.mean(random)) if random else None
    shown = "" if reference is None else number(reference)
    return Task(name, groups, _returns(groups, end, reference), shown, _sections(groups, end))


def _returns(groups: Sequence[Group], end: float, reference: float | None) -> list[Figure]:
    """Training episodes and evaluations side by side, with the same vertical axis."""
    charts = {"Training episodes": _training(groups, end), "Evaluations": _evaluations(groups)}
    low, high = value_range([one for series in charts.values() for one in series], reference)
    room = 0.04 * (high - low) or 1.0
    limits = (low if low == 0 else low - room, high + room)
    figures = []
    for title, series in charts.items():
        label = f"{title}: return over environment steps"
        picture = line_chart(series, LARGE, label, end, reference=reference, limits=limits)
        figures += [Figure(title, ["return"], picture)] if series else []
    return figures


def _training(groups: Sequence[Group], end: float) -> list[Series]:
    found = []
    for group in groups:
        if curves := group.curves(EPISODE):
            stretches = int(np.clip(min(len(curve.steps) for curve in curves) / EPISODES_EACH, 1, SMOOTH))
            band = over_runs(curves, stretches, end)
            found.append(Series(group.label, group.color, band, list(map(thinned, curves))))
    return found


def _evaluations(groups: Sequence[Group]) -> list[Series]:
    found = []
    for group in groups:
        if curves := group.curves(EVALUATION):
            errors = group.curves(ERROR)
            band = _at_steps(curves, errors[0] if errors and len(curves) == 1 else None)
            found.append(Series(group.label, group.color, band, dots=True))
    return found


def _at_steps(curves: Sequence[Curve], error: Curve | None) -> Band:
    """Mean, lowest and highest of the runs at each step; around a single run what is given as its error."""
    steps = np.concatenate([curve.steps for curve in curves])
    values = np.concatenate([curve.values for curve in curves])
    finite = np.isfinite(values)
    at = np.unique(steps[finite])
    each = [values[finite & (steps == step)] for step in at]
    middle = np.array([np.mean(one) for one in each])
    if error is None:
        low, high = np.array([np.min(one) for one in each]), np.array([np.max(one) for one in each])
    else:
        known = dict(zip(error.steps.tolist(), np.nan_to_num(error.values, posinf=0.0).tolist(), strict=True))
        around = np.array([known.get(step, 0.0) for step in at.tolist()])
        low, high = middle - around, middle + around
    return Band(at, middle, low, high, steps[~finite])


def _sections(groups: Sequence[Group], end: float) -> list[Charts]:
    """Every metric that some run has, in the order of the catalogue; what nobody has described comes last."""
    names = dict.fromkeys(name for group in groups for run in group.runs for name in run.curves if name not in ABOVE)
    order = [metric.name for section in sections().values() for metric in section.metrics]
    chosen: dict[str, list[str]] = {section: [] for section in [*sections(), OTHER]}
    rank = {name: index for index, name in enumerate(order)}
    found = {name: find(name) for name in names}
    for name, entry in sorted(found.items(), key=lambda item: rank[item[1][1].name] if item[1] else len(rank)):
        chosen[entry[0] if entry else OTHER].append(name)
    return [_section(groups, section, members, end) for section, members in chosen.items() if members]


def _section(groups: Sequence[Group], section: str, names: Sequence[str], end: float) -> Charts:
    known = sections().get(section)
    title, about = (known.title, known.about) if known else ("Other metrics", "")
    drawn, left_out = names[:MOST], max(0, len(names) - MOST)
    if section == "time":
        return Charts(title, about, *_time_split(groups, drawn, end), left_out)
    return Charts(title, about, [_tile(groups, name, end) for name in drawn], [], left_out)


def _tile(groups: Sequence[Group], name: str, end: float) -> Figure:
    """One metric: a small chart, its unit, its last value if there is only one, and what it means."""
    series, last = [], []
    for group in groups:
        if curves := group.curves(name):
            series.append(Series(group.label, group.color, over_values(curves, FINE, end)))
            last += group.last(name)
    _, metric = find(name) or (OTHER, None)
    notes = [metric.unit] if metric and metric.unit else []
    notes += [f"last {number(last[0])}"] if len(last) == 1 else []
    picture = line_chart(series, SMALL, f"{name} over environment steps", end)
    return Figure(name.removeprefix("train/"), notes, picture, metric)


def _time_split(
    groups: Sequence[Group], names: Sequence[str], end: float
) -> tuple[list[Figure], list[tuple[int, str]]]:
    """One stacked chart for each group, and the legend of all."""
    figures = []
    shown: dict[str, float] = {}
    for group in groups:
        curves = {name.removeprefix("time/"): found for name in names if (found := group.curves(name))}
        ordered = {name: curves[name] for name in [*TIME_COLORS, "other", *curves] if name in curves}
        steps, shares = stacked(ordered, FINE, end)
        if len(steps):
            shown |= {name: float(np.mean(share)) for name, share in shares.items()}
            colors = {name: TIME_COLORS.get(name, TIME_OTHER) for name in shares}
            picture = stacked_chart(steps, shares, colors, f"time split of {group.label}", end)
            figures.append(Figure(group.label, ["share of wall time"], picture))
    words = {name: f"{name} {share:.0%}" if len(figures) == 1 else name for name, share in shown.items()}
    return figures, [(TIME_COLORS.get(name, TIME_OTHER), text) for name, text in words.items()]
