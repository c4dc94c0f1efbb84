"""Limits of spectral variants, and conversion of their colours to RGB.

Mitsuba upsamples a reflectance (r, g, b) to a spectrum with three coefficients (Jakob and Hanika 2019).
A parameter such as `wall.bsdf.reflectance.data` then holds coefficients, whose magnitudes differ by six orders. Callers see linear sRGB.
The coefficients are those of Mitsuba's own table, interpolated as Mitsuba does. The table is a cube for each choice of the largest channel
z: coordinates x, y of the other channels over z, and knots in z.
"""

from __future__ import annotations

import functools
import itertools
import re
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.rendering.mitsuba.film_response import is_spectral, table_wavelengths
from unrender.rendering.mitsuba.integrators.base import total
from unrender.rendering.mitsuba.mesh_layout import NORMALS, POSITIONS
from unrender.rendering.mitsuba.parameters import tensor
from unrender.rendering.mitsuba.ranges import SlotReaders
from unrender.rendering.mitsuba.scene_graph import Holders, children, class_name

_DARKEST, _BRIGHTEST = 1e-4, 1 - 1e-4
"""Range of grey, and smallest value of the largest channel of a colour. Coefficients of black and white are infinite, without slopes."""
_LARGEST_FIRST = 0.02  # size that the first coefficient of no colour has; the largest is .005
_RAW = re.compile(r"^\s*raw = (1|true)\b", re.MULTILINE)
_RGB_TEXTURES = {"BitmapTextureImpl": "data", "SRGBReflectanceSpectrum": "value"}
_DIRECT = {"RegularSpectrum": "values", "IrregularSpectrum": "values", "UniformSpectrum": "value"}
"""{class: parameter} of spectra whose values are used as they are."""
_NUMBERS = ("normalmap", "nested_texture", "opacity", "weight", "roughness", "alpha", "alpha_u", "alpha_v", "metallic")
"""Slots that may read a colour bitmap without making spectra of it."""
_FILMS = ("HDRFilm",)
_INSTEAD = "give the colour as a regular spectrum, whose values can be recovered"
_ROWS = 1 << 14  # number of colours that are converted at once
_Ends = tuple[Any, Any]  # weights of the two ends of a cell along an axis


def channels(value: Any) -> int:
    """Return the number of channels of a bitmap's data, of a colour 3, and of a number 1."""
    return int(value.shape[-1]) if dr.is_tensor_v(value) else len(value) if dr.depth_v(value) == 2 else 1


def refusal(scene: Any, holders: Holders) -> str:
    """Return the reason why spectral variants do not support a scene; "" if they do, and in RGB variants."""
    if not is_spectral():
        return ""
    instead = f"use the variant {str(mi.variant()).replace('spectral', 'rgb')}"
    for node, slots in holders.items():
        if isinstance(node, mi.Medium):
            return f"spectral variants do not support participating media; {instead}"
        used = next((slot for _, slot in slots if slot not in _NUMBERS), "")
        if used and is_raw(node) and channels(mi.traverse(node)["data"]) != 1:
            return f"the bitmap of {used} is raw, and spectral variants do not upsample raw colours; set raw to false"
        if used and class_name(node) == "RawConstantTexture" and channels(mi.traverse(node)["value"]) != 1:
            return f"the rawconstant of {used} holds coordinates, of which spectral variants make no spectrum; give an rgb colour"
        if used and _holds_colours(node):
            return f"the data of the bitmap of {used} are colours, which Mitsuba takes for coefficients; give bitmap = mitsuba.Bitmap(...)"
    for sensor in scene.sensors():
        film = class_name(sensor.film())
        if film not in _FILMS or any(name == "srf" for name, _ in children(sensor)):
            return (
                f"spectral variants support an hdrfilm without srf only, got {film}; remove the srf, or use an hdrfilm"
            )
    return ""


