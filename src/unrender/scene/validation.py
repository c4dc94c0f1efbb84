"""Validation of the arguments of a `Problem`: parameters, views, truth, bounds, the scene."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from unrender.core import arrays, checks, tables
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean, in_words, listed, shorten
from unrender.io import bounded_files, confinement, parameter_values, scene_files
from unrender.io.toml_lines import FieldError
from unrender.losses import FunctionLoss, Loss
from unrender.parameterisations import Bounds, Parameterisation, Transform, check_transform
from unrender.preconditioners.base import Preconditioner, bound_to
from unrender.preconditioners.mesh import MeshTopology
from unrender.rendering.parameter_errors import ErrorMeasure
from unrender.rendering.photographs import scene_renderer
from unrender.rendering.renderer import ParameterInfo, Renderer
from unrender.rendering.tied import TiedRenderer
from unrender.rendering.worlds import worlds_of
from unrender.rendering.wrapper import layers
from unrender.scene import coarse_to_fine
from unrender.scene.bounds import angle_notice, check_bounds, move_inside, open_scale, project, truth_notice
from unrender.scene.coarse_to_fine import CoarseToFine
from unrender.scene.key_hints import instead_of, near_key
from unrender.scene.meshes import check_regularizer, check_remeshing, check_self_intersection, mesh_notices
from unrender.scene.parameter import Parameter, ParameterSettings, Unknown
from unrender.scene.prior import Prior

_RATIOS = "pictures show only the ratios of its values; the result has the initial length, errors are up to a factor"
_DEEPEST = 1 << 20
_LONGEST_KEY = 200
_SHORTEST_NORMAL = 0.1  # length of a normal map's vector below which its direction is arbitrary; it should be 1


@runtime_checkable
class _Renderer(Renderer, Protocol): ...


@runtime_checkable
class _Noticing(Protocol):
    notices: Sequence[str]


@runtime_checkable
class _Merging(Protocol):
    def merge_notices(self, tied: Sequence[AbstractSet[str]]) -> list[str]: ...


def check_max_depth(max_depth: Any) -> None:
    """Raise `FieldError` unless the argument is a maximum path length or None."""
    if max_depth is None:
        return
    whole = isinstance(max_depth, (int, np.integer)) and not isinstance(max_depth, bool)
    if not whole or max_depth < 1:
        hint = "; for Mitsuba's -1 (no limit) use a large number such as 64" if whole and max_depth == -1 else ""
        raise FieldError(("max_depth",), f"expected a whole number of at least 1, got {in_words(max_depth)}{hint}")
    if max_depth > _DEEPEST:
        raise FieldError(("max_depth",), f"expected at most {_DEEPEST}, got {shorten(hex(int(max_depth)), 60)}")


def longest_path(renderer: Renderer) -> int:
    """Return the maximum path length of a renderer in segments; 6 if it does not report one."""
    return int(getattr(scene_renderer(renderer), "max_depth", 6))


def check_loss(loss: Any) -> Loss:
    """Return a loss, made from a function if necessary. Raises `FieldError` for anything else."""
    if isinstance(loss, Loss) and not isinstance(loss, type):
        return loss
    with FieldError.at(("loss",)):
        return FunctionLoss(loss)


def check_loss_function(loss: Loss, reference: np.ndarray) -> None:
    """Raise `FieldError` for a function that is not a loss of images with the shape of `reference` (H, W, 3)."""
    if isinstance(loss, FunctionLoss):
        with FieldError.at(("loss",)):
            loss.prepare(reference)


def check_parameter(
    index: int, parameter: Parameter, known: Mapping[str, ParameterInfo], renderer: Renderer
) -> Unknown:
    """Return the `index`-th parameter with its defaults filled in. Raises `FieldError` that names the invalid field."""
    key, info = parameter.key, _known(index, parameter.key, known)

    def checking(field: str) -> AbstractContextManager[None]:
        return FieldError.at(("parameters", index, field), f"parameter {key}: {field}")

    with checking("initial"):
        start, notice = _initial(parameter, info, renderer)
        _check_vectors(start, info)
    with checking("bounds"):
        bounds, narrowed = check_bounds(parameter.bounds, info, start)
    with checking("learning_rate"):
        rate = parameter.learning_rate
        if rate is not None and (not is_number(rate) or rate <= 0):
            raise InputError(f"expected a number above 0, got {in_words(rate)}")
    parameterisation, transform = None, None
    with checking("preconditioner"):
        preconditioner = _check_preconditioner(key, parameter.preconditioner, info)
    with checking("coarse_to_fine"):
        schedule = _coarse_to_fine(parameter, info)
    initial, moved = move_inside(start, bounds, info)
    initial.flags.writeable = False
    with checking("parameterisation"):
        if parameter.parameterisation is not None:
            parameterisation, transform = _check_parameterisation(parameter.parameterisation, bounds, initial)
    with checking("regularizer"):
        mesh = None if info.moving_mesh is None else info.moving_mesh()
        regularizer = check_regularizer(parameter.regularizer, mesh)
    with checking("prior"):
        prior = None if parameter.prior is None else tables.options(Prior, parameter.prior, "{ smoothness = 0.05 }")
        known_prior = prior and prior.on(initial, info.conversion.repeated, mesh_topology(info), info.welded, bounds)
    with checking("remeshing"):
        remeshing = check_remeshing(parameter.remeshing, mesh, lambda: texture_coordinates(renderer, key, initial.size))
        _check_attributes(remeshing, key, known)
    with checking("self_intersection"):
        check_self_intersection(parameter.self_intersection, mesh)
    ratios = _RATIOS if info.role == "ratios" else ""
    changes = (f"initial {notice}" if notice else "", narrowed, *moved, angle_notice(info, start, *bounds), ratios)
    notices = [f"parameter {key}: {line}" for line in changes if line]
    notices += _at_bounds(key, parameterisation, transform, initial, bounds)
    notices += [] if mesh is None else mesh_notices(key, *mesh)
    return Unknown(
        parameter=parameter,
        initial=initial,
        bounds=bounds,
        measure=ErrorMeasure(info.role, info.conversion.repeated),
        learning_rate=rate and float(rate),
        preconditioner=preconditioner,
        parameterisation=parameterisation,
        transform=transform,
        coarse_to_fine=schedule,
        faces=None if mesh is None else np.asarray(mesh[1]).astype(np.int64).reshape(-1, 3),
        regularizer=regularizer,
        prior=known_prior,
        remeshing=remeshing,
        notices=tuple(notices),
    )


def configure(unknown: Unknown, settings: ParameterSettings, info: ParameterInfo) -> Unknown:
    """Return the unknown with those settings for which its own are None. Raises `InputError` for an unsuitable one."""
    chosen = {n: x for n, x in vars(settings).items() if x is not None}
    factor, start = chosen.pop("start_factor", None), chosen.pop("start", None)
    own = {n: x for n, x in chosen.items() if getattr(unknown.parameter, n) is None}
    changes: dict[str, Any] = dict(own)
    if factor is not None:
        changes["first"] = unknown.multiplied(factor)
    if start is not None:
        changes["first"] = unknown.placed(start)
    if "parameterisation" in own:
        with FieldError.at(("parameterisation",), f"parameter {unknown.parameter.key}: parameterisation"):
            pair = _check_parameterisation(own["parameterisation"], unknown.bounds, unknown.initial)
        changes |= {"parameterisation": pair[0], "transform": pair[1]}
    if "preconditioner" in own:
        changes["preconditioner"] = _check_preconditioner(unknown.parameter.key, own["preconditioner"], info)
    if "coarse_to_fine" in own:
        with FieldError.at(("coarse_to_fine",), f"parameter {unknown.parameter.key}: coarse_to_fine"):
            _check_resolutions(own["coarse_to_fine"], info)
    return replace(unknown, parameter=replace(unknown.parameter, **own), **changes)


def _known(index: int, key: Any, known: Mapping[str, ParameterInfo]) -> ParameterInfo:
    """Return the renderer's description of a parameter. Raises `FieldError` for a key that is unknown or cannot be recovered."""
    if not isinstance(key, str) or key not in known:
        name = key if isinstance(key, str) else in_words(key)
        raise FieldError(("parameters", index, "key"), f"the scene has no parameter {name}{near_key(name, known)}")
    if len(key) > _LONGEST_KEY:  # it becomes part of file names
        raise FieldError(
            ("parameters", index, "key"), f"{key}: expected at most {_LONGEST_KEY} characters, got {len(key)}"
        )
    info = known[key]
    if not info.differentiable and not info.perturbable:
        raise FieldError(
            ("parameters", index, "key"), f"{key} cannot be recovered: {info.reason}{instead_of(key, known)}"
        )
    return info


