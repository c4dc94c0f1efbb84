"""One unknown of a problem: a parameter with its defaults filled in, and what the scene says of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from unrender.parameterisations.base import Bounds, Parameterisation, Transform
from unrender.preconditioners.base import Preconditioner
from unrender.rendering.parameter_errors import ErrorMeasure
from unrender.scene.coarse_to_fine import CoarseToFine
from unrender.scene.mesh_regularizer import MeshRegularizer
from unrender.scene.parameter import Parameter
from unrender.scene.prior import Prior
from unrender.scene.remeshing import Remeshing
from unrender.scene.surfaces import Surface, surface_error


@dataclass(frozen=True, eq=False)
class Unknown:
    """One unknown of a problem.

    Attributes:
        given: The parameter as its author gave it, with what a method has added.
        initial: Where it starts: float32, inside the bounds, of the scene's shape. Read-only: may be the scene's own memory.
        bounds: (low, high), the parameter's own or the physical range that the renderer knows; None is open.
        measure: How errors against the truth are measured.
        learning_rate: Its own; None for the optimizer's.
        preconditioner: S, bound to its mesh where it has one; None for the identity.
        parameterisation: As given; None for none.
        transform: φ of that; None for the identity.
        coarse_to_fine: Resolutions over the steps; None for one resolution.
        faces: (F, 3) numbers of vertices, where it is the vertex positions of a mesh; else None.
        regularizer: Bound to the mesh; None for none.
        prior: Bound to the unknown; None for none.
        remeshing: When the mesh gets other triangles; None for never.
        truth: True value, of the shape of `initial`; None where it is not known.
        surface: True surface of a mesh, where it is not known which point of it a vertex belongs to; else None.
        notices: One line for each change made to the input.
    """

    given: Parameter
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

    def shape(self, step: int | None = None) -> tuple[int, ...]:
        """Return its shape at a step; None for the scene's own."""
        way = None if step is None else self.coarse_to_fine
        return self.initial.shape if way is None or step is None else way.shape(self.initial.shape, step)

    def start(self, step: int) -> np.ndarray:
        """Return the initial value at the resolution of a step."""
        return self.initial if self.coarse_to_fine is None else self.coarse_to_fine.coarsened(self.initial, step)

    def full(self, values: np.ndarray) -> np.ndarray:
        """Return values at the scene's resolution, interpolated where they are still coarse."""
        way, shape = self.coarse_to_fine, self.initial.shape
        return way.refined(values, shape) if way is not None and values.shape in way.shapes(shape) else values

    def error(self, values: np.ndarray) -> float | None:
        """Return the error of values at the scene's resolution; NaN for another shape than the truth's, None where no truth is known.

        The error of a mesh whose true surface is known is the root mean square distance between the surfaces.
        """
        if self.surface is not None and self.faces is not None and values.size == self.initial.size:
            return surface_error(Surface(values.reshape(-1, 3), self.faces), self.surface)
        if self.truth is None:
            return None
        error = self.measure.error(values, self.truth)
        return math.nan if error is None else error
