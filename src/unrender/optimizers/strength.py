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
"""The pairs of gradients that the strength is fitted to at first: later ones tell more of noise than of what is still to do."""
_FACTOR, _WEAKEST = 4.0, 1 / 16
"""Candidates are λ, λ/4, λ/16, ... down to the first that hardly smooths."""
_LEAST_DESCENT = 0.4
"""Of the best candidate's."""
_LEAST_FRESH_DESCENT, _ERRORS = 0.7, 5.5
"""The same with fresh samples; and the standard errors by which the descent must be the greater one."""
_LEAST_CONFIRMED = 0.02
_CONFIRMED, _REFUTED = 0.75, 0.2
"""Shares of what successive gradients agree on that fresh samples have to show for less smoothing, and below which it is given up."""


def _candidates(strength: float) -> int:
    return 1 + max(0, math.ceil(math.log(max(strength, _WEAKEST) / _WEAKEST, _FACTOR)))


@dataclass(frozen=True)
class StrengthFit:
    """The strength of one parameter's preconditioner.

    The stronger the smoothing, the quicker whole regions move, and the less noise moves them; but what differs from texel to texel hardly
    moves. With g and g' the gradients of successive steps and S = (I + λ L)^(-1/2), steps that are as long as Adam's descend by about
    S g · S g' / |S g|. The strength is at first the greatest, up to that given, by which they descend at least 0.4 times as much as by
    the best.

    Later, gradients of an estimator that remembers samples agree on the noise remembered, too. Where an estimate has the gradient f of
    fresh samples (`FreshGradient`), S g · S f is what is no noise. Smoothing is reduced, to the strongest that descends at least 0.7 times
    as much as the best, if by that the descent grows by more than 5.5 standard errors, and S g · S f is at least 0.75 of S g · S g': a
    checkerboard of single texels does that, noise that has got into a texture does not. When fresh samples come to show less than 0.2 of
    what successive gradients agree on, the strength is that of the first fit again. What of that agreement is no noise, is `confirmed`.

    Attributes:
        share: of the λ given, in (0, 1].
        count: pairs of gradients seen.
        sums: (2, n), over them, of S g · S g' and |S g|² for the n candidates.
        fresh: (k, 3, 1 + n), of k fresh gradients since the last change: S g · S f, |S g|² and S g · S g' for this share and the
            candidates.
        judged: how many of these there were when the strength was last judged by them.
        gain: |S g|² with this share over that with the share of the step before.
        confirmed: the share of S g · S g' that is S g · S f, at most, in [0.02, 1]: by how much gradients agree for what is no noise.
    """

    share: float = 1.0
    count: int = 0
    sums: np.ndarray = field(default_factory=lambda: np.zeros((2, 0)))
    fresh: np.ndarray = field(default_factory=lambda: np.zeros((0, 3, 0)))
    judged: int = 0
    gain: float = 1.0
    confirmed: float = 1.0

    @classmethod
    def begun(cls, preconditioner: Sobolev, shape: Sequence[int]) -> StrengthFit:
        """Before the first gradient of a parameter of this shape."""
        count = _candidates(preconditioner.strength_of(tuple(shape)))
        return cls(sums=np.zeros((2, count)), fresh=np.zeros((0, 3, 1 + count)))

    def after(
        self, preconditioner: Sobolev, previous: Array, gradient: Array, fresh: Array | None = None
    ) -> StrengthFit:
        """With another pair of gradients.

        Args:
            preconditioner: with all of λ.
            previous: the gradient of the last step, preconditioned with this share.
            gradient: that of this step, as it is.
            fresh: that of this step's samples alone; None where it was not estimated.
        """
        found = self if self.gain == 1.0 else replace(self, gain=1.0)
        if found.count < STEPS:
            return found._fitted(preconditioner, previous, gradient)
        if fresh is not None:
            return found._seen(preconditioner, previous, gradient, fresh)
        return found._judged() if len(found.fresh) > max(found.judged, 1) else found

    def _fitted(self, preconditioner: Sobolev, previous: Array, gradient: Array) -> StrengthFit:
        smooth = preconditioner.scaled(self.share)
        sums = self.sums + smooth.descents(previous, gradient, self._shares / self.share)
        return replace(self, share=_share(sums), count=self.count + 1, sums=sums)

    def _seen(self, preconditioner: Sobolev, previous: Array, gradient: Array, fresh: Array) -> StrengthFit:
        smooth, shares = preconditioner.scaled(self.share), np.append(1.0, self._shares / self.share)
        products, squares = smooth.descents(previous, fresh, shares)
        agreement, _ = smooth.descents(previous, gradient, shares)
        return replace(self, fresh=np.concatenate([self.fresh, [[products, squares, agreement]]]))

    def _judged(self) -> StrengthFit:
        """At the end of a row of fresh gradients."""
        products, squares = self.fresh[:, 0], self.fresh[:, 1].mean(axis=0)
        first = _share(self.sums)
        if self.share < first and _confirmed(self.fresh[self.judged :], 0) < _REFUTED:
            known = np.interp(math.log(first), np.log(self._shares[::-1]), squares[:0:-1])
            return self._changed(first, float(known / squares[0]))
        descents = products / np.sqrt(np.where(squares > 0, squares, np.inf))
        means = descents.mean(axis=0)[1:]
        best = int(np.argmax(means >= _LEAST_FRESH_DESCENT * means.max()))
        more = descents[:, 1 + best] - descents[:, 0]
        beyond_doubt = more.mean() > _ERRORS * more.std(ddof=1) / math.sqrt(len(more))
        if self._shares[best] < self.share and beyond_doubt and _confirmed(self.fresh, 1 + best) >= _CONFIRMED:
            return self._changed(float(self._shares[best]), float(squares[1 + best] / squares[0]))
        return replace(self, judged=len(self.fresh), confirmed=_most_confirmed(self.fresh))

    def _changed(self, share: float, gain: float) -> StrengthFit:
        return replace(self, share=share, gain=gain, fresh=self.fresh[:0], judged=0, confirmed=1.0)

    @property
    def _shares(self) -> np.ndarray:
        """Of the candidates, (n,)."""
        return _FACTOR ** -np.arange(self.sums.shape[1], dtype=float)


def _confirmed(fresh: np.ndarray, candidate: int) -> float:
    """Σ S g · S f / Σ S g · S g' of `StrengthFit.fresh`; 0 where successive gradients do not agree."""
    product, agreement = fresh[:, 0, candidate].sum(), fresh[:, 2, candidate].sum()
    return float(product / agreement) if agreement > 0 else 0.0


def _most_confirmed(fresh: np.ndarray) -> float:
    """Two standard errors above the share that fresh gradients confirm with the present strength, within [0.02, 1]."""
    share, agreement = _confirmed(fresh, 0), fresh[:, 2, 0].sum()
    if agreement <= 0:
        return 1.0
    error = (fresh[:, 0, 0] - share * fresh[:, 2, 0]).std(ddof=1) * math.sqrt(len(fresh)) / agreement
    return float(np.clip(share + 2.0 * error, _LEAST_CONFIRMED, 1.0))


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
