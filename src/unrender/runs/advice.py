"""Warnings about implausible settings, before the first step."""

from __future__ import annotations

from unrender.optimizers import rates
from unrender.optimizers.adam import Adam
from unrender.optimizers.base import Optimizer
from unrender.optimizers.meta_adam import MetaAdam
from unrender.scene.problem import Problem

_LARGEST_STEP = 0.5
"""Fraction of a bounded parameter's range: a longer first step always ends at a bound."""


def remarks(problem: Problem, optimizer: Optimizer) -> list[str]:
    """Return one line for each parameter whose first step crosses at least half of its range.

    Adam's steps are about as long as the learning rate, in units of the parameter, whatever the scale of the loss.
    """
    if not isinstance(optimizer, (Adam, MetaAdam)):
        return []
    lines = []
    each = rates.per_parameter(
        type(optimizer).__name__, problem.unknowns, optimizer.learning_rate, problem.learning_rates
    )
    for key, unknown in problem.unknowns.items():
        rate, (low, high) = each[key], unknown.bounds
        if unknown.transform is None and low is not None and high is not None and rate >= _LARGEST_STEP * (high - low):
            lines.append(
                f"parameter {key}: a learning_rate of {rate:g} crosses its range, {low:g} to {high:g}, in "
                f"{_steps((high - low) / rate)}; 0.005 to 0.05 of the range are usual"
            )
    return lines


def _steps(number: float) -> str:
    return "one step" if number <= 1 else f"{number:.2g} steps"
