"""The user's cache folder: where it lies, how large it grows, and what happens where it cannot be."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from unrender.backend import cache


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(cache.ENVIRONMENT_VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


def fill(folder: Path, *ages: float) -> None:
    for number, age in enumerate(ages):
        path = folder / f"{number}.bin"
        path.write_bytes(bytes(100))
        os.utime(path, (1e9 - age, 1e9 - age))


def test_a_part_is_made_for_its_user_alone(place: Path) -> None:
    assert cache.folder(cache.REFERENCES) == place / "references"
    assert (place / "references").stat().st_mode & 0o077 == 0


def test_the_default_is_the_system_s_place_for_caches(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(cache.ENVIRONMENT_VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    root = cache.root()
    assert root is not None
    assert root.name == "unrender"
    assert root.is_relative_to(tmp_path)


def test_an_empty_variable_or_a_bypass_switches_it_off(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with cache.bypassed():
        assert cache.folder(cache.REFERENCES) is None
    assert cache.folder(cache.REFERENCES) is not None
    monkeypatch.setenv(cache.ENVIRONMENT_VARIABLE, "")
    assert cache.folder(cache.REFERENCES) is None
    assert cache.size(cache.REFERENCES) == 0


def test_a_place_that_cannot_be_made_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(cache.ENVIRONMENT_VARIABLE, str(tmp_path / "file" / "cache"))
    monkeypatch.delenv("DRJIT_CACHE_DIR", raising=False)
    assert cache.folder(cache.KERNELS) is None
    cache.use_for_kernels()
    assert "DRJIT_CACHE_DIR" not in os.environ


def test_what_was_used_longest_ago_goes_first(place: Path) -> None:
    folder = cache.folder(cache.KERNELS)
    assert folder is not None
    fill(folder, 30, 10, 20)
    assert cache.size(cache.KERNELS) == 300
    cache.trim(folder, 200)
    assert sorted(path.name for path in folder.iterdir()) == ["1.bin", "2.bin"]


def test_it_is_tidied_once_a_day(place: Path) -> None:
    folder = cache.folder(cache.KERNELS)
    assert folder is not None
    cache.tidy(folder, 100)
    fill(folder, 1, 2)
    cache.tidy(folder, 100)
    assert (folder / "1.bin").exists()
    os.utime(folder / cache._STAMP, (1e9, 1e9))
    cache.tidy(folder, 100)
    assert not (folder / "1.bin").exists()


def test_dr_jit_keeps_its_kernels_there_unless_told_otherwise(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_CACHE_DIR", "elsewhere")
    cache.use_for_kernels()
    assert os.environ["DRJIT_CACHE_DIR"] == "elsewhere"
    monkeypatch.delenv("DRJIT_CACHE_DIR")
    cache.use_for_kernels()
    assert os.environ["DRJIT_CACHE_DIR"] == str(place / "kernels")
    monkeypatch.delenv("DRJIT_CACHE_DIR")


@pytest.mark.parametrize("which", ["top", "part"])
def test_a_folder_that_others_may_write_keeps_nothing(
    which: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kernel that somebody else put there would run as whoever loads it."""
    top = tmp_path / "cache"
    monkeypatch.setenv(cache.ENVIRONMENT_VARIABLE, str(top))
    assert cache.folder(cache.KERNELS) == top / cache.KERNELS
    place = top if which == "top" else top / cache.KERNELS
    place.chmod(0o777)
    assert cache.folder(cache.KERNELS) is None
    monkeypatch.delenv("DRJIT_CACHE_DIR", raising=False)
    cache.use_for_kernels()
    assert "DRJIT_CACHE_DIR" not in os.environ
    place.chmod(0o700)
    assert cache.folder(cache.KERNELS) == top / cache.KERNELS


def test_a_folder_that_another_user_could_replace_keeps_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever may write to the folder above it can put another in its place."""
    with tempfile.TemporaryDirectory(dir="/tmp") as above:
        os.chmod(above, 0o755)
        monkeypatch.setenv(cache.ENVIRONMENT_VARIABLE, os.path.join(above, "cache"))
        assert cache.folder(cache.KERNELS) is not None
        os.chmod(above, 0o777)
        assert cache.folder(cache.KERNELS) is None
        os.chmod(above, 0o1777)
        assert cache.folder(cache.KERNELS) is not None
        os.chmod(above, 0o755)
        os.chmod(os.path.join(above, "cache"), 0o775)
        assert cache.folder(cache.KERNELS) is None


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to make a folder of another user")
def test_two_users_share_no_cache(tmp_path: Path) -> None:
    """Each keeps nothing in the other's folder, whatever its mode, and all works as before."""
    with tempfile.TemporaryDirectory(dir="/tmp") as above:
        os.chmod(above, 0o1777)
        place = os.path.join(above, "cache")
        os.mkdir(place)
        os.chmod(place, 0o777)
        code = (
            "from unrender.backend import cache; print(cache.folder(cache.KERNELS)); print(cache.size(cache.KERNELS))"
        )
        for owner in (0, 65534):
            os.chown(place, owner, owner)
            environment = os.environ | {cache.ENVIRONMENT_VARIABLE: place, "PYTHONPATH": os.pathsep.join(sys.path)}
            done = subprocess.run(
                [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
            )
            assert done.stdout == "None\n0\n"


def test_a_moved_clock_does_no_harm(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of the system may jump by years in either direction; then files seem to come from the future."""
    folder = cache.folder(cache.KERNELS)
    assert folder is not None
    fill(folder, 10, 20, 30)
    for now in (0.0, 4e9, 1e9):
        monkeypatch.setattr(time, "time", lambda now=now: now)
        cache.tidy(folder, 200)
        assert sorted(path.name for path in folder.glob("*.bin")) == ["0.bin", "1.bin"]
