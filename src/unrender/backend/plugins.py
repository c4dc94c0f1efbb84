"""Which plugins Mitsuba may load: its own, and no library that lies beside a scene.

Mitsuba makes an object of type T by loading the shared library `plugins/T.so` from the first folder of its file resolver that has one.
The resolver begins with the current directory, and `mitsuba.load_file` puts the scene's folder before that: a scene that someone mailed
would run the code that lies beside it. A name that no folder has is looked up from the current directory once more, and a type such
as `../x` or `/tmp/x` leads out of the folder `plugins` altogether.

So Mitsuba's own folder comes first for the whole process (`prefer_own`), scenes are made where there is no other (`only`), and the
names of types are checked before Mitsuba sees them (`check_type`).
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

from unrender.core.errors import InputError

_FOLDER = "plugins"
_NAME = re.compile(r"[A-Za-z0-9_-]{1,100}")
_ENDING = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")


@cache
def own_folder() -> Path:
    """Where Mitsuba's own plugins and data are. Mitsuba must be importable."""
    import mitsuba as mi

    places = [Path(str(mi.__file__)).parent, *map(Path, mi.__path__)]
    return next((place for place in places if (place / _FOLDER).is_dir()), places[0]).absolute()


def search_paths() -> list[Path]:
    """Return the folders where Mitsuba's file resolver looks for files, first to last. Raises `InputError` for names that are not UTF-8."""
    try:
        return [Path(str(place)) for place in _mitsuba().file_resolver()]
    except UnicodeDecodeError as error:  # the current folder is one of them
        raise InputError("current folder: its name is not UTF-8, which Mitsuba cannot read; rename it") from error


def prefer_own() -> None:
    """Have Mitsuba look into its own folder first, for the whole process. Again does nothing."""
    resolver = _mitsuba().file_resolver()
    if search_paths()[:1] != [own_folder()]:
        resolver.prepend(str(own_folder()))


@contextmanager
def only(folder: Path) -> Iterator[None]:
    """Have Mitsuba look into one folder alone meanwhile. Relative names that it does not have count from the current directory."""
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
    """Raise `InputError` for the type of an object that would have Mitsuba load a library that is not its own.

    Types that were registered in Python are no libraries and pass, and so do types that do not exist: Mitsuba says so.
    """
    if not _NAME.fullmatch(name):
        raise InputError(f"type {name[:60]!r}: expected the name of a plugin, of letters, digits, '_' and '-'")
    file = Path(_FOLDER, name + _ENDING)
    if not (own_folder() / file).exists() and os.path.lexists(file):
        raise InputError(f"type {name}: {file} here is not Mitsuba's, and is not loaded")


def _mitsuba() -> Any:
    import mitsuba

    return mitsuba