def _at_bounds(
    key: str, parameterisation: Any, transform: Transform | None, initial: np.ndarray, bounds: Bounds
) -> list[str]:
    """Return a notice if values start on a bound that a parameterisation leaves slowly; else an empty list."""
    count = 0 if transform is None else int(np.sum(project(initial, *bounds, open_scale(initial)) != initial))
    slowly = f"at a bound, which {type(parameterisation).__name__.lower()} leaves slowly"
    return [f"parameter {key}: {count} of {initial.size} initial values are {slowly}"] if count else []


def _check_parameterisation(
    parameterisation: Any, bounds: Bounds, initial: np.ndarray
) -> tuple[Parameterisation, Transform | None]:
    """Return a parameterisation, made from its name or table, and its φ. Raises `InputError`."""
    made = (
        tables.component(parameterisation, "parameterisation")
        if isinstance(parameterisation, (str, Mapping))
        else parameterisation
    )
    if isinstance(made, type) or not isinstance(made, Parameterisation):
        raise InputError(f"expected one of unrender.parameterisations, or its name, got {in_words(parameterisation)}")
    transform = made.transform(bounds, initial)
    if transform is not None:
        check_transform(transform, project(initial, *bounds, open_scale(initial)))
    return made, transform


def mesh_topology(info: ParameterInfo | None) -> MeshTopology | None:
    """Return the topology of the mesh whose vertices carry the parameter; None if there is none, or no parameter."""
    return None if info is None or info.mesh is None else MeshTopology.of(*info.mesh(), info.welded)


