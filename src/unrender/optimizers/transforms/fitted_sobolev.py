"""Sobolev gradients whose strength is fitted to successive gradients."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.text import listed
from unrender.core.trees import Tree
from unrender.estimators.capabilities import FreshGradient
from unrender.optimizers.transforms.base import (
    GRADIENTS,
    SmoothingChange,
    StepTransform,
    StepUpdate,
    TransformState,
    checked_keys,
)
from unrender.preconditioners import Sobolev
from unrender.preconditioners.base import MeshPreconditioner, PeriodicPreconditioner, Preconditioner
from unrender.preconditioners.mesh import MeshTopology
from unrender.scene.upsampling import Upsampler

STEPS = 10
"""The pairs of gradients that the strength is fitted to at first: later ones tell more of noise than of what is still to do."""
_FACTOR, _WEAKEST = 4.0, 1 / 16
"""Candidates are λ, λ/4, λ/16, ... down to the first that hardly smooths."""
_LEAST_DESCENT = 0.4
"""Of the best candidate's."""
_ROWS = 8
"""Fresh gradients from one judgement to the next; it is by those of the last two."""
_LEAST_FRESH_DESCENT, _ERRORS = 0.7, 2.8
"""Of the best candidate's with fresh samples; and by how many standard errors it has to be more than the present strength's."""
_CONFIRMED, _KEPT = 0.45, 0.6
"""Shares of what successive gradients agree on that fresh samples have to show for less smoothing, and must not be below by a standard
error once it is less."""
_CLEAR = 0.15
"""Share of |S g|² that fresh samples have to show for less smoothing."""
_SLOWEST = 0.75
"""The power of 1 / step that detail's gradient falls by at most where it waits for less smoothing."""
_LEAST_LEFT = 0.05
"""Share of its first gradients that detail's gradient must still have for less smoothing."""
_LEAST_CONFIRMED = 0.02
"""The share by which such an agreement counts at least."""


