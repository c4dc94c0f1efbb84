"""How near a rendering is to a photograph where a mask says that the object is."""

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
    """Of one photograph.

    Attributes:
        psnr: in dB, over the pixels of the mask, as displayed; infinite for equal ones.
        ssim: mean over the mask of the map of structural similarity, windows of 7 pixels, black outside the mask; None for pictures that
            are smaller than a window.
        lpips: of the mask's bounding box, black outside the mask; None where the network is missing or the box is too small.
        exposure: factor before the sRGB curve: 1 for photographs within [0, 1], else that of `metrics.exposure`.
    """

    psnr: float
    ssim: float | None
    lpips: float | None
    exposure: float


@dataclass(frozen=True)
class Albedo:
    """A recovered base colour against the true one, over all pixels of the mask of all views.

    Light and base colour are known up to a factor for each channel, so the error is given as it is and after the best factors.

    Attributes:
        rmse: root mean square error.
        scaled_rmse: after the factors.
        factors: of the channels, those of least squares.
    """

    rmse: float
    scaled_rmse: float
    factors: tuple[float, ...]


def shown(image: np.ndarray, photograph: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Both (H, W, 3) as a screen shows them, in [0, 1] and black outside the mask; and the exposure."""
    inside = mask[..., None] > 0
    counted = photograph[mask > 0]
    factor = 1.0 if counted.max(initial=0.0) <= 1 else metrics.exposure(counted)
    with np.errstate(over="ignore", invalid="ignore"):
        one, two = (metrics.srgb(np.where(inside, x, 0.0) * factor) for x in (image, photograph))
    return one, two, factor


def measure(image: np.ndarray, photograph: np.ndarray, mask: np.ndarray) -> Measures:
    """Of a rendering against a photograph, linear (H, W, 3); mask (H, W), above 0 inside. Raises `InputError` for an empty mask."""
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
    found: Any = structural_similarity(two, one, data_range=1.0, channel_axis=2, win_size=_WINDOW, full=True)
    return float(found[1][mask > 0].mean())


def mean(found: list[Measures]) -> dict[str, float | None]:
    """Means over photographs, by name; None where one is not known."""
    columns = {name: [asdict(each)[name] for each in found] for name in ("psnr", "ssim", "lpips")}
    return {name: None if None in values else float(np.mean(values)) for name, values in columns.items()}


def best_factors(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Of least squares: what each channel of `found` (N, 3) is to be multiplied by, (3,); 1 of a black one."""
    squares = (found**2).sum(0)
    return np.where(squares > 0, (found * truth).sum(0) / np.maximum(squares, 1e-30), 1.0)


def compare_albedo(found: np.ndarray, truth: np.ndarray) -> Albedo:
    """Of pixels (N, 3) in [0, 1]."""
    factors = best_factors(found, truth)
    rmse, scaled = (float(np.sqrt(np.mean((x - truth) ** 2))) for x in (found, found * factors))
    return Albedo(rmse, scaled, tuple(float(x) for x in factors))
