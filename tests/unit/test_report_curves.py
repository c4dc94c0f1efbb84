"""Curves, charts and numbers of the report: closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from report_folders import KEY, write_run

from unrender.app.report import curves
from unrender.app.report.curves import Series
from unrender.display import formatting, plots
from unrender.display.plots import Line
from unrender.runs.folder.reader import read


def test_chart_places_points_on_a_logarithmic_axis():
    line = Line("error", np.array([0.0, 5.0, 10.0]), np.array([1.0, 0.1, 0.01]))
    chart = plots.chart("Error", [line], "seconds", 10.0)
    assert chart is not None
    assert chart.logarithmic
    (x0, y0), (x1, y1), (x2, y2) = (map(float, p.split()) for p in chart.curves[0].path[1:].split("L"))
    assert (x0, x2) == (plots.LEFT, plots.WIDTH - plots.RIGHT)
    assert x1 == pytest.approx((x0 + x2) / 2)
    assert y1 == pytest.approx((y0 + y2) / 2, abs=0.1)  # equal ratios, equal steps
    assert y0 < y2
    ticks = {label: place for place, label in chart.y_ticks}
    assert ticks["0.1"] == pytest.approx(y1, abs=0.1)


def test_chart_breaks_the_line_at_gaps_and_keeps_zero_on_a_linear_axis():
    line = Line("share", np.arange(5.0), np.array([0.0, 1.0, np.nan, 1.0, 0.5]))
    chart = plots.chart("Share", [line], "seconds", 4.0)
    assert chart is not None
    assert not chart.logarithmic
    assert chart.curves[0].path.count("M") == 2
    assert "0" in [label for _, label in chart.y_ticks]
    assert plots.chart("Nothing", [Line("none", np.arange(2.0), np.full(2, np.nan))], "seconds", 1.0) is None


@pytest.mark.parametrize("end", [1e-320, 1.0, 1.7e308])
@pytest.mark.parametrize("high", [5e-324, 1e-300, 1.0, 1.7e308])
@pytest.mark.parametrize("low", [-1.7e308, 0.0, 5e-324, 1e-300, 1.0])
def test_numbers_at_the_ends_of_the_doubles_are_drawn(low: float, high: float, end: float):
    values = np.array([low, high, high])
    line = Line("loss", np.linspace(0.0, end, 3), values, values, values)
    chart = plots.chart("Loss", [line], "seconds", end)
    assert chart is not None
    assert all(0 <= place <= plots.HEIGHT for place, _ in chart.y_ticks)


def test_long_histories_are_thinned_to_median_and_range():
    rng = np.random.default_rng(0)
    x = np.linspace(0.001, 7.0, 20_000)
    y = 2.0 + rng.uniform(-1, 1, x.size)
    thin = curves.binned(x, y)
    assert len(thin.x) <= 200
    assert thin.low.min() == y.min()
    assert thin.high.max() == y.max()
    assert np.abs(thin.median - 2.0).max() < 0.5  # 100 uniform values each: standard error of the median 0.1
    assert (np.diff(thin.x) > 0).all()


def test_a_series_keeps_its_value_until_the_next():
    series = Series(np.array([1.0, 2.0, 3.0]), np.array([10.0, 20.0, 30.0]), np.array([9.0, 4.0, 6.0]))
    assert series.at(np.array([0.0, 1.0, 1.99, 2.0, 50.0])).tolist() == [9, 9, 9, 4, 6]
    assert series.at(np.array([25.0]), "samples").tolist() == [4]
    assert series.time_to(5.0) == 2.0
    assert series.time_to(1.0) is None


def test_the_loss_is_smoothed_over_its_window_only(tmp_path):
    run = read(write_run(tmp_path / "run", times=(1, 2, 3, 4, 5), errors=[0.1] * 5, loss=(1.0, 9.0, 2.0, None, 4.0)))
    smoothed = curves.smoothed_loss(run, 2.0)
    assert smoothed is not None
    assert smoothed.seconds.tolist() == [1, 2, 3, 5]
    assert smoothed.values.tolist() == [1.0, 5.0, 5.5, 4.0]


@pytest.mark.parametrize("status", ["finished", "running"])
def test_the_error_at_the_end_is_that_of_the_result(tmp_path: Path, status: str) -> None:
    """`compare` showed the error of the last step where the result holds other values. Files of a running run are of an earlier step."""
    result = {KEY: np.full((4, 5, 3), 0.45)}
    run = read(write_run(tmp_path / "run", parameters=result, status=status))
    series = curves.parameter_error(run, KEY)
    assert series is not None
    np.testing.assert_allclose(series.values, [0.5, 0.4, 0.3, 0.2, 0.2 if status == "finished" else 0.1], rtol=1e-5)
    np.testing.assert_array_equal(series.seconds, [0.0, 1.0, 2.0, 3.0, 4.0])


def test_median_and_spread_over_runs():
    runs = [
        Series(np.array([0.0, 1.0]), np.array([0.0, 5.0]), np.array([start, start / 10])) for start in (1.0, 2.0, 6.0)
    ]
    band = curves.band(runs, "seconds", 1.0)
    assert band.median.tolist() == [2.0, 0.2]
    assert band.low.tolist() == [1.0, 0.1]
    assert band.high.tolist() == [6.0, 0.6]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (float("nan"), "–"),
        (0.0, "0"),
        (0.02134, "0.0213"),
        (-1.5, "−1.5"),
        (12345.0, "12345"),
        (1e-6, "10⁻⁶"),
        (2.5e-9, "2.5·10⁻⁹"),
        (float("-inf"), "−∞"),
    ],
)
def test_numbers(value, text):
    assert formatting.number(value) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.0, "0 s"), (12.34, "12.3 s"), (59.7, "1 min 00 s"), (200.0, "3 min 20 s"), (3900, "1 h 05 min")],
)
def test_durations(seconds, text):
    assert formatting.duration(seconds) == text


def test_counts():
    assert [formatting.count(n) for n in (0, 999, 20_000, 1_500_000)] == ["0", "999", "20 k", "1.5 M"]
    assert [formatting.count(n) for n in (999.6, 999_600, 999_400)] == ["1 k", "1 M", "999 k"]
