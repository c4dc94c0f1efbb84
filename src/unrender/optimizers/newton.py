"""Newton's method with a modified Hessian, for estimators that give one (Wang et al., section 2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from unrender import arrays, checks, flat
from unrender.gradients.estimate import GRADIENT, HESSIAN, Estimate
from unrender.optimizers import rates
from unrender.optimizers.schedules import Schedule
from unrender.trees import Tree


@dataclass(frozen=True)
class NewtonState:
    """State between steps.

    Attributes:
        step: steps made so far.
        learning_rates: of each parameter, before the schedule.
    """

    step: int
    learning_rates: dict[str, float]


@dataclass(frozen=True)
class Newton:
    """Steps −η H̃⁻¹ g (Eq. 3), no longer than a trust radius.

    H̃ has the eigenvectors of H and its eigenvalues' magnitudes, none below a share `damping` of the largest: where the objective bends
    downwards, plain Newton steps would climb to a saddle or a maximum. Costs O(n³) time and O(n²) memory for n parameters in all.

    Args:
        learning_rate: η, the share of the Newton step that is taken, > 0; for the parameters without their own.
        trust_radius: the longest step, Euclidean, in units of the parameters, > 0; None for no limit.
        damping: the least eigenvalue's share of the largest, in (0, 1).
        schedule: factor of every learning rate by step; see `unrender.optimizers.schedules`.
    """

    learning_rate: float = 1.0
    trust_radius: float | None = 0.5
    damping: float = 1e-3
    schedule: Schedule | None = None

    def __post_init__(self):
        rates.check("Newton", self.learning_rate, self.schedule)
        checks.number("Newton", "damping", self.damping, above=0.0, below=1.0)
        if self.trust_radius is not None:
            checks.number("Newton", "trust_radius", self.trust_radius, above=0.0)

    @property
    def requires(self) -> frozenset[str]:
        """A gradient and its Hessian."""
        return frozenset({GRADIENT, HESSIAN})

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> NewtonState:
        """See `Optimizer.init`."""
        return NewtonState(0, rates.per_parameter("Newton", parameters, self.learning_rate, learning_rates))

    def update(self, estimate: Estimate, state: NewtonState, parameters: Tree) -> tuple[Tree, NewtonState]:
        """See `Optimizer.update`. On the host."""
        assert estimate.hessian is not None
        gradient = flat.ravel(estimate.gradient)
        values, vectors = np.linalg.eigh(arrays.numpy(estimate.hessian).astype(np.float64))
        bend = np.abs(values)
        bend = np.maximum(bend, max(self.damping * bend.max(), np.finfo(float).tiny))
        direction = -vectors @ ((vectors.T @ gradient) / bend)
        factor = rates.factor("Newton", self.schedule, state.step)
        scale = flat.spread({key: rate * factor for key, rate in state.learning_rates.items()}, parameters)
        step = flat.within(direction * scale, self.trust_radius)
        return flat.unravel(step, parameters), NewtonState(state.step + 1, state.learning_rates)