class SpectralColours:
    """The parameters (`keys`, of three channels) of a scene that hold coefficients, and their conversion. It converts nothing in RGB
    variants."""

    def __init__(self, parameters: mi.SceneParameters, readers: SlotReaders):
        self._parameters, self._readers = parameters, readers
        names = parameters.keys() if is_spectral() else []
        self.keys = frozenset(key for key in names if self._is_reflectance(key))
        self._table: tuple[mi.Float, mi.Float, int] | None = None

    def _is_reflectance(self, key: str) -> bool:
        """Return whether a parameter holds coefficients of reflectances in [0, 1]."""
        node, value = self._parameters.properties[key][2], self._parameters[key]
        if _RGB_TEXTURES.get(class_name(node)) != key.rpartition(".")[2] or is_raw(node) or channels(value) != 3:
            return False
        limits = self._readers.range_of(self._parameters, key)
        return (limits.low, limits.high) == (0, 1)

    def obstacle(self, key: str) -> str:
        """Return the reason why a spectral variant does not support a parameter; "" if it does, and in RGB variants."""
        if not is_spectral():
            return ""
        if key in self.keys:
            half = dr.type_v(self._parameters[key]) == dr.VarType.Float16
            return "half precision is too coarse for coefficients of spectra; set its format to variant" if half else ""
        node, leaf, value = self._parameters.properties[key][2], key.rpartition(".")[2], self._parameters[key]
        name = class_name(node)
        if not dr.is_array_v(value) or isinstance(node, (mi.BSDF, mi.Sensor)) or _DIRECT.get(name) == leaf:
            return ""
        if isinstance(node, mi.Shape):
            attribute = leaf.startswith(("vertex_", "face_")) and leaf not in (POSITIONS, NORMALS)
            return f"spectral variants do not support attributes of meshes; {_INSTEAD}" if attribute else ""
        if isinstance(node, mi.Emitter):
            moved = leaf in ("scale", "position", "to_world")
            return "" if moved else f"spectral variants do not support the {leaf} of a light ({name})"
        if _RGB_TEXTURES.get(name) == leaf and (channels(value) == 1 or is_raw(node)):
            return ""
        return f"spectral variants store the colour as coefficients of a spectrum ({name}); {_INSTEAD}"

    def value(self, key: str, native: mi.TensorXf) -> mi.TensorXf:
        """Return linear sRGB for the scene's own value of a parameter."""
        if key not in self.keys:
            return native
        return tensor(_colours(native.numpy().reshape(-1, 3)).reshape(native.shape))

    def native(self, key: str, value: mi.TensorXf) -> mi.TensorXf:
        """Return Mitsuba's coefficients for linear sRGB, which is clipped to [0, 1]. Black and white become almost black and white."""
        if key not in self.keys:
            return value
        return self._joined(self._cell(value).coefficients(), value)

    def clipped(self, key: str, value: np.ndarray) -> np.ndarray:
        """Return linear sRGB clipped to [1e-4, 1 - 1e-4], where coefficients are finite; the values of other parameters unchanged."""
        return np.clip(value, _DARKEST, _BRIGHTEST) if key in self.keys else value

    def pull_back(self, key: str, value: mi.TensorXf, gradient: mi.TensorXf) -> mi.TensorXf:
        """Return the gradient by linear sRGB for the gradient by coefficients at `value`."""
        if key not in self.keys:
            return gradient
        slopes, parts = self._cell(value).slopes(), _split(gradient)
        return self._joined([_dot(parts, slope) for slope in slopes], value)

    def push_forward(self, key: str, value: mi.TensorXf, tangent: mi.TensorXf) -> mi.TensorXf:
        """Return the tangent of the coefficients for a tangent of linear sRGB at `value`."""
        if key not in self.keys:
            return tangent
        slopes, parts = self._cell(value).slopes(), _split(tangent)
        return self._joined([_dot(parts, [slope[j] for slope in slopes]) for j in range(3)], value)

    def _cell(self, value: mi.TensorXf) -> _Cell:
        if self._table is None:
            knots, data, size = _table()
            self._table = mi.Float(knots), mi.Float(data), size
        return _Cell(*self._table, [dr.clip(part, 0, 1) for part in _split(value)])

    @staticmethod
    def _joined(parts: list[Any], like: mi.TensorXf) -> mi.TensorXf:
        joined: Any = dr.ravel(mi.Vector3f(*parts))
        result = mi.TensorXf(joined, tuple(like.shape))
        dr.eval(result)
        return result


