"""How much a Sobolev preconditioner smooths: its strength, fitted to successive gradients."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from unrender.core.arrays import Array
from unrender.preconditioners import Sobolev

__all__ = ["STEPS", "StrengthFit"]

STEPS = 10
"""The pairs of gradients that the strength is fitted to: later ones tell more of noise than of what is still to do."""
_FACTOR, _WEAKEST = 4.0, 1 / 16
"""Candidates are λ, λ/4, λ/16, ... down to the first that hardly smooths."""
_LEAST_DESCENT = 0.4
"""Of the best candidate's."""


def _candidates(strength: float) -> int:
    return 1 + max(0, math.ceil(math.log(max(strength, _WEAKEST) / _WEAKEST, _FACTOR)))


@dataclass(frozen=True)
class StrengthFit:
    """The strength of one parameter's preconditioner.

    The stronger the smoothing, the quicker whole regions move, and the less noise moves them; but what differs from texel to texel hardly
    moves. With g and g' the gradients of successive steps and S = (I + λ L)^(-1/2), steps that are as long as Adam's descend by about
    S g · S g' / |S g|. The strength is the greatest, up to that given, by which they descend at least 0.4 times as much as by the best.

    Attributes:
        share: of the λ given, in (0, 1].
        count: pairs of gradients seen.
        sums: (2, n), over them, of S g · S g' and |S g|² for the n candidates.
    """

    share: float = 1.0
    count: int = 0
    sums: np.ndarray = field(default_factory=lambda: np.zeros((2, 0)))

    @classmethod
    def begun(cls, preconditioner: Sobolev, shape: Sequence[int]) -> StrengthFit:
        """Before the first gradient of a parameter of this shape."""
        return cls(sums=np.zeros((2, _candidates(preconditioner.strength_of(tuple(shape))))))

    def after(self, preconditioner: Sobolev, previous: Array, gradient: Array) -> StrengthFit:
        """With another pair of gradients; unchanged where there have been enough.

        Args:
            preconditioner: with all of λ.
            previous: the gradient of the last step, preconditioned with this share.
            gradient: that of this step, as it is.
        """
        if self.count >= STEPS:
            return self
        shares = _FACTOR ** -np.arange(self.sums.shape[1], dtype=float)
        found = preconditioner.scaled(self.share).descents(previous, gradient, shares / self.share)
        sums = self.sums + found
        return replace(self, share=_share(sums), count=self.count + 1, sums=sums)


def _share(sums: np.ndarray) -> float:
    """From the sums of a `StrengthFit`; between candidates, where the straight line over log λ meets the least descent."""
    products, squares = sums
    descent = products / np.sqrt(np.where(squares > 0, squares, np.inf))
    least = _LEAST_DESCENT * descent.max()
    if least <= 0:
        return 1.0
    first = int(np.argmax(descent >= least))
    if first == 0:
        return 1.0
    part = (descent[first] - least) / (descent[first] - descent[first - 1])
    return float(_FACTOR ** (part - first))
