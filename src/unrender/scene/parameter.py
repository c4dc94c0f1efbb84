"""An unknown parameter of the scene and its settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from unrender.core import checks
from unrender.core.errors import InputError, KeyedError
from unrender.io.toml_lines import FieldError
from unrender.parameterisations import Parameterisation
from unrender.preconditioners.base import Preconditioner
from unrender.rendering.renderer import Renderer
from unrender.rendering.tied import Tie, with_ties
from unrender.scene.coarse_to_fine import CoarseToFine
from unrender.scene.mesh_regularizer import MeshRegularizer
from unrender.scene.prior import Prior
from unrender.scene.remeshing import Remeshing

_LARGEST = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class Parameter:
    """A scene parameter to recover.

    Args:
        key: name in `mitsuba.traverse`, e.g. ``"back.bsdf.reflectance.data"``. With `keys`, any name; "" takes the first of the keys.
        initial: initial value: a number, a colour, an array, a file, or None for the scene's value. A number or a colour fills the
            parameter. A file is converted as Mitsuba converts it when it loads the scene: the sRGB curve, the repeated columns of an
            environment map, the transform of a mesh. Images and `.vol` grids of another resolution are resized. A `.npy` file, or an
            `.npz` archive of one array, must have the parameter's shape; a last axis of length 1 and the repeated columns of an
            environment map may be missing.
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
        if not self.key and self.keys and not isinstance(self.keys, str):
            object.__setattr__(self, "key", next(iter(self.keys)))


@dataclass(frozen=True)
class ParameterSettings:
    """Settings that a method chooses for a parameter whose own are None.

    Attributes:
        parameterisation: parameterisation or its name; None for no choice.
        preconditioner: linear map of gradients and steps; None for no choice.
        coarse_to_fine: resolutions over the steps; None for no choice.
        start_factor: factor of the initial values before the first step, above 0; None for no choice. The product is moved into the bounds.
        start: values before the first step, in place of the initial ones; None for no choice.

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
            raise InputError(f"settings: start must be a list of numbers, got {self.start!r:.60}")
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
        if isinstance(keys, str) or not isinstance(keys, (Sequence, Mapping)):
            raise FieldError(place, f"expected a list of keys, or a table of factors by key, got {keys!r}")
        factors = dict(keys) if isinstance(keys, Mapping) else dict.fromkeys(keys, 1.0)
        if other := next((key for key in factors if key in names and key != parameter.key), None):
            raise FieldError(place, f"{other} is an unknown of its own; remove it here or there")
        if len(factors) < len(keys):
            raise FieldError(place, "a key is given twice")
        try:
            ties.append(Tie(parameter.key, factors))
        except InputError as error:
            raise FieldError(place, str(error)) from error
    return tuple(ties)


def scene_keys(parameters: Sequence[Parameter]) -> list[str]:
    """Return the keys of some parameters and of the members of their ties. Raises `FieldError` as `ties_of`."""
    keys = [parameter.key for parameter in parameters if isinstance(parameter.key, str)]
    return [*keys, *(member for tie in ties_of(parameters) for member in tie.factors)]


def members_of(parameters: Sequence[Parameter]) -> dict[str, list[str]]:
    """Return the keys of the scene that each unknown sets: those of its tie, else its own. Raises `FieldError` as `ties_of`."""
    own = {parameter.key: [parameter.key] for parameter in parameters if isinstance(parameter.key, str)}
    return own | {tie.key: list(tie.factors) for tie in ties_of(parameters)}


def tied(renderer: Renderer, parameters: Sequence[Parameter], ties: Sequence[Tie]) -> Renderer:
    """Return the renderer with the ties of these parameters. Raises `FieldError` for members that cannot share a value."""
    try:
        return with_ties(renderer, ties)
    except KeyedError as error:
        index = [parameter.key for parameter in parameters].index(error.key)
        raise FieldError(("parameters", index, "keys"), str(error)) from error
