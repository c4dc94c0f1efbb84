"""Sobolev gradients whose strength is fitted to successive gradients."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from unrender.core import arrays, checks, trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.text import listed
from unrender.core.trees import Tree
from unrender.estimators.capabilities import AtBounds, FreshGradient
from unrender.optimizers.transforms.base import (
    GRADIENTS,
    SmoothingChange,
    StepTransform,
    StepUpdate,
    TransformState,
    checked_keys,
    without,
)
from unrender.preconditioners import Sobolev
from unrender.preconditioners.base import Preconditioner, bound_to
from unrender.preconditioners.mesh import MeshTopology
from unrender.scene.upsampling import Upsampler

STEPS = 10
"""Number of pairs of gradients in the first fit. Later pairs contain more noise than signal."""
_FACTOR, _WEAKEST = 4.0, 1 / 16
"""Candidates are λ, λ/4, λ/16, ... down to the first that hardly smooths."""
_LEAST_DESCENT = 0.55
"""Smallest accepted descent relative to the best candidate's. Smaller values cost steps at the start, larger ones admit more noise."""
_ROWS = 8
"""Number of independent gradients between two tests; a test uses those of the last two intervals."""
_LEAST_FRESH_DESCENT, _ERRORS = 0.7, 2.8
"""Smallest accepted descent relative to the best candidate's, and the smallest improvement in standard errors."""
_CONFIRMED, _REVERTED = 0.45, 0.6
"""Confirmed fraction of the agreement of successive gradients that is needed to reduce smoothing, and the fraction below which the
reduction is reverted."""
_CLEAR = 0.15
"""Fraction of |S g|² that independent samples must confirm to reduce smoothing."""
_SLOWEST = 0.75
"""Largest power of 1/step at which the gradient of detail may decay if smoothing is to be reduced."""
_LEAST_LEFT = 0.05
"""Smallest fraction of its first gradients that the gradient of detail must retain if smoothing is to be reduced."""
_LEAST_CONFIRMED = 0.02
"""Smallest value of `confirmed`."""


