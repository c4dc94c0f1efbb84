"""Which files a Mitsuba scene is made of, and whether its XML keeps to its own folder.

Mitsuba reads what an XML file includes, from anywhere. A scene that came from elsewhere should not be able to have other files of this
machine parsed, so includes are followed here first and must stay inside the scene's folder. Textures and meshes may lie anywhere: what is
read as a picture or a mesh shows in no message.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

from unrender.core.errors import InputError
from unrender.io import bounded_files

__all__ = ["of"]

_DEEPEST = 128
_DEEPEST_INCLUDE = 16
_MOST_INCLUDES = 1000
_LONGEST = 1 << 28
_VARIABLE = re.compile(r"\$(\w+)")


def of(scene: Path) -> list[Path]:
    """The XML file itself, those that it includes, and the textures, meshes and other files that they name and that exist; each once.

    Raises:
        InputError: the XML cannot be read, declares entities, is nested too deeply, or includes a file outside the scene's folder.
    """
    reader = _Reader(scene.resolve().parent)
    reader.read(scene, scene.name)
    return list(dict.fromkeys([*reader.xml, *reader.named]))


@dataclass
class _Reader:
    root: Path
    xml: list[Path] = field(default_factory=list)
    named: list[Path] = field(default_factory=list)
    defaults: dict[str, str] = field(default_factory=dict)
    _depth: int = 0

    def read(self, path: Path, shown: str) -> None:
        """Take in one XML file and what it includes."""
        if len(self.xml) >= _MOST_INCLUDES:
            raise InputError(f"scene {shown}: more than {_MOST_INCLUDES} includes")
        if self._depth > _DEEPEST_INCLUDE:
            raise InputError(f"scene {shown}: included more than {_DEEPEST_INCLUDE} deep, or by itself")
        self.xml.append(path)
        parser = expat.ParserCreate()
        depth = 0

        def start(tag: str, attributes: dict[str, str]) -> None:
            nonlocal depth
            depth += 1
            if depth > _DEEPEST:
                raise InputError(f"scene {shown}: nested more than {_DEEPEST} deep")
            self._element(tag, attributes, shown)

        def end(_: str) -> None:
            nonlocal depth
            depth -= 1

        def declared(*_: Any) -> None:
            raise InputError(f"scene {shown}: it declares a document type or entities, which no scene needs")

        parser.StartElementHandler, parser.EndElementHandler = start, end
        parser.StartDoctypeDeclHandler = declared
        try:
            parser.Parse(bounded_files.read_bytes(path, _LONGEST), True)
        except expat.ExpatError as error:
            raise InputError(f"scene {shown}:{error.lineno}: not XML: {expat.ErrorString(error.code)}") from error

    def _element(self, tag: str, attributes: dict[str, str], shown: str) -> None:
        if tag == "default" and {"name", "value"} <= set(attributes):
            self.defaults.setdefault(attributes["name"], self._filled(attributes["value"]))
        elif tag == "include":
            self._include(self._filled(attributes.get("filename", "")), shown)
        elif tag == "string" and attributes.get("name") == "filename":
            found = self.root / self._filled(attributes.get("value", ""))
            if found.is_file():
                self.named.append(found)

    def _include(self, name: str, shown: str) -> None:
        place = self.root / name
        if not place.resolve().is_relative_to(self.root):
            raise InputError(f"scene {shown}: it includes {name[:200]}, which is outside the scene's folder")
        if not place.is_file():
            raise InputError(
                f"scene {shown}: it includes {name[:200]}, and there is no such file in the scene's folder"
            )
        self._depth += 1
        self.read(place, name)
        self._depth -= 1

    def _filled(self, text: str) -> str:
        """The text with $name replaced by the defaults that were declared before."""
        return _VARIABLE.sub(lambda match: self.defaults.get(match[1], match[0]), text)
