"""Uncertainty of recovered textures, per texel, and of numbers."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from unrender.core import checks, timing
from unrender.core.exclusive import exclusive
from unrender.core.random import Key
from unrender.rendering.renderer import ParameterInfo
from unrender.runs.image_sensitivity import (
    COUNTED,
    FEWEST_PROBES,
    MAP_AXES,
    Curvature,
    check_arguments,
    curvature,
    map_keys,
    mask_roots,
    neighbour_means,
    root_of_covariance,
    transposed,
)
from unrender.runs.least_squares import check_numbers, checked_keys
from unrender.runs.numbers import TOO_SHORT
from unrender.runs.result import Result
from unrender.runs.verification import OF_FUNCTION, compares, misfit_of_views
from unrender.scene.problem import Problem
from unrender.scene.render import render, selected_views

_STREAM, _PASSES = 6, 4
"""Stream of the random numbers, and number of adjoints of each half of the residual."""
_SPP, _PATHS = (8, 256), 1 << 20
"""Samples per pixel of each half of the pictures, and their paths of all views."""
_PROBES, _ERRORS = 4.0, 3.0
"""Number of probes that the curvature of the neighbours weighs as much as; standard errors by which the residual must exceed the pictures'
noise, or there is no map."""
_MOST_OVERLAP, _UNSURE = 1.5, 0.5
"""Overlap from which on texels are not independent, such as with more texels than pixels that see them; interpolation alone has 1.27.
Standard error of the mean residual of all texels, relative to their variance, from which on a residual is not known."""
_ELEMENTS, _LEAST = 9.0, 0.1
"""Number of elements whose weight the mean over all cells has in a mean with the neighbours, and the least ratio to it."""
_CORNERS = tuple(np.s_[a, b] for a in (slice(1, None), slice(-1)) for b in (slice(1, None), slice(-1)))
_SIGNS = ((1.0, -1.0, -1.0, 1.0), (1.0, 1.0, -1.0, -1.0), (1.0, -1.0, 1.0, -1.0))
"""Cells of all blocks of 2 × 2, and signs of their three details (Haar wavelets)."""
_BLOCK = 16
"""Number of cells of the blocks whose means have followed the references' noise, also after strong smoothing."""
_OF_NOISE, _SURE, _LEAST_FOLLOWED = 0.7, 2.0, 0.5
"""Share of the squared error by the references' noise that has a line, standard errors added to the rest of it, and least f."""
_NEARBY, _LEAST_NOISE = 5, 0.02
"""Side of the squares of pixels that share a variance, and least variance relative to the mean."""


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of textures and numbers.

    Attributes:
        standard_error: {key: array} of the parameters' shapes, float32: standard deviation of each element's error. It is infinite for
            numbers that the references do not determine.
        data_share: {key: array} of the textures' shapes, in [0, 1]: weight of the references in each element. The rest of its value was
            decided by the start, by smoothing, or by a prior.
        missing: one line for each reason why an unknown has no standard error.
        limited: one line for each texture of whose squared error the references' noise is at least 0.7.
    """

    standard_error: Mapping[str, np.ndarray] = field(default_factory=dict)
    data_share: Mapping[str, np.ndarray] = field(default_factory=dict)
    missing: tuple[str, ...] = ()
    limited: tuple[str, ...] = ()


@exclusive("uncertainty")
def uncertainty(
    problem: Problem, values: Mapping[str, np.ndarray] | Result, seconds: float = math.inf, seed: int = 0
) -> Uncertainty:
    """Estimate the standard error of each texel of a problem's textures, and of each number.

    Numbers, 24 elements at most, are tested by least squares at `values`, together with directions of textures and grids that trade off
    against them. Their standard errors contain the references' noise, and the distance from the least-squares solution, for a `Result` that
    with `Result.pixel_weights`. Numbers have none beside a mesh, a prior, or a texture that is too large or has no path gradient, nor if
    time runs out or a smooth difference remains that they do not explain. `missing` has the reasons. No unknown has any if few numbers are
    unknown and the pictures differ from the references by more than noise, in up to four views.

    For textures, r is the pictures' residual, J their derivative with respect to the parameters, and H a diagonal element of the
    Gauss-Newton matrix JᵀJ. Elements are independent, and their values are not shrunk towards the start:

        se² = min(c / H, 1 / (1 / τ² + p))        share of the data = (H / c) / (H / c + 1 / τ² + p)
        c = max(m + (2 f − 1) σ², q σ²)        m = ⟨H d²⟩        σ² = (JᵀΣJ) / H        κ = Σ_ij (JᵀJ)_ij² / Σ_i (JᵀJ)_ii²

    d is the difference from the least-squares solution, (JᵀJ)⁻¹ Jᵀr, with two eigenvalues of JᵀJ / H: one of changes that neighbours
    share, and 1 of all others. So m, a mean over neighbours, contains what has not converged, and the run's noise. σ² is the variance of
    the solution by the references' noise, and f in [0, 1] the fraction of the solution's fine detail that the parameters have. For the
    solution times a filter of mean f, m contains ⟨(1 − f)²⟩ σ² of that noise, and the error ⟨f²⟩ σ², at least f² σ². With q = f² +
    (1 − f²) / 16, the means of 4 × 4 texels count as followed. The variance Σ of a pixel is that of the residual that neighbouring
    pixels do not share. τ² is the mean square change from the start plus the mean variance, and p the curvature of the parameter's prior.

    The root mean square of error / se is 0.76 to 1.68 on ten textures, and largest after many steps and for large H. Errors by a wrong lamp
    or by other textures of the surface are not included. Volumes have no map: rays pass many voxels. Nor have textures with κ ≥ 1.5, such
    as those with more texels than pixels, or of which the picture is no linear function, or any if time or samples are too few.

    Args:
        problem: problem with views and scene.
        values: {key: array} at the end of a run, or its result.
        seconds: time after which no further probe of H and no further test of the numbers is started; H has at least one probe.
        seed: seed of all random numbers.

    Returns:
        Maps of the textures with path gradients and κ < 1.5, and standard errors of the numbers.

    Raises:
        InputError: `values` have other keys or shapes than the problem's, or are not finite.
    """
    values, weights = (values.parameters, values.pixel_weights) if isinstance(values, Result) else (values, ())
    check_arguments("uncertainty", problem, {} if values is None else values, seconds, seed)
    known, maps, ends, until = Curvature(), Uncertainty(), {}, timing.now() + checks.real(seconds)
    keys, mapped = checked_keys(problem, values, problem.initial_values()), map_keys(problem)
    if mapped or keys:
        views = range(len(problem.views)) if mapped else selected_views(problem)
        halves = _halves(problem, values, views, seed)
        ends = dict(zip(views, zip(*halves, strict=True), strict=True))
        if differs := misfit_of_views(problem, views, [*ends.values()]):
            return Uncertainty(missing=(differs.line,))
        if mapped or len(views) < len(problem.views):
            noise = pixel_noise(problem, halves) if mapped else ()
            known = curvature(problem, values, seconds=seconds, seed=seed, noise=noise)
        if mapped:
            maps = of_residuals(problem, values, halves, known, seed)
    limits = until - timing.now(), known.sensitivity(), weights, {}, ends
    numbers = check_numbers(problem, values, problem.initial_values(), *limits)
    errors = {**numbers.standard_errors(values), **maps.standard_error}
    others = _others(problem, keys, {*mapped, *errors, *numbers.unchecked, *numbers.elsewhere, *numbers.fixed})
    return Uncertainty(errors, maps.data_share, (*maps.missing, *numbers.missing(), *others), maps.limited)


def _others(problem: Problem, tested: Sequence[str], explained: Collection[str]) -> list[str]:
    """Return a line for each unknown that has no standard errors and is not among those `explained`."""
    infos, result = problem.renderer.parameters(), []
    for key, unknown in problem.unknowns.items():
        if key in explained:
            continue
        reason = "least squares test few numbers only"
        if infos[key].welded:
            reason = "the vertices of a mesh have none"
        elif unknown.prior is not None or not compares(problem):
            reason = "it has a prior" if compares(problem) else OF_FUNCTION
        elif key in tested:
            reason = "the test's pictures are not finite, or do not depend on the numbers"
        result.append(f"{key}: no standard error: {reason}")
    return result


def _halves(
    problem: Problem, values: Mapping[str, np.ndarray], views: Sequence[int], seed: int
) -> list[list[np.ndarray]]:
    """Return two independent pictures (H, W, 3) of each view."""
    spp, key = min(max(_PATHS // problem.pixels, _SPP[0]), _SPP[1]), Key(seed, 0, _STREAM)
    return [
        [render(problem, values, view, spp, key.fold(2 * view + half).uint32()) for view in views] for half in range(2)
    ]


def of_residuals(
    problem: Problem,
    values: Mapping[str, np.ndarray],
    halves: Sequence[Sequence[np.ndarray]],
    known: Curvature,
    seed: int = 0,
) -> Uncertainty:
    """Return the maps of `uncertainty` from two independent pictures (H, W, 3) of each view and a curvature with `pixel_noise`."""
    infos = problem.renderer.parameters()
    shapes = problem.shapes()
    reasons = {key: _refusal(infos[key], known, key) for key, shape in shapes.items() if len(shape) >= MAP_AXES}
    if not compares(problem):
        reasons = dict.fromkeys(reasons, OF_FUNCTION)
    keys = [key for key, reason in reasons.items() if not reason]
    if not keys:
        return Uncertainty(missing=no_maps(reasons))
    roots = [mask_roots(problem, view) for view in range(len(problem.views))]
    residuals = _residuals(problem, halves)
    noise = _Mean.of(np.concatenate([products[seen] for products, _, seen in _unshared(residuals)]))
    weighted = [[root * x for root, x in zip(roots, half, strict=True)] for half in residuals]
    one, other = (
        transposed(problem, values, of, _PASSES, Key(seed, half, _STREAM)) for half, of in enumerate(weighted)
    )
    errors, shares, limited = {}, {}, []
    for key in keys:
        own = _Cells.of(values[key], problem.unknowns[key].initial, known.squares[key], known.noise[key], known.probes)
        prior = 0.0 if (of := problem.unknowns[key].prior) is None else of.diagonal(values[key])
        posterior = own.posterior((one[key], other[key]), known.smooth[key], noise.is_known, prior)
        if posterior is None:
            reasons[key] = "too few samples tell the pictures' differences from the references from noise"
            continue
        errors[key], shares[key] = np.sqrt(posterior.variance).astype(np.float32), posterior.share.astype(np.float32)
        if noise.is_known and posterior.of_noise >= _OF_NOISE:
            limited.append(
                f"{key}: differences of single pixels, such as the references' noise, now limit it ({posterior.of_noise:.0%} of its "
                "squared error): more steps gain little"
            )
    return Uncertainty(errors, shares, no_maps(reasons), tuple(limited))


def _refusal(info: ParameterInfo, known: Curvature, key: str) -> str:
    """Return why a texture or grid has no map; "" if it has one."""
    square = known.squares.get(key)
    if square is None:
        return "it has no path gradient"
    if square.ndim > MAP_AXES:
        return "rays pass many voxels, so errors of voxels depend on each other; see ur.runs.sensitivity"
    if not square.any():
        return "no picture depends on it"
    if info.curved:
        return (
            "pictures may not change in proportion to it, and differ little before it has converged; compare it with that of a run of more "
            "steps"
        )
    if known.probes < FEWEST_PROBES:
        return TOO_SHORT
    if math.isnan(overlap := known.overlap.get(key, math.inf)):
        return "the noise of the renderings hides how the pictures depend on its texels; larger lights have less"
    if math.isinf(overlap):
        return "it has too many texels to measure whether pixels see several of them"
    return "" if overlap < _MOST_OVERLAP else "pixels see several texels, so errors of texels depend on each other"


def no_maps(reasons: Mapping[str, str]) -> tuple[str, ...]:
    """Return a line for each texture or grid that has no map for a reason other than ""."""
    return tuple(f"{key}: no map of standard errors: {reason}" for key, reason in reasons.items() if reason)


@dataclass(frozen=True)
class _Posterior:
    """Variance and share of the data of each element, (..., C), and a lower estimate of the fraction of the squared error by the
    references' noise, f² σ² / (m + (2 f − 1) σ²), 0 for small f."""

    variance: np.ndarray
    share: np.ndarray
    of_noise: float


