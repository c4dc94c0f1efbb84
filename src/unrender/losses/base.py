"""What a loss is."""

from __future__ import annotations

from typing import Protocol

from unrender.core.arrays import Array


class Loss(Protocol):
    """How far an image is from its reference, element by element. Arrays of any equal shape, linear radiance."""

    @property
    def linear(self) -> bool:
        """Whether `derivative` is linear (affine) in the image, so that image noise does not bias the gradient."""
        ...

    @property
    def pixelwise(self) -> bool:
        """Whether an element's loss depends on that element alone, so that some pixels may be had without the others.

        A loss of whole images (..., H, W, 3) spreads its value evenly over each, so that the mean is the loss, and scales its derivative
        alike.
        """
        ...

    def value(self, image: Array, reference: Array) -> Array:
        """ℓ(I, R) >= 0, per element."""
        ...

    def derivative(self, image: Array, reference: Array) -> Array:
        """∂ℓ/∂I, per element."""
        ...