@dataclass(frozen=True)
class StrengthFit:
    """Fitted strength of one parameter's Sobolev preconditioner.

    Strong smoothing moves large regions quickly and averages noise, but hardly moves detail of single texels. Consider gradients g and g'
    of successive steps, and S = (I + λ L)^(-1/2). Steps of Adam's length descend by about S g · S g' / |S g|. The first fit selects the
    strongest smoothing, up to the given λ, whose descent is at least 0.55 times the best.

    Gradients of an estimator that reuses samples also agree on the reused noise. If an estimate has the gradient f from new samples
    (`FreshGradient`), S g · S f excludes that noise. Smoothing is reduced to the strongest candidate with at least 0.7 times the best
    descent, if all of the following hold:

    - The descent grows by more than 2.8 standard errors.
    - S g · S f is at least 0.45 of S g · S g', and 0.15 of |S g|²; the rest is noise, which would no longer be averaged.
    - The gradient of the detail persists: the root of S g · S f with the new strength decays more slowly than step^(-3/4) between two
      tests (the first gradients are the first test). Smoothed steps recover detail too, only later, so less smoothing helps only if
      detail waits for it. For photographs it decays as 1/step, for a checkerboard of single texels hardly at all.
    - It is at least a twentieth of its first value. Otherwise there is little to gain, and single texels would fit the reference's noise.

    If new gradients later confirm less than 0.6 of the agreement of successive ones, by a standard error, the strength of the first fit
    is restored.

    Attributes:
        share: fraction of the given λ, in (0, 1].
        count: number of pairs of gradients in the first fit.
        sums: sums of S g · S g' and |S g|² over these pairs for the n candidates, (n, 2).
        fresh: products for up to 16 new gradients since the last change, (3, 1 + n) each: S g · S f, |S g|² and S g · S g' for this share
            and the candidates.
        unjudged: number of these since the last test.
        gain: |S g|² with this share relative to the previous share, if it changed at this step; otherwise 1.
        level: |S g|² with this share, if it changed at this step; otherwise 0.
        steps: number of gradients after the first.
        seen: result of the last test, (1 + n,): S g · S f for the n candidates, and the mean of `steps`; empty before the first.
        confirmed: upper estimate of the fraction of S g · S g' that S g · S f confirms, in [0.02, 1].
        last: summary of the last gradient (`Sobolev.summary`), if there is one; else empty.
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
        """Return the fit after a first, unpreconditioned gradient."""
        summary = preconditioner.summary(gradient)
        return self if summary is None else replace(self, last=summary)

    def after(
        self, preconditioner: Sobolev, previous: Array, gradient: Array, fresh: Array | None = None
    ) -> StrengthFit:
        """Return the fit after a further pair of gradients.

        Args:
            preconditioner: preconditioner with the full λ.
            previous: gradient of the last step, preconditioned with this share.
            gradient: gradient of this step, not preconditioned.
            fresh: gradient from this step's samples only; None if not estimated. Ignored if not finite.
        """
        summary = preconditioner.summary(gradient)
        if summary is not None and not len(self.last):
            return replace(self, gain=1.0, level=0.0, last=summary)
        fit = replace(self, gain=1.0, level=0.0, steps=self.steps + 1)
        pair = _Pair(previous, gradient, self.last, summary)
        if fit.count < STEPS:
            fit = fit._with_pair(preconditioner, pair)
        else:
            if fresh is not None:
                newer = _Pair(previous, fresh, self.last, preconditioner.summary(fresh))
                fit = fit._with_fresh(preconditioner, pair, newer)
            fit = fit._tested() if fit.unjudged >= _ROWS else fit
        return fit if summary is None else replace(fit, last=summary)

    def _with_pair(self, preconditioner: Sobolev, pair: _Pair) -> StrengthFit:
        """Return the first fit with a further pair."""
        fit = self
        if self.count == 0:
            strength = preconditioner.strength_of(arrays.shape(pair.gradient))
            candidates = 1 + max(0, math.ceil(math.log(max(strength, _WEAKEST) / _WEAKEST, _FACTOR)))
            fit = replace(self, sums=np.zeros((candidates, 2)))
        smooth = preconditioner.scaled(self.share)
        sums = fit.sums + pair.descents(smooth, fit._shares / self.share).T
        return replace(fit, share=_share(sums), count=self.count + 1, sums=sums)

    def _with_fresh(self, preconditioner: Sobolev, pair: _Pair, fresh: _Pair) -> StrengthFit:
        """Return the fit with the products of a further new gradient."""
        smooth, shares = preconditioner.scaled(self.share), np.append(1.0, self._shares / self.share)
        products, squares = fresh.descents(smooth, shares)
        agreement, _ = pair.descents(smooth, shares)
        row = np.stack([products, squares, agreement])
        if not np.isfinite(row).all() or (squares <= 0).any():
            return self
        return replace(self, fresh=(*self.fresh, row)[-2 * _ROWS :], unjudged=self.unjudged + 1)

    def _tested(self) -> StrengthFit:
        rows = np.stack(self.fresh)
        products, squares = rows[:, 0], rows[:, 1]
        first, before = _share(self.sums), self._before
        looked = np.append(products[-self.unjudged :, 1:].mean(axis=0), self.steps - 0.5 * (self.unjudged - 1))
        fit = replace(self, seen=looked, unjudged=0)
        if self.share < first and sum(_confirmed(rows[-self.unjudged :], 0)) < _REVERTED:
            known = np.interp(math.log(first), np.log(self._shares[::-1]), squares.mean(axis=0)[:0:-1])
            return fit._changed(first, float(known), squares[:, 0].mean())
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
            return fit._changed(float(self._shares[best]), square, squares[:, 0].mean())
        share, error = _confirmed(rows, 0)
        return replace(fit, confirmed=min(max(share + 2.0 * error, _LEAST_CONFIRMED), 1.0))

    def _changed(self, share: float, level: float, before: float) -> StrengthFit:
        """Return the fit with another strength; `level` and `before` are |S g|² with it and with the previous one."""
        gain = float(level / before)
        return replace(self, share=share, gain=gain, level=float(level), fresh=(), unjudged=0, confirmed=1.0)

    @property
    def _before(self) -> np.ndarray:
        """`seen`, or its equivalent from the first fit."""
        return self.seen if len(self.seen) else np.append(self.sums[:, 0] / self.count, 0.5 * (self.count + 1))

    @property
    def _shares(self) -> np.ndarray:
        """Fractions of λ of the candidates, (n,)."""
        return _FACTOR ** -np.arange(len(self.sums), dtype=float)


@dataclass(frozen=True)
class _Pair:
    """Two successive gradients: the earlier one preconditioned, the later one not, and, unless `second` is None, summaries of both
    without."""

    previous: Array
    gradient: Array
    first: np.ndarray
    second: np.ndarray | None

    def descents(self, smooth: Sobolev, shares: np.ndarray) -> np.ndarray:
        if self.second is None:
            return smooth.descents(self.previous, self.gradient, shares)
        return smooth.descents_of_summaries(arrays.shape(self.gradient), self.first, self.second, shares)


def _confirmed(rows: np.ndarray, candidate: int) -> tuple[float, float]:
    """Return the fraction of the agreement of successive gradients that new ones confirm with a candidate, and its standard error.

    It is Σ S g · S f / Σ S g · S g' over rows (k, 3, 1 + n), each divided by its |S g|². (1, 0) if successive gradients do not agree,
    because there is nothing to confirm.
    """
    products, agreement = rows[:, (0, 2), candidate].T / rows[:, 1, candidate]
    if agreement.sum() <= 0:
        return 1.0, 0.0
    ratio = products.sum() / agreement.sum()
    error = (products - ratio * agreement).std(ddof=1) * math.sqrt(len(rows)) / agreement.sum()
    return float(ratio), float(error)


def _share(sums: np.ndarray) -> float:
    """Return the share from the sums of a `StrengthFit`, interpolated between candidates linearly over log λ."""
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

_MEMORY = 0.9
"""Decay of the mean gradient that decides which elements stay at their bounds."""


@dataclass(frozen=True)
class FittedSobolevState(TransformState):
    """State of `FittedSobolev`.

    Attributes:
        gradient: Preconditioned gradient of the last step; zeros before the first.
        strengths: {key: fit of the strength} of the parameters whose preconditioner is a `Sobolev`.
        mean: Exponentially weighted mean of earlier gradients of the preconditioned parameters, without preconditioning; empty before the
            first, and in checkpoints of versions without it.
    """

    gradient: Tree = field(metadata=GRADIENTS)
    strengths: dict[str, StrengthFit] = field(default_factory=dict)
    mean: Tree = field(default_factory=dict, metadata=GRADIENTS)

    def upsampled(self, upsampler: Upsampler) -> FittedSobolevState:
        """Interpolate the gradient, and restart the fit of refined parameters."""
        strengths = {key: StrengthFit() if key in upsampler.shares else fit for key, fit in self.strengths.items()}
        return replace(super().upsampled(upsampler), strengths=strengths)


@register
@dataclass(frozen=True)
class FittedSobolev(StepTransform):
    """Precondition gradients, and store them for later transforms. Averaged iterates restart where the smoothing becomes stronger.

    The strength of a `Sobolev` is an upper limit; it is fitted to successive gradients, see `StrengthFit`. Any other preconditioner is
    applied unchanged. Gradients of other parameters are unchanged. The gradient keeps its unit.

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
        checks.fields(self)
        keys = checked_keys("FittedSobolev: preconditioned", self.preconditioned)
        object.__setattr__(self, "preconditioned", keys)

    def bound(self, topology: Callable[[str], MeshTopology | None], repeated: Mapping[str, int]) -> FittedSobolev:
        """Return the transform for parameters with these meshes, by key, and these numbers of repeated border columns."""
        bound = {}
        for key in self.preconditioned if self.preconditioner is not None else ():
            mesh = topology(key)
            smooth = bound_to(self.preconditioner, mesh, repeated.get(key, 0))
            if smooth is not self.preconditioner:
                bound[key] = 0 if mesh is None else len(mesh.places), smooth
        transform = replace(self)
        object.__setattr__(transform, "_bound", bound)
        return transform

    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> FittedSobolevState:
        """Return the state before the first step. Raises `InputError` for an unknown parameter, or one that S does not support."""
        for key in self.preconditioned:
            if key not in parameters:
                raise InputError(f'FittedSobolev: preconditioned: unknown parameter "{key}"')
            if self.preconditioner is not None:
                self._smooth(key).check(key, arrays.shape(parameters[key]))
        fitted = self.preconditioned if isinstance(self.preconditioner, Sobolev) else ()
        return FittedSobolevState(trees.zeros_like(parameters), dict.fromkeys(fitted, StrengthFit()))

    def update(self, update: StepUpdate, state: FittedSobolevState) -> tuple[StepUpdate, FittedSobolevState]:
        """Precondition the gradient. Waits for the device if a strength is fitted."""
        bounds = update.estimate.get(AtBounds)
        held = {} if bounds is None else bounds.held(state.mean, update.made)
        gradients = {k: (1.0 - _MEMORY) * update.gradient[k] for k in self.preconditioned}
        mean = {k: _MEMORY * state.mean[k] + g if k in state.mean else g for k, g in gradients.items()}
        arrays.evaluate(held, mean)
        raw = without(update.gradient, held)
        if update.made == 0:
            strengths = {key: fit.begun(self._sobolev(key), raw[key]) for key, fit in state.strengths.items()}
        else:
            fresh_gradient = update.estimate.get(FreshGradient)
            fresh: Mapping[str, Array] = {} if fresh_gradient is None else without(fresh_gradient.values, held)
            strengths = {
                key: fit.after(self._sobolev(key), state.gradient[key], raw[key], fresh.get(key))
                for key, fit in state.strengths.items()
            }
        keys = () if self.preconditioner is None else self.preconditioned
        smoothing = {key: replace(self._smoothing(key, strengths), held=held.get(key)) for key in keys}
        gradient = dict(raw)
        for key, change in smoothing.items():
            if key in raw:
                gradient[key] = change.smoothed(raw[key])
        stronger = frozenset(key for key, change in smoothing.items() if change.gain < 1.0)
        update = replace(update, previous=state.gradient, smoothing=smoothing, restarted=update.restarted | stronger)
        following = replace(state, gradient=gradient, strengths=strengths, mean=mean)
        return replace(update, gradient=gradient, direction=gradient), following

    def choices(self, state: FittedSobolevState, made: int) -> tuple[str, ...]:
        """Return the fitted strengths relative to the given ones."""
        fitted = [f"{key} {fit.share:.2g}" for key, fit in state.strengths.items() if fit.count]
        return (f"smoothing, as a share of the strongest: {listed(fitted)}",) if fitted else ()

    def _smoothing(self, key: str, strengths: Mapping[str, StrengthFit]) -> SmoothingChange:
        smooth, fit = self._smooth(key), strengths.get(key)
        vertices = self._bound[key][0] if key in self._bound else 0
        if fit is None:
            return SmoothingChange(smooth, vertices=vertices)
        scaled = smooth.scaled(fit.share) if isinstance(smooth, Sobolev) else smooth
        return SmoothingChange(scaled, fit.gain, fit.level, fit.confirmed, vertices=vertices)

    def _smooth(self, key: str) -> Preconditioner:
        """Return the preconditioner of a parameter in `preconditioned`, at full strength."""
        preconditioner = self._bound[key][1] if key in self._bound else self.preconditioner
        assert preconditioner is not None
        return preconditioner

    def _sobolev(self, key: str) -> Sobolev:
        return cast("Sobolev", self._smooth(key))


@register
@dataclass(frozen=True)
class ApplyPreconditioner(StepTransform):
    """Apply the preconditioner of this step to the direction.

    With `FittedSobolev` before it and a scaling in between, the parameter moves along S (S g / scale).
    """

    def update(self, update: StepUpdate, state: None) -> tuple[StepUpdate, None]:
        direction = dict(update.direction)
        for key, change in update.smoothing.items():
            if key in direction:
                direction[key] = change.smoothed(direction[key])
        return replace(update, direction=direction), None
