"""Problems `lenses` and `relief`: heights of a surface, of which an expression makes the vertices of a mesh.

`lenses` is seen by the caustics that a pane of glass casts on a screen, `relief` in three images under one lamp each.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts
from unrender.gallery.specification import reference
from unrender.preconditioners import LargeSteps
from unrender.rendering.mitsuba.scene_loading import load
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem
from unrender.scene.references import View

_CENTRES = ((-0.5, 0.35), (0.5, 0.35), (0.0, -0.45))
_RADIUS, _PANE, _LAMP = 0.36, 1.4, 3.4  # radius of the lenses, and distances of pane and lamp from the screen
_HEIGHTS, _START, _LARGEST = (0.2, 0.08, 0.14), 0.12, 0.3
"""True heights in the middle of the lenses, the height of all at the start, and the largest."""


@register(name="lenses", position=35)
@dataclass(frozen=True)
class Lenses(fields.Rendered):
    """The heights of three lenses in a pane of glass, from the caustics that they cast on a screen.

    One view of the screen; the glass itself is not seen. The unknown is the height in the middle of each lens, (3,), initially the same.
    An expression makes the positions of the pane's vertices a function of it. A higher lens has a shorter focal length, so its caustic
    is smaller and brighter, or wider beyond the focus. Heights on both sides of the focus cast nearly the same caustic: a second minimum.
    """

    resolution: int = fields.resolution(24)
    mesh_resolution: int = fields.integer(40, "n: the pane has n by n vertices", at_least=8, at_most=1024)
    reference_spp: int = fields.reference_spp(8192)
    max_depth: int = fields.max_depth(5, at_least=4)

    def scene(self) -> dict[str, Any]:
        """Return the pane with lenses of equal heights, the screen at z = 0, and a lamp above."""
        return self._stage(np.full(len(_CENTRES), _START))

    def target(self) -> dict[str, Any]:
        return self._stage(np.array(_HEIGHTS))

    def problem(self, name: str) -> Problem:
        picture = reference(load(self.target), 0, self.reference_spp, self.max_depth)
        grid, shapes = meshes.height_grid(self.mesh_resolution), _shapes(self.mesh_resolution)
        return Problem(
            self.scene,
            [Parameter("height", initial=np.full(len(_CENTRES), _START), bounds=(0.0, _LARGEST))],
            [View(picture)],
            self.loss,
            self.max_depth,
            expressions={"pane.vertex_positions": partial(_bulged, grid, shapes)},
            truth={"height": np.array(_HEIGHTS)},
            name=name,
        )

    def _stage(self, heights: np.ndarray) -> dict[str, Any]:
        positions = meshes.height_grid(self.mesh_resolution)
        positions[..., 2] = _PANE + _shapes(self.mesh_resolution) @ heights
        glass = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
        return {
            "type": "scene",
            "camera": parts.camera((0, -1.9, 1.25), (0, -0.08, 0), 42.0, self.resolution),
            "screen": parts.rectangle((0, 0, 0), (1.5, 0, 0), (0, 1.5, 0), parts.diffuse(0.8)),
            "pane": meshes.triangles(
                "pane", positions.reshape(-1, 3), meshes.grid_faces(self.mesh_resolution, self.mesh_resolution), glass
            ),
            "back": parts.rectangle((0, 0, _PANE - 0.05), (-1, 0, 0), (0, 1, 0), glass),
            "lamp": parts.rectangle(
                (0, 0, _LAMP), (-0.35, 0, 0), (0, 0.35, 0), parts.diffuse(0.0), emitter=parts.light(20.0, 18.0, 15.0)
            ),
        }


def _shapes(count: int) -> np.ndarray:
    """Return the height of the pane per height of each lens, (n, n, 3): paraboloids."""
    grid = meshes.height_grid(count)[..., :2]
    squares = [np.sum(np.square(grid - np.array(centre)), axis=-1) for centre in _CENTRES]
    return np.stack([np.maximum(1.0 - square / _RADIUS**2, 0.0) for square in squares], axis=-1)


def _bulged(grid: np.ndarray, shapes: np.ndarray, values: Any) -> Any:
    """Return the positions (3 n²,) of the pane's vertices with lenses of `values["height"]`, (3,)."""
    heights = dr.sum(mi.TensorXf(shapes.astype(np.float32)) * values["height"], axis=2)
    lifted = dr.reshape(mi.TensorXf, heights, (*heights.shape, 1)) * mi.TensorXf(np.array([[[0, 0, 1]]], np.float32))
    return dr.reshape(mi.TensorXf, mi.TensorXf((grid + [0.0, 0.0, _PANE]).astype(np.float32)) + lifted, -1)


