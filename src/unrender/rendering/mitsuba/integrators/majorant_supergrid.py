"""Majorant supergrids: a bound of the extinction for each supervoxel instead of one for the entire medium.

A medium has a supergrid if its extinction is a `gridvolume` with enough voxels (`cell_size`). A cell covers several voxels along each
axis. Its majorant is the maximum extinction of the voxels that interpolation reads inside it, over all channels and, for a pair, both
states. Rays traverse the cells (Amanatides and Woo 1987), and sampling in each cell uses its majorant: the optical depth to the next
tentative collision is sampled once and consumed cell by cell. Estimates are therefore unbiased for any cell size. Cells outside the
grid, where it repeats, clamps or mirrors, have the majorant of the entire grid.
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

_CELLS = 16  # maximum number of cells along an axis
_LEAST = 2  # minimum number of voxels of a cell along an axis

_FINE = 16
"""Minimum number of voxels along the longest axis for a supergrid: the smallest measured size. Times on two CPU cores, relative to one
majorant: a pair of `smoke` 0.6 at 16³ voxels and 0.66 at 32³, its primal 0.7 and 0.9, with 4 to 13 % more image variance; a sparse grid
of 64³ 0.14 and 0.23, with 29 to 35 % more."""

_MARGIN = 1.25
"""Factor from a cell's maximum extinction to its majorant, clamped to the grid's maximum. A tight majorant makes ratio-tracked
transmittance noisy and decorrelates the states of a pair at null collisions."""

_ROUNDING = 0.25  # Tolerance of a grid's position in voxels. Cells cover half a voxel more than interpolation reads.


class MajorantSupergrids:
    """Majorant supergrids of the media of one scene.

    Args:
        media: media of the scene, by their registry ids.
        transforms: (4, 4) by registry id, from [0, 1]³ to the world, of their extinction grids; a medium without one has no supergrid.

    Attributes:
        every: whether each medium has a supergrid.
        frames: `mi.Float`, 12 numbers by registry id: rows of the affine map from the world to cells.
        layout: `mi.UInt32`, 4 numbers by registry id: cells along x, y and z, 0 without a grid, and the index of its first majorant
            in `values`.
    """

    def __init__(self, media: Mapping[int, Any], transforms: Mapping[int, np.ndarray]):
        parameters: dict[int, Any] = {number: mi.traverse(medium) for number, medium in media.items()}
        self._voxels = [(of, of["sigma_t.data"].shape) for of in parameters.values() if "sigma_t.data" in of]
        grids = {
            number: MajorantSupergrid.of(medium, parameters[number], transforms.get(number))
            for number, medium in media.items()
        }
        self._grids = {number: grid for number, grid in grids.items() if grid is not None}
        self.every = len(self._grids) == len(grids)
        size = max(grids, default=0) + 1
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
        """Return whether all extinctions still have the resolutions that these grids were built for."""
        return all(tuple(of["sigma_t.data"].shape) == tuple(shape) for of, shape in self._voxels)

    def shapes(self) -> list[tuple[int, ...]]:
        """Return the sizes that two states must have in common to share majorants."""
        return [(*grid.cells, *grid.voxels) for grid in self._grids.values()]

    def values(self) -> Any:
        """Return all majorants for the current extinctions, `mi.Float`: (z, y, x) of each grid, including a border layer."""
        parts = [grid.majorants() for grid in self._grids.values()]
        return parts[0] if len(parts) == 1 else dr.concat(parts)


class MajorantSupergrid:
    """Majorant supergrid of one medium: extinction voxels and cells along x, y and z, and the affine map (3, 4) from the world to cells."""

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
        """Return the supergrid of a medium, for its `mi.traverse` parameters. Return None for homogeneous media, small grids, and grids
        at an unknown position, which have one majorant."""
        if medium.class_name() != "HeterogeneousMedium" and not emissive.emits(medium):
            return None
        if "sigma_t.data" not in parameters or to_world is None:
            return None
        volume = parameters.properties["sigma_t.data"][2]
        if not isinstance(volume, mi.Volume) or volume.class_name() != "GridVolume":
            return None
        if max(parameters["sigma_t.data"].shape[:3]) < _FINE:
            return None
        world_to_grid = to_local(volume, to_world)
        scale = float(parameters["scale"]) if "scale" in parameters else 1.0
        return None if world_to_grid is None else MajorantSupergrid(parameters, world_to_grid, scale)

    def majorants(self) -> Any:
        """Return the majorants of the cells, surrounded by a layer of their maximum: `mi.Float` of (z + 2, y + 2, x + 2)."""
        data = dr.detach(self._parameters["sigma_t.data"].array)
        if self._known is None or self._known[0].index != data.index:
            # Hold the array together with its majorants, so that its index is not reused.
            self._known = data, self._pooled(data)
        return self._known[1]

    def _pooled(self, data: Any) -> Any:
        x, y, z = self.voxels
        pooled = data
        if self._channels > 1:
            voxel = dr.arange(mi.UInt32, x * y * z) * self._channels
            several = [dr.gather(mi.Float, data, voxel + channel) for channel in range(self._channels)]
            pooled = functools.reduce(dr.maximum, several)
            dr.eval(pooled)
        pooled = _pool(pooled, (z * y, x, 1), self._cell[0], self.cells[0])
        pooled = _pool(pooled, (z, y, self.cells[0]), self._cell[1], self.cells[1])
        pooled = _pool(pooled, (1, z, self.cells[1] * self.cells[0]), self._cell[2], self.cells[2])
        pooled *= self._scale
        greatest = dr.max(pooled)
        pooled = dr.minimum(pooled * _MARGIN, greatest)
        return _surrounded(pooled, self.cells, greatest)


def cell_size(voxels: int) -> int:
    """Return the number of voxels that a cell covers along an axis."""
    return max(_LEAST, -(-voxels // _CELLS))


def _pool(values: Any, shape: tuple[int, int, int], size: int, cells: int) -> Any:
    """Return maxima along the middle axis over `size` voxels and one more on each side, which linear interpolation reads.

    Beyond the ends of the grid, which the last cell may overlap, the voxels are repeated and mirrored, whichever is greater.
    """
    outer, count, inner = shape
    index = dr.arange(mi.UInt32, outer * cells * inner)
    row, column = index // (cells * inner), index % inner
    first = mi.Int32(index // inner % cells) * size
    greatest, gap = mi.Float(0), cells * size - count
    for offset in range(-1, size + 1):
        voxel = first + offset
        repeated = dr.select(voxel < 0, count - 1, dr.select(voxel < count, voxel, voxel - count))
        mirrored = dr.select(voxel < 0, 0, dr.select(voxel < count, voxel, 2 * count - 1 - voxel))
        for source in (repeated, mirrored) if offset in (-1, *range(size - gap, size + 1)) else (repeated,):
            index = mi.UInt32(dr.clip(source, 0, count - 1))
            greatest = dr.maximum(greatest, dr.gather(mi.Float, values, (row * count + index) * inner + column))
    dr.eval(greatest)
    return greatest


def _surrounded(values: Any, cells: tuple[int, ...], outside: Any) -> Any:
    """Return `values` of (z, y, x) with a border layer of `outside`."""
    x, y, z = cells
    index = dr.arange(mi.UInt32, (x + 2) * (y + 2) * (z + 2))
    i, j, k = index % (x + 2) - 1, index // (x + 2) % (y + 2) - 1, index // ((x + 2) * (y + 2)) - 1
    within = (i < x) & (j < y) & (k < z)  # -1 wraps around to the largest unsigned integer
    padded = dr.gather(mi.Float, values, (k * y + j) * x + i, within)
    padded = dr.select(within, padded, outside)
    dr.eval(padded)
    return padded


def to_local(volume: Any, to_world: np.ndarray) -> np.ndarray | None:
    """Return the affine map (3, 4) from the world to [0, 1]³ of a `gridvolume`; None if it is not accurate enough.

    A map that does not reproduce the volume's bounding box is refused. If the grid is axis-aligned, the box is exact and determines the
    map.

    Args:
        to_world: (4, 4), map from [0, 1]³ to the world according to its description.
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
    """Position of a traversal of a medium. It is state of Dr.Jit loops, hence mutable.

    Attributes:
        t: distance along the ray.
        σ̄: majorant there, of both states.
        cell: indices of the current cell, x, y and z.
        border: distances at which the ray leaves the cell along each axis.
    """

    t: Any
    σ̄: Any
    cell: Any
    border: Any


