"""The inverse problem: what is recovered, from which images, under which loss."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.errors import InputError, KeyedError
from unrender.core.exclusive import exclusive
from unrender.core.text import in_words
from unrender.core.trees import Tree
from unrender.io.toml_lines import FieldError
from unrender.losses import L2, Loss
from unrender.preconditioners.mesh import MeshTopology
from unrender.rendering.expressions import with_expressions
from unrender.rendering.photographs import OF_PHOTOGRAPHS, with_photographs
from unrender.rendering.renderer import Renderer
from unrender.scene import notebook
from unrender.scene.coarse_to_fine import CoarseToFine
from unrender.scene.coordinates import Coordinates
from unrender.scene.executor import LOCAL, Executor
from unrender.scene.meshes import check_surfaces
from unrender.scene.parameter import Parameter, ParameterSettings, Unknown, scene_keys, tied, ties_of
from unrender.scene.references import References, View, ViewLosses, likelihood_scale
from unrender.scene.surfaces import Surface
from unrender.scene.validation import (
    Bounds,
    axis_notices,
    check_loss,
    check_loss_function,
    check_max_depth,
    check_parameter,
    check_sequence,
    check_truth,
    configure,
    longest_path,
    mesh_topology,
    open_renderer,
    renderer_notices,
    texture_coordinates,
)
from unrender.scene.view_checks import check_views, known_angles
from unrender.scene.view_worlds import check_determined, is_storable, known_keys, of_views, requested_depth, unseen

__all__ = ["Bounds", "Problem", "open_scene"]


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Problem(ViewLosses):
    """A scene, its unknown parameters, and the reference images.

    The constructor reads and checks everything. A problem does not change afterwards: its caches hold copies on the device.

    Args:
        scene: an .xml file, a Mitsuba dictionary, a function that returns one, a loaded `mi.Scene`, or a `protocols.Renderer`. A loaded
            scene cannot be duplicated, so methods that compare two states (control variates, meta-estimation) refuse it.
        parameters: the unknowns, at least one, with different keys.
        views: the reference images, at least one.
        loss: loss per pixel and channel; None is L2(). Or a function of an image (H, W, 3), or of an image and its reference, that
            returns a scalar in Dr.Jit or PyTorch: see `losses.FunctionLoss`. The total is the sum over views of weight * mean over pixels
            and channels of mask * loss.
        max_depth: maximum path length in segments, >= 1 (1: directly visible emitters, 2: direct illumination). None takes the value of
            the scene's integrator: 64 if that is unlimited, 6 if there is no integrator.
        expressions: {key of the scene: text or function}: parameters of the scene that are differentiable functions of unknowns which the
            scene does not have, such as {"left.intensity.value": "strength * [1, 0.8, 0.6]"}. A function takes {key of an unknown: Dr.Jit
            tensor} and returns a tensor. `rendering.expression_texts.parse` describes texts. Such an unknown needs an `initial` value,
            whose shape is its own.
        truth: {key: value} of parameters with a known true value, to measure the error; values as for `Parameter.initial`.
        name: name for display; None takes the name of the scene file.
        surfaces: {key: `scene.surfaces.Surface`} of vertex positions whose true surface is known, but not the true position of each vertex.
        partial: whether other views, which this object does not have, may determine an unknown that all of its views know.

    Attributes:
        renderer: renderer of the scene.
        unknowns: {key: `Unknown`}: the parameters with their defaults filled in, in order.
        views: tuple of `View`, with the reference as a float32 array (H, W, 3), and the mask as (H, W) or None. If all references exceed
            512 MiB, they are stored in a temporary file, and `np.asarray` reads one.
        original_views: tuple of `View`, as passed to the constructor.
        loss, max_depth, name: as above.
        origin: how to recreate the problem: {"scene": path of the XML}, plus "file", the path of the problem file, if there is one;
            {"gallery": name, "options": {...}}; empty if only the program that made it can recreate it.
        notices: one line for each ignored setting of the scene, and for each change of the input, such as a conversion.
        references: values and weights of single pixels of the references.
        executor: executor of gradient requests, in this process unless the views are distributed.
        remeshed_from: the problem with its initial meshes, if this one has been remeshed; else None.

    Raises:
        InputError: one line that names the invalid field and the expected value.
    """

    renderer: Renderer
    unknowns: Mapping[str, Unknown]
    views: tuple[View, ...]
    original_views: tuple[View, ...]
    loss: Loss
    max_depth: int
    name: str
    origin: Mapping[str, Any]
    notices: list[str]
    references: References
    executor: Executor
    remeshed_from: Problem | None
    _references: dict[int, Array]
    _masks: dict[int, Array | None]

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
        expressions: Mapping[str, str | Callable[..., Any]] | None = None,
        partial: bool = False,
    ):
        check_max_depth(max_depth)
        checks.optional("name", name, str, "text")
        checks.flag("Problem", "partial", partial)
        checks.optional("truth", truth, Mapping, "values by key of the parameters")
        checked_loss = check_loss(L2() if loss is None else loss)
        checked_parameters: tuple[Parameter, ...] = check_sequence(parameters, Parameter, "parameters")
        original_views: tuple[View, ...] = check_sequence(views, View, "views")
        path = Path(scene) if isinstance(scene, (str, Path)) else None
        renderer, located = _opened(scene, max_depth, checked_parameters, original_views, expressions)
        unknowns = _unknowns(checked_parameters, renderer, truth or {}, {} if surfaces is None else surfaces)
        checked_views, view_notices = check_views(located, renderer, checked_loss)
        if not partial:
            check_determined(original_views, located, renderer, list(unknowns))
        check_loss_function(checked_loss, np.asarray(checked_views[0].reference))
        vars(self).update(
            renderer=renderer,
            unknowns=unknowns,
            views=checked_views,
            original_views=original_views,
            loss=checked_loss,
            max_depth=int(max_depth or longest_path(renderer)),
            name=name or (path.stem if path else "problem"),
            origin={"scene": str(path.resolve())} if path and is_storable(renderer, original_views) else {},
            notices=[
                *renderer_notices(renderer),
                *(line for unknown in unknowns.values() for line in unknown.notices),
                *axis_notices(unknowns, renderer.parameters()),
                *known_angles(original_views, renderer.parameters()),
                *view_notices,
            ],
            references=References(checked_views, renderer.array),
            executor=LOCAL,
            remeshed_from=None,
            _references={},
            _masks={},
        )

    @classmethod
    def from_file(cls, path: str | Path, *, partial: bool = False) -> Problem:
        """Return the problem of a TOML file; `partial` as for `Problem`. Raises `InputError` that names the line."""
        from unrender.scene.toml_file import read

        return read(path, partial)

    def replaced(
        self,
        *,
        parameters: Sequence[Parameter] | None = None,
        views: Sequence[View] | None = None,
        loss: Loss | Callable[..., Any] | None = None,
        truth: Mapping[str, Any] | None = None,
        name: str | None = None,
    ) -> Problem:
        """Return another problem of the same scene, which is not loaded again. Arguments as for `Problem`; None keeps the current value.

        Truths and true surfaces stay for parameters that are still unknown. `origin` keeps only the scene's file. Raises `InputError` as
        `Problem` does.
        """
        given = self.parameters if parameters is None else check_sequence(parameters, Parameter, "parameters")
        keys = {parameter.key for parameter in given if isinstance(parameter.key, str)}
        made = Problem(
            self.renderer,
            given,
            self.original_views if views is None else views,
            self.loss if loss is None else loss,
            requested_depth(self.renderer, self.original_views, self.max_depth),
            truth={key: value for key, value in self.truth.items() if key in keys} if truth is None else truth,
            name=name or self.name,
            surfaces={key: u.surface for key, u in self.unknowns.items() if u.surface is not None and key in keys},
        )
        stored = self.remeshed_from is None and is_storable(made.renderer, made.original_views)
        return made.with_parts(origin={k: v for k, v in self.origin.items() if stored and k == "scene"})

    def with_parts(
        self,
        *,
        renderer: Renderer | None = None,
        unknowns: Mapping[str, Unknown] | None = None,
        origin: Mapping[str, Any] | None = None,
        executor: Executor | None = None,
        remeshed_from: Problem | None = None,
        notices: list[str] | None = None,
    ) -> Problem:
        """Return the same problem with other attributes, which are not checked; None keeps the current one."""
        parts = {"renderer": renderer, "unknowns": unknowns, "origin": origin, "executor": executor, "notices": notices}
        changes = {name: part for name, part in {**parts, "remeshed_from": remeshed_from}.items() if part is not None}
        made = object.__new__(Problem)
        vars(made).update({field.name: getattr(self, field.name) for field in fields(self)} | changes)
        return made

    def configured(self, settings: Mapping[str, ParameterSettings]) -> Problem:
        """Return the problem where parameters whose own setting is None take these. Raises `InputError` for one that does not suit."""
        known = self.renderer.parameters()
        changed = {key: configure(self.unknowns[key], own, known[key]) for key, own in settings.items()}
        return self.with_parts(unknowns={**self.unknowns, **changed})

    def topology(self, key: str) -> MeshTopology | None:
        """Return the topology of the mesh whose vertices carry the parameter, (n V,); None for all others."""
        return mesh_topology(self.renderer.parameters().get(key))

    def texture_coordinates(self, key: str) -> np.ndarray | None:
        """Return the texture coordinates (V, 2) of the mesh whose vertex positions are the parameter `key`; None if it has none."""
        return texture_coordinates(self.renderer, key, self.unknowns[key].initial.size)

    def __deepcopy__(self, memo: Any) -> Problem:
        return self  # it does not change, and Mitsuba does not copy scenes

    def __repr__(self) -> str:
        return notebook.line(self)

    def _repr_html_(self) -> str:
        return notebook.html(self)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters as passed to the constructor, with the settings of `configured`."""
        return tuple(unknown.parameter for unknown in self.unknowns.values())

    @cached_property
    def coordinates(self) -> Coordinates:
        """Coordinates that an optimizer updates, from parameterisations and preconditioners."""
        known = self.unknowns.items()
        return Coordinates(
            {key: u.transform for key, u in known if u.transform is not None},
            {key: u.preconditioner for key, u in known if u.preconditioner is not None},
            {key: u.measure.repeated for key, u in known if u.measure.repeated},
        )

    @cached_property
    def prior_scales(self) -> dict[str, float]:
        """{key: factor by which the negative log density of its prior enters the loss}, see `references.likelihood_scale`."""
        scales = {}
        for key in [key for key, u in self.unknowns.items() if u.prior is not None]:
            reasons = unseen(self.original_views, self.views, self.renderer, key)
            showing = [index for index, of_view in enumerate(reasons) if not all(of_view)]
            scales[key] = likelihood_scale(self, showing or None)
        return scales

    @cached_property
    def learning_rates(self) -> dict[str, float]:
        """{key: learning rate} of the parameters that have their own."""
        return {key: u.learning_rate for key, u in self.unknowns.items() if u.learning_rate is not None}

    @cached_property
    def faces(self) -> dict[str, np.ndarray]:
        """{key: vertex indices (F, 3)} of the parameters that are vertex positions of a mesh."""
        return {key: u.faces for key, u in self.unknowns.items() if u.faces is not None}

    @cached_property
    def coarse_to_fine(self) -> dict[str, CoarseToFine]:
        """{key: resolutions over the steps} of the parameters with a coarse initial resolution."""
        return {key: u.coarse_to_fine for key, u in self.unknowns.items() if u.coarse_to_fine is not None}

    @property
    def truth(self) -> dict[str, np.ndarray]:
        """{key: true value} of the parameters whose true value is known."""
        return {key: u.truth for key, u in self.unknowns.items() if u.truth is not None}

    @property
    def has_truth(self) -> bool:
        """Return whether the true value or surface of any parameter is known."""
        return any(u.truth is not None or u.surface is not None for u in self.unknowns.values())

    @property
    def has_prior(self) -> bool:
        """Return whether any unknown has a prior."""
        return any(u.prior is not None for u in self.unknowns.values())

    @property
    def pixels(self) -> int:
        """Number of pixels of all views."""
        return sum(height * width for height, width in self.sizes)

    def initial_values(self) -> dict[str, np.ndarray]:
        """Return copies of the initial values at the scene's resolution."""
        return {key: np.array(unknown.initial) for key, unknown in self.unknowns.items()}

    def initial(self) -> Tree:
        """Return the initial parameters as arrays of the renderer, inside the bounds, at the scene's resolution."""
        return {key: self.renderer.array(unknown.initial) for key, unknown in self.unknowns.items()}

    def start(self, step: int = 0) -> Tree:
        """Return the values before the first step (`Unknown.first`, else `initial()`) at the resolutions of a step."""
        return {key: self.renderer.array(unknown.start(step)) for key, unknown in self.unknowns.items()}

    def shapes(self, step: int | None = None) -> dict[str, tuple[int, ...]]:
        """Return the shape of each parameter at a step; None for the scene's."""
        return {key: unknown.shape(step) for key, unknown in self.unknowns.items()}

    def full(self, parameters: Mapping[str, Array]) -> dict[str, np.ndarray]:
        """Return the parameters as NumPy arrays at the scene's resolution; coarser ones are interpolated."""
        return {key: self.unknowns[key].full(arrays.numpy(value)) for key, value in parameters.items()}

    def parameter_error(self, parameters: Mapping[str, Array]) -> dict[str, float]:
        """Return the error of each parameter whose truth is known, see `Unknown.error`. Raises `InputError` for missing ones."""
        known = [key for key, u in self.unknowns.items() if u.truth is not None or u.surface is not None]
        if not isinstance(parameters, Mapping) or not parameters.keys() >= {*known}:
            raise InputError(f"parameter_error: expected values of {known}, got {in_words(parameters)}")
        values = self.full({key: parameters[key] for key in known})
        errors = {key: self.unknowns[key].error(values[key]) for key in known}
        return {key: error for key, error in errors.items() if error is not None}