class _Cell:
    """The cell of the table that contains each colour of three channels in [0, 1]. Arrays of three are lists.

    `knots` are positions of the samples in z, and `data` the coefficients of [largest channel, z, y, x], flat.
    """

    def __init__(self, knots: mi.Float, data: mi.Float, size: int, rgb: list[Any]):
        r, g, b = rgb
        self._number = dr.select((r >= g) & (r >= b), mi.UInt32(0), dr.select(g >= b, mi.UInt32(1), mi.UInt32(2)))
        own, first, second = (self._after_largest(rgb, shift) for shift in range(3))
        self._largest, self._is_grey, self._grey = (
            dr.maximum(own, _DARKEST),
            (r == g) & (g == b),
            dr.clip(r, _DARKEST, _BRIGHTEST),
        )
        self._scale = (size - 1) / self._largest
        self._first, self._second = first * self._scale, second * self._scale
        column, row = (dr.minimum(mi.UInt32(at), size - 2) for at in (self._first, self._second))
        layer = dr.binary_search(0, size - 2, lambda i: dr.gather(mi.Float, knots, i + 1) <= self._largest)
        low, high = (dr.gather(mi.Float, knots, layer + step) for step in (0, 1))
        self._thickness = high - low
        self._x, self._y, self._z = self._first - column, self._second - row, (self._largest - low) / self._thickness
        place = ((self._number * size + layer) * size + row) * size + column
        self._corners = {
            (i, j, k): [dr.gather(mi.Float, data, 3 * (place + i + (j + k * size) * size) + c) for c in range(3)]
            for i, j, k in itertools.product((0, 1), repeat=3)
        }

    def _after_largest(self, parts: list[Any], shift: int) -> Any:
        """Return the channel that is `shift` channels after the largest one, cyclically."""
        a, b, c = (parts[(number + shift) % 3] for number in range(3))
        return dr.select(self._number == 0, a, dr.select(self._number == 1, b, c))

    def _sum(self, x: _Ends, y: _Ends, z: _Ends) -> list[Any]:
        """Return the sum of the corners' coefficients with products of these weights."""
        return [
            total([x[i] * y[j] * z[k] * corner[c] for (i, j, k), corner in self._corners.items()]) for c in range(3)
        ]

    def coefficients(self) -> list[Any]:
        """Return the coefficients by trilinear interpolation or, for grey, by their closed form."""
        table = self._sum((1 - self._x, self._x), (1 - self._y, self._y), (1 - self._z, self._z))
        offset = (self._grey - 0.5) * dr.rsqrt(self._grey * (1 - self._grey))
        return [dr.select(self._is_grey, grey, of_table) for grey, of_table in zip((0, 0, offset), table, strict=True)]

    def slopes(self) -> list[list[Any]]:
        """Return the derivatives of the coefficients by r, g and b. They ignore clipping, so that black can become brighter."""
        x, y, z = ((1 - at, at) for at in (self._x, self._y, self._z))
        by_first, by_second = self._sum((-1, 1), y, z), self._sum(x, (-1, 1), z)
        by_largest = [
            d / self._thickness - (a * self._first + b * self._second) / self._largest
            for d, a, b in zip(self._sum(x, y, (-1, 1)), by_first, by_second, strict=True)
        ]
        by_role = by_largest, [d * self._scale for d in by_first], [d * self._scale for d in by_second]
        # The channel c is (c - largest) mod 3 channels after the largest one.
        result = []
        for channel in range(3):
            of_number = [by_role[(channel - number) % 3] for number in range(3)]
            result.append(
                [
                    dr.select(self._number == 0, a, dr.select(self._number == 1, b, c))
                    for a, b, c in zip(*of_number, strict=True)
                ]
            )
        return result


def _holds_colours(node: Any) -> bool:
    """Return whether a bitmap that is not raw holds values that are no coefficients of a spectrum."""
    if class_name(node) != "BitmapTextureImpl" or is_raw(node):
        return False
    data: Any = mi.traverse(node)["data"]
    return channels(data) == 3 and bool(np.abs(data.numpy()[..., 0]).max(initial=0.0) > _LARGEST_FIRST)


def is_raw(node: Any) -> bool:
    """Return whether an object is a bitmap of raw values, which are no colours."""
    return class_name(node) == "BitmapTextureImpl" and _RAW.search(str(node)) is not None


def _split(value: mi.TensorXf) -> list[Any]:
    return list(dr.unravel(mi.Vector3f, value.array))


def _dot(parts: list[Any], others: list[Any]) -> Any:
    return total([a * b for a, b in zip(parts, others, strict=True)])


@functools.cache
def _table() -> tuple[np.ndarray, np.ndarray, int]:
    """Return Mitsuba's table: knots, flat coefficients, and the number of samples along each axis."""
    data = (Path(mi.__file__).parent / "data" / "srgb.coeff").read_bytes()
    size = int(np.frombuffer(data, "<u4", 1, 4)[0])
    numbers = np.frombuffer(data, "<f4", offset=8)
    return numbers[:size], numbers[size:], size


def _colours(coefficients: np.ndarray) -> np.ndarray:
    """Return linear sRGB (N, 3) in [0, 1] of reflectances with these coefficients (N, 3), lit by the white point D65."""
    λ = table_wavelengths()
    sampled: Any = mi.Float(λ)
    lit = np.array(mi.cie_d65(sampled)) * np.array(mi.cie1931_xyz(sampled)).reshape(3, -1)
    rgb = np.array(mi.xyz_to_srgb(mi.Color3f(lit / lit[1].sum()))).reshape(3, -1).T
    result = np.empty((len(coefficients), 3), np.float32)
    for start in range(0, len(result), _ROWS):
        rows = slice(start, start + _ROWS)
        x = np.polynomial.polynomial.polyval(λ, coefficients[rows, ::-1].T.astype(float))
        result[rows] = (0.5 + x / (2 * np.sqrt(1 + x * x))) @ rgb
    return np.clip(result, 0, 1)
