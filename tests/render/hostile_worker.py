"""Takes in hostile inputs in a process of its own, and tells of each how it ended, in which time and in how much memory.

`python hostile_worker.py MODULE TABLE FOLDER < names`: of each name of the table, a line of JSON. A parent sees by a missing line where the
process died or went on for too long, and starts another for the rest.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Outcome", "take_in"]

_HERE = Path(__file__).resolve()
_MEMORY = 4 << 30
"""Bytes of address space beyond what the process has when it begins."""


@dataclass(frozen=True)
class Outcome:
    """How an input was taken in.

    Attributes:
        name: of the input.
        said: the line by which it was refused, "" where it was not; what went wrong, where something else happened.
        kind: "refused", "taken", "raised", "died" or "hung".
        seconds: of the processor, the process's own and its children's.
        wall: seconds of the clock.
        bytes: of memory at most, beyond what the process had before.
    """

    name: str
    said: str
    kind: str
    seconds: float = 0.0
    wall: float = 0.0
    bytes: int = 0


def take_in(
    module: str,
    table: str,
    names: list[str],
    folder: Path,
    limit: float = 20.0,
    note: Callable[[Outcome], None] = lambda outcome: None,
) -> list[Outcome]:
    """Take in the inputs of these names of a module's table, in processes that end where one hangs for `limit` seconds of the clock.

    `note` is called with each outcome as it comes.
    """
    left, found = list(names), []
    while left:
        outcomes, end = _one_process(module, table, left, folder, limit, note)
        found += outcomes
        left = left[len(outcomes) :]
        if left and end:
            found.append(Outcome(left.pop(0), "", end))
            note(found[-1])
        elif left:
            raise RuntimeError("the process of hostile inputs ended too soon")
    return found


def _one_process(
    module: str, table: str, names: list[str], folder: Path, limit: float, note: Callable[[Outcome], None]
) -> tuple[list[Outcome], str]:
    command = [sys.executable, str(_HERE), module, table, str(folder)]
    (folder / "names").write_text("".join(f"{name}\n" for name in names))  # more than a pipe holds
    with (folder / "errors").open("wb") as errors, (folder / "names").open("rb") as given:
        process = subprocess.Popen(command, stdin=given, stdout=subprocess.PIPE, stderr=errors, cwd=folder)
    assert process.stdout is not None
    outcomes: list[Outcome] = []
    os.set_blocking(process.stdout.fileno(), False)
    data, last, end = b"", time.monotonic() + 60, ""
    while True:
        block = process.stdout.read()
        if block == b"":
            break
        if block is None:
            if time.monotonic() - last > limit:
                end = "hung"
                process.kill()
                break
            time.sleep(0.02)
            continue
        data += block
        *lines, data = data.split(b"\n")
        for line in lines:
            outcomes.append(Outcome(**json.loads(line)))
            note(outcomes[-1])
        last = time.monotonic()
    process.stdout.close()
    status = process.wait()
    return outcomes, end or ("died" if status else "")


def _tell(module: str, table: str, folder: Path) -> None:
    from unrender.backend import variant
    from unrender.core.errors import InputError

    variant.use(variant.LLVM)
    report = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what the package prints is no report
    home = importlib.import_module(module)
    inputs = getattr(home, table)
    warm = folder / f"{os.getpid()}-warm"
    warm.mkdir()
    names = sys.stdin.read().splitlines()
    home.warm_up(warm, names)
    limit = _status("VmSize") + _MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for number, name in enumerate(names):
        place = folder / f"{os.getpid()}-{number}"
        place.mkdir()
        call = inputs[name](place)
        before, started, clock = _memory(), _seconds(), time.monotonic()
        kind, said = "taken", ""
        try:
            call()
        except InputError as error:
            kind, said = "refused", str(error)
        except BaseException as error:
            kind, said = "raised", f"{type(error).__name__}: {str(error)[:300]}"
        found = Outcome(name, said, kind, _seconds() - started, time.monotonic() - clock, _peak() - before)
        shutil.rmtree(place, ignore_errors=True)
        report.write(json.dumps(found.__dict__) + "\n")
        report.flush()


def _seconds() -> float:
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def _memory() -> int:
    """Bytes that the process has, from which on `_peak` counts; those at its peak where the system cannot count anew."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return _peak()
    return _status("VmRSS")


def _peak() -> int:
    try:
        return _status("VmHWM")
    except StopIteration:  # a kernel without it
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def _status(name: str) -> int:
    """A size of /proc/self/status, in bytes."""
    text = Path("/proc/self/status").read_text()
    return next(int(line.split()[1]) << 10 for line in text.splitlines() if line.startswith(f"{name}:"))


if __name__ == "__main__":
    _tell(sys.argv[1], sys.argv[2], Path(sys.argv[3]))
