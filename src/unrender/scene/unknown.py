"""An unknown of a problem: a parameter with its defaults filled in and properties from the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.parameterisations import Bounds, Parameterisation, Transform
from unrender.preconditioners.base import Preconditioner
from unrender.rendering.parameter_errors import ErrorMeasure
from unrender.scene.bounds import open_scale, project
from unrender.scene.coarse_to_fine import CoarseToFine
from unrender.scene.mesh_regularizer import MeshRegularizer
from unrender.scene.parameter import Parameter
from unrender.scene.prior import Prior
from unrender.scene.remeshing import Remeshing
from unrender.scene.surfaces import Surface, surface_error

_VECTOR = (3,)


@dataclass(frozen=True, eq=False)
class Unknown:
    """An unknown of a problem.

    Attributes:
        parameter: The parameter as passed, with the settings of a method.
        initial: Initial value: float32, inside the bounds, of the scene's shape. Read-only, because it may be the scene's own memory.
        bounds: (low, high), the parameter's or the physical range from the renderer; None is unbounded.
        measure: Measure of errors against the true value.
        learning_rate: Learning rate of the parameter; None for the optimizer's.
        preconditioner: S, bound to the mesh if there is one; None for the identity.
        parameterisation: Parameterisation as passed; None for none.
        transform: φ of the parameterisation; None for the identity.
        coarse_to_fine: Resolutions over the steps; None for one resolution.
        faces: Vertex indices (F, 3), if the parameter is the vertex positions of a mesh; else None.
        regularizer: Regularizer, bound to the mesh; None for none.
        prior: Prior, bound to the unknown; None for none.
        remeshing: Steps and method of remeshing; None for never.
        truth: True value, of the shape of `initial`; None if unknown.
        surface: True surface of a mesh, if the true position of each vertex is unknown; else None.
        notices: One line for each change of the input.
        first: Value before the first step at the scene's resolution, chosen by a method; None for `initial`.
    """

    parameter: Parameter
    initial: np.ndarray
    bounds: Bounds
    measure: ErrorMeasure
    learning_rate: float | None = None
    preconditioner: Preconditioner | None = None
    parameterisation: Parameterisation | None = None
    transform: Transform | None = None
    coarse_to_fine: CoarseToFine | None = None
    faces: np.ndarray | None = None
    regularizer: MeshRegularizer | None = None
    prior: Prior | None = None
    remeshing: Remeshing | None = None
    truth: np.ndarray | None = None
    surface: Surface | None = None
    notices: tuple[str, ...] = ()
    first: np.ndarray | None = None

    @cached_property
    def _scale(self) -> float:
        return open_scale(self.initial) if None in self.bounds else 1.0

    @property
    def is_direction(self) -> bool:
        """Return whether the unknown is one direction (3,), of which no picture shows the length."""
        return self.measure.role == "direction" and self.initial.shape == _VECTOR

    def normalised(self, values: np.ndarray) -> np.ndarray | None:
        """Return factors, broadcastable to `values`, that no picture shows; None for other unknowns than directions and ratios.

        They give a direction (3,) the length 1, and ratios the length of their initial values, unless these would leave the bounds.
        """
        if self.is_direction:
            lengths, wanted = np.linalg.norm(values), np.float64(1.0)
        elif self.measure.role == "ratios" and values.shape == self.initial.shape:
            lengths, wanted = (np.linalg.norm(x, axis=-1, keepdims=True) for x in (values, self.initial))
        else:
            return None
        factors = np.where(lengths > 0.0, wanted / np.where(lengths > 0.0, lengths, 1.0), 1.0)
        if self.is_direction:
            return factors
        low, high = self.bounds
        scaled = values * factors
        left = (scaled < (-np.inf if low is None else low)) | (scaled > (np.inf if high is None else high))
        return np.where(left.any(axis=-1, keepdims=True), 1.0, factors)

    def project(self, values: Array) -> Array:
        """Return the nearest values inside the bounds, less the margin."""
        return project(values, *self.bounds, self._scale)

    def reached(self, values: Array) -> Array:
        """Return `values` projected onto the bounds. A direction (3,) whose length is outside [1e-3, 1e3] is normalised."""
        inside = self.project(values)
        # Normalisation at every step would look like a projection onto bounds to the optimizer.
        if not self.is_direction:
            return inside
        length = float(np.linalg.norm(arrays.numpy(inside)))
        return inside / arrays.scalar(length, inside) if 0.0 < length < 1e-3 or length > 1e3 else inside

    def placed(self, start: Sequence[float]) -> np.ndarray:
        """Return a value before the first step from a list of its elements. Raises `InputError` for values outside the bounds."""
        where, low, high = f"parameter {self.parameter.key}: start", *self.bounds
        if len(start) != self.initial.size:
            raise InputError(f"{where}: expected {self.initial.size} numbers, got {len(start)}")
        values = np.asarray(start, np.float32).reshape(self.initial.shape)
        below = low is not None and (values < np.float32(low)).any()
        if below or (high is not None and (values > np.float32(high)).any()):
            span = f"{values.min():g} to {values.max():g}"
            raise InputError(f"{where}: expected numbers of {' and '.join(checks.limits(low, high))}, got {span}")
        return np.asarray(self.project(values), np.float32)

    def multiplied(self, factor: float) -> np.ndarray:
        """Return the nearest value inside the bounds to a multiple of the initial one. Raises `InputError` if it is infinite."""
        with np.errstate(over="ignore"):
            values = np.asarray(self.project(np.float32(factor) * self.initial), np.float32)
        if not np.isfinite(values).all():
            raise InputError(
                f"parameter {self.parameter.key}: start_factor: {factor:g} times the initial value is infinite"
            )
        return values

    def shape(self, step: int | None = None) -> tuple[int, ...]:
        """Return its shape at a step; None for the scene's."""
        levels = None if step is None else self.coarse_to_fine
        return self.initial.shape if levels is None or step is None else levels.shape(self.initial.shape, step)

    def start(self, step: int) -> np.ndarray:
        """Return `first`, or `initial` if it is None, at the resolution of a step."""
        first = self.initial if self.first is None else self.first
        return first if self.coarse_to_fine is None else self.coarse_to_fine.coarsened(first, step)

    def full(self, values: np.ndarray) -> np.ndarray:
        """Return values at the scene's resolution; coarser ones are interpolated."""
        levels, shape = self.coarse_to_fine, self.initial.shape
        return levels.refined(values, shape) if levels is not None and values.shape in levels.shapes(shape) else values

    def error(self, values: np.ndarray) -> float | None:
        """Return the error of values at the scene's resolution; NaN if the shape differs from the true value's, None if no truth is known.

        The error of a mesh with a known true surface is the root mean square distance between the surfaces.
        """
        if self.surface is not None and self.faces is not None and values.size == self.initial.size:
            return surface_error(Surface(values.reshape(-1, 3), self.faces), self.surface)
        if self.truth is None:
            return None
        error = self.measure.error(values, self.truth)
        return math.nan if error is None else error