@dataclass(frozen=True)
class _Cells:
    """Texels of one parameter: change of each element from the start, (..., C); its mean curvature > 0 and noise of the references,
    (...)."""

    change: np.ndarray
    curvature: np.ndarray
    noise: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray, start: np.ndarray, squares: np.ndarray, noise: np.ndarray, probes: int) -> _Cells:
        """Return the cells. The fewer probes, the more a cell's curvature follows those of its neighbours, as geometric mean."""
        curvature = _smoothed(squares.mean(axis=-1), probes)
        variances = _smoothed(noise.mean(axis=-1), probes) / curvature if noise.any() else np.zeros(curvature.shape)
        return cls(values.astype(np.float64) - start, curvature, variances)

    @property
    def counted(self) -> np.ndarray:
        """Cells that count in means over cells, (...)."""
        return self.curvature > COUNTED * np.median(self.curvature)

    def posterior(
        self, gradients: tuple[np.ndarray, np.ndarray], smooth: float, noise_is_known: bool, prior: np.ndarray | float
    ) -> _Posterior | None:
        """Return variances and shares of the data, from two independent Jᵀr (..., C); None if samples are too few to tell the residual.
        `smooth` is the eigenvalue of `Curvature`, and `prior` the curvature of the prior."""
        counted, channels = self.counted, self.change.shape[-1]
        one, other = (self._difference(gradient, smooth) for gradient in gradients)
        explained = self.curvature * (one * other).mean(axis=-1)
        m = _Mean.of(explained[counted])
        if not (m.is_known or noise_is_known):
            return None
        elements = 3.0**explained.ndim * channels
        local = neighbour_means(np.where(counted, explained, m.value))
        pooled = (elements * local + _ELEMENTS * m.value) / (elements + _ELEMENTS)
        pooled = np.maximum(pooled, max(_LEAST * m.value, 0.0))
        f = self._followed(one, other)
        least = f**2 + (1.0 - f**2) / _BLOCK
        c = np.maximum(np.maximum(pooled + (2.0 * f - 1.0) * self.noise, least * self.noise), 1e-12)
        noise = float(self.noise[counted].mean())
        if not m.is_known and m.error > _UNSURE * max(m.value + (2.0 * f - 1.0) * noise, least * noise):
            return None
        before = float(np.square(self.change)[counted].mean() + c[counted].mean() / self.curvature[counted].mean())
        precision = np.repeat((self.curvature / c)[..., None], channels, axis=-1)
        others = 1.0 / max(before, 1e-12) + prior
        total = max(m.value + _SURE * m.error + (2.0 * f - 1.0) * noise, f**2 * noise, 1e-12)
        of_noise = f**2 * noise / total if f >= _LEAST_FOLLOWED else 0.0
        return _Posterior(1.0 / np.maximum(precision, others), precision / (precision + others), of_noise)

    def _difference(self, gradient: np.ndarray, smooth: float) -> np.ndarray:
        """Return the parameters minus the least-squares solution, (..., C), from Jᵀr; 0 at cells that do not count."""
        roots = np.where(self.counted, np.sqrt(self.curvature), np.inf)[..., None]
        shared = neighbour_means(gradient / roots, channels=True)
        return (gradient / roots - (1.0 - 1.0 / smooth) * shared) / roots

    def _followed(self, one: np.ndarray, other: np.ndarray) -> float:
        """Return the fraction in [0, 1] of the solution's differences of neighbours that the parameters have, from two independent
        differences from the solution, (..., C); 1 if noise hides it."""
        solutions = self.change - one, self.change - other
        total = _Mean.of(self._details(*solutions))
        own = float(self._details(self.change, 0.5 * (solutions[0] + solutions[1])).mean())
        return min(max(own / total.value, 0.0), 1.0) if total.is_known else 1.0

    def _details(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Return products of two maps' details in the blocks of 2 × 2 cells that all count, weighted by the inverse of their variance."""
        seen = np.logical_and.reduce([self.counted[of] for of in _CORNERS])
        weights = 1.0 / np.sum([1.0 / self.curvature[of] for of in _CORNERS], axis=0)
        first, second = (np.tensordot(_SIGNS, np.stack([x[of] for of in _CORNERS]), axes=1) for x in (one, other))
        return (np.mean(first * second, axis=(0, -1)) * weights)[seen]


@dataclass(frozen=True)
class _Mean:
    """A mean and its standard error."""

    value: float
    error: float

    @classmethod
    def of(cls, values: np.ndarray) -> _Mean:
        if not values.size:
            return cls(0.0, 0.0)
        return cls(float(values.mean()), float(values.std()) / math.sqrt(values.size))

    @property
    def is_known(self) -> bool:
        return self.value > _ERRORS * self.error


def _smoothed(means: np.ndarray, probes: int) -> np.ndarray:
    """Return positive means of cells, which follow those of their neighbours more, the fewer probes they have."""
    logarithms = np.log(np.maximum(means, 1e-6 * np.median(means[means > 0])))
    return np.exp((probes * logarithms + _PROBES * neighbour_means(logarithms)) / (probes + _PROBES))


def pixel_noise(problem: Problem, halves: Sequence[Sequence[np.ndarray]]) -> list[np.ndarray]:
    """Return a and b (H, W, 2) of the root a I + b 11ᵀ of the channels' covariance, of noise that neighbouring pixels do not share."""
    from scipy.ndimage import uniform_filter  # takes long to import

    parts = _unshared(_residuals(problem, halves))
    least = _LEAST_NOISE * max(_Mean.of(np.concatenate([products[seen] for products, _, seen in parts])).value, 0.0)
    roots = []
    for products, shared, seen in parts:
        sums, counts = (
            uniform_filter(np.pad(np.sum(x, axis=-1, dtype=float), ((0, 1), (0, 1))), _NEARBY, mode="constant")
            for x in (products * seen, seen)
        )
        near = counts > 0.5 / _NEARBY**2  # running sums round
        variances = np.where(near, np.maximum(sums / np.where(near, counts, 1.0), least), least)[..., None]
        correlation = float(shared[seen].sum()) / max(float(products[seen].sum()), 1e-300)
        roots.append(root_of_covariance(variances, correlation))
    return roots


def _residuals(problem: Problem, halves: Sequence[Sequence[np.ndarray]]) -> list[list[np.ndarray]]:
    """Return the differences of both halves of the pictures from the references, times the roots of the masks' weights."""
    views = [
        (np.asarray(view.reference, np.float64), mask_roots(problem, index)) for index, view in enumerate(problem.views)
    ]
    return [
        [np.nan_to_num(root * (image - reference)) for image, (reference, root) in zip(half, views, strict=True)]
        for half in halves
    ]


def _unshared(residuals: Sequence[Sequence[np.ndarray]]) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return, for each view, estimates (H - 1, W - 1, 3) of the variance that neighbouring pixels do not share, and of the covariance with
    the other channels, and which are known."""
    views = []
    for pair in zip(*residuals, strict=True):
        one, other = (0.5 * (x[1:, 1:] - x[:-1, 1:] - x[1:, :-1] + x[:-1, :-1]) for x in pair)
        views.append((one * other, 0.5 * (one.sum(axis=-1, keepdims=True) - one) * other, one != 0.0))
    return views
