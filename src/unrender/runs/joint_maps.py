"""Detection of changes of textures, and of values at vertices, that the images hide: one by another, or details that blur together."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby

import numpy as np

from unrender.core import timing
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.text import listed
from unrender.runs.determination import Change, affordable, change_of_images, changed
from unrender.runs.image_sensitivity import (
    ADJOINT,
    MAP_AXES,
    Curvature,
    adjoint_spp,
    adjoints,
    derivative_session,
    mask_roots,
    neighbour_means,
)
from unrender.runs.numbers import TOO_SHORT
from unrender.scene.bounds import off_ends, project
from unrender.scene.problem import Problem
from unrender.scene.render import as_tree, render, selected_views
from unrender.scene.validation import texture_coordinates

_SLOT = re.compile(r"\.(?:(?:nested_)?b(?:sdf|rdf)(?:_\d+)?|emitter)\.")
"""Name of a material within a shape or another material, or of a shape's emitter."""
_HIDDEN = 0.35
"""Root mean square change of the images by changes together, relative to the same changes alone, below which they hide one another."""
_EXPECTED, _NAMED, _LARGE = 0.5, 0.2, 0.1
"""The same ratio by the derivatives, from which nothing is rendered; least part of a named texture, relative to the largest one, and least
change of its values. A smaller change is a small error, even if that of another texture is as large as its range."""
_STEP, _TURN = 0.2, 0.02
"""Size of the changes relative to those of `changed`, a fiftieth of the range; turn of normals, in units of a normal map."""
_CHECKER, _OF_CONSTANT = 0.5, 0.1
"""Size of the checkerboards of `blurred_cells`, relative to the root mean square of the values; most change of the images, relative to that
of a constant of the same size, that is told."""
_BLURRED, _SEEN = 4.0, 0.005
"""Overlap of `Curvature` from which neighbouring texels may not be told apart; least change of the images by the constant."""
_STREAM, _LAUNCHES, _RENDERINGS = 9, 4, 4
"""Stream of the random numbers, adjoints of each change, and samples of a rendering of the joint change relative to those of a part."""
_MOST_FACTOR, _OF_AGAIN = 16, 8.0
"""Largest factor of the number of samples, which becomes four times as large; time that must be left, relative to that of the last test of
a surface."""


def hidden_changes(
    problem: Problem, values: Mapping[str, np.ndarray], spp: int, seconds: float, per_pass: int | None = None
) -> list[str]:
    """Return a line for the textures of each surface whose changes hide one another, or that were not tested.

    Each channel of a texture changes by a field f, such as a fiftieth of its range; a normal map turns along two tangents. With the
    derivative J of the images, a cell has a matrix of the elements f · Jᵀ J f'. Its eigenvector of the least eigenvalue is the joint change
    that the images show least. A line needs that these changes, rendered with other random numbers, change the images far less than alone.

    Args:
        values: {key: array} at the end of a run.
        spp: samples per pixel of each rendering, of which noise may hide the changes. While time is left, there are more.
        seconds: time limit of the tests of all surfaces together.
        per_pass: see `render`.
    """
    until, surfaces, factor = timing.now() + seconds, [*_surfaces(problem)], 1
    lines, spent = [list[str]() for _ in surfaces], [0.0] * len(surfaces)
    pending = [*range(len(surfaces))]
    while pending and factor <= _MOST_FACTOR:
        tested, pending = pending, []
        for index in tested:
            started = timing.now()
            if factor > 1 and _OF_AGAIN * spent[index] > until - started:
                continue
            surface = _Surface(problem, values, surfaces[index], factor * spp, per_pass, factor)
            try:
                lines[index] = surface.line(until - started if factor == 1 else math.inf)
            except InputError:  # the renderer rejects a value
                continue
            spent[index] = timing.now() - started
            pending += [index] * (not lines[index])
        factor *= 4
    return [line for own in lines for line in own]