@dataclass(frozen=True)
class StrengthFit:
    """The strength of one parameter's preconditioner.

    The stronger the smoothing, the quicker whole regions move, and the less noise moves them; but what differs from texel to texel hardly
    moves. With g and g' the gradients of successive steps and S = (I + λ L)^(-1/2), steps that are as long as Adam's descend by about
    S g · S g' / |S g|. The strength is at first the greatest, up to that given, by which they descend at least 0.4 times as much as by
    the best.

    Later, gradients of an estimator that remembers samples agree on the noise remembered, too. Where an estimate has the gradient f of
    fresh samples (`FreshGradient`), S g · S f is what is no noise. Smoothing is reduced, to the strongest that descends at least 0.7 times
    as much as the best, if by that the descent grows by more than 2.8 standard errors, and S g · S f is at least 0.45 of S g · S g', and
    0.15 of |S g|²: the rest is noise, which nothing would average any more.

    Steps by smoothed gradients recover detail, too, only later: reducing their smoothing pays where the detail waits for it. So the root of
    S g · S f with the new strength must fall more slowly than step^(-3/4) from one look at fresh gradients to the next, the first
    gradients being the first look. In pictures it falls as 1/step, on a checkerboard of single texels hardly at all. And it must be at
    least a twentieth of what it was at first: where less is left, there is little to gain, and single texels would follow the noise of
    the reference. What is gained in detail is easily lost to noise: where fresh gradients come to show less than 0.6 of what successive
    ones agree on, by a standard error, the strength is that of the first fit again.

    What is no noise of what successive gradients agree on, is `confirmed`.

    Attributes:
        share: of the λ given, in (0, 1].
        count: pairs of gradients that the first fit has seen.
        sums: (n, 2), over them, of S g · S g' and |S g|² for the n candidates.
        fresh: of up to 16 fresh gradients since the last change, (3, 1 + n) each: S g · S f, |S g|² and S g · S g' for this share and the
            candidates.
        unjudged: how many of these came after the last judgement.
        gain: |S g|² with this share over that with the share before, where fresh gradients have changed it at this step; 1 elsewhere.
        level: |S g|² with this share, where it was changed at this step; 0 elsewhere.
        steps: gradients seen after the first.
        seen: of the last look, (1 + n,): S g · S f for the n candidates, and the mean of `steps` then; empty before the first.
        confirmed: the share of S g · S g' that is S g · S f, at most, in [0.02, 1]: by how much gradients agree for what is no noise.
        last: the summary of the last gradient (`Sobolev.summary`), where there is one; else empty.
    """

    share: float = 1.0
    count: int = 0
    sums: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    fresh: tuple[np.ndarray, ...] = ()
    unjudged: int = 0
    gain: float = 1.0
    level: float = 0.0
    steps: int = 0
    seen: np.ndarray = field(default_factory=lambda: np.zeros(0))
    confirmed: float = 1.0
    last: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))

    def begun(self, preconditioner: Sobolev, gradient: Array) -> StrengthFit:
        """With a first gradient, as it is."""
        summary = preconditioner.summary(gradient)
        return self if summary is None else replace(self, last=summary)

    def after(
        self, preconditioner: Sobolev, previous: Array, gradient: Array, fresh: Array | None = None
    ) -> StrengthFit:
        """With another pair of gradients.

        Args:
            preconditioner: with all of λ.
            previous: the gradient of the last step, preconditioned with this share.
            gradient: that of this step, as it is.
            fresh: that of this step's samples alone; None where it was not estimated. Left out where it is not finite.
        """
        summary = preconditioner.summary(gradient)
        if summary is not None and not len(self.last):
            return replace(self, gain=1.0, level=0.0, last=summary)
        found = replace(self, gain=1.0, level=0.0, steps=self.steps + 1)
        pair = _Pair(previous, gradient, self.last, summary)
        if found.count < STEPS:
            found = found._with_pair(preconditioner, pair)
        else:
            if fresh is not None:
                newer = _Pair(previous, fresh, self.last, preconditioner.summary(fresh))
                found = found._with_fresh(preconditioner, pair, newer)
            found = found._judged() if found.unjudged >= _ROWS else found
        return found if summary is None else replace(found, last=summary)

    def _with_pair(self, preconditioner: Sobolev, pair: _Pair) -> StrengthFit:
        """The first fit, with another pair."""
        found = self
        if self.count == 0:
            strength = preconditioner.strength_of(arrays.shape(pair.gradient))
            found = replace(self, sums=np.zeros((_candidates(strength), 2)))
        smooth = preconditioner.scaled(self.share)
        sums = found.sums + pair.descents(smooth, found._shares / self.share).T
        return replace(found, share=_share(sums), count=self.count + 1, sums=sums)

    def _with_fresh(self, preconditioner: Sobolev, pair: _Pair, fresh: _Pair) -> StrengthFit:
        """With the products of another fresh gradient."""
        smooth, shares = preconditioner.scaled(self.share), np.append(1.0, self._shares / self.share)
        products, squares = fresh.descents(smooth, shares)
        agreement, _ = pair.descents(smooth, shares)
        row = np.stack([products, squares, agreement])
        if not np.isfinite(row).all() or (squares <= 0).any():
            return self
        return replace(self, fresh=(*self.fresh, row)[-2 * _ROWS :], unjudged=self.unjudged + 1)

    def _judged(self) -> StrengthFit:
        """With the strength that the fresh gradients speak for."""
        rows = np.stack(self.fresh)
        products, squares = rows[:, 0], rows[:, 1]
        first, before = _share(self.sums), self._before
        looked = np.append(products[-self.unjudged :, 1:].mean(axis=0), self.steps - 0.5 * (self.unjudged - 1))
        found = replace(self, seen=looked, unjudged=0)
        if self.share < first and sum(_confirmed(rows[-self.unjudged :], 0)) < _KEPT:
            known = np.interp(math.log(first), np.log(self._shares[::-1]), squares.mean(axis=0)[:0:-1])
            return found._changed(first, float(known), squares[:, 0].mean())
        descents = products / np.sqrt(squares)
        means = descents.mean(axis=0)[1:]
        best = int(np.argmax(means >= _LEAST_FRESH_DESCENT * means.max()))
        more = descents[:, 1 + best] - descents[:, 0]
        product, square = products[:, 1 + best].mean(), squares[:, 1 + best].mean()
        if (
            self._shares[best] < self.share
            and more.mean() > _ERRORS * more.std(ddof=1) / math.sqrt(len(more))
            and _confirmed(rows, 1 + best)[0] >= _CONFIRMED
            and product >= _CLEAR * square
            and looked[best] > before[best] * (before[-1] / looked[-1]) ** (2 * _SLOWEST)
            and looked[best] * self.count >= _LEAST_LEFT**2 * self.sums[best, 0]
        ):
            return found._changed(float(self._shares[best]), square, squares[:, 0].mean())
        return replace(found, confirmed=_most_confirmed(rows))

    def _changed(self, share: float, level: float, before: float) -> StrengthFit:
        """With another strength, of which nothing is known yet; |S g|² with it, and with the one before."""
        gain = float(level / before)
        return replace(self, share=share, gain=gain, level=float(level), fresh=(), unjudged=0, confirmed=1.0)

    @property
    def _before(self) -> np.ndarray:
        """`seen`, or of the first fit."""
        return self.seen if len(self.seen) else np.append(self.sums[:, 0] / self.count, 0.5 * (self.count + 1))

    @property
    def _shares(self) -> np.ndarray:
        """Of the candidates, (n,)."""
        return _FACTOR ** -np.arange(len(self.sums), dtype=float)


