"""The step rule for a gradient with an estimated variance (Balint et al. 2023, section 5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from unrender.core import arrays, checks
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient, Variance
from unrender.optimizers import rates
from unrender.problem.upsampling import Upsampler
from unrender.schedules.functions import Schedule

__all__ = ["MetaAdam", "MetaAdamState"]


@dataclass(frozen=True)
class MetaAdamState:
    """State between steps.

    Attributes:
        step: steps made so far.
        learning_rates: of each parameter, before the schedule.
    """

    step: int
    learning_rates: dict[str, float]

    def upsampled(self, upsampler: Upsampler) -> MetaAdamState:
        """See `Upsamplable`: nothing in it has a parameter's shape."""
        del upsampler
        return self

    def restarted(self, fresh: MetaAdamState) -> MetaAdamState:
        """See `Restartable`: the schedule goes on."""
        return replace(fresh, step=self.step)


@register
@dataclass(frozen=True)
class MetaAdam:
    """Steps −η g / √(Var g + ε), per element (Eq. 21), with the variance that the estimator provides.

    Adam divides by the root mean square of many gradients, which it assumes independent; a meta-estimate is an average already and
    correlated with earlier ones. Here the divisor is the standard deviation of the present gradient: where noise dominates, the step is
    about η at most; where many samples agree it grows with their number, up to η √n after n steps of a constant gradient (Var g is
    the mean square of a sample), and falls as soon as the gradient or the weight of the past becomes small. So learning rates are
    lower than Adam's, and the same rate serves the start and the end of a descent.

    At the first step a meta-estimate's variance is its square, and the step is −η sign(g), as Adam's.

    Args:
        learning_rate: η, in units of the parameter, > 0; for the parameters without their own. Or {key: rate, "*": of the others}.
        epsilon: ε, in squared units of the gradient, > 0: elements whose gradient and variance are both 0 do not move.
            It is far below Adam's (whose ε is outside the root): a texel's gradient of a mean over pixels is small.
        schedule: factor of every learning rate by step; see `unrender.schedules.functions`.
        longest: the longest step of an element in units of η, > 0; None for no limit.
    """

    learning_rate: float | Mapping[str, float] = 0.002
    epsilon: float = 1e-24
    schedule: Schedule | None = None
    longest: float | None = None

    def __post_init__(self):
        rates.check("MetaAdam", self.learning_rate, self.schedule)
        checks.number("MetaAdam", "epsilon", self.epsilon, above=0.0)
        if self.longest is not None:
            checks.number("MetaAdam", "longest", self.longest, above=0.0)

    @property
    def requires(self) -> Capabilities:
        """A gradient and its variance."""
        return Capabilities(Gradient, Variance)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> MetaAdamState:
        """See `Optimizer.init`."""
        return MetaAdamState(0, rates.per_parameter("MetaAdam", parameters, self.learning_rate, learning_rates))

    def update(self, estimate: Estimate, state: MetaAdamState, parameters: Tree) -> tuple[Tree, MetaAdamState]:
        """See `Optimizer.update`. Lazy on Dr.Jit."""
        del parameters
        variance = estimate.require("MetaAdam", Variance).values
        factor = rates.factor("MetaAdam", self.schedule, state.step)
        steps: Tree = {}
        for key, gradient in estimate.gradient.items():
            rate = arrays.scalar(-state.learning_rates[key] * factor, gradient)
            step = gradient / arrays.sqrt(variance[key] + self.epsilon)
            steps[key] = rate * (step if self.longest is None else arrays.clip(step, -self.longest, self.longest))
        return steps, replace(state, step=state.step + 1)
