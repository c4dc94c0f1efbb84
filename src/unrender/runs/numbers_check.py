"""Result of the least-squares test of numbers at the end of a run."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np

from unrender.core.text import listed
from unrender.runs.field_directions import TOO_SHORT

_CLEAR = 3.0
"""Length of a step over its noise from which it counts as a distance, if the run states its own error."""


@dataclass(frozen=True)
class NumbersCheck:
    """Result of the least-squares test of the numbers of a run.

    Attributes:
        undetermined: {key: line} of the numbers that the references leave open.
        unfinished: {key: line} of those that a least-squares step would still move.
        errors: {key: standard errors} of all numbers but the unchecked ones, the references' noise included.
        steps: {key: least-squares steps} of all numbers.
        noise: {key: standard errors of the steps by the noise of this check}.
        unchecked: keys of the numbers whose standard errors are unknown.
        blind: keys of the numbers whose influence on the pictures is hidden by the noise of this check.
        elsewhere: keys of the numbers that only other views show than the tested ones.
        fixed: {key: reason} of unknowns that trade off against the numbers in directions that the test leaves out; {} if there was no
            time for the test.
    """

    undetermined: Mapping[str, str] = field(default_factory=dict)
    unfinished: Mapping[str, str] = field(default_factory=dict)
    errors: Mapping[str, np.ndarray] = field(default_factory=dict)
    steps: Mapping[str, np.ndarray] = field(default_factory=dict)
    noise: Mapping[str, np.ndarray] = field(default_factory=dict)
    unchecked: tuple[str, ...] = ()
    blind: tuple[str, ...] = ()
    elsewhere: tuple[str, ...] = ()
    fixed: Mapping[str, str] = field(default_factory=dict)

    def missing(self, reported: Collection[str] = ()) -> list[str]:
        """Return lines: why the standard errors of the unchecked numbers, and of those of other views, are unknown.

        Args:
            reported: keys to leave out, since other lines are about them.
        """
        keys = [key for key in self.unchecked if key not in reported]
        if not keys:
            return [f"{key}: no standard error: the views that are tested do not show it" for key in self.elsewhere]
        if not self.fixed:
            return [f"whether {listed(keys)} converged: {TOO_SHORT}"]
        others = listed([f"{key} ({reason})" for key, reason in self.fixed.items()])
        have = "has no standard error: it is" if len(keys) == 1 else "have no standard errors: they are"
        return [f"{listed(keys)} {have} recovered together with {others}"]

    def noisy(self, known: Collection[str]) -> list[str]:
        """Return at most one line: why the errors of blind numbers are infinite; those of `known` keys are not."""
        keys = [key for key in self.blind if key not in known]
        what = "standard errors are unknown: the noise of the test at the end hides how the pictures depend on them; give more steps"
        return [f"{listed(keys)}: {what}, or less noise, such as by larger lights"] if keys else []

    def standard_errors(
        self, values: Mapping[str, np.ndarray], known: Mapping[str, np.ndarray] | None = None, complete: bool = False
    ) -> dict[str, np.ndarray]:
        """Return the standard errors of the numbers at the end of a run, of the shapes of `values`, float32.

        The squares of the error by the references' noise and of the distance from the least-squares solution are added. An estimate of the
        distance, without its noise σ, is step² − σ². A number is not known better than σ, unless the run states its own error. If that is
        complete, it replaces the check's, which is of another solution, and only steps beyond 3 σ are distances.

        Args:
            values: {key: array} at the end of the run.
            known: {key: standard errors} that the run states.
            complete: whether these contain the references' noise; otherwise errors are no smaller than them.
        """
        errors, known = {}, known or {}
        for key, error in self.errors.items():
            square, noise, step = (np.square(x) for x in (error, self.noise[key], self.steps[key]))
            own = np.square(known.get(key, 0.0)).reshape(-1)
            if complete and key in known:
                square = np.where(np.isfinite(square), own, np.inf) + np.maximum(step - _CLEAR**2 * noise, 0.0)
            else:
                square = square if key in known else np.maximum(square, noise)
                square = np.maximum(square + np.maximum(step - noise, 0.0), own)
            errors[key] = np.sqrt(square).reshape(values[key].shape).astype(np.float32)
        return errors
