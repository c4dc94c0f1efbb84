"""Protocols of optimizers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from typing import Any, Protocol, runtime_checkable

from unrender.core.trees import Tree
from unrender.estimators.base import Estimate


class Optimizer(Protocol):
    """Immutable optimizer, which computes steps from estimates. Everything that changes is in the state."""

    @property
    def requires(self) -> AbstractSet[str]:
        """Capabilities that the estimator must provide, e.g. `Capabilities(Gradient, Variance)`; also a set of names."""
        ...

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> Any:
        """Return the state before the first step, a dataclass of arrays.

        `learning_rates` contains the parameters with their own rates; the others use the optimizer's.
        """
        ...

    def update(self, estimate: Estimate, state: Any, parameters: Tree) -> tuple[Tree, Any]:
        """Return the steps to add to the parameters, and the next state."""
        ...


@runtime_checkable
class Measuring(Protocol):
    """An optimizer that estimates the standard errors of its result from noise."""

    def standard_errors(self, state: Any, parameters: Tree) -> Tree:
        """Return the standard error of each element, {key: array} with the shapes of `parameters`, in the coordinates of the
        optimisation.

        Parameters without an estimate are omitted.
        """
        ...


@runtime_checkable
class Averaging(Protocol):
    """An optimizer whose steps lead some parameters to a mean over all steps."""

    def averages(self, keys: Iterable[str], state: Any = None) -> frozenset[str]:
        """Return those of these parameters that it averages, in this state if it is known."""
        ...


def averaged_by(optimizer: Optimizer, keys: Iterable[str], state: Any = None) -> frozenset[str]:
    """Return the parameters that the optimizer averages itself, in this state if it is known."""
    return optimizer.averages(keys, state) if isinstance(optimizer, Averaging) else frozenset()


@runtime_checkable
class Choosing(Protocol):
    """An optimizer that adapts some of its settings."""

    def choices(self, state: Any) -> tuple[str, ...]:
        """Return the settings chosen so far for display, one line each."""
        ...
