"""Image metrics: differences between an image and its reference, by standard measures.

All but `distance` take linear RGB (H, W, 3). PSNR, SSIM and FLIP are computed on display images: both images are multiplied by
`exposure(reference)`, clipped to [0, 1], and converted by the sRGB curve. NaN is black in display images. Radiance has no peak value for
a peak signal-to-noise ratio, and a visible emitter would otherwise dominate.

A mask (H, W), with values from 0 to 1 and not 0 everywhere, weights the pixels. Images are black where it is 0.
"""

from __future__ import annotations

import functools
import math
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core.errors import InputError

__all__ = [
    "MISSING",
    "RELATIVE_EPSILON",
    "available",
    "displayed",
    "distance",
    "exposure",
    "flip",
    "has_flip",
    "psnr",
    "relative_mse",
    "rmse",
    "srgb",
    "ssim",
]


RELATIVE_EPSILON = 1e-2
"""Constant that `relative_mse` adds to the squared reference, so that black pixels do not dominate."""
_WHITE_PERCENTILE = 95.0
_WHITE = 0.7
_SSIM_WINDOW = 7


def exposure(reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the factor that maps the reference's 95th percentile of luminance to 0.7; 1 for a black reference.

    A percentile, unlike the maximum, is not affected by a small visible emitter. If it is 0, the maximum replaces it. Pixels that are not
    finite, or where a mask (H, W) is 0, are ignored.
    """
    reference = reference if mask is None else reference[mask > 0]
    luminance = reference @ np.array([0.2126, 0.7152, 0.0722])
    finite = luminance[np.isfinite(luminance)]
    if finite.size == 0:
        return 1.0
    level = float(np.percentile(finite, _WHITE_PERCENTILE))
    level = level if level > 0 else float(finite.max())
    return _WHITE / level if level > 0 else 1.0


def srgb(linear: np.ndarray) -> np.ndarray:
    """Apply the sRGB transfer function (IEC 61966-2-1) to values clipped to [0, 1]; NaN becomes 0."""
    x = np.clip(np.nan_to_num(linear, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4) - 0.055)


def displayed(
    image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return both images as displayed at the reference's exposure, with values in [0, 1]. Raises `InputError` for unequal shapes.

    They are black outside of a mask (H, W), and the exposure is that of the pixels inside.
    """
    image, reference = _pair(image, reference, mask)
    factor = exposure(reference, mask)
    with np.errstate(over="ignore"):
        return srgb(image * factor), srgb(reference * factor)


def psnr(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the peak signal-to-noise ratio of the display images in dB, 10 log10(1 / MSE); larger is better, infinite for equal images."""
    shown, target = displayed(image, reference, mask)
    error = _mean((shown - target) ** 2, mask)
    return 10 * math.log10(1 / error) if error > 0 else math.inf


def ssim(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float | None:
    """Return the structural similarity (Wang et al. 2004) of the display images, in [-1, 1], by scikit-image.

    The window has 7 pixels, or as many as fit. 1 for equal images. None for images with a side of less than 3 pixels.
    """
    from skimage.metrics import structural_similarity

    shown, target = displayed(image, reference, mask)
    side = min(_SSIM_WINDOW, *shown.shape[:2])
    if side < 3:
        return None
    window = side if side % 2 else side - 1
    similarity: Any = structural_similarity(target, shown, data_range=1.0, channel_axis=2, win_size=window, full=True)
    return float(similarity[0]) if mask is None else _mean(similarity[1], mask)


def flip(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the mean FLIP (Andersson et al. 2020) of the display images, in [0, 1], at 67 pixels per degree; smaller is better. Raises
    `InputError` without its package."""
    try:
        import flip_evaluator
    except ImportError as error:
        raise InputError("metrics: FLIP needs another package: pip install 'unrender[flip]'") from error
    shown, target = (np.ascontiguousarray(x, np.float32) for x in displayed(image, reference, mask))
    errors, _, _ = flip_evaluator.evaluate(target, shown, "LDR", inputsRGB=True, applyMagma=False)
    return _mean(np.asarray(errors, np.float64), mask)


def relative_mse(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the mean of (I - R)² / (R² + 0.01) in linear values; infinite if one is not finite. Raises `InputError` for unequal sizes."""
    image, reference = _pair(image, reference, mask)
    with np.errstate(over="ignore", invalid="ignore"):
        error = _mean((image - reference) ** 2 / (reference**2 + RELATIVE_EPSILON), mask)
    return error if math.isfinite(error) else math.inf


def rmse(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the root mean square difference in linear values; infinite if one is not finite. Raises `InputError` for unequal sizes."""
    image, reference = _pair(image, reference, mask)
    with np.errstate(over="ignore", invalid="ignore"):
        error = math.sqrt(_mean((image - reference) ** 2, mask))
    return error if math.isfinite(error) else math.inf


def _pair(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    image, reference = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if image.shape != reference.shape or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise InputError(
            f"metrics: expected two pictures (H, W, 3) of one size, got {image.shape} and {reference.shape}"
        )
    if mask is None:
        return image, reference
    inside = mask[..., None] > 0
    return np.where(inside, image, 0.0), np.where(inside, reference, 0.0)


def _mean(values: np.ndarray, mask: np.ndarray | None) -> float:
    if mask is None:
        return float(np.mean(values))
    return float(np.average(values.reshape(*mask.shape, -1).mean(axis=2), weights=mask))


def has_flip() -> bool:
    """Return whether the package that computes FLIP is installed."""
    return find_spec("flip_evaluator") is not None


MISSING = "LPIPS is not reported: it needs pip install lpips, and AlexNet's weights in PyTorch's folder hub/checkpoints"
_LEAST = 32  # smallest side in pixels that the network accepts


def available() -> bool:
    """Return whether LPIPS is installed and AlexNet's weights are in torchvision's cache folder."""
    if any(find_spec(name) is None for name in ("torch", "torchvision", "lpips")):
        return False
    import torch  # pyright: ignore[reportMissingImports]

    return any((Path(torch.hub.get_dir()) / "checkpoints").glob("alexnet-*.pth"))


def distance(image: np.ndarray, reference: np.ndarray) -> float | None:
    """Return LPIPS by AlexNet of two display images of equal shape (H, W, 3), see `displayed`. Smaller is better.

    None if a side is below 32 pixels, or unless `available`.
    """
    if min(image.shape[:2]) < _LEAST or not available():
        return None
    import torch  # pyright: ignore[reportMissingImports]

    one, two = (
        torch.from_numpy(np.ascontiguousarray(2 * x.transpose(2, 0, 1)[None] - 1, np.float32))
        for x in (image, reference)
    )
    with torch.no_grad():
        return float(_network()(one, two))


@functools.cache
def _network() -> Any:
    import lpips  # pyright: ignore[reportMissingImports]

    return lpips.LPIPS(net="alex", verbose=False)  # pyright: ignore[reportAttributeAccessIssue]
