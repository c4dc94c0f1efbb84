"""What is to be recovered, from which images, under which loss."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.core.trees import Tree
from unrender.evaluation.surfaces import Surface, surface_error
from unrender.losses import L2, Loss
from unrender.preconditioners.base import Preconditioner
from unrender.preconditioners.mesh import MeshTopology
from unrender.problem import notebook
from unrender.problem.coarse_to_fine import CoarseToFine
from unrender.problem.coordinates import Coordinates
from unrender.problem.errors import FieldError
from unrender.problem.gatherer import Gatherer
from unrender.problem.mesh_checks import (
    check_remeshings,
    check_self_intersections,
    check_surfaces,
    mesh_notices,
)
from unrender.problem.parameter import Parameter
from unrender.problem.references import References
from unrender.problem.validation import (
    Bounds,
    CheckedParameter,
    check_loss,
    check_loss_function,
    check_max_depth,
    check_parameter,
    check_parameterisation,
    check_preconditioner,
    check_resolutions,
    check_sequence,
    check_truth,
    longest_path,
    mesh_topology,
    open_renderer,
    renderer_notices,
)
from unrender.problem.view import View
from unrender.problem.view_checks import check_views
from unrender.problem.view_losses import ViewLosses
from unrender.rendering.photographs import with_photographs
from unrender.rendering.renderer import Remeshable, Renderer, ReplacedMesh, format_of

__all__ = ["Bounds", "Problem"]


class Problem(ViewLosses):
    """A scene, its unknown parameters, and the reference images.

    Everything is checked and read at construction. A problem then does not change: no method writes to it, and its caches hold device
    copies of the references and masks, which are constant. (`Problem.from_file` and the gallery complete `origin` before they return.)

    Args:
        scene: an .xml file, a Mitsuba dictionary, a function that returns one, a loaded `mi.Scene`, or a `protocols.Renderer`. A loaded
            scene cannot be held twice, so methods that compare two states (control variates, meta-estimation) refuse it.
        parameters: the unknowns, at least one, with different keys.
        views: the reference images, at least one.
        loss: per pixel and channel; None is L2(). Or a function of an image (H, W, 3), or of an image and its reference, to a scalar, in
            Dr.Jit or PyTorch: see `losses.FunctionLoss`. The total is the sum over views of weight * mean over pixels and
            channels of mask * loss.
        max_depth: longest light path in segments, >= 1 (1: emitters seen directly, 2: direct light); None for that of the scene's own
            integrator: 64 where that has no limit, 6 where there is none.
        truth: {key: value} of parameters whose true value is known, to measure the error; values as for
            `Parameter.initial`.
        name: for people; None takes the scene file's.
        surfaces: {key: `evaluation.surfaces.Surface`} of vertex positions whose true surface is known,
            but not where on it a vertex belongs.

    Attributes:
        parameters: tuple of `Parameter`, as given.
        views: tuple of `View`, their reference a float32 array (H, W, 3), their mask (H, W) or None. Where all references
            together take more than 512 MiB, they wait in a temporary file, and `np.asarray` reads one.
        renderer: what renders the scene.
        given_views: tuple of `View`, as given.
        origin: where it came from, to make it again: {"scene": path of the XML}, with "file", the path of the problem file, where there is
            one; {"gallery": name, "options": {...}}; empty where only the program that made it can make it again.
        notices: one line for each setting of the scene that is not used, and for each change made to the input: conversions, values moved
            into bounds.
        bounds: {key: (low, high)}, the parameter's own or the physical range that the renderer knows; None is open.
        learning_rates: {key: rate} of the parameters that have their own.
        preconditioners: {key: preconditioner} of the parameters that have one.
        coarse_to_fine: {key: `CoarseToFine`} of the parameters that are coarse at first.
        parameterisations: {key: parameterisation} of the parameters that were given one.
        remeshings: {key: `Remeshing`} of the parameters that have one.
        self_intersections: {key: "warn", "prevent" or "ignore"} of the parameters that are vertex positions.
        regularizers: {key: `MeshRegularizer`} of the parameters that have one.
        coordinates: what an optimizer moves, by parameterisations and preconditioners.
        references: values and weights of single pixels of the references.
        truth: {key: array} of the parameters' shapes.
        surfaces: as given.
        first_values: {key: float32 array inside the bounds}, where parameters start. Read-only: may be the scene's own memory.
        faces: {key: (F, 3) numbers of vertices} of the parameters that are vertex positions of a mesh.
        remeshed_from: the problem with the meshes that it began with, where it has others now; else None.
        gatherer: computes gradients in place of this process, with the views dealt to workers; None where there is none.

    Raises:
        InputError: in one line, which field is wrong and what was expected.
    """

    remeshed_from: Problem | None = None

    @exclusive("Problem")
    def __init__(
        self,
        scene: str | Path | dict[str, Any] | Callable[[], Any] | Renderer,
        parameters: Sequence[Parameter],
        views: Sequence[View],
        loss: Loss | Callable[..., Any] | None = None,
        max_depth: int | None = None,
        *,
        truth: Mapping[str, Any] | None = None,
        name: str | None = None,
        surfaces: Mapping[str, Surface] | None = None,
    ):
        check_max_depth(max_depth)
        self.loss = check_loss(L2() if loss is None else loss)
        self.parameters: tuple[Parameter, ...] = check_sequence(parameters, Parameter, "parameters")
        self.given_views: tuple[View, ...] = check_sequence(views, View, "views")
        self.origin: dict[str, Any] = {"scene": str(Path(scene).resolve())} if isinstance(scene, (str, Path)) else {}
        self.name = name or (Path(scene).stem if isinstance(scene, (str, Path)) else "problem")
        keys = [parameter.key for parameter in self.parameters if isinstance(parameter.key, str)]
        self.renderer: Renderer = open_renderer(scene, max_depth, keys)
        self.max_depth: int = max_depth or longest_path(self.renderer)
        sensors = [view.sensor for view in self.given_views if isinstance(view.sensor, int)]
        try:
            self.renderer = with_photographs(self.renderer, keys, sensors)
        except InputError as error:
            named = str(error).partition(":")[0]
            raise FieldError(("parameters", keys.index(named), "key"), str(error)) from error

        known = self.renderer.parameters()
        checked: dict[str, CheckedParameter] = {}
        for index, parameter in enumerate(self.parameters):
            if isinstance(parameter.key, str) and parameter.key in checked:
                raise FieldError(("parameters", index, "key"), f"{parameter.key} is given twice")
            checked[parameter.key] = check_parameter(index, parameter, known, self.renderer)
        self.bounds = {key: found.bounds for key, found in checked.items()}
        self.learning_rates = {k: rate for k, found in checked.items() if (rate := found.learning_rate) is not None}
        self.preconditioners = {k: p for k, found in checked.items() if (p := found.preconditioner) is not None}
        self.coarse_to_fine = {k: c for k, found in checked.items() if (c := found.coarse_to_fine) is not None}
        self.parameterisations = {k: p for k, found in checked.items() if (p := found.parameterisation) is not None}
        self.regularizers = {k: r for k, found in checked.items() if (r := found.regularizer) is not None}
        transforms = {k: t for k, found in checked.items() if (t := found.transform) is not None}
        self.coordinates = Coordinates(transforms, self.preconditioners)
        self.first_values = {key: found.initial for key, found in checked.items()}
        meshes = {key: mesh() for key in checked if (mesh := known[key].moving_mesh) is not None}
        self.faces = {key: np.asarray(faces).astype(np.int64).reshape(-1, 3) for key, (_, faces) in meshes.items()}
        self.notices = list(renderer_notices(self.renderer))
        self.notices += [notice for found in checked.values() for notice in found.notices]
        self.notices += [line for key, mesh in meshes.items() for line in mesh_notices(key, *mesh)]
        self.views, notices = check_views(self.given_views, self.renderer, self.loss)
        self.notices += notices
        check_loss_function(self.loss, np.asarray(self.views[0].reference))
        self.truth = self._checked_truth(truth or {})
        self.surfaces = dict(surfaces or {})
        check_surfaces(self.surfaces, self.faces)
        self.remeshings = check_remeshings(self.parameters, known, self.texture_coordinates)
        self.self_intersections = check_self_intersections(self.parameters, self.faces)
        self.gatherer: Gatherer | None = None
        self.references = References(self.views, self.renderer.array)
        self._references, self._masks = dict[int, Array](), dict[int, Array | None]()
        self._as_given: Problem | None = None

    def _checked_truth(self, given: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """True values as arrays; adds to the notices."""
        found: dict[str, np.ndarray] = {}
        for key, value in given.items():
            found[key], notice = check_truth(key, value, self.shapes())
            self.notices += [f"parameter {key}: truth {notice}"] if notice else []
        return found

    @classmethod
    def from_file(cls, path: str | Path) -> Problem:
        """The problem that a TOML file describes. Raises `InputError` that names the line."""
        from unrender.problem.toml_file import read

        return read(path)

    def replaced(
        self,
        *,
        parameters: Sequence[Parameter] | None = None,
        views: Sequence[View] | None = None,
        loss: Loss | Callable[..., Any] | None = None,
        truth: Mapping[str, Any] | None = None,
        name: str | None = None,
    ) -> Problem:
        """Another problem of the same scene, which is not loaded again; arguments as for `Problem`, None for what it has already.

        Of truths and true surfaces those stay whose parameters are still unknown. Of `origin` the scene's file stays.

        Raises `InputError` as `Problem` does.
        """
        given = self.parameters if parameters is None else check_sequence(parameters, Parameter, "parameters")
        keys = {parameter.key for parameter in given if isinstance(parameter.key, str)}
        made = Problem(
            self.renderer,
            given,
            self.given_views if views is None else views,
            self.loss if loss is None else loss,
            self.max_depth,
            truth={key: value for key, value in self.truth.items() if key in keys} if truth is None else truth,
            name=name or self.name,
            surfaces={key: surface for key, surface in self.surfaces.items() if key in keys},
        )
        if self.remeshed_from is None:
            made.origin = {key: value for key, value in self.origin.items() if key == "scene"}
        return made

    @property
    def as_given(self) -> Problem:
        """The problem before an optimizer's parameterisations, preconditioners or resolutions were added."""
        return self._as_given or self

    def reparameterised(self, given: Mapping[str, Any]) -> Problem:
        """The same problem with these parameterisations, {key: one, or its name}, for the parameters that have none of their own.

        Raises `InputError` where bounds do not suit.
        """
        missing = self._missing("parameterisation", given)
        checked = {k: check_parameterisation(g, self.bounds[k], self.first_values[k]) for k, g in missing.items()}
        made = {key: one for key, (one, _) in checked.items()}
        found = self._completed("parameterisation", made)
        found.parameterisations = self.parameterisations | made
        transforms = {key: transform for key, (_, transform) in checked.items() if transform is not None}
        found.coordinates = replace(self.coordinates, transforms={**self.coordinates.transforms, **transforms})
        return found

    def refining(self, given: Mapping[str, CoarseToFine]) -> Problem:
        """The same problem, parameters with no resolutions of their own coarse at first. Raises `InputError` for what does not suit."""
        missing, known = self._missing("coarse_to_fine", given), self.renderer.parameters()
        for key, way in missing.items():
            check_resolutions(key, way, known[key])
        found = self._completed("coarse_to_fine", missing)
        found.coarse_to_fine = self.coarse_to_fine | missing
        return found

    def topology(self, key: str) -> MeshTopology | None:
        """Of the mesh at whose vertices a parameter has values, (n V,); None for textures, grids and numbers."""
        return mesh_topology(self.renderer.parameters()[key])

    def preconditioned(self, given: Mapping[str, Preconditioner]) -> Problem:
        """The same problem with these preconditioners for parameters that have none. Raises `InputError` for one that does not suit."""
        missing, known = self._missing("preconditioner", given), self.renderer.parameters()
        found = self._completed("preconditioner", missing)
        checked = {k: check_preconditioner(k, p, known[k]) for k, p in missing.items()}
        found.preconditioners = self.preconditioners | checked
        found.coordinates = replace(self.coordinates, preconditioners=found.preconditioners)
        return found

    def _missing(self, field: str, given: Mapping[str, Any]) -> dict[str, Any]:
        """What is given for parameters without a `field` of their own."""
        return {p.key: given[p.key] for p in self.parameters if p.key in given and getattr(p, field) is None}

    def _completed(self, field: str, given: Mapping[str, Any]) -> Problem:
        """A copy whose parameters have these as `field`; the problem as it was given stays known."""
        found = copy.copy(self)
        found._as_given = self.as_given
        found.parameters = tuple(replace(p, **{field: given[p.key]}) if p.key in given else p for p in self.parameters)
        return found

    def remeshed(self, meshes: Mapping[str, ReplacedMesh]) -> Problem:
        """The same problem with other meshes, {key of vertex positions: mesh}, which are also where these parameters start.

        Raises `InputError` where the renderer has no meshes to replace.
        """
        if not isinstance(self.renderer, Remeshable):
            raise InputError(f"{', '.join(meshes)}: this renderer's meshes keep their triangles")
        given = [
            replace(p, initial=meshes[p.key].vertices.reshape(-1).astype(np.float32)) if p.key in meshes else p
            for p in self.parameters
        ]
        shapes = {key.rpartition(".")[0]: mesh for key, mesh in meshes.items()}
        renderer = self.renderer.with_meshes(shapes, [p.key for p in given])
        truth = {key: value for key, value in self.truth.items() if key not in meshes}
        # Checked views are RGB, which films of other formats would take for theirs.
        plain = all(format_of(renderer, view.sensor).colour == "rgb" for view in self.views)
        views = self.views if plain else self.given_views
        made = Problem(
            renderer, given, views, self.loss, self.max_depth, truth=truth, name=self.name, surfaces=self.surfaces
        )
        made.origin, made.gatherer, made._as_given = self.origin, self.gatherer, self.as_given
        made.remeshed_from = self.remeshed_from or self
        return made

    def gathered_by(self, gatherer: Gatherer | None) -> Problem:
        """The same problem, its gradients computed by workers that its views are dealt to."""
        found = copy.copy(self)
        found.gatherer = gatherer
        return found

    def rendered_by(self, renderer: Renderer) -> Problem:
        """The same problem, its scene rendered by another renderer of the same arrays."""
        found = copy.copy(self)
        found.renderer = renderer
        return found

    def __repr__(self) -> str:
        return notebook.line(self)

    def _repr_html_(self) -> str:
        return notebook.html(self)

    def initial_values(self) -> dict[str, np.ndarray]:
        """`first_values`, copied."""
        return {key: np.array(value) for key, value in self.first_values.items()}

    @property
    def pixels(self) -> int:
        """Of all views together."""
        return sum(height * width for height, width in self.sizes)

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """(height, width) of each view."""
        known = self.renderer.resolutions()
        return [known[view.sensor] for view in self.views]

    def initial(self) -> Tree:
        """The initial parameters: the renderer's arrays, inside the bounds, at the scene's own resolutions."""
        return {key: self.renderer.array(value) for key, value in self.first_values.items()}

    def start(self, step: int = 0) -> Tree:
        """`initial()` at the resolutions that parameters have at a step."""
        coarse = {key: way.coarsened(self.first_values[key], step) for key, way in self.coarse_to_fine.items()}
        return {key: self.renderer.array(coarse.get(key, value)) for key, value in self.first_values.items()}

    def shapes(self, step: int | None = None) -> dict[str, tuple[int, ...]]:
        """Of each parameter at a step; None for the scene's own."""
        found = {key: value.shape for key, value in self.first_values.items()}
        if step is None:
            return found
        return found | {key: way.shape(found[key], step) for key, way in self.coarse_to_fine.items()}

    def full(self, parameters: Mapping[str, Array]) -> dict[str, np.ndarray]:
        """The parameters as NumPy arrays, those that are still coarse interpolated at the scene's own resolution."""
        found = {key: arrays.numpy(value) for key, value in parameters.items()}
        for key, way in self.coarse_to_fine.items():
            if key in found and found[key].shape in way.shapes(self.first_values[key].shape):
                found[key] = way.refined(found[key], self.first_values[key].shape)
        return found

    def texture_coordinates(self, key: str) -> np.ndarray | None:
        """(V, 2) of a mesh whose vertex positions are the parameter `key`; None where it has none."""
        name = f"{key.rpartition('.')[0]}.vertex_texcoords"
        if name not in self.renderer.parameters():
            return None
        found = arrays.numpy(self.renderer.values([name])[name]).reshape(-1, 2)
        return found if len(found) == self.first_values[key].size // 3 else None

    @property
    def has_truth(self) -> bool:
        """Whether any parameter's true value, or surface, is known."""
        return bool(self.truth or self.surfaces)

    def parameter_error(self, parameters: Mapping[str, Array]) -> dict[str, float]:
        """Root mean square error against the truth, for each key whose truth is known; of meshes whose true surface is, the root
        mean square distance between the surfaces (`evaluation.surfaces.surface_error`). Waits for the device."""
        found = self.full({key: parameters[key] for key in (*self.truth, *self.surfaces)})
        errors = {
            key: float(np.sqrt(np.mean(np.square(found[key] - truth, dtype=np.float64))))
            for key, truth in self.truth.items()
        }
        for key, surface in self.surfaces.items():
            if found[key].size == self.first_values[key].size:
                errors[key] = surface_error(Surface(found[key].reshape(-1, 3), self.faces[key]), surface)
        return errors
