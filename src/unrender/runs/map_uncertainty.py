"""Uncertainty of recovered textures, per texel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from unrender.core.exclusive import exclusive
from unrender.core.random import Key
from unrender.runs.image_sensitivity import (
    MAP_AXES,
    Curvature,
    curvature,
    mask_roots,
    neighbour_means,
    transposed,
)
from unrender.scene.problem import Problem
from unrender.scene.render import render

__all__ = ["Uncertainty", "of_residuals", "uncertainty"]

_STREAM, _PASSES = 6, 4
"""Stream of the random numbers, and number of adjoints of each half of the residual."""
_SPP, _PATHS = (8, 256), 1 << 20
"""Samples per pixel of each half of the pictures, and their paths of all views."""
_COUNTED = 0.1
"""Curvature relative to the median above which a cell counts in means over cells."""
_PROBES = 4.0
"""Number of probes that the curvature of the neighbours weighs as much as."""
_FEWEST, _ERRORS = 8, 3.0
"""Fewest probes, and standard errors by which the residual must exceed the pictures' noise, or there is no map."""
_MOST_OVERLAP = 2.0
"""Overlap from which on texels are not independent, such as with more texels than pixels that see them."""
_ELEMENTS, _LEAST = 9.0, 0.1
"""Number of elements that the mean over all cells weighs as much as beside the neighbours, and the least ratio to it."""


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of textures.

    Attributes:
        standard_error: {key: array} of the parameters' shapes, float32: standard deviation of each element's error.
        data_share: {key: array} of the same shapes, in [0, 1]: weight of the references in each element. The rest of its value was
            decided by the start, by smoothing, or by a prior.
    """

    standard_error: Mapping[str, np.ndarray] = field(default_factory=dict)
    data_share: Mapping[str, np.ndarray] = field(default_factory=dict)


@exclusive("uncertainty")
def uncertainty(
    problem: Problem, values: Mapping[str, np.ndarray], seconds: float = math.inf, seed: int = 0
) -> Uncertainty:
    """Estimate the standard error of each texel of a problem's textures.

    With the pictures' residual r, their derivative J by the parameters, and the diagonal elements H of the Gauss-Newton matrix JᵀJ, the
    variance of an element is that of a posterior with independent elements:

        1 / se² = H / c + 1 / τ² + p        share of the data = (H / c) se²
        c = max(m, (σ − √m)²)        m = ⟨(Jᵀr)² / (κ H)⟩        κ = Σ_ij (JᵀJ)_ij² / Σ_i (JᵀJ)_ii²

    m is the variance of the residual that the parameters could still explain, as mean over neighbours: what has not converged, and the
    run's noise. The references' noise, of standard deviation σ, is missing there as far as the parameters have followed it. τ² is the mean
    square change from the start plus the mean variance, and p the curvature of the parameter's prior.

    Errors of what is not unknown, such as a lamp of another colour, are not included. Volumes have no map, since rays pass many voxels,
    and a diagonal does not bound their errors; nor have textures with κ ≥ 2, such as those with more texels than pixels that see them.
    There is none either if time or samples are too few.

    Args:
        problem: problem with views and scene.
        values: {key: array} at the end of a run.
        seconds: time after which no further probe of H is started; there is at least one.
        seed: seed of all random numbers.

    Returns:
        Maps of the textures with path gradients and κ < 2.

    Raises:
        InputError: `values` have other keys or shapes than the problem's.
    """
    known = curvature(problem, values, seconds=seconds, seed=seed)
    spp = min(max(_PATHS // problem.pixels, _SPP[0]), _SPP[1])
    key = Key(seed, 0, _STREAM)
    halves = [
        [render(problem, values, view, spp, key.fold(2 * view + half).uint32()) for view in range(len(problem.views))]
        for half in range(2)
    ]
    return of_residuals(problem, values, halves, known, seed)


def of_residuals(
    problem: Problem,
    values: Mapping[str, np.ndarray],
    halves: Sequence[Sequence[np.ndarray]],
    known: Curvature,
    seed: int = 0,
) -> Uncertainty:
    """Return `uncertainty` from known pictures and a known curvature.

    Args:
        problem: problem with views and scene.
        values: {key: array} at the end of a run.
        halves: two independent pictures (H, W, 3) of each view, without the references.
        known: curvature at the values.
        seed: seed of all random numbers.
    """
    keys = [
        key
        for key, square in known.squares.items()
        if square.ndim == MAP_AXES and square.any() and known.overlap.get(key, 1.0) < _MOST_OVERLAP
    ]
    if not keys or known.probes < _FEWEST:
        return Uncertainty()
    roots = [mask_roots(problem, view) for view in range(len(problem.views))]
    residuals = [
        [
            np.nan_to_num(root * (image - np.asarray(view.reference, np.float64)))
            for image, view, root in zip(half, problem.views, roots, strict=True)
        ]
        for half in halves
    ]
    noise = _noise(residuals)
    weighted = [[root * x for root, x in zip(roots, half, strict=True)] for half in residuals]
    one, other = (
        transposed(problem, values, of, _PASSES, Key(seed, half, _STREAM)) for half, of in enumerate(weighted)
    )
    errors, shares = {}, {}
    for key in keys:
        own = _Cells.of(values[key], problem.unknowns[key].initial, known.squares[key], known.probes)
        prior = 0.0 if (of := problem.unknowns[key].prior) is None else of.diagonal(values[key])
        posterior = own.posterior(one[key] * other[key], known.overlap.get(key, 1.0), noise, prior)
        if posterior is not None:
            variance, share = posterior
            errors[key], shares[key] = np.sqrt(variance).astype(np.float32), share.astype(np.float32)
    return Uncertainty(errors, shares)


@dataclass(frozen=True)
class _Cells:
    """Texels of one parameter, with one curvature per texel.

    Attributes:
        change: mean square change of each cell from the start, (...).
        curvature: mean diagonal element of each cell, (...), > 0.
        channels: number of channels.
    """

    change: np.ndarray
    curvature: np.ndarray
    channels: int

    @classmethod
    def of(cls, values: np.ndarray, start: np.ndarray, squares: np.ndarray, probes: int) -> _Cells:
        """Return the cells. The fewer probes, the more a cell's curvature follows those of its neighbours, as geometric mean."""
        means = squares.mean(axis=-1)
        logarithms = np.log(np.maximum(means, 1e-6 * np.median(means[means > 0])))
        logarithms = (probes * logarithms + _PROBES * neighbour_means(logarithms)) / (probes + _PROBES)
        change = np.square(values.astype(np.float64) - start).mean(axis=-1)
        return cls(change, np.exp(logarithms), values.shape[-1])

    def posterior(
        self, gradient: np.ndarray, overlap: float, noise: _Mean, prior: np.ndarray | float
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the variance and the share of the data of each element, (..., C); None if samples are too few to tell the residual.

        Args:
            gradient: product of two independent Jᵀr, (..., C).
            overlap: κ.
            noise: σ².
            prior: curvature of the prior, (..., C).
        """
        counted = self.curvature > _COUNTED * np.median(self.curvature)
        explained = gradient.mean(axis=-1) / (overlap * self.curvature)
        m = _Mean.of(explained[counted])
        if not (m.is_known or noise.is_known):
            return None
        mean = m.value
        followed = max(math.sqrt(max(noise.value, 0.0)) - math.sqrt(max(mean, 0.0)), 0.0) ** 2
        elements = 3.0**explained.ndim * self.channels
        local = neighbour_means(np.where(counted, explained, mean))
        pooled = (elements * local + _ELEMENTS * mean) / (elements + _ELEMENTS)
        c = np.maximum(pooled, max(_LEAST * mean, followed, 1e-12))
        before = float(self.change[counted].mean()) + max(mean, followed) / float(self.curvature[counted].mean())
        precision = (self.curvature / c)[..., None] * np.ones(self.channels)
        variance = 1.0 / (precision + 1.0 / max(before, 1e-12) + prior)
        return variance, precision * variance


@dataclass(frozen=True)
class _Mean:
    """A mean and its standard error."""

    value: float
    error: float

    @classmethod
    def of(cls, values: np.ndarray) -> _Mean:
        return cls(float(values.mean()), float(values.std()) / math.sqrt(max(values.size, 1)))

    @property
    def is_known(self) -> bool:
        """Return whether the estimate is significantly positive."""
        return self.value > _ERRORS * self.error


def _noise(residuals: Sequence[Sequence[np.ndarray]]) -> _Mean:
    """Return the variance of the residual that neighbouring pixels do not share, from two halves of independent pictures."""
    products = []
    for pair in zip(*residuals, strict=True):
        one, other = (0.5 * (x[1:, 1:] - x[:-1, 1:] - x[1:, :-1] + x[:-1, :-1]) for x in pair)
        products.append((one * other)[one != 0.0])
    every = np.concatenate(products)
    return _Mean.of(every) if every.size else _Mean(0.0, 0.0)
