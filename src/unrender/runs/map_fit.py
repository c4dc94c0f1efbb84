"""Textures, grids and meshes without a path gradient: whether a run has brought their pictures closer to the references."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from unrender.core.text import listed
from unrender.estimators.fresh_pictures import Residuals
from unrender.runs.determination import changed
from unrender.runs.numbers import TOO_SHORT
from unrender.runs.result import Result
from unrender.runs.verification import compares, misfit
from unrender.scene.problem import Problem

_ERRORS = 2.0
"""Number of standard errors by which a change must be above 0."""
_EXPLAINED, _OF_MESH, _TO_EXPLAIN = 0.2, 0.9, 0.02
"""Share of the square difference from the references that a map must have explained; that of a mesh, whose vertices may end anywhere while
its silhouette fits; and smallest difference relative to the picture, with the initial values, of which they must."""
_BRIGHT, _BUT, _OTHER = 0.05, ", but for its brightest pixels", ", or something that is not among the unknowns is wrong"
"""Share of the brightest pixels, without which a texture or grid is judged once more; words about these, and about another cause."""
_HIDDEN = "noise hides its cause"
"""Words of the line about a difference that may be noise or may not."""
_BLOCKS, _CHANCE, _APART = (1, 8, 1 << 30), 7.0, 3
"""Number of blocks of equal sign along each axis, for each tested change of a map; number of standard errors that chance does not reach,
also where the film's filter makes noise of adjacent pixels alike; distance of compared pixels, at which no filter does."""

Pictures = Callable[[Mapping[str, np.ndarray], int], Sequence[np.ndarray]]
"""Function of values and a view that returns independent pictures (H, W, 3)."""


def no_better_maps(
    problem: Problem,
    result: Result,
    keys: Sequence[str],
    ends: Sequence[Sequence[np.ndarray]],
    pictures: Pictures,
    in_time: bool = True,
) -> list[str]:
    """Return a line for each texture, grid or mesh with whose initial values the pictures are nearly as close to the references.

    It is for those without a path gradient, of which nothing else tells whether the pictures determine them. Where the pictures with the
    initial values agree with the references, there is nothing to explain. No map explains noise of the references, see `_may_explain`. Few
    random changes of a mesh change the pictures as its residual does, so that of a mesh must not be noise by `misfit`. If noise may be all
    that is left, the line says that it hides the cause.

    Args:
        keys: keys of textures, grids and vertices.
        ends: K >= 2 independent pictures (H, W, 3) of each view at the end.
        pictures: function of values and a view that returns such pictures with the same random numbers.
        in_time: whether there is time for this test; if not, one line says so.
    """
    lines = []
    judged = compares(problem) and result.verification.get("best") == "end" and len(ends[0]) > 1
    if judged and keys and not in_time:
        return [f"whether the pictures determine {listed(keys)}: {TOO_SHORT}"]
    for key in keys if judged else ():
        state, views = {**result.parameters, key: result.initial[key]}, range(len(ends))
        start, end = (
            Residuals.of(problem, views, images) for images in ([pictures(state, view) for view in views], ends)
        )
        line = _line(problem, result, key, start, end, pictures)
        if key not in problem.faces and (not line or _HIDDEN in line):
            line = _line(problem, result, key, *_dimmer(start, end), pictures, _BUT) or line
        lines += filter(None, [line])
    return lines


def _line(
    problem: Problem, result: Result, key: str, start: Residuals, end: Residuals, pictures: Pictures, but: str = ""
) -> str:
    """Return the line of `no_better_maps` for one key, "" for none, from the residuals with its initial and final values; `but` are words
    about pixels that these leave out."""
    first, last = start.products, end.products
    left, least = float(first.sum()), _TO_EXPLAIN**2 * 3.0 * start.size**2 * float(start.weights.sum())
    noise, fall = (_ERRORS * math.sqrt(float(np.square(x - x.mean()).sum())) for x in (first, first - last))
    share, is_mesh = 1.0 - float(last.sum()) / max(left, 1e-300), key in problem.faces
    explained = share * left > max(fall, (_OF_MESH if is_mesh else _EXPLAINED) * left)
    if explained or not left > max(noise, least):
        return ""
    remains = math.sqrt(max(1.0 - share, 0.0))
    if is_mesh or but:
        may = misfit(end, 0.0, by_pixel=True) is not None
    else:
        may = _may_explain(problem, result.parameters, key, end, pictures)
    if may:
        closer = "hardly" if share < _EXPLAINED else f"{1.0 - remains:.0%}"
        return (
            f"{key}: the final picture is {closer} closer to the references than with its initial values{but}: they hardly determine it, "
            f"or it needs more steps, or fewer {'vertices' if is_mesh else 'elements'}{_OTHER * bool(but)}"
        )
    if but:
        return ""
    return (
        f"{key}: whether the pictures determine it is not known: the final picture's difference from the references is "
        f"{remains:.0%} of that with its initial values, and {_HIDDEN}; use more steps, or more samples per pixel"
    )


