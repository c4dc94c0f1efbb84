from dataclasses import dataclass, field
from typing import Any

import unrender as ur
from unrender.core import arrays, checks, trees
from unrender.estimators.base import Estimate, Estimator
from unrender.scene.upsampling import upsampled


@dataclass(frozen=True)
class AveragedState:
    """State between steps: the inner estimator's, the mean gradient before debiasing, the steps made."""

    inner: Any
    mean: dict[str, Any]
    steps: int = 0

    def upsampled(self, upsampler):
        return AveragedState(upsampled(self.inner, upsampler), upsampler.tree(self.mean, 1.0), self.steps)


@ur.register
@dataclass(frozen=True)
class AveragedGradient(Estimator):
    """The exponentially weighted mean of another estimator's gradients. Biased while the parameters move.

    Args:
        inner: estimates the gradients.
        decay: of the mean, in [0, 1).
    """

    inner: Estimator = field(default_factory=ur.PathGradient)
    decay: float = 0.8

    def __post_init__(self):
        checks.number("AveragedGradient", "decay", self.decay, above=0.0, below=1.0, inclusive=True)

    @property
    def provides(self):
        return frozenset({"gradient"})

    def init(self, problem, parameters):
        return AveragedState(self.inner.init(problem, parameters), trees.zeros_like(parameters))

    def estimate(self, problem, parameters, state, key):
        sample, inner = self.inner.estimate(problem, parameters, state.inner, key)
        mean = trees.map(lambda m, g: self.decay * m + (1 - self.decay) * g, state.mean, sample.gradient)
        steps = state.steps + 1
        gradient = {name: m * arrays.scalar(1 / (1 - self.decay**steps), m) for name, m in mean.items()}
        arrays.evaluate(gradient, mean)
        return Estimate(sample.loss, gradient, info=sample.info), AveragedState(inner, mean, steps)
