"""One unknown of the scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from unrender.core.errors import InputError
from unrender.parameterisations.base import Parameterisation
from unrender.preconditioners.base import Preconditioner
from unrender.rendering.renderer import Renderer
from unrender.rendering.tied import Tie, TieError, with_ties
from unrender.scene.coarse_to_fine import CoarseToFine
from unrender.scene.errors import FieldError
from unrender.scene.mesh_regularizer import MeshRegularizer
from unrender.scene.prior import Prior
from unrender.scene.remeshing import Remeshing

__all__ = ["Parameter", "ParameterSettings", "tied", "ties_of"]


@dataclass(frozen=True)
class Parameter:
    """A scene parameter to recover.

    Args:
        key: as `mitsuba.traverse` names it, e.g. ``"back.bsdf.reflectance.data"``. With `keys`, a name of your own, or nothing for the
            first of them.
        initial: where the descent starts: a number, a colour, an array, a file, or None for the scene's own value. A number or a
            colour fills the parameter. A file is converted as Mitsuba converts it when it loads the scene: the sRGB curve, the repeated
            columns of an environment map, the transform of a mesh. Pictures and `.vol` grids of another resolution are resized. A `.npy`
            file, or an `.npz` archive of one array, must have the parameter's shape; a last axis of length 1 may be missing, and so may
            the repeated columns of an environment map.
        bounds: (low, high); either may be None. None takes the physical range where it is known (a reflectance: 0 to 1).
        learning_rate: this parameter's own; None takes the optimizer's.
        preconditioner: e.g. `unrender.preconditioners.LargeSteps(10.0)`, or None.
        coarse_to_fine: `CoarseToFine`, or its steps alone, for a texture or grid that is coarse at first; None for one resolution.
        parameterisation: "identity", "log", "logit", "softplus" or "softplus(0.1)", or one of `unrender.parameterisations`: what the
            optimizer moves in place of the values, and what the learning rate is of. Preconditioner and optimizer act on that; values,
            bounds and results are the parameter's own. None for the identity.
        regularizer: of the vertex positions of a mesh, what is added to the loss: `MeshRegularizer`, or a table of its options such as
            {"bilaplacian": 0.001}; None for nothing.
        prior: What is known of the values before any picture: `Prior`, or a table of its options such as {"smoothness": 0.05}; None for
            nothing.
        remeshing: of the vertex positions of a mesh, when it gets other triangles: `Remeshing`, its steps alone, or a table of its options
            such as {"steps": [100], "method": "subdivide"}; None for never.
        self_intersection: of the vertex positions of a mesh, what is done where it passes through itself: "warn" looks now and then and
            at the end, and tells of it in one line; "prevent" shortens steps that would lead there, and looks at every step, which
            takes some 25 ms for 1000 triangles; "ignore" never looks.
        keys: parameters of the scene that all have this one value, or {key: factor} where each is a factor times it. Initial value, bounds,
            rate and preconditioner are of the one value.
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
    """What a method decides for a parameter that has no setting of its own; None leaves the setting open.

    Attributes:
        parameterisation: What the optimizer moves, or its name.
        preconditioner: Map of gradients and steps.
        coarse_to_fine: Resolutions over the steps.
    """

    parameterisation: Parameterisation | str | None = None
    preconditioner: Preconditioner | None = None
    coarse_to_fine: CoarseToFine | None = None


def ties_of(parameters: Sequence[Parameter]) -> tuple[Tie, ...]:
    """Return the ties among some parameters, in their order. Raises `FieldError` for keys that cannot be one."""
    found, names = [], [parameter.key for parameter in parameters]
    for index, parameter in enumerate(parameters):
        keys, place = parameter.keys, ("parameters", index, "keys")
        if keys is None:
            continue
        if isinstance(keys, str) or not isinstance(keys, (Sequence, Mapping)):
            raise FieldError(place, f"expected a list of keys, or a table of factors by key, got {keys!r}")
        factors = dict(keys) if isinstance(keys, Mapping) else dict.fromkeys(keys, 1.0)
        if other := next((key for key in factors if key in names and key != parameter.key), None):
            raise FieldError(place, f"{other} is an unknown of its own; leave it out of one of the two")
        if len(factors) < len(keys):
            raise FieldError(place, "a key is given twice")
        try:
            found.append(Tie(parameter.key, factors))
        except InputError as error:
            raise FieldError(place, str(error)) from error
    return tuple(found)


def tied(renderer: Renderer, parameters: Sequence[Parameter], ties: Sequence[Tie]) -> Renderer:
    """Return the renderer with these ties, which are those of the parameters. Raises `FieldError` where members do not go together."""
    try:
        return with_ties(renderer, ties)
    except TieError as error:
        index = [parameter.key for parameter in parameters].index(error.key)
        raise FieldError(("parameters", index, "keys"), str(error)) from error
