"""Losses, all but one per pixel and channel: value and derivative, and whether the derivative is linear in the image.

Why linearity matters: an image estimate I with E[I] = F gives E[∂ℓ(I)] = ∂ℓ(F) only where ∂ℓ is linear. Otherwise the
gradient is biased by the image's noise, however many steps are averaged (Nicolet et al. 2023, section 4).

The loss of a problem is the sum over views of weight · mean over pixels and channels of mask · value. A loss of whole
images sees the reference where the mask is 0: mean of ℓ(R + mask · (I − R), R).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from unrender import arrays, checks
from unrender.arrays import Array
from unrender.perceptual import Perceptual as Perceptual


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


@dataclass(frozen=True)
class L1:
    """|I − R|. The derivative is the sign (0 where equal): noise biases it, the more the closer I is to R."""

    @property
    def linear(self) -> bool:
        """False."""
        return False

    @property
    def pixelwise(self) -> bool:
        """True."""
        return True

    def value(self, image: Array, reference: Array) -> Array:
        """See `Loss.value`."""
        return arrays.absolute(image - reference)

    def derivative(self, image: Array, reference: Array) -> Array:
        """See `Loss.derivative`."""
        return arrays.sign(image - reference)


@dataclass(frozen=True)
class L2:
    """(I − R)²."""

    @property
    def linear(self) -> bool:
        """True."""
        return True

    @property
    def pixelwise(self) -> bool:
        """True."""
        return True

    def value(self, image: Array, reference: Array) -> Array:
        """See `Loss.value`."""
        difference = image - reference
        return difference * difference

    def derivative(self, image: Array, reference: Array) -> Array:
        """See `Loss.derivative`."""
        return 2.0 * (image - reference)


@dataclass(frozen=True)
class RelativeL2:
    """(I − R)² / (R² + ε): dark pixels count as much as bright ones.

    The denominator holds the reference alone, never the noisy image, so the derivative stays linear. With image and adjoint from
    independent samples, as all estimators here have them, its gradient is that of the unbiased mean relative squared error
    (Deng et al. 2022; Pidhorskyi et al. 2022).

    Args:
        epsilon: ε in squared radiance, > 0; below √ε the loss turns absolute.
    """

    epsilon: float = 1e-2

    def __post_init__(self):
        checks.number("RelativeL2", "epsilon", self.epsilon, above=0.0)

    @property
    def linear(self) -> bool:
        """True."""
        return True

    @property
    def pixelwise(self) -> bool:
        """True."""
        return True

    def value(self, image: Array, reference: Array) -> Array:
        """See `Loss.value`."""
        difference = image - reference
        return difference * difference / (reference * reference + self.epsilon)

    def derivative(self, image: Array, reference: Array) -> Array:
        """See `Loss.derivative`."""
        return 2.0 * (image - reference) / (reference * reference + self.epsilon)


@dataclass(frozen=True)
class Huber:
    """(I − R)²/2 within δ of the reference, δ (|I − R| − δ/2) beyond: the derivative is I − R clamped to [−δ, δ].

    Args:
        delta: δ in radiance, > 0.
    """

    delta: float = 0.1

    def __post_init__(self):
        checks.number("Huber", "delta", self.delta, above=0.0)

    @property
    def linear(self) -> bool:
        """False."""
        return False

    @property
    def pixelwise(self) -> bool:
        """True."""
        return True

    def value(self, image: Array, reference: Array) -> Array:
        """See `Loss.value`."""
        distance = arrays.absolute(image - reference)
        near = arrays.minimum(distance, self.delta)
        return near * (distance - 0.5 * near)

    def derivative(self, image: Array, reference: Array) -> Array:
        """See `Loss.derivative`."""
        return arrays.clip(image - reference, -self.delta, self.delta)
