"""One optimizer until the estimator provides a block of all parameters, and another one from then on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import BlockEstimate, Capabilities, Gradient
from unrender.optimizers.averaged_newton import AveragedNewton
from unrender.optimizers.base import Choosing, Optimizer, averaged_by
from unrender.optimizers.recipes import ScheduleFree
from unrender.scene.upsampling import Upsampler, upsampled


@dataclass(frozen=True)
class SuccessiveState:
    """State between steps: those of both optimizers, and whether the second one has taken a step."""

    first: Any
    then: Any
    changed: bool = False

    def upsampled(self, upsampler: Upsampler) -> SuccessiveState:
        """Interpolate both states."""
        return SuccessiveState(upsampled(self.first, upsampler), upsampled(self.then, upsampler), self.changed)


@register
@dataclass(frozen=True)
class Successive:
    """Steps of one optimizer for estimates without a block, and of another one for blocks of all parameters (`PathThenNewton`).

    Args:
        first: optimizer that requires the gradient only.
        then: optimizer of the blocks.
    """

    first: Optimizer = field(default_factory=ScheduleFree)
    then: AveragedNewton = field(default_factory=AveragedNewton)

    @property
    def requires(self) -> Capabilities:
        """A gradient, and a block."""
        return Capabilities(Gradient, BlockEstimate)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> SuccessiveState:
        """Return the state before the first step. Raises `InputError` as both optimizers do."""
        return SuccessiveState(self.first.init(parameters, learning_rates), self.then.init(parameters))

    def update(self, estimate: Estimate, state: SuccessiveState, parameters: Tree) -> tuple[Tree, SuccessiveState]:
        """Return the steps and the next state."""
        block = estimate.require("Successive", BlockEstimate).estimate
        if block is None:
            steps, first = self.first.update(estimate, state.first, parameters)
            return steps, SuccessiveState(first, state.then)
        steps, then = self.then.update(block, state.then, parameters)
        return steps, SuccessiveState(state.first, then, True)

    def averages(self, keys: Iterable[str], state: SuccessiveState | None = None) -> frozenset[str]:
        """Return the keys that the optimizer of the last step averages; those of the first one without a state."""
        return averaged_by(self.then if state is not None and state.changed else self.first, keys)

    def standard_errors(self, state: SuccessiveState, parameters: Tree) -> Tree:
        """Return the standard errors of the second optimizer; {} before its first step."""
        return self.then.standard_errors(state.then, parameters) if state.changed else {}

    def choices(self, state: SuccessiveState) -> tuple[str, ...]:
        """Return the choices of the first optimizer, one line each."""
        return self.first.choices(state.first) if isinstance(self.first, Choosing) else ()
