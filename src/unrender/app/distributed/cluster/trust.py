"""Access control of an existing cluster: its token, and the folder of its session on this machine."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from unrender.backend.access import can_change, can_read
from unrender.core.errors import InputError
from unrender.core.text import one_line, reason_of

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
    """Check that the cluster requires a token, and that other users cannot read it.

    Raises:
        InputError: anyone who can reach the cluster could run programs as this user.
    """
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
    """Check that other users of this machine cannot change the folders of the cluster's nodes here.

    Raises:
        InputError: they can, or the cluster refuses the connection.
    """
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
