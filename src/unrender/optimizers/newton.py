"""Newton's method with a modified Hessian, for estimators that give one (Wang et al., section 2).

Also what it shares with the other methods that choose a direction on the host: how parameters are scaled, and how a direction becomes a
step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from unrender.core import arrays, checks, vectors
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import GRADIENT, HESSIAN, Estimate
from unrender.optimizers import rates
from unrender.optimizers.adam import Adam, AdamState
from unrender.problem.upsampling import NotCarried, Upsampler
from unrender.schedules.functions import Schedule

_SECULAR_ITERATIONS = 60


@dataclass(frozen=True)
class NewtonState:
    """State between steps.

    Attributes:
        step: steps made so far.
        learning_rates: of each parameter: its scale.
        adam: of the Adam that directions pass through, in double precision on the host; None without one.
    """

    step: int
    learning_rates: dict[str, float]
    adam: AdamState | None = None

    def upsampled(self, upsampler: Upsampler) -> NewtonState:
        """See `Upsamplable`. Raises `NotCarried` where directions pass through Adam, whose moments are on the host."""
        del upsampler
        if self.adam is not None:
            raise NotCarried("Newton's Adam")
        return self

    def restarted(self, fresh: NewtonState) -> NewtonState:
        """See `Restartable`: the schedule goes on."""
        adam = None if self.adam is None or fresh.adam is None else self.adam.restarted(fresh.adam)
        return replace(fresh, step=self.step, adam=adam)


@register
@dataclass(frozen=True)
class Newton:
    """Steps −γ H̃⁻¹ g (Eq. 3) with a positive definite H̃, within a trust region.

    H̃ has the eigenvectors of H and its eigenvalues' magnitudes, none below a share `damping` of the largest: where the objective bends
    downwards, plain Newton steps would climb to a saddle or a maximum. A step that would leave the trust region is replaced by the best
    one inside, the minimum of gᵀs + sᵀ H̃ s / 2 for ‖s‖ <= Δ, which turns towards −g as Δ shrinks. (The paper shortens the step and
    keeps its direction, which is that of the flattest eigenvectors, and they are the ones that noise is mistaken for.) Where H is zero
    the step is −g, Δ long; where H is not finite there is none.

    Scales: the step is sought for the coordinates u = x / η, where η is each parameter's learning rate, times the σ of derivatives that
    are smoothed (`Estimate.width`): of what is farther they tell nothing. Δ, like `damping`, is of u. A position in metres and an
    angle in radians with η of 0.05 and 0.5 may so move by 0.05 Δ and 0.5 Δ. Inside the trust region and without damping the step
    does not depend on η.

    Noise: the step is a product of two estimates, so it is biased even where they are not (an inverse is convex); a small eigenvalue
    that noise makes smaller gives a long step along itself. Noise of a tenth of H asks for `damping` around 0.03, as much noise as H for
    0.3; `share` averages over steps, and so does `through`. Costs O(n³) time and O(n²) memory for n parameters in all.

    Args:
        learning_rate: η, in units of the parameter, > 0; for the parameters without their own. With 1 the trust region is in units of
            σ, or of the parameters; with rates that suit Adam, radii of 10 to 100 are usual.
        trust_radius: Δ, the longest step, Euclidean over all elements of u, > 0; None for no limit.
        damping: the least eigenvalue's share of the largest, in (0, 1).
        share: γ, the share of the step that is taken, in (0, 1]; not with `through`.
        through: an Adam that takes the step's opposite in place of the gradient, as in the paper ("All methods use the Adam
            optimizer"), and makes a step of its own length, by its own learning rate or the parameter's.
        schedule: factor of the step, the last thing to act, by step; see `unrender.schedules.functions`.
    """

    learning_rate: float = 1.0
    trust_radius: float | None = 0.5
    damping: float = 0.1
    share: float = 1.0
    through: Adam | None = None
    schedule: Schedule | None = None

    def __post_init__(self):
        check("Newton", self)
        checks.number("Newton", "damping", self.damping, above=0.0, below=1.0)
        if self.trust_radius is not None:
            checks.number("Newton", "trust_radius", self.trust_radius, above=0.0)

    @property
    def requires(self) -> frozenset[str]:
        """A gradient and its Hessian."""
        return frozenset({GRADIENT, HESSIAN})

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> NewtonState:
        """See `Optimizer.init`."""
        return begin("Newton", self, parameters, learning_rates)

    def update(self, estimate: Estimate, state: NewtonState, parameters: Tree) -> tuple[Tree, NewtonState]:
        """See `Optimizer.update`. On the host."""
        assert estimate.hessian is not None
        scale = scales(estimate, state, parameters)
        hessian = scale[:, None] * arrays.numpy(estimate.hessian).astype(np.float64) * scale
        step = self._solve(scale * vectors.ravel(estimate.gradient), hessian)
        return finish("Newton", self, scale * step, state, parameters)

    def _solve(self, gradient: np.ndarray, hessian: np.ndarray) -> np.ndarray:
        none = np.zeros_like(gradient)
        if not (np.isfinite(hessian).all() and np.isfinite(gradient).all() and gradient.any()):
            return none
        values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
        bend = np.abs(values)
        bend = np.maximum(bend, self.damping * bend.max())
        if self.trust_radius is None and not bend.all():
            return none
        with np.errstate(over="ignore", invalid="ignore"):  # `finish` looks at what came of it
            return vectors @ _least(bend, vectors.T @ gradient, self.trust_radius)


def _least(bend: np.ndarray, slope: np.ndarray, radius: float | None) -> np.ndarray:
    """The s with ‖s‖ <= radius where Σ slope s + bend s² / 2 is least, per eigenvector: (n,), bend >= 0, slope not all zero.

    It is −slope / (bend + λ) with the least λ >= 0 that makes it short enough (Nocedal and Wright, section 4.3). Newton's iteration for
    1 / ‖s‖ = 1 / radius comes from below the root and stays there.
    """
    if radius is None:
        return -slope / bend
    extra = max(0.0, float(np.linalg.norm(slope)) / radius - float(bend.max()))
    step = -slope / (bend + extra)
    for _ in range(_SECULAR_ITERATIONS):
        length = float(np.linalg.norm(step))
        if length <= radius * (1 + 1e-10):
            break
        extra += length**2 / float(np.sum(step * step / (bend + extra))) * (length - radius) / radius
        step = -slope / (bend + extra)
    return vectors.clip_norm(step, radius)


class Directed(Protocol):
    """The options of every method whose directions become steps by `finish`; `Newton` says what they do."""

    @property
    def learning_rate(self) -> float: ...

    @property
    def share(self) -> float: ...

    @property
    def through(self) -> Adam | None: ...

    @property
    def schedule(self) -> Schedule | None: ...


def check(owner: str, options: Directed) -> None:
    """Raise `InputError` unless they make sense."""
    rates.check(owner, options.learning_rate, options.schedule)
    if checks.number(owner, "share", options.share, above=0.0) > 1.0:
        raise InputError(f"{owner}: share must be at most 1, got {options.share!r}")
    if options.through is not None and not isinstance(options.through, Adam):
        raise InputError(f"{owner}: through must be an Adam or None, got {options.through!r}")


def begin(owner: str, options: Directed, parameters: Tree, learning_rates: Mapping[str, float] | None) -> NewtonState:
    """The state before the first step. Raises `InputError` for learning rates that make no sense."""
    own = rates.per_parameter(owner, parameters, options.learning_rate, learning_rates)
    adam = None
    if options.through is not None:
        adam = options.through.init({k: np.zeros(arrays.shape(x)) for k, x in parameters.items()}, learning_rates)
    return NewtonState(0, own, adam)


def scales(estimate: Estimate, state: NewtonState, parameters: Tree) -> np.ndarray:
    """The unit of each element's coordinate u, (n,): its learning rate, times the width that the estimate holds for, if any."""
    width = estimate.width
    return vectors.spread({k: η * (width[k] if width else 1.0) for k, η in state.learning_rates.items()}, parameters)


def finish(
    owner: str, options: Directed, direction: np.ndarray, state: NewtonState, parameters: Tree
) -> tuple[Tree, NewtonState]:
    """The steps that a direction (n,), in units of the parameters, becomes, and the next state.

    A direction that is not finite counts as none.
    """
    if not np.isfinite(direction).all():
        direction = np.zeros_like(direction)
    step, adam = options.share * direction, state.adam
    if options.through is not None and adam is not None:
        opposite = vectors.unravel(-direction, adam.first_moment)
        steps, adam = options.through.update(Estimate(0.0, opposite), adam, opposite)
        step = vectors.ravel(steps)
    factor = rates.factor(owner, options.schedule, state.step)
    return vectors.unravel(factor * step, parameters), NewtonState(state.step + 1, state.learning_rates, adam)
