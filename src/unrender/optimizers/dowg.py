"""DoWG (Khaled, Mishchenko and Jin 2023, "DoWG Unleashed"): gradient descent whose rate is found from distances and gradients."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from unrender.core import arrays, checks
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient
from unrender.optimizers import rates
from unrender.problem.upsampling import Upsampler
from unrender.schedules.functions import Schedule

__all__ = ["DoWG", "DoWGState"]


@dataclass(frozen=True)
class DoWGState:
    """State between steps.

    Attributes:
        step: steps made so far.
        start: x_0.
        distance: {key: r, the greatest distance from the start so far}.
        weighted: {key: Σ r² |g|²}.
    """

    step: int
    start: Tree
    distance: dict[str, float]
    weighted: dict[str, float]

    def upsampled(self, upsampler: Upsampler) -> DoWGState:
        """See `Upsamplable`: the start is interpolated; distances grow, and gradients shrink, with the root of the number of elements."""
        more = {key: 1.0 / upsampler.shares.get(key, 1.0) for key in self.distance}
        distance = {key: r * math.sqrt(more[key]) for key, r in self.distance.items()}
        return replace(self, start=upsampler.tree(self.start), distance=distance)

    def restarted(self, fresh: DoWGState) -> DoWGState:
        """See `Restartable`: the schedule goes on."""
        return replace(fresh, step=self.step)


@register
@dataclass(frozen=True)
class DoWG:
    """Steps −(r_t² / √v_t) g_t with r_t = max(r_{t−1}, |x_t − x_0|) and v_t = v_{t−1} + r_t² |g_t|² (Algorithm 1).

    No rate is to be set: r grows to the distance that there is to go, whatever it was at first, within a factor. Norms are Euclidean, of
    each parameter by itself, since parameters differ in their units (the paper has one for all). All elements of a parameter share a
    rate: what the images tell little of moves little, and slowly even where it is not noise.

    Args:
        first: r_0 over the Euclidean norm of the parameter's first values (of ones where that is 0), > 0. Less costs steps, more may be too
            far. A parameter's own learning rate takes its place: it is the root mean square of the first step, in units of the parameter.
        schedule: factor of every rate by step; see `unrender.schedules.functions`.
    """

    first: float = 1e-2
    schedule: Schedule | None = None

    def __post_init__(self):
        checks.number("DoWG", "first", self.first, above=0.0)
        rates.check("DoWG", self.first, self.schedule)

    @property
    def requires(self) -> Capabilities:
        """A gradient."""
        return Capabilities(Gradient)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> DoWGState:
        """See `Optimizer.init`."""
        first = rates.from_sizes("DoWG", parameters, self.first, learning_rates)
        distance = {key: rate * math.sqrt(rates.elements(parameters[key])) for key, rate in first.items()}
        return DoWGState(0, dict(parameters), distance, dict.fromkeys(parameters, 0.0))

    def update(self, estimate: Estimate, state: DoWGState, parameters: Tree) -> tuple[Tree, DoWGState]:
        """See `Optimizer.update`. Waits for the device: two norms of each parameter are read."""
        factor = rates.factor("DoWG", self.schedule, state.step)
        sums = {}
        for key, g in estimate.gradient.items():
            moved = parameters[key] - state.start[key]
            sums[key] = [arrays.total(moved * moved), arrays.total(g * g)]
        arrays.evaluate(sums)
        steps, distance, weighted = {}, {}, {}
        for key, g in estimate.gradient.items():
            moved, square = (arrays.number(part) for part in sums[key])
            distance[key] = max(state.distance[key], math.sqrt(moved))
            weighted[key] = state.weighted[key] + distance[key] ** 2 * square
            rate = distance[key] ** 2 / math.sqrt(weighted[key]) if weighted[key] > 0 else 0.0
            steps[key] = g * arrays.scalar(-rate * factor, g)
        return steps, replace(state, step=state.step + 1, distance=distance, weighted=weighted)
