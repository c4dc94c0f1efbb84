"""Views, and the references of all of them: values and loss weights of their pixels, their noise, and losses of images."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.io.stored_pictures import StoredPicture
from unrender.losses import Censored, Loss
from unrender.losses.pixelwise import determined_pixels
from unrender.rendering.picture_format import format_of
from unrender.rendering.renderer import Renderer

if TYPE_CHECKING:
    from unrender.scene.problem import Problem

ON_DEVICE = 1 << 29
"""Maximum size in bytes of references that are copied to the device; larger sets stay in host memory."""


@dataclass(frozen=True)
class View:
    """A reference image of the scene and its sensor.

    Args:
        reference: file, or array (H, W, 3), in linear RGB. Files and arrays of 8 and 16 bits are converted from sRGB. Other arrays have the
            film's format: luminance (H, W) or XYZ (H, W, 3) by its `pixel_format`. Of 8- and 16-bit images with alpha only opaque pixels
            count, since rendered edges mix an object with what is behind it. Alpha of floating-point images is ignored, because films
            store premultiplied colours.
        sensor: index of the scene's sensor.
        weight: factor of this view's loss, > 0.
        mask: file or array (H, W), in [0, 1], the factor of each pixel's loss; None for ones. Of an image whose alpha varies, its alpha.
        known: {key: value} of parameters that have this value in this view alone, such as lamps that are off, or the pose of an object on
            a turntable. Values as for `Parameter.initial`. An unknown among them does not act on this view. None for the problem's scene
            as it is.
        scene: Another scene that this view is of, as for `Problem`: an .xml file, a dictionary, a function, or a renderer. Unknowns are
            those of the problem's scene; the ones that this scene has under the same key act on it. None for the problem's scene.
        aov: What the reference contains in place of colour, for the first surface that each pixel sees: "depth" (distance), "position",
            "sh_normal" (shading normal), "albedo" (diffuse reflectance), in world space, or "mask" (1 on surfaces). Background is 0. None
            for colour.
    """

    reference: str | Path | np.ndarray | StoredPicture
    sensor: int = 0
    weight: float = 1.0
    mask: str | Path | np.ndarray | StoredPicture | None = None
    known: Mapping[str, Any] | None = None
    scene: str | Path | dict[str, Any] | Callable[[], Any] | Any = None
    aov: str | None = None

    def __post_init__(self) -> None:
        if isinstance(self.sensor, np.integer):  # files store Python's integers alone
            object.__setattr__(self, "sensor", int(self.sensor))

    @property
    def own_world(self) -> bool:
        """Return whether the view shows other values, another scene or another quantity than the problem's scene."""
        return self.known is not None or self.scene is not None or self.aov is not None

    def pixel_weights(self, size: int | tuple[int, int] | None = None) -> np.ndarray:
        """Return the factor of each pixel's loss: the mask (H, W) of a loaded view, or ones of `size`, by default the reference's."""
        if self.mask is not None:
            return np.asarray(self.mask)
        return np.ones(np.asarray(self.reference).shape[:2] if size is None else size)


