"""Conversion of linear arrays to pictures that a browser shows: exposure, sRGB, false colour, PNG data URIs."""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from unrender.display.pictures import png
from unrender.io.resampling import reduced
from unrender.losses.metrics import srgb

_LARGEST = 1024
_PIXELATED_BELOW = 400

ERROR_COLORMAP = "inferno"
"""Colour map of error images."""
VALUE_COLORMAP = "viridis"
"""Colour map of weights and of one-channel parameters."""
_COLORMAPS = {
    name: np.frombuffer(bytes.fromhex(colours), np.uint8).reshape(-1, 3) / 255.0
    for name, colours in {
        ERROR_COLORMAP: (
            "00000402020c0504170a072210092d160b391e0c45260c512f0a5b380962400a67490b6a510e6c59106e61136e69166e71196e78"
            "1c6d801f6c88226a902568982766a02a63a82e5fb0315bb73557bf3952c63d4dcc4248d34743d94d3ddf5337e45a31e9612bed69"
            "25f1711ff47918f78212f98b0bfa9407fb9d07fca60cfcb014fbba1ffac42af8cd37f6d746f4e156f2ea69f2f27df5f992fcffa4"
        ),
        VALUE_COLORMAP: (
            "44015446085c471063481769481d6f482475472a7a46307e453781433d844142873f48893d4e8a3a538b38598c355e8d33638d31"
            "688e2e6d8e2c718e2a768e297b8e27808e25848e23898e218e8d20928c1f978b1e9c891fa18821a58524aa8328ae802eb37c35b7"
            "793dbc7446c06f50c46a5ac86465cb5e70cf577cd25089d54895d840a2da37b0dd2fbddf26cae11fd8e219e5e419f1e51dfde725"
        ),
    }.items()
}
"""Every fifth of the 256 colours of Matplotlib's maps. Its import would take a fifth of a page's time."""


@dataclass(frozen=True)
class Picture:
    """A picture within the page: data URI or address, size of the array, description, and whether its colours are linear, with an
    exposure."""

    source: str
    width: int
    height: int
    alt: str
    linear: bool = False

    @property
    def pixelated(self) -> bool:
        """True if the browser should show pixels as squares instead of interpolating them."""
        return max(self.width, self.height) < _PIXELATED_BELOW


@dataclass(frozen=True)
class PictureData:
    """The values of a picture, not yet encoded.

    Attributes:
        values: (H, W, 3) linear RGB, or (H, W) numbers.
        factor: exposure of linear RGB.
        low, high, map: range of the colour scale and name of the colour map, for numbers.
        root: whether the colour scale uses the square root of the numbers.
    """

    values: np.ndarray
    factor: float = 1.0
    low: float = 0.0
    high: float = 1.0
    map: str = ""
    root: bool = False

    def png(self, exposure: float = 1.0, effort: int = 9) -> bytes:
        """Encode the picture as a PNG file of the compression level `effort`, 0 to 9. `exposure` is a further factor of linear RGB."""
        shown = reduced(self.values, _LARGEST)
        if self.map:
            shown = np.sqrt(np.maximum(shown, 0.0)) if self.root else shown
            high = np.sqrt(self.high) if self.root else self.high
            colours = apply_colormap(shown, self.low, high, self.map)
        else:
            with np.errstate(over="ignore"):
                colours = srgb(shown * (self.factor * exposure))
        return png(colours, effort)


def inline(picture: PictureData) -> str:
    """Return the picture as a data URI, for a self-contained page."""
    return f"data:image/png;base64,{base64.b64encode(picture.png()).decode('ascii')}"


@dataclass(frozen=True)
class PictureEncoder:
    """An encoder of pictures for a page; `source` returns the `src` of the `img` element: the data itself (`inline`), or its address."""

    source: Callable[[PictureData], str] = field(default=inline)

    def colour(self, linear: np.ndarray, factor: float, alt: str) -> Picture:
        """Encode (H, W, 3) linear RGB, multiplied by the exposure `factor`, in sRGB."""
        return self._picture(PictureData(linear, factor), alt)

    def false_colour(self, values: np.ndarray, low: float, high: float, alt: str) -> Picture:
        """Encode (H, W) values from `low` to `high` by the colour map of values."""
        return self._picture(PictureData(values, 1.0, low, high, VALUE_COLORMAP), alt)

    def error(self, error: np.ndarray, high: float, alt: str) -> Picture:
        """Encode (H, W) errors from 0 to `high` by their square root, so that a tenth of `high` remains visible."""
        return self._picture(PictureData(error, 1.0, 0.0, high, ERROR_COLORMAP, True), alt)

    def _picture(self, picture: PictureData, alt: str) -> Picture:
        height, width = picture.values.shape[:2]
        return Picture(self.source(picture), width, height, alt, not picture.map)


INLINE = PictureEncoder()
"""The encoder of pictures that are part of the page."""


@dataclass(frozen=True)
class ColourBar:
    """The legend of a false-colour picture.

    Attributes:
        colours: hexadecimal colours, from low to high.
        low, middle, high: values at the ends and in the middle; values beyond the ends have the colour of the nearer end.
        label: name of the quantity.
    """

    colours: tuple[str, ...]
    low: float
    middle: float
    high: float
    label: str


def apply_colormap(values: np.ndarray, low: float, high: float, name: str = VALUE_COLORMAP) -> np.ndarray:
    """Map values from `low` to `high` to colours of the colour map `name`: (...) -> (..., 3) in [0, 1]."""
    span, colours = high - low, _COLORMAPS[name]
    place = (np.nan_to_num(values, nan=low, posinf=high, neginf=low) - low) / (span if span > 0 else 1.0)
    nodes = np.linspace(0.0, 1.0, len(colours))
    return np.stack([np.interp(place, nodes, channel) for channel in colours.T], axis=-1)


def error_bar(high: float) -> ColourBar:
    """Return the legend of `PictureEncoder.error`."""
    return replace(colour_bar(0.0, high, "Mean |difference| over channels", ERROR_COLORMAP), middle=high / 4)


def colour_bar(low: float, high: float, label: str, name: str = VALUE_COLORMAP) -> ColourBar:
    """Return the legend of a picture in a colour map from `low` to `high`."""
    stops = (apply_colormap(np.linspace(0.0, 1.0, 9), 0.0, 1.0, name) * 255 + 0.5).astype(int)
    return ColourBar(tuple(f"#{r:02x}{g:02x}{b:02x}" for r, g, b in stops), low, (low + high) / 2, high, label)


def absolute_error(shown: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """Return the mean of |shown - reference| over the channels: (H, W, C) -> (H, W); NaN where a mask (H, W) is 0."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.mean(np.abs(shown - reference), axis=-1)
    return error if mask is None else np.where(mask > 0, error, np.nan)


def colour_limit(error: np.ndarray) -> float:
    """Return the end of an error's colour scale: the 99th percentile of the finite values, else their maximum, else 1."""
    finite = error[np.isfinite(error)]
    if finite.size == 0:
        return 1.0
    level = float(np.percentile(finite, 99.0))
    return level if level > 0 else float(finite.max()) or 1.0
