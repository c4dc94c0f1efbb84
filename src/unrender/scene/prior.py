"""Priors of unknowns: knowledge of their values that does not come from the references."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core import arrays, checks, periodic, tables
from unrender.core.errors import InputError
from unrender.core.text import in_words
from unrender.io import resampling
from unrender.preconditioners import grid
from unrender.preconditioners.mesh import MeshTopology

_CORNER = 0.1
"""Size of a difference, in units of `total_variation`, below which its norm is rounded to have a derivative at 0."""

_FAR = 3.0
"""Standard deviations by which expected values may be outside of an unknown's bounds."""

_ARRAYS = (("near", 1, "a number or one number per channel"), ("palette", 2, "a list of colours"))
"""(field, largest number of axes of an array, what it is)."""


@dataclass(frozen=True)
class Prior:
    """A prior density p(x) of one unknown x. The descent minimises the loss − s log p(x), with

        −log p(x) / weight = Σ_e (x_e − near_e)² / (2 std²)
                           + Σ_c min_k |x_c − palette_k|² / (2 std²)
                           + Σ_(c ~ d) |x_c − x_d|² / (2 smoothness²)
                           + Σ_(c ~ d) |x_c − x_d| / total_variation

    over elements e, over texels, voxels or vertices c (or the one colour or number), and over pairs (c ~ d) of neighbours. Terms that
    are not set are absent. s is the loss that the noise of the references alone causes, per pixel value and likelihood unit
    (`references.likelihood_scale`): with an L2 or L1 loss and weight 1 the minimum is the maximum a posteriori estimate. Norms below
    a tenth of `total_variation` are rounded to be differentiable. A prior biases the result towards itself, by design.

    Args:
        near: Expected value: a number, one number per channel, or "initial" for the unknown's initial value.
        std: Standard deviation around `near` or around the nearest colour of `palette`, > 0, in units of the unknown.
        palette: k >= 1 colours, each with one number per channel.
        smoothness: Standard deviation of the difference of neighbours, > 0, in units of the unknown.
        total_variation: Scale of the Laplace distribution of the difference of neighbours, > 0, in units of the unknown.
        weight: Factor of all terms, > 0.

    Raises:
        InputError: No term, a term without its `std`, an array with too many axes, or a number out of range.
    """

    near: float | Sequence[float] | str | None = None
    std: float | None = None
    palette: Sequence[Sequence[float]] | None = None
    smoothness: float | None = None
    total_variation: float | None = None
    weight: float = 1.0
    _unknown: _Unknown | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self):
        for name, axes, kind in _ARRAYS:  # before an array of an image's size becomes tuples, which takes 0.4 s
            value = getattr(self, name)
            if isinstance(value, np.ndarray) and value.ndim > axes:
                raise InputError(f"prior: {name}: expected {kind}, got an array of shape {value.shape}")
        for name in ("near", "std", "palette", "smoothness", "total_variation", "weight"):
            object.__setattr__(self, name, _frozen(getattr(self, name)))
        for name in ("std", "smoothness", "total_variation", "weight"):
            if getattr(self, name) is not None:
                checks.number("prior", name, getattr(self, name), above=0.0)
        pulled = self.near is not None or self.palette is not None
        if pulled != (self.std is not None):
            raise InputError("prior: near or palette needs std, and std needs one of these")
        if not pulled and self.smoothness is None and self.total_variation is None:
            raise InputError("prior: expected near, palette, smoothness or total_variation")
        if isinstance(self.near, (str, bool)) and self.near != "initial":
            raise InputError(
                f'prior: near must be a number, one number per channel, or "initial", got {in_words(self.near)}'
            )

    def on(
        self,
        initial: np.ndarray,
        repeated: int = 0,
        topology: MeshTopology | None = None,
        moving: bool = False,
        bounds: tuple[float | None, float | None] = (None, None),
    ) -> Prior:
        """Return the prior bound to an unknown.

        Args:
            initial: Initial value, at the scene's resolution.
            repeated: Number of columns at each end that repeat those of the other, for an environment map.
            topology: Mesh at whose vertices the unknown has values; None for textures, volumes, colours and numbers.
            moving: Whether the values are the positions of that mesh.
            bounds: Limits of the values; None is open.

        Raises:
            InputError: A term that does not suit the unknown's shape, or expected values far outside of the bounds.
        """
        shape = periodic.interior_shape(initial.shape, repeated)
        channels = initial.size // len(topology.places) if topology is not None else _channels(shape)
        inner = periodic.interior(initial, repeated)
        near = None if self.near is None else _values(self.near, inner, channels)
        palette = None if self.palette is None else _palette(self.palette, channels)
        low, high = (
            end if end is None else end + sign * _FAR * (self.std or 0.0)
            for end, sign in zip(bounds, (-1, 1), strict=True)
        )
        for name, given, values in (("near", self.near, near), ("palette", self.palette, palette)):
            if values is not None and not arrays.all_within(values, low, high):
                within = " and ".join(checks.limits(*bounds))
                raise InputError(f"prior: {name}: expected {within} as the unknown's bounds, got {in_words(given)}")
        if self.smoothness is not None or self.total_variation is not None:
            if moving:
                raise InputError("prior: neighbouring positions differ; a mesh has regularizer = { bilaplacian = ... }")
            if topology is None and not grid.is_map(shape):
                raise InputError("prior: smoothness and total_variation need a texture, a volume or vertices of a mesh")
        bound = Prior(self.near, self.std, self.palette, self.smoothness, self.total_variation, self.weight)
        object.__setattr__(bound, "_unknown", _Unknown(channels, near, palette, repeated, topology))
        return bound

    def evaluate(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Return −log p(x) up to a constant, `weight` included, and its gradient, of the shape of `x`, in double precision."""
        unknown = self._of()
        cells = unknown.cells(x)
        value, gradient = 0.0, np.zeros_like(cells)
        for away in unknown.distances(cells):
            value += float(np.sum(away * away)) / (2 * self._variance)
            gradient += away / self._variance
        sizes, pull = self._pairs(cells, cells)
        return self.weight * (value + sizes), self.weight * unknown.spread(gradient + pull, x)

    def product(self, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return M v, of the shape of `x`: M is positive semidefinite and equals the Hessian of −log p(x) for all quadratic terms.

        The total variation's part of M is that of the quadratic function that touches it at `x` from above.
        """
        unknown = self._of()
        cells, along = unknown.cells(x), unknown.cells(v)
        product = np.zeros_like(cells)
        for _ in unknown.distances(cells):
            product += along / self._variance
        _, pull = self._pairs(cells, along)
        return self.weight * unknown.spread(product + pull, x)

    def diagonal(self, x: np.ndarray) -> np.ndarray:
        """Return the diagonal elements of M of a texture or grid, of the shape of `x`. M of `product` couples neighbouring cells only."""
        repeated = self._of().repeated
        colour = np.indices(periodic.interior_shape(x.shape, repeated)[:-1]).sum(axis=0)[..., None] % 2
        if repeated:  # the last column is a neighbour of the first, which may have the same parity
            colour[:, -1] += 2
        masks = [np.broadcast_to(periodic.pad(colour, repeated) == of, x.shape) for of in np.unique(colour)]
        return sum((mask * self.product(x, mask.astype(np.float64)) for mask in masks), np.zeros(x.shape))

    def describe(self) -> str:
        """Return the terms in one line."""
        return ", ".join(
            f"{name} {value}" for name, value in tables.fields(self).items() if name != "weight" or value != 1.0
        )

    @property
    def _variance(self) -> float:
        return (self.std or 1.0) ** 2

    def _of(self) -> _Unknown:
        if self._unknown is None:
            raise InputError("prior: it is bound to no unknown yet (on)")
        return self._unknown

    def _pairs(self, cells: np.ndarray, along: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the terms of pairs of neighbours at `cells`, and M `along`, with M at `cells`. Their gradient is M `cells`."""
        unknown, value, pulls = self._of(), 0.0, np.zeros_like(cells)
        for i, j in unknown.neighbours(cells):
            norm = np.linalg.norm(cells[i] - cells[j], axis=-1, keepdims=True)
            stiffness = np.zeros_like(norm)
            if self.smoothness is not None:
                value += 0.5 * float(np.sum((norm / self.smoothness) ** 2))
                stiffness += 1 / self.smoothness**2
            if self.total_variation is not None:
                rounded = np.hypot(norm / self.total_variation, _CORNER)
                value += float(np.sum(rounded - _CORNER))
                stiffness += 1 / (rounded * self.total_variation**2)
            pull = stiffness * (along[i] - along[j])
            unknown.add(pulls, i, pull)
            unknown.add(pulls, j, -pull)
        return value, pulls


@dataclass(frozen=True, eq=False)
class _Unknown:
    """Properties of an unknown that its prior uses: values per texel, voxel or vertex, expected values, which broadcast with the cells,
    palette (k, channels), repeated columns at each end, and mesh of the vertices."""

    channels: int
    near: np.ndarray | None
    palette: np.ndarray | None
    repeated: int
    topology: MeshTopology | None

    def cells(self, x: np.ndarray) -> np.ndarray:
        """Return the cells (..., channels) without repeated columns, in double precision."""
        if self.topology is not None:
            return x.astype(np.float64).reshape(-1, self.channels)
        inner = periodic.interior(x.astype(np.float64), self.repeated)
        return inner if inner.ndim and inner.shape[-1] == self.channels else inner.reshape(*inner.shape, 1)

    def spread(self, values: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return values of the cells in the shape of `x`; repeated columns, which are no unknowns, are copies."""
        if not self.repeated:
            return values.reshape(x.shape)
        return periodic.pad(values.reshape(periodic.interior_shape(x.shape, self.repeated)), self.repeated)

    def distances(self, cells: np.ndarray) -> list[np.ndarray]:
        """Return the differences of the cells from the expected values and from the nearest colours, if there are these terms."""
        terms = [] if self.near is None else [cells - self._expected(cells.shape)]
        if self.palette is None:
            return terms
        nearest, least = np.broadcast_to(self.palette[0], cells.shape), np.full((*cells.shape[:-1], 1), np.inf)
        for colour in self.palette:
            distance = np.sum((cells - colour) ** 2, axis=-1, keepdims=True)
            nearest, least = np.where(distance < least, colour, nearest), np.minimum(least, distance)
        return [*terms, cells - nearest]

    def _expected(self, shape: tuple[int, ...]) -> np.ndarray:
        """Return the expected values, averaged over the cells of a coarser grid."""
        near = np.asarray(self.near)
        if near.size == self.channels or near.size == math.prod(shape):
            return near if near.size == self.channels else near.reshape(shape)
        return resampling.downsample(near, shape[:-1])

    def neighbours(self, cells: np.ndarray) -> list[tuple[Any, Any]]:
        """Return index pairs (i, j) into the cells, each pair of neighbours once."""
        if self.topology is not None:
            _, first = np.unique(self.topology.places, return_index=True)
            i, j = first[self.topology.neighbours].T
            return [(i, j)]
        pairs: list[tuple[Any, Any]] = []
        for axis in range(cells.ndim - 1):
            before = (slice(None),) * axis
            pairs.append(((*before, slice(1, None)), (*before, slice(None, -1))))
            if self.repeated and axis == 1:  # an environment map continues from its last column to its first
                pairs.append(((*before, slice(0, 1)), (*before, slice(-1, None))))
        return pairs

    def add(self, total: np.ndarray, index: Any, values: np.ndarray) -> None:
        """Add values to the cells of an index of `neighbours`, which may repeat on meshes."""
        if self.topology is None:
            total[index] += values
        else:
            np.add.at(total, index, values)


def _channels(shape: tuple[int, ...]) -> int:
    """Return the number of channels: the last axis of textures (H, W, C) and volumes (Z, Y, X, C), all elements of a colour."""
    return shape[-1] if shape else 1


def _values(near: Any, initial: np.ndarray, channels: int) -> np.ndarray:
    if isinstance(near, str):
        return initial.astype(np.float64)
    values = _numbers("near", near)
    if values.ndim > 1 or values.size not in (1, channels):
        expected = "a number" if channels == 1 else f"a number or {channels} numbers"
        raise InputError(f"prior: near must be {expected}, got an array of shape {values.shape}")
    return np.broadcast_to(values, (channels,)).copy()


def _palette(palette: Any, channels: int) -> np.ndarray:
    colours = _numbers("palette", palette)
    if colours.ndim != 2 or not len(colours) or colours.shape[1] != channels:
        each = "1 number" if channels == 1 else f"{channels} numbers"
        raise InputError(f"prior: palette must be a list of colours of {each} each")
    return colours


def _frozen(value: Any) -> Any:
    """Return arrays and lists as tuples of numbers: what a file contains is read back equal."""
    plain = value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
    return tuple(map(_frozen, plain)) if isinstance(plain, (list, tuple)) else plain


def _numbers(name: str, value: Any) -> np.ndarray:
    try:
        values = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        values = np.full(1, np.nan)
    if not np.isfinite(values).all():
        raise InputError(f"prior: {name} must have finite numbers, and rows of one length")
    return values
