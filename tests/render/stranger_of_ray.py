"""What another user of the machine tries against a cluster: `python stranger_of_ray.py < targets`, both objects of JSON.

The targets: "uid"; "address" of the cluster's store; "ports"; "processes"; and by their paths "sockets", "folders" and "files" that others
may read, "closed" folders and "secrets", files that they may not. "secret" is the token that must be shown nowhere. STRANGER_TOKEN in the
environment is the one that the stranger has.

Imported as root, it gives root up before anything else. The answer counts the attempts, and names those that came to anything.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import json
import os
import socket
import sys
import threading
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

_SECONDS = 6.0
_ATTACH = 16
"""PTRACE_ATTACH."""
_REQUESTS = (("POST", "get_or_create_runtime_env"), ("GET", ""), ("GET", "metrics"), ("GET", "api/version"))
_attempts = Counter[str]()


def _become(uid: int) -> None:
    os.setgroups([])
    os.setgid(uid)
    os.setuid(uid)


def _joined(address: str) -> str | None:
    """Return what was read from the cluster's store of functions and written into it, as whoever is let in can."""
    raylet: Any = importlib.import_module("ray._raylet")
    found: list[Any] = []

    def attempt() -> None:
        with contextlib.suppress(Exception):
            client = raylet.GcsClient(address=address)
            keys = client.internal_kv_keys(b"", b"fun", timeout=3)
            found.append(f"read {len(keys)} keys")
            client.internal_kv_put(b"stranger", b"was here", True, b"fun", timeout=3)
            found.append("wrote")

    _attempts["joins"] += 1
    thread = threading.Thread(target=attempt, daemon=True)
    thread.start()
    thread.join(_SECONDS)
    return ", ".join(found) or None


def _asked(port: int, method: str, name: str) -> str | None:
    """Return the status of an HTTP request, unless it refuses or fails."""
    _attempts["requests"] += 1
    url = f"http://127.0.0.1:{port}/{name}"
    data = b"" if method == "POST" else None
    try:
        with urllib.request.urlopen(urllib.request.Request(url, data=data, method=method), timeout=2) as answer:
            return f"{method} /{name}: {answer.status}"
    except urllib.error.HTTPError as error:
        return None if error.code in (401, 403) else f"{method} /{name}: {error.code}"
    except Exception:
        return None


def _done(kind: str, actions: dict[str, Callable[[], Any]]) -> list[str]:
    """Return the names of the actions that the system allowed."""
    found = []
    for name, action in actions.items():
        _attempts[kind] += 1
        with contextlib.suppress(OSError):
            action()
            found.append(name)
    return found


def _folder(folder: Path) -> list[str]:
    return _done(
        "folders",
        {
            f"{folder} {name}": action
            for name, action in {
                "renamed": lambda: os.rename(folder, f"{folder}-gone"),
                "wrote": lambda: (folder / "planted").write_text("x"),
                "linked": lambda: os.symlink("/etc", folder / "planted-link"),
            }.items()
        },
    )


def _inside(folder: Path) -> list[str]:
    return _done(
        "folders",
        {f"{folder} listed": lambda: os.listdir(folder), f"{folder} entered": lambda: os.chdir(folder)},
    )


def _opened(path: Path, flags: int) -> None:
    os.close(os.open(path, flags | os.O_NONBLOCK))


def _file(path: Path) -> list[str]:
    return _done("files", {f"{path} read": lambda: _opened(path, os.O_RDONLY), **_changed(path)})


def _changed(path: Path) -> dict[str, Callable[[], Any]]:
    return {
        f"{path} changed": lambda: _opened(path, os.O_WRONLY),
        f"{path} removed": lambda: os.unlink(path),
        f"{path} given modes": lambda: os.chmod(path, 0o666),
    }


def _process(pid: int) -> list[str]:
    place = Path(f"/proc/{pid}")

    def attach() -> None:
        if ctypes.CDLL(None, use_errno=True).ptrace(_ATTACH, pid, None, None):
            raise OSError(ctypes.get_errno(), "")

    return _done(
        "processes",
        {
            f"{pid} {name}": action
            for name, action in {
                "environment": (place / "environ").read_bytes,
                "memory": lambda: _opened(place / "mem", os.O_RDWR),
                "descriptors": lambda: os.listdir(place / "fd"),
                "folder": lambda: os.listdir(place / "cwd"),
                "signal": lambda: os.kill(pid, 0),
                "attached": attach,
            }.items()
        },
    )


def _socket(path: str) -> list[str]:
    def connect() -> None:
        with socket.socket(socket.AF_UNIX) as made:
            made.settimeout(2)
            made.connect(path.replace("@", "\0", 1))

    return _done("sockets", {path: connect})


def _shown(secret: str) -> list[str]:
    """Return processes whose environment or command line shows the token."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        for name in ("environ", "cmdline"):
            _attempts["processes"] += 1
            with contextlib.suppress(OSError):
                if place.name != str(os.getpid()) and secret.encode() in (place / name).read_bytes():
                    found.append(f"{place.name}/{name}")
    return found


def _outside(ports: list[int]) -> list[int]:
    """Return the ports that are reached by the machine's own address."""
    found = []
    with contextlib.suppress(OSError, StopIteration):
        addresses = (str(a[4][0]) for a in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET))
        other = next(address for address in addresses if not address.startswith("127."))
        for port in ports:
            _attempts["ports from outside"] += 1
            with contextlib.suppress(OSError):
                socket.create_connection((other, port), 1).close()
                found.append(port)
    return found


def main() -> None:
    targets = json.load(sys.stdin)
    given = os.environ.pop("STRANGER_TOKEN", None)
    os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": given or "0" * 64}
    import ray  # noqa: F401  # where it is installed may be closed to others

    _become(targets["uid"])
    ports, get = targets["ports"], lambda name: targets.get(name, [])
    report = {
        "joined": _joined(targets["address"]),
        "requests": [f"{port} {told}" for port in ports for words in _REQUESTS if (told := _asked(port, *words))],
        "outside": _outside(ports),
        "closed folders": [told for name in get("closed") for told in (*_folder(Path(name)), *_inside(Path(name)))],
        "folders": [told for name in get("folders") for told in _folder(Path(name))],
        "closed files": [told for name in get("secrets") for told in _file(Path(name))],
        "files": [told for name in get("files") for told in _done("files", _changed(Path(name)))],
        "processes": [told for pid in get("processes") for told in _process(pid)],
        "sockets": [told for path in get("sockets") for told in _socket(path)],
        "shown": _shown(targets["secret"]),
    }
    print(
        json.dumps({"attempts": _attempts, "done": {name: told for name, told in report.items() if told}}), flush=True
    )
    os._exit(0)


if __name__ == "__main__":
    main()
