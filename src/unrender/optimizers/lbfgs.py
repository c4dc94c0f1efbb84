"""Limited-memory BFGS, which estimates curvature from the gradients of past steps (Liu and Nocedal 1989)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from unrender.core import arrays, checks, trees
from unrender.core.checks import Count, OpenFraction, Positive
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient
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

    @property
    def requires(self) -> Capabilities:
        """A gradient."""
        return Capabilities(Gradient)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> LBFGSState:
        n = sum(math.prod(arrays.shape(x)) for x in parameters.values())
        none, rows = np.zeros(n), np.zeros((self.history, n))
        return LBFGSState(init_state("LBFGS", self, parameters, learning_rates), none, none, rows, rows)

    def update(self, estimate: Estimate, state: LBFGSState, parameters: Tree) -> tuple[Tree, LBFGSState]:
        """Return the steps and the next state. Computed on the host."""
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
