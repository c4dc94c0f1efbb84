"""Protocol of losses."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from unrender.core.arrays import Array


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