class HomogeneousMajorant:
    """One majorant for a segment from `near` to `far`: 0 without a medium.

    This is not a dataclass, since Dr.Jit would treat a dataclass as loop state.
    """

    def __init__(self, σ̄: Any, near: Any, far: Any):
        self.σ̄, self.near, self.far = σ̄, near, far

    def at_least(self, least: Any) -> HomogeneousMajorant:
        """Return a copy with majorants of at least this value."""
        return HomogeneousMajorant(dr.maximum(self.σ̄, least), self.near, self.far)

    def start(self) -> DdaState:
        """Return the state at `near`."""
        return DdaState(mi.Float(self.near), mi.Float(self.σ̄), mi.Int32(0), mi.Float(0))

    def advance(self, dda: DdaState, τ: Any, active: Any) -> DdaState:
        """Advance by an optical depth `τ` of the majorant, beyond `far` if the remaining optical depth is smaller."""
        dda.t = dda.t + dr.select(dda.σ̄ > 0, τ / dda.σ̄, dr.inf)
        return dda


class SupergridTraversal:
    """Traversal of the cells along a segment, with the interface of `HomogeneousMajorant`; σ̄ is the majorant of media without a grid."""

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
        self.step = mi.Vector3i(dr.select(self.d > 0, 1, -1))

    def at_least(self, least: Any) -> SupergridTraversal:
        """Return a copy with majorants of at least this value."""
        copied = copy(self)
        copied.least = least
        return copied

    def _majorant(self, cell: Any, active: Any) -> Any:
        x, y, z = (mi.UInt32(dr.clip(cell[axis], -1, self.cells[axis]) + 1) for axis in range(3))
        wide, high = mi.UInt32(self.cells.x + 2), mi.UInt32(self.cells.y + 2)
        majorant = dr.gather(mi.Float, self.values, self.offset + (z * high + y) * wide + x, active & self.known)
        if self.σ̄ is not None:
            majorant = dr.select(self.known, majorant, self.σ̄)
        return dr.maximum(majorant, self.least)

    def start(self) -> DdaState:
        """Return the state at `near`, in the cell slightly beyond, since rounding may give a cell that the segment does not cross."""
        t = mi.Float(self.near)
        beyond = t + 1e-4 * (self.far - t)
        cell = mi.Vector3i(dr.floor(self.o + beyond * self.d))
        edge = mi.Vector3f(cell) + dr.select(self.d > 0, 1, 0)
        border = dr.select(dr.isfinite(self.across), (edge - self.o) * self.rate, dr.inf)
        return DdaState(t, self._majorant(cell, self.near < self.far), cell, border)

    @dr.syntax
    def advance(self, dda: DdaState, τ: Any, active: Any) -> DdaState:
        """Advance by an optical depth `τ` of the majorants, cell by cell, to `far` if the remaining optical depth is smaller."""
        τ = mi.Float(τ)
        going = mi.Bool(active)
        while dr.hint(going, label="majorant cells"):
            end = dr.minimum(dr.min(dda.border), self.far)
            left = dda.σ̄ * dr.maximum(end - dda.t, 0)
            collides = τ < left
            dda.t = dr.select(collides, dda.t + τ / dda.σ̄, dr.maximum(end, dda.t))
            going &= ~collides & (end < self.far)
            τ -= left
            nearest = going & (dda.border == end)
            nearest.y &= ~nearest.x
            nearest.z &= ~nearest.x & ~nearest.y
            dda.cell = dr.select(nearest, dda.cell + self.step, dda.cell)
            dda.border = dr.select(nearest, dda.border + self.across, dda.border)
            dda.σ̄ = dr.select(going, self._majorant(dda.cell, going), dda.σ̄)
        return dda
