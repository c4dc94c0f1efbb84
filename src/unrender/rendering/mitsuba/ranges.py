"""Physical ranges of parameters, from the plugin slots that read them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import mitsuba as mi

from unrender.rendering.mitsuba import mesh_layout
from unrender.rendering.mitsuba.emissive import COEFFICIENT
from unrender.rendering.mitsuba.scene_graph import Holders, attribute, children, class_name


@dataclass(frozen=True)
class Range:
    """Physical range of the values that a slot reads.

    Attributes:
        low: smallest value; None for no limit.
        high: largest value; None for no limit.
        unit: unit of the values; "1" for a dimensionless number, "" for an unknown slot.
        singular: value between `low` and `high` at which images are singular; values stay on one side of it.
        lobe: whether the value decides the probability with which a lobe is sampled. At an end that probability is 0.
        scattering: what the value changes the form of: a BSDF, as a roughness does, not a colour, or a medium; "" for neither.
    """

    low: float | None = None
    high: float | None = None
    unit: str = "1"
    singular: float | None = None
    lobe: bool = False
    scattering: Literal["", "bsdf", "medium"] = ""

    def scaled(self, factor: float) -> Range:
        """Return the range of x such that factor · x is in this range."""
        if factor == 0:
            return replace(self, low=None, high=None, singular=None)
        low, high, middle = (None if x is None else x / factor for x in (self.low, self.high, self.singular))
        return (
            replace(self, low=high, high=low, singular=middle)
            if factor < 0
            else replace(self, low=low, high=high, singular=middle)
        )

    def both(self, other: Range) -> Range:
        """Return the intersection of two ranges; this range if the intersection is empty."""
        lows, highs = ([x for x in ends if x is not None] for ends in ((self.low, other.low), (self.high, other.high)))
        low, high = max(lows, default=None), min(highs, default=None)
        if low is not None and high is not None and low >= high:
            return self
        singular = other.singular if self.singular is None else self.singular
        lobe, scattering = self.lobe or other.lobe, self.scattering or other.scattering
        return replace(self, low=low, high=high, singular=singular, lobe=lobe, scattering=scattering)


UNKNOWN = Range(unit="")
"""Range of a slot without an entry, such as a slot of a third-party plugin."""

_SHARE = Range(0.0, 1.0)
_LOBE = Range(0.0, 1.0, lobe=True)
_FORM = Range(0.0, 1.0, scattering="bsdf")
_ROUGHNESS = Range(0.02, 1.0, scattering="bsdf")
_IOR = Range(0.2, 5.0, "ratio of indices", singular=1.0)
_COMPLEX_IOR = Range(0.0, None, "index")
_LENGTH = Range(unit="scene units")
_POSITIVE_LENGTH = Range(0.0, None, "scene units")
_ANGLE = Range(unit="degrees")
_DIRECTION = Range(unit="direction")
_RADIANCE = Range(0.0, None, "radiance")

KINDS: dict[str, dict[str, Range]] = {
    "BSDF": {
        **dict.fromkeys(
            (
                "reflectance", "diffuse_reflectance", "specular_reflectance", "specular_transmittance",
                "diffuse_transmittance", "transmittance", "base_color", "spec_tint", "sheen_tint",
            ),
            _SHARE,
        ),
        **dict.fromkeys(
            ("metallic", "specular", "anisotropic", "sheen", "clearcoat", "clearcoat_gloss", "flatness"), _FORM
        ),
        **dict.fromkeys(("opacity", "weight"), _LOBE),
        "spec_trans": replace(_LOBE, scattering="bsdf"),
        **dict.fromkeys(("alpha", "alpha_u", "alpha_v", "roughness"), _ROUGHNESS),
        "eta": _IOR,
        "normalmap": Range(0.0, 1.0, "(direction + 1) / 2"),
        "nested_texture": _LENGTH,
        "theta": _ANGLE,
    },
    "Emitter": {
        "radiance": _RADIANCE,
        "irradiance": Range(0.0, None, "irradiance"),
        "intensity": Range(0.0, None, "radiant intensity"),
        "scale": Range(0.0, None),
        "position": _LENGTH,
        "direction": _DIRECTION,
    },
    "Medium": {
        "sigma_t": Range(0.0, None, "1 / scene unit", scattering="medium"),
        "albedo": Range(0.0, 1.0, scattering="medium"),
        "emission": _RADIANCE,
    },
    "PhaseFunction": {"g": Range(-0.99, 0.99, scattering="medium"), "weight": _SHARE},
    "Sensor": {
        "x_fov": Range(0.1, 179.0, "degrees"),
        "principal_point_offset_x": Range(unit="film widths"),
        "principal_point_offset_y": Range(unit="film heights"),
        "aperture_radius": _POSITIVE_LENGTH,
        "focus_distance": _POSITIVE_LENGTH,
    },
    "Shape": {
        mesh_layout.POSITIONS: _LENGTH,
        mesh_layout.NORMALS: Range(-1.0, 1.0, "direction"),
        mesh_layout.TEXCOORDS: Range(unit="texture coordinates"),
    },
}  # fmt: skip
"""{kind of plugin: {slot: range}}, for slots with the same meaning in all plugins of a kind."""

_SKY = {
    "turbidity": Range(1.0, 10.0),
    "albedo": _SHARE,
    "latitude": Range(-90.0, 90.0, "degrees"),
    "longitude": Range(-180.0, 180.0, "degrees"),
    "timezone": Range(-12.0, 14.0, "hours"),
    "hour": Range(0.0, 24.0, "hours"),
    "minute": Range(0.0, 60.0, "minutes"),
    "second": Range(0.0, 60.0, "seconds"),
    "window_start_time": Range(0.0, 24.0, "hours"),
    "window_end_time": Range(0.0, 24.0, "hours"),
    "sun_direction": _DIRECTION,
}
_CONDUCTOR = {"eta": _COMPLEX_IOR, "k": _COMPLEX_IOR}
_CURVE = {"control_points": Range(unit="scene units (x, y, z, radius)")}
_ELLIPSOIDS = {
    "data": Range(unit="scene units (centre, scale), quaternion"),
    "opacities": _SHARE,
    "sh_coeffs": Range(unit="radiance"),
}

_PLASTIC = {"specular_reflectance": _LOBE, "diffuse_reflectance": _LOBE}

CLASSES: dict[str, dict[str, Range]] = {
    "SmoothPlastic": _PLASTIC,
    "RoughPlastic": _PLASTIC,
    "SmoothConductor": _CONDUCTOR,
    "RoughConductor": _CONDUCTOR,
    "LinearRetarder": {"delta": _ANGLE},
    "PrincipledThin": {"diff_trans": Range(0.0, 2.0, lobe=True)},
    "Hair": {
        "longitudinal_roughness": _ROUGHNESS,
        "azimuthal_roughness": _ROUGHNESS,
        "scale_tilt": Range(-45.0, 45.0, "degrees"),
        "eumelanin": Range(0.0, None, "concentration"),
        "pheomelanin": Range(0.0, None, "concentration"),
        "sigma_a": Range(0.0, None, "1 / hair radius"),
    },
    "EnvironmentMapEmitter": {"data": _RADIANCE},
    "SpotLight": {
        "texture": Range(0.0, None),
        **dict.fromkeys(("cutoff_angle", "beam_width"), Range(0.0, 90.0, "degrees")),  # light ends at the smaller one
    },
    "SunskyEmitter": _SKY,
    "TimedSunskyEmitter": _SKY,
    "SGGXPhaseFunction": {"S": Range(-1.0, 1.0, "entries of a matrix")},
    "TabulatedPhaseFunction": {"values": Range(0.0, None, "1 / steradian")},
    "IrregularSpectrum": {"wavelengths": Range(0.0, None, "nm")},
    "BSplineCurve": _CURVE,
    "LinearCurve": _CURVE,
    "Ellipsoids": _ELLIPSOIDS,
    "EllipsoidsMesh": _ELLIPSOIDS,
    "SDFGrid": {"grid": Range(unit="scene units (signed distance)")},
}
"""{class of a plugin: {slot: range}}, which take precedence over those of its kind."""


_FORWARDED = ("value", "values", "data", "color0", "color1", "volume")
"""Slots of textures and volumes whose values the holding object reads."""
_KINDS = ("BSDF", "Emitter", "Medium", "PhaseFunction", "Sensor", "Shape")


class SlotReaders:
    """The objects of a scene, with the slots of other objects that hold each of them.

    `mitsuba.traverse` visits an object once, under its own id if it has one. A range depends on the slot instead, so every path to an
    object counts: a texture shared by two BSDFs has the range that is valid for both.

    Args:
        holders: {object: its holders and their slots}.
    """

    def __init__(self, holders: Holders):
        self._holders = holders
        self._attributes: dict[str, list[Any]] = {}
        for node in self._holders:
            if isinstance(node, mi.Texture) and (name := attribute(node)[0]):
                self._attributes.setdefault(name, []).append(node)

    def range_of(self, parameters: mi.SceneParameters, key: str) -> Range:
        """Return the range of the parameter `key`; `UNKNOWN` if no known slot reads it."""
        return self._of_slot(parameters.properties[key][2], key.rpartition(".")[2])

    def _of_slot(self, node: Any, slot: str) -> Range:
        if isinstance(node, (mi.Texture, mi.Volume)) and slot in _FORWARDED:
            return self._of_readers(node)
        if (known := entry(node, slot)) is not None:
            return known
        if isinstance(node, mi.Shape):
            return self._of_attribute(node, slot)
        if isinstance(node, mi.Medium) and slot.startswith(COEFFICIENT):
            return Range(unit="radiance")
        return UNKNOWN

    def _of_readers(self, node: Any) -> Range:
        """Return the range that is valid for all slots that hold a texture or volume."""
        result: Range | None = None
        for holder, slot in self._holders.get(node, []):
            harmonic = isinstance(holder, mi.Medium) and any(name == f"{COEFFICIENT}1" for name, _ in children(holder))
            if harmonic and slot == "emission":
                each = Range(unit="radiance")
            else:
                each = self._of_slot(holder, slot)
            result = each if result is None else result.both(each)
        return result or UNKNOWN

    def _of_attribute(self, shape: Any, name: str) -> Range:
        """Return the range of a shape's attribute: that of the slots whose textures read it from this shape, divided by their scale."""
        result: Range | None = None
        for texture in self._attributes.get(name, []):
            if shape not in self._shapes_of(texture):
                continue
            each = self._of_readers(texture).scaled(attribute(texture)[1])
            result = each if result is None else result.both(each)
        return result or UNKNOWN

    def _shapes_of(self, node: Any) -> set[Any]:
        """Return the shapes that hold an object, directly or indirectly."""
        shapes, seen, pending = set(), {node}, [node]
        while pending:
            for holder, _ in self._holders.get(pending.pop(), []):
                if isinstance(holder, mi.Shape):
                    shapes.add(holder)
                elif holder not in seen:
                    seen.add(holder)
                    pending.append(holder)
        return shapes


def entry(node: Any, slot: str) -> Range | None:
    """Return the table's range for a slot of an object; None without an entry."""
    own = CLASSES.get(class_name(node), {})
    if slot in own:
        return own[slot]
    kind = next((KINDS[name] for name in _KINDS if isinstance(node, getattr(mi, name))), {})
    return kind.get(slot)
