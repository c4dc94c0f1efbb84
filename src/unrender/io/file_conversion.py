"""How a renderer converts what a file or an array holds to the values of one of its parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from unrender.core import periodic

MESH_FILES = (".obj", ".ply", ".serialized")
"""File name endings of meshes."""


@dataclass(frozen=True)
class FileConversion:
    """The conversion that the renderer applies when it loads such a parameter from a file of the scene.

    Attributes:
        raw: whether 8- and 16-bit pictures hold linear values; otherwise they are sRGB.
        half: whether the renderer stores values in half precision.
        repeated: number of columns at each end of the second axis that repeat columns of the opposite end, as environment maps of
            Mitsuba have one. The parameter has the shape (H, W + 2 `repeated`, C), and its pictures (H, W).
        vertices: returns the parameter's values from a mesh file as a flat float32 array; None where no mesh holds them.
    """

    raw: bool = False
    half: bool = False
    repeated: int = 0
    vertices: Callable[[Path], np.ndarray] | None = field(default=None, compare=False, repr=False)

    def picture_shape(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Return the shape of a picture that fills a parameter of this shape without being scaled."""
        return periodic.interior_shape(shape, self.repeated)

    def stored(self, values: np.ndarray) -> np.ndarray:
        """Return float32 values as the renderer stores them: rounded to its precision."""
        if not self.half:
            return values
        with np.errstate(over="ignore"):
            rounded = values.astype(np.float16).astype(np.float32)
        return np.where(np.isfinite(rounded), rounded, values)


PLAIN = FileConversion()
"""Values are stored as they are."""
