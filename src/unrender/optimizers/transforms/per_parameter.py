"""Different transforms for different parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.capabilities import Capability
from unrender.optimizers.transforms.base import StepTransform, StepUpdate, checked_keys, checked_transforms
from unrender.scene.upsampling import Upsampler, restarted, upsampled

_TREES = ("learning_rates", "parameters", "gradient", "direction", "factors", "smoothing", "steps")


@dataclass(frozen=True)
class PerParameterState:
    """State of `PerParameter`.

    Attributes:
        own: States of `transforms`.
        others: States of the transforms of all other parameters.
    """

    own: tuple[Any, ...]
    others: tuple[Any, ...]

    def upsampled(self, upsampler: Upsampler) -> PerParameterState:
        """Interpolate each of the states."""
        parts = (tuple(upsampled(state, upsampler) for state in part) for part in (self.own, self.others))
        return PerParameterState(*parts)

    def restarted(self, fresh: PerParameterState) -> PerParameterState:
        """Restart each of the states."""
        pairs = ((self.own, fresh.own), (self.others, fresh.others))
        return PerParameterState(*(tuple(map(restarted, old, new)) for old, new in pairs))


@register
@dataclass(frozen=True)
class PerParameter(StepTransform):
    """Apply some transforms to the parameters in `keys`, and others to the rest.

    Args:
        keys: Keys of parameters.
        transforms: Transforms of these, in order.
        others: Transforms of all others, in order.
    """

    keys: tuple[str, ...] = ()
    transforms: tuple[StepTransform, ...] = ()
    others: tuple[StepTransform, ...] = ()

    def __post_init__(self):
        object.__setattr__(self, "keys", checked_keys("PerParameter: keys", self.keys))
        for name in ("transforms", "others"):
            object.__setattr__(self, name, checked_transforms(f"PerParameter: {name}", getattr(self, name)))

    @property
    def requires(self) -> tuple[type[Capability], ...]:
        """Capabilities that the transforms require."""
        return tuple(kind for part in (*self.transforms, *self.others) for kind in part.requires)

    @property
    def sets_steps(self) -> bool:
        return any(part.sets_steps for part in (*self.transforms, *self.others))

    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> PerParameterState:
        """Return the states before the first step. Raises `InputError` for an unknown key."""
        if unknown := next((key for key in self.keys if key not in parameters), None):
            raise InputError(f'PerParameter: keys: unknown parameter "{unknown}"')
        states = []
        for parts, own in ((self.transforms, True), (self.others, False)):
            values, rates = self._group(parameters, own), self._group(learning_rates, own)
            states.append(tuple(part.init(values, rates) for part in parts))
        return PerParameterState(*states)

    def update(self, update: StepUpdate, state: PerParameterState) -> tuple[StepUpdate, PerParameterState]:
        results, following = [], []
        for parts, before, own in ((self.transforms, state.own, True), (self.others, state.others, False)):
            group, states = self._restricted(update, own), []
            for part, each in zip(parts, before, strict=True):
                group, after = part.update(group, each)
                states.append(after)
            # The groups' common factors may differ after their transforms, so they become factors of the parameters.
            scale = group.factor / group.divisor
            factors = {key: group.factors.get(key, 1.0) * scale for key in group.direction}
            results.append(replace(group, factors=factors))
            following.append(tuple(states))
        own, others = results
        merged: dict[str, Any] = {name: {**getattr(own, name), **getattr(others, name)} for name in _TREES}
        previous = {**(own.previous or {}), **(others.previous or {})}
        complete = previous.keys() == update.direction.keys()
        following_update = replace(update, **merged, factor=1.0, divisor=1.0, previous=previous if complete else None)
        return following_update, PerParameterState(*following)

    def choices(self, state: PerParameterState, made: int) -> tuple[str, ...]:
        pairs = zip((*self.transforms, *self.others), (*state.own, *state.others), strict=True)
        return tuple(line for part, own in pairs for line in part.choices(own, made))

    def _group(self, tree: Mapping[str, Any], own: bool) -> dict[str, Any]:
        return {key: value for key, value in tree.items() if (key in self.keys) == own}

    def _restricted(self, update: StepUpdate, own: bool) -> StepUpdate:
        trees: dict[str, Any] = {name: self._group(getattr(update, name), own) for name in _TREES}
        previous = None if update.previous is None else self._group(update.previous, own)
        return replace(update, **trees, previous=previous)
