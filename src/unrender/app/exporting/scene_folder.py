"""Export of a scene as a folder that plain Mitsuba loads: scene.xml, the files that it refers to, and the recovered values alone."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.app.exporting import asset, ready_made, textures
from unrender.app.exporting.formats import MITSUBA, OWN
from unrender.app.exporting.formats import check as check_formats
from unrender.app.exporting.formats import write as write_formats
from unrender.app.exporting.graph import SceneGraph, reachable, store
from unrender.backend import variant
from unrender.core import arrays, checks, periodic
from unrender.core.errors import InputError, prefixed
from unrender.core.exclusive import exclusive
from unrender.io import files
from unrender.rendering.mitsuba import mesh_layout, poses
from unrender.rendering.mitsuba.description import load, parse
from unrender.rendering.mitsuba.parameters import from_tensor, to_tensor
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.mitsuba.scene_graph import ObjectGraph
from unrender.rendering.photographs import scene_renderer, scene_values
from unrender.runs import reopen
from unrender.runs.folder import reader as folders
from unrender.scene.problem import Problem
from unrender.scene.render import as_tree

SCENE = "scene.xml"
_FOLDERS = {
    mi.ObjectType.Shape: ready_made.MESHES,
    mi.ObjectType.Volume: ready_made.VOLUMES,
    mi.ObjectType.Texture: ready_made.BITMAPS,
    mi.ObjectType.Emitter: ready_made.BITMAPS,
}
_OF_SCENE = {SCENE, *_FOLDERS.values(), "files"}
_OWN = {textures.RECORD, textures.TABLE, textures.FOLDER, *_OF_SCENE, *OWN}
_SPP = 256
_POSITIONS = mesh_layout.POSITIONS
_ROUNDING = 1e-4
_INVERSE = 5e-3  # largest deviation from 1 of a matrix times its inverse: axes with three digits deviate less
_INVERSE_OF_MESH = 0.045
"""The same for meshes, rectangles and sensors, to which the inverse matters little. Axes with two digits deviate less.