def _opened(
    scene: Any,
    max_depth: int | None,
    parameters: Sequence[Parameter],
    views: Sequence[View],
    expressions: Mapping[str, Any] | None,
) -> tuple[Renderer, tuple[View, ...]]:
    """Return the renderer of a scene, with unknowns that photographs have, and the views by its sensors. Raises `FieldError`."""
    keys = [parameter.key for parameter in parameters if isinstance(parameter.key, str)]
    known = known_keys(views)
    renderer = open_scene(scene, max_depth, parameters, known, expressions)
    members = list(dict.fromkeys([*scene_keys(parameters), *(expressions or ())]))
    renderer, located = of_views(renderer, views, members, lambda of: open_renderer(of, max_depth, [*members, *known]))
    for index, view in enumerate(views):
        if view.aov is not None and (conflict := next((key for key in keys if key in OF_PHOTOGRAPHS), None)):
            what = f"not supported together with the unknown {conflict}; leave out one of them"
            raise FieldError(("views", index, "aov"), what)
    try:
        return with_photographs(renderer, keys, [view.sensor for view in located]), located
    except InputError as error:
        named = str(error).partition(":")[0]
        raise FieldError(("parameters", keys.index(named), "key"), str(error)) from error


def _unknowns(
    parameters: Sequence[Parameter], renderer: Renderer, truth: Mapping[str, Any], surfaces: Mapping[str, Surface]
) -> dict[str, Unknown]:
    known = renderer.parameters()
    unknowns: dict[str, Unknown] = {}
    for index, parameter in enumerate(parameters):
        if isinstance(parameter.key, str) and parameter.key in unknowns:
            raise FieldError(("parameters", index, "key"), f"{parameter.key} is given twice")
        unknowns[parameter.key] = check_parameter(index, parameter, known, renderer)
    check_surfaces(surfaces, {key: u.faces for key, u in unknowns.items() if u.faces is not None})
    unknowns |= {key: replace(unknowns[key], surface=surface) for key, surface in surfaces.items()}
    for key, value in truth.items():
        true, notices = check_truth(key, value, known, unknowns)
        unknowns[key] = replace(unknowns[key], truth=true, notices=(*unknowns[key].notices, *notices))
    return unknowns