class References:
    """Values and loss weights of single pixels of the references.

    Small sets, of at most `on_device` bytes, are copied to the renderer's device once. From large sets only the requested pixels are
    copied, from host memory or from the file of a `StoredPicture`.
    """

    def __init__(self, views: Sequence[View], array: Callable[[np.ndarray], Array], on_device: int = ON_DEVICE):
        self._views = views
        self._array = array
        self._sizes = [_size(view.reference) for view in views]
        self._factors = [view.weight / size for view, size in zip(views, self._sizes, strict=True)]
        self.in_host_memory = 4 * sum(self._sizes) > on_device
        self._complete: dict[range, tuple[Array, Array, Array]] = {}

    @cached_property
    def sensors(self) -> Array:
        """Sensor index of each view, integers."""
        return arrays.like_integers(np.array([view.sensor for view in self._views]), self._array(np.zeros(1)))

    def at(self, views: Array, pixels: Array) -> tuple[Array, Array]:
        """Return the reference values (N, 3) of these row-major pixels of views, and the factors of their losses (N, 1): weight * mask /
        (H * W * 3)."""
        if self.in_host_memory:
            return self._from_host(arrays.numpy(views), arrays.numpy(pixels))
        row = self.rows(views, pixels)
        factors = arrays.gather_rows(self._view_factors, views)
        if self._all_masks is not None:
            factors = factors * arrays.gather_rows(self._all_masks, row)
        return arrays.gather_rows(self._all_references, row), factors

    def complete(self, views: range) -> tuple[Array, Array, Array]:
        """Return view and index of each pixel of these views in order, (N,), integers, and ones (N, 1). The result is stored."""
        if views not in self._complete:
            counts = [self._sizes[view] // 3 for view in views]
            ones = self._array(np.ones((sum(counts), 1)))
            pixels = np.concatenate([np.arange(count) for count in counts])
            integers = [arrays.like_integers(x, ones) for x in (np.repeat(views, counts), pixels)]
            self._complete[views] = (integers[0], integers[1], ones)
        return self._complete[views]

    def rows(self, views: Array, pixels: Array) -> Array:
        """Return the index of these pixels in the concatenation of all views, (N,)."""
        return arrays.gather(self._starts, views) + pixels

    def _from_host(self, views: np.ndarray, pixels: np.ndarray) -> tuple[Array, Array]:
        values = np.empty((len(pixels), 3), np.float32)
        factors = np.empty((len(pixels), 1), np.float32)
        for view in np.unique(views):
            here = views == view
            own = self._views[view]
            values[here] = _rows(own.reference, pixels[here], 3)
            factors[here] = self._factors[view] * (1.0 if own.mask is None else _rows(own.mask, pixels[here], 1))
        return self._array(values), self._array(factors)

    @cached_property
    def _all_references(self) -> Array:
        return self._array(np.concatenate([np.asarray(view.reference).reshape(-1, 3) for view in self._views]))

    @cached_property
    def _all_masks(self) -> Array | None:
        if all(view.mask is None for view in self._views):
            return None
        pairs = zip(self._views, self._sizes, strict=True)
        columns = [view.pixel_weights(size // 3).ravel() for view, size in pairs]
        return self._array(np.concatenate(columns)[:, None])

    @cached_property
    def _starts(self) -> Any:
        sizes = [size // 3 for size in self._sizes]
        return arrays.like_integers(np.cumsum([0, *sizes[:-1]]), self._array(np.zeros(1)))

    @cached_property
    def _view_factors(self) -> Array:
        return self._array(np.array(self._factors)[:, None])


def _size(picture: Any) -> int:
    """Return the number of values. A stored image is not read."""
    return picture.size if isinstance(picture, StoredPicture) else np.asarray(picture).size


def _rows(picture: Any, pixels: np.ndarray, channels: int) -> np.ndarray:
    if isinstance(picture, StoredPicture):
        return picture.rows(pixels)
    return np.asarray(picture).reshape(-1, channels)[pixels]


_MEDIAN = 0.6744897501960817  # median of |z| of a standard normal z
_LEAST = 1e-4  # least noise, in units of the picture's root mean square: no picture is exact


def standard_deviation(reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the standard deviation of the noise of a picture (H, W, 3), in its units.

    It is the scaled median of |x_ij − x_i+1,j − x_i,j+1 + x_i+1,j+1| / 2, and at least 1e-4 times the root mean square of the picture.
    These differences are 0 for a sum of a function of the row and one of the column. They have the noise's standard deviation if noise is
    independent between pixels. Edges change few of them. Fine texture counts as noise. Noise that is correlated between neighbours, as by
    wide film filters, is underestimated.

    Args:
        reference: (H, W, 3). Values that are not finite are ignored.
        mask: (H, W); only differences of pixels above 0 count. None for all pixels.
    """
    picture = np.asarray(reference, np.float64)
    valid = np.isfinite(picture).all(axis=-1) & (True if mask is None else np.asarray(mask) > 0)
    size = math.sqrt(float(np.mean(picture[valid] ** 2))) if valid.any() else 0.0
    both = valid[1:, 1:] & valid[:-1, 1:] & valid[1:, :-1] & valid[:-1, :-1]
    twice = 0.5 * (picture[1:, 1:] - picture[:-1, 1:] - picture[1:, :-1] + picture[:-1, :-1])[both]
    deviation = float(np.median(np.abs(twice))) / _MEDIAN if twice.size else 0.0
    return max(deviation, _LEAST * size, 1e-12)


def likelihood_scale(problem: Problem, views: Iterable[int] | None = None) -> float:
    """Return s, the factor by which the negative log density of an unknown's prior enters the loss L.

    The loss of a view, |image − reference|^p per pixel, is s_v = p L_v(noise) / N_v times a negative log likelihood. L_v(noise) is its loss
    if the picture differs from the N_v values of the reference by their noise alone. A grey picture has one value per pixel, else three. p
    is measured: L_v grows by 2^p when that noise is doubled; 2 if it does not grow. s is the mean of s_v by the curvature of L_v, which is
    p L_v(noise) / σ_v² times the square of a derivative. That derivative is taken as proportional to the reference's standard deviation,
    so neither units nor a view without noise decide s. Raises `InputError` if the loss is not finite at the noise.

    Args:
        views: indices of the views that show the unknown; None for all.
    """
    scales, curvatures = [], []
    for index in range(len(problem.views)) if views is None else views:
        view = problem.views[index]
        reference = np.asarray(view.reference, np.float32)
        mask = None if view.mask is None else np.asarray(view.mask)
        sigma = standard_deviation(reference, mask)
        noise = np.random.default_rng(index).standard_normal(reference.shape).astype(np.float32) * np.float32(sigma)
        once, twice = (_loss(problem, index, reference + factor * noise) for factor in (1, 2))
        if not math.isfinite(once):
            raise InputError(
                f"prior: its scale is the loss at the references plus noise, where {type(problem.loss).__name__} is {once}; use a loss "
                "that is finite there, or leave out the priors"
            )
        power = math.log2(twice / once) if 0 < once < twice < math.inf else 2.0
        values = reference.shape[-1] if np.ptp(reference, axis=-1).any() else 1  # grey pixels are one value each
        scales.append(power * once / max(values * (reference[..., 0].size if mask is None else float(mask.sum())), 1.0))
        signal = np.nanvar(reference if mask is None else reference[mask > 0], dtype=np.float64)
        curvatures.append(power * once * (1.0 + float(signal) / sigma**2))
    return float(np.average(scales, weights=curvatures)) if any(curvatures) else float(np.mean(scales))


def _loss(problem: Problem, view: int, image: np.ndarray) -> float:
    return arrays.number(problem.loss_value(view, problem.renderer.array(image)))


class ViewLosses:
    """The part of `Problem` that estimators use: a loss per view. The attributes are those of `Problem`."""

    loss: Loss
    views: tuple[View, ...]
    original_views: tuple[View, ...]
    renderer: Renderer
    references: References
    _references: dict[int, Array]
    _masks: dict[int, Array | None]

    @property
    def given_views(self) -> tuple[View, ...]:
        """Former name of `original_views`. Version 0.2 removes it."""
        warnings.warn("Problem.given_views is now Problem.original_views", DeprecationWarning, stacklevel=2)
        return self.original_views

    def _view(self, view: int) -> View:
        return self.views[checks.integer("Problem", "view", view, 0, len(self.views) - 1)]

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """(height, width) of each view."""
        known = self.renderer.resolutions()
        return [known[view.sensor] for view in self.views]

    def reference(self, view: int) -> Array:
        """Return the view's reference as an array of the renderer, (H, W, 3)."""
        if view in self._references:
            return self._references[view]
        array = self.renderer.array(np.asarray(self._view(view).reference))
        if not self.references.in_host_memory:
            self._references[view] = array
        return array

    def mask(self, view: int) -> Array | None:
        """Return the view's mask as an array of the renderer, (H, W, 1), or None if every pixel counts."""
        if view in self._masks:
            return self._masks[view]
        mask = self._view(view).mask
        array = None if mask is None else self.renderer.array(np.asarray(mask)[..., None])
        if not self.references.in_host_memory:
            self._masks[view] = array
        return array

    @cached_property
    def units(self) -> list[float]:
        """Ratio of the root mean square of the first kind of references, colour if there is any, to that of each view's kind."""
        kinds = [format_of(self.renderer, view.sensor).aov for view in self.views]
        if len(set(kinds)) == 1:
            return [1.0] * len(kinds)
        squares = {
            kind: np.mean(
                [
                    np.mean(np.square(np.asarray(view.reference, np.float32)))
                    for view, own in zip(self.views, kinds, strict=True)
                    if own == kind
                ]
            )
            for kind in sorted(set(kinds))
        }
        first = next(iter(squares.values()))
        return [math.sqrt(first / squares[kind]) if first > 0 and squares[kind] > 0 else 1.0 for kind in kinds]

    def test_weights(self, view: int, images: Sequence[np.ndarray] = ()) -> np.ndarray:
        """Return the weight (H, W) of each pixel's square in tests of pictures: the mask's, and 0 for lower bounds of `Censored`.

        Bounds that independent images (H, W, 3) do not reach have the mask's weight, since these images are wrong there. Residuals of AOVs
        beside other views are multiplied by `units`, so that their references count as those of colour.
        """
        weights = self._view(view).pixel_weights(self.sizes[view])
        if not isinstance(self.loss, Censored):
            return weights
        return weights * determined_pixels(
            self.loss, np.asarray(self.views[view].reference), np.asarray(images) if len(images) else None
        )

    def loss_value(self, view: int, image: Array) -> Array:
        """Return the view's loss at an image (H, W, 3): weight * mean(mask * loss), a lazy scalar."""
        return arrays.mean(self._values(image, self.reference(view), self.mask(view))) * self.views[view].weight

    def loss_values(self, view: int, images: Array) -> Array:
        """Return `loss_value` of each of B images (B, H, W, 3): (B,), lazy."""
        reference, mask = arrays.add_first_axis(self.reference(view)), self.mask(view)
        values = self._values(images, reference, None if mask is None else arrays.add_first_axis(mask))
        return arrays.mean_over_rest(values) * self.views[view].weight

    def loss_derivative(self, view: int, image: Array) -> Array:
        """Return ∂(total loss)/∂(pixel) at an image (H, W, 3): weight * mask * loss' / (H * W * 3)."""
        reference, mask = self.reference(view), self.mask(view)
        derivative = self.loss.derivative(self._masked(image, reference, mask), reference)
        factor = self.views[view].weight / math.prod(arrays.shape(reference))
        return (derivative if mask is None else derivative * mask) * factor

    def _values(self, image: Array, reference: Array, mask: Array | None) -> Array:
        values = self.loss.value(self._masked(image, reference, mask), reference)
        return values if mask is None or not self.loss.pixelwise else values * mask

    def _masked(self, image: Array, reference: Array, mask: Array | None) -> Array:
        """Return the argument of the loss: the image for a pixelwise loss, else the reference and image blended by the mask. Raises
        `InputError` for another shape, which NumPy might broadcast."""
        shape = tuple(getattr(image, "shape", ()))
        if shape[-3:] != arrays.shape(reference)[-3:]:
            raise InputError(
                f"Problem: image must have the shape of the reference, {arrays.shape(reference)[-3:]}, got {shape}"
            )
        return image if mask is None or self.loss.pixelwise else reference + mask * (image - reference)
