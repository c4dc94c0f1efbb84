"""From linear arrays to pictures that a browser shows: exposure, sRGB, false colour, PNG in the page itself."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass, replace

import matplotlib
import numpy as np
from PIL import Image

_LARGEST = 1024
_PIXELATED_BELOW = 400
_WHITE_PERCENTILE = 95.0
_WHITE = 0.7

ERRORS = "inferno"
"""Colour map of error images."""
VALUES = "viridis"
"""Colour map of weights and of one-channel parameters."""


@dataclass(frozen=True)
class Picture:
    """A picture within the page.

    Attributes:
        source: PNG as a data URI.
        width, height: in pixels of the array it shows.
        alt: what it shows, in words.
    """

    source: str
    width: int
    height: int
    alt: str

    @property
    def pixelated(self) -> bool:
        """Whether the browser should show pixels as squares rather than blur them."""
        return max(self.width, self.height) < _PIXELATED_BELOW


@dataclass(frozen=True)
class ColourBar:
    """What the colours of a false-colour picture mean.

    Attributes:
        colours: hexadecimal, from low to high.
        low, middle, high: the values at the ends and half-way between; beyond the ends the colour stays.
        label: what is shown.
    """

    colours: tuple[str, ...]
    low: float
    middle: float
    high: float
    label: str


def luminance(linear: np.ndarray) -> np.ndarray:
    """Rec. 709 luminance of (..., 3) linear RGB."""
    return linear @ np.array([0.2126, 0.7152, 0.0722])


def exposure(reference: np.ndarray) -> float:
    """The factor that takes the reference's 95th percentile of luminance to 0.7; 1 for a black reference.

    A percentile, so that a lamp in the picture leaves the rest of it visible.
    """
    found = luminance(reference)
    found = found[np.isfinite(found)]
    if found.size == 0:
        return 1.0
    level = float(np.percentile(found, _WHITE_PERCENTILE))
    level = level if level > 0 else float(found.max())
    return _WHITE / level if level > 0 else 1.0


def srgb(linear: np.ndarray) -> np.ndarray:
    """The sRGB transfer function (IEC 61966-2-1) of values clipped to [0, 1]."""
    x = np.clip(np.nan_to_num(linear, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4) - 0.055)


def colour(linear: np.ndarray, factor: float, alt: str) -> Picture:
    """(H, W, 3) linear RGB, times the exposure `factor`, in sRGB."""
    return _picture(srgb(_reduced(linear) * factor), linear.shape, alt)


def false_colour(values: np.ndarray, low: float, high: float, name: str, alt: str) -> Picture:
    """(H, W) values from `low` to `high` in the colours of the map `name`."""
    return _picture(mapped(_reduced(values), low, high, name), values.shape, alt)


def mapped(values: np.ndarray, low: float, high: float, name: str) -> np.ndarray:
    """Values from `low` to `high` through the colour map `name`: (H, W) -> (H, W, 3) in [0, 1]."""
    span = high - low
    place = (np.nan_to_num(values, nan=low, posinf=high, neginf=low) - low) / (span if span > 0 else 1.0)
    return matplotlib.colormaps[name](np.clip(place, 0.0, 1.0))[..., :3]


def false_colour_error(error: np.ndarray, high: float, alt: str) -> Picture:
    """(H, W) errors from 0 to `high`, the colour by the square root, so that a tenth of `high` is still seen."""
    return false_colour(np.sqrt(np.maximum(error, 0.0)), 0.0, np.sqrt(high), ERRORS, alt)


def error_bar(high: float) -> ColourBar:
    """The legend of `false_colour_error`."""
    return replace(colour_bar(0.0, high, ERRORS, "Mean |difference| over channels"), middle=high / 4)


def colour_bar(low: float, high: float, name: str, label: str) -> ColourBar:
    """The legend of `false_colour` with the same arguments."""
    stops = (matplotlib.colormaps[name](np.linspace(0.0, 1.0, 9))[:, :3] * 255 + 0.5).astype(int)
    return ColourBar(tuple(f"#{r:02x}{g:02x}{b:02x}" for r, g, b in stops), low, (low + high) / 2, high, label)


def absolute_error(shown: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """|shown - reference|, its mean over channels: (H, W, C) -> (H, W)."""
    return np.mean(np.abs(shown - reference), axis=-1)


def top(error: np.ndarray) -> float:
    """The end of an error's colour scale: its 99th percentile (its maximum where that is 0)."""
    finite = error[np.isfinite(error)]
    if finite.size == 0:
        return 1.0
    level = float(np.percentile(finite, 99.0))
    return level if level > 0 else float(finite.max()) or 1.0


def root_mean_square(a: np.ndarray, b: np.ndarray) -> float | None:
    """The root mean square difference, or None where the shapes differ (a parameter that was refined on the way)."""
    return float(np.sqrt(np.mean((a - b) ** 2, dtype=np.float64))) if a.shape == b.shape and a.size else None


def _reduced(array: np.ndarray) -> np.ndarray:
    """Box-filtered by a whole factor so that no side has more than `_LARGEST` pixels."""
    factor = -(-max(array.shape[:2]) // _LARGEST)
    if factor <= 1:
        return array
    pad = [(0, -side % factor) for side in array.shape[:2]] + [(0, 0)] * (array.ndim - 2)
    padded = np.pad(array, pad, mode="edge")
    height, width = (side // factor for side in padded.shape[:2])
    return padded.reshape(height, factor, width, factor, *array.shape[2:]).mean(axis=(1, 3))


def _picture(colours: np.ndarray, shape: tuple[int, ...], alt: str) -> Picture:
    buffer = io.BytesIO()
    Image.fromarray((colours * 255 + 0.5).astype(np.uint8)).save(buffer, "PNG", compress_level=9)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    return Picture(f"data:image/png;base64,{data}", shape[1], shape[0], alt)
