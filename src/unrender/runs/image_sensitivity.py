"""Sensitivity of the images to each element of the parameters."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

import numpy as np

from unrender.core import arrays, checks, periodic, timing
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.core.random import Key, check_seed
from unrender.core.text import in_words
from unrender.core.trees import Tree
from unrender.rendering.renderer import RenderSession
from unrender.scene.bounds import off_ends
from unrender.scene.problem import Problem
from unrender.scene.render import as_tree, check_problem, limited_spp, selected_views, view_request
from unrender.statistics.debiased import overlap

_PROBES, _MOST_SPP, _PATHS = 32, 4, 1 << 20
ADJOINT, _BOUNDARY = 1.5, (6, 24)
"""Time of an adjoint relative to a rendering; the same, and launches, of the boundary term of poses and vertices."""
MAP_AXES = 3
"""Number of axes from which a parameter is a texture or grid."""
FEWEST_PROBES = 8
"""Fewest probes from which the curvature and the overlap are known."""
_PROJECTIONS = 1 << 25
"""Numbers of the probes' projections that are stored for the overlap."""
COUNTED = 0.1
"""Curvature relative to the median above which a cell counts in means over cells."""
_INSENSITIVE, _INSENSITIVE_ALONE = 0.1, 0.05
"""Sensitivity relative to that of seen cells below which a cell hardly affects the images, such as by bounced light alone; that of an
element of a list, which has more noise than the medians over neighbouring cells."""

_REACHED, _WINDOWS = 5, 6
"""Fewest cells with paths in the windows of `around`, and least ratio of a texture's side to that of a window."""


@dataclass(frozen=True)
class Curvature:
    """Diagonal of the Gauss-Newton matrix JᵀJ, where J is the derivative of all views' pixels with respect to the parameters.

    Attributes:
        squares: {key: diagonal elements} of the parameters' shapes. Estimates below 0 are 0.
        overlap: {key: Σ_ij (JᵀJ)_ij² / Σ_i (JᵀJ)_ii²}, at least 1, of textures and grids: 1 if no pixel depends on two elements, 1.27 with
            linear interpolation of texels larger than pixels. The sum is over neighbours i and j, and over others where these are more than
            noise. It is infinite if too few probes are made, or fit into memory, and NaN if their noise hides the diagonal.
        smooth: {key: tr(SAS) / tr(SS)}, at least 1, of textures and grids, for A = JᵀJ with unit diagonal and the means S over neighbouring
            cells: the eigenvalue of smooth changes, 1 if no pixel depends on two elements. Infinite like `overlap`.
        probes: number of probes of the estimate.
        noise: {key: diagonal elements of JᵀΣJ} for pixels of covariance Σ; {} if that is unknown.
    """

    squares: Mapping[str, np.ndarray] = field(default_factory=dict)
    overlap: Mapping[str, float] = field(default_factory=dict)
    smooth: Mapping[str, float] = field(default_factory=dict)
    probes: int = 0
    noise: Mapping[str, np.ndarray] = field(default_factory=dict)

    def sensitivity(self) -> dict[str, np.ndarray]:
        """Return the roots of the diagonal elements, float32."""
        return {key: np.sqrt(square).astype(np.float32) for key, square in self.squares.items()}


@exclusive("sensitivity")
def sensitivity(
    problem: Problem,
    values: Mapping[str, np.ndarray] | None = None,
    probes: int = _PROBES,
    spp: int | None = None,
    seconds: float = np.inf,
    seed: int = 0,
    views: int | None = None,
) -> dict[str, np.ndarray]:
    """Estimate √diag(JᵀJ), where J is the derivative of all views' pixels with respect to the parameters.

    It is the change of the images per unit of each element, as root sum of squares over pixels and channels, weighted by the views' masks.
    Where it is small, the images do not determine an element, and the recovered value is noise or smoothing. JᵀJ is the Gauss-Newton
    Hessian of L2. With noise σ in each pixel of the references, no estimate of the element alone has a standard deviation below σ divided
    by this.

    diag(JᵀJ) is the expectation of (Jᵀs)² over images s of independent signs. The two factors are adjoints on separate paths, so the
    product is unbiased. The root, and the clamping of negative estimates to 0, are not.

    Args:
        problem: problem with views and scene.
        values: {key: array}; None for the initial ones.
        probes: number of sign images, >= 1. The relative standard error of the square is about √(2/probes).
        spp: samples per pixel of each adjoint, >= 1; None for 4, or fewer if the views have more than 2¹⁸ pixels in total.
        seconds: time after which no further probe is started; there is at least one.
        seed: seed of all random numbers.
        views: number of views to render, the first ones, >= 1; None for all.

    Returns:
        {key: array} of the parameters' shapes, float32, for the parameters with path gradients.

    Raises:
        InputError: `values` have other keys or shapes than the problem's; `probes`, `spp` or `views` is below 1.
    """
    return curvature(problem, values, probes, spp, seconds, seed, views).sensitivity()


