"""Image metrics of a run's final pictures, by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from unrender.losses import metrics
from unrender.runs.folder.reader import RunFolder

MOST_PIXELS = 1 << 21
"""Of all views' pictures that are measured. FLIP takes a second or two for a megapixel."""


@dataclass(frozen=True)
class ImageMetric:
    """A metric of a picture against its reference.

    Attributes:
        name: in headings.
        description: what it is, for people.
        larger_is_better: whether larger values are better.
        compute: (picture, reference) to a number, or None where it is not defined.
    """

    name: str
    description: str
    larger_is_better: bool
    compute: Callable[[np.ndarray, np.ndarray], float | None]


def available() -> list[ImageMetric]:
    """Those that can be computed here; FLIP where its package is installed."""
    found = [
        ImageMetric("RMSE", "root mean square error of linear values", False, metrics.rmse),
        ImageMetric(
            "relative MSE", "mean of (I - R)\u00b2 / (R\u00b2 + 0.01), of linear values", False, metrics.relative_mse
        ),
        ImageMetric("PSNR", "peak signal-to-noise ratio in dB, as displayed", True, metrics.psnr),
        ImageMetric("SSIM", "structural similarity, as displayed", True, metrics.ssim),
    ]
    return found + ([ImageMetric("FLIP", "mean FLIP, as displayed", False, metrics.flip)] if metrics.has_flip() else [])


def measure_views(run: RunFolder) -> dict[int, dict[str, float | None]]:
    """{view: {name: value}} of the last pictures: of the first view, and of as many more as have `MOST_PIXELS` together."""
    found: dict[int, dict[str, float | None]] = {}
    pixels = 0
    for index, view in run.views.items():
        pixels += view.reference.size // 3
        if found and pixels > MOST_PIXELS:
            break
        found[index] = {metric.name: metric.compute(view.result, view.reference) for metric in available()}
    return found


def measure_run(run: RunFolder) -> dict[str, float | None]:
    """{name: mean over the views of `measure_views`}; None where nothing is known."""
    views = list(measure_views(run).values())
    return {metric.name: _mean([view[metric.name] for view in views]) for metric in available()}


def _mean(values: Sequence[float | None]) -> float | None:
    found = [value for value in values if value is not None]
    return float(np.mean(found)) if found else None
