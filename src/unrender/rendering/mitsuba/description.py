"""Scene descriptions, parsed and checked before Mitsuba instantiates them.

A description may come from an untrusted source. Mitsuba's two steps, parsing and instantiation, therefore run separately. In between,
the plugin types and the files that objects name are checked, and file names become absolute. Instantiation only finds Mitsuba's own
plugins. `mitsuba.load_file` and `mitsuba.load_dict` run both steps at once, and add the scene's folder to the plugin search path.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.backend import plugins, variant
from unrender.core.errors import InputError
from unrender.core.text import one_line, shorten
from unrender.io import scene_files
from unrender.rendering.mitsuba.film_response import is_spectral

_DEEPEST = 128
_MOST_PATHS = 1 << 20
_FILE = "filename"
_RESOURCES = "resources"
_COLOURS = ("rgb", "spectrum")
_NO_PLUGINS = ("scene", "ref", *_COLOURS)
_MATERIAL = re.compile(r"[\w.+-]{1,100}")
_POINTERS = "blender"
_NEEDED = {"bitmap": (_FILE, "bitmap", "data"), "blendbsdf": ("weight",)}
"""{type: properties, one of which is required}."""


@dataclass(frozen=True)
class Parsed:
    """A description that was parsed and checked, as `mitsuba.parser.ParserConfig` and `ParserState`; names of existing files are
    absolute."""

    config: Any
    state: Any
    _unread: Sequence[Sequence[str]]
    _checks: scene_files.AssetChecks = field(default_factory=scene_files.AssetChecks)

    def instantiate(self) -> Any:
        """Return the object that the description defines. This consumes `state`.

        Raises:
            InputError: a file that it names is missing, malformed or too large, or an object lacks a property that Mitsuba needs.
            RuntimeError: Mitsuba's refusals, such as of a property that its plugin does not know.
        """
        for node in self.state.nodes:
            _check_complete(node.props)
            self._check_files(node.props)
        # Readers of the description mark what they read, and Mitsuba refuses only properties that nobody has read.
        for node, names in zip(self.state.nodes, self._unread, strict=True):
            for name in names:
                node.props.mark_queried(name, False)
        files = [node.props[_FILE] for node in self.state.nodes if _is_text(node.props, _FILE)]
        with variant.two_threads(*files), plugins.only(plugins.own_folder()), _printable_log():
            result = mi.parser.instantiate(self.config, self.state)
        return result[0] if isinstance(result, list) else result

    def _check_files(self, props: Any) -> None:
        plugin = props.plugin_name()
        if _is_text(props, _FILE):
            index = props["shape_index"] if plugin == "serialized" and "shape_index" in props else 0
            self._checks.check(plugin, Path(props[_FILE]), index if isinstance(index, int) else 0)
        if _is_text(props, "material") and not _MATERIAL.fullmatch(props["material"]):
            raise InputError(f"{plugin}: material: expected the name of a material, got {props['material'][:60]!r}")


def load(description: Path | Mapping[str, Any]) -> Any:
    """Return the object that an XML file or a dictionary describes. Shapes are not merged, so two loads have them in the same order.

    Raises:
        InputError: see `parse` and `Parsed.instantiate`. Mitsuba's own refusals have their original type.
    """
    return parse(description).instantiate()


def parse(description: Path | Mapping[str, Any]) -> Parsed:
    """Parse an XML file or a dictionary, and resolve its references. Only Mitsuba's own plugins are loaded.

    Raises:
        InputError: the XML is malformed or includes files from outside its folder; or a type is not the name of a plugin, or names a
            plugin in the scene's folder. Mitsuba's own refusals have their original type.
    """
    config = mi.parser.ParserConfig(variant.ensure())
    config.merge_equivalent = config.merge_meshes = config.parallel = False
    own = plugins.own_folder()
    others = [*(place for place in plugins.search_paths() if place != own), Path(), own]
    if isinstance(description, Path):
        state, search = _parse_xml(config, description)
    else:
        search = []
        dictionary = _Dictionary(search, others).checked(description)
        with plugins.only(plugins.own_folder()), _printable_log():
            state = mi.parser.parse_dict(config, dictionary)
    mi.parser.transform_upgrade(config, state)
    mi.parser.transform_resolve(config, state)
    unread = [node.props.unqueried() for node in state.nodes]
    _check_types({node.props.plugin_name() for node in state.nodes}, isinstance(description, Path))
    for node in state.nodes:
        _settle(node.props, [*search, *others])
    _check_paths(state.nodes)
    return Parsed(config, state, unread)


def _parse_xml(config: Any, path: Path) -> tuple[Any, list[Path]]:
    """Return the parser's state, and the search path of the files that the scene names."""
    expected = scene_files.read(path).xml
    with plugins.only(path.absolute().parent), _printable_log():
        state = mi.parser.parse_file(config, str(path.absolute()))
        search = plugins.search_paths()
    read = [Path(str(file)).resolve() for file in state.files]
    if sorted(read) != sorted(file.resolve() for file in expected):
        raise InputError(f"scene {path}: its includes cannot be resolved")
    return state, search