@dataclass(frozen=True)
class _Pair:
    """Two gradients.

    Attributes:
        previous: the earlier, preconditioned.
        gradient: the later, as it is.
        first, second: the summaries of both, as they are, where the second is not None.
    """

    previous: Array
    gradient: Array
    first: np.ndarray
    second: np.ndarray | None

    def descents(self, smooth: Sobolev, shares: np.ndarray) -> np.ndarray:
        if self.second is None:
            return smooth.descents(self.previous, self.gradient, shares)
        return smooth.descents_of_summaries(arrays.shape(self.gradient), self.first, self.second, shares)


def _candidates(strength: float) -> int:
    return 1 + max(0, math.ceil(math.log(max(strength, _WEAKEST) / _WEAKEST, _FACTOR)))


def _confirmed(rows: np.ndarray, candidate: int) -> tuple[float, float]:
    """The share of what successive gradients agree on that fresh ones confirm, with a candidate's strength, and its standard error.

    Σ S g · S f / Σ S g · S g' of rows (k, 3, 1 + n) that count alike, each over its |S g|².

    (1, 0) where successive gradients do not agree: there is then nothing to confirm.
    """
    products, agreement = rows[:, (0, 2), candidate].T / rows[:, 1, candidate]
    if agreement.sum() <= 0:
        return 1.0, 0.0
    found = products.sum() / agreement.sum()
    error = (products - found * agreement).std(ddof=1) * math.sqrt(len(rows)) / agreement.sum()
    return float(found), float(error)


def _most_confirmed(rows: np.ndarray) -> float:
    """Two standard errors above the share that fresh gradients confirm with the present strength, within [0.02, 1]."""
    share, error = _confirmed(rows, 0)
    return min(max(share + 2.0 * error, _LEAST_CONFIRMED), 1.0)


def _share(sums: np.ndarray) -> float:
    """From the sums of a `StrengthFit`; between candidates, where the straight line over log λ meets the least descent."""
    products, squares = sums.T
    descent = products / np.sqrt(np.where(squares > 0, squares, np.inf))
    least = _LEAST_DESCENT * descent.max()
    if least <= 0:
        return 1.0
    first = int(np.argmax(descent >= least))
    if first == 0:
        return 1.0
    part = (descent[first] - least) / (descent[first] - descent[first - 1])
    return float(_FACTOR ** (part - first))


# ------------------------------------------------------------------------------------------------------ transforms


@dataclass(frozen=True)
class FittedSobolevState(TransformState):
    """State of `FittedSobolev`.

    Attributes:
        gradient: Gradient of the last step, preconditioned; zeros before the first.
        strengths: {key: fit of the strength}, of the parameters whose preconditioner is a `Sobolev`.
    """

    gradient: Tree = field(metadata=GRADIENTS)
    strengths: dict[str, StrengthFit] = field(default_factory=dict)

    def upsampled(self, upsampler: Upsampler) -> FittedSobolevState:
        """See `Upsamplable`: the strength is fitted anew."""
        strengths = {key: StrengthFit() if key in upsampler.shares else fit for key, fit in self.strengths.items()}
        return replace(super().upsampled(upsampler), strengths=strengths)


