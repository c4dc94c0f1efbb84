"""Newton's method by conjugate gradients, from Hessian-vector products only (Wang et al., Eqs 4 to 7)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from unrender.core import checks, conjugate_gradients, trees
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient, HessianProduct, LossFunction
from unrender.optimizers.adam import Adam
from unrender.optimizers.directions import NewtonState, apply_direction, check_options, coordinate_scales, init_state
from unrender.schedules.functions import Schedule


@register
@dataclass(frozen=True)
class NewtonCG:
    """Approximate solution of H s = −g by conjugate gradients (Fletcher and Reeves), truncated at a trust radius.

    Starts from s = 0 and v = r = −g (Eq. 6). Each iteration computes α = rᵀr / vᵀHv, which equals Eq. 5 for v conjugate to earlier ones,
    s += α v (Eq. 7), r' = r − α H v, and v = r' + (r'ᵀr' / rᵀr) v. It stops after `iterations`, when ‖r‖ is below `tolerance` ‖g‖, or
    when s reaches the trust radius Δ. If the curvature along −g is negative, the step follows −g to the radius (Steihaug 1983). Memory is
    a few vectors; no n × n matrix is built. As many iterations as dimensions solve a well-conditioned positive definite system exactly,
    without tolerance and damping.

    Scales: as in `Newton`, everything, including Δ, is in coordinates u = x / η with each parameter's learning rate η, times its σ.
    Products are requested for η v.

    Noise: the estimated products need not belong to one symmetric matrix. So the iteration stops before it follows noise: at a v whose
    curvature vᵀHv / vᵀv is negative or below `damping` times the largest so far (the step along it then uses the magnitude of the
    curvature, but at least that bound); when ‖r‖ exceeds ‖g‖; when v is not a descent direction (vᵀg >= 0); and at a product that is not
    finite. Thus s is always a descent direction of the given gradient, and few iterations are as good as many. The step is biased even if
    gradient and products are not, because it is nonlinear in them.

    Args:
        learning_rate: η, in units of the parameter, > 0, for the parameters without their own. With 1 the trust region is in units of σ,
            or of the parameters; with learning rates that suit Adam, radii of 10 to 100 are usual.
        trust_radius: Δ, largest Euclidean length of a step over all elements of u, > 0.
        iterations: maximum number of Hessian-vector products per step, >= 1.
        tolerance: ratio ‖r‖ / ‖g‖ at which the iteration stops, in [0, 1).
        damping: smallest accepted curvature relative to the largest, in [0, 1).
        step_scale: γ, factor of the step, in (0, 1]; no effect with `inner_optimizer`.
        inner_optimizer: an Adam whose gradient is the negated step, as in the paper ("All methods use the Adam optimizer"); its own
            learning rate, or the parameter's, determines the length. None takes the step itself.
        schedule: final factor of the step, by step; see `unrender.schedules.functions`. Near the optimum the step is as noisy as the
            gradient. Decreasing steps average this noise, as Adam's mean does.
        line: whether to use only the step's direction, and to determine its length from a parabola through three losses, at the
            parameters and one step to either side. This takes two evaluations, and the estimator must provide losses. It suits many
            parameters, where the gradient is mostly noise and its curvature, from the same samples, is not that of the loss. These losses
            are not smoothed.
    """

    learning_rate: float = 1.0
    trust_radius: float = 0.5
    iterations: int = 4
    tolerance: float = 0.1
    damping: float = 0.1
    step_scale: float = 1.0
    inner_optimizer: Adam | None = None
    schedule: Schedule | None = None
    line: bool = False

    def __post_init__(self):
        checks.flags(self)
        check_options("NewtonCG", self)
        checks.number("NewtonCG", "trust_radius", self.trust_radius, above=0.0)
        checks.integer("NewtonCG", "iterations", self.iterations, at_least=1)
        checks.number("NewtonCG", "tolerance", self.tolerance, above=0.0, below=1.0, inclusive=True)
        checks.number("NewtonCG", "damping", self.damping, above=0.0, below=1.0, inclusive=True)

    @property
    def requires(self) -> Capabilities:
        """A gradient and Hessian-vector products; with `line`, also the loss at points chosen by the optimizer."""
        return Capabilities(Gradient, HessianProduct, *([LossFunction] if self.line else []))

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> NewtonState:
        return init_state("NewtonCG", self, parameters, learning_rates)

    def update(self, estimate: Estimate, state: NewtonState, parameters: Tree) -> tuple[Tree, NewtonState]:
        """Return the steps and the next state. On the host, between products."""
        hvp = estimate.require("NewtonCG", HessianProduct).apply
        scale = coordinate_scales(estimate, state, parameters)

        def product(v: np.ndarray) -> np.ndarray:
            return scale * trees.ravel(hvp(trees.unravel(scale * v, parameters)))

        gradient = scale * trees.ravel(estimate.gradient)
        step = conjugate_gradients.solve(
            gradient, product, self.trust_radius, self.iterations, self.tolerance, self.damping
        )
        if self.line and step.any():
            step = self._line_search(step, self._losses(estimate, scale * step, parameters))
        return apply_direction("NewtonCG", self, scale * step, state, parameters)

    @staticmethod
    def _losses(estimate: Estimate, step: np.ndarray, parameters: Tree) -> np.ndarray:
        """Return the losses one step behind the parameters, at the parameters, and one step ahead, (3,)."""
        theta = trees.ravel(parameters)
        return estimate.require("NewtonCG", LossFunction).evaluate(np.stack([theta - step, theta, theta + step]))

    def _line_search(self, step: np.ndarray, losses: np.ndarray) -> np.ndarray:
        """Return the multiple >= 0 of `step` in the trust radius that minimises the parabola through the three losses."""
        behind, center, ahead = losses
        slope, curvature = 0.5 * (ahead - behind), ahead + behind - 2 * center
        longest = self.trust_radius / float(np.linalg.norm(step))
        if slope >= 0.0 or not np.isfinite(losses).all():
            return np.zeros_like(step)
        return (longest if curvature * longest <= -slope else -slope / curvature) * step
