"""What somebody would do by hand for a reflectance that is seen directly: multiply each texel by reference over rendering."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import SampleRequest, mi, prepare
from benchmarks.stock_loop import step_seed

_WHOLE = 3
"""Steps that are made whole; later ones are made in part, as noise has to be averaged."""
_SUFFIXES = ("reflectance.data", "base_color.data")


def applies(problem: ur.Problem) -> bool:
    """Whether all unknowns are textures of reflectances."""
    return all(key.endswith(_SUFFIXES) for key in problem.shapes())


def fixed_point(
    problem: ur.Problem, spp: int, seconds: float, seed: int, error: Callable[[dict[str, Any]], float]
) -> list[tuple[float, float]]:
    """x ← x (Jᵀ R / Jᵀ I)^c, c = min(1, 3 / (k + 1)) at step k, with the Jacobian J of one set of paths for both, and I of another.

    For a texture that the camera sees directly, Jᵀ R / Jᵀ I is the mean of the pixels' reference over that of their rendering.
    Returns (seconds, error) of each step; the first step, which compiles, is made twice and timed once. Errors are not timed.
    """
    keys = list(problem.shapes())
    session = prepare(problem, keys)
    references = [problem.renderer.array(np.asarray(view.reference)[None]) for view in problem.views]
    history: list[tuple[float, float]] = []
    for warm in (True, False):
        x = {key: np.array(value, np.float32) for key, value in problem.initial().items()}
        clock, step = 0.0, 0
        while clock < seconds and step < (1 if warm else 1 << 30):
            began = time.perf_counter()
            values = {key: mi.TensorXf(value) for key, value in x.items()}
            above, below = ({key: np.zeros(value.shape) for key, value in x.items()} for _ in range(2))
            for view, reference in enumerate(references):
                sensor, number = problem.views[view].sensor, step_seed(seed, step, view)
                image = session.image(values, SampleRequest(sensor, spp, number)).images
                paths = session.image(values, SampleRequest(sensor, spp, number + 1)).paths
                for weights, sums in ((reference, above), (image, below)):
                    for key, found in session.adjoint(values, paths, weights).items():
                        sums[key] += np.array(found, np.float64).reshape(sums[key].shape)
            part = min(1.0, _WHOLE / (step + 1))
            for key, value in x.items():
                known = (above[key] > 0) & (below[key] > 0)
                ratio = np.where(known, above[key], 1.0) / np.where(known, below[key], 1.0)
                low, high = problem.unknowns[key].bounds
                x[key] = np.clip(value * ratio**part, low, high).astype(np.float32)
            clock += time.perf_counter() - began
            step += 1
            if not warm:
                history.append((clock, error({key: mi.TensorXf(value) for key, value in x.items()})))
    return history
