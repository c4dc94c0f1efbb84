"""Interface of gradient estimators, and the estimates that they return."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.estimators.capabilities import (
    Capability,
    FreshGradient,
    GradientNoise,
    Hessian,
    HessianNoise,
    HessianProduct,
    LossFunction,
    ScoreCovariance,
    Smoothing,
    Variance,
)
from unrender.scene.problem import Problem

C = TypeVar("C", bound=Capability)


@dataclass(frozen=True)
class Estimate:
    """The loss and its derivatives at the current parameters, as estimated in one step.

    Attributes:
        loss: loss of this step's samples (biased upward by their noise).
        gradient: {key: array}, the parameters' keys and shapes; {} from estimators that compute none.
        capabilities: additional quantities, at most one of each type; library code reads them by `get` and `require`, which return
            typed values.
        info: information for people: samples traced, control weights, images. Library code never reads it.
        preconditioned: whether `gradient` and its variance are with respect to v, where a parameter is x = φ(S v) with its
            parameterisation φ and its preconditioner S. Estimators with a per-element state store it in these coordinates.
    """

    loss: float
    gradient: Tree
    capabilities: tuple[Capability, ...] = ()
    info: Mapping[str, Any] = field(default_factory=dict)
    preconditioned: bool = False

    def get(self, kind: type[C]) -> C | None:
        """Return the capability of this type; None if it was not computed."""
        return next((capability for capability in self.capabilities if isinstance(capability, kind)), None)

    def require(self, owner: str, kind: type[C]) -> C:
        """Return the capability of this type. Raise `InputError` that names `owner` if it was not computed."""
        if (capability := self.get(kind)) is None:
            raise InputError(f'{owner} requires "{kind.name}", which this estimate does not have')
        return capability

    @property
    def variance(self) -> Tree | None:
        """Variance of `gradient` per element, {key: array}; None if it was not computed."""
        capability = self.get(Variance)
        return None if capability is None else capability.values

    @property
    def hessian(self) -> Array | None:
        """Hessian (n, n) over all parameters flattened in key order; None if it was not computed."""
        capability = self.get(Hessian)
        return None if capability is None else capability.matrix

    @property
    def hvp(self) -> Callable[[Tree], Tree] | None:
        """Product of the Hessian with a tree; None if it is not available."""
        capability = self.get(HessianProduct)
        return None if capability is None else capability.apply

    @property
    def losses(self) -> Callable[[np.ndarray], np.ndarray] | None:
        """Function from points (B, n) to their losses (B,), all with this step's random numbers; None if it is not available."""
        capability = self.get(LossFunction)
        return None if capability is None else capability.evaluate

    @property
    def sigma(self) -> Mapping[str, float | np.ndarray] | None:
        """{key: σ} of the Gaussian that smooths the derivatives; None if they are not smoothed."""
        capability = self.get(Smoothing)
        return None if capability is None else capability.sigma


def as_numpy(estimate: Estimate) -> Estimate:
    """Return the estimate with its gradient, variance and Hessian as NumPy arrays."""

    def convert(capability: Capability) -> Capability:
        match capability:
            case Variance(values):
                return Variance(trees.numpy(values))
            case FreshGradient(values):
                return FreshGradient(trees.numpy(values))
            case Hessian(matrix):
                return Hessian(arrays.numpy(matrix))
            case GradientNoise(matrix) | HessianNoise(matrix) | ScoreCovariance(matrix):
                return replace(capability, matrix=arrays.numpy(matrix))
        return capability

    converted = tuple(convert(capability) for capability in estimate.capabilities)
    return replace(estimate, gradient=trees.numpy(estimate.gradient), capabilities=converted)


class Estimator(Protocol):
    """An estimator of the loss gradient. It is immutable; everything that changes is in the state."""

    @property
    def provides(self) -> AbstractSet[str]:
        """Types that its estimates provide: `Capabilities` such as `Capabilities(Gradient, Variance)`, which reads as a set of names."""
        ...

    def init(self, problem: Problem, parameters: Tree) -> Any:
        """Return the state before the first step: a dataclass of arrays."""
        ...

    def estimate(self, problem: Problem, parameters: Tree, state: Any, key: Key) -> tuple[Estimate, Any]:
        """Return an estimate at `parameters` and the next state. Pure: equal arguments give equal results."""
        ...


@runtime_checkable
class WeighsPixels(Protocol):
    """An estimator whose steps weight pixels by the noise of earlier images."""

    def pixel_weights(self, state: Any) -> tuple[np.ndarray, ...]:
        """Return the weights of each view's pixels in the next step, (H, W, 1) or (H, W, 3), in (0, 1]; () if equal."""
        ...


def pixel_weights(estimator: Estimator, state: Any) -> tuple[np.ndarray, ...]:
    """Return the `WeighsPixels.pixel_weights` of an estimator; () for one without weights."""
    return estimator.pixel_weights(state) if isinstance(estimator, WeighsPixels) else ()
