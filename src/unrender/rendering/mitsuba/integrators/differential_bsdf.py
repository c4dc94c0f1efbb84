"""Roughness derivatives with directions sampled in proportion to the derivative of the BSDF (Belhe et al. 2024).

Standard BSDF sampling, weighted by ∂ log D / ∂α of the normal distribution D, has a variance in proportion to L² / α², even if the
radiance L is constant and the derivative is 0. Here, at the first vertex of a path whose BSDF has an unknown α, the replay omits the
derivative of D. A pair of paths branches off instead: one where D decreases with α and one where it increases
(`statistics/roughness.py`). Both have the same azimuth, equal fractions of the two parts, and the same random numbers afterwards, so
common terms cancel (antithetic sampling, as in Zhang et al. 2021). Emitters are also sampled there, and MIS combines both.

Symbols: α roughness, m half-vector, t = tan²θₘ / α², D normal distribution, f BSDF times cosine, L, δL, β as in `path.py`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.rendering.mitsuba.integrators.base import (
    Bool,
    Float,
    PathContext,
    ScatteringVertex,
    Spectrum,
    UInt32,
    registry_id,
)
from unrender.rendering.mitsuba.scene_pair import ScenePair
from unrender.statistics.roughness import GGX, Beckmann, NormalDistribution

DISTRIBUTIONS: dict[str, tuple[int, NormalDistribution]] = {"ggx": (1, GGX()), "beckmann": (2, Beckmann())}
"""{Mitsuba's name: (entry of `tables["rough"]` by registry ids of BSDFs, distribution)}. The entry 0 means standard BSDF sampling."""


@dataclass
class BranchVertex:
    """Vertex where the pair of paths branches off, in `valid` lanes: the ray that hits it, with the number of segments, the throughput and
    the relative index of refraction before it. It is state of Dr.Jit loops."""

    ray: mi.Ray3f
    depth: UInt32
    β: Spectrum
    η: Float
    valid: Bool

    @staticmethod
    def nowhere(ray: mi.Ray3f) -> BranchVertex:
        """Return the state before any vertex."""
        return BranchVertex(mi.Ray3f(ray), mi.UInt32(0), mi.Spectrum(0), mi.Float(0), mi.Bool(False))

    def or_else(self, other: BranchVertex) -> BranchVertex:
        """Return this vertex, or `other` in lanes that had none before."""
        take = other.valid & ~self.valid
        return BranchVertex(
            ray=dr.select(take, other.ray, self.ray),
            depth=dr.select(take, other.depth, self.depth),
            β=dr.select(take, other.β, self.β),
            η=dr.select(take, other.η, self.η),
            valid=self.valid | other.valid,
        )


class RoughLobe:
    """Reflection at one vertex, in lanes that use differential sampling (`served`); `moved` is α minus itself: 0, with its derivative.

    `kind` is the BSDF's entry in the table of distributions, 0 in other lanes. `wi` is the direction towards the previous vertex in the
    local frame; below the surface on the back side of a two-sided BSDF.
    """

    def __init__(self, distributions: Mapping[int, NormalDistribution], kind: UInt32, α: Float, wi: mi.Vector3f):
        self._distributions, self._kind, self.served = distributions, kind, kind != 0
        self.moved = α - dr.detach(α)
        self._α = dr.maximum(dr.detach(α), 1e-4)  # as in Mitsuba
        self._wi = dr.detach(wi)

    def _select(self, function: Callable[[NormalDistribution], Float]) -> Float:
        """Evaluate a function of each lane's distribution."""
        result = mi.Float(0)
        for number, distribution in self._distributions.items():
            result = dr.select(self._kind == number, function(distribution), result)
        return result

    def _slope(self, wo: mi.Vector3f) -> tuple[mi.Vector3f, Float]:
        """Return the half-vector m of wi and `wo`, and its t."""
        m = dr.normalize(self._wi + wo)
        across = (dr.square(m.x) + dr.square(m.y)) / dr.maximum(dr.square(m.z), 1e-12)
        return m, across / dr.square(self._α)

    def reflects(self, wo: mi.Vector3f) -> Bool:
        """Return whether light is reflected from wi to `wo`: both on one side of the surface, with their half-vector between them."""
        return self.served & (self._wi.z * wo.z > 0) & (dr.dot(self._wi, self._wi + wo) > 0)

    def without(self, f: Spectrum, wo: mi.Vector3f) -> Spectrum:
        """Return `f` in the direction `wo` without the derivative of D."""
        return f - self.change(f, wo)

    def change(self, f: Spectrum, wo: mi.Vector3f) -> Spectrum:
        """Return 0, with the derivative of f by D."""
        return dr.detach(f) * self.log_derivative(dr.detach(wo)) * self.moved

    def log_derivative(self, wo: mi.Vector3f) -> Float:
        """Return ∂ log D / ∂α, detached; 0 in lanes that use standard sampling."""
        _, t = self._slope(wo)
        return dr.select(
            self.served & (dr.squared_norm(self._wi + wo) > 0),
            self._select(lambda of: of.log_derivative(self._α, t)),
            0,
        )

    def pdf(self, wo: mi.Vector3f) -> Float:
        """Return the solid angle density of the direction of the pair whose part contains `wo`."""
        m, t = self._slope(wo)
        density = self._select(lambda of: of.density(self._α, t) * of.share(t))
        return dr.select(self.reflects(wo), density * dr.abs(m.z) / (4 * dr.dot(self._wi, m)), 0)

    def weight(self, wo: mi.Vector3f) -> Float:
        """Return ∂ log D / ∂α over `pdf`."""
        m, t = self._slope(wo)
        over = self._select(lambda of: of.mass(self._α) / of.density(self._α, t))
        weight = dr.mulsign(4 * dr.dot(self._wi, m) / dr.abs(m.z) * over, t - 1)
        return dr.select(self.reflects(wo), weight, 0)

    def pair(self, sample: mi.Point2f) -> list[mi.Vector3f]:
        """Sample a direction of the inner and of the outer part, with half-vectors of equal azimuth. They may be below the surface."""
        sin, cos = dr.sincos(2 * math.pi * sample.y)
        u, directions = 1 - sample.x, []
        for part in (0, 1):
            tan = self._α * dr.sqrt(self._select(lambda of, part=part: of.parts(u)[part]))
            cosm = dr.rsqrt(1 + dr.square(tan))
            m = mi.Vector3f(cos * tan * cosm, sin * tan * cosm, dr.mulsign(cosm, self._wi.z))
            directions.append(2 * dr.dot(self._wi, m) * m - self._wi)
        return directions


class DifferentialBsdf:
    """The two steps of differential sampling: omission of D's derivative in the replay, and the pair of paths that estimates it."""

    def __init__(self, kinds: Iterable[str]):
        # This is not a dataclass, since Dr.Jit would treat a dataclass as state of the path tracer's loop.
        self._distributions = dict(DISTRIBUTIONS[name] for name in kinds)

    def lobe(self, context: PathContext, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active: Bool) -> RoughLobe:
        """Return the lobe of a vertex, in the `active` lanes whose BSDF uses differential sampling. Attached in a replay."""
        table = context.tables["rough"]
        number = dr.minimum(registry_id(bsdf), dr.width(table) - 1)
        kind = dr.select(active, dr.gather(mi.UInt32, table, number, active), 0)
        any_bsdf: Any = bsdf
        with context.resume_grad():
            α = any_bsdf.eval_attribute_1("alpha", si, kind != 0)
            return RoughLobe(self._distributions, kind, α, si.wi)

    def contribution(
        self,
        context: PathContext,
        branch: BranchVertex,
        numbers: Any,
        incident: Callable[[BranchVertex, ScatteringVertex, mi.Ray3f, Any, Bool], Spectrum],
    ) -> Spectrum:
        """Return 0, with the derivative of each path's radiance that the replay has omitted, by `numbers` that the path has not used.

        `incident` is the radiance along a ray that leaves the vertex, a function of (branch, vertex with the direction's density, ray,
        sampler, active). It applies the MIS weight to emitters that the ray hits.
        """
        geometry: Any = context.geometry
        si = geometry.ray_intersect(branch.ray, ray_flags=mi.RayFlags.All, coherent=False, active=branch.valid)
        bsdf, (material,) = si.bsdf(branch.ray), context.materials([si])
        lobe = self.lobe(context, material, bsdf, branch.valid & si.is_valid())
        slope = mi.Spectrum(0)
        for wo in lobe.pair(numbers.next_2d()):
            active = lobe.reflects(wo)
            weight = bsdf.eval(context.bsdf_ctx, material, wo, active) * lobe.weight(wo)
            active &= dr.any(weight != 0)
            vertex = ScatteringVertex(dr.detach(si, True), lobe.pdf(wo), mi.Bool(False))
            L = incident(branch, vertex, si.spawn_ray(si.to_world(wo)), numbers.clone(), active)
            slope += dr.select(active, weight * L, 0)
        with dr.resume_grad():
            return branch.β * slope * lobe.moved


_ROLES = ("alpha", "alpha_u", "alpha_v", "roughness")


class RoughLobes:
    """Roughness parameters that `DifferentialBsdf` supports: those of isotropic rough conductors, one-sided or two-sided with equal sides.

    Other parameters use standard BSDF sampling.

    Args:
        pair: both loads of the scene.
        keys: parameters with a derivative; None to disable differential sampling.
        geometric: whether parameters move shapes.

    Attributes:
        differential: sampler of the BSDF derivatives; None if disabled.
        tables: {"rough": entry of `DISTRIBUTIONS` by registry ids of the current scene's BSDFs, 0 for others and at the end}, or empty.

    Raises `InputError` if no parameter is supported, with the reason for each roughness, and in scenes that other kernels trace: with
    media, or with moving shapes.
    """

    def __init__(self, pair: ScenePair, keys: Sequence[str] | None, geometric: bool):
        self.differential: DifferentialBsdf | None = None
        self.tables: dict[str, Any] = {}
        if keys is None:
            return
        if pair.volumetric or geometric:
            reason_of_scene = "the scene has media" if pair.volumetric else "a parameter moves shapes"
            raise InputError(f"differential_bsdf: {reason_of_scene}, which it does not support; leave it out")
        kinds, reasons = {}, []
        for key in keys:
            bsdf, kind, reason = _lobe(pair.current_parameters, key)
            if bsdf is not None:
                kinds[int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf)).numpy()[0])] = kind  # pyright: ignore[reportAttributeAccessIssue]
            elif reason:
                reasons.append(f"{key} {reason}")
        if not kinds:
            raise InputError(
                "differential_bsdf: expected the alpha of an isotropic roughconductor, bare or two-sided, among the parameters: "
                + ("; ".join(reasons) or f"got {', '.join(keys)}")
            )
        table = np.zeros(max(kinds) + 2, np.uint32)
        for number, kind in kinds.items():
            table[number] = DISTRIBUTIONS[kind][0]
        self.differential, self.tables = (
            DifferentialBsdf(dict.fromkeys(kinds.values())),
            {"rough": arrays.owned(table, mi.UInt32)},
        )


