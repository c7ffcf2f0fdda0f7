"""The curves of the report: means over steps and runs, axes, and lines where their values are."""

import math
import re

import numpy as np
import pytest
from html_document import Document
from report_runs import NAN, curve

from dreamer_spec.report import svg
from dreamer_spec.report.series import means, over_runs, over_values, stacked, thinned


def test_means_over_stretches_of_steps() -> None:
    band = means(curve([0, 10, 30, 60, 100], [1, 3, NAN, 5, 7]), 2, 100)
    assert band.steps.tolist() == [5, 80]
    assert (band.middle.tolist(), band.low.tolist(), band.high.tolist()) == ([2, 6], [1, 5], [3, 7])
    assert band.bad.tolist() == [30]
    assert len(means(curve([1], [math.inf]), 5, 1)) == 0


def test_the_spread_over_runs_is_that_of_their_means() -> None:
    runs = [curve([0, 1, 10, 11], [0, 2, 4, 6]), curve([0, 1, 10, 11], [10, 20, 30, 50])]
    band = over_runs(runs, 2, 12)
    assert (band.steps.tolist(), band.middle.tolist()) == ([0.5, 10.5], [8, 22.5])
    assert (band.low.tolist(), band.high.tolist()) == ([1, 5], [15, 40])
    values = over_values(runs, 2, 12)
    assert (values.middle.tolist(), values.low.tolist(), values.high.tolist()) == ([8, 22.5], [0, 4], [20, 50])


def test_a_shorter_run_counts_as_far_as_it_goes() -> None:
    band = over_runs([curve([0, 10, 20], [0, 10, 20]), curve([0, 10], [2, 12])], 100, 20)
    assert dict(zip(band.steps.tolist(), band.middle.tolist(), strict=True)) == {0: 1, 10: 11, 20: 20}


def test_a_run_that_ends_a_moment_earlier_counts_to_the_end() -> None:
    """Or else the mean would jump to the other run at its last point."""
    band = over_runs([curve([0, 50, 99], [1, 1, 1]), curve([0, 50, 100], [3, 3, 3])], 50, 100)
    assert (band.steps[-1], band.middle.tolist()) == (100, [2, 2, 2, 2])


def test_nothing_is_drawn_where_no_run_is() -> None:
    """Two runs, the second begins after the end of the first."""
    runs = [curve(list(range(0, 100)), [1] * 100), curve(list(range(1000, 1100)), [3] * 100)]
    band = over_runs(runs, 20, 1100)
    assert np.isfinite(band.middle).all()
    assert not ((band.steps > 100) & (band.steps < 1000)).any()


def test_a_long_curve_is_thinned_to_its_ends() -> None:
    thin = thinned(curve(list(range(50_000)), list(range(50_000))))
    assert len(thin.steps) == 1000
    assert (thin.values[0], thin.values[-1]) == (0, 49_999)


def test_shares_add_up_to_one() -> None:
    steps, shares = stacked(
        {"a": [curve([0, 10], [0.5, 0.2])], "b": [curve([0, 10], [0.5, 0.6])], "c": [curve([0], [NAN])]}, 10, 10
    )
    assert steps.tolist() == [0, 10]
    assert shares["a"].tolist() == pytest.approx([0.5, 0.25])
    assert np.sum(list(shares.values()), axis=0).tolist() == pytest.approx([1, 1])


# Charts


def test_ticks_are_round_numbers() -> None:
    assert svg.linear_ticks(0, 8000, 5) == [0, 2000, 4000, 6000, 8000]
    assert svg.linear_ticks(-0.11, 0.31, 4) == pytest.approx([-0.1, 0, 0.1, 0.2, 0.3])
    assert svg.log_ticks(2, 2000, 3) == [10, 100, 1000]
    assert [svg.tick_format([], True)(value) for value in (1e-3, 0.1, 10, 1e4, 1e6)] == [
        "0.001",
        "0.1",
        "10",
        "10,000",
        "1e+06",
    ]


@pytest.mark.parametrize(
    ("ticks", "text"),
    [
        ([0, 2000, 4000], ["0", "2,000", "4,000"]),
        ([0, 50_000, 100_000], ["0", "50k", "100k"]),
        ([0, 500_000, 1_000_000], ["0", "0.5M", "1.0M"]),
        ([0, 0.25, 0.5], ["0.00", "0.25", "0.50"]),
        ([0, 1e-5, 2e-5], ["0", "1e-05", "2e-05"]),
    ],
)
def test_numbers_at_axes(ticks: list[float], text: list[str]) -> None:
    assert [svg.tick_format(ticks, False)(value) for value in ticks] == text


def positions(chart: str) -> list[tuple[float, float]]:
    [line] = re.findall(r'class="line[^"]*" data-label="[^"]*" data-moved="0" d="M([^"]*)"', chart)
    return [tuple(map(float, point.split(","))) for point in line.split("L")]  # type: ignore[misc]


def test_a_line_lies_where_its_values_are() -> None:
    band = means(curve([0, 50, 100], [0, 5, 10]), 100, 100)
    frame = svg.Frame(200, 100, left=50, right=10, top=10, bottom=20)
    chart = svg.line_chart([svg.Series("a", 0, band)], frame, "", x_end=100, limits=(0, 10))
    (x0, low), (x1, middle), (x2, high) = positions(chart)
    assert (x0, x1, x2) == (50, 120, 190)
    assert middle == pytest.approx((low + high) / 2, abs=0.1)
    assert low > high, "up is less in SVG"
    assert "stroke-dasharray" not in chart


def test_positive_values_that_spread_far_have_a_logarithmic_axis() -> None:
    band = means(curve([0, 50, 100], [1, 10, 100]), 100, 100)
    (_, low), (_, middle), (_, high) = positions(svg.line_chart([svg.Series("a", 0, band)], svg.SMALL, "", x_end=100))
    assert middle == pytest.approx((low + high) / 2, abs=0.1)


@pytest.mark.parametrize(
    "values",
    [
        [NAN, NAN, NAN],
        [1, NAN, 2],
        [math.inf, 1, -math.inf],
        [1e308, -1e308, 0],
        [1e308, 1e-308, 1e-320],
        [1e308, 1.1e308, 1.2e308],
        [-1e308, -1e308, -1e308],
        [5e-324, 0, 0],
        [0, 0, 0],
        [-7, -7, -7],
        [1e-12, 2e-12, 1e-10],
    ],
)
def test_no_value_breaks_a_picture(values: list[float]) -> None:
    band = over_values([curve([0, 10, 20], values), curve([0, 10, 20], values[::-1])], 10, 20)
    chart = svg.line_chart([svg.Series("a", 0, band, [thinned(curve([0, 10, 20], values))])], svg.SMALL, "", x_end=20)
    assert not re.search(r"nan|inf(?!inite)", chart.replace("not finite", ""))
    assert chart.count('class="bad"') == len(set(band.bad.tolist()))
    for x, y in re.findall(r"[ML](-?[\d.]+),(-?[\d.]+)", chart):
        assert -10 <= float(x) <= 310
        assert -10 <= float(y) <= 160
    Document(chart)


# Runs
