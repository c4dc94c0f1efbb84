"""Optional quantities of an estimate besides loss and gradient, one type each: estimators provide them, optimizers require them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from unrender.core.arrays import Array
from unrender.core.trees import Tree


@dataclass(frozen=True)
class Capability:
    """One quantity that an estimator computes. Subclasses define its name and hold its value.

    Attributes:
        name: name in messages and in `Estimator.provides`.
    """

    name: ClassVar[str]

    def __init_subclass__(cls, name: str = ""):
        cls.name = name


@dataclass(frozen=True)
class Gradient(Capability, name="gradient"):
    """Marker for `provides` and `requires`: `Estimate.gradient` has an entry for every parameter. The value is a field of `Estimate`."""


@dataclass(frozen=True)
class TreeCapability(Capability):
    """A quantity with one value per element of the gradient.

    Attributes:
        values: {key: array}, with the gradient's keys and shapes.
    """

    values: Tree


@dataclass(frozen=True)
class MatrixCapability(Capability):
    """A quantity with one value per pair of elements.

    Attributes:
        matrix: (n, n) over all parameters flattened in key order, symmetric.
    """

    matrix: Array


@dataclass(frozen=True)
class Variance(TreeCapability, name="variance"):
    """Variance of the gradient, >= 0."""


@dataclass(frozen=True)
class FreshGradient(TreeCapability, name="fresh_gradient"):
    """Gradient from this step's samples alone. Its noise has mean 0, independent of earlier samples.

    Estimators that reuse earlier samples provide it in some of their steps.
    """


@dataclass(frozen=True)
class GradientAtBounds(TreeCapability, name="gradient_at_bounds"):
    """Gradient of this step's samples with respect to x, of an estimate with respect to v. It tells which elements stay at their bounds.

    It has values for the parameters with bounds and a preconditioner, or for some of them.
    """


@dataclass(frozen=True)
class NoiseSample(TreeCapability, name="noise_sample"):
    """One sample of the gradient's noise, of mean 0 and about the gradient's variance."""


@dataclass(frozen=True)
class Hessian(MatrixCapability, name="hessian"):
    """Hessian of the loss."""


@dataclass(frozen=True)
class HessianNoise(MatrixCapability, name="hessian_noise"):
    """Noise that squared derivative images would add to the Gauss-Newton matrix: Σ ℓ'' N Nᵀ over pixels, with the noise N of the images.

    It is positive semidefinite. Damping by it prevents steps along noisy directions.
    """


@dataclass(frozen=True)
class GradientNoise(MatrixCapability, name="gradient_noise"):
    """Covariance of the gradient from this step's samples. Trust-region steps are damped along directions that noise dominates."""


@dataclass(frozen=True)
class ScoreCovariance(MatrixCapability, name="score_covariance"):
    """Covariance of the loss gradient from the references' noise, as the residual shows it (`statistics.scores.covariance`).

    Noise may give it negative eigenvalues.
    """


@dataclass(frozen=True)
class HessianProduct(Capability, name="hvp"):
    """Products of the Hessian of the loss with vectors.

    Attributes:
        apply: function from a tree v with the parameters' keys and shapes to H v.
    """

    apply: Callable[[Tree], Tree]


@dataclass(frozen=True)
class LossFunction(Capability, name="losses"):
    """The loss as a function of the parameters, evaluated with this step's random numbers.

    Attributes:
        evaluate: function from points (B, n), all parameters flattened in key order, to losses (B,); NumPy arrays.
    """

    evaluate: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Smoothing(Capability, name="sigma"):
    """The derivatives are those of the loss smoothed by a Gaussian over the parameters. Trust regions are in units of its σ.

    Attributes:
        sigma: {key: standard deviation in units of the parameter}, > 0: a number, or one for each element.
    """

    sigma: Mapping[str, float | np.ndarray]


_TURNING = 64
"""Number of first steps in which no element is held at a bound: the mean of some ten gradients lags behind those of a texture beside a lamp
of unknown brightness."""


@dataclass(frozen=True)
class AtBounds(Capability, name="at_bounds"):
    """Elements at a bound, which the loop adds for the optimizer.

    Attributes:
        sides: function that returns {key: array}, with the parameters' keys, shapes and types: -1 at the lower bound, 1 at the upper one,
            0 elsewhere, and for parameters with a preconditioner, whose steps have other coordinates.
    """

    sides: Callable[[], Tree]

    def held(self, mean: Tree, made: int) -> Tree:
        """Return {key: mask of the elements at a bound beyond which the loss falls}, from the mean of earlier gradients.

        Smoothing would spread the gradient of these elements, which cannot move, over their neighbours. The present gradient does not
        decide, because its noise would then no longer have mean 0. In the first 64 steps gradients may turn faster than their mean.

        Args:
            mean: {key: mean of earlier gradients}.
            made: number of steps before this one.
        """
        sides = {} if made < _TURNING else self.sides()
        return {key: sides[key] * x < 0.0 for key, x in mean.items() if key in sides}


@dataclass(frozen=True)
class DerivativeImages(Capability, name="derivative_images"):
    """Derivative images of every element, by view. They are total derivatives where other parameters are eliminated.

    Attributes:
        views: {view: (elements, images, weights)}: the indices of the elements that the view shows, (m,), the derivatives of its image by
            them, (m, H, W, 3), and the second derivative of the loss by each value of the image times the weight of its noise, (H, W, 3).
    """

    views: Mapping[int, tuple[np.ndarray, np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class BlockEstimate(Capability, name="block"):
    """Estimate for a subset of the parameters, with their own curvature.

    The other parameters are fixed at their current values, except those that the estimator eliminates, which are linear functions of the
    subset.

    Attributes:
        keys: keys of the subset, in key order.
        estimate: an `Estimate` whose gradient has these keys; None in a step in which they do not change.
    """

    keys: tuple[str, ...]
    estimate: Any


class Capabilities(frozenset[str]):
    """A set of capability types, for `Estimator.provides` and `Optimizer.requires`. Reads as the set of their names.

    `Capabilities(Gradient, Variance)` equals `{"gradient", "variance"}`.
    """

    types: frozenset[type[Capability]]

    def __new__(cls, *types: type[Capability]) -> Capabilities:
        capabilities = super().__new__(cls, (kind.name for kind in types))
        capabilities.types = frozenset(types)
        return capabilities
