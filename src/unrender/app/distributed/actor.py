"""Process that holds shares of a problem's views. It must choose the variant before it imports modules that import Dr.Jit."""

from __future__ import annotations

import os
import socket
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from unrender.app.distributed.cluster import load_ray, prepare_worker
from unrender.backend import limits

if TYPE_CHECKING:
    from unrender.app.distributed.messages import Call, Reply
    from unrender.app.distributed.share import ViewShare
    from unrender.runs.folder.state import Packed


@dataclass(frozen=True)
class Place:
    """Location of a worker: machine, process, `free` bytes available to it if it were alone, of the GPU or of the machine, and GPU or
    ""."""

    machine: str
    process: int
    free: int
    gpu: str = ""


class ViewWorker:
    """A Ray actor: shares of a problem's views, one or more."""

    def __init__(self, variant: str, threads: int):
        self._variant = prepare_worker(variant, threads)
        self._shares: dict[int, ViewShare] = {}

    def place(self) -> Place:
        """Return the location of the worker. The first answer signals that it is ready."""
        gpu = os.environ.get("CUDA_VISIBLE_DEVICES", "") if self._variant.startswith("cuda") else ""
        free = limits.free_gpu_memory() if gpu else limits.free_memory()
        return Place(socket.gethostname(), os.getpid(), free, gpu)

    def alive(self) -> bool:
        """Return True. It runs in a thread of its own, so that it answers during a step."""
        return True

    def hold(self, share: int, views: tuple[int, ...], blob: bytes) -> None:
        """Build a share of the problem, replacing an earlier one. Raise `InputError` if this fails."""
        from unrender.app.distributed.share import ViewShare
        from unrender.app.distributed.transfer import unpacked
        from unrender.core.errors import prefixed

        with prefixed(f"worker on {socket.gethostname()}"):
            problem = unpacked(blob, load_ray())
        self._shares[share] = ViewShare(problem, views)

    def drop(self, share: int) -> None:
        """Delete a share. Do nothing if it does not exist."""
        self._shares.pop(share, None)

    def run(self, share: int, call: Call, arrays: dict[int, Any]) -> Reply:
        """Run a call, see `ViewShare.run`; `arrays` are the call's."""
        from dataclasses import replace

        return self._shares[share].run(replace(call, arrays=arrays))

    def store(self, share: int, number: int, packed: Packed) -> None:
        self._shares[share].store(number, packed)

    def fetch(self, share: int, number: int) -> Packed:
        return self._shares[share].fetch(number)
