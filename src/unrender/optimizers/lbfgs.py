"""Limited-memory BFGS: curvature from the gradients of past steps (Liu and Nocedal 1989)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from unrender.core import arrays, checks, vectors
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient
from unrender.optimizers.adam import Adam
from unrender.optimizers.directions import (
    NewtonState,
    apply_direction,
    check_options,
    coordinate_scales,
    init_state,
)
from unrender.schedules.functions import Schedule

_FIRST_STEP = 0.1
"""Length of a step before any curvature is known, as a fraction of the trust radius."""


@dataclass(frozen=True)
class LBFGSState:
    """State between steps.

    Attributes:
        newton: the step count, scales and inner Adam, as of `Newton`.
        parameters, gradient: (n,) each, of the last step.
        moves, changes: (history, n) each: s = Δx and y = Δg of past steps, the most recent in the last row.
        count: how many rows of them are in use, the last ones.
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
    """Steps −γ B g, no longer than a trust radius: B is BFGS's estimate of H⁻¹ from the last steps s and the changes y of the gradient
    over them, starting from the identity times sᵀy / yᵀy of the last one. There is no line search: a step costs one gradient.

    Until there is a pair (s, y) the step is −g, a tenth of the trust radius long. Needs 2 `history` n numbers of memory.

    Scales: as in `Newton`, all this is of u = x / η with each parameter's learning rate η, times its σ, and so is Δ.

    Noise: y is the difference of two gradients that each have noise of their own, which does not shrink with s. A pair with sᵀy below
    `curvature` ‖s‖ ‖y‖, as where the curvature is negative or y is mostly noise, is left out; the noise of the others stays for
    `history` steps. So noise in proportion to the gradient, up to a third of it, does little harm; noise of a constant size soon ends
    the descent (the paper found that it "almost never converges" there), which a `schedule` delays. B is biased even where the
    gradients are not.

    Args:
        learning_rate: η, in units of the parameter, > 0; for the parameters without their own. With 1 the trust region is in units of
            σ, or of the parameters; with rates that suit Adam, radii of 10 to 100 are usual.
        trust_radius: Δ, the longest step, Euclidean over all elements of u, > 0.
        history: pairs that are kept, >= 1.
        curvature: the least cosine between s and y of a pair that is kept, in (0, 1).
        step_scale: γ, factor of the step, in (0, 1]; without effect with `inner_optimizer`.
        inner_optimizer: an Adam whose gradient is the negated step; the length of its step follows from its own learning rate or the
            parameter's. None to take the step itself.
        schedule: factor of the step, the last thing to act, by step; see `unrender.schedules.functions`.
    """

    learning_rate: float = 1.0
    trust_radius: float = 0.5
    history: int = 5
    curvature: float = 0.01
    step_scale: float = 1.0
    inner_optimizer: Adam | None = None
    schedule: Schedule | None = None

    def __post_init__(self):
        check_options("LBFGS", self)
        checks.number("LBFGS", "trust_radius", self.trust_radius, above=0.0)
        checks.integer("LBFGS", "history", self.history, at_least=1)
        checks.number("LBFGS", "curvature", self.curvature, above=0.0, below=1.0)

    @property
    def requires(self) -> Capabilities:
        """A gradient."""
        return Capabilities(Gradient)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> LBFGSState:
        n = sum(math.prod(arrays.shape(x)) for x in parameters.values())
        none, rows = np.zeros(n), np.zeros((self.history, n))
        return LBFGSState(init_state("LBFGS", self, parameters, learning_rates), none, none, rows, rows)

    def update(self, estimate: Estimate, state: LBFGSState, parameters: Tree) -> tuple[Tree, LBFGSState]:
        """See `Optimizer.update`. On the host."""
        scale = coordinate_scales(estimate, state.newton, parameters)
        here, gradient = vectors.ravel(parameters), vectors.ravel(estimate.gradient)
        if state.newton.step:
            state = self._remember(state, here - state.parameters, gradient - state.gradient, scale)
        direction = scale * self._direction(state, scale * gradient, scale)
        steps, newton = apply_direction("LBFGS", self, direction, state.newton, parameters)
        return steps, replace(state, newton=newton, parameters=here, gradient=gradient)

    def _remember(self, state: LBFGSState, move: np.ndarray, change: np.ndarray, scale: np.ndarray) -> LBFGSState:
        """With this pair as the most recent one, where its curvature is positive and large enough."""
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
        from scipy.optimize import LbfgsInvHessProduct  # takes long to import

        length = float(np.linalg.norm(gradient))
        if not 0.0 < length < math.inf:
            return np.zeros_like(gradient)
        if state.count == 0:
            return gradient * (-_FIRST_STEP * self.trust_radius / length)
        moves, changes = state.moves[-state.count :] / scale, state.changes[-state.count :] * scale
        # SciPy's B starts from the identity: in coordinates u / √β that is β in those of u.
        beta = float(moves[-1] @ changes[-1]) / float(changes[-1] @ changes[-1])
        inverse = LbfgsInvHessProduct(moves / math.sqrt(beta), changes * math.sqrt(beta))
        return vectors.clip_norm(-beta * inverse.matvec(gradient), self.trust_radius)
