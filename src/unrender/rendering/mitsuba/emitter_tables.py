"""Probabilities of emitter sampling: the scene's own, other probabilities as tables of a kernel, and moments of connections.

Mitsuba stores an emitter's `sampling_weight` on the host, so a recorded kernel would treat it as a constant. Probabilities that change
are therefore tables, and the scene's own weights do not change.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.rendering.renderer import EmitterMoments


def own_probabilities(scene: mi.Scene) -> np.ndarray:
    """Return Mitsuba's probabilities in the order of the scene's emitters, (E,), from their sampling weights; all 0 without weights."""
    weights = np.array([emitter.sampling_weight() for emitter in scene.emitters()], np.float64)
    return weights / weights.sum() if weights.sum() > 0 else weights


def emitter_tables(scene: mi.Scene, probabilities: np.ndarray) -> dict[str, mi.UInt32 | mi.Float]:
    """Return the tables of emitter sampling.

    - "emitter_cdf": 0 and the cumulative sums of the probabilities, (E + 1,).
    - "emitter_ids": registry id of each emitter, (E,).
    - "emitter_pmf": probability by registry id.

    Raises `InputError` if the number of probabilities is not E, one is negative, or their sum is not 1.
    """
    ids = _ids(scene)
    p = np.asarray(probabilities, np.float64)
    if p.shape != ids.shape or not (p >= 0).all() or not abs(p.sum() - 1) < 1e-6:
        raise InputError(
            f"emitters: expected the probabilities of {len(ids)} emitters, of sum 1, got an array of shape {p.shape}"
        )
    cdf = np.concatenate([[0.0], np.cumsum(p)]).astype(np.float32)
    last = int(np.flatnonzero(p)[-1])
    cdf[last + 1 :] = 1.0
    pmf = np.zeros(int(ids.max(initial=0)) + 1, np.float32)
    pmf[ids] = np.diff(cdf)  # from the rounded CDF, so the densities match the samples exactly
    numbers = arrays.owned(ids.astype(np.uint32), mi.UInt32)
    return {
        "emitter_cdf": arrays.owned(cdf, mi.Float),
        "emitter_ids": numbers,
        "emitter_pmf": arrays.owned(pmf, mi.Float),
    }


def connection_moments(scene: mi.Scene, values: mi.Float, emitters: mi.UInt32) -> EmitterMoments:
    """Return the moments by emitter of the connections' values. Each has the registry id of its emitter, 0 for none.

    A value that is not finite counts as 0. The sums run on the host in a fixed order. Atomic sums on a device would differ in their last
    bits between runs.
    """
    ids = _ids(scene)
    index = np.full(int(ids.max(initial=0)) + 1, len(ids))
    index[ids] = np.arange(len(ids))
    where, y = index[emitters.numpy()], values.numpy().astype(np.float64)
    y = np.where(np.isfinite(y), y, 0.0)
    sums, squares = (np.bincount(where, of, len(ids) + 1)[:-1] for of in (y, y * y))
    return EmitterMoments(sums, squares)


def _ids(scene: mi.Scene) -> np.ndarray:
    pointers: Any = scene.emitters_dr()
    ids: Any = dr.reinterpret_array(mi.UInt32, pointers)
    return ids.numpy().astype(np.int64)
