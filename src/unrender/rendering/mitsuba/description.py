"""Scene descriptions, parsed and checked before Mitsuba loads what they name.

A description may come from somebody else. So Mitsuba's own two steps, parsing and making objects, are taken one by one: between them the
types of plugins and the files that objects name are checked, names of files become absolute, and objects are made where Mitsuba finds no
plugins but its own. `mitsuba.load_file` and `mitsuba.load_dict` do both at once, with the scene's folder among the places of plugins.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi

from unrender.backend import plugins, variant
from unrender.core.errors import InputError
from unrender.core.text import one_line, shorten
from unrender.io import scene_assets, scene_files, spectrum_files

_DEEPEST = 128
_MOST_PATHS = 1 << 20
_FILE = "filename"
_RESOURCES = "resources"
_COLOURS = ("rgb", "spectrum")
_NO_PLUGINS = ("scene", "ref", *_COLOURS)
_MATERIAL = re.compile(r"[\w.+-]{1,100}")
_POINTERS = "blender"
_NEEDED = {"bitmap": (_FILE, "bitmap", "data"), "blendbsdf": ("weight",)}
"""{type: names, of which one must be given}."""


@dataclass(frozen=True)
class Parsed:
    """A description that was parsed and checked.

    Attributes:
        state: `mitsuba.parser.ParserState`; names of files that exist are absolute.
    """

    config: Any
    state: Any
    _checks: scene_assets.AssetChecks = field(default_factory=scene_assets.AssetChecks)

    def instantiate(self) -> Any:
        """The object that the description makes. Uses up `state`.

        Raises:
            InputError: a file that it names is missing, malformed or too large; an object lacks what Mitsuba needs.
        """
        for node in self.state.nodes:
            _check_complete(node.props)
            self._check_files(node.props)
        with variant.two_threads(), plugins.only(plugins.own_folder()), _printable_log():
            found = mi.parser.instantiate(self.config, self.state)
        return found[0] if isinstance(found, list) else found

    def _check_files(self, props: Any) -> None:
        plugin = props.plugin_name()
        if _is_text(props, _FILE):
            index = props["shape_index"] if plugin == "serialized" and "shape_index" in props else 0
            self._checks.check(plugin, Path(props[_FILE]), index if isinstance(index, int) else 0)
        if _is_text(props, "material") and not _MATERIAL.fullmatch(props["material"]):
            raise InputError(f"{plugin}: material: expected the name of a material, got {props['material'][:60]!r}")


def load(description: Path | Mapping[str, Any]) -> Any:
    """The object that an XML file or a dictionary describes. Shapes are not merged, so that two loads have them in the same order.

    Raises:
        InputError: see `parse` and `Parsed.instantiate`. What Mitsuba itself refuses is an exception of its own.
    """
    return parse(description).instantiate()


def parse(description: Path | Mapping[str, Any]) -> Parsed:
    """Parse an XML file or a dictionary, and resolve its references. No plugin but Mitsuba's own is loaded.

    Raises:
        InputError: its XML is malformed or includes files from outside its folder; a type is not the name of a plugin, or of one that lies
            beside the scene. What Mitsuba itself refuses is an exception of its own.
    """
    config = mi.parser.ParserConfig(variant.ensure())
    config.merge_equivalent = config.merge_meshes = config.parallel = False
    own = plugins.own_folder()
    others = [*(place for place in plugins.search_paths() if place != own), Path(), own]
    if isinstance(description, Path):
        state, search = _parse_xml(config, description)
    else:
        search = []
        given = _Dictionary(search, others).checked(description)
        with plugins.only(plugins.own_folder()), _printable_log():
            state = mi.parser.parse_dict(config, given)
    mi.parser.transform_upgrade(config, state)
    mi.parser.transform_resolve(config, state)
    _check_types({node.props.plugin_name() for node in state.nodes}, isinstance(description, Path))
    for node in state.nodes:
        _settle(node.props, [*search, *others])
    _check_paths(state.nodes)
    return Parsed(config, state)


def _parse_xml(config: Any, path: Path) -> tuple[Any, list[Path]]:
    """The parser's state, and where files are that the scene names."""
    expected = scene_files.read(path).xml
    with plugins.only(path.absolute().parent), _printable_log():
        state = mi.parser.parse_file(config, str(path.absolute()))
        search = plugins.search_paths()
    read = [Path(str(file)).resolve() for file in state.files]
    if sorted(read) != sorted(file.resolve() for file in expected):
        raise InputError(f"scene {path}: its includes cannot be followed")
    return state, search


