"""Newton steps, from Hessians or Hessian-vector products (Wang et al., section 2), and limited-memory BFGS (Liu and Nocedal 1989)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from unrender.core import arrays, checks, conjugate_gradients, trees
from unrender.core.checks import Count, Fraction, OpenFraction, Positive
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient, Hessian, HessianProduct, LossFunction
from unrender.optimizers.directions import (
    NewtonState,
    apply_direction,
    check_options,
    coordinate_scales,
    free_elements,
    init_state,
)
from unrender.optimizers.recipes import Adam
from unrender.schedules import Schedule

_SECULAR_ITERATIONS = 60


def trust_region_step(curvatures: np.ndarray, gradient: np.ndarray, radius: float | None) -> np.ndarray:
    """Return the s with ‖s‖ <= radius that minimises Σ gradient s + curvatures s² / 2, in the eigenbasis, (n,).

    Args:
        curvatures: (n,), >= 0; > 0 without a radius.
        gradient: (n,), not all zero.
        radius: > 0; None for no limit.

    The solution is −gradient / (curvatures + λ) with the smallest λ >= 0 that satisfies the limit (Nocedal and Wright, section 4.3).
    Newton's iteration for 1 / ‖s‖ = 1 / radius approaches λ from below.
    """
    if radius is None:
        return -gradient / curvatures
    λ = max(0.0, float(np.linalg.norm(gradient)) / radius - float(curvatures.max()))
    if not (curvatures + λ).all():
        λ = max(λ, float((np.abs(gradient) / radius - curvatures).max()))
    step = _ratio(-gradient, curvatures + λ)
    for _ in range(_SECULAR_ITERATIONS):
        length = float(np.linalg.norm(step))
        if length <= radius * (1 + 1e-10):
            break
        λ += length**2 / float(np.sum(_ratio(step * step, curvatures + λ))) * (length - radius) / radius
        step = _ratio(-gradient, curvatures + λ)
    return trees.clip_norm(step, radius)


def _ratio(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.divide(x, y, out=np.zeros_like(x), where=x != 0.0)


@register
@dataclass(frozen=True)
class Newton:
    """Steps −γ H̃⁻¹ g (Eq. 3) with a positive definite H̃, in a trust region.

    H̃ has the eigenvectors of H and the magnitudes of its eigenvalues, at least `damping` times the largest. Along directions of negative
    curvature, plain Newton steps would climb to a saddle point or a maximum. A step beyond the trust region is replaced by the minimum of
    gᵀs + sᵀ H̃ s / 2 for ‖s‖ <= Δ, which turns towards −g as Δ shrinks. (The paper shortens the step and keeps its direction. That
    direction is dominated by the eigenvectors of least curvature, whose estimates are the noisiest.) If H is zero, the step is −g with
    length Δ. If H is not finite, there is no step.

    Scales: coordinates are u = x / η, where η is each parameter's learning rate. For smoothed derivatives, η is `learning_rate` times σ
    (`Estimate.sigma`), whatever a parameter's own rate, since they contain no information beyond σ. Δ and `damping` are in units of u: a
    position in metres and an angle in radians with η of 0.05 and 0.5 may move by 0.05 Δ and 0.5 Δ. Inside the trust region and without
    damping, the step does not depend on η.

    Noise: the step is a product of two estimates, so it is biased even if they are not (an inverse is convex). Noise that reduces a small
    eigenvalue causes a long step along its eigenvector. Noise of a tenth of H needs `damping` of about 0.03, noise as large as H needs
    0.3. `step_scale` and `inner_optimizer` average over steps. Takes O(n³) time and O(n²) memory for n parameters in total.

    Args:
        learning_rate: η, in units of the parameter, > 0, for the parameters without their own. With 1 the trust region is in units of σ,
            or of the parameters; with learning rates that suit Adam, radii of 10 to 100 are usual.
        trust_radius: Δ, largest Euclidean length of a step over all elements of u, > 0; None for no limit.
        damping: smallest eigenvalue of H̃ relative to the largest, in (0, 1).
        step_scale: γ, factor of the step, in (0, 1]; no effect with `inner_optimizer`.
        inner_optimizer: an Adam whose gradient is the negated step, as in the paper ("All methods use the Adam optimizer"); its own
            learning rate, or the parameter's, determines the length. None takes the step itself.
        schedule: final factor of the step, by step; see `unrender.schedules`.
    """

    learning_rate: float = 1.0
    trust_radius: Positive | None = 0.5
    damping: OpenFraction = 0.1
    step_scale: float = 1.0
    inner_optimizer: Adam | None = None
    schedule: Schedule | None = None

    def __post_init__(self):
        check_options("Newton", self)
        checks.fields(self)

    requires = Capabilities(Gradient, Hessian)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> NewtonState:
        return init_state("Newton", self, parameters, learning_rates)

    def update(self, estimate: Estimate, state: NewtonState, parameters: Tree) -> tuple[Tree, NewtonState]:
        matrix = estimate.require("Newton", Hessian).matrix
        scale = coordinate_scales(estimate, state, parameters, self.learning_rate)
        hessian = scale[:, None] * arrays.numpy(matrix).astype(np.float64) * scale
        step, gradient = np.zeros_like(scale), scale * trees.ravel(estimate.gradient)
        free = np.flatnonzero(free_elements(estimate, parameters))
        step[free] = self._solve(gradient[free], hessian[np.ix_(free, free)])
        return apply_direction("Newton", self, scale * step, state, parameters)

    def _solve(self, gradient: np.ndarray, hessian: np.ndarray) -> np.ndarray:
        none = np.zeros_like(gradient)
        if not (np.isfinite(hessian).all() and np.isfinite(gradient).all() and gradient.any()):
            return none
        eigenvalues, eigenvectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
        curvatures = np.abs(eigenvalues)
        curvatures = np.maximum(curvatures, self.damping * curvatures.max())
        if self.trust_radius is None and not curvatures.all():
            return none
        with np.errstate(over="ignore", invalid="ignore"):  # `apply_direction` discards what is not finite
            return eigenvectors @ trust_region_step(curvatures, eigenvectors.T @ gradient, self.trust_radius)


@register
@dataclass(frozen=True)
class NewtonCG:
    """Approximate solution of H s = −g by conjugate gradients (Fletcher and Reeves), truncated at a trust radius.

    Starts from s = 0 and v = r = −g (Eq. 6). Each iteration computes α = rᵀr / vᵀHv, which equals Eq. 5 for v conjugate to earlier ones,
    s += α v (Eq. 7), r' = r − α H v, and v = r' + (r'ᵀr' / rᵀr) v. It stops after `iterations`, when ‖r‖ is below `tolerance` ‖g‖, or
    when s reaches the trust radius Δ. If the curvature along −g is negative, the step follows −g to the radius (Steihaug 1983). Memory is
    a few vectors; no n × n matrix is built. As many iterations as dimensions solve a well-conditioned positive definite system exactly,
    without tolerance and damping.

    Scales: as in `Newton`, everything, including Δ, is in coordinates u = x / η.
    Products are requested for η v.

    Noise: the estimated products need not belong to one symmetric matrix. So the iteration stops before it follows noise: at a v whose
    curvature vᵀHv / vᵀv is negative or below `damping` times the largest so far (the step along it then uses the magnitude of the
    curvature, but at least that bound); when ‖r‖ exceeds ‖g‖; when v is not a descent direction (vᵀg >= 0); and at a product that is not
    finite. Thus s is always a descent direction of the given gradient, and few iterations are as good as many. The step is biased even if
    gradient and products are not, because it is nonlinear in them.

    Args:
        trust_radius: Δ, largest Euclidean length of a step over all elements of u, > 0.
        iterations: maximum number of Hessian-vector products per step, >= 1.
        tolerance: ratio ‖r‖ / ‖g‖ at which the iteration stops, in [0, 1).
        damping: smallest accepted curvature relative to the largest, in [0, 1).
        learning_rate, step_scale, inner_optimizer, schedule: as in `Newton`. Near the optimum the step is as noisy as the gradient.
            Decreasing steps average this noise, as Adam's mean does.
        line: whether to use only the step's direction, and to determine its length from a parabola through three losses, at the
            parameters and one step to either side. This takes two evaluations, and the estimator must provide losses. It suits many
            parameters, where the gradient is mostly noise and its curvature, from the same samples, is not that of the loss. These losses
            are not smoothed.
    """

    learning_rate: float = 1.0
    trust_radius: Positive = 0.5
    iterations: Count = 4
    tolerance: Fraction = 0.1
    damping: Fraction = 0.1
    step_scale: float = 1.0
    inner_optimizer: Adam | None = None
    schedule: Schedule | None = None
    line: bool = False

    def __post_init__(self):
        checks.fields(self)
        check_options("NewtonCG", self)

    @property
    def requires(self) -> Capabilities:
        """A gradient and Hessian-vector products; with `line`, also the loss at points chosen by the optimizer."""
        return Capabilities(Gradient, HessianProduct, *([LossFunction] if self.line else []))

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> NewtonState:
        return init_state("NewtonCG", self, parameters, learning_rates)

    def update(self, estimate: Estimate, state: NewtonState, parameters: Tree) -> tuple[Tree, NewtonState]:
        hvp = estimate.require("NewtonCG", HessianProduct).apply
        scale = coordinate_scales(estimate, state, parameters, self.learning_rate) * free_elements(estimate, parameters)

        def product(v: np.ndarray) -> np.ndarray:
            return scale * trees.ravel(hvp(trees.unravel(scale * v, parameters)))

        gradient = scale * trees.ravel(estimate.gradient)
        step = conjugate_gradients.solve(
            gradient, product, self.trust_radius, self.iterations, self.tolerance, self.damping
        )
        if self.line and step.any():
            theta, moved = trees.ravel(parameters), scale * step
            evaluate = estimate.require("NewtonCG", LossFunction).evaluate
            step = self._line_search(step, evaluate(np.stack([theta - moved, theta, theta + moved])))
        return apply_direction("NewtonCG", self, scale * step, state, parameters)

    def _line_search(self, step: np.ndarray, losses: np.ndarray) -> np.ndarray:
        """Return the multiple >= 0 of `step` in the trust radius that minimises the parabola through the three losses."""
        behind, center, ahead = losses
        slope, curvature = 0.5 * (ahead - behind), ahead + behind - 2 * center
        longest = self.trust_radius / float(np.linalg.norm(step))
        if slope >= 0.0 or not np.isfinite(losses).all():
            return np.zeros_like(step)
        return (longest if curvature * longest <= -slope else -slope / curvature) * step


_FIRST_STEP = 0.1
"""Length of a step without curvature information, as a fraction of the trust radius."""


@dataclass(frozen=True)
class LBFGSState:
    """State between steps.

    Attributes:
        newton: step count, scales and inner Adam, as in `Newton`.
        parameters, gradient: those of the last step, (n,) each.
        moves, changes: s = Δx and y = Δg of past steps, (history, n) each, with the most recent in the last row.
        count: number of rows in use, which are the last ones.
    """

    newton: NewtonState
    parameters: np.ndarray
    gradient: np.ndarray
    moves: np.ndarray
    changes: np.ndarray
    count: int = 0


@register
@dataclass(frozen=True)
class LBFGS:
    """Steps −γ B g within a trust radius, where B is BFGS's estimate of H⁻¹.

    B comes from the last steps s and the changes y of the gradient, starting from the identity times sᵀy / yᵀy of the last pair. There is
    no line search: a step costs one gradient. Without any pair (s, y) the step is −g with a tenth of the trust radius. Memory is 2
    `history` n numbers.

    Scales: as in `Newton`, everything, including Δ, is in coordinates u = x / η.

    Noise: y is the difference of two gradients with independent noise, which does not shrink with s. A pair with sᵀy below `curvature`
    ‖s‖ ‖y‖, such as one with negative curvature or mostly noise, is skipped. The noise of the others stays for `history` steps. Noise in
    proportion to the gradient, up to a third of it, does little harm. Noise of constant size soon ends the optimisation (the paper found
    that it "almost never converges" there), which a `schedule` delays. B is biased even if the gradients are not.

    Args:
        trust_radius: Δ, largest Euclidean length of a step over all elements of u, > 0.
        history: number of pairs, >= 1.
        curvature: smallest cosine between s and y of a pair, in (0, 1).
        learning_rate, step_scale, inner_optimizer, schedule: as in `Newton`.
    """

    learning_rate: float = 1.0
    trust_radius: Positive = 0.5
    history: Count = 5
    curvature: OpenFraction = 0.01
    step_scale: float = 1.0
    inner_optimizer: Adam | None = None
    schedule: Schedule | None = None

    def __post_init__(self):
        check_options("LBFGS", self)
        checks.fields(self)

    requires = Capabilities(Gradient)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> LBFGSState:
        n = sum(math.prod(arrays.shape(x)) for x in parameters.values())
        none, rows = np.zeros(n), np.zeros((self.history, n))
        return LBFGSState(init_state("LBFGS", self, parameters, learning_rates), none, none, rows, rows)

    def update(self, estimate: Estimate, state: LBFGSState, parameters: Tree) -> tuple[Tree, LBFGSState]:
        scale = coordinate_scales(estimate, state.newton, parameters, self.learning_rate)
        here, gradient = trees.ravel(parameters), trees.ravel(estimate.gradient)
        if state.newton.step:
            state = self._remember(state, here - state.parameters, gradient - state.gradient, scale)
        free = free_elements(estimate, parameters)
        direction = free * scale * self._direction(state, free * scale * gradient, scale)
        steps, newton = apply_direction("LBFGS", self, direction, state.newton, parameters)
        return steps, replace(state, newton=newton, parameters=here, gradient=gradient)

    def _remember(self, state: LBFGSState, move: np.ndarray, change: np.ndarray, scale: np.ndarray) -> LBFGSState:
        """Return the state with this pair as the most recent one, if its curvature is positive and large enough."""
        least = self.curvature * float(np.linalg.norm(move / scale) * np.linalg.norm(change * scale))
        if not 0.0 < least <= float(move @ change):
            return state
        return replace(
            state,
            moves=np.concatenate([state.moves[1:], move[None]]),
            changes=np.concatenate([state.changes[1:], change[None]]),
            count=min(state.count + 1, self.history),
        )

    def _direction(self, state: LBFGSState, gradient: np.ndarray, scale: np.ndarray) -> np.ndarray:
        from scipy.optimize import LbfgsInvHessProduct  # a slow import

        length = float(np.linalg.norm(gradient))
        if not 0.0 < length < math.inf:
            return np.zeros_like(gradient)
        if state.count == 0:
            return gradient * (-_FIRST_STEP * self.trust_radius / length)
        moves, changes = state.moves[-state.count :] / scale, state.changes[-state.count :] * scale
        # SciPy's B starts from the identity. In coordinates u / √β this is β in those of u.
        beta = float(moves[-1] @ changes[-1]) / float(changes[-1] @ changes[-1])
        inverse = LbfgsInvHessProduct(moves / math.sqrt(beta), changes * math.sqrt(beta))
        return trees.clip_norm(-beta * inverse.matvec(gradient), self.trust_radius)
