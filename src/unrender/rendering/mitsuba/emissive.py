"""Emissive and absorbing medium without scattering: the Mitsuba plugin `emissive`, for fits of radiance fields.

    {"type": "emissive", "sigma_t": volume, "emission": volume}

Along a ray the radiance is ∫ T(t) σₜ(t) e(t) dt, with the extinction σₜ of `sigma_t` in inverse scene units. The emitted radiance e of
`emission` is isotropic. With 3 or 8 further volumes, `emission_1` to `emission_3` or `emission_8`, all volumes are coefficients of
spherical harmonics of degree 1 or 2. In the direction d

    e(d) = s log(1 + exp(Σ_k c_k Y_k(d) / s)),    s = 0.05,

which is positive and approaches the sum where the sum is well above s. c_0 is `emission`, c_k is `emission_k`, and Y_k are the real
spherical harmonics divided by that of degree 0:

    1,  √3 y, √3 z, √3 x,  √15 xy, √15 yz, √5 (3z² - 1)/2, √15 xz, √15 (x² - y²)/2.

Only the kernels of this package support it. Mitsuba's own integrators treat its emission as scattering.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.core.errors import InputError

COEFFICIENT = "emission_"
"""Prefix of the names of the volumes other than `emission`."""
FUNCTIONS = (1, 4, 9)
"""Numbers of spherical harmonics up to degree 0, 1 and 2."""
_SOFTNESS = 0.05


def register() -> None:
    """Register the plugin with the active variant. Repeated calls do nothing."""
    _plugin(mi.variant())


def emits(medium: Any) -> bool:
    """Return whether a medium is of the `emissive` plugin."""
    return isinstance(medium, _plugin(mi.variant()))


def is_positive(medium: Any) -> bool:
    """Return whether a medium emits in every direction: an `emissive` medium with spherical harmonics of degree 1 or 2."""
    return emits(medium) and bool(medium.more)


def _volume(properties: Any, name: str) -> Any:
    volume = properties.get(name, None)
    if not isinstance(volume, mi.Volume):
        got = "nothing" if volume is None else type(volume).__name__
        raise InputError(f"medium emissive: {name} must be a volume, such as a gridvolume, got {got}")
    return volume


def harmonics(d: Any, count: int) -> list[Any]:
    """Return the first 4 or 9 real spherical harmonics in the direction d, divided by that of degree 0."""
    values = [1.0, 3**0.5 * d.y, 3**0.5 * d.z, 3**0.5 * d.x]
    if count == 9:
        values += [15**0.5 * d.x * d.y, 15**0.5 * d.y * d.z, 5**0.5 / 2 * (3 * d.z * d.z - 1)]
        values += [15**0.5 * d.x * d.z, 15**0.5 / 2 * (d.x * d.x - d.y * d.y)]
    return values


@cache
def _plugin(variant: str) -> type:
    del variant  # a cache key only: the base class belongs to the active variant

    class EmissiveMedium(mi.Medium):
        """The medium. Its "scattering coefficient" is the emission σₜ e, which kernels add as radiance."""

        def __init__(self, properties: Any):
            super().__init__(properties)
            self.m_is_homogeneous = False
            self.m_has_spectral_extinction = False
            self.sigma_t = _volume(properties, "sigma_t")
            self.emission = _volume(properties, "emission")
            self.more = []
            while f"{COEFFICIENT}{len(self.more) + 1}" in properties:
                self.more.append(_volume(properties, f"{COEFFICIENT}{len(self.more) + 1}"))
            if len(self.more) + 1 not in FUNCTIONS:
                raise InputError(
                    f"medium emissive: expected emission_1 to emission_3 or to emission_8, got {len(self.more)}"
                )
            self.parameters_changed([])

        def traverse(self, callback: Any) -> None:
            super().traverse(callback)
            callback.put("sigma_t", self.sigma_t, mi.ParamFlags.Differentiable)
            callback.put("emission", self.emission, mi.ParamFlags.Differentiable)
            for number, volume in enumerate(self.more, 1):
                callback.put(f"{COEFFICIENT}{number}", volume, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: Any) -> None:
            self.majorant = dr.opaque(mi.Float, dr.detach(self.sigma_t.max()))

        def to_string(self) -> str:
            return f"EmissiveMedium[\n  sigma_t = {self.sigma_t},\n  emission = {self.emission}\n]"

        def get_majorant(self, mei: Any, active: Any = True) -> Any:
            return mi.Color3f(self.majorant)

        def get_scattering_coefficients(self, mei: Any, active: Any = True) -> Any:
            σₜ = self.sigma_t.eval(mei, active)
            return σₜ * self._radiance(mei, active), self.majorant - σₜ, σₜ

        def _radiance(self, mei: Any, active: Any) -> Any:
            value = self.emission.eval(mei, active)
            if not self.more:
                return value
            for volume, Y in zip(self.more, harmonics(mei.wi, len(self.more) + 1)[1:], strict=True):
                value = dr.fma(volume.eval(mei, active), Y, value)
            # s log(1 + exp(x / s)), without overflow
            return dr.maximum(value, 0) + _SOFTNESS * dr.log(1 + dr.exp(-dr.abs(value) / _SOFTNESS))

        def intersect_aabb(self, ray: Any) -> Any:
            return self.sigma_t.bbox().ray_intersect(ray)

    mi.register_medium("emissive", EmissiveMedium)
    return EmissiveMedium
