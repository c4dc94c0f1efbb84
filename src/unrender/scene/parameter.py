"""An unknown parameter of the scene: as the user sets it, and with its defaults filled in and properties from the scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.errors import InputError, KeyedError
from unrender.core.text import in_words
from unrender.io import resampling
from unrender.io.toml_lines import FieldError
from unrender.parameterisations import Bounds, Parameterisation, Transform
from unrender.preconditioners.base import Preconditioner
from unrender.rendering.parameter_errors import ErrorMeasure
from unrender.rendering.renderer import Renderer
from unrender.rendering.tied import Tie, with_ties
from unrender.scene.bounds import ends_of, open_scale, project, sides_of_bounds
from unrender.scene.coarse_to_fine import CoarseToFine
from unrender.scene.meshes import MeshRegularizer, Remeshing
from unrender.scene.prior import Prior
from unrender.scene.surfaces import Surface, surface_error

_LARGEST = float(np.finfo(np.float32).max)


@dataclass(frozen=True, eq=False)
class Parameter:
    """A scene parameter to recover.

    Args:
        key: name in `mitsuba.traverse`, e.g. ``"back.bsdf.reflectance.data"``. With `keys`, any name; "" takes the first of the keys.
        initial: initial value: a number, a colour, an array, a file, or None for the scene's value. A number or a colour fills the
            parameter. A file is converted as Mitsuba converts it when it loads the scene: the sRGB curve, the repeated columns of an
            environment map, the transform of a mesh. Images and `.vol` grids of another resolution are resized. A `.npy` file, or an
            `.npz` archive of one array, must have the parameter's shape; a last axis of length 1 and the repeated columns of an
            environment map may be missing. Arrays are linear; those of 8 and 16 bits above 1, which are sRGB in a view, are refused.
        bounds: (low, high); either may be None. None takes the physical range if it is known (a reflectance: 0 to 1).
        learning_rate: learning rate of this parameter; None takes the optimizer's.
        preconditioner: e.g. `unrender.preconditioners.LargeSteps(10.0)`, or None.
        coarse_to_fine: `CoarseToFine`, or its steps, for a texture or grid with a coarse initial resolution; None for one resolution.
        parameterisation: "identity", "log", or one of `unrender.parameterisations`: the variable that preconditioner, optimizer and
            learning rate act on. Values, bounds and results remain those of the parameter. None for the identity.
        regularizer: for the vertex positions of a mesh, an additional term of the loss: `MeshRegularizer`, or a table of its options such
            as {"bilaplacian": 0.001}; None for none.
        prior: prior knowledge of the values: `Prior`, or a table of its options such as {"smoothness": 0.05}; None for none.
        remeshing: for the vertex positions of a mesh, steps at which it is remeshed: `Remeshing`, its steps, or a table of its options
            such as {"steps": [100], "method": "subdivide"}; None for never.
        self_intersection: for the vertex positions of a mesh, treatment of self-intersections. "warn" checks occasionally and at the end,
            and reports in one line. "prevent" checks every step and shortens steps that would cause one, which takes about 25 ms for 1000
            triangles. "ignore" never checks.
        keys: parameters of the scene that share this one value, or {key: factor} if each is a factor times it. Initial value, bounds,
            learning rate and preconditioner apply to the shared value.
    """

    key: str = ""
    initial: float | tuple[float, ...] | list[Any] | str | Path | np.ndarray | None = None
    bounds: tuple[float | None, float | None] | None = None
    learning_rate: float | None = None
    preconditioner: Preconditioner | None = None
    coarse_to_fine: CoarseToFine | Sequence[int] | None = None
    parameterisation: Parameterisation | str | Mapping[str, Any] | None = None
    regularizer: MeshRegularizer | Mapping[str, Any] | None = None
    prior: Prior | Mapping[str, Any] | None = None
    remeshing: Remeshing | Sequence[int] | Mapping[str, Any] | None = None
    self_intersection: Literal["warn", "prevent", "ignore"] = "warn"
    keys: Sequence[str] | Mapping[str, float] | None = None

    def __post_init__(self):
        keys = self.keys if isinstance(self.keys, (Sequence, Mapping)) and not isinstance(self.keys, str) else ()
        if keys and isinstance(self.key, str) and not self.key:
            object.__setattr__(self, "key", next(iter(keys)))


@dataclass(frozen=True)
class ParameterSettings:
    """Settings that a method chooses for a parameter whose own are None; None for no choice.

    Attributes:
        start_factor: factor of the initial values before the first step, above 0. The product is moved into the bounds.
        start: values before the first step, in place of the initial ones.

    Raises:
        InputError: a start that is no list of finite numbers, or another factor.
    """

    parameterisation: Parameterisation | str | None = None
    preconditioner: Preconditioner | None = None
    coarse_to_fine: CoarseToFine | None = None
    start_factor: float | None = None
    start: tuple[float, ...] | None = None

    def __post_init__(self):
        if self.start_factor is not None:
            _single("start_factor", checks.number("settings", "start_factor", self.start_factor, above=0.0))
        if self.start is None:
            return
        if not isinstance(self.start, (list, tuple)):
            raise InputError(f"settings: start must be a list of numbers, got {in_words(self.start)}")
        values = tuple(_single("start", checks.number("settings", "start", value)) for value in self.start)
        object.__setattr__(self, "start", values)


def _single(name: str, value: float) -> float:
    """Return a number. Raises `InputError` for one that is infinite in single precision."""
    if abs(value) > _LARGEST:
        raise InputError(f"settings: {name} must be at most {_LARGEST:.3g}, got {value:g}")
    return value


def ties_of(parameters: Sequence[Parameter]) -> tuple[Tie, ...]:
    """Return the ties among some parameters, in order. Raises `FieldError` for keys that cannot be tied."""
    ties, names = [], [parameter.key for parameter in parameters]
    for index, parameter in enumerate(parameters):
        keys, place = parameter.keys, ("parameters", index, "keys")
        if keys is None:
            continue
        listed = isinstance(keys, (Sequence, Mapping)) and not isinstance(keys, str)
        if not listed or not all(isinstance(key, str) for key in keys):
            raise FieldError(place, f"expected a list of keys, or a table of factors by key, got {in_words(keys)}")
        factors = dict(keys) if isinstance(keys, Mapping) else dict.fromkeys(keys, 1.0)
        if other := next((key for key in factors if key in names and key != parameter.key), None):
            raise FieldError(place, f"{other} is an unknown of its own; remove it here or there")
        if len(factors) < len(keys):
            raise FieldError(place, "a key is given twice")
        with FieldError.at(place):
            ties.append(Tie(parameter.key, factors))
    return tuple(ties)


def scene_keys(parameters: Sequence[Parameter]) -> list[str]:
    """Return the keys of some parameters and of the members of their ties. Raises `FieldError` as `ties_of`."""
    keys = [parameter.key for parameter in parameters if isinstance(parameter.key, str)]
    return [*keys, *(member for tie in ties_of(parameters) for member in tie.factors)]


def tied(renderer: Renderer, parameters: Sequence[Parameter], ties: Sequence[Tie]) -> Renderer:
    """Return the renderer with the ties of these parameters. Raises `FieldError` for members that cannot share a value."""
    try:
        return with_ties(renderer, ties)
    except KeyedError as error:
        index = [parameter.key for parameter in parameters].index(error.key)
        raise FieldError(("parameters", index, "keys"), str(error)) from error


_VECTOR = (3,)


@dataclass(frozen=True, eq=False)
class Unknown:
    """An unknown of a problem.

    Attributes:
        parameter: The parameter as passed, with the settings of a method.
        initial: Initial value: float32, inside the bounds, of the scene's shape. Read-only, because it may be the scene's own memory.
        bounds: (low, high), the parameter's or the physical range from the renderer; None is unbounded.
        measure: Measure of errors against the true value.
        preconditioner: S, bound to the mesh if there is one; None for the identity.
        parameterisation: Parameterisation as passed; None for none.
        transform: φ of the parameterisation; None for the identity.
        faces: Vertex indices (F, 3), if the parameter is the vertex positions of a mesh; else None.
        regularizer: Regularizer, bound to the mesh; None for none.
        prior: Prior, bound to the unknown; None for none.
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
        low, high = ends_of(self.bounds)
        scaled = values * factors
        left = (scaled < low) | (scaled > high)
        return np.where(left.any(axis=-1, keepdims=True), 1.0, factors)

    def project(self, values: Array) -> Array:
        """Return the nearest values inside the bounds, less the margin."""
        return project(values, *self.bounds, self._scale)

    def sides(self, values: Array) -> Array:
        """Return -1 for elements that `project` keeps at the lower bound, 1 for those at the upper one, and 0 for the others."""
        return sides_of_bounds(values, *self.bounds, self._scale)

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
        first, levels = self.initial if self.first is None else self.first, self.coarse_to_fine
        return first if levels is None else resampling.downsample(first, levels.shape(first.shape, step)[:-1])

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
