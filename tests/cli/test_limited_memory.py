"""The command where memory is limited: one line and a documented status, whatever native code makes of it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from tiers import quick, slow
from unrender.app.cli import memory, signals
from unrender.backend import limits
from unrender.core.errors import InputError
from unrender.estimators.path import PathGradient

resource = pytest.importorskip("resource")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of addresses are Linux's")

COMMAND = "import sys; sys.argv[0] = 'unrender'; import unrender; from unrender.app.cli import memory; "
RUN = "from unrender.app.cli.main import main; sys.exit(main())"
UNCHECKED = "memory._BASE = memory._PER_CORE = 0; "
"""The command begins under any limit."""
CONTAINER = "from unrender.backend import limits; limits.group_memory = lambda: 8 << 30; "
"""The command in a container of 8 GiB."""
DIES = """
import os

before = memory.supervised

def supervised():
    if (status := before()) is None:
        os.write(2, b"what native code says before it dies")
        os.kill(os.getpid(), {})
    return status

memory.supervised = supervised
"""
INTERRUPTED = """
import os, signal, time

os.setsid()
fork = os.fork

def forked():
    if child := fork():
        time.sleep(0.1)
        os.killpg(0, signal.SIGINT)
    else:
        time.sleep(0.3)
    return child

os.fork = forked
"""
"""Ctrl-C reaches both processes before either is ready for it."""
TOY = ["run", "exponential", "--method", "plain", "--final-spp", "1", "--out", "run"]


def start(folder: Path, words: list[str], limit: int | None = None, before: str = "") -> subprocess.Popen[str]:
    def limited() -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # shells ignore it for what they start in the background
        if limit:
            resource.setrlimit(resource.RLIMIT_AS, (limit << 10, limit << 10))

    return subprocess.Popen(
        [sys.executable, "-c", COMMAND + before + RUN, *words],
        cwd=folder,
        env={name: value for name, value in os.environ.items() if not name.startswith("COV_")},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=limited,
    )


def ended(process: subprocess.Popen[str], seconds: float = 120) -> tuple[int, str]:
    _, said = process.communicate(timeout=seconds)
    return process.returncode, said.removeprefix(f"unrender: {signals.WAITING}\n")


@pytest.mark.parametrize(
    ("limit", "words"),
    [
        (60_000, ["doctor"]),
        slow(300_000, ["methods", "rcv"]),
        (500_000, TOY),
        slow(600_000, ["compare", "exponential"]),
        (800_000, ["import", "photos"]),
    ],
)
def test_too_few_addresses_are_one_line(tmp_path: Path, limit: int, words: list[str]) -> None:
    """Dr.Jit waits for ever at 500000 kB, where it gets no thread."""
    status, said = ended(start(tmp_path, words, limit), 30)
    assert status == 3
    assert said.startswith(f"unrender: memory: ulimit -v allows {limit} kB of address space, expected at least ")
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_the_version_needs_little(tmp_path: Path) -> None:
    assert ended(start(tmp_path, ["--version"], 60_000)) == (0, "")


@pytest.mark.slow
def test_enough_addresses(tmp_path: Path) -> None:
    needed = (memory._BASE + memory._PER_CORE * limits.cores()) >> 10
    assert ended(start(tmp_path, [*TOY, "--steps", "2"], needed)) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize("limit", [200_000, 600_000, 650_000, 700_000, 725_000, 750_000])
def test_the_libraries_run_out_of_memory(tmp_path: Path, limit: int) -> None:
    """They raise, abort or crash, at another place each time."""
    words = ["run", "indirect-room", "-p", "resolution=16", "--steps", "2", "--final-spp", "1", "--out", "run"]
    status, said = ended(start(tmp_path, words, limit, UNCHECKED))
    assert status in (0, 3), said
    assert said.count("\n") == (status != 0), said
    assert status == 0 or "out of memory" in said


@pytest.mark.parametrize("name", ["SIGKILL", slow("SIGABRT"), slow("SIGSEGV")])
def test_a_container_ends_the_process(tmp_path: Path, name: str) -> None:
    """The kernel kills what takes too much; allocators abort."""
    number = int(signal.Signals[name])
    status, said = ended(start(tmp_path, ["methods"], None, CONTAINER + DIES.format(number)))
    assert (status, said.count("\n")) == (3, 1)
    assert said.startswith(
        f"unrender: out of memory (the container allows 8192 MB), it seems: {name} ended the process"
    )


@pytest.mark.parametrize("words", [["run", "nowhere.toml"], slow(["run", "--help"])])
def test_in_a_container_all_is_as_elsewhere(tmp_path: Path, words: list[str]) -> None:
    inside, outside = (start(tmp_path, words, None, before) for before in (CONTAINER, ""))
    assert [*inside.communicate(timeout=60), inside.returncode] == [
        *outside.communicate(timeout=60),
        outside.returncode,
    ]


@pytest.mark.parametrize("number", quick([signal.SIGINT, signal.SIGTERM], signal.SIGINT))
def test_signals_reach_a_run_in_a_container_once(tmp_path: Path, number: signal.Signals) -> None:
    process = start(tmp_path, [*TOY, "--steps", "1000000"], None, CONTAINER)
    history = tmp_path / "run" / "history.jsonl"
    until = time.monotonic() + 60
    while time.monotonic() < until and not (history.exists() and history.stat().st_size > 2000):
        time.sleep(0.05)
    os.kill(process.pid, number)
    words = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}[number]
    assert ended(process) == (128 + number, f"unrender: {words}\n")
    assert json.loads((tmp_path / "run" / "run.json").read_text())["stopped"] == words


def test_a_signal_between_the_processes_is_one_line(tmp_path: Path) -> None:
    process = start(tmp_path, [*TOY, "--steps", "1000000"], None, CONTAINER + INTERRUPTED)
    assert ended(process) == (130, "unrender: interrupted\n")


@pytest.mark.slow
def test_a_killed_parent_takes_the_command_along(tmp_path: Path) -> None:
    process = start(tmp_path, [*TOY, "--steps", "1000000"], None, CONTAINER)
    lists = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    until = time.monotonic() + 60
    while time.monotonic() < until and not (tmp_path / "run" / "history.jsonl").exists():
        time.sleep(0.05)
    (child,) = map(int, lists.read_text().split())
    process.kill()
    process.communicate(timeout=60)
    until = time.monotonic() + 10
    while time.monotonic() < until and _runs(child):
        time.sleep(0.02)
    assert not _runs(child)


def _runs(number: int) -> bool:
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("jit_malloc(): out of memory! Could not allocate 123 bytes of host memory."),
        OSError(12, "Cannot allocate memory"),
    ],
    ids=repr,
)
def test_a_run_without_memory(
    unrender, monkeypatch: pytest.MonkeyPatch, mitsuba_variant: str, error: Exception
) -> None:
    before = PathGradient.estimate

    def estimate(self: Any, problem: Any, parameters: Any, state: Any, key: Any) -> Any:
        if key.step == 5:
            raise error
        return before(self, problem, parameters, state, key)

    with monkeypatch.context() as patches:
        patches.setattr(PathGradient, "estimate", estimate)
        answer = unrender(*TOY, "--steps", 10, "--checkpoint-every", 2, "--variant", mitsuba_variant)
    assert answer.status == 3
    assert answer.error.startswith("unrender: out of memory; files of a run remain.")
    assert answer.error.count("\n") == 1
    assert json.loads(Path("run/run.json").read_text())["status"] == "failed"
    assert unrender("resume", "run").status == 0


def test_what_memory_is_blamed_for(monkeypatch: pytest.MonkeyPatch) -> None:
    error = RuntimeError("an error of its own")
    error.__cause__ = MemoryError()
    assert memory.says_so(error)
    for text in ("FlatVariables::traverse(): error encountered: std::bad_alloc", "can't start new thread"):
        assert memory.says_so(RuntimeError(text))
    assert not memory.exhausted(RuntimeError("a defect"))
    monkeypatch.setattr(limits, "address_space", lambda: limits.most_address_space() + 1000)
    assert memory.exhausted(ImportError("DLL load failed"))
    assert not memory.says_so(InputError("a name that nobody knows"))
