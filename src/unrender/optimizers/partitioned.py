"""Two optimizers: for disjoint sets of parameters, or in succession."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from unrender.core import checks, trees
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.text import listed
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import (
    AtBounds,
    BlockEstimate,
    Capabilities,
    Capability,
    FreshGradient,
    Gradient,
    Smoothing,
)
from unrender.optimizers.averaged_newton import AveragedNewton
from unrender.optimizers.base import Choosing, Optimizer, Settling, averaged_by
from unrender.optimizers.recipes import Adam, ScheduleFree
from unrender.optimizers.transforms.base import checked_keys
from unrender.scene.upsampling import Upsampler, restarted, upsampled


@dataclass(frozen=True)
class PartitionedState:
    """State between steps: that of the optimizer of `keys`, and that of the others."""

    own: Any
    others: Any

    def upsampled(self, upsampler: Upsampler) -> PartitionedState:
        return PartitionedState(upsampled(self.own, upsampler), upsampled(self.others, upsampler))

    def restarted(self, fresh: PartitionedState) -> PartitionedState:
        return PartitionedState(restarted(self.own, fresh.own), restarted(self.others, fresh.others))


@register
@dataclass(frozen=True)
class Partitioned:
    """One optimizer for the parameters in `keys` and another for the rest, such as vertices of a mesh and its texture.

        Partitioned(("vase.vertex_positions",), Adam(0.01, uniform=True), ScheduleFree(0.1))

    Or a few scalars by `AveragedNewton` together with textures, from an estimator that provides a separate block for the scalars
    (`HybridGradient` with `GaussNewton`). In steps without a block the scalars do not change.

    Args:
        keys: parameters of the block, by key.
        optimizer: optimizer of `keys`. One that requires more than the gradient uses the block of these keys (`BlockEstimate`).
        others: optimizer of all other parameters; it may require the gradient only.
    """

    keys: tuple[str, ...] = ()
    optimizer: Optimizer = field(default_factory=lambda: Adam(uniform=True))
    others: Optimizer = field(default_factory=Adam)

    def __post_init__(self):
        checks.fields(self)
        object.__setattr__(self, "keys", checked_keys("Partitioned: keys", self.keys))
        if self.others.requires != Capabilities(Gradient):
            kind = type(self.others).__name__
            raise InputError(
                f"Partitioned: others: expected one that requires the gradient alone, such as Adam, got {kind}"
            )

    @property
    def requires(self) -> Capabilities:
        """A gradient, and a block if the optimizer requires more."""
        return Capabilities(Gradient, BlockEstimate) if self._solves_block else Capabilities(Gradient)

    @property
    def _solves_block(self) -> bool:
        return self.optimizer.requires != Capabilities(Gradient)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> PartitionedState:
        """Return the state before the first step. Raises `InputError` for an unknown key."""
        for key in self.keys:
            if key not in parameters:
                raise InputError(f'Partitioned: keys: unknown parameter "{key}"')
        own, others = self._parts(parameters)
        rates_own, rates_others = self._parts(learning_rates or {})
        return PartitionedState(self.optimizer.init(own, rates_own), self.others.init(others, rates_others))

    def update(self, estimate: Estimate, state: PartitionedState, parameters: Tree) -> tuple[Tree, PartitionedState]:
        points, gradients = self._parts(parameters), self._parts(estimate.gradient)
        steps, states = {}, []
        for part, before, point, gradient in zip(
            (self.optimizer, self.others), (state.own, state.others), points, gradients, strict=True
        ):
            own_parts = (_part(capability, gradient) for capability in estimate.capabilities)
            own = replace(estimate, gradient=gradient, capabilities=tuple(filter(None, own_parts)))
            if self._solves_block and part is self.optimizer:
                block = estimate.require("Partitioned", BlockEstimate)
                if set(block.keys) != set(self.keys):
                    raise InputError(
                        f"Partitioned: the estimate's block is of {listed(block.keys)}, not of {listed(self.keys)}"
                    )
                own = block.estimate
            part_steps, after = (trees.zeros_like(point), before) if own is None else part.update(own, before, point)
            steps |= part_steps
            states.append(after)
        return {key: steps[key] for key in parameters}, PartitionedState(*states)

    def restarted(self, state: PartitionedState, fresh: PartitionedState, keys: Iterable[str]) -> PartitionedState:
        """Return a state in which those of the two states restart that belong to one of these parameters."""
        own, others = self._parts(dict.fromkeys(keys))
        return PartitionedState(
            restarted(state.own, fresh.own) if own else state.own,
            restarted(state.others, fresh.others) if others else state.others,
        )

    def averages(self, keys: Iterable[str], state: PartitionedState | None = None) -> frozenset[str]:
        all_keys = frozenset(keys)
        return averaged_by(self.optimizer, all_keys.intersection(self.keys)) | averaged_by(
            self.others, all_keys.difference(self.keys)
        )

    def unsettled(self, state: PartitionedState, parameters: Tree) -> frozenset[str]:
        """Return those of both optimizers."""
        both = zip((self.optimizer, self.others), (state.own, state.others), self._parts(parameters), strict=True)
        return frozenset().union(*(part.unsettled(*of) for part, *of in both if isinstance(part, Settling)))

    def choices(self, state: PartitionedState) -> tuple[str, ...]:
        both = ((self.optimizer, state.own), (self.others, state.others))
        return tuple(line for part, of in both if isinstance(part, Choosing) for line in part.choices(of))

    def _parts(self, tree: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        own = {key: value for key, value in tree.items() if key in self.keys}
        return own, {key: value for key, value in tree.items() if key not in self.keys}


def _part(capability: Capability, keys: Collection[str]) -> Capability | None:
    """Return a capability for some of the parameters; None for one that is left out."""
    match capability:
        case FreshGradient(values):
            return FreshGradient({key: values[key] for key in keys})
        case Smoothing(sigma):
            return Smoothing({key: sigma[key] for key in keys})
        case AtBounds(sides):
            return AtBounds(lambda: {key: side for key, side in sides().items() if key in keys})
    return None


@dataclass(frozen=True)
class SuccessiveState:
    """State between steps: those of both optimizers, and whether the second one has taken a step."""

    first: Any
    then: Any
    changed: bool = False

    def upsampled(self, upsampler: Upsampler) -> SuccessiveState:
        return SuccessiveState(upsampled(self.first, upsampler), upsampled(self.then, upsampler), self.changed)


@register
@dataclass(frozen=True)
class Successive(checks.Checked):
    """Steps of one optimizer for estimates without a block, and of another one for blocks of all parameters (`PathThenNewton`).

    Args:
        first: optimizer that requires the gradient only.
        then: optimizer of the blocks.
    """

    first: Optimizer = field(default_factory=ScheduleFree)
    then: AveragedNewton = field(default_factory=AveragedNewton)

    requires = Capabilities(Gradient, BlockEstimate)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> SuccessiveState:
        """Return the state before the first step. Raises `InputError` as both optimizers do."""
        return SuccessiveState(self.first.init(parameters, learning_rates), self.then.init(parameters))

    def update(self, estimate: Estimate, state: SuccessiveState, parameters: Tree) -> tuple[Tree, SuccessiveState]:
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

    def unsettled(self, state: SuccessiveState, parameters: Tree) -> frozenset[str]:
        """Return those of the second optimizer, after its first step."""
        return self.then.unsettled(state.then, parameters) if state.changed else frozenset()

    def choices(self, state: SuccessiveState) -> tuple[str, ...]:
        return self.first.choices(state.first) if isinstance(self.first, Choosing) else ()
