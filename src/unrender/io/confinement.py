"""Files that an input names must lie in the input's own folder.

A capture, a scene or a mesh may come from somebody else. What it names elsewhere on this machine would be read, and would show in what is
made of it. So photographs and masks of a capture must lie in its folder, and textures, meshes and grids of a problem file's scene in the
scene's folder or in that of the problem file. Links are followed before that is decided. What the user names on the command line may lie
anywhere, and so may what a scene names that a script opens.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from unrender.core.errors import InputError
from unrender.core.text import shorten, visible

VARIABLE = "UNRENDER_ALLOW_OUTSIDE"
"""Environment variable that allows files outside: any value but "" and "0". Worker processes inherit it."""

_folders: ContextVar[tuple[Path, ...]] = ContextVar("folders", default=())


def is_outside_allowed() -> bool:
    """Whether files may lie outside of the folder of the input that names them."""
    return os.environ.get(VARIABLE, "0") not in ("", "0")


def allow(wanted: bool) -> bool:
    """Allow files outside for this process and those that it starts, where `wanted`. Returns `wanted`."""
    if wanted:
        os.environ[VARIABLE] = "1"
    return wanted


@contextmanager
def within(folder: Path) -> Iterator[None]:
    """Let files lie in `folder`, too, while the context is entered."""
    token = _folders.set((*_folders.get(), folder))
    try:
        yield
    finally:
        _folders.reset(token)


def is_confined() -> bool:
    """Return whether an input that may come from somebody else is being read, within `within`."""
    return bool(_folders.get())


def check(path: Path, folders: Sequence[Path], what: str) -> None:
    """Raise `InputError` where a file lies outside of all `folders` and those of `within`, links followed.

    Args:
        path: the file, as it will be opened.
        folders: where it may lie; the first is named in the message.
        what: the input that names it, and how: begins the message.
    """
    if is_outside_allowed():
        return
    try:
        real = path.resolve()
        if any(real.is_relative_to(folder.resolve()) for folder in (*folders, *_folders.get())):
            return
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links, a zero byte
        raise InputError(f"{what} {visible(shorten(str(path), 200))}: cannot be read: {error}") from error
    where = f"{visible(shorten(str(path), 200))}, which lies outside {visible(shorten(str(folders[0]), 200))}"
    raise InputError(f"{what} {where}; to read it nevertheless, give --allow-outside (or set {VARIABLE}=1)")
