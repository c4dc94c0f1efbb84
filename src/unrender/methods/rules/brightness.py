"""Factors of unknown lights at the start, by least squares: images are linear in them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.methods.rules.constants import Constants
from unrender.scene.problem import Problem
from unrender.scene.render import power_of_two, render, selected_views
from unrender.statistics.debiased import normal_equations

_SEEDS = (11, 12)
"""Seeds of two independent halves."""
_MOST_PIXELS = 1 << 19
"""Maximum number of pixels of the views, of which the first is always rendered."""
_PATHS, _SPP = 1 << 17, (2, 64)
"""Path budget of the images of one state, and limits of their samples per pixel."""
_LIMIT = 1e4
"""Largest factor, and reciprocal of the smallest."""
_BETTER = 0.25
"""Ratio of the mean square residuals with and without the factors below which the factors are used."""


def start_factors(problem: Problem, keys: Sequence[str], constants: Constants) -> dict[str, float]:
    """Return {key: factor} of the lights' initial values if one is far from 1 and factors reduce the residual well, else {}.

    With D_k, the image of light k alone, f minimises ‖I + Σ (f_k − 1) D_k − R‖². Its normal equations are products of two independent
    halves, so noise does not bias them. The other unknowns are at their start, so factors are no better than these.

    A start that is ten times too bright costs Adam more steps than one that is ten times too dark: its second moments remember the first
    gradients, which are a hundred times as large as the later ones.

    The problem's own loss must be less, too. A saturated reference, for example, says nothing against a brighter image.

    Args:
        keys: Keys of unknown lights.
        constants: Constants of the rules; `far_light` is the least ratio that counts as far.
    """
    if not keys or not problem.loss.pixelwise:
        return {}
    try:
        factors, change, less = _least_squares(problem, keys)
    except (InputError, np.linalg.LinAlgError):  # a value that the renderer rejects
        return {}
    far = max((max(f, 1.0 / f) for f in factors.values() if f > 0.0), default=1.0) > constants.far_light
    usable = all(math.isfinite(f) and 1.0 / _LIMIT < f < _LIMIT for f in factors.values())
    return factors if usable and far and change < _BETTER and less else {}


def _least_squares(problem: Problem, keys: Sequence[str]) -> tuple[dict[str, float], float, bool]:
    """Return the factors, the ratio of the mean square residuals with and without them, and whether the loss is less with them."""
    start, selected = problem.initial_values(), selected_views(problem)
    ends = np.cumsum([math.prod(problem.sizes[view]) for view in selected])
    most = max(int((ends <= _MOST_PIXELS).sum()), 1)
    views, pixels = selected[:most], int(ends[most - 1])
    spp = power_of_two(min(max(_PATHS // pixels, _SPP[0]), _SPP[1]))
    states: list[Mapping[str, np.ndarray]] = [start, *({**start, key: 2.0 * start[key]} for key in keys)]
    count = len(keys)
    matrix, vector, squares, means = np.zeros((count, count)), np.zeros(count), 0.0, {}
    for view in views:
        own = problem.views[view]
        weight = own.weight * own.pixel_weights(problem.sizes[view]).reshape(*problem.sizes[view], 1)
        halves = [np.stack([render(problem, x, view, spp, seed) for x in states]).astype(np.float64) for seed in _SEEDS]
        reference = np.asarray(own.reference)
        finite = np.asarray(np.isfinite(np.stack(halves)).all(axis=(0, 1, -1)))[..., None]
        halves = [np.where(finite, images, reference) for images in halves]  # neither residual nor light in the others
        means[view] = (halves[0] + halves[1]) / 2.0
        residuals = [reference - images[0] for images in halves]
        parts = normal_equations([images[1:] - images[0] for images in halves], residuals, weight)
        matrix, vector = matrix + parts[0], vector + parts[1]
        squares += float((residuals[0] * residuals[1] * weight).sum())
    step = np.linalg.solve(matrix, vector)
    after = squares - 2.0 * float(step @ vector) + float(step @ matrix @ step)
    factors = {key: 1.0 + float(x) for key, x in zip(keys, step, strict=True)}
    less = _loss(problem, means, step) < _loss(problem, means, np.zeros(count))
    return factors, max(after, 0.0) / squares if squares > 0.0 else 1.0, less


def _loss(problem: Problem, images: Mapping[int, np.ndarray], step: np.ndarray) -> float:
    """Return the loss of views from the images of all states and the change of each light's factor."""
    changed = {view: of[0] + np.tensordot(step, of[1:] - of[0], 1) for view, of in images.items()}
    return sum(arrays.number(problem.loss_value(view, problem.renderer.array(x))) for view, x in changed.items())
