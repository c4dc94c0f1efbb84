"""Majorant supergrids: a bound of the extinction for each cell of a medium instead of one for all of it.

A medium has one where its extinction is a `gridvolume` of enough voxels (`cell_size`). A cell covers some voxels along each axis; its
majorant is the greatest extinction of the voxels that interpolation reaches from within, in all channels and, for a pair, in both
states. Rays walk from cell to cell (Amanatides and Woo 1987), and what they sample in each has the cell's majorant: the
optical depth of majorants to the next tentative collision is drawn once, and used up cell by cell. So nothing is biased, however
coarse the cells. SupergridTraversal beyond the grid, where it repeats, clamps or mirrors, have the majorant of the whole grid.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.rendering.mitsuba import emissive

_CELLS = 16
"""SupergridTraversal along an axis, at most."""

_LEAST = 2
"""Voxels of a cell along an axis, at least."""

_FINE = 16
"""Voxels along some axis from which on there is a supergrid: the fewest that were measured. On two CPU cores, against one majorant, a
pair of `smoke` took 0.6 of the time at 16³ voxels and 0.66 at 32³, the primal 0.7 and 0.9, at 4 to 13 % more variance of images. A
sparse grid of 64³ took 0.14 and 0.23, at 29 to 35 % more."""

_MARGIN = 1.25
"""Majorants are as much above the greatest extinction of a cell, up to that of the whole grid: where a majorant is hardly above the
extinction, ratios of transmittance are noisy, and two states of a pair part at null collisions."""

_ROUNDING = 0.25
"""Voxels by which the place of a grid may be wrong. SupergridTraversal look half a voxel further than interpolation does."""


class MajorantSupergrids:
    """The majorant supergrids of the media of one scene.

    Args:
        media: those of the scene, by their registry ids.
        transforms: (4, 4) by registry id, from [0, 1]³ to the world, of their extinction grids; a medium without one has no supergrid.

    Attributes:
        every: whether each medium has one.
        frames: `mi.Float`, 12 numbers by registry id: rows of the affine map from the world to cells.
        layout: `mi.UInt32`, 4 numbers by registry id: cells along x, y and z, 0 where there is no grid, and where in `values`
            its majorants begin.
    """

    def __init__(self, media: Mapping[int, Any], transforms: Mapping[int, np.ndarray]):
        parameters: dict[int, Any] = {number: mi.traverse(medium) for number, medium in media.items()}
        self._voxels = [(of, of["sigma_t.data"].shape) for of in parameters.values() if "sigma_t.data" in of]
        found = {
            number: MajorantSupergrid.of(medium, parameters[number], transforms.get(number))
            for number, medium in media.items()
        }
        self._grids = {number: grid for number, grid in found.items() if grid is not None}
        self.every = len(self._grids) == len(found)
        size = max(found, default=0) + 1
        frames, layout = np.zeros((size, 3, 4), np.float32), np.zeros((size, 4), np.uint32)
        start = 0
        for number, grid in self._grids.items():
            frames[number] = grid.to_cells
            layout[number] = (*grid.cells, start)
            start += grid.size
        self.frames = mi.Float(frames.ravel())
        self.layout = mi.UInt32(layout.ravel())

    def __bool__(self) -> bool:
        return bool(self._grids)

    def fits(self) -> bool:
        """Whether all extinctions still have the resolutions that these grids were laid out for."""
        return all(tuple(of["sigma_t.data"].shape) == tuple(shape) for of, shape in self._voxels)

    def shapes(self) -> list[tuple[int, ...]]:
        """What two states must have alike to be bounded together."""
        return [(*grid.cells, *grid.voxels) for grid in self._grids.values()]

    def values(self) -> Any:
        """All majorants, `mi.Float`, from what the grids hold now: z, y, x of each, a layer around it included."""
        parts = [grid.majorants() for grid in self._grids.values()]
        return parts[0] if len(parts) == 1 else dr.concat(parts)


class MajorantSupergrid:
    """The majorant supergrid of one medium.

    Attributes:
        voxels: of the extinction along x, y and z.
        cells: likewise of this.
        to_cells: (3, 4), affine, from the world to cells.
        size: of its `majorants`.
    """

    def __init__(self, parameters: Any, to_local: np.ndarray, scale: float):
        self._parameters = parameters
        self._scale = scale
        *shape, self._channels = parameters["sigma_t.data"].shape
        z, y, x = shape
        self.voxels = int(x), int(y), int(z)
        self._cell = tuple(cell_size(n) for n in self.voxels)
        self.cells = tuple(-(-n // k) for n, k in zip(self.voxels, self._cell, strict=True))
        self.size = int(np.prod([n + 2 for n in self.cells]))
        self.to_cells = to_local * (np.array(self.voxels) / self._cell)[:, None]
        self._known: tuple[Any, Any] | None = None

    @staticmethod
    def of(medium: Any, parameters: Any, to_world: np.ndarray | None) -> MajorantSupergrid | None:
        """From what `mi.traverse` finds in a medium. None where it is to have one majorant: homogeneous ones, small grids, grids whose
        place is not known."""
        if medium.class_name() != "HeterogeneousMedium" and not emissive.emits(medium):
            return None
        if "sigma_t.data" not in parameters or to_world is None:
            return None
        volume = parameters.properties["sigma_t.data"][2]
        if not isinstance(volume, mi.Volume) or volume.class_name() != "GridVolume":
            return None
        if max(parameters["sigma_t.data"].shape[:3]) < _FINE:
            return None
        place = to_local(volume, to_world)
        scale = float(parameters["scale"]) if "scale" in parameters else 1.0
        return None if place is None else MajorantSupergrid(parameters, place, scale)

    def majorants(self) -> Any:
        """Those of the cells, and around them a layer of the greatest: `mi.Float` of (z + 2, y + 2, x + 2)."""
        data = dr.detach(self._parameters["sigma_t.data"].array)
        if self._known is None or self._known[0].index != data.index:
            # The array is kept beside what was made of it, so that no other gets its index meanwhile.
            self._known = data, self._pooled(data)
        return self._known[1]

    def _pooled(self, data: Any) -> Any:
        x, y, z = self.voxels
        found = data
        if self._channels > 1:
            voxel = dr.arange(mi.UInt32, x * y * z) * self._channels
            several = [dr.gather(mi.Float, data, voxel + channel) for channel in range(self._channels)]
            found = functools.reduce(dr.maximum, several)
            dr.eval(found)
        found = _pool(found, (z * y, x, 1), self._cell[0], self.cells[0])
        found = _pool(found, (z, y, self.cells[0]), self._cell[1], self.cells[1])
        found = _pool(found, (1, z, self.cells[1] * self.cells[0]), self._cell[2], self.cells[2])
        found *= self._scale
        greatest = dr.max(found)
        found = dr.minimum(found * _MARGIN, greatest)
        return _surrounded(found, self.cells, greatest)


def cell_size(voxels: int) -> int:
    """How many voxels a cell covers along an axis."""
    return max(_LEAST, -(-voxels // _CELLS))


def _pool(values: Any, shape: tuple[int, int, int], size: int, cells: int) -> Any:
    """Maxima along the middle axis over `size` voxels and one more on each side: those that linear interpolation reaches. Past an end of
    the grid, where the last cell may end too, they are those of its other end, or mirrored, whichever is greater."""
    outer, count, inner = shape
    index = dr.arange(mi.UInt32, outer * cells * inner)
    row, column = index // (cells * inner), index % inner
    first = mi.Int32(index // inner % cells) * size
    greatest, gap = mi.Float(0), cells * size - count
    for offset in range(-1, size + 1):
        voxel = first + offset
        repeated = dr.select(voxel < 0, count - 1, dr.select(voxel < count, voxel, voxel - count))
        mirrored = dr.select(voxel < 0, 0, dr.select(voxel < count, voxel, 2 * count - 1 - voxel))
        for found in (repeated, mirrored) if offset in (-1, *range(size - gap, size + 1)) else (repeated,):
            index = mi.UInt32(dr.clip(found, 0, count - 1))
            greatest = dr.maximum(greatest, dr.gather(mi.Float, values, (row * count + index) * inner + column))
    dr.eval(greatest)
    return greatest


def _surrounded(values: Any, cells: tuple[int, ...], outside: Any) -> Any:
    """`values` of (z, y, x) with a layer of `outside` around."""
    x, y, z = cells
    index = dr.arange(mi.UInt32, (x + 2) * (y + 2) * (z + 2))
    i, j, k = index % (x + 2) - 1, index // (x + 2) % (y + 2) - 1, index // ((x + 2) * (y + 2)) - 1
    within = (i < x) & (j < y) & (k < z)  # -1 wraps around to the greatest number
    found = dr.gather(mi.Float, values, (k * y + j) * x + i, within)
    found = dr.select(within, found, outside)
    dr.eval(found)
    return found


def to_local(volume: Any, to_world: np.ndarray) -> np.ndarray | None:
    """The affine map (3, 4) from the world to [0, 1]³ of a `gridvolume`; None where it cannot be told well enough.

    Args:
        volume: live.
        to_world: (4, 4), the map from [0, 1]³ to the world that its description gives.

    The volume's bounding box is the check: a map that does not lead its corners there is refused. Where the grid's axes are the
    world's, the box is exact and gives the numbers.
    """
    box = volume.bbox()
    low, high = (np.array(corner, np.float64).ravel() for corner in (box.min, box.max))
    if not np.array_equal(to_world[3], [0, 0, 0, 1]) or not np.isfinite([*low, *high]).all() or not (low < high).all():
        return None
    if np.linalg.det(to_world) == 0:
        return None
    matrix = np.linalg.inv(to_world)
    corners = np.array([[i, j, k, 1] for i in (0, 1) for j in (0, 1) for k in (0, 1)]) @ to_world.T
    wrong = np.maximum(np.abs(corners.min(axis=0)[:3] - low), np.abs(corners.max(axis=0)[:3] - high))
    voxels = np.array([int(n) for n in volume.resolution()])
    if not ((np.abs(matrix[:3, :3]) @ wrong) * voxels < _ROUNDING).all():
        return None
    linear = matrix[:3, :3]
    linear[np.abs(linear) < 1e-6 * np.abs(linear).max()] = 0
    if ((linear != 0).sum(axis=0) == 1).all() and ((linear != 0).sum(axis=1) == 1).all():
        matrix[:3, :3] = np.sign(linear) / (high - low)
        matrix[:3, 3] = -np.where(linear > 0, matrix[:3, :3] * low, matrix[:3, :3] * high).sum(axis=1)
    return matrix[:3]


@dataclass
class DdaState:
    """Where a walk through a medium is. State of Dr.Jit loops, hence mutable.

    Attributes:
        t: distance along the ray.
        σ̄: majorant there, both states'.
        cell: where it lies, x, y and z.
        border: distances at which the ray leaves it along each axis.
    """

    t: Any
    σ̄: Any
    cell: Any
    border: Any


class HomogeneousMajorant:
    """One majorant for all of a segment from `near` to `far`: 0 where there is no medium.

    No dataclass: Dr.Jit would take it for state of its loops.
    """

    def __init__(self, σ̄: Any, near: Any, far: Any):
        self.σ̄, self.near, self.far = σ̄, near, far

    def at_least(self, least: Any) -> HomogeneousMajorant:
        """The same with majorants of at least so much."""
        return HomogeneousMajorant(dr.maximum(self.σ̄, least), self.near, self.far)

    def start(self) -> DdaState:
        """At `near`."""
        return DdaState(mi.Float(self.near), mi.Float(self.σ̄), mi.Int32(0), mi.Float(0))

    def advance(self, place: DdaState, τ: Any, active: Any) -> DdaState:
        """Move on by an optical depth `τ` of majorants: beyond `far` where the medium has not so much left."""
        del active
        place.t = place.t + dr.select(place.σ̄ > 0, τ / place.σ̄, dr.inf)
        return place


class SupergridTraversal:
    """The cells that a segment crosses. Interface as `HomogeneousMajorant`.

    Args:
        tables: {"frames", "layout", "majorants"} of `MajorantSupergrids`.
        medium: `mi.MediumPtr`, of the scene that the tables are of.
        σ̄: the majorant where the medium has no grid; None where all have one.
        active: where there is a medium at all.
    """

    def __init__(self, tables: Any, medium: Any, ray: Any, near: Any, far: Any, σ̄: Any, active: Any):
        number: Any = dr.reinterpret_array(mi.UInt32, medium)
        layout = dr.gather(mi.Vector4u, tables["layout"], number, active)
        self.cells, self.offset = mi.Vector3i(layout.x, layout.y, layout.z), layout.w
        self.known = active & (layout.x > 0)
        rows = [dr.gather(mi.Vector4f, tables["frames"], 3 * number + axis, self.known) for axis in range(3)]
        self.o = mi.Vector3f([row.x * ray.o.x + row.y * ray.o.y + row.z * ray.o.z + row.w for row in rows])
        self.d = mi.Vector3f([row.x * ray.d.x + row.y * ray.d.y + row.z * ray.d.z for row in rows])
        self.values, self.σ̄, self.near, self.far, self.least = tables["majorants"], σ̄, near, far, mi.Float(0)
        moves = self.d != 0
        self.rate = dr.select(moves, dr.rcp(dr.select(moves, self.d, 1)), 0)
        self.across = dr.select(moves, dr.select(self.d > 0, self.rate, -self.rate), dr.inf)
        self.way = mi.Vector3i(dr.select(self.d > 0, 1, -1))

    def at_least(self, least: Any) -> SupergridTraversal:
        """The same with majorants of at least so much."""
        found = copy(self)
        found.least = least
        return found

    def _majorant(self, cell: Any, active: Any) -> Any:
        x, y, z = (mi.UInt32(dr.clip(cell[axis], -1, self.cells[axis]) + 1) for axis in range(3))
        wide, high = mi.UInt32(self.cells.x + 2), mi.UInt32(self.cells.y + 2)
        found = dr.gather(mi.Float, self.values, self.offset + (z * high + y) * wide + x, active & self.known)
        if self.σ̄ is not None:
            found = dr.select(self.known, found, self.σ̄)
        return dr.maximum(found, self.least)

    def start(self) -> DdaState:
        """At `near`: in the cell a little beyond, lest rounding finds one that the segment does not cross."""
        t = mi.Float(self.near)
        beyond = t + 1e-4 * (self.far - t)
        cell = mi.Vector3i(dr.floor(self.o + beyond * self.d))
        edge = mi.Vector3f(cell) + dr.select(self.d > 0, 1, 0)
        border = dr.select(dr.isfinite(self.across), (edge - self.o) * self.rate, dr.inf)
        return DdaState(t, self._majorant(cell, self.near < self.far), cell, border)

    @dr.syntax
    def advance(self, place: DdaState, τ: Any, active: Any) -> DdaState:
        """Move on by an optical depth `τ` of majorants, from cell to cell; to `far` where the medium has not so much left."""
        τ = mi.Float(τ)
        going = mi.Bool(active)
        while dr.hint(going, label="majorant cells"):
            end = dr.minimum(dr.min(place.border), self.far)
            left = place.σ̄ * dr.maximum(end - place.t, 0)
            collides = τ < left
            place.t = dr.select(collides, place.t + τ / place.σ̄, dr.maximum(end, place.t))
            going &= ~collides & (end < self.far)
            τ -= left
            nearest = going & (place.border == end)
            nearest.y &= ~nearest.x
            nearest.z &= ~nearest.x & ~nearest.y
            place.cell = dr.select(nearest, place.cell + self.way, place.cell)
            place.border = dr.select(nearest, place.border + self.across, place.border)
            place.σ̄ = dr.select(going, self._majorant(place.cell, going), place.σ̄)
        return place
