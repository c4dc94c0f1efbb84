"""Saturated pixels of photographs: known to be at least as bright as white."""

from __future__ import annotations

from dataclasses import dataclass, field

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.losses.base import Loss
from unrender.losses.pixelwise import L1


@register(position=6)
@dataclass(frozen=True)
class Censored:
    """ℓ(min(I, R), R) where the reference R is at least `white`, ℓ(I, R) elsewhere, per element.

    A photograph cannot show more than its white: there a rendering that is darker is wrong, one that is brighter is not. The loss is
    then of one side (censored regression, Tobin 1958).

    The derivative is not linear in the image, whatever ℓ is. Where the true radiance is near white, noise of the image counts when it is
    darker alone, so such pixels come out too bright, by about the image's standard deviation; pixels far above white have no bias, and
    no information beyond it. Leaving saturated pixels out, by a mask, has no bias, and lets highlights be as dark as they like.

    Args:
        loss: ℓ, per pixel and channel.
        white: the least value of a saturated pixel, linear, > 0. Photographs are scaled to [0, 1]; values below 1 allow for pixels that
            resizing mixed with their neighbours.
    """

    loss: Loss = field(default_factory=L1)
    white: float = 0.95

    def __post_init__(self):
        checks.number("Censored", "white", self.white, above=0.0)
        if isinstance(self.loss, type) or not getattr(self.loss, "pixelwise", False):
            raise InputError(f"Censored: loss must be one per pixel, such as L1(), got {self.loss!r:.80}")

    @property
    def linear(self) -> bool:
        """False."""
        return False

    @property
    def pixelwise(self) -> bool:
        """True."""
        return True

    def value(self, image: Array, reference: Array) -> Array:
        return self.loss.value(self._censored(image, reference), reference)

    def derivative(self, image: Array, reference: Array) -> Array:
        """See `Loss.derivative`; 0 where the image is brighter than white."""
        slope = self.loss.derivative(self._censored(image, reference), reference)
        return arrays.where((reference >= self.white) & (image >= reference), slope * 0.0, slope)

    def _censored(self, image: Array, reference: Array) -> Array:
        return arrays.where(reference >= self.white, arrays.minimum(image, reference), image)
