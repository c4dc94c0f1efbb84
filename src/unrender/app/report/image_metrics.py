"""Image metrics of the final pictures of a run, by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from unrender.losses import metrics
from unrender.runs.folder.reader import RunFolder

MOST_PIXELS = 1 << 21
"""Limit of the pixels that are measured, over all views. FLIP takes a second or two per megapixel."""


@dataclass(frozen=True)
class ImageMetric:
    """A metric of a picture against its reference.

    Attributes:
        name: the name in headings.
        description: the definition, for readers.
        larger_is_better: whether larger values are better.
        compute: the function from (picture, reference) to a number, or None where the metric is undefined.
    """

    name: str
    description: str
    larger_is_better: bool
    compute: Callable[[np.ndarray, np.ndarray], float | None]


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
        index: {metric.name: metric.compute(view.result, view.reference) for metric in available()}
        for index, view in views.items()
    }


def measure_run(run: RunFolder) -> dict[str, float | None]:
    """Return {name: mean over the views of `measure_views`}; None where no view has a value."""
    views = list(measure_views(run).values())
    return {metric.name: _mean([view[metric.name] for view in views]) for metric in available()}


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
