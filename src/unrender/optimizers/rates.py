"""Learning rates per parameter, and their schedule."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from unrender.core import checks
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean
from unrender.schedules import Schedule


def check(owner: str, learning_rate: Any, schedule: Any) -> None:
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
        raise InputError(f"{owner}: schedule must be one of unrender.schedules or None, got {schedule!r}")


def per_parameter(
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


def factor(owner: str, schedule: Schedule | None, step: int) -> float:
    """Return the schedule's factor at `step`. Raises `InputError` if it is negative or not finite."""
    value = 1.0 if schedule is None else float(schedule(step))
    if not (math.isfinite(value) and value >= 0.0):
        raise InputError(f"{owner}: schedule must return a finite factor >= 0, got {value!r} at step {step}")
    return value
