"""Protection from other users: a local cluster with its own folder, token and loopback addresses, and checks of an existing cluster."""

from __future__ import annotations

import contextlib
import fcntl
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from unrender.backend.cache import can_change, can_read
from unrender.core.errors import InputError
from unrender.core.text import one_line, reason_of

_PREFIX, _LOCK = "unrender-ray-", "lock"
_LONGEST = 107 - len("/unrender-ray-12345678/r/session_2026-01-01_00-00-00_000000_1234567/sockets/plasma_store")
"""Maximum length of the folder that contains the cluster's, since a socket's path is limited to 107 bytes."""
_YOUNG = 60.0  # seconds until a folder without a lock counts as abandoned
_WATCHER = """
import os, shutil, sys, time
os.read(0, 1)
for _ in range(100):
    shutil.rmtree(sys.argv[1], True)
    if not os.path.lexists(sys.argv[1]):
        break
    time.sleep(0.1)
"""
"""Program that removes the folder when its standard input ends, even if the parent process is killed."""
_ENVIRONMENT = ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER")


@contextlib.contextmanager
def private_cluster(ray: Any) -> Iterator[dict[str, Any]]:
    """Prepare the start of a cluster that only this user's processes can enter. Yield the arguments of `ray.init`.

    The token is in the environment of these processes, which other users cannot read, and is never written. All services listen on the
    loopback interface. Ray's files are below a folder of mode 0700. Raises `InputError` if no folder is safe, or this version of Ray does
    not support tokens.
    """
    _clear_token_cache(ray)  # raises before any changes
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    constants = ray._private.ray_constants
    networked = constants.ENABLE_RAY_CLUSTER
    with private_folder() as folder:
        os.environ.pop("RAY_AUTH_TOKEN_PATH", None)
        os.environ |= {
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN": secrets.token_hex(32),
            "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",  # Ray's name for: use the loopback interface
        }
        constants.ENABLE_RAY_CLUSTER = False
        _clear_token_cache(ray)
        try:
            yield {"address": "local", "_node_ip_address": "127.0.0.1", "_temp_dir": str(folder / "r")}
        finally:
            constants.ENABLE_RAY_CLUSTER = networked
            for name, value in before.items():
                os.environ.pop(name, None)
                if value is not None:
                    os.environ[name] = value
            _clear_token_cache(ray)


def check_private(ray: Any) -> None:
    """Raise `InputError` unless a cluster that was just started listens on the loopback interface alone, and asks for the token."""
    address = ray.get_runtime_context().gcs_address
    asks = ray._raylet.get_authentication_mode() == ray._raylet.AuthenticationMode.TOKEN
    if not address.startswith(("127.", "[::1]")) or not asks:
        where = f"listens at {address}" if asks else "asks for no token"
        raise InputError(
            f"workers: Ray {ray.__version__} {where}, open to other users; install another version: pip install 'ray>=2.52,<=2.60'"
        )


def _clear_token_cache(ray: Any) -> None:
    """Make Ray read the environment's token and mode again."""
    try:
        ray._raylet.Config.initialize("")
        ray._raylet.AuthenticationTokenLoader.instance().reset_cache()
    except AttributeError as error:
        raise InputError(
            f"workers: Ray {ray.__version__} does not support tokens; install a newer version: pip install 'ray>=2.52'"
        ) from error


@contextlib.contextmanager
def private_folder() -> Iterator[Path]:
    """Make a folder of mode 0700 with a short path, and remove it at the end: also after this process was killed.

    Raises `InputError` if there is no place for one that others cannot change.
    """
    base = _base()
    _remove_left_over(base)
    folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=base))
    with (folder / _LOCK).open("wb") as lock, _watched(folder):
        fcntl.flock(lock, fcntl.LOCK_EX)
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def _watched(folder: Path) -> Iterator[None]:
    words = [sys.executable, "-I", "-S", "-c", _WATCHER, str(folder)]
    with subprocess.Popen(
        words,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        cwd="/",
        start_new_session=True,
    ):
        yield