def texture_coordinates(renderer: Renderer, key: str, size: int) -> np.ndarray | None:
    """Return the texture coordinates (V, 2) of a mesh by the key of its vertex positions, which have `size` elements; None for none."""
    name = f"{key.rpartition('.')[0]}.vertex_texcoords"
    if name not in renderer.parameters():
        return None
    uv = arrays.numpy(renderer.values([name])[name]).reshape(-1, 2)
    return uv if len(uv) == size // 3 else None


_GEOMETRY = ("positions", "normals", "texcoords")


def _check_attributes(remeshing: Any, key: str, known: Mapping[str, ParameterInfo]) -> None:
    """Raise `InputError` if a mesh that will be remeshed has other values at its vertices or faces."""
    parts = [name.rpartition(".") for name in known] if remeshing is not None else []
    others = [
        name
        for owner, _, name in parts
        if owner == key.rpartition(".")[0] and name.removeprefix("vertex_") not in _GEOMETRY
    ]
    if attributes := [name for name in others if name.startswith(("vertex_", "face_"))]:
        raise InputError(
            f"its mesh has {listed(attributes)}, and new triangles would have none; remove them from its file"
        )


def _check_preconditioner(key: str, preconditioner: Any, info: ParameterInfo) -> Preconditioner | None:
    """Return the preconditioner, bound to the parameter's mesh if there is one; None for None. Raises `InputError` if it does not suit."""
    if preconditioner is None:
        return None
    if isinstance(preconditioner, type) or not isinstance(preconditioner, Preconditioner):
        raise InputError(f"expected one of unrender.preconditioners, got {in_words(preconditioner)}")
    preconditioner = bound_to(preconditioner, mesh_topology(info), info.conversion.repeated)
    try:
        preconditioner.check(key, info.shape)
    except InputError as error:
        raise InputError(str(error).removeprefix(f"{key}: preconditioner ")) from error
    return preconditioner


def _coarse_to_fine(parameter: Parameter, info: ParameterInfo) -> CoarseToFine | None:
    if parameter.coarse_to_fine is None:
        return None
    schedule = coarse_to_fine.of(parameter.coarse_to_fine)
    _check_resolutions(schedule, info)
    if parameter.preconditioner is not None:
        parameter.preconditioner.check(parameter.key, schedule.shape(info.shape, 0))
    return schedule


def _check_resolutions(schedule: CoarseToFine, info: ParameterInfo) -> None:
    if not info.resizable:
        raise InputError("its resolution is fixed; expected the data of a bitmap texture or a grid volume")
    schedule.check(info.shape)


def _initial(parameter: Parameter, info: ParameterInfo, renderer: Renderer) -> tuple[np.ndarray, str]:
    """Return the initial value, float32, and a notice of how it was converted, "" if it was not."""
    if parameter.initial is not None:
        return parameter_values.fill(parameter.initial, info.shape, info.conversion)
    # On a CPU this is the scene's own memory, which is never written to: grids and textures can be large.
    start = np.asarray(arrays.view(renderer.values([parameter.key])[parameter.key]), np.float32)
    if not np.isfinite(start).all():
        raise InputError("the scene's own value is not finite; set initial")
    return start, ""


def _check_vectors(start: np.ndarray, info: ParameterInfo) -> None:
    """Raise `InputError` for vertices at one point, a direction of length 0, or a normal map with very short vectors: derivatives grow with
    the inverse of their length."""
    if info.welded and parameter_values.at_one_point(start):
        raise InputError(f"all {start.size // 3} vertices are at one point, {start[:3]}; expected a mesh")
    if info.role == "direction" and start.shape == (3,) and not start.any():
        raise InputError("expected a vector of any length above 0, got three zeros")
    if info.role != "normal":
        return
    short = np.linalg.norm(2.0 * start.reshape(-1, 3) - 1.0, axis=-1) < _SHORTEST_NORMAL
    if short.any():
        raise InputError(
            f"{int(short.sum())} of {len(short)} normals have no direction: a value x encodes 2 x - 1, which is near zero; "
            "expected vectors of length 1, such as [0.5, 0.5, 1] for a flat surface"
        )