@register
@dataclass(frozen=True)
class FittedSobolev(StepTransform):
    """Precondition gradients, and remember them for the transforms that follow.

    The strength of a `Sobolev` is the greatest that is of use: it is fitted to successive gradients, see `StrengthFit`. Any other
    preconditioner is applied as it is. Gradients of other parameters stay as they are. The gradient keeps its unit.

    Args:
        preconditioner: S; None for none.
        preconditioned: Keys of the parameters to precondition.
    """

    preconditioner: Preconditioner | None = None
    preconditioned: tuple[str, ...] = ()
    _bound: Mapping[str, tuple[int, Preconditioner]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self):
        keys = checked_keys("FittedSobolev: preconditioned", self.preconditioned)
        object.__setattr__(self, "preconditioned", keys)

    def on_meshes(
        self, topology: Callable[[str], MeshTopology | None], repeated: Callable[[str], int] | None = None
    ) -> FittedSobolev:
        smooth, bound = self.preconditioner, {}
        for key in self.preconditioned:
            if isinstance(smooth, MeshPreconditioner) and (mesh := topology(key)) is not None:
                bound[key] = len(mesh.places), smooth.on_mesh(mesh)
            elif isinstance(smooth, PeriodicPreconditioner) and repeated and (columns := repeated(key)):
                bound[key] = 0, smooth.on_repeated(columns)
        transform = replace(self)
        object.__setattr__(transform, "_bound", bound)
        return transform

    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> FittedSobolevState:
        """See `StepTransform.init`. Raises `InputError` for a parameter that the preconditioner does not suit, or an unknown one."""
        del learning_rates
        for key in self.preconditioned:
            if key not in parameters:
                raise InputError(f'FittedSobolev: preconditioned: unknown parameter "{key}"')
            if self.preconditioner is not None:
                self._smooth(key).check(key, arrays.shape(parameters[key]))
        fitted = self.preconditioned if isinstance(self.preconditioner, Sobolev) else ()
        return FittedSobolevState(trees.zeros_like(parameters), dict.fromkeys(fitted, StrengthFit()))

    def update(self, update: StepUpdate, state: FittedSobolevState) -> tuple[StepUpdate, FittedSobolevState]:
        """See `StepTransform.update`. Waits for the device where a strength is fitted."""
        raw = update.gradient
        if update.made == 0:
            strengths = {key: fit.begun(self._sobolev(key), raw[key]) for key, fit in state.strengths.items()}
        else:
            found = update.estimate.get(FreshGradient)
            fresh: Mapping[str, Array] = {} if found is None else found.values
            strengths = {
                key: fit.after(self._sobolev(key), state.gradient[key], raw[key], fresh.get(key))
                for key, fit in state.strengths.items()
            }
        smoothing = (
            {} if self.preconditioner is None else {k: self._smoothing(k, strengths) for k in self.preconditioned}
        )
        gradient = dict(raw)
        for key, change in smoothing.items():
            if key in raw and change.preconditioner is not None:
                gradient[key] = change.preconditioner.apply(raw[key])
        following = replace(state, gradient=gradient, strengths=strengths)
        return replace(
            update, gradient=gradient, direction=gradient, previous=state.gradient, smoothing=smoothing
        ), following

    def choices(self, state: FittedSobolevState, made: int) -> tuple[str, ...]:
        """See `StepTransform.choices`: how strongly gradients are smoothed."""
        del made
        fitted = [f"{key} {fit.share:.2g}" for key, fit in state.strengths.items() if fit.count]
        return (f"smoothing, as a share of the strongest: {listed(fitted)}",) if fitted else ()

    def _smoothing(self, key: str, strengths: Mapping[str, StrengthFit]) -> SmoothingChange:
        smooth, fit = self._smooth(key), strengths.get(key)
        vertices = self._bound[key][0] if key in self._bound else 0
        if fit is None:
            return SmoothingChange(smooth, vertices=vertices)
        scaled = smooth.scaled(fit.share) if isinstance(smooth, Sobolev) else smooth
        return SmoothingChange(scaled, fit.gain, fit.level, fit.confirmed, vertices)

    def _smooth(self, key: str) -> Preconditioner:
        """Return the preconditioner of a parameter in `preconditioned`, at full strength."""
        found = self._bound[key][1] if key in self._bound else self.preconditioner
        assert found is not None
        return found

    def _sobolev(self, key: str) -> Sobolev:
        return cast("Sobolev", self._smooth(key))


@register
@dataclass(frozen=True)
class ApplyPreconditioner(StepTransform):
    """Apply the preconditioner of this step to the direction.

    With `FittedSobolev` before it and a scaling between the two, the parameter moves along S (S g / scale).
    """

    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> None:
        del parameters, learning_rates

    def update(self, update: StepUpdate, state: None) -> tuple[StepUpdate, None]:
        del state
        direction = dict(update.direction)
        for key, change in update.smoothing.items():
            if key in direction and change.preconditioner is not None:
                direction[key] = change.preconditioner.apply(direction[key])
        return replace(update, direction=direction), None