def _check_types(names: set[str], is_file: bool) -> None:
    for name in sorted(names - set(_NO_PLUGINS)):
        plugins.check_type(name)
    if is_file and _POINTERS in names:
        raise InputError(f"type {_POINTERS}: takes addresses in memory, which no file can know")


def _check_complete(props: Any) -> None:
    """Raise `InputError` for an object without what Mitsuba needs and does not check: it would end the process."""
    plugin = props.plugin_name()
    needed = _NEEDED.get(plugin)
    if needed and not any(name in props for name in needed):
        raise InputError(f"type {plugin}: expected {' or '.join(needed)}, got none")


def _settle(props: Any, search: Sequence[Path]) -> None:
    """Make the name of an object's file absolute where there is one."""
    if _is_text(props, _FILE) and (found := scene_files.resolve(props[_FILE], search)) is not None:
        props[_FILE] = str(found.resolve())


def _check_paths(nodes: Any) -> None:
    """Raise `InputError` where there are too many ways from the scene to its objects.

    Objects that hold one another by reference twice each double them, and who walks through a scene goes all ways. There are no circles.
    """
    resolved = mi.Properties.Type.ResolvedReference
    ways: dict[int, int] = {}
    pending = [0]
    while pending:
        index = pending[-1]
        props = nodes[index].props
        held = [props[name].index() for name in props.keys() if props.type(name) == resolved]  # noqa: SIM118
        if missing := [child for child in held if child not in ways]:
            pending += missing
            continue
        ways[pending.pop()] = 1 + sum(ways[child] for child in held)
    if ways[0] > _MOST_PATHS:
        raise InputError(
            f"its objects hold one another in {shorten(str(ways[0]), 40)} ways, expected at most {_MOST_PATHS}"
        )


def _is_text(props: Any, name: str) -> bool:
    return name in props and props.type(name) == mi.Properties.Type.String


@dataclass
class _Dictionary:
    """Checks a dictionary: Mitsuba's parser looks up plugins as it goes, and reads spectra.

    Attributes:
        search: where files are that it names; its folders of resources are added.
        others: where Mitsuba looks after that.
    """

    search: list[Path]
    others: Sequence[Path]

    def checked(self, given: Mapping[str, Any], depth: int = 0) -> dict[str, Any]:
        """A copy without folders of resources, and with the names of spectra's files absolute."""
        if depth > _DEEPEST:
            raise InputError(f"nested more than {_DEEPEST} deep")
        kind = given.get("type")
        if isinstance(kind, str) and kind not in _NO_PLUGINS:
            plugins.check_type(kind)
        if kind in _COLOURS and isinstance(name := given.get(_FILE), (str, Path)):
            return {**given, _FILE: str(self._spectrum(name))}
        found = {}
        for key, value in given.items():
            if not isinstance(value, dict):
                found[key] = str(value) if key == _FILE and isinstance(value, Path) else value
            elif depth == 0 and value.get("type") == _RESOURCES:
                self._add_resources(value)
            else:
                found[key] = self.checked(value, depth + 1)
        return found

    def _add_resources(self, given: Mapping[str, Any]) -> None:
        name = str(given.get("path", ""))
        place = scene_files.resolve(name, [Path(), *self.search, *self.others])
        if place is None or not place.is_dir():
            raise InputError(f"resources: {shorten(name, 200)}: no such folder")
        self.search.insert(0, place.absolute())

    def _spectrum(self, name: str | Path) -> Path:
        found = scene_files.resolve(str(name), [*self.search, *self.others])
        if found is None:
            raise InputError(f"spectrum {shorten(str(name), 200)}: no such file")
        spectrum_files.check(found)
        return found.absolute()


@contextmanager
def _printable_log() -> Iterator[None]:
    """Let Mitsuba's messages reach the terminal in printable text alone: they quote names from files."""
    logger: Any = getattr(mi, "logger")()  # noqa: B009 (its type is unknown)
    if logger is None:  # in a thread that is not Mitsuba's
        yield
        return
    kept = [logger.appender(index) for index in range(logger.appender_count())]
    ours = _PrintableLog()
    logger.clear_appenders()
    logger.add_appender(ours)
    try:
        yield
    finally:
        logger.clear_appenders()
        for appender in kept:
            logger.add_appender(appender)


class _PrintableLog(mi.Appender):
    """Writes to standard error what Mitsuba warns of."""

    def append(self, level: Any, text: str) -> None:
        """See `mitsuba.Appender`."""
        del level
        print(one_line(" ".join(text.split())), file=sys.stderr)

    def log_progress(self, progress: float, name: str, formatted: str, eta: str, ptr: Any = None) -> None:
        """Progress of loading is not shown."""
