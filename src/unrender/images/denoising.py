"""Taking the noise out of a picture or a map: Intel's Open Image Denoise on the CPU, OptiX on an NVIDIA GPU, total variation anywhere.

Whatever is denoised is biased: a denoiser trades noise for error. Pictures must have a box filter, whose pixels do not share samples;
all pictures of `unrender` have.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from unrender.backend import variant
from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean

Denoiser = Literal["auto", "oidn", "optix", "variation"]
"""Who denoises: "oidn" (package pyoidn), "optix" (Mitsuba's, where its variant runs on a GPU), "variation" (scikit-image's total
variation, for maps: it keeps the mean, and knows nothing of how pictures look), or "auto": optix where it runs, else oidn."""

_SMALLEST, _MULTIPLE = 32, 16
"""Pixels a side that the networks get at least, and a multiple of which they work on: beyond the border they see black, which costs a
picture of 4 x 4 a quarter of its light. Others are continued by their mirror images."""


def choose(by: Denoiser = "auto") -> Denoiser:
    """The denoiser that "auto" means on this machine; any other name is checked.

    Raises:
        InputError: there is none of that name, or it cannot run here; one line that says what to install.
    """
    if by not in ("auto", *_DENOISERS):
        known = ("auto", *_DENOISERS)
        raise InputError(f"denoiser {by!r}: expected {', '.join(known)}{did_you_mean(str(by), known)}")
    on_gpu = variant.current() == variant.CUDA
    if by == "optix" and not on_gpu:
        raise InputError(
            f"denoiser optix: it needs the variant {variant.CUDA}, which is not in use; oidn runs on the CPU"
        )
    if by == "auto":
        by = "optix" if on_gpu else "oidn"
    if by == "oidn" and importlib.util.find_spec("pyoidn") is None:
        raise InputError("denoising needs pyoidn: pip install 'unrender[denoise]'")
    return by


def denoise(
    image: np.ndarray,
    albedo: np.ndarray | None = None,
    normals: np.ndarray | None = None,
    by: Denoiser = "auto",
    fast: bool = False,
) -> np.ndarray:
    """`image` without its noise. Biased; deterministic on the CPU.

    The scale does not matter: `denoise(c * image)` is `c * denoise(image)` up to rounding, for c > 0.

    Args:
        image: (H, W) or (H, W, 3), linear, finite, of any size from 1 x 1. Values below 0 count as 0.
        albedo: (H, W, 3) in [0, 1], of what the pixels see first; guides where edges are. Not for "variation".
        normals: (H, W, 3) in [-1, 1], in the sensor's frame; only beside `albedo`. Not for "variation".
        by: see `Denoiser`.
        fast: of oidn, the smaller network: half the time, for maps that only steer. The others have one quality.

    Returns:
        float32 of the shape of `image`, >= 0.

    Raises:
        InputError: shapes that do not fit, values that are not finite, a denoiser that cannot run here.
    """
    by = choose(by)
    picture = _checked("image", image)
    guides = {name: _checked(name, x) for name, x in (("albedo", albedo), ("normals", normals)) if x is not None}
    for name, guide in guides.items():
        if guide.shape != (*picture.shape[:2], 3):
            raise InputError(f"denoise: {name} must be of shape {(*picture.shape[:2], 3)}, got {guide.shape}")
        if by == "variation":
            raise InputError(f"denoise: {name} guides no denoiser by total variation")
    if "normals" in guides and "albedo" not in guides:
        raise InputError("denoise: normals need albedo beside them")
    picture = np.maximum(picture, 0)
    scale = float(picture.mean(dtype=np.float64))
    if scale == 0:
        return picture
    found = np.maximum(_DENOISERS[by](picture / np.float32(scale), guides, fast), 0)
    return np.ascontiguousarray(found * np.float32(scale), np.float32)


def _checked(name: str, given: Any) -> np.ndarray:
    array = np.asarray(given)
    if not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
        raise InputError(f"denoise: {name} must be an array of numbers, got {array.dtype}")
    if (array.ndim not in (2, 3)) or (array.ndim == 3 and array.shape[2] != 3) or array.size == 0:
        raise InputError(f"denoise: {name} must be of shape (H, W) or (H, W, 3), got {array.shape}")
    with np.errstate(over="ignore"):
        array = array.astype(np.float32)
    if not np.isfinite(array).all():
        raise InputError(f"denoise: {name} has values that are not finite")
    return array


def _oidn(picture: np.ndarray, guides: dict[str, np.ndarray], fast: bool) -> np.ndarray:
    try:
        import pyoidn  # pyright: ignore[reportMissingImports]
    except (ImportError, OSError) as error:
        raise InputError(f"denoising needs pyoidn, which cannot be loaded here: {error}") from error
    names = {"albedo": "albedo", "normals": "normal"}
    given: dict[str, Any] = {names[name]: _continued(guide) for name, guide in guides.items()}
    return _as(pyoidn.denoise(_continued(picture), **given, hdr=True, quality="fast" if fast else "high"), picture)


def _optix(picture: np.ndarray, guides: dict[str, np.ndarray], fast: bool) -> np.ndarray:
    import mitsuba as mi

    del fast
    noisy = _continued(picture)
    denoiser = _optix_denoiser(noisy.shape[1], noisy.shape[0], "albedo" in guides, "normals" in guides)
    given = {name: mi.TensorXf(_continued(guide)) for name, guide in guides.items()}
    return _as(np.array(denoiser(mi.TensorXf(noisy), **given).numpy()), picture)


@functools.lru_cache(maxsize=8)
def _optix_denoiser(width: int, height: int, albedo: bool, normals: bool) -> Any:
    import mitsuba as mi

    return mi.OptixDenoiser(mi.ScalarVector2u(width, height), albedo=albedo, normals=normals)


def _variation(picture: np.ndarray, guides: dict[str, np.ndarray], fast: bool) -> np.ndarray:
    """Rudin, Osher and Fatemi's model, with the noise seen in the differences between neighbours as its weight."""
    del guides, fast
    from skimage.restoration import denoise_tv_chambolle

    steps = np.concatenate([np.abs(np.diff(picture, axis=axis)).reshape(-1) for axis in (0, 1)])
    if steps.size == 0:
        return picture
    # The median tells flat places from edges; 0.6745 is that of |N(0, 1)|, and a difference has twice the variance.
    noise = float(np.median(steps)) / (0.6745 * np.sqrt(2))
    if noise == 0:
        return picture
    channels = 2 if picture.ndim == 3 else None
    return np.asarray(denoise_tv_chambolle(picture, weight=noise, channel_axis=channels))


_DENOISERS: dict[str, Callable[[np.ndarray, dict[str, np.ndarray], bool], np.ndarray]] = {
    "oidn": _oidn,
    "optix": _optix,
    "variation": _variation,
}


def _continued(picture: np.ndarray) -> np.ndarray:
    """(H, W) or (H, W, 3) as (H', W', 3), each side a multiple of `_MULTIPLE` and at least `_SMALLEST`."""
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=2)
    more = [(0, max(_SMALLEST - side, -side % _MULTIPLE)) for side in picture.shape[:2]]
    return np.ascontiguousarray(np.pad(picture, [*more, (0, 0)], mode="symmetric"), np.float32)


def _as(found: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """The part of `found` that `picture` had, with its channels."""
    part = found[: picture.shape[0], : picture.shape[1]]
    return part.mean(axis=2) if picture.ndim == 2 else part
