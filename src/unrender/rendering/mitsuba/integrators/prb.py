"""Mitsuba's own path replay, for parameters that move geometry."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from unrender.rendering.mitsuba.integrators.base import Bool, Float, PathContext, Spectrum
from unrender.rendering.mitsuba.integrators.path import PathPair


class PrbKernel:
    """Mitsuba's `prb` as a `PathKernel`, for parameters that move geometry. Its adjoint is the continuous part of their derivative. It
    omits visibility, which `BoundaryIntegrator` adds for meshes."""

    def __init__(self, max_depth: int, rr_depth: int = 5):
        self._integrator: Any = mi.load_dict({"type": "prb", "max_depth": max_depth, "rr_depth": rr_depth})
        self._depths = max_depth, rr_depth

    def sample(
        self, context: PathContext, sampler: Any, ray: mi.RayDifferential3f, active: Bool | bool = True
    ) -> tuple[Spectrum, None]:
        """Trace one path per lane, see `PathKernel.sample`. Raise `ValueError` for pairs and for `geometry`, which `prb` does not
        support."""
        if context.pair or context.posed is not None:
            raise ValueError("prb: expected one state and the scene's own geometry")
        δL, state_in = (context.replay[0].δL, context.replay[0].radiance) if context.replay else (None, None)
        radiance = self._integrator.sample(context.mode, context.scene, sampler, ray, δL, state_in, mi.Bool(active))[0]
        return radiance, None

    def vertices(self, context: PathContext, sampler: Any, ray: mi.RayDifferential3f) -> Float:
        """Return the number of vertices per lane of paths with the same distribution, see `PathKernel.vertices`."""
        return PathPair(*self._depths).vertices(context, sampler, ray)
