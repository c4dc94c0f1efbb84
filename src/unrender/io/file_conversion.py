"""Conversion from the contents of a file or an array to the values of a renderer's parameter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from unrender.core import periodic

MESH_FILES = (".obj", ".ply", ".serialized")
"""File name extensions of meshes."""


@dataclass(frozen=True)
class FileConversion:
    """Conversion that the renderer applies to this parameter when it loads it from a file of the scene.

    Attributes:
        raw: whether 8- and 16-bit images are linear; otherwise they are sRGB.
        half: whether the renderer stores values in half precision.
        repeated: number of columns at each end of the second axis that repeat those of the opposite end; Mitsuba's environment maps have
            one. The parameter has the shape (H, W + 2 `repeated`, C), and its images have (H, W).
        vertices: function that returns the parameter's values from a mesh file as a flat float32 array; None for other parameters.
    """

    raw: bool = False
    half: bool = False
    repeated: int = 0
    vertices: Callable[[Path], np.ndarray] | None = field(default=None, compare=False, repr=False)

    def picture_shape(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Return the shape (H, W, C) of an image that fills a parameter of this shape without scaling."""
        return periodic.interior_shape(shape, self.repeated)

    def stored(self, values: np.ndarray) -> np.ndarray:
        """Return float32 values rounded to the renderer's precision. Values beyond the range of half precision are not changed."""
        if not self.half:
            return values
        with np.errstate(over="ignore"):
            rounded = values.astype(np.float16).astype(np.float32)
        return np.where(np.isfinite(rounded), rounded, values)


PLAIN = FileConversion()
"""Conversion that stores values unchanged."""
