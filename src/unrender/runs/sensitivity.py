"""How much the images tell of each element of the parameters."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np

from unrender.core import arrays, checks, periodic
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.rendering.renderer import RenderSession
from unrender.scene.bounds import off_ends
from unrender.scene.problem import Problem
from unrender.scene.render import as_tree, view_request

_PROBES, _MOST_SPP, _PATHS = 32, 4, 1 << 20
_MAP_AXES = 3
_HARDLY = 0.05
"""Of the median: elements that change the images less are hardly seen."""


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
    """√diag(JᵀJ) with J the derivative of all views' pixels by the parameters: by how much, as the root of the sum of squares over pixels
    and channels, the images change per unit of each element.

    Where it is small, the images tell nothing of an element, and what is recovered there is noise or smoothing: JᵀJ is the Gauss-Newton
    Hessian of L2, and with noise σ in each pixel of the references no estimate of the element alone has a smaller standard deviation than
    σ over this.

    diag(JᵀJ) is the expectation of (Jᵀs)² over images s of independent signs. The two factors are adjoints on separate paths, so that the
    product is unbiased; the root, and negative estimates that become 0, are not.

    Args:
        problem: its views and scene.
        values: {key: array}; None for the initial ones.
        probes: images of signs, >= 1. The standard error of the square is about √(2/probes) of it.
        spp: samples per pixel of each adjoint, >= 1; None for 4, or fewer where the views have more than 2¹⁸ pixels together.
        seconds: after which no further probe is begun; there is one at least.
        seed: of all random numbers.
        views: how many views to render, the first ones, >= 1; None for all.

    Returns:
        {key: array} of the parameters' shapes, float32; {} where path gradients do not reach a parameter.

    Raises:
        InputError: `values` have other keys or shapes than the problem's; `probes` or `spp` below 1.
    """
    checks.integer("sensitivity", "probes", probes, at_least=1)
    if spp is None:
        spp = min(max(_PATHS // problem.pixels, 1), _MOST_SPP)
    checks.integer("sensitivity", "spp", spp, at_least=1)
    try:
        session = problem.renderer.prepare(list(problem.shapes()), None)
    except InputError:
        return {}
    parameters = off_ends(as_tree(problem, values), problem.renderer.parameters())
    squares = {key: np.zeros(shape) for key, shape in problem.shapes().items()}
    made, until = 0, time.perf_counter() + seconds
    while made == 0 or (made < probes and time.perf_counter() < until):
        one, other = (
            _projections(problem, session, parameters, spp, Key(seed, made), half, views) for half in range(2)
        )
        for key, square in squares.items():
            square += one[key] * other[key]
        made += 1
    roots = {key: np.sqrt(np.maximum(square / made, 0.0)).astype(np.float32) for key, square in squares.items()}
    return {key: periodic.repeat(root, problem.unknowns[key].measure.repeated) for key, root in roots.items()}


def around(found: np.ndarray) -> np.ndarray:
    """The root mean square of an array of `sensitivity` over channels and the cells around each: (..., channels) -> (...).

    Few probes leave much noise in a single element.
    """
    from scipy.ndimage import uniform_filter

    means = uniform_filter(np.mean(np.square(found, dtype=np.float64), axis=-1), 3, mode="nearest")
    return np.sqrt(means.clip(min=0.0))  # running sums round to less than 0 beside large values


def hardly_seen(found: np.ndarray) -> np.ndarray:
    """Which cells of a texture or grid, with those around them, change the images by less than a twentieth of the median of those that do.

    Args:
        found: of `sensitivity`, (..., channels).

    Returns:
        (...), truth values.
    """
    whole = around(found)
    return whole <= _HARDLY * np.median(whole[whole > 0]) if (whole > 0).any() else np.ones(whole.shape, bool)


def seen_cells(found: np.ndarray) -> np.ndarray | None:
    """Return the cells of a texture or grid that change the images, (...) truth values; None for what is neither.

    Args:
        found: of `sensitivity`, (..., channels).
    """
    return ~hardly_seen(found) if found.ndim >= _MAP_AXES and found.size else None


def _projections(
    problem: Problem, session: RenderSession, parameters: Tree, spp: int, key: Key, half: int, views: int | None
) -> dict[str, np.ndarray]:
    """{key: Jᵀs}: of the signs s of a probe, on one of its two halves' paths."""
    found = {key: np.zeros(shape) for key, shape in problem.shapes().items()}
    signs = np.random.default_rng(key.uint32())
    for view in range(len(problem.views))[:views]:
        rendering = session.image(parameters, view_request(problem, view, spp, key.fold(2 * view + half).uint32()))
        weights = signs.choice(np.array([-1, 1], np.float32), size=arrays.shape(rendering.images))
        for name, value in session.adjoint(parameters, rendering.paths, problem.renderer.array(weights)).items():
            found[name] += arrays.numpy(value).reshape(found[name].shape)
    return found
