"""Protocols of optimizers, and their learning rates per parameter."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from typing import Any, Protocol, runtime_checkable

from unrender.core import checks
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean, in_words
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
class Settling(Protocol):
    """An optimizer that knows whether its parameters still move by more than noise."""

    def unsettled(self, state: Any, parameters: Tree) -> frozenset[str]:
        """Return the parameters that do."""
        ...


@runtime_checkable
class Choosing(Protocol):
    """An optimizer that adapts some of its settings."""

    def choices(self, state: Any) -> tuple[str, ...]:
        """Return the settings chosen so far for display, one line each."""
        ...


def check_rates(owner: str, learning_rate: Any, schedule: Any) -> None:
    """Raise `InputError` for an invalid learning rate or schedule.

    `learning_rate` must be a positive number or {key: rate, "*": rate of the others}, and `schedule` a schedule or None.
    """
    if isinstance(learning_rate, Mapping):
        if "*" not in learning_rate:
            raise InputError(f'{owner}: learning_rate needs a rate for the other parameters, {{"*": rate}}')
        for key, rate in learning_rate.items():
            checks.number(owner, "learning_rate" if key == "*" else f"learning_rate of {key}", rate, above=0.0)
    else:
        checks.number(owner, "learning_rate", learning_rate, above=0.0)
    if schedule is not None and not callable(schedule):
        raise InputError(f"{owner}: schedule must be one of unrender.schedules or None, got {in_words(schedule)}")


def rates_of(
    owner: str, keys: Iterable[str], common: float | Mapping[str, float], own: Mapping[str, float] | None
) -> dict[str, float]:
    """Return {key: learning rate}: the parameter's own, else `common`, which may be {key: rate, "*": rate of the others}.

    Raises `InputError` for a rate of an unknown parameter, or one that is not positive.
    """
    keys, own = list(keys), dict(own or {})
    if isinstance(common, Mapping):
        own, common = {key: rate for key, rate in common.items() if key != "*"} | own, common["*"]
    for key, rate in own.items():
        if key not in keys:
            hint = did_you_mean(key, keys)
            raise InputError(f'{owner}: learning rate given for unknown parameter "{key}"{hint}')
        checks.number(owner, f'learning rate of "{key}"', rate, above=0.0)
    return {key: float(own.get(key, common)) for key in keys}