def _check_types(names: set[str], is_file: bool) -> None:
    for name in sorted(names - set(_NO_PLUGINS)):
        plugins.check_type(name)
    if is_file and _POINTERS in names:
        raise InputError(f"type {_POINTERS}: needs memory addresses, which a file cannot contain; remove it")


def _check_complete(props: Any) -> None:
    """Raise `InputError` for an object without a property that Mitsuba needs but does not check: it would abort the process."""
    plugin = props.plugin_name()
    needed = _NEEDED.get(plugin)
    if needed and not any(name in props for name in needed):
        raise InputError(f"type {plugin}: expected {' or '.join(needed)}, got none")


def _settle(props: Any, search: Sequence[Path]) -> None:
    """Make the file name of an object absolute if the file exists."""
    if _is_text(props, _FILE) and (resolved := scene_files.resolve(props[_FILE], search)) is not None:
        props[_FILE] = str(resolved.resolve())


def _check_paths(nodes: Any) -> None:
    """Raise `InputError` if there are too many paths from the scene to its objects.

    Objects that reference each other twice double the number of paths at each level, and a traversal follows every path. There are no
    cycles.
    """
    paths: dict[int, int] = {}
    pending = [0]
    while pending:
        index = pending[-1]
        props = nodes[index].props
        held = [child for _, child in references(props)]
        if missing := [child for child in held if child not in paths]:
            pending += missing
            continue
        paths[pending.pop()] = 1 + sum(paths[child] for child in held)
    if paths[0] > _MOST_PATHS:
        raise InputError(
            f"its objects reference one another along {shorten(str(paths[0]), 40)} paths, expected at most {_MOST_PATHS}"
        )


def references(props: Any) -> list[tuple[str, int]]:
    """Return (property, index of the node) for each object that an object holds."""
    resolved = mi.Properties.Type.ResolvedReference
    return [(name, props[name].index()) for name in props.keys() if props.type(name) == resolved]  # noqa: SIM118


def _is_text(props: Any, name: str) -> bool:
    return name in props and props.type(name) == mi.Properties.Type.String


