"""Step rule for a gradient with an estimated variance (Balint et al. 2023, section 5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from unrender.core import checks
from unrender.core.registry import register
from unrender.optimizers import rates
from unrender.optimizers.chain import Recipe
from unrender.optimizers.transforms.base import StepTransform
from unrender.optimizers.transforms.scale import ClipDirection, ScaleByDeviation
from unrender.schedules.functions import Schedule


@register
@dataclass(frozen=True)
class MetaAdam(Recipe):
    """Steps −η g / √(Var g + ε), per element (Eq. 21), with the variance from the estimator.

    Adam divides by the root mean square of many gradients, which it assumes to be independent. A meta-estimate is already an average, and
    correlated with earlier ones. Here the divisor is the standard deviation of the current gradient. Where noise dominates, the step is
    about η at most. Where many samples agree, it grows with their number: up to η √n after n steps of a constant gradient, where Var g is
    the mean square of a sample. It decreases when the gradient or the weight of the past becomes small. So learning rates are lower
    than Adam's, and one learning rate serves the start and the end of a run.

    The noise of successive meta-estimates is correlated, so the steps of a noisy element do not average out. After n steps with full
    weight of the past it has moved by about 0.8 η n, whereas Adam with independent gradients moves it by η √n: a factor of 14 after 300
    steps.

    At the first step a meta-estimate's variance is its square, and the step is −η sign(g), as in Adam. The chain is `ScaleByDeviation`,
    and `ClipDirection` with `longest`.

    Args:
        learning_rate: η, in units of the parameter, > 0, for the parameters without their own; or {key: rate, "*": rate of the others}.
        epsilon: ε, in squared units of the gradient, > 0. Elements whose gradient and variance are both 0 do not move. It is far below
            Adam's ε, which is outside the root: a texel's gradient of a mean over pixels is small.
        schedule: factor of every learning rate by step; see `unrender.schedules.functions`.
        longest: largest step of an element in units of η, > 0; None for no limit.
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

    def compose(self) -> tuple[StepTransform, ...]:
        scale = ScaleByDeviation(self.epsilon)
        return (scale,) if self.longest is None else (scale, ClipDirection(self.longest))
