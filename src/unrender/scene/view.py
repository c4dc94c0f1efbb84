"""A reference image of the scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unrender.io.stored_pictures import StoredPicture


@dataclass(frozen=True)
class View:
    """A reference image and its sensor.

    Args:
        reference: file, or array (H, W, 3), in linear RGB. 8-bit files are converted from sRGB. An array contains the film's format:
            luminance (H, W) or XYZ (H, W, 3) according to the film's `pixel_format`. Alpha of 8- and 16-bit images multiplies the mask.
            Alpha of floating-point images is ignored, because films store premultiplied colours.
        sensor: index of the scene's sensor.
        weight: factor of this view's loss, > 0.
        mask: file or array (H, W), in [0, 1], the factor of each pixel's loss; None for ones.
    """

    reference: str | Path | np.ndarray | StoredPicture
    sensor: int = 0
    weight: float = 1.0
    mask: str | Path | np.ndarray | StoredPicture | None = None
