"""Files and folders that are written: whole at every instant, on the disk when they say so, and nothing left over."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.campaigns.faults import Killed, operations
from tests.campaigns.survivors import recording
from unrender.io import files

DEAD = 2**22 + 1
"""Beyond what Linux numbers processes to."""


def contents(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


def make(folder: Path, text: str) -> Path:
    (folder / "maps").mkdir(parents=True)
    (folder / "scene.xml").write_text(text)
    (folder / "maps" / "wall.txt").write_text(text)
    return folder


OLD, NEW = ({"scene.xml": text, "maps/wall.txt": text} for text in ("old", "new"))


# ---------------------------------------------------------------------- after a power cut


def test_what_is_written_is_on_the_disk_name_and_all(tmp_path: Path) -> None:
    with recording(tmp_path) as (disk, _):
        files.write(tmp_path / "a" / "b" / "text", b"data")
        files.write_arrays(tmp_path / "arrays.npz", {"x": np.arange(3)})
        files.write(tmp_path / "passing", b"data", durable=False)
        files.write(tmp_path / "later", b"data", name_too=False)
    disk.restore(tmp_path / "cut")
    assert (tmp_path / "cut" / "a" / "b" / "text").read_bytes() == b"data"
    np.testing.assert_array_equal(np.load(tmp_path / "cut" / "arrays.npz")["x"], np.arange(3))
    assert not (tmp_path / "cut" / "passing").exists()
    assert not (tmp_path / "cut" / "later").exists()


def test_a_file_is_never_replaced_by_an_empty_one(tmp_path: Path) -> None:
    """Its bytes are flushed before it gets its name, also where the name is flushed later."""
    files.write(tmp_path / "text", b"old")
    with recording(tmp_path) as (disk, _):
        files.write(tmp_path / "text", b"new", name_too=False)
        files.sync_folder(tmp_path)
    disk.restore(tmp_path / "cut")
    assert (tmp_path / "cut" / "text").read_bytes() == b"new"


@pytest.mark.parametrize("exchange", [True, False])
def test_a_folder_that_was_replaced_is_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exchange: bool
) -> None:
    if not exchange:
        monkeypatch.setattr(files, "_exchange", lambda *_: False)
    make(tmp_path / "scene", "old")
    with recording(tmp_path) as (disk, _):
        files.replace_folder(make(files.temporary(tmp_path / "scene"), "new"), tmp_path / "scene")
    disk.restore(tmp_path / "cut")
    assert contents(tmp_path / "cut" / "scene") == NEW


def test_a_folder_that_cannot_be_flushed_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some network file systems have no such operation. A disk that is full is another matter."""

    def fail(number: int) -> None:
        def fsync(file: int) -> None:
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(os, "fsync", fsync)

    fail(errno.EINVAL)
    files.sync_folder(tmp_path)
    fail(errno.ENOSPC)
    with pytest.raises(OSError, match="No space left"):
        files.sync_folder(tmp_path)


def test_a_folder_below_or_in_place_of_a_file_is_the_system_s_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(NotADirectoryError):
        files.make_folder(tmp_path / "file" / "folder")
    with pytest.raises(FileExistsError):
        files.make_folder(tmp_path / "file")
    files.make_folder(tmp_path / "a" / "b" / "c")
    files.make_folder(tmp_path / "a" / "b" / "c")


# ---------------------------------------------------------------------- after a kill


@pytest.mark.parametrize("exchange", [True, False])
def test_a_folder_is_the_old_or_the_new_one_whatever_operation_kills(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exchange: bool
) -> None:
    """At the instant of the kill where two names can be exchanged; else once the next process has set it right."""
    if not exchange:
        monkeypatch.setattr(files, "_exchange", lambda *_: False)
    number, seen = 0, []
    while True:
        home = tmp_path / str(number)
        place = make(home / "scene", "old")
        new = make(home / f".scene.{os.getpid()}.part", "new")
        try:
            with operations(home, at=number):
                files.replace_folder(new, place)
            break
        except Killed:
            if exchange:
                assert contents(place) in (OLD, NEW)
            files.remove_leftovers(home, ("scene",))
            assert contents(home) in ({f"scene/{name}": text for name, text in one.items()} for one in (OLD, NEW))
            seen.append(contents(place)["scene.xml"])
        number += 1
    assert contents(place) == NEW
    assert {"old", "new"} <= set(seen)


def test_what_the_dead_left_is_removed_and_what_the_living_write_is_not(tmp_path: Path) -> None:
    mine = {"a.txt": "", "notes.2019.old": "", "film.part": "", "page.html.1.part": "", "other.7777777.part": ""}
    for name in (*mine, f"page.html.{DEAD}.part", f"page.html.{os.getpid()}.part"):
        (tmp_path / name).write_text("")
    make(tmp_path / f".scene.{DEAD}.part", "half")
    make(tmp_path / f".scene.{DEAD}.old", "old")
    files.remove_leftovers(tmp_path, ("page.html", "scene"))
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*mine, "scene"])
    assert contents(tmp_path / "scene") == OLD
    make(tmp_path / f".scene.{DEAD}.old", "older")
    files.remove_leftovers(tmp_path)
    assert contents(tmp_path / "scene") == OLD
    assert not (tmp_path / f".scene.{DEAD}.old").exists()
    assert not (tmp_path / "other.7777777.part").exists()
    assert (tmp_path / "page.html.1.part").exists()  # of the first process, which lives


def test_who_writes_a_file_removes_what_the_dead_left_of_it(tmp_path: Path) -> None:
    for name in ("page.html", "other.html"):
        (tmp_path / f"{name}.{DEAD}.part").write_text("half")
    files.write(tmp_path / "page.html", b"whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"other.html.{DEAD}.part", "page.html"]


def test_nothing_is_removed_through_a_link(tmp_path: Path) -> None:
    away = tmp_path / "away"
    make(away / f".scene.{DEAD}.part", "theirs")
    (tmp_path / "folder").symlink_to(away)
    files.remove_leftovers(tmp_path / "folder")
    shutil.copytree(away, tmp_path / "home")
    (tmp_path / "home" / f".other.{DEAD}.part").symlink_to(away)
    files.remove_leftovers(tmp_path / "home")
    assert contents(away)
    assert list((tmp_path / "home").iterdir()) == []
