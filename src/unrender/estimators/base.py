"""What every gradient estimator returns, and what it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeVar

import numpy as np

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.estimators.capabilities import (
    Capability,
    FreshGradient,
    Hessian,
    HessianNoise,
    HessianProduct,
    LossFunction,
    PastWeight,
    Smoothing,
    Variance,
)
from unrender.scene.problem import Problem

C = TypeVar("C", bound=Capability)


@dataclass(frozen=True)
class Estimate:
    """The loss and its derivatives at the current parameters, as estimated in one step.

    Attributes:
        loss: of this step's samples (biased upward by their noise).
        gradient: {key: array}, the parameters' keys and shapes; {} from estimators that compute none.
        capabilities: what else was computed, at most one of each type; library code reads it by `get` and `require`, which return
            typed values.
        info: for people: samples traced, control weights, images. Never read back.
        preconditioned: whether `gradient` and its variance are already by v, where a parameter is x = φ(S v) with its parameterisation φ
            and its preconditioner S: estimators with a per-element state keep it in the coordinates of the descent.
    """

    loss: float
    gradient: Tree
    capabilities: tuple[Capability, ...] = ()
    info: Mapping[str, Any] = field(default_factory=dict)
    preconditioned: bool = False

    def get(self, kind: type[C]) -> C | None:
        """The capability of this type; None where it was not computed."""
        return next((found for found in self.capabilities if isinstance(found, kind)), None)

    def require(self, owner: str, kind: type[C]) -> C:
        """The capability of this type. Raises `InputError` that names `owner` where it was not computed."""
        if (found := self.get(kind)) is None:
            raise InputError(f'{owner} requires "{kind.name}", which this estimate does not have')
        return found

    @property
    def variance(self) -> Tree | None:
        """Variance of `gradient` per element, {key: array}; None where it was not computed."""
        found = self.get(Variance)
        return None if found is None else found.values

    @property
    def hessian(self) -> Array | None:
        """(n, n) over all parameters flattened in key order; None where it was not computed."""
        found = self.get(Hessian)
        return None if found is None else found.matrix

    @property
    def hvp(self) -> Callable[[Tree], Tree] | None:
        """The product of the Hessian with a tree; None where there is none."""
        found = self.get(HessianProduct)
        return None if found is None else found.apply

    @property
    def losses(self) -> Callable[[np.ndarray], np.ndarray] | None:
        """The loss at points (B, n), as (B,), all with this step's random numbers; None where there is no such function."""
        found = self.get(LossFunction)
        return None if found is None else found.evaluate

    @property
    def sigma(self) -> Mapping[str, float | np.ndarray] | None:
        """{key: σ} of the Gaussian that the derivatives are smoothed by; None where they are not smoothed."""
        found = self.get(Smoothing)
        return None if found is None else found.sigma


def as_numpy(estimate: Estimate) -> Estimate:
    """The same estimate, its gradient, variance and Hessian as NumPy arrays."""

    def convert(capability: Capability) -> Capability:
        match capability:
            case Variance(values):
                return Variance(trees.numpy(values))
            case PastWeight(values):
                return PastWeight(trees.numpy(values))
            case FreshGradient(values):
                return FreshGradient(trees.numpy(values))
            case Hessian(matrix):
                return Hessian(arrays.numpy(matrix))
            case HessianNoise(matrix):
                return HessianNoise(arrays.numpy(matrix))
        return capability

    converted = tuple(convert(capability) for capability in estimate.capabilities)
    return replace(estimate, gradient=trees.numpy(estimate.gradient), capabilities=converted)


class Estimator(Protocol):
    """A way to estimate the loss gradient. Immutable; all that changes is in the state."""

    @property
    def provides(self) -> AbstractSet[str]:
        """What its estimates have: `Capabilities` of types, e.g. `Capabilities(Gradient, Variance)`; reads as a set of names."""
        ...

    def init(self, problem: Problem, parameters: Tree) -> Any:
        """The state before the first step: a dataclass of arrays."""
        ...

    def estimate(self, problem: Problem, parameters: Tree, state: Any, key: Key) -> tuple[Estimate, Any]:
        """One estimate at `parameters` and the next state. Pure: equal arguments, equal results."""
        ...