def blurred_cells(
    problem: Problem,
    values: Mapping[str, np.ndarray],
    known: Curvature,
    spp: int,
    seconds: float,
    per_pass: int | None,
    most: float = math.inf,
    path_seconds: float = 0.0,
) -> list[str]:
    """Return a line for each texture whose differences between neighbouring blocks of cells hardly change the images.

    Each cell may still change them, such as one of a lamp or a sky that only rough surfaces reflect. Checkerboards of blocks are compared
    with a constant of the same size; the blocks become twice as wide while they hardly show.

    Args:
        values, per_pass: see `change_of_images`.
        known: curvature at these values. Textures whose texels hardly overlap in it are not tested.
        spp: most samples per pixel of a rendering.
        seconds: time after which no block becomes wider. All textures share it, at `per_pass` samples or more.
        most: time after which no further texture is tested.
        path_seconds: time of a path; 0 if unknown.
    """
    lines, began, infos = [], timing.now(), problem.renderer.parameters()
    keys = [key for key, square in known.squares.items() if square.ndim == MAP_AXES and square.any()]
    keys = [key for key in keys if infos[key].role == "value" and not infos[key].curved and _may_blur(known, key)]
    if path_seconds and keys:
        spp, _ = affordable(problem, spp, seconds / (2 * len(keys)), per_pass or spp, path_seconds)
    for key in keys:
        if timing.now() > began + most:
            break
        constant, width = _added(problem, values, key, np.ones(1), spp, per_pass), 1
        y, x, channel = np.indices(shape := np.shape(values[key]))
        while (
            2 * width <= min(shape[:2]) and constant.is_above(_SEEN) and (width == 1 or timing.now() < began + seconds)
        ):
            signs = np.where((y // width + x // width + channel) % 2, -1.0, 1.0)
            if not _added(problem, values, key, signs, spp, per_pass).is_below(_OF_CONSTANT, constant.square):
                break
            width *= 2
        if width > 1:
            lines.append(
                f"{key}: a checkerboard of {width // 2} × {width // 2} texels changes the pictures by less than a tenth of what a constant "
                f"does; details of up to {width} texels may be smoothing or noise"
            )
    return lines


def _may_blur(known: Curvature, key: str) -> bool:
    """Return whether the texels of a texture overlap in the pictures, or noise hides it; no if that is unknown."""
    overlap = known.overlap.get(key, math.inf)  # infinite if unknown, NaN if noise hides it
    return not (overlap < _BLURRED or math.isinf(overlap))


def _added(
    problem: Problem, values: Mapping[str, np.ndarray], key: str, signs: np.ndarray, spp: int, per_pass: int | None
) -> Change:
    """Return the change of the images from values with `signs` times half their root mean square subtracted to those with it added."""
    own, bounds = np.asarray(values[key], np.float32), problem.unknowns[key].bounds
    step = (_CHECKER * np.sqrt(np.mean(np.square(own))) * signs).astype(np.float32)
    first, last = ({**values, key: project(own + of, *bounds)} for of in (-step, step))
    return change_of_images(problem, first, last, spp, per_pass)


def untested_changes(problem: Problem) -> list[str]:
    """Return the lines of `hidden_changes` for a run that was too short for it."""
    return [_untested(keys) for keys in _surfaces(problem)]


def _untested(keys: Sequence[str]) -> str:
    what = f"changes of {listed(keys)} hide" if len(keys) > 1 else f"turns of the normals of {keys[0]} hide"
    return f"whether {what} one another: {TOO_SHORT}"


def _surface_of(key: str) -> str:
    """Return the id of the shape or material of a texture's key. An id may have dots, as Blender's Cube.001."""
    return _SLOT.split(key, maxsplit=1)[0] if _SLOT.search(key) else key.rsplit(".", 2)[0]


def shares_surface(problem: Problem, key: str) -> bool:
    """Return whether another unknown texture or mesh attribute has the same surface as that of the key."""
    infos = problem.renderer.parameters()
    lists = (k for k, shape in problem.shapes().items() if math.prod(shape) > 3 and not infos[k].welded and k != key)
    return any(_surface_of(other) == _surface_of(key) for other in lists)


def _surfaces(problem: Problem) -> Iterator[list[str]]:
    """Yield the keys of the textures, and values at vertices, of each surface whose changes may hide one another; none for many views."""
    known = problem.renderer.parameters()
    if len(selected_views(problem)) < len(problem.views):
        return
    on_mesh = [key for key in problem.unknowns if known[key].mesh is not None and not known[key].welded]
    maps = [key for key in problem.unknowns if len(known[key].shape) == MAP_AXES or key in on_mesh]
    maps = [key for key in maps if known[key].differentiable]
    for _, of in groupby(sorted(maps, key=_surface_of), key=_surface_of):
        keys = sorted(of)
        free = any(problem.unknowns[key].prior is None for key in keys)  # otherwise priors decide
        if free and (len(keys) > 1 or known[keys[0]].role == "normal"):
            yield keys


@dataclass(frozen=True)
class _Surface:
    """Textures of one surface, whose texels share the cells of the coarsest one, or the vertices of a mesh with values at these; for the
    attributes, see `hidden_changes`. `factor` multiplies the number of adjoints."""

    problem: Problem
    values: Mapping[str, np.ndarray]
    keys: Sequence[str]
    spp: int
    per_pass: int | None
    factor: int = 1

    def line(self, seconds: float) -> list[str]:
        """Return the line; [] for none."""
        problem, values, started = self.problem, self.values, timing.now()
        fields = [(key, field) for key in self.keys for field in self._fields(key)]
        matrix = self._matrix(fields, seconds)
        if matrix is None:
            return [_untested(self.keys)]
        smooth = self._cells.neighbour_means(matrix)
        if not np.isfinite(smooth).all():
            return []
        amounts = _aligned(np.linalg.eigh(smooth)[1][..., 0])
        amounts /= np.abs(amounts).max(axis=-1, keepdims=True)
        diagonal = np.maximum(np.diagonal(matrix, axis1=-2, axis2=-1).sum(axis=0), 0.0)
        # Eigenvectors have no sign: one direction remains where values are at their bounds.
        after, parts = max(
            (self._within(fields, sign * amounts, diagonal) for sign in (1.0, -1.0)), key=lambda of: sum(of[1].values())
        )
        total = sum(parts.values())
        joint = float(np.einsum("ci,cij,cj->", amounts, matrix, amounts))
        named = [key for key, part in parts.items() if part > _NAMED**2 * max(parts.values())]
        sizes = self._sizes(fields, amounts, matrix)
        weak = [key for key in named if sizes[key] > _LARGE * max(sizes[k] for k in named)]
        if not total > 0.0 or joint > _EXPECTED**2 * total or not (len(named) > 1 or self._is_normal(named[0])):
            return []
        moved = {**values, **after}
        alone = total / (3.0 * sum(float(np.sum(problem.test_weights(view))) for view in range(len(problem.views))))
        rendered = timing.now()
        change = change_of_images(problem, values, moved, _RENDERINGS * self.spp, self.per_pass)
        now = timing.now()
        may_be = change.square < _HIDDEN**2 * alone < change.square + 2.0 * change.error
        if may_be and now - started + _RENDERINGS * (now - rendered) < seconds:
            change = change_of_images(problem, values, moved, _RENDERINGS**2 * self.spp, self.per_pass)
        if not change.is_below(_HIDDEN, alone):
            return []
        ratio = f"{max(math.sqrt(max(change.square, 0.0) / alone), 0.01):.0%}"
        advice = "use more lights or views"
        if len(named) == 1:
            return [
                f"{named[0]}: some turns of its normals change the pictures by {ratio} of what others do; its values may be another "
                f"solution: {advice}"
            ]
        hidden, whose = f"{listed(weak)}: changes of one hide those of another", "their"
        if len(weak) == 1:
            hidden, whose = f"{weak[0]}: small changes of the surface's other textures hide its changes", "its"
        return [
            f"{hidden}; together they change the pictures by {ratio} of what they do alone; {whose} values may be another solution: "
            f"{advice}, or fix one of them"
        ]

    def _within(
        self, fields: Sequence[tuple[str, np.ndarray]], amounts: np.ndarray, diagonal: np.ndarray
    ) -> tuple[dict[str, np.ndarray], dict[str, float]]:
        """Return the values of each texture that changes within its bounds, and the sum of squares of the images' change by it alone."""
        after, parts = {}, {}
        for key in self.keys:
            own = [n for n, (name, _) in enumerate(fields) if name == key]
            before, squares = np.asarray(self.values[key], np.float64), np.square(amounts[:, own])
            # Turns of normals have no channels of their own, so both have the mean size.
            axes = (0, 1) if self._is_normal(key) else 0
            step = sum(amounts[self._cells.of[key], n, None] * fields[n][1] for n in own)
            moved = self.problem.unknowns[key].project(before + np.reshape(step, before.shape))
            after[key] = np.asarray(moved, np.float32)
            left, whole = (np.square(x).sum(axis=axes) for x in (self._rows(key, after[key] - before), step))
            parts[key] = float(np.sum(squares.mean(axis=axes) * diagonal[own] * left / np.maximum(whole, 1e-300)))
        return after, parts

    def _sizes(
        self, fields: Sequence[tuple[str, np.ndarray]], amounts: np.ndarray, matrix: np.ndarray
    ) -> dict[str, float]:
        """Return the root mean square of each texture's amounts, which are relative to its range, over the cells that the images show."""
        seen = np.maximum(np.trace(matrix, axis1=-2, axis2=-1), 0.0)
        squares = np.einsum("c,cf->f", seen / max(float(seen.sum()), 1e-300), np.square(amounts))
        return {
            k: math.sqrt(np.mean([x for x, (key, _) in zip(squares, fields, strict=True) if key == k]))
            for k in self.keys
        }

    def _is_normal(self, key: str) -> bool:
        return self.problem.renderer.parameters()[key].role == "normal"

    @cached_property
    def _cells(self) -> _Cells:
        return _Cells.shared(self.problem, self.keys)

    def _rows(self, key: str, values: np.ndarray) -> np.ndarray:
        """Return values with an axis of texels or vertices and one of channels, (N, C)."""
        return np.reshape(values, (len(self._cells.of[key]), -1))

    def _fields(self, key: str) -> Iterator[np.ndarray]:
        """Yield the change (N, C) of each channel of a texture, or turns of its normals along two tangents."""
        own = np.asarray(self.values[key], np.float32)
        values = self._rows(key, own)
        if not self._is_normal(key):
            step = _STEP * (self._rows(key, changed(self.problem, key, own, np.ones(own.shape))) - values)
            yield from (step * (np.arange(step.shape[-1]) == channel) for channel in range(step.shape[-1]))
            return
        normals = 2.0 * values - 1.0
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
        first = np.cross(normals, np.where(np.abs(normals[..., :1]) < 0.7, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
        first /= np.maximum(np.linalg.norm(first, axis=-1, keepdims=True), 1e-6)
        yield from (_TURN * first, _TURN * np.cross(normals, first))

    def _matrix(self, fields: Sequence[tuple[str, np.ndarray]], seconds: float) -> np.ndarray | None:
        """Return the matrix of each cell, (cells, F, F); None if there is not enough time."""
        problem, values, key = self.problem, self.values, Key(0, _STREAM)
        views, started = range(len(problem.views)), timing.now()

        def pictures(of: Mapping[str, np.ndarray]) -> list[np.ndarray]:
            return [render(problem, of, view, self.spp, key.uint32(), self.per_pass) for view in views]

        before = pictures(values)
        if ((1 + ADJOINT * _LAUNCHES) * len(fields) + 4 * _RENDERINGS) * (timing.now() - started) > seconds:
            return None
        steps = [np.asarray(x.reshape(np.shape(values[name])), np.float32) for name, x in fields]
        moved = [pictures({**values, name: values[name] + x}) for (name, _), x in zip(fields, steps, strict=True)]
        changes = [
            np.nan_to_num(
                np.stack([of[view] - before[view] for of in moved]) * np.float32(mask_roots(problem, view) ** 2)
            )
            for view in views
        ]
        session, keys = derivative_session(problem)
        if session is None:
            raise InputError("the textures have no derivatives together with other unknowns")
        tree, spp = off_ends(as_tree(problem, values), problem.renderer.parameters()), adjoint_spp(problem)
        count = math.prod(self._cells.shape)
        matrix = np.zeros((len(fields), count, len(fields)))
        launches = self.factor * _LAUNCHES
        for launch in range(1, 1 + launches):
            seeds = {view: key.fold(launch).fold(view) for view in views}
            of = adjoints(problem, session, tree, keys, spp, seeds, changes)
            for n, (name, x) in enumerate(fields):
                for row, gradient in zip(matrix, of[name], strict=True):
                    weights = (self._rows(name, gradient) * x).sum(axis=-1) / launches
                    row[:, n] += np.bincount(self._cells.of[name], weights, count)
        matrix = np.moveaxis(matrix, 0, -2)
        return 0.5 * (matrix + matrix.swapaxes(-1, -2))


@dataclass(frozen=True)
class _Cells:
    """Cells of a surface: texels (h, w) of the coarsest texture, or the vertices of a mesh.

    Attributes:
        of: {key: index of the cell of each texel or vertex, (N,)}.
        shape: (h, w), or (vertices,).
        faces: vertices of each face of a mesh, (F, 3).
    """

    of: Mapping[str, np.ndarray]
    shape: tuple[int, ...]
    faces: np.ndarray | None = None

    @classmethod
    def shared(cls, problem: Problem, keys: Sequence[str]) -> _Cells:
        """Return those of some keys of a surface. Texels of a mesh belong to the vertex with the nearest texture coordinates."""
        known, shapes = problem.renderer.parameters(), problem.shapes()
        on_mesh, mesh = next(((key, of) for key in keys if (of := known[key].mesh) is not None), ("", None))
        textures = {key: shapes[key][:2] for key in keys if len(shapes[key]) == MAP_AXES}
        if mesh is None:
            height, width = (min(of) for of in zip(*textures.values(), strict=True))
            grids = {key: np.indices(size).reshape(2, -1) * [[height], [width]] for key, size in textures.items()}
            of = {k: x[0] // textures[k][0] * width + x[1] // textures[k][1] for k, x in grids.items()}
            return cls(of, (height, width))
        vertices, faces = mesh()
        of = {key: np.arange(len(vertices)) for key in keys if key not in textures}
        if textures:
            uv = texture_coordinates(problem.renderer, on_mesh, 3 * len(vertices))
            if uv is None:
                raise InputError("a mesh without texture coordinates")
            from scipy.spatial import KDTree  # takes long to import

            nearest = KDTree(uv % 1.0)
            for key, (height, width) in textures.items():
                y, x = np.indices((height, width)).reshape(2, -1)
                of[key] = np.asarray(nearest.query(np.stack([(x + 0.5) / width, (y + 0.5) / height], axis=1))[1])
        return cls(of, (len(vertices),), faces)

    def neighbour_means(self, values: np.ndarray) -> np.ndarray:
        """Return the means of values (cells, ...) over the neighbours of each cell, that cell included."""
        if self.faces is None:
            return neighbour_means(values.reshape(*self.shape, -1), channels=True).reshape(values.shape)
        from scipy.sparse import coo_matrix, eye  # takes long to import

        one, other = (np.ravel(self.faces[:, order]) for order in ([0, 1, 2, 1, 2, 0], [1, 2, 0, 0, 1, 2]))
        count = len(values)
        near = eye(count) + coo_matrix((np.ones(len(one)), (one, other)), (count, count))
        return (near @ values.reshape(count, -1) / np.ravel(near.sum(axis=1))[:, None]).reshape(values.shape)


def _aligned(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (cells, F) with signs that bring them closest to one direction: those of eigenvectors are arbitrary."""
    main = np.linalg.eigh(vectors.T @ vectors)[1][:, -1]
    return vectors * np.where(vectors @ main < 0.0, -1.0, 1.0)[:, None]
