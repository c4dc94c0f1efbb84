"""Curves of a run and of several runs: step functions of time, medians over seeds, times to a level; metrics of the final pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from unrender.losses import metrics
from unrender.runs.folder.reader import RunFolder

MOST_PIXELS = 1 << 21
"""Limit of the pixels that are measured, over all views. FLIP takes a second or two per megapixel."""


@dataclass(frozen=True)
class ImageMetric:
    """A metric from (picture, reference, mask or None) to a number, or None where it is undefined."""

    name: str
    description: str
    larger_is_better: bool
    compute: Callable[[np.ndarray, np.ndarray, np.ndarray | None], float | None]


def available() -> list[ImageMetric]:
    """Return the metrics that can be computed here; FLIP is among them if its package is installed."""
    result = [
        ImageMetric("RMSE", "root mean square error of linear values", False, metrics.rmse),
        ImageMetric(
            "relative MSE", "mean of (I - R)\u00b2 / (R\u00b2 + 0.01), of linear values", False, metrics.relative_mse
        ),
        ImageMetric("PSNR", "peak signal-to-noise ratio in dB, as displayed", True, metrics.psnr),
        ImageMetric("SSIM", "structural similarity, as displayed", True, metrics.ssim),
    ]
    return result + (
        [ImageMetric("FLIP", "mean FLIP, as displayed", False, metrics.flip)] if metrics.has_flip() else []
    )


def measured_views(run: RunFolder) -> list[int]:
    """Return the views that are measured: the first one, and further ones until the pixels exceed `MOST_PIXELS`."""
    measured: list[int] = []
    pixels = 0
    for index, view in run.views.items():
        pixels += view.reference.size // 3
        if measured and pixels > MOST_PIXELS:
            break
        measured.append(index)
    return measured


def measure_views(run: RunFolder) -> dict[int, dict[str, float | None]]:
    """Return {view: {name: value}} of the last pictures of `measured_views`."""
    views = {index: run.views[index] for index in measured_views(run)}
    return {
        index: {metric.name: metric.compute(view.result, view.reference, view.mask) for metric in available()}
        for index, view in views.items()
    }


def measure_run(run: RunFolder) -> dict[str, float | None]:
    """Return {name: mean over the views of `measure_views`}; None where no view has a value."""
    views = list(measure_views(run).values())
    return {metric.name: _mean([view[metric.name] for view in views]) for metric in available()}


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


_BINS = 200
_SMOOTHED_POINTS = 500
_TIMES = 2000


@dataclass(frozen=True)
class Series:
    """A quantity of one run as a step function: each value holds until the next one.

    The arrays have one length. Seconds and samples ascend. Values are never NaN, but can be infinite.
    """

    seconds: np.ndarray
    samples: np.ndarray
    values: np.ndarray

    def at(self, positions: np.ndarray, axis: str = "seconds") -> np.ndarray:
        """Return the last known value at each position of the axis, "seconds" or "samples"; the first value before the first position."""
        known = getattr(self, axis)
        return self.values[np.maximum(np.searchsorted(known, positions, side="right") - 1, 0)]

    def time_to(self, level: float) -> float | None:
        """Return the first time, in seconds, at which the value is at most `level`; None if it never is."""
        below = np.flatnonzero(self.values <= level)
        return float(self.seconds[below[0]]) if below.size else None


@dataclass(frozen=True)
class Band:
    """Several runs of one method: median, minimum and maximum over them along an axis; arrays of one length."""

    x: np.ndarray
    median: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def time_to(self, level: float) -> float | None:
        """Return the first position at which the median is at most `level`; None if it never is."""
        below = np.flatnonzero(self.median <= level)
        return float(self.x[below[0]]) if below.size else None


def parameter_error(run: RunFolder, key: str) -> Series | None:
    """Return the error of a parameter over the run, and last that of the result, which may have other values; None without truth."""
    if key not in run.known:
        return None
    history = run.history
    recorded = history.parameter_error.get(key)
    records = recorded.records if recorded is not None else np.array([], int)
    seconds = history.seconds[records]
    samples = history.samples[records]
    values = recorded.values if recorded is not None else np.array([])
    first, last = run.error_before.get(key), run.error_after.get(key)
    if first is not None:
        seconds, samples, values = np.r_[0.0, seconds], np.r_[0.0, samples], np.r_[first, values]
    measured_last = len(records) > 0 and records[-1] == len(history) - 1
    if last is not None and len(history) and not measured_last:
        seconds = np.r_[seconds, history.seconds[-1]]
        samples, values = np.r_[samples, history.samples[-1]], np.r_[values, last]
    # Files of a running one are of an earlier step; float32 values round the error.
    elif last is not None and run.record.status != "running" and not np.isclose(values[-1], last, rtol=1e-5, atol=0.0):
        values = np.r_[values[:-1], last]
    return Series(seconds, samples, values) if len(values) else None


def relative_error(run: RunFolder, keys: Sequence[str], start: Mapping[str, float] | None = None) -> Series | None:
    """Return the mean over the parameters of error / error at the start: 1 at the start, 0 at full recovery.

    Methods may start elsewhere, so runs are compared relative to the errors at one `start`; None for those of the run. Parameters without
    truth, or with an error of 0 or infinity there, are left out; None if no parameter remains.
    """
    known = {key: series for key in keys if (series := parameter_error(run, key)) is not None}
    before = {key: float(series.values[0]) for key, series in known.items()} | dict(start or {})
    scaled = [(known[key], before[key]) for key in known if 0 < before[key] < np.inf]
    if not scaled:
        return None
    usable = [series for series, _ in scaled]
    seconds = np.unique(np.concatenate([series.seconds for series in usable]))
    samples = usable[0].samples[np.maximum(np.searchsorted(usable[0].seconds, seconds, side="right") - 1, 0)]
    return Series(seconds, samples, np.mean([series.at(seconds) / first for series, first in scaled], axis=0))


def image_error(run: RunFolder) -> float | None:
    """Return the error of the pictures of the result: root mean square over pixels and channels, mean over views; None without pictures."""
    return _mean([metrics.rmse(view.result, view.reference, view.mask) for view in run.views.values()])


def smoothed_loss(run: RunFolder, window: float) -> Series | None:
    """Return the loss, each value the median of the records of the last `window` seconds. Skipped steps are left out."""
    known = np.isfinite(run.history.loss)
    seconds, samples, loss = run.history.seconds[known], run.history.samples[known], run.history.loss[known]
    if not len(loss):
        return None
    ends = np.unique(np.linspace(0, len(loss) - 1, min(len(loss), _SMOOTHED_POINTS)).astype(int))
    starts = np.searchsorted(seconds, seconds[ends] - window, side="right")
    values = [np.median(loss[min(a, b) : b + 1]) for a, b in zip(starts, ends, strict=True)]
    return Series(seconds[ends], samples[ends], np.array(values))


def band(series: Sequence[Series], axis: str, end: float, count: int | None = None) -> Band:
    """Return median and spread of several runs from 0 to `end`, at `count` even positions, or at each change of a run."""
    if count is None:
        positions = np.unique(np.concatenate([getattr(one, axis) for one in series] + [np.array([0.0, end])]))
        positions = positions[positions <= end]
        positions = positions[np.unique(np.linspace(0, len(positions) - 1, min(len(positions), _TIMES)).astype(int))]
    else:
        positions = np.linspace(0.0, end, count)
    values = np.stack([one.at(positions, axis) for one in series])
    return Band(positions, np.median(values, axis=0), values.min(axis=0), values.max(axis=0))


def binned(x: np.ndarray, y: np.ndarray) -> Band:
    """Return median, minimum and maximum of a noisy curve in at most 200 bins of x."""
    known = np.isfinite(y)
    x, y = x[known], y[known]
    if len(x) <= _BINS:
        return Band(x, y, y, y)
    bin_index = np.minimum((x / (x[-1] or 1.0) * _BINS).astype(int), _BINS - 1)
    starts = np.flatnonzero(np.r_[True, np.diff(bin_index) > 0])
    ends = np.r_[starts[1:], len(y)]
    # All bins at once, since the live page of a run computes these every second: within a sorted bin, the middle is the median.
    ordered = y[np.lexsort((y, bin_index))]
    left, right = (starts + ends - 1) // 2, (starts + ends) // 2
    middle, median = (x[left] + x[right]) / 2, (ordered[left] + ordered[right]) / 2
    return Band(middle, median, ordered[starts], ordered[ends - 1])
