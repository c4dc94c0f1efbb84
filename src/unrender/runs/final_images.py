"""The final pictures of a run, for its report."""

from __future__ import annotations

import numpy as np

from unrender.io.thumbnails import resize_nearest
from unrender.problem.problem import Problem
from unrender.problem.render import render
from unrender.runs.result import Result

__all__ = ["render_pictures"]

_PICTURE_PATHS = 1 << 22
_FEWEST, _MOST = 16, 512


def render_pictures(problem: Problem, result: Result, spp: int | None = None) -> dict[str, np.ndarray]:
    """Reference, initial and final picture of each view, the control weight and the probability of pixels where there are any.

    Args:
        problem: what was run.
        result: its outcome.
        spp: samples per pixel, or None for as many as some four million paths per picture allow.
    """
    weights, probabilities = (result.info.get(name, {}) for name in ("control_weight", "pixel_probability"))
    found: dict[str, np.ndarray] = {}
    for index, view in enumerate(problem.views):
        reference = np.asarray(view.reference, np.float32)
        samples = spp or min(max(_PICTURE_PATHS // (reference.size // 3), _FEWEST), _MOST)
        found[f"view{index}/reference"] = reference
        found[f"view{index}/initial"] = render(problem, result.initial, index, samples, seed=1)
        found[f"view{index}/result"] = render(problem, result.parameters, index, samples, seed=2)
        if index in weights:
            found[f"view{index}/control_weight"] = np.asarray(weights[index], np.float32)
        if index in probabilities:
            density = np.asarray(probabilities[index], np.float32)
            found[f"view{index}/pixel_probability"] = resize_nearest(density, *reference.shape[:2])
    return found