def _dimmer(start: Residuals, end: Residuals) -> tuple[Residuals, Residuals]:
    """Return both without the brightest pixels: highlights, as of a lamp in a mirror, may hold nearly all of a difference."""
    bright = sum(np.abs(of.images.mean(axis=0) + of.references).sum(axis=1) * of.weights for of in (start, end))
    bright += 2.0 * start.references.sum(axis=1) * start.weights
    counted = (start.weights > 0.0) & (end.weights > 0.0)
    dim = bright <= (np.quantile(bright[counted], 1.0 - _BRIGHT) if counted.any() else 0.0)
    return replace(start, weights=start.weights * dim), replace(end, weights=end.weights * dim)


def _may_explain(
    problem: Problem,
    values: Mapping[str, np.ndarray],
    key: str,
    residuals: Residuals,
    pictures: Pictures,
) -> bool:
    """Return whether another map may explain the residuals: pictures change with it as the residuals do, or hardly change at all.

    The products of a residual that some map removes and of changes of the pictures by random changes of the map have a sum that is not 0,
    or pixels that are three apart share their sign. Noise of the references is independent of these changes, from pixel to pixel.
    """
    weights, sizes = residuals.weights, residuals.sizes
    generator, most, shown = np.random.default_rng(0), 0.0, False
    for blocks in _BLOCKS:
        signs = _signs(np.shape(values[key]), blocks, generator)
        state = {**values, key: changed(problem, key, np.asarray(values[key]), signs)}
        views = range(len(sizes))
        after = Residuals.of(problem, views, [pictures(state, view) for view in views])
        change = replace(after, images=(after.images - residuals.images) * (after.weights > 0)[:, None])
        (one, other), (first, second) = residuals.halves, change.halves
        along, square = (x.sum(axis=1) * weights for x in (one * second + other * first, first * second))
        most = max(most, abs(_score(along)), _score(_pairs(along, sizes)))
        shown |= float(square.sum()) > _ERRORS * math.sqrt(float(np.square(square - square.mean()).sum()))
    return most > _CHANCE or not shown


def _score(values: np.ndarray) -> float:
    """Return the sum of values in standard errors, if their mean is 0."""
    return float(values.sum()) / max(math.sqrt(float(np.square(values).sum())), 1e-150)


def _pairs(values: np.ndarray, sizes: Sequence[tuple[int, int]]) -> np.ndarray:
    """Return the products of the values of pixels that are three apart, from those of the pixels of all views, (N,)."""
    ends = np.cumsum([height * width for height, width in sizes])[:-1]
    images = [part.reshape(size) for part, size in zip(np.split(values, ends), sizes, strict=True)]
    pairs = [[x[_APART:] * x[:-_APART], x[:, _APART:] * x[:, :-_APART]] for x in images]
    return np.concatenate([product.ravel() for pair in pairs for product in pair])


def _signs(shape: tuple[int, ...], blocks: int, generator: np.random.Generator) -> np.ndarray:
    """Return random signs of this shape, equal in each of up to `blocks` blocks along each axis, and for all channels of a texture."""
    axes = shape[:-1] if len(shape) > 2 else shape
    counts = [min(blocks, size) for size in axes]
    places = [np.arange(size) * count // size for size, count in zip(axes, counts, strict=True)]
    signs = generator.choice([-1.0, 1.0], counts)[np.ix_(*places)]
    return np.broadcast_to(signs if len(shape) < 3 else signs[..., None], shape)
