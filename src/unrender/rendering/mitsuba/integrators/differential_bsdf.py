"""Roughness derivatives by directions in proportion to the derivative of the BSDF itself (Belhe et al. 2024).

Directions of ordinary BSDF sampling, weighted by ∂ log D / ∂α of the distribution D of normals, have a variance in proportion to L² / α²,
also where the radiance L is the same in all of them and the derivative nothing. Here, at the first vertex of a path whose BSDF has an
unknown α, the replay leaves the derivative of D out; a pair of paths branches off, one where D shrinks with α and one where it grows
(`statistics/roughness.py`), with one azimuth, equal shares of the two parts, and the same random numbers beyond, so that what they
have in common cancels (antithetic, as in Zhang et al. 2021). Emitters are also sampled there, with the weights of MIS between both.

Symbols: α roughness, m half-vector, t = tan²θₘ / α², D distribution of normals, f BSDF times cosine, L, δL, β as in `path.py`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.array_types import Bool, Float, Spectrum, UInt32
from unrender.rendering.mitsuba.integrators.base import PathContext, ScatteringVertex
from unrender.rendering.mitsuba.integrators.pointer_tables import registry_id
from unrender.statistics.roughness import GGX, Beckmann, NormalDistribution

DISTRIBUTIONS: dict[str, tuple[int, NormalDistribution]] = {"ggx": (1, GGX()), "beckmann": (2, Beckmann())}
"""By Mitsuba's names: the entry of `tables["rough"]`, by registry ids of BSDFs, and the distribution. 0 stands for BSDFs that are not
sampled so."""


@dataclass
class BranchVertex:
    """Where the pair of paths branches off. State of Dr.Jit loops.

    Attributes:
        ray: that meets the vertex.
        depth: segments before it.
        β: throughput up to it.
        η: relative index of refraction up to it.
        found: lanes that have one.
    """

    ray: mi.Ray3f
    depth: UInt32
    β: Spectrum
    η: Float
    found: Bool

    @staticmethod
    def nowhere(ray: mi.Ray3f) -> BranchVertex:
        """Before any vertex."""
        return BranchVertex(mi.Ray3f(ray), mi.UInt32(0), mi.Spectrum(0), mi.Float(0), mi.Bool(False))

    def kept(self, other: BranchVertex) -> BranchVertex:
        """This one, or `other` in lanes that have found none before."""
        take = other.found & ~self.found
        return BranchVertex(
            ray=dr.select(take, other.ray, self.ray),
            depth=dr.select(take, other.depth, self.depth),
            β=dr.select(take, other.β, self.β),
            η=dr.select(take, other.η, self.η),
            found=self.found | other.found,
        )


class RoughLobe:
    """The reflection of one vertex, in lanes where it is sampled by its derivative.

    Args:
        distributions: those that occur, by their entry in the table.
        kind: the BSDF's entry in the table, per lane; 0 in lanes that do not take part.
        α: its roughness, attached where the caller resumes gradients.
        wi: towards where the path came from, in the frame of the vertex; below the surface where that has two sides.

    Attributes:
        served: lanes that take part.
        moved: α less itself: 0, with its derivative.
    """

    def __init__(self, distributions: Mapping[int, NormalDistribution], kind: UInt32, α: Float, wi: mi.Vector3f):
        self._distributions, self._kind, self.served = distributions, kind, kind != 0
        self.moved = α - dr.detach(α)
        self._α = dr.maximum(dr.detach(α), 1e-4)  # as Mitsuba has it
        self._wi = dr.detach(wi)

    def _select(self, of: Callable[[NormalDistribution], Float]) -> Float:
        """What `of` gives for each lane's distribution."""
        found = mi.Float(0)
        for number, distribution in self._distributions.items():
            found = dr.select(self._kind == number, of(distribution), found)
        return found

    def _slope(self, wo: mi.Vector3f) -> tuple[mi.Vector3f, Float]:
        """The half-vector m of wi and `wo`, and its t."""
        m = dr.normalize(self._wi + wo)
        across = (dr.square(m.x) + dr.square(m.y)) / dr.maximum(dr.square(m.z), 1e-12)
        return m, across / dr.square(self._α)

    def reflects(self, wo: mi.Vector3f) -> Bool:
        """Whether light passes between wi and `wo`: both on one side of the surface, their half-vector between them."""
        return self.served & (self._wi.z * wo.z > 0) & (dr.dot(self._wi, self._wi + wo) > 0)

    def without(self, f: Spectrum, wo: mi.Vector3f) -> Spectrum:
        """`f` in the direction `wo`, its derivative without that of D."""
        return f - self.change(f, wo)

    def change(self, f: Spectrum, wo: mi.Vector3f) -> Spectrum:
        """0, with the derivative that f has through D."""
        return dr.detach(f) * self.log_derivative(dr.detach(wo)) * self.moved

    def log_derivative(self, wo: mi.Vector3f) -> Float:
        """∂ log D / ∂α, detached; 0 where the lane does not take part."""
        _, t = self._slope(wo)
        return dr.select(
            self.served & (dr.squared_norm(self._wi + wo) > 0),
            self._select(lambda of: of.log_derivative(self._α, t)),
            0,
        )

    def pdf(self, wo: mi.Vector3f) -> Float:
        """Solid angle density of that direction of the pair to whose part `wo` belongs."""
        m, t = self._slope(wo)
        density = self._select(lambda of: of.density(self._α, t) * of.share(t))
        return dr.select(self.reflects(wo), density * dr.abs(m.z) / (4 * dr.dot(self._wi, m)), 0)

    def weight(self, wo: mi.Vector3f) -> Float:
        """∂ log D / ∂α over `pdf`."""
        m, t = self._slope(wo)
        over = self._select(lambda of: of.mass(self._α) / of.density(self._α, t))
        weight = dr.mulsign(4 * dr.dot(self._wi, m) / dr.abs(m.z) * over, t - 1)
        return dr.select(self.reflects(wo), weight, 0)

    def pair(self, sample: mi.Point2f) -> list[mi.Vector3f]:
        """A direction of the inner and one of the outer part, of half-vectors with one azimuth. Nothing may be reflected in them."""
        sin, cos = dr.sincos(2 * math.pi * sample.y)
        u, found = 1 - sample.x, []
        for part in (0, 1):
            tan = self._α * dr.sqrt(self._select(lambda of, part=part: of.parts(u)[part]))
            cosm = dr.rsqrt(1 + dr.square(tan))
            m = mi.Vector3f(cos * tan * cosm, sin * tan * cosm, dr.mulsign(cosm, self._wi.z))
            found.append(2 * dr.dot(self._wi, m) * m - self._wi)
        return found


