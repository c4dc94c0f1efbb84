"""One reference image of the scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unrender.io.stored_pictures import StoredPicture


@dataclass(frozen=True)
class View:
    """A reference image and the sensor that it was taken with.

    Args:
        reference: file, or array (H, W, 3), linear RGB. 8-bit files are taken as sRGB and linearised. An array is what the film stores:
            luminance (H, W) or XYZ (H, W, 3) where the film's `pixel_format` says so. Alpha of 8- and 16-bit pictures multiplies the mask;
            that of floating-point pictures is left out, since films store colours multiplied with it.
        sensor: index of the scene's sensor.
        weight: factor of this view's loss, > 0.
        mask: file or array (H, W), in [0, 1]; factor of each pixel's loss. None for all ones.
    """

    reference: str | Path | np.ndarray | StoredPicture
    sensor: int = 0
    weight: float = 1.0
    mask: str | Path | np.ndarray | StoredPicture | None = None
