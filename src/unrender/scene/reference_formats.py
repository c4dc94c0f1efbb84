"""References in the formats in which films store pictures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core.errors import InputError
from unrender.io import images
from unrender.rendering.renderer import PictureFormat

__all__ = ["Reference", "read_reference"]

_DARKEST = -1e-4
"""Share of the largest value down to which negative values are rounding."""


@dataclass(frozen=True)
class Reference:
    """A reference as losses compare it.

    Attributes:
        values: (H, W, 3) float32, linear RGB; of a film that stores luminance, that in each channel.
        alpha: (H, W) in [0, 1], of a cut-out picture of 8 or 16 bits; None where there is none.
        limited: whether values end at a white.
        notices: one line for each conversion.
    """

    values: np.ndarray
    alpha: np.ndarray | None
    limited: bool
    notices: tuple[str, ...]


def read_reference(source: Any, form: PictureFormat) -> Reference:
    """The reference in a file or an array.

    An array, or a .npy file, has what the film of that format stores. Other files tell their own colour space.
    The alpha of 8- and 16-bit pictures becomes a mask. That of floating-point pictures is left out: films store colours that are
    multiplied with it already.

    Raises `InputError`: see `images.read`; and for another number of channels than the film's, and for negative radiance.
    """
    grey = form.colour == "luminance"
    channels = {"luminance": (1, 2), "xyz": (3, 4), "rgb": (1, 3, 4)}[form.colour]
    try:
        image = images.read(source, alpha=True, channels=channels)
    except InputError as error:
        if form.colour == "rgb" or "expected an array of shape" not in str(error):
            raise
        raise InputError(f"{error}: the film's pixel_format is {form.colour}") from error
    values = image.values
    if grey and values.shape[2] != 1:
        raise InputError(
            "it has three channels and the film's pixel_format is luminance: give one channel, or the film pixel_format rgb"
        )
    if not form.signed:
        _check_not_negative(values)
    notices = [image.notice] if image.notice else []
    if form.colour == "xyz" and _is_of_film(source):
        values = images.xyz_to_rgb(values)
        notices.append("in XYZ as the film stores it, converted to RGB")
    elif values.shape[2] == 1 and not grey:
        notices.append("of one channel, which red, green and blue of the image are each compared with")
    elif grey:
        notices.append("of luminance, which the luminance of the image is compared with")
    full = np.array(np.broadcast_to(values, (*values.shape[:2], 3)))
    return Reference(full, image.alpha, bool(image.notice), tuple(notices))


def _is_of_film(source: Any) -> bool:
    """Whether values are as a film has them, with no colour space of their own."""
    path = isinstance(source, (str, Path))
    integers = not path and np.asarray(source).dtype in (np.uint8, np.uint16)
    return not integers and (not path or Path(source).suffix.lower() == ".npy")


def _check_not_negative(values: np.ndarray) -> None:
    bad = (values < _DARKEST * max(float(values.max()), 0.0)).any(axis=-1)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise InputError(
            f"{int(bad.sum())} pixels are negative, the first in row {row}, column {column}, and radiance is not: "
            "clip them at 0, or give the film the filter with negative lobes that made them"
        )
