"""The victims' process, and a disk whose power can be cut."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

from benchmarks.runner.catalogue import ROOT

__all__ = ["KILLED", "Disk", "Victims"]

KILLED = -signal.SIGKILL
_SHUTDOWN, _WITHOUT_FLUSH = 0x8004587D, 2
_MEGABYTES = 64


class Victims:
    """Carries out commands, one after the other, and kills them. A context manager."""

    def __enter__(self) -> Victims:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "src")])}
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        words = [sys.executable, "-m", "tests.campaigns.victim"]
        self._process = subprocess.Popen(words, env=environment, cwd=ROOT, **pipes)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._process.wait(timeout=600)
        if self._process.stdout is not None:
            self._process.stdout.close()

    def begin(self, *words: object, **order: Any) -> int:
        """Start a command. Returns its process id."""
        self._send({"words": [str(word) for word in words], **order})
        return int(self._receive())

    def end(self) -> int:
        """Wait for it. Returns its exit status, `KILLED` where it was."""
        return int(self._receive())

    def carry_out(self, *words: object, **order: Any) -> int:
        """Start a command and wait for it."""
        self.begin(*words, **order)
        return self.end()

    def kill(self, pid: int) -> None:
        """Kill a command that was begun and not waited for."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)

    def _send(self, order: dict[str, Any]) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()

    def _receive(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()


class Disk:
    """ext4 in a file, on a loop device. Only root can have one.

    It is mounted with a commit interval of minutes: nothing reaches the disk by itself while a run goes.

    Args:
        folder: for the file and the place where it is mounted.
    """

    def __init__(self, folder: Path):
        self._image, self.place = folder / "disk.img", folder / "disk"

    def make(self) -> None:
        """An empty one."""
        self._image.unlink(missing_ok=True)
        with self._image.open("wb") as file:
            file.truncate(_MEGABYTES << 20)
        _call("mkfs.ext4", "-q", "-F", self._image)
        self.place.mkdir(exist_ok=True)

    @contextlib.contextmanager
    def mounted(self) -> Iterator[Path]:
        """Where it is mounted, meanwhile."""
        _call("mount", "-o", "loop,commit=300", self._image, self.place)
        try:
            yield self.place
        finally:
            for _ in range(100):  # a process that was killed may still hold it
                if subprocess.run(["umount", str(self.place)], capture_output=True, check=False).returncode == 0:
                    break
                time.sleep(0.05)
            else:
                raise RuntimeError(f"{self.place} cannot be unmounted")

    def cut(self) -> None:
        """Cut the power: nothing more reaches the disk, what was not flushed is lost. It is to be mounted again."""
        folder = os.open(self.place, os.O_RDONLY)
        try:
            fcntl.ioctl(folder, _SHUTDOWN, struct.pack("I", _WITHOUT_FLUSH))
        finally:
            os.close(folder)


def _call(*words: object) -> None:
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{words[0]}: {' '.join(done.stderr.split())[:300]}")
