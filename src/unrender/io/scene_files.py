"""Files of a Mitsuba scene: their list, confinement of its XML to the scene's folder, and checks of kind, size and agreement with headers.

Mitsuba reads whatever an XML file includes. An untrusted scene must not be able to have other files of this machine parsed. So this
module follows includes first, as Mitsuba will, and requires that they stay in the scene's folder. It does not restrict
textures and meshes: no message shows their contents, and `confinement` restricts those of untrusted scenes.
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import IO, Any
from xml.parsers import expat

from unrender.core.errors import InputError, prefixed
from unrender.core.text import shorten
from unrender.io import bounded_files, image_size, mesh_files, volumes

MOST_VALUES = 1 << 30
"""Largest number of values of all images and grids of a scene."""
_LARGEST_ASSET = 1 << 32


@dataclass
class AssetChecks:
    """Checks of the files of one scene, and the number of values of its images and grids so far."""

    values: int = 0

    def check(self, plugin: str, path: Path, index: int = 0) -> None:
        """Check a file that an object of type `plugin` refers to, with its `shape_index`, and add its values to `values`. Raises
        `InputError`."""
        if (kind := bounded_files.kind(path)) != "file":
            raise InputError(f"{shorten(str(path), 200)}: {_KINDS_OF_PATHS[kind]}")
        if plugin == "serialized":
            mesh_files.check_serialized(path, index)
        else:
            self.values += _CHECKS.get(plugin, _plain)(path) or 0
        if self.values > MOST_VALUES:
            raise InputError(f"{path}: with it the scene's pictures and grids have more than {MOST_VALUES} values")


_KINDS_OF_PATHS = {"": "no such file", "folder": "a folder, expected a file", "other": "not a regular file"}


def _picture(path: Path) -> int:
    with prefixed(path):
        return image_size.check(path)


def _plain(path: Path) -> None:
    size = path.stat().st_size
    if size > _LARGEST_ASSET:
        raise InputError(f"{path}: larger than {_LARGEST_ASSET >> 30} GiB")


_CHECKS: dict[str, Callable[[Path], int | None]] = {
    **dict.fromkeys(("bitmap", "envmap"), _picture),
    **dict.fromkeys(("gridvolume", "sdfgrid"), volumes.check_vol),
    **dict.fromkeys(("ellipsoids", "ellipsoidsmesh"), partial(mesh_files.check_ply, splats=True)),
    **dict.fromkeys(("measured", "measured_polarized"), lambda path: check_tensors(path)),
    "ply": mesh_files.check_ply,
    "obj": mesh_files.check_obj,
    "spectrum": lambda path: check_spectrum(path),
}

_MAGIC = b"tensor_file"
_MOST_FIELDS, _MOST_AXES = 1000, 16
_BYTES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 8, 8: 8, 9: 2, 10: 4, 11: 8}
"""Bytes per number of each type: integers of 8 to 64 bits, signed and unsigned; float16, float32, float64."""


def check_tensors(path: Path) -> None:
    """Raise `InputError` unless all tensors of a file are inside of it."""
    try:
        with bounded_files.open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            if file.read(12).rstrip(b"\0") != _MAGIC:
                raise ValueError("no tensor file")
            _, fields = _unpack(file, "<HI")
            if fields > _MOST_FIELDS:
                raise ValueError("too many tensors")
            for _ in range(fields):
                _check_field(file, size)
    except (struct.error, ValueError, KeyError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a tensor file that can be read ({error})") from error


def _check_field(file: IO[bytes], size: int) -> None:
    (length,) = _unpack(file, "<H")
    file.read(length)
    axes, kind, offset = _unpack(file, "<HBQ")
    if axes > _MOST_AXES:
        raise ValueError("too many axes")
    shape = _unpack(file, f"<{axes}Q")
    if offset + math.prod(shape) * _BYTES[kind] > size:
        raise ValueError("a tensor that leads out of the file")


def _unpack(file: IO[bytes], form: str) -> tuple[int, ...]:
    return struct.unpack(form, file.read(struct.calcsize(form)))


_LARGEST_SPECTRUM = 1 << 20


def check_spectrum(path: Path) -> None:
    """Raise `InputError` unless the file is a spectrum: lines of a wavelength and a value."""
    text = bounded_files.read_text(path, _LARGEST_SPECTRUM)
    for number, line in enumerate(text.split("\n"), 1):
        words = line.partition("#")[0].split()
        try:
            if len(words) not in (0, 2):
                raise ValueError
            for word in words:
                float(word)
        except ValueError as error:
            raise InputError(f"{path}:{number}: expected a wavelength and a value") from error


_DEEPEST = 128
_DEEPEST_INCLUDE = 14
_MOST_INCLUDES = 1000
_MOST_ELEMENTS = 1 << 20
_LARGEST = 1 << 26
_LONGEST_VALUE = 1 << 12  # largest number of characters of an attribute in which parameters are substituted
_MOST_PARAMETERS = 1000


@dataclass(frozen=True)
class SceneFiles:
    """The files of a scene.

    Attributes:
        xml: the scene and its includes, in the order in which they are opened; a file that is included twice is listed twice.
        named: existing textures, meshes and other files that they refer to.
    """

    xml: list[Path]
    named: list[Path]


def of(scene: Path) -> list[Path]:
    """Return the XML file, its includes, and the existing files that they refer to, once each. Raises `InputError`, see `read`."""
    files = read(scene)
    return list(dict.fromkeys([*files.xml, *files.named]))


def read(scene: Path) -> SceneFiles:
    """Follow a scene's XML and collect its files.

    Raises `InputError` if the XML cannot be read, declares entities, is nested too deeply, has too many elements, includes a file outside
    of the scene's folder, uses an undefined parameter, or refers to a malformed spectrum file.
    """
    path = scene.absolute()
    reader = _Reader(path.parent.resolve())
    reader.read(path, scene.name, [path.parent], 0)
    return SceneFiles(reader.xml, reader.named)


def resolve(name: str, search: Sequence[Path]) -> Path | None:
    """Return the first file of this name in the folders `search`, as Mitsuba does; None if there is none. Absolute names are unchanged."""
    path = Path(name)
    places = [path] if path.is_absolute() else [place / path for place in search]
    return next((place for place in places if os.path.exists(place)), None)


@dataclass
class _Reader:
    root: Path
    xml: list[Path] = field(default_factory=list)
    named: list[Path] = field(default_factory=list)
    parameters: list[tuple[str, str]] = field(default_factory=list)  # ("$name", value), longest names first
    _elements: int = 0
    _bytes: int = 0

    def read(self, path: Path, shown: str, search: list[Path], depth: int) -> None:
        """Read an XML file at a nesting `depth`, and its includes. Its `path` elements are added to the folders of `search`."""
        if len(self.xml) >= _MOST_INCLUDES:
            raise InputError(f"scene {shown}: more than {_MOST_INCLUDES} includes")
        if depth > _DEEPEST_INCLUDE:
            raise InputError(f"scene {shown}: included more than {_DEEPEST_INCLUDE} deep, or by itself")
        self.xml.append(path)
        file = _File(self, path.parent, shown, search, depth)
        parser = expat.ParserCreate()
        parser.StartElementHandler, parser.EndElementHandler = file.start, file.end
        parser.StartDoctypeDeclHandler = file.declared
        data = bounded_files.read_bytes(path, _LARGEST, self.root if depth else None)
        self._bytes += len(data)
        if self._bytes > _LARGEST:
            raise InputError(f"scene {shown}: more than {_LARGEST >> 20} MiB of XML with what it includes")
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            raise InputError(f"scene {shown}:{error.lineno}: not XML: {expat.ErrorString(error.code)}") from error

    def count(self, shown: str) -> None:
        self._elements += 1
        if self._elements > _MOST_ELEMENTS:
            raise InputError(f"scene {shown}: more than {_MOST_ELEMENTS} elements")

    def define(self, name: str, value: str, shown: str) -> None:
        """Define a parameter unless it is defined. Names are sorted from the longest to the shortest, as Mitsuba tries them."""
        key = f"${name}"
        if any(key == known for known, _ in self.parameters):
            return
        if len(self.parameters) >= _MOST_PARAMETERS:
            raise InputError(f"scene {shown}: more than {_MOST_PARAMETERS} parameters")
        place = next((n for n, (known, _) in enumerate(self.parameters) if len(key) > len(known)), len(self.parameters))
        self.parameters.insert(place, (key, value))

    def substituted(self, text: str, shown: str) -> str:
        """Replace `$name` by the values of parameters; `\\$` is a literal dollar sign.

        A name matches as a prefix: `$ab` is the value of `a` followed by "b" if there is no parameter `ab`.
        """
        if "$" not in text:
            return text
        for key, value in self.parameters:
            at = 0
            while (at := text.find(key, at)) >= 0:
                if len(text) + len(value) > _LONGEST_VALUE:
                    raise InputError(f"scene {shown}: an attribute of more than {_LONGEST_VALUE} characters with '$'")
                if at and text[at - 1] == "\\":
                    at += len(key)
                else:
                    text = text[:at] + value + text[at + len(key) :]
                    at += len(value)
        at = 0
        while (at := text.find("$", at)) >= 0:
            if not at or text[at - 1] != "\\":
                raise InputError(f"scene {shown}: undefined parameter {shorten(text[at:], 60)}")
            at += 1
        return text.replace("\\$", "$")


@dataclass
class _File:
    """Handlers of the elements of one XML file while it is read."""

    reader: _Reader
    folder: Path
    shown: str
    search: list[Path]
    depth: int
    _nested: int = 0

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self._nested += 1
        if self._nested > _DEEPEST:
            raise InputError(f"scene {self.shown}: nested more than {_DEEPEST} deep")
        self.reader.count(self.shown)
        values = {name: self.reader.substituted(value, self.shown) for name, value in attributes.items()}
        if tag == "default" and {"name", "value"} <= set(values):
            self.reader.define(values["name"], values["value"], self.shown)
        elif tag == "include":
            self._include(values.get("filename", ""))
        elif tag == "path":
            self._search(values.get("value", ""))
        elif tag == "string" and values.get("name") == "filename":
            self._name(values.get("value", ""))
        elif tag == "spectrum" and "filename" in values:
            self._spectrum(values["filename"])

    def end(self, _: str) -> None:
        self._nested -= 1

    def declared(self, *_: Any) -> None:
        raise InputError(f"scene {self.shown}: it declares a document type or entities, which no scene needs")

    def _include(self, name: str) -> None:
        inside = [self.folder, *self.search]
        place = resolve(name, inside)
        root, words = self.reader.root, shorten(name, 200)
        if not (self.folder / name if place is None else place).resolve().is_relative_to(root):
            raise InputError(f"scene {self.shown}: it includes {words}, which is outside the scene's folder")
        if place is None or not place.is_file():
            raise InputError(
                f"scene {self.shown}: it includes {words}, and there is no such file in the scene's folder"
            )
        self.reader.read(place, name, inside, self.depth + 1)

    def _search(self, name: str) -> None:
        place = resolve(name, [self.folder, *self.search])
        if place is None or not place.is_dir():
            raise InputError(f"scene {self.shown}: its path {shorten(name, 200)} is no folder")
        self.search.insert(0, place)

    def _name(self, name: str) -> None:
        path = resolve(name, self.search)
        if path is not None and path.is_file():
            self.reader.named.append(path)

    def _spectrum(self, name: str) -> None:
        """Check a spectrum file at once, because Mitsuba reads it while it parses the XML."""
        path = resolve(name, [*self.search, Path()])
        if path is None:
            raise InputError(f"scene {self.shown}: spectrum {shorten(name, 200)}: no such file")
        check_spectrum(path)
        self.reader.named.append(path)
