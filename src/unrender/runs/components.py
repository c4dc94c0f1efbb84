"""Resolution of the estimator and optimizer arguments: components, plans, or a method's name."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from unrender.core.errors import InputError
from unrender.core.text import did_you_mean
from unrender.estimators.base import Estimator
from unrender.methods import method, methods
from unrender.methods.plan import Plan
from unrender.scene.problem import Problem


def resolve(problem: Problem, estimator: Any, optimizer: Any) -> Plan:
    """Return the plan of a method's name, of two components, or a plan unchanged.

    Args:
        problem: problem for which a method chooses its parts.
        estimator: an estimator, a `Plan`, or the name of a method, which includes its optimizer.
        optimizer: an optimizer; None for the method's.

    Raises:
        InputError: an argument is missing or of another kind, such as an optimizer of Mitsuba or PyTorch, or a class instead of an
            object.
    """
    if optimizer is None and isinstance(estimator, Plan):
        return replace(estimator, problem=problem)
    if optimizer is None and isinstance(estimator, str):
        return method(estimator).plan(problem)
    chosen = resolve_estimator(problem, estimator)
    if optimizer is None:
        raise InputError(
            "optimize: give an optimizer, such as unrender.optimizers.Adam(learning_rate=0.01), or a method's name in place of both"
        )
    if not _is_component(optimizer, "requires", "init", "update"):
        raise InputError(f"optimize: optimizer: {_instead_of_optimizer(optimizer)}")
    return Plan(problem, chosen, optimizer)


def resolve_estimator(problem: Problem, estimator: Any, owner: str = "optimize") -> Estimator:
    """Return an estimator, from itself or a method's name. Raises `InputError` for anything else."""
    if isinstance(estimator, str):
        return method(estimator).plan(problem).estimator
    if not _is_component(estimator, "provides", "init", "estimate"):
        names = ", ".join(methods())
        raise InputError(
            f"{owner}: expected an estimator, such as unrender.PathGradient(spp=4), or the name of a method ({names}), "
            f"got {_shown(estimator)}"
        )
    return estimator


def _is_component(value: Any, *members: str) -> bool:
    return not isinstance(value, type) and all(
        callable(getattr(type(value), m, None)) or hasattr(value, m) for m in members
    )


def _instead_of_optimizer(value: Any) -> str:
    """Return what is wrong with an invalid optimizer, and what is expected."""
    from unrender import optimizers

    kind = value if isinstance(value, type) else type(value)
    known = {name: getattr(optimizers, name) for name in optimizers.__all__}
    package = kind.__module__.partition(".")[0]
    if isinstance(value, type) and value in known.values():
        return f"expected an object, got the class {value.__name__}; write {value.__name__}()"
    if package in ("mitsuba", "drjit", "torch"):
        owner = {"mitsuba": "Mitsuba", "drjit": "Dr.Jit", "torch": "PyTorch"}[package]
        same = kind.__name__ if kind.__name__ in known else "Adam"
        return f"{owner}'s {kind.__name__} updates parameters of its own; expected unrender.optimizers.{same}(learning_rate=...)"
    expected = "expected one of unrender.optimizers, such as Adam(learning_rate=0.01)"
    hint = did_you_mean(value, known) if isinstance(value, str) else ""
    return f"{expected}, got {_shown(value)}{hint}"


def _shown(value: Any) -> str:
    return f"the class {value.__name__}" if isinstance(value, type) else repr(value)[:80]
