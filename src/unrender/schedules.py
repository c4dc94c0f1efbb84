"""Schedules: factors of a learning rate or of a smoothing width, as functions of the step.

A schedule is a callable that takes the number of completed steps (>= 0) and returns a factor >= 0. The number may be fractional:
`SmoothedDerivatives(adaptive_annealing=True)` measures progress in other units than steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

from unrender.core import checks
from unrender.core.checks import Count, NotNegative, Positive
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.text import in_words

__all__ = ["Constant", "Cosine", "Exponential", "Inverse", "InverseRoot", "Schedule", "Steps", "Warmup"]


class Schedule(Protocol):
    """A pure function from a step to a factor."""

    def __call__(self, step: float) -> float:
        """Return the factor at `step`, which counts from 0."""
        ...


def schedule_factor(owner: str, schedule: Schedule | None, step: float) -> float:
    """Return the schedule's factor at `step`, 1 without a schedule. Raises `InputError` unless it is a finite number >= 0."""
    value: Any = 1.0 if schedule is None else schedule(step)
    try:
        factor = math.nan if isinstance(value, (str, bytes)) else float(value)
    except (TypeError, ValueError, OverflowError):
        factor = math.nan
    if math.isfinite(factor) and factor >= 0.0:
        return factor
    raise InputError(f"{owner}: schedule must return a finite factor >= 0, got {in_words(value)} at step {step:g}")


@register(position=1)
@dataclass(frozen=True)
class Constant(checks.Checked):
    """The same factor at every step.

    Args:
        factor: the factor, >= 0.
    """

    factor: NotNegative = 1.0

    def __call__(self, step: float) -> float:
        return self.factor


@register(position=2)
@dataclass(frozen=True)
class Exponential(checks.Checked):
    """2^(−step / half_life), but at least `floor`.

    Args:
        half_life: number of steps that halve the factor, > 0.
        floor: smallest factor, >= 0.
    """

    half_life: Positive
    floor: NotNegative = 0.0

    def __call__(self, step: float) -> float:
        return max(self.floor, 0.5 ** (step / self.half_life))


@register(position=3)
@dataclass(frozen=True)
class InverseRoot(checks.Checked):
    """1 / √(1 + step / time), which decreases early and has no end.

    Args:
        time: step at which the factor is 1/√2, > 0.
    """

    time: Positive

    def __call__(self, step: float) -> float:
        return 1.0 / math.sqrt(1.0 + step / self.time)


@register(position=7)
@dataclass(frozen=True)
class Inverse(checks.Checked):
    """1 / (1 + step / time), the rate at which Newton steps average out noise (Robbins and Monro 1951).

    Args:
        time: step at which the factor is 1/2, > 0.
    """

    time: Positive

    def __call__(self, step: float) -> float:
        return 1.0 / (1.0 + step / self.time)


@register(position=4)
@dataclass(frozen=True)
class Cosine(checks.Checked):
    """Half a cosine from 1 at step 0 to `floor` at step `steps`, then constant.

    Args:
        steps: length of the decay, >= 1.
        floor: last factor, >= 0.
    """

    steps: Count
    floor: NotNegative = 0.0

    def __call__(self, step: float) -> float:
        done = min(step / self.steps, 1.0)
        return self.floor + (1.0 - self.floor) * 0.5 * (1.0 + math.cos(math.pi * done))


@register(position=5)
@dataclass(frozen=True)
class Steps(checks.Checked):
    """`factor` to the power of the integer part of step / `every`.

    A factor above 1 overflows to infinity in the end, which optimizers refuse.

    Args:
        every: number of steps, >= 1.
        factor: factor, > 0, usually below 1.
    """

    every: Count
    factor: Positive = 0.5

    def __call__(self, step: float) -> float:
        try:
            return float(self.factor) ** (step // self.every)
        except OverflowError:
            return math.inf


@register(position=6)
@dataclass(frozen=True)
class Warmup(checks.Checked):
    """A linear increase over the first `steps` steps, 1/steps, 2/steps … 1, followed by another schedule from its step 0.

    Args:
        steps: length of the increase, >= 1.
        then: the following schedule; None stays at 1.
    """

    steps: Count
    then: Schedule | None = None

    def __call__(self, step: float) -> float:
        if step < self.steps:
            return min((step + 1) / self.steps, 1.0)
        return 1.0 if self.then is None else self.then(step - self.steps)
