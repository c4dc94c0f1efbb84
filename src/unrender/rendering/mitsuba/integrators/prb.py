"""Mitsuba's own path replay, for parameters that move geometry."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.array_types import Bool, Float, Spectrum
from unrender.rendering.mitsuba.integrators.base import ReplayState
from unrender.rendering.mitsuba.integrators.path import PathPair


class PrbKernel:
    """Mitsuba's `prb` as a `PathKernel`, for parameters that move geometry. Its adjoint is the continuous part of their derivative. It
    omits visibility, which `BoundaryIntegrator` adds for meshes."""

    def __init__(self, max_depth: int, rr_depth: int = 5):
        self._integrator: Any = mi.load_dict({"type": "prb", "max_depth": max_depth, "rr_depth": rr_depth})
        self._depths = max_depth, rr_depth

    def sample(
        self,
        mode: dr.ADMode,
        scene: mi.Scene,
        tables: Mapping[str, Any],
        sampler: Any,
        ray: mi.RayDifferential3f,
        replay: tuple[ReplayState, ...] = (),
        pair: bool = False,
        geometry: Any = None,
        active: Bool | bool = True,
    ) -> tuple[Spectrum, None]:
        """Trace one path per lane, see `PathKernel.sample`. Raise `ValueError` for pairs and for `geometry`, which `prb` does not
        support."""
        del tables
        if pair or geometry is not None:
            raise ValueError("prb: expected one state and the scene's own geometry")
        δL, state_in = (replay[0].δL, replay[0].radiance) if replay else (None, None)
        return self._integrator.sample(mode, scene, sampler, ray, δL, state_in, mi.Bool(active))[0], None

    def vertices(
        self, scene: mi.Scene, tables: Mapping[str, Any], sampler: Any, ray: mi.RayDifferential3f, geometry: Any = None
    ) -> Float:
        """Return the number of vertices per lane of paths with the same distribution, see `PathKernel.vertices`."""
        return PathPair(*self._depths).vertices(scene, tables, sampler, ray, geometry)
