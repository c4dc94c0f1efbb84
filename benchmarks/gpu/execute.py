"""Run a slice: its commands one after the other, each a process of its own, within so many minutes."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.gpu.plan import Command, Folder, Slice, State
from benchmarks.runner.catalogue import ROOT

_GRACE = 10.0
"""Seconds from the request to end to the end by force; a part of the minutes."""


def words(part: Slice, command: Command, folder: Folder) -> list[str]:
    """The command line."""
    arguments = command.arguments(folder.is_toy)
    match command.name:
        case "doctor":
            return [sys.executable, "-m", "unrender", "doctor", *arguments]
        case "tests":
            return [sys.executable, "-m", "pytest", "-q", "-n", "auto", "--dist", "loadfile", *arguments]
        case name:
            return [
                sys.executable,
                "-m",
                "benchmarks",
                name,
                *arguments,
                "--out",
                _relative(folder.path / part.name / name),
            ]


def run_slice(part: Slice, folder: Folder, where: State, minutes: float) -> str:
    """Run what has not ended yet, and note it; the slice's summary.

    Args:
        part: the slice.
        folder: of states and records.
        where: the device.
        minutes: for the whole slice; a command that would go on is ended, and noted as cut short. The next time it begins
            anew.
    """
    until = time.monotonic() + 60 * minutes
    for number, command in enumerate(part.commands):
        if folder.ended(part, command) in ("done", "failed"):
            continue
        seconds = until - time.monotonic()
        if seconds <= _GRACE:
            break
        log = ROOT / "out" / "benchmarks" / ("gpu-toy" if folder.is_toy else "gpu") / f"{part.name}-{number}.log"
        print(f"{part.name}: {command.words}", flush=True)
        entry = _run(words(part, command, folder), log, seconds, where)
        folder.note(part, command, where, entry)
        print(f"  {entry['ended']} after {entry['seconds']:.0f} s; {_relative(log)}", flush=True)
    return folder.summary(part)


def _run(line: list[str], log: Path, seconds: float, where: State) -> State:
    log.parent.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "UNRENDER_VARIANT": where["variant"]}
    began = time.monotonic()
    with log.open("w") as file:
        process = subprocess.Popen(
            line, cwd=ROOT, stdout=file, stderr=subprocess.STDOUT, env=environment, start_new_session=True
        )
        try:
            status: int | None = process.wait(seconds - _GRACE)
        except subprocess.TimeoutExpired:
            status = None
        finally:
            _end(process)
    entry: State = {
        "ended": "cut short" if status is None else "failed" if status else "done",
        "seconds": round(time.monotonic() - began, 1),
        "date": time.strftime("%Y-%m-%d %H:%M"),
    }
    if status:
        entry["status"] = status
    if status or "pytest" in line:  # the last line of tests has their number
        entry["last_line"] = _last_line(log)
    return entry


def _end(process: subprocess.Popen[bytes]) -> None:
    """The process and those that it began, if it still runs: asked first, then by force."""
    for sent in (signal.SIGTERM, signal.SIGKILL):
        if process.poll() is not None:
            return
        os.killpg(process.pid, sent)
        try:
            process.wait(_GRACE / 2)
        except subprocess.TimeoutExpired:
            continue


def _last_line(log: Path) -> str:
    """The last line that says something, without the repository's path."""
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if re.search(r"\w", line)]
    return lines[-1][:300].replace(f"{ROOT}/", "") if lines else ""


def _relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else str(path)
