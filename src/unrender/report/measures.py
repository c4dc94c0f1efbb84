"""The measures of a run's last pictures, by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from unrender.evaluation import metrics
from unrender.runs.folder.reader import RunFolder

MOST_PIXELS = 1 << 21
"""Of all views' pictures that are measured. FLIP takes a second or two for a megapixel."""


@dataclass(frozen=True)
class Measure:
    """A way to compare a picture with its reference.

    Attributes:
        name: in headings.
        note: what it is, for people.
        larger: whether larger values are better.
        of: (picture, reference) to a number, or None where it cannot tell.
    """

    name: str
    note: str
    larger: bool
    of: Callable[[np.ndarray, np.ndarray], float | None]


def known() -> list[Measure]:
    """Those that can be computed here; FLIP where its package is installed."""
    found = [
        Measure("RMSE", "root mean square error of linear values", False, metrics.rmse),
        Measure(
            "relative MSE", "mean of (I - R)\u00b2 / (R\u00b2 + 0.01), of linear values", False, metrics.relative_mse
        ),
        Measure("PSNR", "peak signal-to-noise ratio in dB, as displayed", True, metrics.psnr),
        Measure("SSIM", "structural similarity, as displayed", True, metrics.ssim),
    ]
    return found + ([Measure("FLIP", "mean FLIP, as displayed", False, metrics.flip)] if metrics.has_flip() else [])


def of_views(run: RunFolder) -> dict[int, dict[str, float | None]]:
    """{view: {name: value}} of the last pictures: of the first view, and of as many more as have `MOST_PIXELS` together."""
    found: dict[int, dict[str, float | None]] = {}
    pixels = 0
    for index, view in run.views.items():
        pixels += view.reference.size // 3
        if found and pixels > MOST_PIXELS:
            break
        found[index] = {measure.name: measure.of(view.result, view.reference) for measure in known()}
    return found


def of_run(run: RunFolder) -> dict[str, float | None]:
    """{name: mean over the views of `of_views`}; None where nothing is known."""
    views = list(of_views(run).values())
    return {measure.name: _mean([view[measure.name] for view in views]) for measure in known()}


def _mean(values: Sequence[float | None]) -> float | None:
    found = [value for value in values if value is not None]
    return float(np.mean(found)) if found else None
