"""Physical range and unit of every slot of Mitsuba's plugins that a parameter's value can reach."""

from __future__ import annotations

from dataclasses import dataclass, replace

__all__ = ["CLASSES", "KINDS", "UNKNOWN", "Range"]


@dataclass(frozen=True)
class Range:
    """Physical range of the values that a slot reads.

    Attributes:
        low: smallest value; None where there is none.
        high: largest value; None where there is none.
        unit: of the values; "1" for a pure number, "" where the slot is unknown.
        singular: value between `low` and `high` at which images are singular; values stay on one side of it.
        above: another parameter of the same object, whose value in the scene is a lower limit, "" for none.
        below: another parameter of the same object, whose value in the scene is an upper limit, "" for none.
    """

    low: float | None = None
    high: float | None = None
    unit: str = "1"
    singular: float | None = None
    above: str = ""
    below: str = ""

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
        """Return the range of values that serve both slots; this range where no value does."""
        lows, highs = ([x for x in ends if x is not None] for ends in ((self.low, other.low), (self.high, other.high)))
        low, high = max(lows, default=None), min(highs, default=None)
        if low is not None and high is not None and low >= high:
            return self
        singular = other.singular if self.singular is None else self.singular
        return replace(self, low=low, high=high, singular=singular)


UNKNOWN = Range(unit="")
"""Range of a slot without an entry, such as one of a plugin that is not Mitsuba's."""

_SHARE = Range(0.0, 1.0)
_ROUGHNESS = Range(0.02, 1.0)
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
                "diffuse_transmittance", "transmittance", "base_color", "metallic", "specular", "anisotropic",
                "spec_tint", "sheen", "sheen_tint", "clearcoat", "clearcoat_gloss", "spec_trans", "flatness",
                "opacity", "weight",
            ),
            _SHARE,
        ),
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
        "sigma_t": Range(0.0, None, "1 / scene unit"),
        "albedo": _SHARE,
        "emission": _RADIANCE,
    },
    "PhaseFunction": {"g": Range(-0.99, 0.99), "weight": _SHARE},
    "Sensor": {
        "x_fov": Range(0.1, 179.0, "degrees"),
        "principal_point_offset_x": Range(unit="film widths"),
        "principal_point_offset_y": Range(unit="film heights"),
        "aperture_radius": _POSITIVE_LENGTH,
        "focus_distance": _POSITIVE_LENGTH,
    },
    "Shape": {
        "vertex_positions": _LENGTH,
        "vertex_normals": Range(-1.0, 1.0, "direction"),
        "vertex_texcoords": Range(unit="texture coordinates"),
    },
}  # fmt: skip
"""{kind of plugin: {slot: range}}, for slots that mean the same in all plugins of a kind."""

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

CLASSES: dict[str, dict[str, Range]] = {
    "SmoothConductor": _CONDUCTOR,
    "RoughConductor": _CONDUCTOR,
    "LinearRetarder": {"delta": _ANGLE},
    "PrincipledThin": {"diff_trans": Range(0.0, 2.0)},
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
        "cutoff_angle": Range(0.0, 90.0, "degrees", above="beam_width"),
        "beam_width": Range(0.0, 90.0, "degrees", below="cutoff_angle"),
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
"""{class of a plugin: {slot: range}}, before those of its kind."""
