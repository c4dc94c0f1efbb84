"""A machine that several people share, and home folders that all may enter: what another user can do to a sweep on workers and its page.

User 65534 tries it without a token, and with the one that Ray itself leaves in the home folder. It reads the results that the umask
opens, and nothing else: it runs no code, writes nothing, and sees no token.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.render.test_private_cluster import NOBODY, STRANGER, below, listening
from unrender.app.cli.signals import WAITING

SWEEP = [
    "sweep",
    "poster",
    "-p",
    "resolution=16",
    "-m",
    "plain",
    "--over",
    "learning_rate=0.003,0.01",
    "--final-spp",
    "2",
]
SWEEP += ["--steps", "1000000", "--threads", "1", "--workers", "2"]
HOME_TOKEN = "5" * 64


@pytest.fixture
def home() -> Iterator[Path]:
    """A home folder of mode 0755 with the token that Ray makes, of mode 0644; the temporary folder of tests is closed to others."""
    base = Path(tempfile.mkdtemp(prefix="u-", dir="/tmp"))
    before = os.umask(0o022)
    try:
        base.chmod(0o755)
        (base / "home" / ".ray").mkdir(parents=True)
        (base / "home" / ".ray" / "auth_token").write_text(HOME_TOKEN)
        yield base / "home"
    finally:
        os.umask(before)
        shutil.rmtree(base)


def start(home: Path, *words: str) -> subprocess.Popen[str]:
    names = ("RAY_", "XDG_", "UNRENDER_", "DRJIT_CACHE", "TMPDIR")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(names)}
    line = [sys.executable, "-m", "unrender", *words]
    return subprocess.Popen(
        line,
        cwd=home,
        env=environment | {"HOME": str(home), "RAY_worker_niceness": "0"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def environment_of(pid: int) -> dict[str, str]:
    pairs = (part.partition("=") for part in Path(f"/proc/{pid}/environ").read_text().split("\0"))
    return {name: value for name, _, value in pairs}


def unix_sockets(processes: list[int]) -> list[str]:
    """The names of the sockets on which processes listen."""
    inodes = {os.readlink(path) for pid in processes for path in Path(f"/proc/{pid}/fd").iterdir() if path.is_symlink()}
    rows = (line.split() for line in Path("/proc/net/unix").read_text().splitlines()[1:])
    return sorted({row[7] for row in rows if len(row) > 7 and f"socket:[{row[6]}]" in inodes})


def shared_memory(processes: list[int]) -> list[str]:
    """Return the files of shared memory that processes use, and that have a name."""
    maps = (line.split() for pid in processes for line in Path(f"/proc/{pid}/maps").read_text().splitlines())
    return sorted({row[5] for row in maps if len(row) == 6 and row[5].startswith("/dev/shm/")})


def targets(home: Path, processes: list[int]) -> dict[str, Any]:
    """Return all that there is to attack, as root finds it."""
    words = " ".join(Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ") for pid in processes)
    (folder,) = {found.group() for found in re.finditer(r"/tmp/unrender-ray-[^/ ]+", words)}
    address = re.search(r"--gcs-address=(\S+)", words)
    assert address is not None
    paths = [path for path in home.rglob("*") if not path.is_symlink()]
    caches = [path for path in paths if path.is_dir() and not path.stat().st_mode & 0o077]
    assert caches  # that of the kernels, which are code
    return {
        "uid": NOBODY,
        "address": address.group(1),
        "secret": next(token for pid in processes if (token := environment_of(pid).get("RAY_AUTH_TOKEN"))),
        "ports": sorted(listening(processes)),
        "processes": processes,
        "sockets": unix_sockets(processes),
        "closed": [folder, *map(str, caches)],
        "secrets": [str(path) for cache in (Path(folder), *caches) for path in cache.rglob("*") if path.is_file()],
        "folders": [str(home), *(str(path) for path in paths if path.is_dir() and path not in caches)],
        "files": [*(str(path) for path in paths if path.is_file()), *shared_memory(processes)],
    }


def attack(given: dict[str, Any], token: str = "") -> dict[str, Any]:
    """Return what user 65534 tried and could do."""
    environment = {**os.environ, "RAY_DISABLE_IMPORT_WARNING": "1"} | ({"STRANGER_TOKEN": token} if token else {})
    done = subprocess.run(
        [sys.executable, str(STRANGER)],
        input=json.dumps(given),
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0 or sys.platform != "linux", reason="only root can act as another user")
def test_another_user_runs_nothing_reads_no_secret_and_writes_nothing(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("ray")
    sweep, page = start(home, *SWEEP, "--out", "sweep"), None
    try:
        until = time.monotonic() + 400
        while len(list(home.glob("sweep/trial-*/checkpoints/*/manifest.json"))) < 2:
            assert sweep.poll() is None, sweep.communicate()
            assert time.monotonic() < until
            time.sleep(0.1)
        page = start(home, "watch", "sweep", "--no-browser")
        assert page.stdout is not None
        secret_of_page = page.stdout.readline().rsplit("/", 2)[1]
        given = targets(home, [*below(sweep.pid), *below(page.pid)])
        said = {}
        for name, token in {"without a token": "", "with the token of the home folder": HOME_TOKEN}.items():
            said[name] = attack(given, token)
            assert said[name]["done"] == {}, name
        assert attack({**given, "secret": secret_of_page, "ports": []})["done"] == {}
        # The attempts are real: with the cluster's own token, which it cannot read, the same user is let in.
        assert attack(given, given["secret"])["done"]["joined"].endswith("wrote")
        os.killpg(sweep.pid, signal.SIGINT)
        _, error = sweep.communicate(timeout=60)
        assert (sweep.returncode, error.removeprefix(f"unrender: {WAITING}\n")) == (130, "unrender: interrupted\n")
        assert not list(home.rglob("planted*"))
        with capsys.disabled():
            print("".join(f"\n{name}: {told['attempts']}, came to nothing" for name, told in said.items()), end="")
    finally:
        for process in (sweep, page):
            if process is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.communicate()
