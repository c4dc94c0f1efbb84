"""Control over the plugins that Mitsuba loads: only its own, never a library next to a scene.

Mitsuba creates an object of type T by loading the shared library `plugins/T.so` from the first folder of its file resolver that has one.
The resolver starts with the current directory, and `mitsuba.load_file` puts the scene's folder first. A scene from an untrusted source
could thus execute code in its own folder. A name that no folder has is looked up once more in the current directory, and a type such as
`../x` or `/tmp/x` leaves the folder `plugins`.

So Mitsuba's own folder comes first for the entire process (`prefer_own`), and scenes are loaded with no other folder (`only`). The names
of types are checked before Mitsuba reads them (`check_type`).
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from unrender.core.checks import encode_text
from unrender.core.errors import InputError

_FOLDER = "plugins"
_NAME = re.compile(r"[A-Za-z0-9_-]{1,100}")
_ENDING = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")


@cache
def own_folder() -> Path:
    """Return the folder of Mitsuba's own plugins and data. Mitsuba must be importable."""
    import mitsuba as mi

    places = [Path(str(mi.__file__)).parent, *map(Path, mi.__path__)]
    return next((place for place in places if (place / _FOLDER).is_dir()), places[0]).absolute()


def search_paths() -> list[Path]:
    """Return the folders of Mitsuba's file resolver in search order. Raises `InputError` for names that are not UTF-8."""
    try:
        return [Path(str(place)) for place in _mitsuba().file_resolver()]
    except UnicodeDecodeError as error:  # the current folder is one of them
        raise InputError("current folder: its name is not UTF-8, which Mitsuba cannot read; rename it") from error


def prefer_own() -> None:
    """Put Mitsuba's own folder first in its file resolver for the entire process. Idempotent."""
    resolver = _mitsuba().file_resolver()
    if search_paths()[:1] != [own_folder()]:
        resolver.prepend(str(own_folder()))


@contextmanager
def only(folder: Path) -> Iterator[None]:
    """Restrict Mitsuba's file resolver to one folder within this context. Other relative names resolve against the current directory.

    Raises `InputError` for a name that is not UTF-8.
    """
    encode_text(str(folder), "folder of the scene")
    mi = _mitsuba()
    before = mi.file_resolver()
    resolver = mi.FileResolver(before)
    resolver.clear()
    resolver.append(str(folder))
    mi.set_file_resolver(resolver)
    try:
        yield
    finally:
        mi.set_file_resolver(before)


def check_type(name: str) -> None:
    """Raise `InputError` for an object type for which Mitsuba would load a library other than its own, or that is no plugin's name.

    Types that were registered in Python have no library and pass. Types that do not exist pass too: Mitsuba reports them.
    """
    if not _NAME.fullmatch(name):
        raise InputError(f"type {name[:60]!r}: expected the name of a plugin, of letters, digits, '_' and '-'")
    file = Path(_FOLDER, name + _ENDING)
    if not (own_folder() / file).exists() and os.path.lexists(file):
        raise InputError(f"type {name}: {file} here is not Mitsuba's, and is not loaded")


def _mitsuba() -> Any:
    import mitsuba

    return mitsuba
