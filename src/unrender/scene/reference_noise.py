"""The noise of reference pictures, estimated from the pictures themselves."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from unrender.core import arrays

if TYPE_CHECKING:
    from unrender.scene.problem import Problem

_MEDIAN = 0.6744897501960817
"""Median of |z| of a standard normal z."""
_LEAST = 1e-4
"""Least noise, in units of the picture's root mean square: no picture is exact."""


def standard_deviation(reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the standard deviation of the noise of a picture (H, W, 3), in its units.

    It is the scaled median of (x_ij − x_i+1,j − x_i,j+1 + x_i+1,j+1) / 2, which is 0 for pictures that are linear along either axis, and
    has the noise's standard deviation where noise is independent between pixels. Edges change few of these values. Fine texture counts
    as noise, and noise that neighbouring pixels share, as that of wide film filters, is underestimated.

    Args:
        reference: (H, W, 3). Values that are not finite are ignored.
        mask: (H, W); only differences of pixels above 0 count. None for all pixels.
    """
    picture = np.asarray(reference, np.float64)
    valid = np.isfinite(picture).all(axis=-1) & (True if mask is None else np.asarray(mask) > 0)
    size = math.sqrt(float(np.mean(picture[valid] ** 2))) if valid.any() else 0.0
    both = valid[1:, 1:] & valid[:-1, 1:] & valid[1:, :-1] & valid[:-1, :-1]
    twice = 0.5 * (picture[1:, 1:] - picture[:-1, 1:] - picture[1:, :-1] + picture[:-1, :-1])[both]
    deviation = float(np.median(np.abs(twice))) / _MEDIAN if twice.size else 0.0
    return max(deviation, _LEAST * size, 1e-12)


def likelihood_scale(problem: Problem) -> float:
    """Return s, the factor by which negative log densities of priors enter the loss L.

    A loss of |image − reference|^p per pixel is s times a negative log likelihood with s = p L(noise) / N. L(noise) is the loss of
    pictures that differ from the N values of the references by their noise alone. p is measured: L grows by 2^p when that noise is
    doubled.
    """
    once, twice, count = 0.0, 0.0, 0.0
    for index, view in enumerate(problem.views):
        reference = np.asarray(view.reference, np.float32)
        mask = None if view.mask is None else np.asarray(view.mask)
        sigma = standard_deviation(reference, mask)
        noise = np.random.default_rng(index).standard_normal(reference.shape).astype(np.float32) * np.float32(sigma)
        once += _loss(problem, index, reference + noise)
        twice += _loss(problem, index, reference + 2 * noise)
        count += reference.size if mask is None else float(mask.sum()) * reference.shape[-1]
    power = math.log2(twice / once) if 0 < once < twice < math.inf else 2.0
    return power * once / max(count, 1.0) if math.isfinite(once) else 0.0


def _loss(problem: Problem, view: int, image: np.ndarray) -> float:
    return arrays.number(problem.loss_value(view, problem.renderer.array(image)))
