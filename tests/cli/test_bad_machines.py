"""Machines in a bad state: full disks, poisoned or shared caches, moved clocks, file systems without locks."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from unrender.runs.folder import reader

WORDS = ["run", "exponential", "--method", "plain", "--set", "spp=2", "--final-spp", "1"]
SCENE = ["run", "indirect-room", "-p", "resolution=8", "-p", "texture_resolution=4", "-p", "reference_spp=8"]
SCENE += ["--method", "plain", "--steps", "2", "--final-spp", "1", "--threads", "1"]
COMMAND = "import sys; sys.argv[0] = 'unrender'; from unrender.app.cli.main import main; sys.exit(main())"


def start(folder: Path, *words: str, before: str = "", **environment: str) -> subprocess.Popen[str]:
    line = [sys.executable, "-c", before + COMMAND, *words]
    kept = os.environ | environment
    return subprocess.Popen(line, cwd=folder, env=kept, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, said = process.communicate(timeout=300)
    return process.returncode, said


def losses(run: Path) -> list[float]:
    return [json.loads(line)["loss"] for line in (run / "history.jsonl").read_text().splitlines()]


@contextlib.contextmanager
def small_disk(place: Path, options: str) -> Iterator[None]:
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(place)]
    if os.geteuid() or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("needs root, to mount a small file system")
    try:
        yield
    finally:
        subprocess.run(["umount", str(place)], check=True)


@pytest.mark.slow
@pytest.mark.parametrize("full", ["size=40k", "size=200k", "nr_inodes=4", "nr_inodes=12"])
def test_a_full_disk_is_one_line_and_the_run_goes_on_later(tmp_path: Path, full: str) -> None:
    """Bytes or inodes run out in the midst of a run."""
    disk = tmp_path / "disk"
    with small_disk(disk, full):
        status, said = ended(start(disk, *WORDS, "--steps", "1500", "--checkpoint-every", "200", "--out", "run"))
        assert status == 2
        *notices, last = said.splitlines()
        assert last.startswith("unrender: ")
        assert "No space left on device" in last
        assert all(line.startswith("run folder run: ") for line in notices)
        assert all(("the run continues" in line) != ("end not written" in line) for line in notices)
        subprocess.run(["mount", "-o", "remount,size=50m,nr_inodes=1000", str(disk)], check=True)
        if (disk / "run" / "run.json").exists():
            reader.read(disk / "run")
            status, said = ended(start(disk, "resume", "run"))
            assert (status, said) == (0, "")
        status, said = ended(start(disk, *WORDS, "--steps", "5", "--out", "run", "--overwrite"))
        assert (status, said) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["sweep", "exponential", "-m", "plain", "--over", "learning_rate=0.003,0.01", "--steps", "20"],
        ["run", "two-planets", "-p", "resolution=16", "-p", "texture_resolution=8", "-p", "reference_spp=8"]
        + ["--method", "plain", "--steps", "3"],
    ],
    ids=lambda words: words[0],
)
def test_workers_in_a_container_with_64_megabytes_of_shared_memory(tmp_path: Path, words: list[str]) -> None:
    pytest.importorskip("ray")
    mounted = 'mount -t tmpfs -o size=64m tmpfs /dev/shm && exec "$@"'
    if os.geteuid() or subprocess.run(["unshare", "-m", "true"], capture_output=True, check=False).returncode:
        pytest.skip("needs root, to mount a small file system")
    line = ["unshare", "-m", "sh", "-c", mounted, "sh", sys.executable, "-c", COMMAND, *words]
    line += ["--workers", "2", "--final-spp", "1", "--out", "out"]
    kept = os.environ | {"RAY_worker_niceness": "0"}
    done = subprocess.run(line, cwd=tmp_path, env=kept, capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
def test_damaged_and_exchanged_kernels_change_nothing(tmp_path: Path) -> None:
    """Those of the cache are code; a damaged one is compiled anew."""
    cache = tmp_path / "kernels"
    cache.mkdir()
    assert ended(start(tmp_path, *SCENE, "--out", "sound", DRJIT_CACHE_DIR=str(cache)))[0] == 0
    kernels = {path: path.read_bytes() for path in sorted(cache.glob("*.bin"))}
    assert kernels
    draw = random.Random(0)
    exchanged = dict(zip(kernels, [*list(kernels.values())[1:], next(iter(kernels.values()))], strict=True))
    changes: dict[str, Any] = {
        "halves": lambda path, data: data[: len(data) // 2],
        "zeros": lambda path, data: data[: len(data) // 2] + bytes(len(data) - len(data) // 2),
        "noise": lambda path, data: draw.randbytes(len(data)),
        "bits": lambda path, data: bytes([*data[:-1], data[-1] ^ 1]),
        "exchanged": lambda path, data: exchanged[path],
    }
    for name, change in changes.items():
        for path, data in kernels.items():
            path.write_bytes(change(path, data))
        assert ended(start(tmp_path, *SCENE, "--out", name, DRJIT_CACHE_DIR=str(cache)))[0] == 0, name
        assert losses(tmp_path / name) == losses(tmp_path / "sound"), name


@pytest.mark.slow
def test_processes_that_fill_one_cache_together(tmp_path: Path) -> None:
    names = ["one", "two", "three"]
    caches = {"DRJIT_CACHE_DIR": str(tmp_path), "UNRENDER_CACHE_DIR": str(tmp_path / "cache")}
    processes = [start(tmp_path, *SCENE, "--out", name, **caches) for name in names]
    assert [ended(process) for process in processes] == 3 * [(0, "")]
    assert losses(tmp_path / "one") == losses(tmp_path / "two") == losses(tmp_path / "three")


@pytest.mark.slow
def test_a_clock_that_jumps(unrender, monkeypatch: pytest.MonkeyPatch, mitsuba_variant: str) -> None:
    """By decades, in both directions, while a run goes on: it is timed by another clock."""
    real, calls = time.time, []

    def jumping() -> float:
        calls.append(1)
        return max(real() + (-1) ** len(calls) * 1e9, 1.0)

    monkeypatch.setattr(time, "time", jumping)
    started = time.perf_counter()
    words = [*WORDS, "--seconds", 1, "--variant", mitsuba_variant]
    assert unrender(*words, "--out", "run").status == 0
    assert 0.4 < time.perf_counter() - started < 100  # steps have half of the second at least
    assert json.loads(Path("run/run.json").read_text())["seconds"] == pytest.approx(1, abs=2)
    assert unrender("report", "run").status == 0


def test_a_file_system_without_locks(unrender, monkeypatch: pytest.MonkeyPatch, mitsuba_variant: str) -> None:
    def flock(file: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", flock)
    words = [*WORDS, "--variant", mitsuba_variant]
    assert unrender(*words, "--steps", 3, "--out", "run").status == 0
    holder = {"pid": os.getppid(), "host": "another", "started": "yesterday"}
    Path("run/lock").write_text(json.dumps(holder))
    answer = unrender("resume", "run", "--steps", 5)
    assert answer.refuses("in use by")
    Path("run/lock").unlink()
    assert unrender("resume", "run", "--steps", 5).status == 0
