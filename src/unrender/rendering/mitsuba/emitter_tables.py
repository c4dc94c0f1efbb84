"""Which emitter a connection takes: the scene's own probabilities, others as tables of a kernel, and what connections of a replay tell.

Mitsuba keeps an emitter's `sampling_weight` as a number of the host, which a recorded kernel would hold as a constant: so
probabilities that change are tables, and the scene's own weights stay as they are.
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
    """Mitsuba's, in the order of the scene's emitters, (E,): by their sampling weights."""
    weights = np.array([emitter.sampling_weight() for emitter in scene.emitters()], np.float64)
    return weights / weights.sum() if weights.sum() > 0 else weights


def emitter_tables(scene: mi.Scene, probabilities: np.ndarray) -> dict[str, mi.UInt32 | mi.Float]:
    """{"emitter_cdf": 0 and the sums of the probabilities, (E + 1,); "emitter_ids": registry id of each emitter, (E,); "emitter_pmf":
    probability by registry id}.

    Raises `InputError` for another number of probabilities than emitters, negative ones, or a sum that is not 1.
    """
    ids = _ids(scene)
    given = np.asarray(probabilities, np.float64)
    if given.shape != ids.shape or not (given >= 0).all() or not abs(given.sum() - 1) < 1e-6:
        raise InputError(
            f"emitters: expected the probabilities of {len(ids)} emitters, of sum 1, got an array of shape {given.shape}"
        )
    cdf = np.concatenate([[0.0], np.cumsum(given)]).astype(np.float32)
    last = int(np.flatnonzero(given)[-1])
    cdf[last + 1 :] = 1.0
    pmf = np.zeros(int(ids.max(initial=0)) + 1, np.float32)
    pmf[ids] = np.diff(cdf)  # of what is drawn, to the last bit
    numbers = arrays.owned(ids.astype(np.uint32), mi.UInt32)
    return {
        "emitter_cdf": arrays.owned(cdf, mi.Float),
        "emitter_ids": numbers,
        "emitter_pmf": arrays.owned(pmf, mi.Float),
    }


def connection_moments(scene: mi.Scene, values: mi.Float, emitters: mi.UInt32) -> EmitterMoments:
    """Sums by emitter of the values of connections, each with the registry id of its emitter, 0 for none.

    On the host, in a fixed order: sums of a device's atomic operations would differ in their last bits from run to run.
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
    found: Any = dr.reinterpret_array(mi.UInt32, pointers)
    return found.numpy().astype(np.int64)
