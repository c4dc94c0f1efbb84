"""Which clusters of the user are refused because other users can enter them. Ray is needed by none of this."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from unrender.app.distributed.cluster.connection import check_cluster, check_token
from unrender.backend.cache import can_change, can_read
from unrender.core.errors import InputError


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home folder that others can enter, in one that they can."""
    place = Path(os.path.realpath(tmp_path))
    for above in (place, *place.parents):
        if above.stat().st_uid == os.geteuid() and above.name.startswith(("pytest", "test_", "popen")):
            above.chmod(0o755)
    folder = place / "home"
    folder.mkdir(mode=0o755)
    monkeypatch.setenv("HOME", str(folder))
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"):
        monkeypatch.delenv(name, raising=False)
    return folder


def with_token(home: Path, mode: int) -> Path:
    """The token's file."""
    path = home / ".ray" / "auth_token"
    path.parent.mkdir()
    path.write_text("secret")
    path.chmod(mode)
    return path


def test_a_cluster_without_a_token_is_refused(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for mode in (None, "disabled", "token"):
        if mode:
            monkeypatch.setenv("RAY_AUTH_MODE", mode)
        with pytest.raises(InputError, match=r"cluster at a:1 does not require a token.*--insecure"):
            check_token("a:1")
    monkeypatch.setenv("RAY_AUTH_TOKEN", "x")
    check_token("a:1")


@pytest.mark.parametrize(
    ("mode", "refused"), [(0o644, True), (0o604, True), (0o640, True), (0o620, True), (0o600, False)]
)
def test_a_token_that_others_can_read_is_refused(
    home: Path, monkeypatch: pytest.MonkeyPatch, mode: int, refused: bool
) -> None:
    path = with_token(home, mode)
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    if not refused:
        check_token("a:1")
        return
    verb = "readable" if mode & 0o044 else "writable"
    with pytest.raises(InputError, match=rf"{path} is {verb} by others \(mode {mode:04o}\); .*chmod 600") as raised:
        check_token("a:1")
    assert "\n" not in str(raised.value)
    home.chmod(0o700)  # nobody else gets there
    check_token("a:1")


def test_a_token_elsewhere_is_looked_at(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = home / "token"
    path.write_text("secret")
    path.chmod(0o644)
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(path))
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    with pytest.raises(InputError, match="readable by others"):
        check_token("a:1")


def test_what_others_can_change(home: Path) -> None:
    folder = home / "a" / "b"
    folder.mkdir(parents=True)
    assert can_change(folder) == ""
    (home / "a").chmod(0o777)  # `b` can be renamed
    assert can_change(folder) == f"{home / 'a'} is writable by others (mode 0777)"
    (home / "a").chmod(0o1777)
    assert can_change(folder) == ""
    assert can_change(home / "a", shared=True) == ""
    assert "writable" in can_change(home / "a")  # names can be taken before the owner
    (home / "a").chmod(0o700)
    folder.chmod(0o777)
    assert can_change(folder) == ""  # nobody else gets there
    link = home / "link"
    link.symlink_to(folder)
    assert can_change(link) == ""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give folders away")
def test_folders_and_tokens_of_others_are_not_trusted(home: Path) -> None:
    folder = home / "a"
    folder.mkdir()
    path = folder / "token"
    path.write_text("x")
    path.chmod(0o600)
    os.chown(path, 4321, 4321)
    assert can_read(path) == f"{path} belongs to user 4321"
    os.chown(folder, 4321, 4321)
    assert can_change(folder) == f"{folder} belongs to user 4321"


def fake_ray(*folders: Path) -> Any:
    """Ray, of whose cluster the nodes have these folders."""
    nodes = {n: SimpleNamespace(session_dir=str(folder)) for n, folder in enumerate(folders)}
    client = SimpleNamespace(get_all_node_info=lambda timeout: nodes)
    return SimpleNamespace(_raylet=SimpleNamespace(GcsClient=lambda address: client))


def test_ray_folder_that_others_can_change_is_refused(home: Path) -> None:
    session = home / "r" / "session_1"
    session.mkdir(parents=True)
    session.chmod(0o777)  # as Ray leaves it
    with pytest.raises(
        InputError, match=r"Ray's folder .*/session_1 is writable by others \(mode 0777\); .*--temp-dir"
    ):
        check_cluster(fake_ray(session), "a:1")
    home.chmod(0o700)
    check_cluster(fake_ray(session, Path("/on/another/machine")), "a:1")


def test_a_cluster_without_nodes_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """It says nothing of its folders, so it is not joined."""
    monkeypatch.setattr("unrender.app.distributed.cluster.private._SECONDS", 0.0)
    with pytest.raises(InputError, match="the cluster at a:1 has no node"):
        check_cluster(fake_ray(), "a:1")


def test_a_cluster_that_lets_nobody_in_is_one_line() -> None:
    def refuse(address: str) -> None:
        raise RuntimeError("Unauthenticated:\nno token")

    ray: Any = SimpleNamespace(_raylet=SimpleNamespace(GcsClient=refuse))
    with pytest.raises(InputError, match=r"Ray cannot be reached at a:1: Unauthenticated") as raised:
        check_cluster(ray, "a:1")
    assert "\n" not in str(raised.value)