An axis of (0.58, 0.58, 0.58) changes pictures of them by 0.3 %, textured spheres by 3 % and environment maps by 12 %.
"""
_OF_MATRIX = ("cube", "obj", "ply", "rectangle", "serialized")
_Maps = Mapping[str, Mapping[str, np.ndarray]]  # {name: {key: array}}, see `textures.write`


@dataclass(frozen=True)
class Exported:
    """The result of an export.

    Attributes:
        scene: the XML file; None if it was not requested, or for an emissive medium, which plain Mitsuba does not have.
        renamed: {key: key in the exported scene} of all parameters of the scene whose key differs there.
    """

    folder: Path
    scene: Path | None
    notices: tuple[str, ...]
    renamed: Mapping[str, str] = field(default_factory=dict)


@exclusive("export")
def export(
    what: str | Path | tuple[Problem, Mapping[str, np.ndarray]],
    out: str | Path,
    overwrite: bool = False,
    spp: int = _SPP,
    formats: Sequence[str] = (MITSUBA,),
) -> Exported:
    """Write a scene with its recovered parameters as a folder that plain Mitsuba loads, or for other programs.

        ur.app.export("out/indirect-room-auto", "out/room")
        ur.app.export((problem, result.parameters), "out/room-2")
        ur.app.export("out/indirect-room-auto", "out/room-3", formats=["obj", "ply"])

    The folder contains scene.xml, which refers to its textures, meshes and volumes by relative paths, and the recovered values alone as
    maps/*.exr, maps/*.png, parameters.json and parameters.csv. `mitsuba scene.xml` renders the last picture of the run, up to noise. Its
    integrator is `path`, or `volpath` with participating media, with the depth of the problem; every film has its own reconstruction
    filter. Sensors are in the order of the problem (`-s 1` selects the second). Plain Mitsuba has no emissive media, so only the
    recovered values are written for a scene with an emissive medium.

    The other formats contain meshes with base colour, roughness, metallic and normal map (`exporting.materials`), the environment map and
    the cameras. Notices list the parts of the scene that a format cannot represent.

    Args:
        what: a run folder; a problem file, for its initial values; or a problem and {key: array} of all its parameters.
        out: the new folder.
        overwrite: whether an earlier export may be replaced.
        spp: samples per pixel in scene.xml.
        formats: "mitsuba", "glb", "obj", "ply", "environment", "blender".

    Raises:
        InputError: the run folder or the problem cannot be read, `out` cannot be written, a description cannot hold a parameter, the
            scene has no mesh, a mesh with maps has no texture coordinates, or a map is too large. No files remain after an error.

    The files are on the disk when this function returns. The new export replaces an earlier one atomically. On a system that cannot
    exchange two names, the replacement takes two steps, and the next export repairs an interrupted one.
    """
    variant.ensure()
    out, formats_ = checks.path("export: out", out), check_formats(formats)
    files.check_replaceable(out, _OWN, textures.RECORD, overwrite, f"export to {out}", "an earlier export")
    problem, parameters, related, changed = _opened(what)
    renderer = scene_renderer(problem.renderer)
    if not isinstance(renderer, MitsubaRenderer):
        raise InputError(f"{problem.name}: it is not rendered by Mitsuba, so there is no scene to export")
    as_tree(problem, parameters)
    values = {key: arrays.numpy(value).astype(np.float32) for key, value in parameters.items()}
    contents = problem, renderer, values, formats_, spp, related
    notices, renamed = files.write_folder(out, lambda folder: _write(folder, *contents), f"export to {out}")
    has_scene = MITSUBA in formats_ and not renderer.pair.emissive
    return Exported(out, out / SCENE if has_scene else None, (*changed, *notices), renamed)


def _opened(
    what: str | Path | tuple[Problem, Mapping[str, np.ndarray]],
) -> tuple[Problem, Mapping[str, np.ndarray], _Maps, list[str]]:
    if isinstance(what, tuple) and len(what) == 2 and isinstance(what[0], Problem):
        return what[0], what[1], {}, []
    what = checks.path("export", what, "a run folder, a problem file, or (problem, values)")
    if what.suffix.lower() == ".toml":
        problem = Problem.from_file(what)
        return problem, problem.initial_values(), {}, []
    run = folders.read(what)
    maps = {"standard_error": run.standard_error, "data_share": run.data_share}
    problem = reopen.problem_of(what)
    return reopen.with_meshes(problem, run), run.parameters, maps, reopen.scene_changes(problem, run)


def _write(
    folder: Path,
    problem: Problem,
    renderer: MitsubaRenderer,
    values: dict[str, np.ndarray],
    formats: Sequence[str],
    spp: int,
    related: _Maps,
) -> tuple[list[str], dict[str, str]]:
    """Write the recovered values and the requested formats; return the notices and `Exported.renamed`."""
    repeated = problem.coordinates.repeated
    inner, *maps = (
        {k: periodic.interior(x, repeated.get(k, 0)) for k, x in of.items()} for of in (values, *related.values())
    )
    notices = textures.write(inner, folder, dict(zip(related, maps, strict=True)))
    others = [name for name in formats if name != MITSUBA]
    if renderer.pair.emissive:
        if others:
            raise InputError(f"{problem.name}: an emissive medium has no mesh; expected --format {MITSUBA} alone")
        why = f"no {SCENE}: plain Mitsuba has no emissive medium; the recovered values are in {textures.FOLDER}"
        return [*notices, why], {}
    of_scene = scene_values(problem.renderer, values)
    renamed = _fill(folder, renderer, of_scene, problem.max_depth, spp)
    if MITSUBA in formats:
        renamings = [
            f"{key} is called {name} in the exported scene" for key, name in renamed.items() if key in of_scene
        ]
        notices = renamings + notices
    if others:
        notices += write_formats(asset.read(folder / SCENE), folder, others)
    if MITSUBA not in formats:
        for name in _OF_SCENE:
            files.remove(folder / name)
    return notices, renamed


def _fill(
    folder: Path, renderer: MitsubaRenderer, values: dict[str, np.ndarray], max_depth: int, spp: int
) -> dict[str, str]:
    """Write scene.xml and the files that it names. Returns `Exported.renamed`."""
    graph = SceneGraph(_description(renderer.pair.description, folder))
    _check_transforms(graph.nodes, graph.names)
    described = renderer.pair.as_described()
    scene = described.scene
    moved = {key: value for key, value in values.items() if key in poses.keys(scene)}
    own = {key: described.colours.clipped(key, value) for key, value in values.items() if key not in moved}
    places = graph.places(described.parameters)
    if deformed := next((key for key in own if key not in places), None):
        raise InputError(f"parameter {deformed} cannot be exported: the scene has a sphere there, without vertices")
    for key, value in own.items():
        if (mesh := renderer.pair.replaced.get(key.rpartition(".")[0])) is not None and key.endswith(_POSITIONS):
            name = places[key].key.removesuffix(_POSITIONS)
            graph.live[f"{name}{mesh_layout.FACES}"] = mi.UInt32(mesh.faces.ravel().astype(np.uint32))
            if mesh.uv is not None:
                graph.live[f"{name}{mesh_layout.TEXCOORDS}"] = mi.Float(mesh.uv.ravel().astype(np.float32))
        live = graph.live[places[key].key]
        graph.live[places[key].key] = from_tensor(described.colours.native(key, renderer.array(value)), live)
    graph.live.update()
    for key, value in own.items():
        with prefixed(f"parameter {key} cannot be exported"):
            store(graph, places[key], value, key, folder)
    posed = [_move(graph, target, matrix) for target, matrix in poses.matrices(scene, moved).items()]
    _set_up_rendering(graph, renderer, max_depth, spp)
    _gather_files(graph, folder)
    path = folder / SCENE
    path.write_bytes(graph.xml())
    names = _verify(graph, path, {key: places[key].key for key in own}, posed)
    return {key: names[place.key] for key, place in places.items() if names[place.key] != key}


def check_transforms(scene: Path) -> None:
    """Raise `InputError` if an XML file has a transform that prevents an export of it. The scene is not loaded."""
    nodes: Any = parse(scene).state.nodes
    _check_transforms(nodes, [node.props.id() for node in nodes])


def _check_transforms(nodes: Any, names: Sequence[str]) -> None:
    """Raise `InputError` for a transform whose inverse is not that of its matrix, which is all that a file holds.

    Mitsuba makes such a transform from a rotation about an axis of another length than 1.
    """
    for index in reachable(nodes):
        props = nodes[index].props
        of_matrix = nodes[index].type == mi.ObjectType.Sensor or props.plugin_name() in _OF_MATRIX
        for name in [name for name in props.keys() if props.type(name) == mi.Properties.Type.Transform]:  # noqa: SIM118
            matrix, inverse = (np.array(x, np.float64) for x in (props[name].matrix, props[name].inverse_transpose))
            rounding = 1e-6 * np.abs(matrix).max() * np.abs(inverse).max()
            most = (_INVERSE_OF_MESH if of_matrix else _INVERSE) + rounding
            if np.abs(matrix @ inverse.T - np.eye(len(matrix))).max() > most:
                what = names[index] or f"a {props.plugin_name()}"
                raise InputError(
                    f"{what}: {name}: cannot be exported: it rotates about an axis whose length is not 1; normalise the axis"
                )


def _description(description: Any, folder: Path) -> Path | dict[str, Any]:
    """Return the XML file, or the dictionary with files in place of ready-made objects."""
    if isinstance(description, (str, Path)):
        return Path(description)
    scene, recorded = ready_made.make(description) if callable(description) else (description, [])
    return ready_made.FilesOnly(folder, recorded).dictionary(scene)


def _move(graph: SceneGraph, target: str, matrix: np.ndarray) -> int:
    """Put a pose before the `to_world` of a shape, emitter or sensor, and return which node that is."""
    kinds = mi.ObjectType.Shape, mi.ObjectType.Emitter, mi.ObjectType.Sensor
    index = next(i for kind in kinds for i in graph.of(kind) if graph.names[i] == target)
    props = graph.nodes[index].props
    # A point or a direction in world space may place an emitter instead; the sun of a sky is given in addition to its `to_world`.
    placed = [name for name in ("position", "direction", "sun_direction") if name in props]
    for name in placed:
        vector = [*np.array(props[name], float).reshape(3), 1.0 if name == "position" else 0.0]
        props[name] = type(props[name])((matrix @ vector)[:3].tolist())
    if placed in (["position"], ["direction"]):
        return index
    before = props["to_world"] if "to_world" in props else mi.ScalarTransform4d()
    before = np.array(before.matrix, float).reshape(4, 4)
    props["to_world"] = mi.ScalarTransform4d((matrix @ before).tolist())
    return index


def _set_up_rendering(graph: SceneGraph, renderer: MitsubaRenderer, max_depth: int, spp: int) -> None:
    """Set the rendering of the pictures of the run: the same path depth, independent samples, the reconstruction filters of the films."""
    masked = any(graph.nodes[index].props.plugin_name() == "mask" for index in graph.used())
    # `path` drops light of masks, see `light_paths.mask_notices`, and `prb` does not support hide_emitters.
    surfaces = "prb" if masked and not renderer.light_paths.hide_emitters else "path"
    integrator = graph.child(0, mi.ObjectType.Integrator, "volpath" if renderer.pair.volumetric else surfaces)
    integrator["max_depth"], integrator["rr_depth"] = max_depth, renderer.light_paths.rr_depth
    if renderer.light_paths.hide_emitters:
        integrator["hide_emitters"] = True
    films = {sensor.id(): sensor.film() for sensor in graph.sensors()}
    # Of the references, which stages compare with this scene.
    formats = dict(zip(films, renderer.formats()[: len(films)], strict=True))
    for index in graph.of(mi.ObjectType.Sensor):
        graph.child(index, mi.ObjectType.Sampler, "independent")["sample_count"] = spp
        film = films[f"n{index}"]
        rfilter = graph.descendant(index, mi.ObjectType.Film, mi.ObjectType.ReconstructionFilter)
        props = graph.child(index, mi.ObjectType.Film, "hdrfilm")
        for axis, (size, part, offset) in enumerate(
            (("width", "crop_width", "crop_offset_x"), ("height", "crop_height", "crop_offset_y"))
        ):
            props[size] = int(film.size()[axis])
            if tuple(film.size()) != tuple(film.crop_size()):
                props[part], props[offset] = int(film.crop_size()[axis]), int(film.crop_offset()[axis])
        props["pixel_format"], props["component_format"] = formats[f"n{index}"].colour, "float32"
        props["sample_border"] = bool(film.sample_border())
        if rfilter is not None:
            props["rfilter"] = mi.Properties.ResolvedReference(rfilter)


def _gather_files(graph: SceneGraph, folder: Path) -> None:
    taken: dict[Path, str] = {}
    for index in sorted(graph.used()):
        node = graph.nodes[index]
        if "filename" not in node.props:
            continue
        path = Path(node.props["filename"])
        if path not in taken:
            if path.is_relative_to(folder):
                taken[path] = path.relative_to(folder).as_posix()
            else:
                kind = _FOLDERS.get(node.type, "files")
                name = f"{ready_made.file_name(path.stem)}{path.suffix}"
                if (folder / kind / name).exists():
                    name = f"{ready_made.file_name(path.stem)}-{index}{path.suffix}"
                (folder / kind).mkdir(exist_ok=True)
                shutil.copyfile(path, folder / kind / name)
                taken[path] = f"{kind}/{name}"
        node.props["filename"] = taken[path]
    for path in folder.glob("*/*"):  # files that a recovered value replaces
        if path.parent.name != textures.FOLDER and path.relative_to(folder).as_posix() not in taken.values():
            path.unlink()


