"""Error measures between a rendering and a photograph inside a mask of the object."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from unrender.core.errors import InputError
from unrender.losses import metrics

_WINDOW = 7


@dataclass(frozen=True)
class Measures:
    """The measures of one photograph.

    Attributes:
        psnr: peak signal-to-noise ratio in dB over the pixels of the mask, as displayed; infinite for equal pictures.
        ssim: mean over the mask of the structural similarity with windows of 7 pixels, black outside the mask; None for pictures smaller
            than a window.
        lpips: LPIPS of the bounding box of the mask, black outside the mask; None if the network is missing or the box is too small.
        exposure: factor before the sRGB curve: 1 for photographs within [0, 1], otherwise that of `metrics.exposure`.
    """

    psnr: float
    ssim: float | None
    lpips: float | None
    exposure: float


@dataclass(frozen=True)
class Albedo:
    """The errors of a recovered base colour against the true one, over all pixels of the masks of all views.

    Light and base colour are determined only up to a factor for each channel. Therefore there are two errors: without and with the best
    factors.

    Attributes:
        rmse: root mean square error.
        scaled_rmse: root mean square error after multiplication by the factors.
        factors: factors of the channels by least squares.
    """

    rmse: float
    scaled_rmse: float
    factors: tuple[float, ...]


def shown(image: np.ndarray, photograph: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return both (H, W, 3) pictures as displayed, in [0, 1] and black outside the mask; and the exposure."""
    inside = mask[..., None] > 0
    counted = photograph[mask > 0]
    factor = 1.0 if counted.max(initial=0.0) <= 1 else metrics.exposure(counted)
    with np.errstate(over="ignore", invalid="ignore"):
        one, two = (metrics.srgb(np.where(inside, x, 0.0) * factor) for x in (image, photograph))
    return one, two, factor


def measure(image: np.ndarray, photograph: np.ndarray, mask: np.ndarray) -> Measures:
    """Return the measures of a rendering against a photograph, both linear (H, W, 3), with a mask (H, W) that is positive inside.

    Raises:
        InputError: the mask is empty.
    """
    if not (mask > 0).any():
        raise InputError("a mask without a pixel")
    one, two, factor = shown(image, photograph, mask)
    error = float(np.mean((one - two)[mask > 0] ** 2))
    psnr = 10 * math.log10(1 / error) if error > 0 else math.inf
    rows, columns = np.nonzero(mask > 0)
    box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    return Measures(psnr, _ssim(one, two, mask), metrics.distance(one[box], two[box]), factor)


def _ssim(one: np.ndarray, two: np.ndarray, mask: np.ndarray) -> float | None:
    from skimage.metrics import structural_similarity

    if min(mask.shape) < _WINDOW:
        return None
    similarity: Any = structural_similarity(two, one, data_range=1.0, channel_axis=2, win_size=_WINDOW, full=True)
    return float(similarity[1][mask > 0].mean())


def mean(measures: list[Measures]) -> dict[str, float | None]:
    """Return {name: mean over photographs}; None where a value is missing."""
    columns = {name: [asdict(each)[name] for each in measures] for name in ("psnr", "ssim", "lpips")}
    return {name: None if None in values else float(np.mean(values)) for name, values in columns.items()}


def best_factors(values: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the least squares factors (3,) of the channels that bring `values` (N, 3) closest to `truth`; 1 for a black channel."""
    squares = (values**2).sum(0)
    return np.where(squares > 0, (values * truth).sum(0) / np.maximum(squares, 1e-30), 1.0)


def compare_albedo(values: np.ndarray, truth: np.ndarray) -> Albedo:
    """Return the errors of the base colour of N pixels, (N, 3) in [0, 1]."""
    factors = best_factors(values, truth)
    rmse, scaled = (float(np.sqrt(np.mean((x - truth) ** 2))) for x in (values, values * factors))
    return Albedo(rmse, scaled, tuple(float(x) for x in factors))
