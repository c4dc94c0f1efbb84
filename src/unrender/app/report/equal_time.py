"""Comparison of several methods at equal time and at equal samples: errors, ratios, times to a target error, curves."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from unrender.app.report import curves
from unrender.app.report.curves import Band, ImageMetric, Series
from unrender.app.report.groups import Group
from unrender.core.errors import InputError
from unrender.display.plots import AXES
from unrender.rendering import parameter_errors
from unrender.runs.folder.reader import RunFolder

SHARES = (0.25, 0.5, 1.0)
"""Fractions of the time of the shortest run, or of the fewest samples, at which methods are compared."""
LOSS_WINDOW = 0.05
"""Window of the median of a loss, as a fraction of the time of the shortest run."""
_POINTS = 200


@dataclass(frozen=True)
class Spread:
    """Median, minimum and maximum over the runs of one method; None where no value is known."""

    median: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True)
class ErrorAtBudget:
    """The error of one method at a fraction of the budget, in seconds or in samples.

    Attributes:
        share: fraction of the time of the shortest run, or of the fewest samples.
        seconds, samples: the position; one of the two is None.
        ratio: ratio of the median to that of the first method; None where that is 0 or not finite.
    """

    share: float
    seconds: float | None
    samples: float | None
    error: Spread
    ratio: float | None


@dataclass(frozen=True)
class TimeToTarget:
    """The time at which one method reaches the target: the lowest median error of the first method.

    Attributes:
        seconds: time at which the median over the runs reaches the target; None if it never does.
        fastest, slowest: the least and the greatest time of the single runs that reach the target.
        count, runs: number of the runs that reach the target, and number of all runs.
        speedup: time of the first method divided by the time of this one; None where either is unknown or zero.
    """

    seconds: float | None
    fastest: float | None
    slowest: float | None
    count: int
    runs: int
    speedup: float | None


@dataclass(frozen=True)
class MethodResult:
    """The results of one method by one metric.

    Attributes:
        moments: errors at `SHARES` of the time that all runs have.
        at_samples: errors at `SHARES` of the samples that all runs have.
        reached: the time to the target error.
        over_seconds, over_samples: the error's median and range along both axes.
    """

    moments: tuple[ErrorAtBudget, ...]
    at_samples: tuple[ErrorAtBudget, ...]
    reached: TimeToTarget
    over_seconds: Band
    over_samples: Band


@dataclass(frozen=True)
class Metric:
    """A compared quantity.

    Attributes:
        name: "loss", "relative parameter error", or the key of a parameter.
        best_of_first: the lowest median over the runs of the first method.
        improves: whether `best_of_first` is less than the initial median.
        methods: {label of the method: outcome}.
    """

    name: str
    title: str
    best_of_first: float
    improves: bool
    methods: dict[str, MethodResult]

    def best_at(self, index: int, axis: str = "seconds") -> str | None:
        """Return the method with the lowest median at `SHARES[index]` of the time or of the samples; None for a single method."""
        errors = {label: of.moments if axis == "seconds" else of.at_samples for label, of in self.methods.items()}
        return _best({label: of[index].error.median for label, of in errors.items()})


@dataclass(frozen=True)
class Comparison:
    """The comparison of several methods.

    Attributes:
        groups: the methods; the first one is the reference for the others.
        seconds: time of the shortest run.
        samples: paths of the run that traced the fewest.
        metrics: the compared quantities; pages and tables begin with the first one.
        image_error: {label: root mean square error of the result's pictures}, each run at its own end.
        images: {metric's name: {label: value}} of the same pictures.
        representatives: {label: the run with the (lower) median of the final parameter error, or of the image error without truth}.
    """

    groups: tuple[Group, ...]
    seconds: float
    samples: float
    metrics: tuple[Metric, ...]
    image_error: dict[str, Spread]
    images: dict[str, dict[str, Spread]]
    representatives: dict[str, RunFolder]

    def best_image(self, metric: ImageMetric) -> str | None:
        """Return the method with the best median of an image metric; None for a single method, or if no value is known."""
        sign = -1.0 if metric.larger_is_better else 1.0
        return _best({k: x.median and sign * x.median for k, x in self.images[metric.name].items()})


def _best(medians: Mapping[str, float | None]) -> str | None:
    known = {label: value for label, value in medians.items() if value is not None}
    return min(known, key=lambda label: known[label]) if len(medians) > 1 and known else None


def compare_groups(groups: tuple[Group, ...]) -> Comparison:
    """Compare methods up to the shortest time and the fewest samples. Raises `InputError` without truth and without a finite loss."""
    ends = {axis: min(float(getattr(run.history, axis)[-1]) for group in groups for run in group.runs) for axis in AXES}
    end = ends["seconds"]
    first_run = groups[0].runs[0]
    keys = [key for key in first_run.parameters if all(key in run.known for group in groups for run in group.runs)]
    compared = []
    if len(keys) > 1:
        compared.append(
            _metric(
                "relative parameter error",
                "Mean parameter error, relative to the first run's start",
                lambda run: curves.relative_error(run, keys, first_run.error_before),
                groups,
                ends,
            )
        )
    for key in keys:
        title = f"{parameter_errors.title([first_run.measure(key)])}: {key}"
        compared.append(_metric(key, title, lambda run, key=key: curves.parameter_error(run, key), groups, ends))
    compared.append(_metric("loss", "Loss", lambda run: curves.smoothed_loss(run, LOSS_WINDOW * end), groups, ends))
    # With several parameters, the mean over the parameters comes first, then the loss, then each parameter.
    order = [compared[0], compared[-1], *compared[1:-1]] if len(compared) > 1 else compared
    metrics = tuple(metric for metric in order if metric is not None)
    if not metrics:
        raise InputError(
            f"{first_run.path / 'history.jsonl'}: no truth is known and no loss is finite: nothing to compare"
        )
    images = {g.label: _spread([curves.image_error(run) for run in g.runs]) for g in groups}
    measured_images = {g.label: [curves.measure_run(run) for run in g.runs] for g in groups}
    by_metric = {
        metric.name: {label: _spread([run[metric.name] for run in runs]) for label, runs in measured_images.items()}
        for metric in curves.available()
    }
    representatives = {g.label: _median_run(g, keys, first_run.error_before) for g in groups}
    return Comparison(groups, end, ends["samples"], metrics, images, by_metric, representatives)


def _metric(
    name: str, title: str, series: Callable[[RunFolder], Series | None], groups: Sequence[Group], ends: dict[str, float]
) -> Metric | None:
    """Return a metric with its outcome for each method; None where some method has no value of it."""
    series_of = {group.label: [s for run in group.runs if (s := series(run)) is not None] for group in groups}
    if not all(series_of.values()):
        return None
    full = {label: curves.band(of, "seconds", min(float(s.seconds[-1]) for s in of)) for label, of in series_of.items()}
    first = next(iter(full.values()))
    level = float(first.median.min())
    improves = level < float(first.median[0])
    at_first = first.time_to(level)
    methods = {}
    for label, of in series_of.items():
        moments, at_samples = (
            tuple(_error_at(share, axis, ends[axis], of, next(iter(series_of.values()))) for share in SHARES)
            for axis in AXES
        )
        reached = _time_to_target(of, full[label], level, at_first if improves else None)
        longest = min(float(s.samples[-1]) for s in of)
        over_seconds = curves.band(of, "seconds", float(full[label].x[-1]), _POINTS)
        methods[label] = MethodResult(
            moments, at_samples, reached, over_seconds, curves.band(of, "samples", longest, _POINTS)
        )
    return Metric(name, title, level, improves, methods)


def _error_at(share: float, axis: str, end: float, of: Sequence[Series], first: Sequence[Series]) -> ErrorAtBudget:
    position = share * end
    own, reference = ([float(s.at(np.array([position]), axis)[0]) for s in runs] for runs in (of, first))
    a, b = median(own), median(reference)
    ratio = a / b if b > 0 and math.isfinite(a) and math.isfinite(b) else None
    seconds, samples = (position, None) if axis == "seconds" else (None, position)
    return ErrorAtBudget(share, seconds, samples, _spread(own), ratio)


def _time_to_target(of: Sequence[Series], median_run: Band, level: float, at_first: float | None) -> TimeToTarget:
    when, each = median_run.time_to(level), [t for s in of if (t := s.time_to(level)) is not None]
    speedup = at_first / when if when and at_first else None
    return TimeToTarget(when, min(each, default=None), max(each, default=None), len(each), len(of), speedup)


def _spread(values: Sequence[float | None]) -> Spread:
    known = [value for value in values if value is not None]
    return Spread(median(known), min(known), max(known)) if known else Spread(None, None, None)


def _median_run(group: Group, keys: Sequence[str], start: Mapping[str, float]) -> RunFolder:
    def last(run: RunFolder) -> float:
        relative_error = curves.relative_error(run, keys, start)
        if relative_error is not None:
            return float(relative_error.values[-1])
        image = curves.image_error(run)
        return image if image is not None else math.inf

    return sorted(group.runs, key=last)[(len(group.runs) - 1) // 2]
