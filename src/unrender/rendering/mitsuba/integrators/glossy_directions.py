"""How what a fixed point reflects depends on the direction from which it is seen."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.emitters import mis_weight

__all__ = ["glossy_radiance", "is_glossy"]


def is_glossy(scene: Any) -> bool:
    """Whether a BSDF of the scene has a glossy lobe: others that are no perfect mirrors reflect alike in all directions."""
    return any(mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Glossy) for shape in scene.shapes())


def glossy_radiance(
    scene: Any, si: Any, towards: Any, sampler: Any, trace: Callable[[Any, Any, Any, Any, Any], Any], active: Any
) -> Any:
    """0, with the derivative of the reflected radiance by the direction of view attached, perfectly specular lobes left out: the radiance
    less itself from where it is seen, so that derivatives by the material cancel, which path replay has.

    Args:
        scene: of Mitsuba.
        si: where, detached.
        towards: the direction of view in the frame of `si`, attached.
        sampler: of the lanes.
        trace: the radiance along a ray that meets an interaction: (scene, ray, interaction, sampler, active).
        active: lanes that count.
    """
    context = mi.BSDFContext()
    with dr.suspend_grad():
        bsdf, turned = si.bsdf(), mi.SurfaceInteraction3f(si)
        ds, emitted = scene.sample_emitter_direction(si, sampler.next_2d(), True, active)
        to_emitter = si.to_local(ds.d)
        lit = active & (ds.pdf > 0)
        density = bsdf.pdf(context, si, to_emitter, lit)
        emitted *= dr.select(ds.delta, 1, mis_weight(ds.pdf, density))
        bs, _ = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), active)
        smooth = active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        density = bsdf.pdf(context, si, bs.wo, smooth)
        smooth &= density > 0
        ray = si.spawn_ray(si.to_world(bs.wo))
        following = scene.ray_intersect(ray, smooth)
        arriving = trace(scene, ray, following, sampler, smooth)
        seen = mi.DirectionSample3f(scene, following, si)
        direct = following.emitter(scene, smooth).eval(following, smooth)
        share = mis_weight(density, scene.pdf_emitter_direction(si, seen, smooth))
        arriving += direct * (share - 1)
        arriving = dr.select(smooth, arriving / density, 0)
    with dr.resume_grad():
        turned.wi = towards
        from_emitter = bsdf.eval(context, turned, to_emitter, lit) - bsdf.eval(context, si, to_emitter, lit)
        others = bsdf.eval(context, turned, bs.wo, smooth) - bsdf.eval(context, si, bs.wo, smooth)
        return from_emitter * emitted + others * arriving
