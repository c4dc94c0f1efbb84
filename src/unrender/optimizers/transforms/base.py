"""What a transform is: one part of a step, with a state of its own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capability
from unrender.preconditioners.base import Preconditioner
from unrender.scene.upsampling import SQUARES, Upsampler


@dataclass(frozen=True)
class SmoothingChange:
    """How the gradient of one parameter is preconditioned at this step.

    Attributes:
        preconditioner: S; None for the identity.
        gain: |S g|² over that with the smoothing of the last step; 1 where the smoothing has not changed.
        level: |S g|² where the smoothing has changed; 0 elsewhere.
        confirmed: Share of the agreement of successive gradients that fresh samples confirm, in (0, 1].
        vertices: Vertices of the mesh whose values these are; 0 for textures, grids and single numbers.
    """

    preconditioner: Preconditioner | None = None
    gain: float = 1.0
    level: float = 0.0
    confirmed: float = 1.0
    vertices: int = 0


SMOOTHING_UNCHANGED = SmoothingChange()


@dataclass(frozen=True)
class StepUpdate:
    """What flows through a chain: at first the gradient, at last the steps.

    The step of a parameter is −η f q direction / divisor with its learning rate η, `factor` f and its own q of `factors`. A transform may
    set `steps` instead.

    Attributes:
        estimate: Estimate of this step.
        parameters: Current values, {key: array}.
        made: Steps that the chain has made before this one.
        learning_rates: {key: η}, in units of the parameter.
        gradient: Gradient as preconditioned so far.
        direction: Ascent direction as transformed so far; the gradient at first.
        factor: Factor of every learning rate.
        factors: {key: factor of this learning rate}; 1 for keys that are missing.
        divisor: Sum of weights of a mean that `direction` is, which starts at zero.
        previous: Preconditioned gradient of the last step; zeros at the first step, None where no transform remembers it.
        smoothing: {key: how its gradient is preconditioned}.
        steps: {key: step}, set by a transform that has iterates of its own.
    """

    estimate: Estimate
    parameters: Tree
    made: int
    learning_rates: Mapping[str, float]
    gradient: Tree
    direction: Tree
    factor: float = 1.0
    factors: Mapping[str, float] = field(default_factory=dict)
    divisor: float = 1.0
    previous: Tree | None = None
    smoothing: Mapping[str, SmoothingChange] = field(default_factory=dict)
    steps: Tree = field(default_factory=dict)

    def rate(self, key: str) -> float:
        """Return η f q / divisor."""
        return self.learning_rates[key] * (self.factor / self.divisor) * self.factors.get(key, 1.0)

    def require_previous(self, owner: str) -> Tree:
        """Return `previous`. Raise `InputError` where no earlier transform remembers it."""
        if self.previous is None:
            raise InputError(f"{owner}: no transform before it remembers the last gradient; put FittedSobolev first")
        return self.previous


class StepTransform(ABC):
    """One part of a step. Immutable; everything that changes is in its state.

    A class inherits from this one and is registered. `unrender.optimizers.Chain` applies transforms one after the other.
    """

    @property
    def requires(self) -> tuple[type[Capability], ...]:
        """Capabilities that the estimate must have, besides the gradient."""
        return ()

    @abstractmethod
    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> Any:
        """Return the state before the first step: a frozen dataclass of arrays, or None.

        Args:
            parameters: Initial values, {key: array}.
            learning_rates: {key: η}, in units of the parameter.
        """
        ...

    @abstractmethod
    def update(self, update: StepUpdate, state: Any) -> tuple[StepUpdate, Any]:
        """Return the transformed update and the next state."""
        ...

    def choices(self, state: Any, made: int) -> tuple[str, ...]:
        """Return what the transform has chosen in `made` steps, a line each, for people."""
        del state, made
        return ()


VALUES: Mapping[str, float] = {"power": 0.0}
"""Metadata of a state's field {key: array} that holds values of parameters."""
GRADIENTS: Mapping[str, float] = {"power": 1.0}
"""Metadata of a field that holds gradients."""
MEAN_SQUARES: Mapping[str, float] = {"power": SQUARES}
"""Metadata of a field that holds mean squares of gradients."""


@dataclass(frozen=True)
class TransformState:
    """A state whose fields declare by metadata what a finer resolution makes of them: `VALUES`, `GRADIENTS` or `MEAN_SQUARES`."""

    def upsampled(self, upsampler: Upsampler) -> Any:
        """See `Upsamplable`."""
        powers = {each.name: each.metadata["power"] for each in fields(self) if "power" in each.metadata}
        return replace(self, **{name: upsampler.tree(getattr(self, name), power) for name, power in powers.items()})


def checked_keys(owner: str, keys: Any) -> tuple[str, ...]:
    """Return keys of parameters as a tuple. Raise `InputError` for anything else."""
    if isinstance(keys, str) or not all(isinstance(key, str) for key in keys):
        raise InputError(f"{owner} must be keys of parameters, got {keys!r}")
    return tuple(keys)


def checked_transforms(owner: str, parts: Any) -> tuple[StepTransform, ...]:
    """Return transforms as a tuple. Raise `InputError` for anything else."""
    if not isinstance(parts, (list, tuple)):
        raise InputError(f"{owner}: expected a list of transforms such as ScaleByRms(), got {parts!r:.80}")
    if wrong := [part for part in parts if not isinstance(part, StepTransform)]:
        raise InputError(f"{owner}: expected transforms such as ScaleByRms(), got {wrong[0]!r:.80}")
    return tuple(parts)
