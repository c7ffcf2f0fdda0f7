"""The charts of one task: returns first, then every metric."""

import re
from collections.abc import Sequence
from html import escape

import numpy as np

from dreamer_spec.report.catalogue import Metric, find, sections
from dreamer_spec.report.html import breakable, details, swatch
from dreamer_spec.report.results import number
from dreamer_spec.report.runs import Curve, Group
from dreamer_spec.report.series import Band, over_runs, over_values, stacked, thinned
from dreamer_spec.report.svg import LARGE, SMALL, Series, line_chart, stacked_chart, value_range

SMOOTH, FINE = 50, 100  # stretches of a curve: for the noisy returns, and for other metrics
EPISODES_EACH = 5  # on average in a stretch at least
OTHER = "other"
MOST = 200  # metrics of a section that are drawn
TIME_COLORS = {
    "train": 0,
    "environments": 1,
    "policy": 2,
    "replay": 4,
    "evaluation": 3,
    "checkpoint": 5,
    "log": 7,
    "other": 6,
}

EPISODE, EVALUATION, ERROR, RANDOM = (
    "episode/return",
    "evaluation/return",
    "evaluation/return_standard_error",
    "random/return",
)
ABOVE = (EPISODE, EVALUATION, ERROR, RANDOM)  # what the charts of returns show


def task_section(task: str, groups: Sequence[Group], several: bool) -> str:
    """The returns of a task's groups over environment steps, then every metric in its section."""
    curves = [curve for group in groups for run in group.runs for curve in run.curves.values()]
    if not curves:
        return f"<h2>{escape(task or 'unknown task')}</h2><p>Nothing has been logged yet.</p>"
    end = max(float(curve.steps[-1]) for curve in curves)
    legend = "".join(f"<span>{swatch(group.color)}{escape(group.label)}</span>" for group in groups)
    title = f"Returns: {task or 'unknown task'}" if several else "Returns"
    parts = [
        f"<h2>{escape(title)}</h2>",
        f'<div class="legend">{legend}</div>',
        _returns(groups, end),
        "<h2>Metrics</h2>",
        _reading(groups),
    ]
    parts += [f'<div class="legend">{legend}</div>'] if len(groups) > 1 else []
    return "".join(parts) + "".join(_metric_sections(groups, end))


def _returns(groups: Sequence[Group], end: float) -> str:
    """Training episodes and evaluations side by side, with the same vertical axis."""
    random = [value for group in groups for run in group.runs if (value := run.last(RANDOM)) is not None]
    reference = float(np.mean(random)) if random else None
    charts = [("Training episodes", _training(groups, end)), ("Evaluations", _evaluations(groups))]
    charts = [(title, series) for title, series in charts if series]
    if not charts:
        return "<p>No episode has ended yet.</p>"
    low, high = value_range([one for _, series in charts for one in series], reference)
    room = 0.04 * (high - low) or 1.0
    limits = (low if low == 0 else low - room, high + room)
    figures = []
    for title, series in charts:
        picture = line_chart(
            series,
            LARGE,
            f"{title}: return over environment steps",
            x_end=end,
            x_label="environment steps",
            reference=reference,
            limits=limits,
        )
        figures.append(f'<figure><figcaption><span class="name">{title}</span> return</figcaption>{picture}</figure>')
    seeds = any(len(group.runs) > 1 for group in groups)
    words = [
        "Dots are single training episodes"
        + (", those of all seeds," if seeds else "")
        + " and the line is their mean over stretches of steps."
    ]
    if seeds:
        words.append(
            "With several seeds, lines and dots are means over seeds, bands and whiskers go "
            "from the lowest seed to the highest."
        )
    if any(len(group.runs) == 1 for group in groups) and len(charts) > 1:
        words.append("The whiskers of a single run are the standard error over the episodes of an evaluation.")
    if reference is not None:
        words.append(f"Dashed: what a random policy gets, {number(reference)}.")
    return f'<div class="large">{"".join(figures)}</div><p class="small muted">{" ".join(words)}</p>'


def _training(groups: Sequence[Group], end: float) -> list[Series]:
    found = []
    for group in groups:
        curves = [run.curves[EPISODE] for run in group.runs if EPISODE in run.curves]
        if curves:
            stretches = int(np.clip(min(len(curve.steps) for curve in curves) / EPISODES_EACH, 1, SMOOTH))
            found.append(
                Series(
                    group.label, group.color, over_runs(curves, stretches, end), [thinned(curve) for curve in curves]
                )
            )
    return found


def _evaluations(groups: Sequence[Group]) -> list[Series]:
    found = []
    for group in groups:
        runs = [run for run in group.runs if EVALUATION in run.curves]
        if runs:
            error = runs[0].curves.get(ERROR) if len(runs) == 1 else None
            found.append(
                Series(group.label, group.color, _at_steps([run.curves[EVALUATION] for run in runs], error), dots=True)
            )
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


