"""Newton's method by conjugate gradients: the Newton step from Hessian-vector products alone (Wang et al., Eqs 4 to 7)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from unrender.core import checks, conjugate_gradients, vectors
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient, HessianProduct, LossFunction
from unrender.optimizers.adam import Adam
from unrender.optimizers.directions import (
    NewtonState,
    apply_direction,
    check_options,
    coordinate_scales,
    init_state,
)
from unrender.schedules.functions import Schedule


@register
@dataclass(frozen=True)
class NewtonCG:
    """A step that solves H s = −g by conjugate gradients (Fletcher and Reeves), truncated at a trust radius.

    From s = 0 and v = r = −g (Eq. 6): α = rᵀr / vᵀHv, which is Eq. 5 for v conjugate to those before, s += α v (Eq. 7), r −= α H v,
    and the next v is r + (r'ᵀr' / rᵀr) v. It ends after `iterations`, when ‖r‖ falls below `tolerance` ‖g‖, or when s reaches the
    trust radius Δ. Where the curvature along −g is negative, the step follows −g to the radius (Steihaug 1983). Memory is a few
    vectors; no n × n matrix is built. As many iterations as dimensions solve a well-conditioned positive definite H exactly, without
    tolerance and damping.

    Scales: as in `Newton`, all this is in the coordinates u = x / η with each parameter's learning rate η, times its σ, and so is Δ;
    products are asked for with η v.

    Noise: the estimated product H v need not be that of a symmetric matrix, nor of the same one each time. So the iterations end before
    they follow noise: at a v whose curvature vᵀHv / vᵀv is below `damping` times the greatest one met, or negative (the step along it then
    uses the magnitude of the curvature, and no less than that bound); when ‖r‖ exceeds ‖g‖; when v is no descent direction (vᵀg >= 0); at
    a product that is not finite. Thus s always descends by the given gradient, and few iterations are as good as many. The step is
    biased even where gradient and products are not: it is not linear in them.

    Args:
        learning_rate: η, in units of the parameter, > 0; for the parameters without their own. With 1 the trust region is in units of
            σ, or of the parameters; with rates that suit Adam, radii of 10 to 100 are usual.
        trust_radius: Δ, the longest step, Euclidean over all elements of u, > 0.
        iterations: Hessian-vector products a step at most, >= 1.
        tolerance: the ratio ‖r‖ / ‖g‖ at which it ends, in [0, 1).
        damping: the least curvature that is trusted, as a fraction of the greatest, in [0, 1).
        step_scale: γ, factor of the step, in (0, 1]; without effect with `inner_optimizer`.
        inner_optimizer: an Adam whose gradient is the negated step, as in the paper ("All methods use the Adam optimizer"); the length
            of its step follows from its own learning rate or the parameter's. None to take the step itself.
        schedule: factor of the step, the last thing to act, by step; see `unrender.schedules.functions`. Near the optimum the step
            is as noisy as the gradient: shrinking steps average the noise, which Adam's mean does for its own.
        line: keep the step's direction alone, and take its length from a parabola through three losses, at the parameters and one step to
            either side: two evaluations (and the estimator must provide losses). For many parameters, where the gradient is mostly
            noise and the curvature along it, from the same draws, is not that of the loss. Those losses are not smoothed.
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
        check_options("NewtonCG", self)
        checks.number("NewtonCG", "trust_radius", self.trust_radius, above=0.0)
        checks.integer("NewtonCG", "iterations", self.iterations, at_least=1)
        checks.number("NewtonCG", "tolerance", self.tolerance, above=0.0, below=1.0, inclusive=True)
        checks.number("NewtonCG", "damping", self.damping, above=0.0, below=1.0, inclusive=True)

    @property
    def requires(self) -> Capabilities:
        """A gradient and Hessian-vector products; with `line`, the loss at points of its own."""
        return Capabilities(Gradient, HessianProduct, *([LossFunction] if self.line else []))

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> NewtonState:
        return init_state("NewtonCG", self, parameters, learning_rates)

    def update(self, estimate: Estimate, state: NewtonState, parameters: Tree) -> tuple[Tree, NewtonState]:
        """See `Optimizer.update`. On the host, between products."""
        hvp = estimate.require("NewtonCG", HessianProduct).apply
        scale = coordinate_scales(estimate, state, parameters)

        def product(v: np.ndarray) -> np.ndarray:
            return scale * vectors.ravel(hvp(vectors.unravel(scale * v, parameters)))

        gradient = scale * vectors.ravel(estimate.gradient)
        step = conjugate_gradients.solve(
            gradient, product, self.trust_radius, self.iterations, self.tolerance, self.damping
        )
        if self.line and step.any():
            step = self._line_search(step, self._losses(estimate, scale * step, parameters))
        return apply_direction("NewtonCG", self, scale * step, state, parameters)

    @staticmethod
    def _losses(estimate: Estimate, step: np.ndarray, parameters: Tree) -> np.ndarray:
        """The losses one step behind the parameters, at the parameters, and one step ahead, (3,)."""
        theta = vectors.ravel(parameters)
        return estimate.require("NewtonCG", LossFunction).evaluate(np.stack([theta - step, theta, theta + step]))

    def _line_search(self, step: np.ndarray, losses: np.ndarray) -> np.ndarray:
        """The multiple >= 0 of `step` within the trust radius that minimises the parabola through the three losses."""
        behind, center, ahead = losses
        slope, curvature = 0.5 * (ahead - behind), ahead + behind - 2 * center
        longest = self.trust_radius / float(np.linalg.norm(step))
        if slope >= 0.0 or not np.isfinite(losses).all():
            return np.zeros_like(step)
        return (longest if curvature * longest <= -slope else -slope / curvature) * step
