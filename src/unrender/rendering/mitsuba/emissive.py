"""A medium that emits and absorbs, and scatters nothing: Mitsuba's plugin `emissive`, for fits of radiance fields.

    {"type": "emissive", "sigma_t": volume, "emission": volume}

Along a ray the radiance is ∫ T(t) σₜ(t) e(t) dt, with the extinction σₜ of `sigma_t` in inverse scene units, and the radiance e of
`emission`, the same in all directions. Only the kernels of this package know of it: Mitsuba's own integrators take its light for
scattering.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.core.errors import InputError

__all__ = ["emits", "register"]


def register() -> None:
    """Make the plugin known to the variant that is set. Again does nothing."""
    _plugin(mi.variant())


def emits(medium: Any) -> bool:
    """Whether a medium is such a one."""
    return isinstance(medium, _plugin(mi.variant()))


def _volume(properties: Any, name: str) -> Any:
    volume = properties.get(name, None)
    if not isinstance(volume, mi.Volume):
        got = "nothing" if volume is None else type(volume).__name__
        raise InputError(f"medium emissive: {name} must be a volume, such as a gridvolume, got {got}")
    return volume


@cache
def _plugin(variant: str) -> type:
    del variant  # the base class is that of the variant that is set

    class EmissiveMedium(mi.Medium):
        """Its "scattering coefficient" is what it emits, σₜ e: where a kernel finds that instead of light to scatter."""

        def __init__(self, properties: Any):
            super().__init__(properties)
            self.m_is_homogeneous = False
            self.m_has_spectral_extinction = False
            self.sigma_t = _volume(properties, "sigma_t")
            self.emission = _volume(properties, "emission")
            self.parameters_changed([])

        def traverse(self, callback: Any) -> None:
            super().traverse(callback)
            callback.put("sigma_t", self.sigma_t, mi.ParamFlags.Differentiable)
            callback.put("emission", self.emission, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: Any) -> None:
            del keys
            self.majorant = dr.opaque(mi.Float, dr.detach(self.sigma_t.max()))

        def to_string(self) -> str:
            return f"EmissiveMedium[\n  sigma_t = {self.sigma_t},\n  emission = {self.emission}\n]"

        def get_majorant(self, mei: Any, active: Any = True) -> Any:
            return mi.Color3f(self.majorant)

        def get_scattering_coefficients(self, mei: Any, active: Any = True) -> Any:
            σₜ = self.sigma_t.eval(mei, active)
            return σₜ * self.emission.eval(mei, active), self.majorant - σₜ, σₜ

        def intersect_aabb(self, ray: Any) -> Any:
            return self.sigma_t.bbox().ray_intersect(ray)

    mi.register_medium("emissive", EmissiveMedium)
    return EmissiveMedium
