"""The protocol of optimizers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from typing import Any, Protocol, runtime_checkable

from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.preconditioners.mesh import MeshTopology


class Optimizer(Protocol):
    """Computes steps from estimates. Immutable; all that changes is in the state."""

    @property
    def requires(self) -> AbstractSet[str]:
        """What the estimator must provide: `Capabilities` of types, e.g. `Capabilities(Gradient, Variance)`; reads as a set of names."""
        ...

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> Any:
        """The state before the first step: a dataclass of arrays.

        `learning_rates` holds the parameters that have their own; the others take the optimizer's.
        """
        ...

    def update(self, estimate: Estimate, state: Any, parameters: Tree) -> tuple[Tree, Any]:
        """The steps to add to the parameters, and the next state."""
        ...


@runtime_checkable
class OnMeshes(Protocol):
    """An optimizer that has preconditioners which need to know the neighbours of a parameter's elements."""

    def on_meshes(
        self, topology: Callable[[str], MeshTopology | None], repeated: Callable[[str], int] | None = None
    ) -> Optimizer:
        """Return the same for a problem's parameters.

        Args:
            topology: returns the mesh of a parameter; None for what has none.
            repeated: returns the number of outer columns that repeat those of the opposite end; None where no parameter has any.
        """
        ...


@runtime_checkable
class Measuring(Protocol):
    """An optimizer that measures how far noise moves its result."""

    def standard_errors(self, state: Any, parameters: Tree) -> Tree:
        """Return the standard error of each element, {key: array} of the shapes of `parameters`, by the coordinates of the descent.

        Parameters without one are left out.
        """
        ...


@runtime_checkable
class Choosing(Protocol):
    """An optimizer that finds settings of its own as it goes."""

    def choices(self, state: Any) -> tuple[str, ...]:
        """What it has chosen so far, a line each, for people."""
        ...
