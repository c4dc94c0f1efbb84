"""What is to be recovered, from which images, under which loss."""

from __future__ import annotations

import copy
import math
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
from unrender.losses import L2, Loss
from unrender.preconditioners.mesh import MeshTopology
from unrender.rendering.parameter_errors import ErrorMeasure
from unrender.rendering.photographs import with_photographs
from unrender.rendering.renderer import Remeshable, Renderer, ReplacedMesh, format_of
from unrender.scene import notebook
from unrender.scene.coordinates import Coordinates
from unrender.scene.errors import FieldError
from unrender.scene.executor import LOCAL, Executor
from unrender.scene.mesh_checks import (
    check_remeshings,
    check_self_intersections,
    check_surfaces,
    mesh_notices,
)
from unrender.scene.parameter import Parameter, ParameterSettings
from unrender.scene.references import References
from unrender.scene.surfaces import Surface, surface_error
from unrender.scene.validation import (
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
from unrender.scene.view import View
from unrender.scene.view_checks import check_views
from unrender.scene.view_losses import ViewLosses

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
        measures: {key: `evaluation.parameter_errors.ErrorMeasure`}, how errors against the truth are measured: the root mean square
            difference, of normals and directions the mean angle in degrees.
        references: values and weights of single pixels of the references.
        truth: {key: array} of the parameters' shapes.
        surfaces: as given.
        first_values: {key: float32 array inside the bounds}, where parameters start. Read-only: may be the scene's own memory.
        faces: {key: (F, 3) numbers of vertices} of the parameters that are vertex positions of a mesh.
        remeshed_from: the problem with the meshes that it began with, where it has others now; else None.
        executor: computes gradients, in this process unless the views are distributed.

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
        self.measures = {key: ErrorMeasure(known[key].role, known[key].conversion.repeated) for key in checked}
        self.coordinates = Coordinates(transforms, self.preconditioners, self.repeated)
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
        self.executor: Executor = LOCAL
        self.references = References(self.views, self.renderer.array)
        self._references, self._masks = dict[int, Array](), dict[int, Array | None]()

    def _checked_truth(self, given: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """True values as arrays; adds to the notices."""
        found: dict[str, np.ndarray] = {}
        known = self.renderer.parameters()
        infos = {key: known[key] for key in self.first_values}
        for key, value in given.items():
            found[key], notice = check_truth(key, value, infos)
            self.notices += [f"parameter {key}: truth {notice}"] if notice else []
        return found

    @classmethod
    def from_file(cls, path: str | Path) -> Problem:
        """The problem that a TOML file describes. Raises `InputError` that names the line."""
        from unrender.scene.toml_file import read

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

    def configured(self, settings: Mapping[str, ParameterSettings]) -> Problem:
        """Return the same problem where parameters without a setting of their own take the one given here.

        Raises `InputError` for a setting that does not suit its parameter.
        """
        known, made = self.renderer.parameters(), copy.copy(self)
        transforms, parameters = dict(self.coordinates.transforms), []
        made.parameterisations, made.preconditioners = dict(self.parameterisations), dict(self.preconditioners)
        made.coarse_to_fine = dict(self.coarse_to_fine)
        for parameter in self.parameters:
            key, chosen = parameter.key, vars(settings.get(parameter.key, ParameterSettings()))
            new = {n: value for n, value in chosen.items() if value is not None and getattr(parameter, n) is None}
            parameters.append(replace(parameter, **new))
            if "parameterisation" in new:
                checked = check_parameterisation(new["parameterisation"], self.bounds[key], self.first_values[key])
                made.parameterisations[key] = checked[0]
                transforms |= {} if checked[1] is None else {key: checked[1]}
            if "preconditioner" in new:
                made.preconditioners[key] = check_preconditioner(key, new["preconditioner"], known[key])
            if "coarse_to_fine" in new:
                check_resolutions(key, new["coarse_to_fine"], known[key])
                made.coarse_to_fine[key] = new["coarse_to_fine"]
        made.parameters = tuple(parameters)
        made.coordinates = replace(self.coordinates, transforms=transforms, preconditioners=made.preconditioners)
        return made

    def topology(self, key: str) -> MeshTopology | None:
        """Of the mesh at whose vertices a parameter has values, (n V,); None for textures, grids and numbers."""
        return mesh_topology(self.renderer.parameters()[key])

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
        made.origin, made.executor = self.origin, self.executor
        made.remeshed_from = self.remeshed_from or self
        return made

    def executed_by(self, executor: Executor) -> Problem:
        """Return the same problem with another executor of its gradients."""
        made = copy.copy(self)
        made.executor = executor
        return made

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
    def repeated(self) -> dict[str, int]:
        """{key: number of columns at each end that repeat those of the opposite end} of environment maps."""
        return {key: measure.repeated for key, measure in self.measures.items() if measure.repeated}

    @property
    def has_truth(self) -> bool:
        """Whether any parameter's true value, or surface, is known."""
        return bool(self.truth or self.surfaces)

    def parameter_error(self, parameters: Mapping[str, Array]) -> dict[str, float]:
        """Return the error of each parameter whose truth is known, see `measures`. Waits for the device.

        The error of a mesh whose true surface is known is the root mean square distance between the surfaces
        (`evaluation.surfaces.surface_error`).
        """
        found = self.full({key: parameters[key] for key in (*self.truth, *self.surfaces)})
        errors = {}
        for key, truth in self.truth.items():
            error = self.measures[key].error(found[key], truth)
            errors[key] = math.nan if error is None else error
        for key, surface in self.surfaces.items():
            if found[key].size == self.first_values[key].size:
                errors[key] = surface_error(Surface(found[key].reshape(-1, 3), self.faces[key]), surface)
        return errors
