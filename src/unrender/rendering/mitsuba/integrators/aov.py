"""Properties of the first surface that each camera ray hits, in place of radiance: Mitsuba's arbitrary output variables (AOVs)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.base import Bool, Float, PathContext, Spectrum


class AovKernel:
    """One property of the first surface as a `PathKernel`: the names and values are those of Mitsuba's `aov` integrator.

    The property is 0 where a ray hits nothing. It is attached to all parameters that it depends on: vertex positions move the hit along a
    fixed ray. The motion of silhouettes is left to `BoundaryIntegrator`.

    Args:
        name: "depth", "position", "sh_normal", "albedo", or "mask", which is 1 where a ray hits a surface.
    """

    def __init__(self, name: str):
        self.name = name

    def sample(
        self, context: PathContext, sampler: Any, ray: mi.RayDifferential3f, active: Bool | bool = True
    ) -> tuple[Spectrum, None]:
        """Trace one ray per lane, see `PathKernel.sample`. Raise `ValueError` for pairs."""
        if context.pair:
            raise ValueError("aov: expected one state")
        with context.resume_grad():
            lanes: Any = mi.Bool(active)
            si = context.geometry.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=lanes, active=lanes)
            value = self.value(context.materials([si])[0] if self.name == "albedo" else si, ray, active)
            if not context.primal and dr.grad_enabled(value):
                if context.forward:
                    return dr.forward_to(value), None
                dr.backward_from(context.adjoint_sum([value]))
        return dr.detach(value) * (0 if context.forward else 1), None

    def value(self, si: Any, ray: Any, active: Any) -> Any:
        """Return the property of surface interactions, in three channels."""
        hit = si.is_valid() & active
        if self.name == "mask":
            return dr.select(hit, mi.Spectrum(1), 0)
        if self.name == "depth":
            return mi.Spectrum(dr.select(hit, si.t, 0))
        if self.name == "albedo":
            return dr.select(hit, si.bsdf(ray).eval_diffuse_reflectance(si, hit), 0)
        vector = si.p if self.name == "position" else si.sh_frame.n
        return dr.select(hit, mi.Spectrum(vector.x, vector.y, vector.z), 0)

    def vertices(self, context: PathContext, sampler: Any, ray: mi.RayDifferential3f) -> Float:
        """Return the number of vertices per lane, see `PathKernel.vertices`: 1 where the ray hits a surface, else 0."""
        geometry: Any = context.geometry
        return dr.select(geometry.ray_test(mi.Ray3f(ray), mi.Bool(True)), mi.Float(1), 0)
