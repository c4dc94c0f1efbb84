"""What every gradient estimator returns, and what it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from unrender.core.arrays import Array
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.problem.problem import Problem

GRADIENT = "gradient"
VARIANCE = "variance"
HESSIAN = "hessian"
HVP = "hvp"
LOSSES = "losses"


@dataclass(frozen=True)
class Estimate:
    """One step's knowledge of the loss around the current parameters.

    Attributes:
        loss: of this step's samples (biased upward by their noise).
        gradient: {key: array}, the parameters' keys and shapes.
        variance: of `gradient`, per element; None where the estimator provides none.
        hessian: (n, n) over all parameters flattened in key order, or None.
        hvp: the product of the Hessian with a tree, or None.
        losses: the loss at many points at once, (B, n) to (B,) NumPy arrays over all parameters flattened in key order, every point
            with this step's random numbers; or None.
        width: {key: σ}, how far around the parameters the derivatives tell of the loss, where they are smoothed; None where they are local.
            Trust regions are measured in it.
        info: for people: samples traced, control weights, images. Never read back.
        preconditioned: whether `gradient` and `variance` are already those of u, where a parameter with a preconditioner S is
            x = S u: estimators that remember per element must do so in the coordinates of the descent.
    """

    loss: float
    gradient: Tree
    variance: Tree | None = None
    hessian: Array | None = None
    hvp: Callable[[Tree], Tree] | None = None
    losses: Callable[[np.ndarray], np.ndarray] | None = None
    width: Mapping[str, float] | None = None
    info: Mapping[str, Any] = field(default_factory=dict)
    preconditioned: bool = False


class Estimator(Protocol):
    """A way to estimate the loss gradient. Immutable; all that changes is in the state."""

    @property
    def provides(self) -> frozenset[str]:
        """Subset of {"gradient", "variance", "hessian", "hvp", "losses"}."""
        ...

    def init(self, problem: Problem, parameters: Tree) -> Any:
        """The state before the first step: a dataclass of arrays."""
        ...

    def estimate(self, problem: Problem, parameters: Tree, state: Any, key: Key) -> tuple[Estimate, Any]:
        """One estimate at `parameters` and the next state. Pure: equal arguments, equal results."""
        ...