@dataclass
class _Dictionary:
    """Checker of a scene dictionary, whose files are searched in `search`, to which its resource folders are added, then in `others`."""

    search: list[Path]
    others: Sequence[Path]

    def checked(self, description: Mapping[str, Any], depth: int = 0) -> dict[str, Any]:
        """Return a copy without resource folders and with absolute file names of spectra."""
        if depth > _DEEPEST:
            raise InputError(f"nested more than {_DEEPEST} deep")
        kind = description.get("type")
        if isinstance(kind, str) and kind not in _NO_PLUGINS:
            plugins.check_type(kind)
        if kind in _COLOURS and isinstance(name := description.get(_FILE), (str, Path)):
            return {**description, _FILE: str(self._spectrum(name))}
        result = {}
        for key, value in description.items():
            if not isinstance(value, dict):
                result[key] = str(value) if key == _FILE and isinstance(value, Path) else _copied(value, description)
            elif depth == 0 and value.get("type") == _RESOURCES:
                self._add_resources(value)
            else:
                result[key] = self.checked(value, depth + 1)
        return result

    def _add_resources(self, resources: Mapping[str, Any]) -> None:
        name = str(resources.get("path", ""))
        place = scene_files.resolve(name, [Path(), *self.search, *self.others])
        if place is None or not place.is_dir():
            raise InputError(f"resources: {shorten(name, 200)}: no such folder")
        self.search.insert(0, place.absolute())

    def _spectrum(self, name: str | Path) -> Path:
        path = scene_files.resolve(str(name), [*self.search, *self.others])
        if path is None:
            raise InputError(f"spectrum {shorten(str(name), 200)}: no such file")
        scene_files.check_spectrum(path)
        return path.absolute()


def _copied(value: Any, owner: Mapping[str, Any]) -> Any:
    """Return a copy of a bitmap or tensor, because Mitsuba empties tensors, and in spectral variants overwrites bitmaps with coefficients.

    Raises `InputError` for a bitmap of colours that another load has overwritten, and for a tensor of colours, which Mitsuba would take for
    coefficients.
    """
    colours = is_spectral() and owner.get("type") == "bitmap" and not owner.get("raw", False)
    if dr.is_tensor_v(value):
        if colours and value.shape[-1:] == (3,):
            raise InputError(
                "bitmap: spectral variants take data for coefficients of spectra; give bitmap = mitsuba.Bitmap(...)"
            )
        return type(value)(value)
    if not isinstance(value, mi.Bitmap):
        return value
    if colours and np.array(value, copy=False).min(initial=0) < 0:
        raise InputError(
            "bitmap: colours below 0, such as the coefficients with which mitsuba.load_dict overwrites a bitmap in spectral variants; "
            "make a new mitsuba.Bitmap for each load"
        )
    return mi.Bitmap(value)


@contextmanager
def _printable_log() -> Iterator[None]:
    """Redirect Mitsuba's messages to a logger that only prints printable text, since they quote names from files."""
    logger: Any = getattr(mi, "logger")()  # noqa: B009 (its type is unknown)
    if logger is None:  # in a thread that is not Mitsuba's
        yield
        return
    appenders = [logger.appender(index) for index in range(logger.appender_count())]
    ours = _PrintableLog()
    logger.clear_appenders()
    logger.add_appender(ours)
    try:
        yield
    finally:
        logger.clear_appenders()
        for appender in appenders:
            logger.add_appender(appender)


class _PrintableLog(mi.Appender):
    """Appender that writes Mitsuba's messages to standard error."""

    def append(self, level: Any, text: str) -> None:
        print(one_line(" ".join(text.split())), file=sys.stderr)

    def log_progress(self, progress: float, name: str, formatted: str, eta: str, ptr: Any = None) -> None:
        """Ignore the progress of loading."""


Recorded = list[tuple[Any, dict[str, Any]]]

_recorded: ContextVar[Recorded | None] = ContextVar("recorded", default=None)


def load_described(description: dict[str, Any]) -> Any:
    """Return `mitsuba.load_dict(description)`. Inside `recorded_descriptions`, record the object with its description."""
    result = mi.load_dict(description)
    recorded = _recorded.get()
    if recorded is not None:
        recorded.append((result, description))
    return result


@contextmanager
def recorded_descriptions() -> Iterator[Recorded]:
    """Yield a list of (object, description), which collects every object that `load_described` makes inside the context.

    The list keeps the objects alive; discard it early. Mitsuba objects outside the scenes of a run prevent Dr.Jit from freezing kernels.
    """
    recorded: Recorded = []
    token = _recorded.set(recorded)
    try:
        yield recorded
    finally:
        _recorded.reset(token)