def _base() -> Path:
    """Return the parent folder for the cluster's folder: the temporary folder, or the system's if that has a long path or is not
    private."""
    reasons = []
    for name in dict.fromkeys((tempfile.gettempdir(), "/tmp", "/var/tmp")):
        place = Path(os.path.realpath(name))
        if not os.access(place, os.W_OK | os.X_OK):
            reasons.append(f"{place} cannot be written")
        elif len(os.fsencode(place)) > _LONGEST:
            reasons.append(f"{place} has more than {_LONGEST} characters")
        elif reason := can_change(place, shared=True):
            reasons.append(reason)
        else:
            return place
    raise InputError(
        f"workers: no folder is safe for Ray's sockets ({'; '.join(reasons)}); set TMPDIR to a folder of your own with a short path"
    )


def _remove_left_over(base: Path) -> None:
    """Remove folders of processes that were killed. Their locks are free."""
    for folder in base.glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):
            status = folder.lstat()
            if status.st_uid != os.geteuid() or folder.is_symlink():
                continue
            if not (folder / _LOCK).exists():
                if time.time() - status.st_mtime > _YOUNG:
                    shutil.rmtree(folder, ignore_errors=True)
                continue
            with (folder / _LOCK).open("rb") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)


_HOW = "; or give --insecure if no other user can reach this machine"
_SECONDS = 10.0


def _token_files() -> list[Path]:
    """Return the paths where Ray searches for a token of this user."""
    named = os.environ.get("RAY_AUTH_TOKEN_PATH")
    return [Path(named)] if named else [Path(os.path.expanduser("~/.ray/auth_token"))]


def has_token() -> bool:
    """Return whether this user has a token in a location that Ray searches."""
    return bool(os.environ.get("RAY_AUTH_TOKEN")) or any(path.is_file() for path in _token_files())


def check_token(address: str) -> None:
    """Raise `InputError` unless the cluster requires a token that other users cannot read: they could run programs as this user."""
    mode = os.environ.get("RAY_AUTH_MODE", "disabled").lower()
    if mode == "disabled" or (mode == "token" and not has_token()):
        raise InputError(
            f"workers: the cluster at {address} does not require a token, so anyone who can reach its ports can run programs as its user; "
            f"start it with one (docs/guide/workers.md){_HOW}"
        )
    if os.environ.get("RAY_AUTH_TOKEN"):
        return
    for path in _token_files():
        if path.is_file() and (reason := can_read(path)):
            raise InputError(f"workers: the token {reason}; create a new one, and run chmod 600 {path}{_HOW}")


def check_cluster(ray: Any, address: str) -> None:
    """Raise `InputError` if other users of this machine can change the folders of the cluster's nodes here, or it refuses the
    connection."""
    for folder in sorted({node.session_dir for node in _nodes(ray, address)}):
        if folder and os.path.isdir(folder) and (reason := can_change(Path(folder))):
            raise InputError(
                f"workers: Ray's folder {reason}; start the cluster with --temp-dir below a folder of mode 0700{_HOW}"
            )


def _nodes(ray: Any, address: str) -> list[Any]:
    """Return the nodes of the cluster, of which a new one has none for a while. Raises `InputError`."""
    until = time.monotonic() + _SECONDS
    try:
        client = ray._raylet.GcsClient(address=address)
        while not (nodes := list(client.get_all_node_info(timeout=_SECONDS).values())) and time.monotonic() < until:
            time.sleep(0.1)
    except Exception as error:  # of many kinds
        reason = one_line(reason_of(error, 200))
        raise InputError(f"workers: Ray cannot be reached at {address}: {reason}") from error
    if not nodes:
        raise InputError(
            f"workers: the cluster at {address} has no node; run ray status to see whether its nodes are alive"
        )
    return nodes
