"""Prodigy (Mishchenko and Defazio 2024): Adam whose rate is an estimate of the distance to go."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from unrender.core import arrays, checks, trees
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient
from unrender.optimizers import rates
from unrender.problem.upsampling import SQUARES, Upsampler
from unrender.schedules.functions import Schedule

__all__ = ["Prodigy", "ProdigyState"]


@dataclass(frozen=True)
class ProdigyState:
    """State between steps.

    Attributes:
        step: steps made so far.
        start: x_0.
        first_moment, second_moment: m and v of the docstring.
        weighted: s, the weighted sum of gradients.
        descent: {key: r, the weighted sum of their products with the way back to the start}.
        distance: {key: d}.
    """

    step: int
    start: Tree
    first_moment: Tree
    second_moment: Tree
    weighted: Tree
    descent: dict[str, float]
    distance: dict[str, float]

    def upsampled(self, upsampler: Upsampler) -> ProdigyState:
        """See `Upsamplable`: start and moments are interpolated; r, a sum over elements, stays as it is."""
        return replace(
            self,
            start=upsampler.tree(self.start),
            first_moment=upsampler.tree(self.first_moment, 1.0),
            second_moment=upsampler.tree(self.second_moment, SQUARES),
            weighted=upsampler.tree(self.weighted, 1.0),
        )

    def restarted(self, fresh: ProdigyState) -> ProdigyState:
        """See `Restartable`: the schedule and the distances found go on."""
        return replace(fresh, step=self.step, distance=self.distance)


@register
@dataclass(frozen=True)
class Prodigy:
    """Steps −γ d m / (√v + d ε), where d grows to the distance that there is to go (Algorithm 4):

        m ← β_1 m + (1 − β_1) d g,   v ← β_2 v + (1 − β_2) d² g²,
        r ← √β_2 r + (1 − √β_2) γ d² ⟨g, x_0 − x⟩,   s ← √β_2 s + (1 − √β_2) γ d² g,   d ← max(d, r / |s|_1)

    No rate is to be set. Each parameter has a d of its own, since parameters differ in their units (the paper has one for all): it bounds
    the largest change of an element from below as far as the loss is convex and gradients have no noise. d never falls: against the noise
    at the end a schedule is needed, which the paper recommends too, and which has to know the number of steps.

    Args:
        first: d_0 over the root mean square of the parameter's first values (1 where that is 0), > 0. Less costs steps, more may be too
            far. A parameter's own learning rate takes the place of its d_0.
        beta_1: decay of m, in [0, 1).
        beta_2: decay of v, in [0, 1); its root is that of r and s.
        epsilon: ε, in units of the gradient, > 0.
        factor: γ, > 0.
        schedule: factor of γ by step; see `unrender.schedules.functions`.
    """

    first: float = 1e-3
    beta_1: float = 0.9
    beta_2: float = 0.999
    epsilon: float = 1e-8
    factor: float = 1.0
    schedule: Schedule | None = None

    def __post_init__(self):
        checks.number("Prodigy", "first", self.first, above=0.0)
        rates.check("Prodigy", self.first, self.schedule)
        checks.number("Prodigy", "beta_1", self.beta_1, above=0.0, below=1.0, inclusive=True)
        checks.number("Prodigy", "beta_2", self.beta_2, above=0.0, below=1.0, inclusive=True)
        checks.number("Prodigy", "epsilon", self.epsilon, above=0.0)
        checks.number("Prodigy", "factor", self.factor, above=0.0)

    @property
    def requires(self) -> Capabilities:
        """A gradient."""
        return Capabilities(Gradient)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> ProdigyState:
        """See `Optimizer.init`."""
        first = rates.from_sizes("Prodigy", parameters, self.first, learning_rates)
        zeros = trees.zeros_like(parameters)
        return ProdigyState(0, dict(parameters), zeros, zeros, zeros, dict.fromkeys(parameters, 0.0), first)

    def update(self, estimate: Estimate, state: ProdigyState, parameters: Tree) -> tuple[Tree, ProdigyState]:
        """See `Optimizer.update`. Waits for the device: two sums over each parameter are read."""
        γ = self.factor * rates.factor("Prodigy", self.schedule, state.step)
        β, root = self.beta_1, math.sqrt(self.beta_2)
        steps: Tree = {}
        first: Tree = {}
        second: Tree = {}
        weighted: Tree = {}
        sums = {}
        for key, g in estimate.gradient.items():
            d = arrays.scalar(state.distance[key], g)
            first[key] = β * state.first_moment[key] + (1.0 - β) * (d * g)
            second[key] = self.beta_2 * state.second_moment[key] + (1.0 - self.beta_2) * (d * g) * (d * g)
            rate = arrays.scalar(γ * state.distance[key] ** 2 * (1.0 - root), g)
            weighted[key] = root * state.weighted[key] + rate * g
            sums[key] = [
                arrays.total(g * (state.start[key] - parameters[key])),
                arrays.total(arrays.absolute(weighted[key])),
            ]
            steps[key] = arrays.scalar(-γ, g) * d * first[key] / (arrays.sqrt(second[key]) + d * self.epsilon)
        arrays.evaluate(sums, weighted)
        descent, distance = {}, {}
        for key, parts in sums.items():
            product, length = (arrays.number(part) for part in parts)
            d = state.distance[key]
            descent[key] = root * state.descent[key] + (1.0 - root) * γ * d * d * product
            distance[key] = max(d, descent[key] / length) if length > 0 else d
        following = replace(
            state,
            step=state.step + 1,
            first_moment=first,
            second_moment=second,
            weighted=weighted,
            descent=descent,
            distance=distance,
        )
        return steps, following
