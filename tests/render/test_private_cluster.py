"""A cluster that is started here, and other users of the machine: no code, no read, no write; nothing is left after a kill."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from unrender.app.distributed.cluster import Workers, connect
from unrender.app.distributed.cluster.private import private_cluster, private_folder
from unrender.core.errors import InputError

ray: Any = None


@pytest.fixture(autouse=True, scope="module")
def with_ray() -> None:
    """Import the extra here, not at collection: every test process would take a second for it."""
    global ray
    ray = pytest.importorskip("ray")


STRANGER = Path(__file__).with_name("stranger_of_ray.py")
NOBODY = 65534
SLEEPER = """
import sys, time
from unrender.app.distributed.cluster.private import private_folder
with private_folder() as folder:
    (folder / "r").mkdir()
    print(folder, flush=True)
    time.sleep(600)
"""

ACTION = """
import contextlib, ctypes, signal, sys
from unrender.app.distributed.cluster import Workers, connect, connection
def action():
    found = ctypes.create_string_buffer(1024)
    ctypes.CDLL(None).sigaction(signal.SIGTERM, None, found)
    return found.raw[:8]  # of a pointer to the handler
ray = connection.load_ray()
signal.signal(signal.SIGTERM, lambda *_: None)
begin, before, same = ray.init, action(), []
def init(**options):
    begin(**options)
    same.append(action() == before)
ray.init = init
connection._restored_action = lambda number: contextlib.nullcontext()
with connect(Workers(1), "llvm_ad_rgb", store_bytes=80 << 20):
    same.append(action() == before)
print(*same, action() == before)
"""

RAISES = """
import os, signal, sys, threading, time
from unrender.app.distributed.cluster import Workers, connect
class Mine(Exception): pass
def handler(number, frame):
    raise SystemExit(7) if sys.argv[1] == "exit" else Mine
with connect(Workers(1), "llvm_ad_rgb", store_bytes=80 << 20) as cluster:
    ray = cluster.ray
    wait = cluster.wait if sys.argv[2] == "here" else lambda of, count, seconds: ray.wait(of, num_returns=count, timeout=seconds)
    signal.signal(signal.SIGTERM, handler)
    task = ray.remote(lambda: time.sleep(30)).remote()
    threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGTERM)).start()
    try:
        wait([task], 1, 5.0)
        print("ignored")
    except Mine:
        print("raised")
    finally:
        print(cluster.get(ray.put("connected")), flush=True)
"""


def below(root: int) -> list[int]:
    """A process and all that descend from it."""
    parents = {}
    for place in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(place.name)] = int((place / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    found = [root]
    for pid in found:
        found += [child for child, parent in parents.items() if parent == pid]
    return found


def listening(processes: list[int]) -> dict[int, str]:
    """{port: address in hexadecimal} of the TCP sockets on which processes listen."""
    sockets = set()
    for pid in processes:
        for descriptor in Path(f"/proc/{pid}/fd").glob("*"):
            try:
                sockets.add(os.readlink(descriptor).removeprefix("socket:[").removesuffix("]"))
            except OSError:
                continue
    found = {}
    for table in ("tcp", "tcp6"):
        for line in Path("/proc/net", table).read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A" and words[9] in sockets:
                address, _, port = words[1].partition(":")
                found[int(port, 16)] = address
    return found


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A home folder without Ray's."""
    folder = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patches:
        patches.setenv("HOME", str(folder))
        for name in ("RAY_ADDRESS", "RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"):
            patches.delenv(name, raising=False)
        yield folder


@pytest.fixture(scope="module")
def cluster(home: Path) -> Iterator[dict[str, Any]]:
    """What there is to know of a running cluster of one worker."""
    with connect(Workers(1), "llvm_ad_rgb", store_bytes=80 << 20) as connected:
        assert ray.get(ray.remote(lambda: 1).remote())
        session = Path(ray._private.worker._global_node.get_session_dir_path())
        processes = below(os.getpid())
        yield {
            "address": connected.head._address,
            "folder": session.parents[1],
            "processes": processes,
            "ports": listening(processes),
            "token": os.environ["RAY_AUTH_TOKEN"],
        }


def test_it_listens_on_the_loopback_alone(cluster: dict[str, Any]) -> None:
    assert len(cluster["ports"]) >= 5, cluster["ports"]
    assert {address[-8:] for address in cluster["ports"].values()} == {"0100007F"}  # 127.0.0.1, also within IPv6


def test_its_token_is_nowhere_but_in_the_environment(cluster: dict[str, Any], home: Path) -> None:
    assert not list(home.iterdir())
    secret = cluster["token"].encode()
    assert len(secret) == 64
    for path in cluster["folder"].rglob("*"):
        if path.is_file() and not path.is_symlink():
            assert secret not in path.read_bytes(), path
    for pid in cluster["processes"]:
        assert secret not in Path(f"/proc/{pid}/cmdline").read_bytes()


def test_its_folder_is_closed(cluster: dict[str, Any]) -> None:
    assert cluster["folder"].stat().st_mode & 0o777 == 0o700