def check_truth(
    key: str, value: Any, known: Mapping[str, ParameterInfo], unknowns: Mapping[str, Unknown]
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the true value of an unknown, float32, and notices of how it was converted, and of values outside the bounds. Raises
    `FieldError` if it does not suit the parameter."""
    if key not in unknowns:
        raise FieldError(("truth", key), f"not one of the parameters{did_you_mean(key, unknowns)}")
    with FieldError.at(("truth", key)):
        truth, converted = parameter_values.fill(value, known[key].shape, known[key].conversion)
    notices = filter(None, (converted, truth_notice(truth, unknowns[key].bounds, known[key].conversion.half)))
    return truth, tuple(f"parameter {key}: truth {notice}" for notice in notices)


def open_renderer(scene: Any, max_depth: int | None, keys: Iterable[str] = ()) -> Renderer:
    """Return the renderer of a scene, as for `Problem`. `keys` are the parameters that will be used. Raises `FieldError`."""
    if isinstance(scene, _Renderer) and not isinstance(scene, type):
        return scene
    loaded = type(scene).__module__.partition(".")[0] == "mitsuba"
    if not isinstance(scene, (str, Path, dict)) and not callable(scene) and not loaded:
        got = type(scene).__name__
        raise FieldError(("scene",), f"expected an .xml file, a Mitsuba dictionary or a function, got {got}")
    from unrender.backend.variant import ensure

    try:
        if isinstance(scene, (str, Path)) and bounded_files.kind(Path(scene)) == "file":
            _check_files(Path(scene))
    except InputError as error:
        raise FieldError(("scene",), str(error).removeprefix("scene ")) from error
    ensure()
    from unrender.rendering.mitsuba.renderer import MitsubaRenderer

    try:
        return MitsubaRenderer(scene, max_depth, keys)
    except InputError as error:
        raise FieldError(("scene",), str(error).removeprefix("scene: ").removeprefix("scene ")) from error


def _check_files(scene: Path) -> None:
    """Raise `InputError` if an XML scene of a problem file refers to files outside of both folders.

    A scene that a script names itself is as trusted as the script.
    """
    if not confinement.is_confined():
        return
    for path in dict.fromkeys(scene_files.read(scene).named):
        confinement.check(path, [scene.absolute().parent], f"scene {scene.name}: it names")


def renderer_notices(renderer: Renderer) -> Sequence[str]:
    """Return a renderer's deviations from its scene, one line each; a renderer need not report any."""
    lines = [*renderer.notices] if isinstance(renderer, _Noticing) else []
    ties = [tie.factors for layer in layers(renderer) if isinstance(layer, TiedRenderer) for tie in layer.ties]
    tied = [factors.keys() for factors in ties if len({*factors.values()}) == 1]
    for world in worlds_of(renderer, range(len(renderer.resolutions()))):
        lines += world.renderer.merge_notices(tied) if isinstance(world.renderer, _Merging) else []
    return list(dict.fromkeys(lines))


def axis_notices(unknowns: Mapping[str, Unknown], known: Mapping[str, ParameterInfo]) -> list[str]:
    """Return a notice for each light with three unknown numbers of a rotation of which the pictures show two, its direction."""
    # The test at a run's end sees the third number, since turns about that axis are a curve of rotation vectors.
    free, counts = [key for key in unknowns if known[key].axial and unknowns[key].prior is None], Counter[str]()
    for key in free:
        counts[key if known[key].shape else key.rpartition(".")[0]] += math.prod(known[key].shape)
    return [
        f"{key}: a turn of this light about its own axis changes no picture, so only its direction is determined, not its three numbers, "
        "whatever their standard errors are; make two of them unknown, those of axes across its direction"
        for key, count in counts.items()
        if count == 3
    ]


def check_sequence(values: Any, kind: type, name: str) -> tuple[Any, ...]:
    """Return a tuple of at least one `kind`. Raises `FieldError`."""
    items = (values,) if isinstance(values, kind) else values
    if isinstance(items, (str, bytes, Mapping)) or not isinstance(items, Sequence):
        raise FieldError((name,), f"expected a list of {kind.__name__}, got {type(values).__name__}")
    if not items:
        raise FieldError((name,), f"expected at least one {kind.__name__}, got none")
    for index, item in enumerate(items):
        if not isinstance(item, kind):
            what = f"expected a {kind.__name__}, got {type(item).__name__}"
            raise FieldError((name, index), what)
    return tuple(items)


def is_number(x: Any) -> bool:
    """Return whether x is a finite real number of Python or NumPy, and no boolean."""
    return isinstance(x, (int, float, np.integer, np.floating)) and math.isfinite(checks.real(x))