class DifferentialBsdf:
    """Settings and the two steps: what the replay leaves out, and the pair of paths that has it.

    Args:
        kinds: names of the distributions that occur, see `DISTRIBUTIONS`.
    """

    def __init__(self, kinds: Iterable[str]):
        # No dataclass: Dr.Jit would take it for state of the path tracer's loop.
        self._distributions = dict(DISTRIBUTIONS[name] for name in kinds)

    def lobe(self, context: PathContext, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active: Bool) -> RoughLobe:
        """Of a vertex, in the `active` lanes whose BSDF is sampled so. Attached where paths are replayed."""
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
        """0, with the derivative of the radiance along each lane's path that the replay has left out.

        Args:
            context: of the replay.
            branch: where.
            numbers: random numbers that the path has not used.
            incident: the radiance along a ray that leaves the vertex: (branch, vertex with the direction's density, ray, random numbers,
                active); emitters that it meets have their MIS weight.
        """
        geometry: Any = context.geometry
        si = geometry.ray_intersect(branch.ray, ray_flags=mi.RayFlags.All, coherent=False, active=branch.found)
        bsdf = si.bsdf(branch.ray)
        lobe = self.lobe(context, si, bsdf, branch.found & si.is_valid())
        slope = mi.Spectrum(0)
        for wo in lobe.pair(numbers.next_2d()):
            active = lobe.reflects(wo)
            weight = bsdf.eval(context.bsdf_ctx, si, wo, active) * lobe.weight(wo)
            active &= dr.any(weight != 0)
            vertex = ScatteringVertex(dr.detach(si, True), lobe.pdf(wo), mi.Bool(False))
            L = incident(branch, vertex, si.spawn_ray(si.to_world(wo)), numbers.clone(), active)
            slope += dr.select(active, weight * L, 0)
        with dr.resume_grad():
            return branch.β * slope * lobe.moved
