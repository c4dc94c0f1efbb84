"""Loading of scene descriptions, with one-line errors; and equal objects of a description.

`mi.load_file` and `mi.load_dict` merge equal objects unless `optimize=False`. One key then changes several objects; here each object has
its own key. References that were rendered by setting such a key in a merged scene show a different scene.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.backend import variant
from unrender.core.errors import InputError
from unrender.io import bounded_files
from unrender.io.parameter_values import PLAIN, FileConversion
from unrender.io.volumes import read_grid
from unrender.rendering.mitsuba import description as loading
from unrender.rendering.mitsuba import emissive
from unrender.rendering.mitsuba.description import parse, references
from unrender.rendering.mitsuba.scene_graph import all_shapes
from unrender.rendering.mitsuba.spectral_colours import is_raw

SceneDescription = str | Path | dict | Callable[[], Any] | Any
"""An XML file, a Mitsuba dictionary, a function that returns one, or a loaded `mi.Scene`, which has one state only.

The function is called twice, so that ready-made objects such as meshes are created twice."""


def load(description: SceneDescription) -> mi.Scene:
    """Return a Mitsuba scene, without merged meshes: two loads have their shapes in one order. Raises `InputError` in one line."""
    return load_resolved(description)[0]


def is_loaded(description: SceneDescription) -> bool:
    """Return whether it is a loaded scene, of any variant, instead of a description."""
    return type(description).__module__.partition(".")[0] == "mitsuba" and type(description).__name__ == "Scene"


def load_resolved(description: SceneDescription) -> tuple[mi.Scene, Path | dict, tuple[Equal, ...]]:
    """Return a Mitsuba scene, what it was loaded from, and its `equal_objects`.

    The second item is the file's path, or the dictionary without data (`_outline`). It is empty for a scene that the user has loaded.
    """
    variant.ensure()
    emissive.register()
    if is_loaded(description):
        return _checked_scene(description), {}, ()
    if callable(description):
        description = description()
    name = str(description) if isinstance(description, (str, Path)) else "dictionary"
    try:
        if isinstance(description, (str, Path)):
            path = Path(description)
            if bounded_files.kind(path) != "file":
                raise InputError(f"scene {path}: {bounded_files.no_file(path)}")
            parsed = loading.parse(path)
        elif isinstance(description, dict):
            parsed = loading.parse(description)
        else:
            raise InputError(f"scene: expected an .xml path or a Mitsuba dictionary, got {type(description).__name__}")
        equal = equal_objects(parsed.state.nodes)
        scene = parsed.instantiate()
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith("scene") else f"scene {name}: {text}") from error
    except Exception as error:
        raise InputError(f"scene {name}: Mitsuba could not load it: {_one_line(error)}") from error
    if not isinstance(scene, mi.Scene):
        raise InputError(f"scene: the description makes a {type(scene).__name__}, not a scene")
    outline = _outline(description) if isinstance(description, dict) else Path(description)
    return _with_sensor(scene), outline, equal


def load_sensors(description: SceneDescription) -> Iterator[list[mi.Sensor]]:
    """Yield new sensors of a description that is known to load, without the rest of its scene.

    A function is called again only if what it returned holds ready-made sensors or films, which two sensors cannot share.
    """
    used: list[Any] = []
    described: Any = description() if callable(description) else description
    while True:
        parsed = loading.parse(described if isinstance(described, dict) else Path(described))
        nodes = parsed.state.nodes
        for name, child in references(nodes[0].props):
            if nodes[child].type != mi.ObjectType.Sensor:
                del nodes[0].props[name]
        sensors = list(parsed.instantiate().sensors())
        parts = [part for sensor in sensors for part in (sensor, sensor.film())]
        if callable(description) and any(part is other for part in parts for other in used):
            described, used = description(), []
            continue
        used += parts
        yield sensors


def _outline(description: dict[str, Any]) -> dict[str, Any]:
    """Return a dictionary without the grids, bitmaps and arrays that it passes to plugins: the scene has copies of them."""
    nested = {key: _outline(value) if isinstance(value, dict) else value for key, value in description.items()}
    return {key: value for key, value in nested.items() if not _is_data(value)}


def _is_data(value: Any) -> bool:
    large = isinstance(value, np.ndarray) and value.size > 16  # larger than a transform
    return large or isinstance(value, (mi.VolumeGrid, mi.Bitmap)) or dr.is_tensor_v(value)


def _checked_scene(scene: Any) -> mi.Scene:
    if not isinstance(scene, mi.Scene):
        raise InputError(
            f"scene: it was loaded under another variant than {mi.variant()}; call unrender.use() before loading it"
        )
    return _with_sensor(scene)


def _with_sensor(scene: mi.Scene) -> mi.Scene:
    if not scene.sensors():
        raise InputError("scene: it has no sensor; add one")
    return scene


def _one_line(error: Exception) -> str:
    if own := re.search(r"InputError: (.+)", str(error)):  # from a plugin of this package, within Mitsuba's traceback
        return own[1]
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines)[:400] or type(error).__name__


def media(scene: mi.Scene) -> list[mi.Medium]:
    """Return all participating media of a scene, once for each attachment, in an order that two loads share."""
    return [medium for _, medium in attached_media(scene)]


MediumKey = tuple[str, str, int]
"""(id of a shape or sensor, "interior", "exterior" or "medium", number of earlier entries of the same name).

