from dataclasses import dataclass, field
from typing import Any

import unrender as ur
from unrender.core import checks
from unrender.pixels.base import MiniBatch, PixelSampler


@dataclass(frozen=True)
class AlternatingState:
    """State between steps: the inner sampler's, and how many steps were made."""

    inner: Any
    step: int = 0


@ur.register
@dataclass(frozen=True)
class Alternating(PixelSampler):
    """All pixels every `every`-th step, those of another sampler in between. Unbiased as that one is.

    Args:
        inner: draws pixels.
        every: >= 1.
    """

    inner: PixelSampler = field(default_factory=lambda: ur.pixels.Uniform(1024))
    every: int = 10

    def __post_init__(self):
        checks.integer("Alternating", "every", self.every, at_least=1)

    def init(self, problem, parameters):
        return AlternatingState(self.inner.init(problem, parameters))

    def draw(self, problem, parameters, state, key):
        if state.step % self.every == 0:
            return MiniBatch(None), AlternatingState(state.inner, state.step + 1)
        batch, inner = self.inner.draw(problem, parameters, state.inner, key)
        return batch, AlternatingState(inner, state.step + 1)

    def observe(self, problem, state, gradient):
        return AlternatingState(self.inner.observe(problem, state.inner, gradient), state.step)
