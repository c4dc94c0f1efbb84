"""A reference image of the scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unrender.io.stored_pictures import StoredPicture


@dataclass(frozen=True)
class View:
    """A reference image and its sensor.

    Args:
        reference: file, or array (H, W, 3), in linear RGB. 8- and 16-bit files are converted from sRGB. An array has the film's format:
            luminance (H, W) or XYZ (H, W, 3) according to the film's `pixel_format`. Of 8- and 16-bit images with alpha only opaque pixels
            count, since rendered edges mix an object with what is behind it. Alpha of floating-point images is ignored, because films
            store premultiplied colours.
        sensor: index of the scene's sensor.
        weight: factor of this view's loss, > 0.
        mask: file or array (H, W), in [0, 1], the factor of each pixel's loss; None for ones. Of an image whose alpha varies, its alpha.
        known: {key: value} of parameters that have this value in this view alone, such as lamps that are off, or the pose of an object on
            a turntable. Values as for `Parameter.initial`. An unknown among them does not act on this view. None for the problem's scene
            as it is.
        scene: Another scene that this view is of, as for `Problem`: an .xml file, a dictionary, a function, or a renderer. Unknowns are
            those of the problem's scene; the ones that this scene has under the same key act on it. None for the problem's scene.
        aov: What the reference contains in place of colour, for the first surface that each pixel sees: "depth" (distance), "position",
            "sh_normal" (shading normal), "albedo" (diffuse reflectance), in world space, or "mask" (1 on surfaces). Background is 0. None
            for colour.
    """

    reference: str | Path | np.ndarray | StoredPicture
    sensor: int = 0
    weight: float = 1.0
    mask: str | Path | np.ndarray | StoredPicture | None = None
    known: Mapping[str, Any] | None = None
    scene: str | Path | dict[str, Any] | Callable[[], Any] | Any = None
    aov: str | None = None

    @property
    def own_world(self) -> bool:
        """Return whether the view shows other values, another scene or another quantity than the problem's scene."""
        return self.known is not None or self.scene is not None or self.aov is not None

    def pixel_weights(self, size: int | tuple[int, int] | None = None) -> np.ndarray:
        """Return the factor of each pixel's loss: the mask (H, W) of a loaded view, or ones of `size`, by default the reference's."""
        if self.mask is not None:
            return np.asarray(self.mask)
        return np.ones(np.asarray(self.reference).shape[:2] if size is None else size)
