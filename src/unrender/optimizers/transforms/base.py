"""Base class of step transforms: parts of a step with their own state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.text import in_words
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capability
from unrender.preconditioners.base import Preconditioner
from unrender.scene.upsampling import SQUARES, Upsampler


@dataclass(frozen=True)
class SmoothingChange:
    """Preconditioning of one parameter's gradient at this step.

    Attributes:
        preconditioner: S; None for the identity.
        gain: |S g|² relative to the smoothing of the last step; 1 if it is unchanged.
        level: |S g|² if the smoothing has changed; 0 otherwise.
        confirmed: Fraction of the agreement of successive gradients that independent samples confirm, in (0, 1].
        lasting: Fraction of that agreement that gradients of much later steps confirm, in (0, 1].
        inflation: Variance of the sum of many steps' noise, relative to that of independent noise of the same size, >= 1.
        growth: Factor of the learning rate, because gradients of much later steps agree, >= 1.
        vertices: Number of mesh vertices that carry the parameter; 0 for textures, grids and numbers.
        held: Mask of the elements that stay at their bounds; None for none.
    """

    preconditioner: Preconditioner | None = None
    gain: float = 1.0
    level: float = 0.0
    confirmed: float = 1.0
    lasting: float = 1.0
    inflation: float = 1.0
    growth: float = 1.0
    vertices: int = 0
    held: Array | None = None

    def smoothed(self, x: Array) -> Array:
        """Return P S P x, where P sets elements that stay at their bounds to 0."""
        for part in (None, self.preconditioner):
            x = x if part is None else part.apply(x)
            x = x if self.held is None else arrays.where(self.held, 0.0 * x, x)
        return x


SMOOTHING_UNCHANGED = SmoothingChange()


@dataclass(frozen=True)
class StepUpdate:
    """Data that passes through a chain: the gradient at first, the steps at last.

    The step of a parameter is −η f q direction / divisor, with its learning rate η, the common factor f, and its own factor q. A
    transform may set `steps` instead.

    Attributes:
        parameters: Current values, {key: array}.
        made: Number of previous steps of the chain.
        learning_rates: {key: η}, in units of the parameter.
        gradient: Gradient with the preconditioning so far.
        direction: Ascent direction with the transforms so far; initially the gradient.
        factor: f, factor of every learning rate.
        factors: {key: q}; 1 for missing keys.
        divisor: Sum of weights, if `direction` is a mean that starts at zero.
        previous: Preconditioned gradient of the last step; zeros at the first step, None if no transform stores it.
        smoothing: {key: preconditioning of its gradient}.
        restarted: Keys of parameters whose iterate restarts at its average before the step.
        steps: {key: step}, set by a transform with its own iterates.
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
    restarted: frozenset[str] = frozenset()
    steps: Tree = field(default_factory=dict)

    def rate(self, key: str) -> float:
        """Return η f q / divisor."""
        return self.learning_rates[key] * (self.factor / self.divisor) * self.factors.get(key, 1.0)

    def require_previous(self, owner: str) -> Tree:
        """Return `previous`. Raise `InputError` if no earlier transform stores it."""
        if self.previous is None:
            raise InputError(f"{owner}: no transform before it stores the last gradient; put FittedSobolev first")
        return self.previous


class StepTransform(ABC):
    """Part of a step. Immutable; everything that changes is in its state.

    Subclasses are registered. `unrender.optimizers.Chain` applies transforms in sequence.
    """

    requires: ClassVar[tuple[type[Capability], ...]] = ()
    """Capabilities that the estimate must have in addition to the gradient."""
    sets_steps: ClassVar[bool] = False
    """Whether `update` sets `StepUpdate.steps`. Later transforms cannot change these."""

    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> Any:
        """Return the state before the first step: a frozen dataclass of arrays; None by default.

        Args:
            parameters: Initial values, {key: array}.
            learning_rates: {key: η}, in units of the parameter.
        """
        return None

    @abstractmethod
    def update(self, update: StepUpdate, state: Any) -> tuple[StepUpdate, Any]:
        """Return the transformed update and the next state."""
        ...

    def choices(self, state: Any, made: int) -> tuple[str, ...]:
        """Return the choices of the transform after `made` steps for display, one line each."""
        return ()


VALUES: Mapping[str, float] = {"power": 0.0}
"""Metadata of a state's field {key: array} that contains values of parameters."""
GRADIENTS: Mapping[str, float] = {"power": 1.0}
"""Metadata of a field that contains gradients."""
MEAN_SQUARES: Mapping[str, float] = {"power": SQUARES}
"""Metadata of a field that contains mean squares of gradients."""


@dataclass(frozen=True)
class TransformState:
    """State whose fields declare in metadata how a finer resolution scales them: `VALUES`, `GRADIENTS` or `MEAN_SQUARES`."""

    def upsampled(self, upsampler: Upsampler) -> Any:
        powers = {each.name: each.metadata["power"] for each in fields(self) if "power" in each.metadata}
        return replace(self, **{name: upsampler.tree(getattr(self, name), power) for name, power in powers.items()})


def without(gradient: Tree, held: Tree) -> Tree:
    """Return a gradient with 0 for the elements that stay at their bounds."""
    return {key: arrays.where(held[key], 0.0 * g, g) if key in held else g for key, g in gradient.items()}


def checked_keys(owner: str, keys: Any) -> tuple[str, ...]:
    """Return keys of parameters as a tuple. Raise `InputError` for anything else."""
    names: tuple[Any, ...] = tuple(keys) if isinstance(keys, Iterable) and not isinstance(keys, str) else (None,)
    if not all(isinstance(name, str) for name in names):
        raise InputError(f"{owner} must be keys of parameters, got {in_words(keys)}")
    return names


def checked_transforms(owner: str, parts: Any) -> tuple[StepTransform, ...]:
    """Return transforms as a tuple. Raise `InputError` for anything else, or if one before the last sets the steps."""
    if not isinstance(parts, (list, tuple)):
        raise InputError(f"{owner}: expected a list of transforms such as ScaleByRms(), got {in_words(parts)}")
    if wrong := [part for part in parts if not isinstance(part, StepTransform)]:
        raise InputError(f"{owner}: expected transforms such as ScaleByRms(), got {in_words(wrong[0])}")
    if early := [type(part).__name__ for part in parts[:-1] if part.sets_steps]:
        raise InputError(f"{owner}: {early[0]} sets the steps, so later transforms have no effect; put it last")
    return tuple(parts)
