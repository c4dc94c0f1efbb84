"""Pixelwise losses."""

from __future__ import annotations

from dataclasses import dataclass

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.registry import register


class _Pixelwise:
    """Base of the losses in this module."""

    @property
    def pixelwise(self) -> bool:
        """True."""
        return True


class _WithLinearDerivative(_Pixelwise):
    @property
    def linear(self) -> bool:
        """True."""
        return True


class _WithNonlinearDerivative(_Pixelwise):
    @property
    def linear(self) -> bool:
        """False."""
        return False


@register(position=1)
@dataclass(frozen=True)
class L1(_WithNonlinearDerivative):
    """|I − R|. The derivative is the sign, 0 for equal values. Noise biases it more the closer I is to R."""

    def value(self, image: Array, reference: Array) -> Array:
        return arrays.absolute(image - reference)

    def derivative(self, image: Array, reference: Array) -> Array:
        return arrays.sign(image - reference)


@register(position=2)
@dataclass(frozen=True)
class L2(_WithLinearDerivative):
    """(I − R)²."""

    def value(self, image: Array, reference: Array) -> Array:
        difference = image - reference
        return difference * difference

    def derivative(self, image: Array, reference: Array) -> Array:
        return 2.0 * (image - reference)


@register(position=3)
@dataclass(frozen=True)
class RelativeL2(_WithLinearDerivative):
    """(I − R)² / (R² + ε), which weights dark and bright pixels alike.

    The denominator contains the reference only, not the noisy image, so the derivative is linear. The estimators sample the image and the
    adjoint independently. The gradient is then that of the unbiased mean relative squared error (Deng et al. 2022; Pidhorskyi et al.
    2022).

    Args:
        epsilon: ε in squared radiance, > 0. For R below √ε the loss is nearly absolute.
    """

    epsilon: float = 1e-2

    def __post_init__(self):
        checks.number("RelativeL2", "epsilon", self.epsilon, above=0.0)

    def value(self, image: Array, reference: Array) -> Array:
        difference = image - reference
        return difference * difference / (reference * reference + self.epsilon)

    def derivative(self, image: Array, reference: Array) -> Array:
        return 2.0 * (image - reference) / (reference * reference + self.epsilon)


@register(position=4)
@dataclass(frozen=True)
class Huber(_WithNonlinearDerivative):
    """(I − R)²/2 for |I − R| <= δ, else δ (|I − R| − δ/2). The derivative is I − R clamped to [−δ, δ].

    Args:
        delta: δ in radiance, > 0.
    """

    delta: float = 0.1

    def __post_init__(self):
        checks.number("Huber", "delta", self.delta, above=0.0)

    def value(self, image: Array, reference: Array) -> Array:
        distance = arrays.absolute(image - reference)
        near = arrays.minimum(distance, self.delta)
        return near * (distance - 0.5 * near)

    def derivative(self, image: Array, reference: Array) -> Array:
        return arrays.clip(image - reference, -self.delta, self.delta)
