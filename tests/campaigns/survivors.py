"""What a power cut must leave: the bytes and the names that were flushed, and nothing else.

The worst disk that POSIX allows: a file that was never flushed is empty, a name that its folder was not flushed with is not there, and a
name that was removed since comes back. Real file systems keep more, each in its own way.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

__all__ = ["Survivors", "recording"]


@dataclass
class Survivors:
    """What has been flushed below a folder.

    Attributes:
        root: the folder.
        flushes: how many there were.
        contents: {inode: bytes} of files.
        names: {inode: {name: inode}} of folders.
    """

    root: Path
    flushes: int = 0
    contents: dict[int, bytes] = field(default_factory=dict)
    names: dict[int, dict[str, tuple[int, bool]]] = field(default_factory=dict)
    _held: list[int] = field(default_factory=list)

    def see(self, file: int) -> bool:
        """Note that a file or folder is flushed. Returns whether it is one of those."""
        path = os.readlink(f"/proc/self/fd/{file}").removesuffix(" (deleted)")
        if not Path(path).is_relative_to(self.root):
            return False
        self.flushes += 1
        status = os.fstat(file)
        self._held.append(os.dup(file))  # no other file gets its number
        if stat.S_ISDIR(status.st_mode):
            with os.scandir(path) as entries:
                found = {entry.name: (entry.inode(), entry.is_dir(follow_symlinks=False)) for entry in entries}
            self.names[status.st_ino] = found
        else:
            self.contents[status.st_ino] = Path(f"/proc/self/fd/{file}").read_bytes()
        return True

    def copy(self) -> Survivors:
        """What a cut now would leave."""
        return Survivors(self.root, self.flushes, dict(self.contents), dict(self.names))

    def restore(self, place: Path) -> None:
        """Make the folder at `place` what the cut left of the root."""
        self._restore(self.root.stat().st_ino, place)

    def _restore(self, number: int, place: Path) -> None:
        place.mkdir()
        for name, (inside, is_folder) in self.names.get(number, {}).items():
            if is_folder:
                self._restore(inside, place / name)
            else:
                (place / name).write_bytes(self.contents.get(inside, b""))

    def close(self) -> None:
        """Let the files go."""
        for file in self._held:
            os.close(file)
        self._held.clear()


@contextlib.contextmanager
def recording(root: Path, every: int = 1) -> Iterator[tuple[Survivors, list[Survivors]]]:
    """Record what is flushed below a folder, and what a cut after every so many flushes would leave."""
    now, cuts = Survivors(Path(os.path.realpath(root))), []
    fsync = os.fsync

    def recorded(file: int) -> None:
        if now.see(file) and now.flushes % every == 0:
            cuts.append(now.copy())

    os.fsync = recorded  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield now, cuts
    finally:
        os.fsync = fsync
        now.close()