_LAMPS = ((-2.2, 0.9, 1.2), (2.2, 0.9, 1.2), (0.0, -2.3, 1.2))  # positions, low at the plaque's side and in front of it
_INTENSITY = 14.0
_DEEPEST = 0.3  # largest height above and below the plaque's plane, whose sides are 2 long


@register(name="relief", position=34)
@dataclass(frozen=True)
class Relief(fields.Rendered):
    """The height map of a plaque, from three images under one lamp each, starting with a flat plaque.

    Three views by one camera, each of a world in which one lamp is on. The unknown is the height of each vertex above the plane, (n, n, 1),
    with LargeSteps. An expression makes the mesh's vertex positions a function of it. The camera looks straight at the plaque, so heights
    change the image only by shading and shadows.
    """

    height_resolution: int = fields.integer(24, "n: the height map has n by n vertices", at_least=2, at_most=1024)
    reference_spp: int = fields.reference_spp(256)
    max_depth: int = fields.max_depth(3, at_least=2)

    def scene(self) -> dict[str, Any]:
        """Return the flat plaque, x and y in [-1, 1] at z = 0, under all lamps."""
        return self._stage(np.zeros((self.height_resolution, self.height_resolution)))

    def target(self) -> dict[str, Any]:
        return self._stage(_heights(self.height_resolution))

    def problem(self, name: str) -> Problem:
        truth = _heights(self.height_resolution)
        views = []
        for lit in range(len(_LAMPS)):
            picture = reference(load(partial(self._stage, truth, lit)), 0, self.reference_spp, self.max_depth)
            off = {f"lamp_{n}.intensity.value": [0.0, 0.0, 0.0] for n in range(len(_LAMPS)) if n != lit}
            views.append(View(picture, known=off))
        grid = meshes.height_grid(self.height_resolution)
        unknown = Parameter(
            "height", initial=np.zeros_like(grid[..., :1]), bounds=(-_DEEPEST, _DEEPEST), preconditioner=LargeSteps(1.0)
        )
        return Problem(
            self.scene,
            [unknown],
            views,
            self.loss,
            self.max_depth,
            expressions={"plaque.vertex_positions": partial(_displaced, grid)},
            truth={"height": truth[..., None]},
            name=name,
        )

    def _stage(self, heights: np.ndarray, lit: int | None = None) -> dict[str, Any]:
        """Return the scene with a height map (n, n), under one lamp or all."""
        positions = meshes.height_grid(self.height_resolution)
        positions[..., 2] = heights
        corners = meshes.grid_faces(self.height_resolution, self.height_resolution)
        lamps = {
            f"lamp_{n}": {
                "type": "point",
                "position": list(place),
                "intensity": parts.colour(_INTENSITY if lit in (None, n) else 0.0),
            }
            for n, place in enumerate(_LAMPS)
        }
        return {
            "type": "scene",
            "camera": parts.camera((0, 0, 5.0), (0, 0, 0), 25.0, self.resolution),
            "plaque": meshes.triangles("plaque", positions.reshape(-1, 3), corners, parts.twosided(parts.diffuse(0.6))),
            **lamps,
        }


def _displaced(grid: np.ndarray, values: Any) -> Any:
    """Return the positions (3 n²,) of the vertices of a flat plaque, moved along its normal by `values["height"]`, (n, n, 1)."""
    normal = mi.TensorXf(np.array([[[0.0, 0.0, 1.0]]], np.float32))
    return dr.reshape(mi.TensorXf, mi.TensorXf(grid.astype(np.float32)) + values["height"] * normal, -1)


def _heights(count: int) -> np.ndarray:
    """Return a ring with a dome in its middle and a groove across, flat at the border: (n, n)."""
    grid = meshes.height_grid(count)
    x, y = grid[..., 0], grid[..., 1]
    radius = np.hypot(x, y)
    ring = 0.12 * np.exp(-(((radius - 0.6) / 0.12) ** 2))
    dome = 0.16 * np.exp(-((radius / 0.25) ** 2))
    groove = -0.08 * np.exp(-(((x - y) / 0.18) ** 2)) * parts.ramp(1.0 - radius, 0.0, 0.3)
    return ring + dome + groove
