"""What an estimate can carry beside loss and gradient, one type each: estimators provide these types, optimizers require them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from unrender.core.arrays import Array
from unrender.core.trees import Tree


@dataclass(frozen=True)
class Capability:
    """One quantity that an estimator computes. Subclasses name it and hold its value.

    Attributes:
        name: what messages and `Estimator.provides` call it.
    """

    name: ClassVar[str]


@dataclass(frozen=True)
class Gradient(Capability):
    """`Estimate.gradient` has an entry for every parameter. For `provides` and `requires` only: the value is a field of `Estimate`."""

    name: ClassVar[str] = "gradient"


@dataclass(frozen=True)
class Variance(Capability):
    """The variance of the gradient.

    Attributes:
        values: {key: array}, of the gradient's keys and shapes, >= 0.
    """

    name: ClassVar[str] = "variance"
    values: Tree


@dataclass(frozen=True)
class PastWeight(Capability):
    """The weight of earlier estimates in the gradient: its noise is correlated with the last step's by this factor.

    Attributes:
        values: {key: array}, of the gradient's keys and shapes, in [0, 1).
    """

    name: ClassVar[str] = "past_weight"
    values: Tree


@dataclass(frozen=True)
class FreshGradient(Capability):
    """The gradient as this step's samples alone show it: whatever the earlier ones were, its noise is 0 on average.

    Estimators that remember samples give it now and then.

    Attributes:
        values: {key: array}, of the gradient's keys and shapes.
    """

    name: ClassVar[str] = "fresh_gradient"
    values: Tree


@dataclass(frozen=True)
class Hessian(Capability):
    """The Hessian of the loss.

    Attributes:
        matrix: (n, n) over all parameters flattened in key order.
    """

    name: ClassVar[str] = "hessian"
    matrix: Array


@dataclass(frozen=True)
class HessianNoise(Capability):
    """What the noise of derivative images would add to the Gauss-Newton matrix, if it were made of their squares.

    Attributes:
        matrix: (n, n), positive semidefinite: Σ ℓ'' N Nᵀ over pixels, with the noise N of the derivative images. Damping by it keeps
            steps from following noise.
    """

    name: ClassVar[str] = "hessian_noise"
    matrix: Array


@dataclass(frozen=True)
class HessianProduct(Capability):
    """Products of the Hessian of the loss with vectors.

    Attributes:
        apply: from a tree v of the parameters' keys and shapes to H v.
    """

    name: ClassVar[str] = "hvp"
    apply: Callable[[Tree], Tree]


@dataclass(frozen=True)
class LossFunction(Capability):
    """The loss at any points, all evaluated with this step's random numbers.

    Attributes:
        evaluate: from points (B, n), all parameters flattened in key order, to losses (B,); NumPy arrays.
    """

    name: ClassVar[str] = "losses"
    evaluate: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Smoothing(Capability):
    """The derivatives are those of the loss smoothed by a Gaussian over the parameters. Trust regions are in units of its σ.

    Attributes:
        sigma: {key: standard deviation in units of the parameter}, > 0: a number, or one for each element.
    """

    name: ClassVar[str] = "sigma"
    sigma: Mapping[str, float | np.ndarray]


@dataclass(frozen=True)
class BlockEstimate(Capability):
    """The estimate of some of the parameters alone, with their own curvature, the others held at their present values.

    Attributes:
        keys: of these parameters, in key order.
        estimate: an `Estimate` whose gradient has these keys; None in a step in which they stay where they are.
    """

    name: ClassVar[str] = "block"
    keys: tuple[str, ...]
    estimate: Any


class Capabilities(frozenset[str]):
    """A set of capability types, for `Estimator.provides` and `Optimizer.requires`. Reads as the set of their names.

    `Capabilities(Gradient, Variance)` equals `{"gradient", "variance"}`.
    """

    types: frozenset[type[Capability]]

    def __new__(cls, *types: type[Capability]) -> Capabilities:
        made = super().__new__(cls, (kind.name for kind in types))
        made.types = frozenset(types)
        return made
