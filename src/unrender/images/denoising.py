"""Denoising of images and maps, by Intel's Open Image Denoise on the CPU, OptiX on an NVIDIA GPU, or total variation.

Denoising biases: it trades noise for error. Images must have a box filter, so that pixels share no samples, as images of `unrender` do.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from unrender.backend import variant
from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.checks import Several
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.text import did_you_mean, in_words
from unrender.core.trees import Tree
from unrender.images.base import ImageEstimate, ImageEstimator, PairRequest, Plain, WithoutSnapshot
from unrender.rendering.renderer import Space
from unrender.scene.batches import Frame
from unrender.scene.problem import Problem

Denoiser = Literal["auto", "oidn", "optix", "variation"]
"""Denoisers: "oidn" (package pyoidn), "optix" (Mitsuba's, for GPU variants), "variation" (scikit-image's total variation, which preserves
the mean and suits maps rather than images), or "auto": optix if available, else oidn."""

_SMALLEST, _MULTIPLE = 32, 16
"""Smallest side in pixels, and its divisor, to which images are padded by mirroring.

The networks see black beyond the border, which costs an image of 4 x 4 a quarter of its light.
"""


def choose(by: Denoiser = "auto") -> Denoiser:
    """Return the denoiser that "auto" selects on this machine; any other name is checked.

    Raises:
        InputError: the name is unknown, or the denoiser is not available; the message says what to install.
    """
    if not isinstance(by, str) or by not in ("auto", *_DENOISERS):
        known = ("auto", *_DENOISERS)
        raise InputError(f"denoiser {in_words(by)}: expected {', '.join(known)}{did_you_mean(by, known)}")
    if by == "auto":
        by = "oidn" if optix_problem() else "optix"
    elif by == "optix" and (problem := optix_problem()):
        raise InputError(f"denoiser optix: {problem}; oidn runs on the CPU")
    if by == "oidn" and importlib.util.find_spec("pyoidn") is None:
        raise InputError("denoising needs pyoidn: pip install 'unrender[denoise]'")
    return by


def optix_problem() -> str | None:
    """Return why OptiX cannot denoise here, in one line; None if it can. Tested once per process."""
    on_gpu = variant.is_gpu()
    return _failure_of_optix() if on_gpu else f"it needs the variant {variant.CUDA}"


@functools.cache
def _failure_of_optix() -> str | None:
    """Return why a denoiser cannot be made. A separate process tries, since OptiX ends it where its weights are not installed."""
    return variant.gpu_trial(f"mi.OptixDenoiser(mi.ScalarVector2u({_SMALLEST}, {_SMALLEST}))")


def denoise(image: np.ndarray, by: Denoiser = "auto", fast: bool = False) -> np.ndarray:
    """Remove the noise of `image`. Biased; deterministic on the CPU.

    The result scales with the image: `denoise(c * image)` is `c * denoise(image)` up to rounding, for c > 0.

    Args:
        image: (H, W) or (H, W, 3), linear, finite, at least 1 x 1. Negative values count as 0.
        by: see `Denoiser`.
        fast: whether oidn uses its smaller network, which takes half the time and suits maps for sampling. The others have one quality.

    Returns:
        float32 of the shape of `image`, >= 0.

    Raises:
        InputError: another shape, values that are not finite, or an unavailable denoiser.
    """
    by = choose(by)
    picture = np.maximum(_checked(image), 0)
    scale = float(picture.mean(dtype=np.float64))
    if scale == 0:
        return picture
    denoised = np.maximum(_DENOISERS[by](picture / np.float32(scale), fast), 0)
    return np.ascontiguousarray(denoised * np.float32(scale), np.float32)


def _checked(image: Any) -> np.ndarray:
    array = checks.as_array(image, "denoise: image: ")
    if not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
        raise InputError(f"denoise: image must be an array of numbers, got {array.dtype}")
    if (array.ndim not in (2, 3)) or (array.ndim == 3 and array.shape[2] != 3) or array.size == 0:
        raise InputError(f"denoise: image must be of shape (H, W) or (H, W, 3), got {array.shape}")
    with np.errstate(over="ignore"):
        array = array.astype(np.float32)
    if not np.isfinite(array).all():
        raise InputError("denoise: image has values that are not finite")
    return array


def _oidn(picture: np.ndarray, fast: bool) -> np.ndarray:
    try:
        import pyoidn  # pyright: ignore[reportMissingImports]
    except (ImportError, OSError) as error:
        raise InputError(f"denoising needs pyoidn, which cannot be loaded here: {error}") from error
    return _as(pyoidn.denoise(_continued(picture), hdr=True, quality="fast" if fast else "high"), picture)


def _optix(picture: np.ndarray, fast: bool) -> np.ndarray:
    import mitsuba as mi

    noisy = _continued(picture)
    denoiser = _optix_denoiser(noisy.shape[1], noisy.shape[0])
    return _as(np.array(denoiser(mi.TensorXf(noisy)).numpy()), picture)


@functools.lru_cache(maxsize=8)
def _optix_denoiser(width: int, height: int) -> Any:
    import mitsuba as mi

    return mi.OptixDenoiser(mi.ScalarVector2u(width, height))


def _variation(picture: np.ndarray, fast: bool) -> np.ndarray:
    """Apply the model of Rudin, Osher and Fatemi, weighted by the noise that the differences between neighbours show."""
    from skimage.restoration import denoise_tv_chambolle

    steps = np.concatenate([np.abs(np.diff(picture, axis=axis)).reshape(-1) for axis in (0, 1)])
    if steps.size == 0:
        return picture
    # The median excludes edges; 0.6745 is the median of |N(0, 1)|, and a difference has twice the variance.
    noise = float(np.median(steps)) / (0.6745 * np.sqrt(2))
    if noise == 0:
        return picture
    channels = 2 if picture.ndim == 3 else None
    return np.asarray(denoise_tv_chambolle(picture, weight=noise, channel_axis=channels))


_DENOISERS: dict[str, Callable[[np.ndarray, bool], np.ndarray]] = {
    "oidn": _oidn,
    "optix": _optix,
    "variation": _variation,
}


def _continued(picture: np.ndarray) -> np.ndarray:
    """Pad (H, W) or (H, W, 3) to (H', W', 3), with sides that are multiples of `_MULTIPLE` and at least `_SMALLEST`."""
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=2)
    more = [(0, max(_SMALLEST - side, -side % _MULTIPLE)) for side in picture.shape[:2]]
    return np.ascontiguousarray(np.pad(picture, [*more, (0, 0)], mode="symmetric"), np.float32)


def _as(padded: np.ndarray, picture: np.ndarray) -> np.ndarray:
    part = padded[: picture.shape[0], : picture.shape[1]]
    return part.mean(axis=2) if picture.ndim == 2 else part


@register
@dataclass(frozen=True)
class Denoised(WithoutSnapshot):
    """The image of another estimator, denoised before the loss is evaluated. Biased.

    A denoiser trades variance for a systematic error that no number of steps averages out. The optimisation converges to parameters whose
    *denoised* image matches the reference, which are at best near the truth. Use it if the loss derivative is nonlinear and the image so
    noisy that the bias from noise is larger, and for previews. A control variate in `inner` applies to the image before denoising.

    Image and adjoint stay independent: for each sample group the image of all *other* groups is denoised separately, so no adjoint is
    weighted by an image of its own samples. Each is a call of the denoiser, so fewer groups are used than elsewhere.

    Denoisers need independent noise per pixel. Pixels here do not share samples; otherwise a denoiser takes correlated noise for texture.

    Args:
        inner: image estimator, `images.Plain()` or `images.RecursiveControlVariate()`.
        by: the denoiser: "auto" (OptiX on a GPU, else OIDN: `pip install 'unrender[denoise]'`), "oidn", "optix" or "variation".
        groups: number of sample groups, >= 2: the largest divisor of the estimator's own number that is at most this, else its smallest
            divisor above 1. Each group needs a call of the denoiser in addition to the full image; more groups have less noisy images.

    Raises:
        InputError: at construction, a value out of range; from `init`, a denoiser that is not available.
    """

    inner: ImageEstimator = field(default_factory=Plain)
    by: Denoiser = "auto"
    groups: Several = 2
    pixelwise = False  # a denoiser needs the neighbours of a pixel

    def __post_init__(self):
        checks.fields(self)
        if isinstance(self.inner, Denoised):
            raise InputError("Denoised: inner must be another image estimator, such as Plain(), got a Denoised")

    @property
    def space(self) -> Space | None:
        return self.inner.space

    def init(self, problem: Problem, parameters: Tree) -> Any:
        """Return the state of `inner`. Raises `InputError` if the denoiser is not available."""
        choose(self.by)
        return self.inner.init(problem, parameters)

    def estimate(
        self,
        problem: Problem,
        parameters: Tree,
        state: Any,
        frame: Frame,
        spp: int,
        groups: int,
        key: Key,
        pair_request: PairRequest | None = None,
    ) -> tuple[ImageEstimate, Any]:
        estimate, contribution = self.inner.estimate(
            problem, parameters, state, frame, spp, self._groups(groups), key, pair_request
        )
        return replace(estimate, filter=self._filter(problem), variance=None), contribution

    def needs_full_views(self, parameters: Tree, state: Any, batches: int) -> bool:
        return True

    def advance(self, parameters: Tree, state: Any, contributions: tuple[Any, ...]) -> Any:
        return self.inner.advance(parameters, state, contributions)

    def _groups(self, requested: int) -> int:
        """Return the largest divisor of `requested` that is at most `groups`, else its smallest divisor above 1."""
        divisors = [n for n in range(2, requested + 1) if requested % n == 0]
        return max((n for n in divisors if n <= self.groups), default=min(divisors, default=1))

    def _filter(self, problem: Problem) -> Callable[[Array], Array]:
        def filtered(image: Array) -> Array:
            noisy = arrays.numpy(image)
            if not arrays.all_finite(noisy):
                return image  # the loop then skips the step
            positive = denoise(noisy, by=self.by)
            # Pixels of a film with negative lobes, or of a property such as normals, may be negative.
            return problem.renderer.array(positive - denoise(-noisy, by=self.by) if (noisy < 0).any() else positive)

        return filtered