def _verify(graph: SceneGraph, path: Path, recovered: Mapping[str, str], posed: list[int]) -> dict[str, str]:
    """Load the exported scene, and raise `InputError` if its values are not those of the live scene.

    `recovered` are {key of a parameter: key in the live scene}, and `posed` the nodes that moved in the exported scene alone. Returns {key
    in the live scene: key in the exported scene}.
    """
    try:
        written = ObjectGraph(load(path)).parameters()
    except Exception as error:
        raise InputError(
            f"export: Mitsuba refuses the scene that was written: {' '.join(str(error).split())[:400]}"
        ) from error
    ends = [[key.rpartition(".")[2] for key in scene.properties] for scene in (graph.live, written)]
    if ends[0] != ends[1]:
        raise InputError("export: the scene that was written has other parameters than the one it was made of")
    names = dict(zip(graph.live.properties, written.properties, strict=True))
    keys = {own: key for key, own in recovered.items()}
    moved = tuple(f"n{index}." for index in posed)
    for own, name in names.items():
        if own.startswith(moved):
            continue
        try:
            before, after = (to_tensor(scene[key]).numpy() for scene, key in ((graph.live, own), (written, name)))
        except TypeError:  # no array, such as a transformation
            continue
        key = keys.get(own, name)
        scale = max(1.0, float(np.max(np.abs(before), initial=0)))
        if before.shape != after.shape or not np.allclose(before, after, rtol=0, atol=_ROUNDING * scale):
            raise InputError(f"parameter {key} cannot be exported: the scene that was written has another value")
    return names
