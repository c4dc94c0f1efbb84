"""How far a picture is from its reference, by measures that others report too.

All take linear RGB (H, W, 3). PSNR, SSIM and FLIP are of pictures as a screen shows them: both are multiplied by one exposure, that
takes the reference's 95th percentile of luminance to 0.7, clipped to [0, 1] and put through the sRGB curve. Radiance has no greatest
value that a peak signal-to-noise ratio could refer to, and a lamp in the picture would otherwise decide everything.
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
"""Added to the squared reference by `relative_mse`, so that black pixels do not decide."""
_WHITE_PERCENTILE = 95.0
_WHITE = 0.7
_SSIM_WINDOW = 7


def exposure(reference: np.ndarray) -> float:
    """The factor that takes the reference's 95th percentile of luminance to 0.7; 1 for a black reference.

    A percentile, so that a lamp in the picture leaves the rest of it visible.
    """
    luminance = reference @ np.array([0.2126, 0.7152, 0.0722])
    found = luminance[np.isfinite(luminance)]
    if found.size == 0:
        return 1.0
    level = float(np.percentile(found, _WHITE_PERCENTILE))
    level = level if level > 0 else float(found.max())
    return _WHITE / level if level > 0 else 1.0


def srgb(linear: np.ndarray) -> np.ndarray:
    """The sRGB transfer function (IEC 61966-2-1) of values clipped to [0, 1]; NaN becomes 0."""
    x = np.clip(np.nan_to_num(linear, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4) - 0.055)


def displayed(image: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both as a screen shows them, at the reference's exposure: values in [0, 1]. Raises `InputError` for other shapes."""
    image, reference = _pair(image, reference)
    factor = exposure(reference)
    with np.errstate(over="ignore"):
        return srgb(image * factor), srgb(reference * factor)


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB, 10 log10(1 / MSE) as displayed; infinite for equal pictures. Larger is better."""
    shown, wanted = displayed(image, reference)
    error = float(np.mean((shown - wanted) ** 2))
    return 10 * math.log10(1 / error) if error > 0 else math.inf


def ssim(image: np.ndarray, reference: np.ndarray) -> float | None:
    """Structural similarity (Wang et al. 2004) as displayed, in [-1, 1]: scikit-image's, in windows of 7 pixels, or as large as fit.

    1 for equal pictures. None for pictures of less than 3 pixels' width or height.
    """
    from skimage.metrics import structural_similarity

    shown, wanted = displayed(image, reference)
    side = min(_SSIM_WINDOW, *shown.shape[:2])
    if side < 3:
        return None
    window = side if side % 2 else side - 1
    found: Any = structural_similarity(wanted, shown, data_range=1.0, channel_axis=2, win_size=window)
    return float(found)


def flip(image: np.ndarray, reference: np.ndarray) -> float:
    """The mean of FLIP (Andersson et al. 2020) as displayed, in [0, 1], at its own 67 pixels per degree. Smaller is better.

    Raises `InputError` where the package flip-evaluator is missing.
    """
    try:
        import flip_evaluator
    except ImportError as error:
        raise InputError("metrics: FLIP needs a package of its own: pip install 'unrender[flip]'") from error
    shown, wanted = (np.ascontiguousarray(x, np.float32) for x in displayed(image, reference))
    _, mean, _ = flip_evaluator.evaluate(wanted, shown, "LDR", inputsRGB=True, applyMagma=False)
    return float(mean)


def relative_mse(image: np.ndarray, reference: np.ndarray) -> float:
    """The mean over pixels and channels of (I - R)² / (R² + 0.01), of linear values. Smaller is better.

    Infinite where a value is not finite. Raises `InputError` for pictures of different sizes.
    """
    image, reference = _pair(image, reference)
    with np.errstate(over="ignore", invalid="ignore"):
        found = float(np.mean((image - reference) ** 2 / (reference**2 + RELATIVE_EPSILON)))
    return found if math.isfinite(found) else math.inf


def rmse(image: np.ndarray, reference: np.ndarray) -> float:
    """The root of the mean squared difference of linear values. Smaller is better.

    Infinite where a value is not finite. Raises `InputError` for pictures of different sizes.
    """
    image, reference = _pair(image, reference)
    with np.errstate(over="ignore", invalid="ignore"):
        found = float(np.sqrt(np.mean((image - reference) ** 2)))
    return found if math.isfinite(found) else math.inf


def _pair(image: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    image, reference = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if image.shape != reference.shape or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise InputError(
            f"metrics: expected two pictures (H, W, 3) of one size, got {image.shape} and {reference.shape}"
        )
    return image, reference


def has_flip() -> bool:
    """Whether the package that computes FLIP is installed."""
    from importlib.util import find_spec

    return find_spec("flip_evaluator") is not None


MISSING = "LPIPS is left out: it needs pip install lpips, and AlexNet's weights in PyTorch's folder hub/checkpoints"
_LEAST = 32
"""Pixels a side that the network needs."""


def available() -> bool:
    """Whether the package is installed and AlexNet's weights lie where torchvision keeps them."""
    if any(find_spec(name) is None for name in ("torch", "torchvision", "lpips")):
        return False
    import torch  # pyright: ignore[reportMissingImports]

    return any((Path(torch.hub.get_dir()) / "checkpoints").glob("alexnet-*.pth"))


def distance(image: np.ndarray, reference: np.ndarray) -> float | None:
    """Of two pictures (H, W, 3) as displayed, in [0, 1], by AlexNet. Smaller is better. None where it cannot be computed."""
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
