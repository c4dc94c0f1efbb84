"""A parameter that is coarse at first and becomes finer at given steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from unrender.core import checks, tables
from unrender.core.errors import InputError
from unrender.io import resampling

NEVER = 1 << 40
"""A step that no run comes to: `CoarseToFine((NEVER,), 4)` is four times as coarse throughout."""


@dataclass(frozen=True)
class CoarseToFine:
    """The resolutions of a texture (H, W, C) or grid (Z, Y, X, C) during a descent.

    The last resolution is the scene's own. Before step `steps[-1]` each axis has `factor` times fewer texels (rounded up), before the
    step in front of it `factor` times fewer again: `steps=(200, 400)` takes a grid of 64³ through 16³, 32³ and 64³. The start is
    averaged over the coarse texels (`resampling.downsample`); at each change the parameter becomes its linear interpolant
    (`resampling.upsample`), which shows the same up to the kinks of linear interpolation.

    What optimizer, estimator and pixel sampler remember is either carried through a change or starts anew (`states`), see
    `unrender.scene.upsampling`. Learning rates and their schedules go on in any case.

    Args:
        steps: before which of the run's steps the resolution grows, counted from 0: ascending, each at least 1.
        factor: how many times more texels along each axis, >= 2.
        wrap: whether opposite borders are neighbours, as for a tiling texture (Mitsuba's `repeat`); for all axes or one truth value per
            axis. Otherwise values are constant beyond the border (`clamp`).
        states: "estimator" carries what the estimator remembers, its pixel sampler's state included, and the optimizer starts anew;
            "carry" carries all; with "reset" all start anew.
    """

    steps: tuple[int, ...]
    factor: int = 2
    wrap: bool | tuple[bool, ...] = False
    states: Literal["estimator", "carry", "reset"] = "estimator"

    def __post_init__(self):
        object.__setattr__(self, "steps", checked_steps("CoarseToFine", self.steps))
        checks.integer("CoarseToFine", "factor", self.factor, at_least=2)
        wrap = tuple(self.wrap) if isinstance(self.wrap, (list, tuple)) else self.wrap
        object.__setattr__(self, "wrap", wrap)
        if not all(isinstance(wraps, bool) for wraps in (wrap if isinstance(wrap, tuple) else (wrap,))):
            raise InputError(f"CoarseToFine: wrap must be true, false, or one of these per axis, got {wrap!r}")
        if self.states not in ("estimator", "carry", "reset"):
            raise InputError(f'CoarseToFine: states must be "estimator", "carry" or "reset", got {self.states!r}')

    def check(self, shape: tuple[int, ...]) -> None:
        """Raise `InputError` where a parameter of this (full) shape cannot be coarse at first."""
        if len(shape) not in (3, 4):
            raise InputError(f"expected a texture (H, W, C) or a grid (Z, Y, X, C), got shape {shape}")
        if isinstance(self.wrap, tuple) and len(self.wrap) != len(shape) - 1:
            raise InputError(f"wrap must have {len(shape) - 1} entries for shape {shape}, got {len(self.wrap)}")
        if max(self.shape(shape, 0)[:-1]) < 2:
            raise InputError(f"shape {shape} is too small to be coarser {len(self.steps)} times by {self.factor}")

    def shape(self, full: tuple[int, ...], step: int) -> tuple[int, ...]:
        """The parameter's shape at a step, where `full` is that of the scene."""
        coarser = self.factor ** sum(step < change for change in self.steps)
        return (*(-(-size // coarser) for size in full[:-1]), full[-1])

    def shapes(self, full: tuple[int, ...]) -> set[tuple[int, ...]]:
        """All that it has in the course of a run."""
        return {self.shape(full, step) for step in (0, *self.steps)}

    def coarsened(self, values: np.ndarray, step: int) -> np.ndarray:
        """Values at the scene's resolution, at that of a step."""
        return resampling.downsample(values, self.shape(values.shape, step)[:-1])

    def refined(self, values: np.ndarray, shape: Sequence[int]) -> np.ndarray:
        """Values at a coarser resolution, at that of `shape`. Linear in the values."""
        wrap = self.wrap if isinstance(self.wrap, tuple) else (self.wrap,) * (values.ndim - 1)
        return resampling.upsample(values, shape[:-1], wrap)


def checked_steps(owner: str, given: Any) -> tuple[int, ...]:
    """Steps before which something changes. Raises `InputError` for what are none."""
    steps = tuple(given) if isinstance(given, (list, tuple)) else ()
    if not steps or not all(type(step) is int and step >= 1 for step in steps) or list(steps) != sorted(set(steps)):
        what = "whole numbers of at least 1 that ascend, such as [200, 400]"
        raise InputError(f"{owner}: steps must be {what}, got {given!r:.80}")
    return steps


def of(given: Any) -> CoarseToFine:
    """What a parameter was given: one, its steps alone, or a table of its options. Raises `InputError`."""
    if isinstance(given, CoarseToFine):
        return given
    table = dict(given) if isinstance(given, Mapping) else {"steps": given}
    return tables.build(CoarseToFine, table)
