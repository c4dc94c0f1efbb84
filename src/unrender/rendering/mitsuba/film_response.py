"""The film's response to light.

In spectral variants a camera ray samples four wavelengths λ, one more dimension of the path. The sensor's weight w is 1 / pdf(λ). With
the film's response R (CIE 1931, then linear sRGB), a sample of the film is the mean over λ of R_c(λ) w(λ) L(λ) in channel c. In RGB
variants it is w_c L_c.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

_STEP = 5.0  # distance in nanometres of the entries of Mitsuba's tables of the CIE 1931 curves


@dataclass
class SpectralSamples:
    """Radiance of paths in a spectral variant: weighted samples of the film; and, for a replay, unweighted radiance at the wavelengths.

    It is a dataclass, which recorded kernels carry."""

    film: Any
    spectrum: Any


class FilmResponse:
    """Linear map from the radiance of a ray to its sample of the film, by the sensor's weights and the wavelengths in nanometres. This is
    not a dataclass, since Dr.Jit would treat it as loop state."""

    def __init__(self, weight: Any, wavelengths: Any, tables: Mapping[str, Any]):
        self.weight = weight
        self._rows = _rows(weight, wavelengths, tables["response"]) if is_spectral() else None

    def film(self, L: Any) -> Any:
        """Return the samples of the film, `mi.Color3f`, for radiance or a derivative of it."""
        return L * self.weight if self._rows is None else mi.Color3f(*(dr.sum(row * L) for row in self._rows))

    def pull_back(self, δ: Any) -> Any:
        """Return derivatives by radiance, `mi.Spectrum`, for derivatives by samples of the film: the transpose of `film`."""
        if self._rows is None:
            return δ * self.weight
        return self._rows[0] * δ.x + self._rows[1] * δ.y + self._rows[2] * δ.z

    def stored(self, L: Any) -> Any:
        """Return radiance as `film_samples`, `with_film` and `replayed` accept it."""
        return self.film(L) if self._rows is None else SpectralSamples(self.film(L), L)

    def replayed(self, stored: Any, finite: Any) -> Any:
        """Return the unweighted radiance of `stored`, 0 in lanes that are not finite."""
        if isinstance(stored, SpectralSamples):
            return dr.select(finite, stored.spectrum, 0)
        return dr.select((self.weight != 0) & finite, stored / self.weight, 0)


def film_samples(stored: Any) -> Any:
    """Return the samples of the film, `mi.Color3f`, of `FilmResponse.stored`."""
    return stored.film if isinstance(stored, SpectralSamples) else stored


def with_film(stored: Any, film: Any) -> Any:
    """Return `stored` with other samples of the film."""
    return SpectralSamples(film, stored.spectrum) if isinstance(stored, SpectralSamples) else film


def is_spectral() -> bool:
    """Return whether the active variant is spectral."""
    return bool(mi.is_spectral)  # pyright: ignore[reportAttributeAccessIssue]


def response_table() -> dict[str, Any]:
    """Return the film's response at the wavelengths of `_curves`, an input of recorded kernels; {} in RGB variants."""
    return {"response": mi.Float(_curves().ravel())} if is_spectral() else {}


def table_wavelengths() -> np.ndarray:
    """Return the wavelengths of Mitsuba's tables of the CIE 1931 curves in nanometres, (95,)."""
    return np.arange(mi.MI_CIE_MIN, mi.MI_CIE_MAX + 1, _STEP)


@functools.cache
def _curves() -> np.ndarray:
    """Return the response of the linear sRGB channels every 5 nm from 360 to 830 nm, (95, 3), which Mitsuba interpolates linearly."""
    λ: Any = mi.Float(table_wavelengths())
    rgb = mi.xyz_to_srgb(mi.cie1931_xyz(λ))
    return np.array(rgb).reshape(3, -1).T * float(mi.MI_CIE_Y_NORMALIZATION)


def _rows(weight: Any, wavelengths: Any, curves: Any) -> list[Any]:
    """Return R_c(λ) w(λ) over the number of wavelengths, for each channel c."""
    position = (wavelengths - mi.MI_CIE_MIN) / _STEP
    count = len(wavelengths)
    below = [mi.UInt32(dr.clip(position[i], 0, dr.width(curves) // 3 - 2)) for i in range(count)]
    rows = []
    for channel in range(3):
        ends = [[dr.gather(mi.Float, curves, 3 * (at + step) + channel) for at in below] for step in (0, 1)]
        values = [
            dr.lerp(low, high, position[i] - at) for i, (low, high, at) in enumerate(zip(*ends, below, strict=True))
        ]
        rows.append(weight * mi.Spectrum(*values) / count)
    return rows