def _reading(groups: Sequence[Group]) -> str:
    means = "the mean over seeds" if any(len(group.runs) > 1 for group in groups) else "the mean"
    return (
        f'<p class="small muted">Over environment steps. Lines are {means} over stretches of '
        f"steps; bands go from the lowest to the "
        "highest value that was logged there. A red cross marks a value that is not finite. "
        "Positive values that spread far have a "
        "logarithmic axis.</p>"
    )


def _metric_sections(groups: Sequence[Group], end: float) -> list[str]:
    """Every metric that some run has, in the order of the catalogue; what nobody has described comes last."""
    names = dict.fromkeys(name for group in groups for run in group.runs for name in run.curves if name not in ABOVE)
    order = [metric.name for section in sections().values() for metric in section.metrics]
    chosen: dict[str, list[str]] = {section: [] for section in [*sections(), OTHER]}
    rank = {name: index for index, name in enumerate(order)}
    found = {name: find(name) for name in names}
    for name, entry in sorted(found.items(), key=lambda item: rank[item[1][1].name] if item[1] else len(rank)):
        chosen[entry[0] if entry else OTHER].append(name)
    parts = []
    for section, members in chosen.items():
        if not members:
            continue
        left_out, members = len(members) - MOST, members[:MOST]
        content = _time_split(groups, members, end) if section == "time" else _tiles(groups, members, end)
        title = sections()[section].title if section in sections() else "Other metrics"
        about = f'<p class="small muted">{_prose(sections()[section].about)}</p>' if section in sections() else ""
        more = f"<p>{left_out:,} more metrics of this section are not drawn.</p>" if left_out > 0 else ""
        parts.append(f"<h3>{escape(title)}</h3>{about}{content}{more}")
    return parts


def _tiles(groups: Sequence[Group], names: Sequence[str], end: float) -> str:
    return f'<div class="tiles">{"".join(_tile(groups, name, end) for name in names)}</div>'


def _tile(groups: Sequence[Group], name: str, end: float) -> str:
    """One metric: a small chart, its unit, its last value if there is only one, and what it means."""
    series, last = [], []
    for group in groups:
        curves = [run.curves[name] for run in group.runs if name in run.curves]
        if curves:
            series.append(Series(group.label, group.color, over_values(curves, FINE, end)))
            last += [value for run in group.runs if (value := run.last(name)) is not None]
    entry = find(name)
    unit = f"<span>{escape(entry[1].unit)}</span>" if entry and entry[1].unit else ""
    now = f"<span>last {number(last[0])}</span>" if len(last) == 1 else ""
    caption = f'<figcaption><span class="name">{breakable(name.removeprefix("train/"))}</span>{unit}{now}</figcaption>'
    meaning = _meaning(entry[1]) if entry else ""
    return (
        f"<figure>{caption}{line_chart(series, SMALL, f'{name} over environment steps', x_end=end)}{meaning}</figure>"
    )


def _meaning(metric: Metric) -> str:
    lines = [
        _prose(metric.what),
        f"<b>Healthy.</b> {_prose(metric.healthy)}",
        f"<b>Trouble.</b> {_prose(metric.trouble)}",
    ]
    return details("what it means", "".join(f"<p>{line}</p>" for line in lines))


def _prose(text: str) -> str:
    """Text of the catalogue as markup: `code` is kept, links are dropped."""
    plain = re.sub(r"\[([^\]]+)\]\([^)]*\)", r"\1", text)
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(plain))


def _time_split(groups: Sequence[Group], names: Sequence[str], end: float) -> str:
    """One stacked chart for each group."""
    figures = []
    shown: dict[str, float] = {}
    for group in groups:
        curves = {
            name.removeprefix("time/"): found
            for name in names
            if (found := [run.curves[name] for run in group.runs if name in run.curves])
        }
        ordered = {name: curves[name] for name in [*TIME_COLORS, *curves] if name in curves}
        steps, shares = stacked(ordered, FINE, end)
        if len(steps):
            shown |= {name: float(np.mean(share)) for name, share in shares.items()}
            picture = stacked_chart(
                steps,
                shares,
                {name: TIME_COLORS.get(name, 6) for name in shares},
                LARGE,
                f"time split of {group.label}",
                end,
            )
            figures.append(
                f'<figure><figcaption><span class="name">{escape(group.label)}</span> share of wall '
                f"time</figcaption>{picture}</figure>"
            )
    shares_of = "".join(
        f"<span>{swatch(TIME_COLORS.get(name, 6))}{escape(name)}{f' {share:.0%}' if len(figures) == 1 else ''}</span>"
        for name, share in shown.items()
    )
    return f'<div class="legend">{shares_of}</div><div class="large">{"".join(figures)}</div>'
