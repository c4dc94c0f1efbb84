"""From linear arrays to pictures that a browser shows: exposure, sRGB, false colour, PNG in the page itself."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from PIL import Image

from unrender.io.thumbnails import reduced
from unrender.losses.metrics import exposure, srgb

_LARGEST = 1024
_PIXELATED_BELOW = 400

__all__ = [
    "ERROR_COLORMAP",
    "INLINE",
    "VALUE_COLORMAP",
    "ColourBar",
    "Picture",
    "PictureData",
    "PictureEncoder",
    "absolute_error",
    "apply_colormap",
    "colour_bar",
    "colour_limit",
    "error_bar",
    "exposure",
    "inline",
    "srgb",
]

ERROR_COLORMAP = "inferno"
"""Colour map of error images."""
VALUE_COLORMAP = "viridis"
"""Colour map of weights and of one-channel parameters."""


@dataclass(frozen=True)
class Picture:
    """A picture within the page.

    Attributes:
        source: a data URI, or where it is served.
        width, height: in pixels of the array it shows.
        alt: what it shows, in words.
        linear: whether it shows linear colours, which may be exposed otherwise.
    """

    source: str
    width: int
    height: int
    alt: str
    linear: bool = False

    @property
    def pixelated(self) -> bool:
        """Whether the browser should show pixels as squares rather than blur them."""
        return max(self.width, self.height) < _PIXELATED_BELOW


@dataclass(frozen=True)
class PictureData:
    """What a picture shows, not yet encoded.

    Attributes:
        values: (H, W, 3) linear RGB, or (H, W) numbers.
        factor: exposure of linear RGB.
        low, high, map: of numbers: the ends of their colours, and the colour map's name.
        root: whether colours go with the square root of numbers.
    """

    values: np.ndarray
    factor: float = 1.0
    low: float = 0.0
    high: float = 1.0
    map: str = ""
    root: bool = False

    def png(self, exposure: float = 1.0, effort: int = 9) -> bytes:
        """The picture as a PNG file.

        Args:
            exposure: a further factor of linear RGB; numbers do not know it.
            effort: of compression, 0 to 9.
        """
        shown = reduced(self.values, _LARGEST)
        if self.map:
            shown = np.sqrt(np.maximum(shown, 0.0)) if self.root else shown
            high = np.sqrt(self.high) if self.root else self.high
            colours = apply_colormap(shown, self.low, high, self.map)
        else:
            with np.errstate(over="ignore"):
                colours = srgb(shown * (self.factor * exposure))
        buffer = io.BytesIO()
        Image.fromarray((colours * 255 + 0.5).astype(np.uint8)).save(buffer, "PNG", compress_level=effort)
        return buffer.getvalue()


def inline(picture: PictureData) -> str:
    """The picture as a data URI, for a page that is complete in itself."""
    return f"data:image/png;base64,{base64.b64encode(picture.png()).decode('ascii')}"


@dataclass(frozen=True)
class PictureEncoder:
    """Makes pictures for a page.

    Attributes:
        source: what an `img` element takes for a picture: the data itself (`inline`), or where it is served.
    """

    source: Callable[[PictureData], str] = field(default=inline)

    def colour(self, linear: np.ndarray, factor: float, alt: str) -> Picture:
        """(H, W, 3) linear RGB, times the exposure `factor`, in sRGB."""
        return self._picture(PictureData(linear, factor), alt)

    def false_colour(self, values: np.ndarray, low: float, high: float, name: str, alt: str) -> Picture:
        """(H, W) values from `low` to `high` in the colours of the map `name`."""
        return self._picture(PictureData(values, 1.0, low, high, name), alt)

    def error(self, error: np.ndarray, high: float, alt: str) -> Picture:
        """(H, W) errors from 0 to `high`, the colour by the square root, so that a tenth of `high` is still seen."""
        return self._picture(PictureData(error, 1.0, 0.0, high, ERROR_COLORMAP, True), alt)

    def _picture(self, picture: PictureData, alt: str) -> Picture:
        height, width = picture.values.shape[:2]
        return Picture(self.source(picture), width, height, alt, not picture.map)


INLINE = PictureEncoder()
"""Makes pictures that are part of the page."""


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


def apply_colormap(values: np.ndarray, low: float, high: float, name: str) -> np.ndarray:
    """Values from `low` to `high` through the colour map `name`: (H, W) -> (H, W, 3) in [0, 1]."""
    import matplotlib

    span = high - low
    place = (np.nan_to_num(values, nan=low, posinf=high, neginf=low) - low) / (span if span > 0 else 1.0)
    return matplotlib.colormaps[name](np.clip(place, 0.0, 1.0))[..., :3]


def error_bar(high: float) -> ColourBar:
    """The legend of `PictureEncoder.error`."""
    return replace(colour_bar(0.0, high, ERROR_COLORMAP, "Mean |difference| over channels"), middle=high / 4)


def colour_bar(low: float, high: float, name: str, label: str) -> ColourBar:
    """The legend of `PictureEncoder.false_colour` with the same arguments."""
    import matplotlib

    stops = (matplotlib.colormaps[name](np.linspace(0.0, 1.0, 9))[:, :3] * 255 + 0.5).astype(int)
    return ColourBar(tuple(f"#{r:02x}{g:02x}{b:02x}" for r, g, b in stops), low, (low + high) / 2, high, label)


def absolute_error(shown: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """|shown - reference|, its mean over channels: (H, W, C) -> (H, W)."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.mean(np.abs(shown - reference), axis=-1)


def colour_limit(error: np.ndarray) -> float:
    """The end of an error's colour scale: its 99th percentile (its maximum where that is 0)."""
    finite = error[np.isfinite(error)]
    if finite.size == 0:
        return 1.0
    level = float(np.percentile(finite, 99.0))
    return level if level > 0 else float(finite.max()) or 1.0
