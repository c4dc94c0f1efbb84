"""Newton's method by conjugate gradients: the Newton step from Hessian-vector products alone (Wang et al., Eqs 4 to 7)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from unrender import checks, flat
from unrender.gradients.estimate import GRADIENT, HVP, Estimate
from unrender.optimizers import rates
from unrender.optimizers.newton import NewtonState
from unrender.optimizers.schedules import Schedule
from unrender.trees import Tree


@dataclass(frozen=True)
class NewtonCG:
    """A step that solves H s = −g by conjugate gradients (Fletcher and Reeves), truncated at a trust radius.

    From s = 0 and v = r = −g: α = rᵀr / vᵀHv (Eq. 5, with v conjugate to those before), s += α v, r −= α H v, and the next v is
    r + (r'ᵀr' / rᵀr) v. Ends after `iterations`, when the residual is a tenth of the gradient, when s reaches the trust radius,
    or when vᵀHv <= 0: there the objective bends downwards along v, no minimum is in sight, and the step goes to the trust radius.
    Never builds an n × n matrix.

    Args:
        learning_rate: the share of the step that is taken, > 0; for the parameters without their own.
        trust_radius: Δ, the longest step, Euclidean, in units of the parameters, > 0.
        iterations: Hessian-vector products a step at most, >= 1.
        schedule: factor of every learning rate by step; see `unrender.optimizers.schedules`.
    """

    learning_rate: float = 1.0
    trust_radius: float = 0.5
    iterations: int = 4
    schedule: Schedule | None = None

    def __post_init__(self):
        rates.check("NewtonCG", self.learning_rate, self.schedule)
        checks.number("NewtonCG", "trust_radius", self.trust_radius, above=0.0)
        checks.whole("NewtonCG", "iterations", self.iterations, at_least=1)

    @property
    def requires(self) -> frozenset[str]:
        """A gradient and Hessian-vector products."""
        return frozenset({GRADIENT, HVP})

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> NewtonState:
        """See `Optimizer.init`."""
        return NewtonState(0, rates.per_parameter("NewtonCG", parameters, self.learning_rate, learning_rates))

    def update(self, estimate: Estimate, state: NewtonState, parameters: Tree) -> tuple[Tree, NewtonState]:
        """See `Optimizer.update`. On the host."""
        direction = self._solve(estimate, parameters)
        factor = rates.factor("NewtonCG", self.schedule, state.step)
        scale = flat.spread({key: rate * factor for key, rate in state.learning_rates.items()}, parameters)
        return flat.unravel(direction * scale, parameters), NewtonState(state.step + 1, state.learning_rates)

    def _solve(self, estimate: Estimate, parameters: Tree) -> np.ndarray:
        assert estimate.hvp is not None
        residual = -flat.ravel(estimate.gradient)
        v, step = residual, np.zeros_like(residual)
        first = square = float(residual @ residual)
        for _ in range(self.iterations):
            if square <= 0.01 * first or square == 0.0:
                break
            product = flat.ravel(estimate.hvp(flat.unravel(v, parameters)))
            bend = float(v @ product)
            alpha = square / bend if bend > 0 else np.inf
            reach = self._to_the_radius(step, v)
            step = step + min(alpha, reach) * v
            if alpha >= reach:
                break
            residual = residual - alpha * product
            before, square = square, float(residual @ residual)
            v = residual + square / before * v
        return step

    def _to_the_radius(self, step: np.ndarray, v: np.ndarray) -> float:
        """The τ >= 0 at which step + τ v is on the sphere of the trust radius."""
        a, b = float(v @ v), float(step @ v)
        c = float(step @ step) - self.trust_radius**2
        return (-b + np.sqrt(max(b * b - a * c, 0.0))) / a
