"""The protocol of losses; pixelwise losses, and one for photographs with saturated pixels, whose true radiance is at least white."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.checks import Positive
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.text import in_words

_CLEARLY = 4.0  # standard errors by which images are darker than a lower bound that they do not reach


@register(position=1)
@dataclass(frozen=True)
class L1:
    """|I − R|. The derivative is the sign, 0 for equal values. Noise biases it more the closer I is to R."""

    linear, pixelwise = False, True

    def value(self, image: Array, reference: Array) -> Array:
        return arrays.absolute(image - reference)

    def derivative(self, image: Array, reference: Array) -> Array:
        return arrays.sign(image - reference)


@register(position=2)
@dataclass(frozen=True)
class L2:
    """(I − R)²."""

    linear, pixelwise = True, True

    def value(self, image: Array, reference: Array) -> Array:
        difference = image - reference
        return difference * difference

    def derivative(self, image: Array, reference: Array) -> Array:
        return 2.0 * (image - reference)


@register(position=3)
@dataclass(frozen=True)
class RelativeL2(checks.Checked):
    """(I − R)² / (R² + ε): squared relative error.

    The denominator contains the reference only, not the noisy image, so the derivative is linear. The estimators sample the image and the
    adjoint independently. The gradient is then that of the unbiased mean relative squared error (Deng et al. 2022; Pidhorskyi et al.
    2022).

    Args:
        epsilon: ε in squared radiance, > 0. For R well below √ε the loss is the squared error over ε.
    """

    linear, pixelwise = True, True

    epsilon: Positive = 1e-2

    def value(self, image: Array, reference: Array) -> Array:
        difference = image - reference
        return difference * difference / (reference * reference + self.epsilon)

    def derivative(self, image: Array, reference: Array) -> Array:
        return 2.0 * (image - reference) / (reference * reference + self.epsilon)


@register(position=4)
@dataclass(frozen=True)
class Huber(checks.Checked):
    """(I − R)²/2 for |I − R| <= δ, else δ (|I − R| − δ/2). The derivative is I − R clamped to [−δ, δ].

    Args:
        delta: δ in radiance, > 0.
    """

    linear, pixelwise = False, True

    delta: Positive = 0.1

    def value(self, image: Array, reference: Array) -> Array:
        distance = arrays.absolute(image - reference)
        near = arrays.minimum(distance, self.delta)
        return near * (distance - 0.5 * near)

    def derivative(self, image: Array, reference: Array) -> Array:
        return arrays.clip(image - reference, -self.delta, self.delta)


@register(position=6)
@dataclass(frozen=True)
class Censored:
    """ℓ(min(I, R), R) where the reference R is at least `white`, and ℓ(I, R) elsewhere, per element.

    A photograph cannot show more than white. At saturated pixels a darker rendering is wrong and a brighter one is not, so the loss is
    one-sided there (censored regression, Tobin 1958).

    The derivative is not linear in the image. If the true radiance is near white, image noise counts only where it is darker, so such
    pixels become too bright by about the standard deviation of the image. Pixels far above white have no bias, and only a lower bound.
    Excluding saturated pixels by a mask has no bias, but leaves highlights unconstrained.

    Args:
        loss: ℓ, a pixelwise loss.
        white: smallest value of a saturated pixel, linear, > 0. Photographs are scaled to [0, 1]. Values below 1 include pixels that
            resizing has mixed with their neighbours.
    """

    loss: Loss = field(default_factory=L1)
    white: Positive = 0.95
    linear, pixelwise = False, True

    def __post_init__(self):
        checks.fields(self)
        if not getattr(self.loss, "pixelwise", False):
            raise InputError(f"Censored: loss must be pixelwise, such as L1(), got {in_words(self.loss)}")

    def value(self, image: Array, reference: Array) -> Array:
        return self.loss.value(self._censored(image, reference), reference)

    def derivative(self, image: Array, reference: Array) -> Array:
        """Return ∂ℓ/∂I per element; 0 at saturated pixels where the image is brighter than the reference."""
        slope = self.loss.derivative(self._censored(image, reference), reference)
        return arrays.where((reference >= self.white) & (image >= reference), slope * 0.0, slope)

    def _censored(self, image: Array, reference: Array) -> Array:
        return arrays.where(reference >= self.white, arrays.minimum(image, reference), image)


def determined_pixels(loss: Loss, reference: np.ndarray, images: np.ndarray | None = None) -> np.ndarray:
    """Return which pixels (...,) of a reference (..., 3) are values, or lower bounds of `Censored` that images do not reach.

    Images do not reach a bound if their mean is darker by more than the noise of the elements with a darker image. This must hold for all
    bounds of a pixel.

    Args:
        loss: loss of the problem.
        reference: linear values.
        images: K >= 2 independent images (K, ..., 3); None to exclude all bounds.
    """
    white = loss.white if isinstance(loss, Censored) else np.inf
    bounds = reference >= white
    if images is None or len(images) < 2 or not bounds.any():
        return np.asarray(~bounds.any(axis=-1))
    below = np.where(np.isfinite(images), np.minimum(images - white, 0.0), 0.0)
    dark, squares = bounds & (below < 0.0).any(axis=0), below.var(axis=0, ddof=1) / len(below)
    noise = np.sqrt(np.maximum(squares, squares[dark].mean() if dark.any() else 0.0))
    return np.asarray(~(bounds & ~(below.mean(axis=0) < -_CLEARLY * noise)).any(axis=-1))


@runtime_checkable
class Loss(Protocol):
    """Distance of an image to its reference per element. Both arrays have the same shape and contain linear radiance."""

    @property
    def linear(self) -> bool:
        """Return whether `derivative` is linear (affine) in the image, so that image noise does not bias the gradient."""
        ...

    @property
    def pixelwise(self) -> bool:
        """Return whether the loss of an element depends on that element alone, so that it can be evaluated for some pixels.

        A loss of full images (..., H, W, 3) returns an image's loss in each of its elements, so that their mean is the loss, and scales
        its derivative accordingly.
        """
        ...

    def value(self, image: Array, reference: Array) -> Array:
        """Return ℓ(I, R) per element, with the shape of the image; >= 0 for all losses but a user's function."""
        ...

    def derivative(self, image: Array, reference: Array) -> Array:
        """Return ∂ℓ/∂I per element, with the shape of the image."""
        ...