def check_arguments(owner: str, problem: Any, values: Any, seconds: Any, seed: Any) -> None:
    """Raise `InputError` unless these are a problem, finite values of its unknowns or None, a number of seconds, which may be infinite,
    and a seed."""
    check_problem(owner, problem)
    if isinstance(seconds, bool) or not isinstance(seconds, Real) or np.isnan(checks.real(seconds)):
        raise InputError(f"{owner}: seconds must be a number, got {in_words(seconds)}")
    check_seed(f"{owner}: seed", seed)
    as_tree(problem, values)


def curvature(
    problem: Problem,
    values: Mapping[str, np.ndarray] | None = None,
    probes: int = _PROBES,
    spp: int | None = None,
    seconds: float = np.inf,
    seed: int = 0,
    views: int | None = None,
    noise: Sequence[np.ndarray] = (),
) -> Curvature:
    """Return the curvature of `sensitivity`, with the same arguments.

    (JᵀJ)_ij² is the expectation of (Jᵀs)_i (Jᵀs)_j (Jᵀs')_i (Jᵀs')_j over pairs of probes, with separate paths of the first two factors.
    With the `noise` (H, W, 2) of each view, a and b of the root a I + b 11ᵀ of the channels' covariance, the probes are also weighted by
    that root, on the same paths.
    """
    check_arguments("sensitivity", problem, values, seconds, seed)
    for name, number in (("probes", probes), ("views", len(problem.views) if views is None else views)):
        checks.integer("sensitivity", name, number, at_least=1)
    if spp is None:
        spp = adjoint_spp(problem)
    checks.integer("sensitivity", "spp", spp, at_least=1)
    session, keys = derivative_session(problem)
    if session is None:
        return Curvature()
    parameters = off_ends(as_tree(problem, values), problem.renderer.parameters())
    squares = {key: np.zeros(shape) for key, shape in problem.shapes().items() if key in keys}
    noisy = {key: np.zeros_like(square) for key, square in squares.items()} if noise else {}
    maps = [key for key, square in squares.items() if square.ndim >= MAP_AXES]
    stored: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {key: [] for key in maps}
    most = min(_PROBES, _PROJECTIONS // max(1, sum(squares[key].size for key in maps)))
    made, until = 0, timing.now() + checks.real(seconds)
    while made == 0 or (made < probes and timing.now() < until):
        try:
            one, other = (
                _projections(problem, session, parameters, keys, spp, Key(seed, made), half, views, noise)
                for half in range(2)
            )
        except InputError:  # no picture depends on any of the unknowns, as on the gloss of a clear coat of weight 0
            return Curvature()
        for key, square in squares.items():
            square += one[key][0] * other[key][0]
            if key in noisy:
                noisy[key] += one[key][1] * other[key][1]
            if key in stored and made < most:
                stored[key].append((one[key][0].astype(np.float32), other[key][0].astype(np.float32)))
        made += 1
    overlaps = {key: overlap(of) if len(of) >= FEWEST_PROBES else np.inf for key, of in stored.items()}
    smooth = {key: _smooth_eigenvalue(squares[key] / made, of) for key, of in stored.items()}
    means, variances = (
        {
            key: periodic.repeat(np.maximum(x / made, 0.0), problem.unknowns[key].measure.repeated)
            for key, x in sums.items()
        }
        for sums in (squares, noisy)
    )
    return Curvature(means, overlaps, smooth, made, variances)


def root_of_covariance(variance: np.ndarray | float, correlation: float) -> np.ndarray:
    """Return a and b (..., 2) of the root a I + b 11ᵀ of the covariance of three channels, whose correlation is limited to [0, 1].

    `variance` has the shape (..., 1).
    """
    correlation = min(max(correlation, 0.0), 1.0)
    own, both = math.sqrt(1.0 - correlation), math.sqrt(1.0 + 2.0 * correlation)
    return np.sqrt(variance) * np.array([own, (both - own) / 3.0])


def shown_elsewhere(problem: Problem, sensitivity: np.ndarray | None, step: np.ndarray | float, least: float) -> bool:
    """Return whether a view beside those of `selected_views` may change by a root mean square of `least`, for this `step` of the elements.
    It is False for a `sensitivity` of all views that is unknown."""
    if sensitivity is None or len(selected_views(problem)) == len(problem.views):
        return False
    largest = max(height * width for height, width in problem.sizes)
    return float(np.sum(np.square(sensitivity * step, dtype=np.float64))) > 3 * largest * least**2


def _smooth_eigenvalue(squares: np.ndarray, stored: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Return tr(SAS) / tr(SS) of `Curvature`, at least 1, by the probes' projections; infinite for too few, or without a curvature."""
    if len(stored) < FEWEST_PROBES or not (squares > 0.0).any():
        return np.inf
    diagonal = squares.mean(axis=-1)
    counted = diagonal > COUNTED * np.median(diagonal[diagonal > 0.0])
    roots = np.where(counted, np.sqrt(np.maximum(diagonal, 1e-300)), np.inf)[..., None]
    signs, total, white = np.random.default_rng(0), 0.0, 0.0
    for pair in stored:
        one, other = (neighbour_means(x / roots, channels=True) for x in pair)
        sign = signs.choice((-1.0, 1.0), size=squares.shape) * counted[..., None]
        total, white = (
            total + float(np.sum(one * other)),
            white + float(np.sum(np.square(neighbour_means(sign, channels=True)))),
        )
    return max(1.0, total / white)


def map_keys(problem: Problem) -> list[str]:
    """Return the keys of the textures and grids among the unknowns."""
    return [key for key, shape in problem.shapes().items() if len(shape) >= MAP_AXES]


def mask_roots(problem: Problem, view: int) -> np.ndarray:
    """Return the roots of the weights of a view's pixels, times the view's unit, (H, W, 1)."""
    return np.sqrt(np.asarray(problem.test_weights(view), np.float64))[..., None] * problem.units[view]


def transposed(
    problem: Problem, values: Mapping[str, np.ndarray], pictures: Sequence[np.ndarray], passes: int, key: Key
) -> dict[str, np.ndarray]:
    """Return {key: mean of `passes` estimates of Jᵀx}, unbiased, for a picture x (H, W, 3) of each view."""
    session, keys = derivative_session(problem)
    if session is None:
        return {}
    parameters, spp = off_ends(as_tree(problem, values), problem.renderer.parameters()), adjoint_spp(problem)
    count, each = len(pictures), [picture[None] for picture in pictures]
    seeds = [{view: key.fold(number * count + view) for view in range(count)} for number in range(passes)]
    parts = [adjoints(problem, session, parameters, keys, spp, of, each) for of in seeds]
    return {name: np.mean([part[name][0] for part in parts], axis=0) for name in keys}


def around(values: np.ndarray) -> np.ndarray:
    """Return the root of the median over neighbouring cells of the mean square over channels: (..., channels) -> (...).

    It lowers the noise of single elements from few probes, and keeps the border between seen and unseen cells. Paths that are fewer than
    the cells leave most seen ones at 0, so it is then the root of the mean over a window with some other cells that paths have reached.
    """
    from scipy.ndimage import median_filter, uniform_filter  # takes long to import

    squares, side = np.mean(np.square(values, dtype=np.float64), axis=-1), 3
    reached = squares > 0.0
    while side < min(squares.shape) // _WINDOWS and reached.any():
        counts = uniform_filter(reached.astype(np.float64), side, mode="nearest") * side**squares.ndim
        if np.median(counts[reached]) >= _REACHED:
            break
        side += 2
    means = (median_filter if side == 3 else uniform_filter)(squares, side, mode="nearest")
    return np.sqrt(np.maximum(means, 0.0))  # of running sums, so some may be below 0


def neighbour_means(cells: np.ndarray, channels: bool = False) -> np.ndarray:
    """Return the means over neighbouring cells, those of a cell included. With `channels`, the last axis is one of channels."""
    from scipy.ndimage import uniform_filter  # takes long to import

    sides: Any = [3] * (cells.ndim - channels) + [1] * channels
    return uniform_filter(cells, sides, mode="nearest")


def insensitive(values: np.ndarray) -> np.ndarray:
    """Return a mask (...) of the cells of a texture or grid whose smoothed `sensitivity` (..., channels) is below a tenth of that of the
    cells which the images show, see `_typical`."""
    smoothed = around(values)
    return smoothed <= _INSENSITIVE * _typical(smoothed)


def _typical(sensitivity: np.ndarray) -> float:
    """Return the sensitivity above which elements have half of the sum; most elements may be unseen, so it is not their median."""
    ordered = np.sort(sensitivity, axis=None)
    sums = np.cumsum(ordered, dtype=np.float64)
    return float(ordered[np.searchsorted(sums, 0.5 * sums[-1])])


def seen_cells(values: np.ndarray) -> np.ndarray | None:
    """Return a mask (...) of the cells of a texture or grid that affect the images, from `sensitivity`; None for other parameters."""
    return ~insensitive(values) if values.ndim >= MAP_AXES and values.size else None


def seen_elements(values: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of the elements of a list, such as one of vertices, whose own sensitivity is at least a twentieth of that of the
    elements which the images show, see `_typical`. Few probes leave it uncertain for single elements."""
    return values > _INSENSITIVE_ALONE * _typical(values)


def adjoint_spp(problem: Problem) -> int:
    """Return the samples per pixel of an adjoint: 4, or fewer if the views have more than 2¹⁸ pixels in total, or more below 64."""
    return limited_spp(_PATHS, problem.pixels, (1, _MOST_SPP))


def derivative_session(problem: Problem) -> tuple[RenderSession | None, frozenset[str]]:
    """Return a session with derivatives and their keys: all, or all differentiable ones but poses; None without path gradients."""
    known, keys = problem.renderer.parameters(), list(problem.shapes())
    for chosen in (keys, [key for key in keys if known[key].differentiable and not known[key].rigid]):
        if chosen:
            try:
                return problem.renderer.prepare(keys, None, derivatives=frozenset(chosen)), frozenset(chosen)
            except InputError:
                continue
    return None, frozenset()


def _projections(
    problem: Problem,
    session: RenderSession,
    parameters: Tree,
    keys: frozenset[str],
    spp: int,
    key: Key,
    half: int,
    views: int | None,
    noise: Sequence[np.ndarray],
) -> dict[str, np.ndarray]:
    """Return {key: Jᵀs, and Jᵀ√Σ s with noise} for the signs s of a probe, on one of its two sets of paths."""
    signs, pictures = np.random.default_rng(key.uint32()), []
    for view in range(len(problem.views))[:views]:
        image = signs.choice(np.array([-1, 1], np.float32), size=(*problem.sizes[view], 3)) * mask_roots(problem, view)
        images = [image]
        if noise:
            own, shared = np.split(noise[view], 2, axis=-1)
            images.append(own * image + shared * image.sum(axis=-1, keepdims=True))
        pictures.append(np.stack(images))
    seeds = {view: key.fold(2 * view + half) for view in range(len(pictures))}
    return adjoints(problem, session, parameters, keys, spp, seeds, pictures)


def adjoints(
    problem: Problem,
    session: RenderSession,
    parameters: Tree,
    keys: Collection[str],
    spp: int,
    seeds: Mapping[int, Key],
    pictures: Sequence[np.ndarray],
) -> dict[str, np.ndarray]:
    """Return {key: Jᵀx, (k, *shape)} of k pictures x (k, H, W, 3) for each view of `seeds`, from one rendering of the view."""
    count = len(pictures[0])
    sums = {key: np.zeros((count, *shape)) for key, shape in problem.shapes().items() if key in keys}
    for (view, seed), parts in zip(seeds.items(), pictures, strict=True):
        rendering = session.image(parameters, view_request(problem, view, spp, seed.uint32()))
        shape = arrays.shape(rendering.images)
        timing.add(*_cost(problem, keys, spp, view, count))
        for index, part in enumerate(parts):
            weights = problem.renderer.array(part.astype(np.float32).reshape(shape))
            gradient = session.adjoint(parameters, rendering.paths, weights)
            for name, total in sums.items():
                total[index] += arrays.numpy(gradient[name]).reshape(total.shape[1:])
    return sums


def seconds_of_probe(problem: Problem, spent: float, cost: float, pictures: int) -> float:
    """Return the seconds of a probe of the curvature with this number of pictures for each view, where others of a `timing.cost` took
    `spent` seconds."""
    costs = (_cost(problem, problem.shapes(), adjoint_spp(problem), v, pictures) for v in range(len(problem.views)))
    return 2.0 * sum(timing.cost(*of) for of in costs) * (1.0 if timing.counts() else spent / cost)


def _cost(problem: Problem, keys: Collection[str], spp: int, view: int, pictures: int) -> tuple[float, int]:
    """Return the paths and launches of a rendering of a view with the adjoints of this number of pictures."""
    known = problem.renderer.parameters()
    paths, launches = _BOUNDARY if any(known[key].rigid or known[key].welded for key in keys) else (0, 0)
    count = (1.0 + (ADJOINT + paths) * pictures) * spp * math.prod(problem.sizes[view])
    return count, 1 + (1 + launches) * pictures
