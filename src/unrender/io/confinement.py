"""Confinement: files that an input refers to must be in the input's own folder.

A capture, a scene or a mesh may come from an untrusted source. A file elsewhere on this machine that it refers to would be read, and
would show in the output. So photographs and masks of a capture must be in its folder. Textures, meshes and grids of a problem file's
scene must be in the folder of the scene or of the problem file. Links are resolved first. Files on the command line may be anywhere, and
so may those of a scene that a script opens.
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
"""Environment variable that allows files outside of the folder: any value except "" and "0". Worker processes inherit it."""

_folders: ContextVar[tuple[Path, ...]] = ContextVar("folders", default=())


def allow(everything: bool) -> bool:
    """Allow outside files for this process and its children if `everything` is true. Returns `everything`."""
    if everything:
        os.environ[VARIABLE] = "1"
    return everything


@contextmanager
def within(folder: Path) -> Iterator[None]:
    """Also allow files in `folder` within this context."""
    token = _folders.set((*_folders.get(), folder))
    try:
        yield
    finally:
        _folders.reset(token)


def is_confined() -> bool:
    """Return whether an untrusted input is being read, in the context `within`."""
    return bool(_folders.get())


def check(path: Path, folders: Sequence[Path], what: str) -> None:
    """Raise `InputError` if a file, links resolved, is outside of all `folders` and those of `within`.

    Its message begins with `what`, the input and how it refers to the file, and names the first folder.
    """
    if os.environ.get(VARIABLE, "0") not in ("", "0"):
        return
    try:
        real = path.resolve()
        if any(real.is_relative_to(folder.resolve()) for folder in (*folders, *_folders.get())):
            return
    except (OSError, RuntimeError, ValueError) as error:  # a cycle of links, a zero byte
        raise InputError(f"{what} {visible(shorten(str(path), 200))}: cannot be read: {error}") from error
    where = f"{visible(shorten(str(path), 200))}, which lies outside {visible(shorten(str(folders[0]), 200))}"
    raise InputError(f"{what} {where}; to read it nevertheless, give --allow-outside (or set {VARIABLE}=1)")