def stranger(cluster: dict[str, Any], token: str = "") -> dict[str, Any]:
    """What user 65534 tries and can do, with a token where it is given."""
    targets = {
        "uid": NOBODY,
        "address": cluster["address"],
        "ports": list(cluster["ports"]),
        "secret": cluster["token"],
    }
    targets |= {"closed": [str(cluster["folder"])], "processes": cluster["processes"]}
    environment = {**os.environ, "RAY_DISABLE_IMPORT_WARNING": "1"} | ({"STRANGER_TOKEN": token} if token else {})
    words = [sys.executable, str(STRANGER)]
    done = subprocess.run(
        words, input=json.dumps(targets), env=environment, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as another user")
def test_a_stranger_neither_reads_nor_writes_nor_joins(cluster: dict[str, Any]) -> None:
    found = stranger(cluster)
    assert found["done"] == {}
    assert found["attempts"]["joins"] == 1
    # The attempts are real: with the token, which it has no way to read, the same stranger is let in.
    assert stranger(cluster, cluster["token"])["done"]["joined"].endswith("wrote")


def test_the_environment_is_as_before_afterwards(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", "/nowhere")
    before = dict(os.environ)
    with private_cluster(ray) as arguments:
        assert os.environ["RAY_AUTH_MODE"] == "token"
        assert "RAY_AUTH_TOKEN_PATH" not in os.environ
        folder = Path(arguments["_temp_dir"]).parent
        assert folder.is_dir()
    assert not folder.exists()
    assert dict(os.environ) == before


@pytest.mark.slow
@pytest.mark.parametrize("setting", ["1", "0"])
def test_no_compiled_handler_of_sigterm_is_installed_while_ray_starts(setting: str, home: Path) -> None:
    """Nothing else restores the action here. The planted fault is Ray without its setting."""
    environment = os.environ | ({"RAY_DISABLE_FAILURE_SIGNAL_HANDLER": "0"} if setting == "0" else {})
    words = [sys.executable, "-c", ACTION]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout.split()) == (0, [str(setting == "1"), "True", "True"]), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "wait", "code", "lines"),
    [
        ("exit", "here", 7, ["connected"]),
        ("exception", "here", 0, ["raised", "connected"]),
        ("exit", "ray", 1, ["connected"]),  # the planted faults: Ray's own wait
        ("exception", "ray", 1, ["connected"]),
    ],
)
def test_a_handler_of_a_signal_may_raise_anything_while_workers_are_awaited(
    kind: str, wait: str, code: int, lines: list[str], home: Path
) -> None:
    words = [sys.executable, "-c", RAISES, kind, wait]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout.split()) == (code, lines), done.stderr
    assert ("SystemError" in done.stderr) is ((kind, wait) == ("exception", "ray")), done.stderr


def test_a_killed_driver_leaves_no_folder() -> None:
    process = subprocess.Popen([sys.executable, "-c", SLEEPER], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    folder = Path(process.stdout.readline().strip())
    assert folder.is_dir()
    process.kill()
    process.communicate()
    until = time.monotonic() + 20
    while folder.exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert not folder.exists()


def test_the_next_start_removes_what_is_left_and_nothing_that_is_in_use(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where the watching process was killed, too."""
    base = Path(tempfile.mkdtemp(prefix="u-", dir="/tmp"))
    monkeypatch.setattr(tempfile, "tempdir", str(base))
    try:
        with private_folder() as used:
            assert used.parent == base
            left = base / "unrender-ray-left"
            left.mkdir()
            (left / "lock").touch()
            begun = base / "unrender-ray-begun"
            begun.mkdir()
            target = tmp_path_factory.mktemp("other")
            (target / "lock").touch()
            (base / "unrender-ray-link").symlink_to(target)
            with private_folder() as second:
                assert not left.exists()
                assert used.exists()
                assert second.exists()
                assert begun.exists()  # may be one that begins right now
                assert target.exists()
    finally:
        subprocess.run(["rm", "-rf", str(base)], check=True)


def test_a_temporary_folder_that_others_can_change_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    base = Path(tempfile.mkdtemp(prefix="u-", dir="/tmp"))
    try:
        inner = base / "t"
        inner.mkdir()
        for mode, used in ((0o777, False), (0o1777, True), (0o700, True)):
            inner.chmod(mode)
            base.chmod(0o755)
            monkeypatch.setattr(tempfile, "tempdir", str(inner))
            with private_folder() as folder:
                assert (folder.parent == inner) is used
        inner.chmod(0o700)
        base.chmod(0o777)  # `inner` itself could be replaced
        with private_folder() as folder:
            assert folder.parent != inner
    finally:
        subprocess.run(["rm", "-rf", str(base)], check=True)


def test_ray_without_tokens_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(ray._raylet, "AuthenticationTokenLoader")
    line = r"does not support tokens; install a newer version: pip install 'ray>=2\.52'"
    with pytest.raises(InputError, match=line), private_cluster(ray):
        pass


def test_sockets_fit_their_limit() -> None:
    with private_folder() as folder:
        longest = folder / "r/session_2026-01-01_00-00-00_000000_4194304/sockets/plasma_store"
        assert len(os.fsencode(longest)) <= 107