def _lobe(parameters: mi.SceneParameters, key: str) -> tuple[Any, str, str]:
    """Return (outermost BSDF, name of the distribution, "") of a supported roughness; else (None, "", reason), with "" for other
    parameters."""
    if key not in parameters.properties or not set(key.split(".")) & set(_ROLES):
        return None, "", ""
    node, chain = parameters.properties[key][2], []
    while node is not None and node in parameters.hierarchy:
        chain.append(node)
        node = parameters.hierarchy[node][0]
    bsdfs = [node for node in chain if isinstance(node, mi.BSDF)]
    names = [bsdf.class_name() for bsdf in bsdfs]
    if not bsdfs:
        return None, "", ""
    if names[0] != "RoughConductor":
        return None, "", f"belongs to another BSDF ({names[0]})"
    if names[1:] not in ([], ["TwoSidedBRDF"]):
        return None, "", f"is inside a {names[1]}"
    if "alpha" not in key.split("."):
        return None, "", "is anisotropic"
    if any(name.startswith("brdf_1.") for name in mi.traverse(bsdfs[-1]).keys()):  # noqa: SIM118 (iterating gives pairs)
        return None, "", "belongs to one of two different sides"
    kind = re.search(r"distribution = (\w+)", str(bsdfs[0]))
    if kind is None or kind.group(1) not in DISTRIBUTIONS:
        return None, "", "has a distribution that is neither GGX nor Beckmann's"
    return bsdfs[-1], kind.group(1), ""
