"""Newton's method by conjugate gradients: the Newton step from Hessian-vector products alone (Wang et al., Eqs 4 to 7)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from unrender.core import checks, vectors
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import GRADIENT, HVP, LOSSES, Estimate
from unrender.optimizers.adam import Adam
from unrender.optimizers.newton import NewtonState, begin, check, finish, scales
from unrender.schedules.functions import Schedule


@register
@dataclass(frozen=True)
class NewtonCG:
    """A step that solves H s = −g by conjugate gradients (Fletcher and Reeves), truncated at a trust radius.

    From s = 0 and v = r = −g (Eq. 6): α = rᵀr / vᵀHv, which is Eq. 5 for v conjugate to those before, s += α v (Eq. 7), r −= α H v,
    and the next v is r + (r'ᵀr' / rᵀr) v. It ends after `iterations`, when ‖r‖ is a share `tolerance` of ‖g‖, or when s reaches the
    trust radius Δ. Where the objective bends downwards along −g, no minimum is in sight, and the step goes there to the radius
    (Steihaug 1983). Memory is a few vectors; no n × n matrix is built. As many iterations as dimensions solve a well-conditioned
    positive definite H exactly, without tolerance and damping.

    Scales: as in `Newton`, all this is of u = x / η with each parameter's learning rate η, times its σ, and so is Δ; the products that
    are asked for are of η v.

    Noise: what is estimated as H v need not come from a symmetric matrix, nor from the same one each time. So the iterations end where they
    would go by noise: at a v along which the curvature vᵀHv / vᵀv is less than a share `damping` of the greatest one met, or negative
    (its magnitude, and no less than that share, decides how far v is still followed); when ‖r‖ exceeds ‖g‖; when v no longer descends
    (vᵀg >= 0); at a product that is not finite. Thus s always descends by the gradient given, and few iterations are as good as many.
    The step is biased even where gradient and products are not: it is not linear in them.

    Args:
        learning_rate: η, in units of the parameter, > 0; for the parameters without their own. With 1 the trust region is in units of
            σ, or of the parameters; with rates that suit Adam, radii of 10 to 100 are usual.
        trust_radius: Δ, the longest step, Euclidean over all elements of u, > 0.
        iterations: Hessian-vector products a step at most, >= 1.
        tolerance: the residual's share of the gradient at which it ends, in [0, 1).
        damping: the least curvature that is believed, as a share of the greatest, in [0, 1).
        share: γ, the share of the step that is taken, in (0, 1]; not with `through`.
        through: an Adam that takes the step's opposite in place of the gradient, as in the paper ("All methods use the Adam
            optimizer"), and makes a step of its own length, by its own learning rate or the parameter's.
        schedule: factor of the step, the last thing to act, by step; see `unrender.schedules.functions`. Near the optimum the step
            is as noisy as the gradient: shrinking steps average the noise, which Adam's mean does for its own.
        line: take the step's direction alone, and its length from a parabola through the losses here and a step to either side: two
            evaluations (and the estimator must provide losses). For many parameters, where the gradient is mostly noise and the
            curvature along it, from the same draws, is not that of the loss. Those losses are not smoothed.
    """

    learning_rate: float = 1.0
    trust_radius: float = 0.5
    iterations: int = 4
    tolerance: float = 0.1
    damping: float = 0.1
    share: float = 1.0
    through: Adam | None = None
    schedule: Schedule | None = None
    line: bool = False

    def __post_init__(self):
        check("NewtonCG", self)
        checks.number("NewtonCG", "trust_radius", self.trust_radius, above=0.0)
        checks.integer("NewtonCG", "iterations", self.iterations, at_least=1)
        checks.number("NewtonCG", "tolerance", self.tolerance, above=0.0, below=1.0, inclusive=True)
        checks.number("NewtonCG", "damping", self.damping, above=0.0, below=1.0, inclusive=True)

    @property
    def requires(self) -> frozenset[str]:
        """A gradient and Hessian-vector products; with `line`, the loss at points of its own."""
        return frozenset({GRADIENT, HVP, *([LOSSES] if self.line else [])})

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> NewtonState:
        """See `Optimizer.init`."""
        return begin("NewtonCG", self, parameters, learning_rates)

    def update(self, estimate: Estimate, state: NewtonState, parameters: Tree) -> tuple[Tree, NewtonState]:
        """See `Optimizer.update`. On the host, between products."""
        hvp = estimate.hvp
        assert hvp is not None
        scale = scales(estimate, state, parameters)

        def product(v: np.ndarray) -> np.ndarray:
            return scale * vectors.ravel(hvp(vectors.unravel(scale * v, parameters)))

        step = self._solve(scale * vectors.ravel(estimate.gradient), product)
        if self.line and step.any():
            step = self._to_the_least(step, self._losses(estimate, scale * step, parameters))
        return finish("NewtonCG", self, scale * step, state, parameters)

    @staticmethod
    def _losses(estimate: Estimate, step: np.ndarray, parameters: Tree) -> np.ndarray:
        """The losses a step behind, here, and a step ahead."""
        assert estimate.losses is not None
        here = vectors.ravel(parameters)
        return estimate.losses(np.stack([here - step, here, here + step]))

    def _to_the_least(self, step: np.ndarray, losses: np.ndarray) -> np.ndarray:
        """The multiple of `step` within the trust radius at which the parabola through three losses is least; none backwards."""
        behind, here, ahead = losses
        slope, bend = 0.5 * (ahead - behind), ahead + behind - 2 * here
        farthest = self.trust_radius / float(np.linalg.norm(step))
        if slope >= 0.0 or not np.isfinite(losses).all():
            return np.zeros_like(step)
        return (farthest if bend * farthest <= -slope else -slope / bend) * step

    def _solve(self, gradient: np.ndarray, product: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        step, residual = np.zeros_like(gradient), -gradient
        v, sharpest = residual, 0.0
        first = square = float(residual @ residual)
        if not math.isfinite(first):
            return step
        for iteration in range(self.iterations):
            if not self.tolerance**2 * first < square <= first or not v @ gradient < 0.0:
                break
            bent = product(v)
            if not np.isfinite(bent).all():
                break
            bend, length = float(v @ bent), float(v @ v)
            left = _to_the_radius(step, v, self.trust_radius)
            if iteration == 0 and bend <= 0.0:
                return left * v
            sharpest = max(sharpest, abs(bend) / length)
            least = self.damping * sharpest * length
            believed = max(abs(bend), least)
            if square >= believed * left:
                return step + left * v
            alpha = square / believed
            step = step + alpha * v
            if bend < least:
                break
            residual = residual - alpha * bent
            before, square = square, float(residual @ residual)
            v = residual + square / before * v
        return step


def _to_the_radius(step: np.ndarray, v: np.ndarray, radius: float) -> float:
    """The τ >= 0 at which step + τ v is on the sphere of that radius."""
    a, b = float(v @ v), float(step @ v)
    c = float(step @ step) - radius**2
    return (-b + math.sqrt(max(b * b - a * c, 0.0))) / a
