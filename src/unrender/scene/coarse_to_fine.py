"""Parameters with a coarse initial resolution that is refined at given steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from unrender.core import checks, tables
from unrender.core.checks import Several
from unrender.core.errors import InputError
from unrender.core.text import in_words
from unrender.io import resampling

NEVER = 1 << 40
"""A step that no run reaches: `CoarseToFine((NEVER,), 4)` uses a quarter of the resolution in the entire run."""


@dataclass(frozen=True)
class CoarseToFine:
    """Resolutions of a texture (H, W, C) or grid (Z, Y, X, C) during an optimisation.

    The last resolution is the scene's. Before step `steps[-1]` each axis has `factor` times fewer texels (rounded up), before step
    `steps[-2]` `factor` times fewer again: `steps=(200, 400)` takes a grid of 64³ through 16³, 32³ and 64³. The initial value is averaged
    over the coarse texels (`resampling.downsample`). At each refinement the parameter becomes its linear interpolant
    (`resampling.upsample`), which renders the same image except at the kinks of linear interpolation.

    `states` determines whether the states of optimizer, estimator and pixel sampler are interpolated or restarted, see
    `unrender.scene.upsampling`. Learning rates and their schedules always continue.

    Args:
        steps: steps of the run at which the resolution increases, counted from 0: ascending, each at least 1.
        factor: ratio of the numbers of texels along each axis, >= 2.
        wrap: whether opposite borders are neighbours, as in a tiling texture (Mitsuba's `repeat`): one truth value, or one per axis.
            Otherwise values are constant beyond the border (`clamp`).
        states: "estimator" keeps the estimator's state, including its pixel sampler's, and restarts the optimizer; "carry" keeps all
            states; "reset" restarts all.
    """

    steps: tuple[int, ...]
    factor: Several = 2
    wrap: bool | tuple[bool, ...] = False
    states: Literal["estimator", "carry", "reset"] = "estimator"

    def __post_init__(self):
        object.__setattr__(self, "steps", checked_steps("CoarseToFine", self.steps))
        checks.fields(self)
        wrap = tuple(self.wrap) if isinstance(self.wrap, (list, tuple)) else self.wrap
        object.__setattr__(self, "wrap", wrap)
        if not all(isinstance(wraps, bool) for wraps in (wrap if isinstance(wrap, tuple) else (wrap,))):
            raise InputError(f"CoarseToFine: wrap must be true, false, or one of these per axis, got {in_words(wrap)}")

    def check(self, shape: tuple[int, ...]) -> None:
        """Raise `InputError` for a parameter of this (full) shape that cannot have coarser resolutions."""
        if len(shape) not in (3, 4):
            raise InputError(f"expected a texture (H, W, C) or a grid (Z, Y, X, C), got shape {shape}")
        if isinstance(self.wrap, tuple) and len(self.wrap) != len(shape) - 1:
            raise InputError(f"wrap must have {len(shape) - 1} entries for shape {shape}, got {len(self.wrap)}")
        if max(self.shape(shape, 0)[:-1]) < 2:
            raise InputError(f"shape {shape} is too small to be coarser {len(self.steps)} times by {self.factor}")

    def shape(self, full: tuple[int, ...], step: int) -> tuple[int, ...]:
        """Return the parameter's shape at a step; `full` is its shape in the scene."""
        coarser = self.factor ** sum(step < change for change in self.steps)
        return (*(-(-size // coarser) for size in full[:-1]), full[-1])

    def shapes(self, full: tuple[int, ...]) -> set[tuple[int, ...]]:
        """Return all shapes of the parameter during a run."""
        return {self.shape(full, step) for step in (0, *self.steps)}

    def refined(self, values: np.ndarray, shape: Sequence[int]) -> np.ndarray:
        """Upsample values from a coarser resolution to that of `shape`. Linear in the values."""
        wrap = self.wrap if isinstance(self.wrap, tuple) else (self.wrap,) * (values.ndim - 1)
        return resampling.upsample(values, shape[:-1], wrap)


def checked_steps(owner: str, values: Any) -> tuple[int, ...]:
    """Return the steps at which something changes, after checking them. Raises `InputError`."""
    steps = tuple(values) if isinstance(values, (list, tuple)) else ()
    if not steps or not all(type(step) is int and step >= 1 for step in steps) or list(steps) != sorted(set(steps)):
        what = "whole numbers of at least 1 that ascend, such as [200, 400]"
        raise InputError(f"{owner}: steps must be {what}, got {in_words(values)}")
    return steps


def of(value: Any) -> CoarseToFine:
    """Return the resolutions of a parameter from an instance, a list of steps or a table of options. Raises `InputError`."""
    if isinstance(value, CoarseToFine):
        return value
    table = dict(value) if isinstance(value, Mapping) else {"steps": value}
    return tables.build(CoarseToFine, table)