The number is needed since shapes of an XML file may have no id."""


def attached_media(scene: mi.Scene) -> list[tuple[MediumKey, Any]]:
    """Return all participating media of a scene, once for each shape side or sensor that has one, in an order that two loads share."""
    shapes, sensors = all_shapes(scene), scene.sensors()
    entries = [
        ((shape.id(), side), medium)
        for shape in shapes
        for side, medium in (("interior", shape.interior_medium()), ("exterior", shape.exterior_medium()))
    ]
    entries += [((sensor.id(), "medium"), sensor.get_medium()) for sensor in sensors]
    return _numbered((owner, medium) for owner, medium in entries if medium is not None)


def _numbered(slots: Iterable[tuple[tuple[str, str], Any]]) -> list[tuple[MediumKey, Any]]:
    before: Counter[tuple[str, str]] = Counter()
    result = []
    for owner, medium in slots:
        result.append(((*owner, before[owner]), medium))
        before[owner] += 1
    return result


def extinction_transforms(description: Path | Mapping[str, Any]) -> dict[MediumKey, np.ndarray]:
    """Return the affine map (4, 4) from [0, 1]³ to the world of each medium's extinction grid, of a valid description. Media and volumes
    that are ready-made objects are omitted."""
    nodes: Any = parse(description).state.nodes
    top = list(_children(nodes, nodes[0]).values())
    groups = [node for node in top if node.props.plugin_name() == "shapegroup"]
    slots = []
    for node in (*top, *(child for group in groups for child in _children(nodes, group).values())):
        if node.type in (mi.ObjectType.Shape, mi.ObjectType.Sensor):
            for name, child in _children(nodes, node).items():
                side = name if node.type == mi.ObjectType.Shape else "medium"
                # The parser does not know the type of media that are plugins in Python.
                if child.type == mi.ObjectType.Medium or side in ("interior", "exterior") or "sigma_t" in child.props:
                    owner = node.props.id(), side
                    slots.append((owner, _transform(nodes, child)))
    return {key: matrix for key, matrix in _numbered(slots) if matrix is not None}


def _children(nodes: Any, node: Any) -> dict[str, Any]:
    return {name: nodes[index] for name, index in references(node.props)}


def _transform(nodes: Any, medium: Any) -> np.ndarray | None:
    volume = _children(nodes, medium).get("sigma_t")
    if volume is None or volume.props.plugin_name() != "gridvolume":
        return None
    props = volume.props
    to_world = np.eye(4)
    if "to_world" in props:
        to_world = np.array(props["to_world"].matrix, np.float64).reshape(4, 4)
    if props.get("use_grid_bbox", False) and "filename" in props:
        try:
            box = np.array(read_grid(props["filename"]).box).reshape(2, 3)
        except InputError:  # Mitsuba finds the file on another search path
            return None
        place = np.eye(4)
        place[:3, :3], place[:3, 3] = np.diag(box[1] - box[0]), box[0]
        return to_world @ place
    return to_world


_ENVIRONMENT_COLUMNS = 1
"""Columns that Mitsuba adds at each end of an environment map, and recomputes whenever its data change."""
_SHAPE_OPTIONS = ("to_world", "face_normals", "flip_normals", "flip_tex_coords")
_INDEXED = "serialized"


def conversion(parameters: mi.SceneParameters, key: str, description: SceneDescription) -> FileConversion:
    """Return how Mitsuba converts a file to the values of the array `key`. Shapes of the description place the vertices of mesh files."""
    value, node = parameters[key], parameters.properties[key][2]
    if isinstance(node, mi.Mesh) and key.rpartition(".")[2].startswith(("vertex_", "face_")):
        return FileConversion(vertices=partial(read_vertices, description, key))
    if not key.endswith("data") or not dr.is_tensor_v(value):
        return PLAIN
    columns = _ENVIRONMENT_COLUMNS if node.class_name() == "EnvironmentMapEmitter" else 0
    raw = is_raw(node)
    return FileConversion(raw, dr.type_v(value) == dr.VarType.Float16, columns)


def read_vertices(description: SceneDescription, key: str, path: Path) -> np.ndarray:
    """Return values at the vertices of a mesh file, as if the scene's shape referenced that file.

    Mitsuba loads the file with the shape's transform, its own order of vertices, and the duplicates that it makes for normals and
    texture coordinates.

    Args:
        key: such as "block.vertex_positions".
        path: an .obj, .ply or .serialized file.

    Returns:
        (n V,) float32.

    Raises:
        InputError: the file cannot be read or has no such values, or the scene does not state how its shape is placed.
    """
    if bounded_files.kind(path) != "file":
        raise InputError(f"{path}: {bounded_files.no_file(path)}")
    owner, _, name = key.rpartition(".")
    resolved: Any = description() if callable(description) else description
    if is_loaded(resolved):
        raise InputError(
            f"{path}: a loaded scene does not expose the transforms of its shapes; give the .xml file or an array"
        )
    parsed = loading.parse(Path(resolved) if isinstance(resolved, (str, Path)) else resolved)
    # A shape of a group has the key "group.shape", and its own id alone in XML.
    known = [[n.props for n in parsed.state.nodes if n.props.id() == i] for i in (owner, owner.rpartition(".")[2])]
    (shape,) = next((found for found in known if len(found) == 1), [None])
    if shape is None:
        raise InputError(f"{path}: the scene's description has no shape named {owner}; give an array")
    plugin = path.suffix.lower().removeprefix(".")
    named: dict[str, Any] = {"type": plugin, "filename": str(path.resolve())}
    named |= {option: shape[option] for option in _SHAPE_OPTIONS if option in shape}
    if plugin == _INDEXED and "shape_index" in shape:
        named["shape_index"] = shape["shape_index"]
    try:
        values = mi.traverse(loading.load(named))
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    except RuntimeError as error:
        raise InputError(f"{path}: Mitsuba could not load it: {' '.join(str(error).split())[:200]}") from error
    if name not in values:
        raise InputError(f"{path}: the mesh has no {name}")
    return np.array(values[name], np.float32).reshape(-1)


_MERGED = ("BSDF", "Texture", "Volume", "Medium", "PhaseFunction")
_NUMBERS = ("Float", "Integer", "Bool", "Vector", "Color")


Equal = tuple[tuple[str, ...], ...]
"""The names of each of several equal objects."""


def equal_objects(nodes: Sequence[Any]) -> tuple[Equal, ...]:
    """Return the objects that Mitsuba merges with equal ones, one tuple per set. An object that is held by reference counts once.

    Each object is the tuple of its names: the one of `_name`, and one for each slot that holds it.
    """
    contents: dict[int, Any] = {}
    order = _from_scene(nodes)
    names = {index: [name] for index, name in order}
    for index, name in order:
        for prop, child in references(nodes[index].props):
            names[child].append(f"{name}.{prop}" if name else prop)
    for index, _ in reversed(order):
        contents[index] = _content(nodes[index], contents, index)
    groups: dict[Any, list[tuple[str, ...]]] = {}
    for index, own in names.items():
        if _kind(nodes[index]) in _MERGED:
            groups.setdefault(contents[index], []).append(tuple(dict.fromkeys(own)))
    return tuple(tuple(sorted(equal)) for equal in groups.values())


def merge_notices(keys: Iterable[str], equal: Sequence[Equal], tied: Sequence[AbstractSet[str]]) -> list[str]:
    """Return one notice for each unknown whose object has `equal_objects`; parameters that equal one another share it.

    None if one of the sets `tied` of parameters that have one value contains all of them: one unknown then changes them all here, too.
    """
    notices: list[str] = []
    named: set[str] = set()
    for key in keys:
        holders = [
            (name, objects) for objects in equal for names in objects for name in names if key.startswith(f"{name}.")
        ]
        own, objects = max(holders, key=lambda holder: len(holder[0]), default=("", ()))
        rest, with_it = key.removeprefix(own), next((one for one in tied if key in one), {key})
        others = [names[0] for names in objects if own not in names and with_it.isdisjoint(n + rest for n in names)]
        if not others or key in named:
            continue
        named.update(f"{name}{rest}" for names in objects for name in names)
        more = f" and {len(others) - 1} more" if len(others) > 1 else ""
        notices.append(
            f"{key}: {own} equals {others[0]}{more}, and Mitsuba merges equal objects, so that one key changes them all. Here {key} and "
            f"{others[0]}{rest} are separate; load the scene of references with optimize=False"
        )
    return notices


def _from_scene(nodes: Sequence[Any]) -> list[tuple[int, str]]:
    """Return (index, name) of all objects of the scene, each after those that hold it."""
    names: dict[int, str] = {}
    pending = [(0, "")]
    while pending:
        index, name = pending.pop()
        names.pop(index, None)
        names[index] = name
        for number, (prop, child) in enumerate(references(nodes[index].props)):
            pending.append((child, _name(nodes[child], name, prop, nodes[index].props.plugin_name(), number)))
    return list(names.items())


def _name(node: Any, holder: str, prop: str, plugin: str, number: int) -> str:
    """Return the name that `mi.traverse` uses: the object's own id, or else the name of its holder, whose child `number` it is."""
    own = node.props.id()
    if not holder or (own and own != prop and not own.startswith("_")):
        return own or prop
    if plugin == "twosided":
        prop = f"brdf_{number}"
    elif prop.startswith("_"):
        prop = _kind(node).lower()
    return f"{holder}.{prop}{'_medium' if prop in ('interior', 'exterior') else ''}"


def _kind(node: Any) -> str:
    return str(node.type).rpartition(".")[2]


def _content(node: Any, contents: dict[int, Any], index: int) -> Any:
    """Return a hashable description of an object. A value that cannot be compared is replaced by the object's unique index."""
    values = []
    props = node.props
    for name in sorted(props.keys()):
        kind = str(props.type(name)).rpartition(".")[2]
        value = props[name]
        if kind == "ResolvedReference":
            values.append((name, contents.get(value.index(), index)))
        elif kind in _NUMBERS:
            values.append((name, np.asarray(value, np.float64).tobytes()))
        elif kind == "Transform":
            values.append((name, np.asarray(value.matrix, np.float64).tobytes()))
        else:
            values.append((name, value if kind == "String" else index))
    return _kind(node), props.plugin_name(), tuple(values)