def open_scene(
    scene: Any,
    max_depth: int | None,
    parameters: Sequence[Parameter],
    others: Sequence[str] = (),
    expressions: Mapping[str, Any] | None = None,
) -> Renderer:
    """Return the renderer of a scene in which the ties of these parameters are unknowns, and `others` will be used. Raises `FieldError`."""
    functions = {} if expressions is None else expressions
    if not (isinstance(functions, Mapping) and all(isinstance(key, str) for key in functions)):
        what = f"expected texts or functions by key of the scene, got {in_words(functions)}"
        raise FieldError(("expressions",), what)
    if taken := next((key for key in scene_keys(parameters) if key in functions), None):
        index = next(n for n, one in enumerate(parameters) if taken == one.key or taken in (one.keys or ()))
        field = "key" if parameters[index].keys is None else "keys"
        what = f"{taken} has an expression, which sets it; leave out one of them"
        raise FieldError(("parameters", index, field), what)
    renderer = open_renderer(scene, max_depth, [*scene_keys(parameters), *others, *functions])
    try:
        own = [p for p in parameters if isinstance(p.key, str) and p.keys is None and p.key not in OF_PHOTOGRAPHS]
        renderer = with_expressions(renderer, functions, {p.key: p.initial for p in own})
    except KeyedError as error:
        raise FieldError(("expressions", error.key), str(error), f"expression of {error.key}") from error
    except InputError as error:
        name, _, what = str(error).partition(": ")
        index = [parameter.key for parameter in parameters].index(name)
        field, what = ("initial", what[9:]) if what.startswith("initial: ") else ("key", what)
        raise FieldError(("parameters", index, field), what, f"parameter {name}") from error
    return tied(renderer, parameters, ties_of(parameters))
