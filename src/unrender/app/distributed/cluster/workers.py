"""Number of workers, their location and resources. This module does not need Ray."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from unrender.backend import limits, variant
from unrender.core.errors import InputError

_prepared: list[tuple[str, int]] = []


def prepare_worker(name: str, threads: int) -> str:
    """Choose the variant and the number of threads, once per process, and return the variant. Later calls with the same arguments do
    nothing. Raises `VariantError` if this machine does not support it."""
    chosen = variant.use(name)
    if (name, threads) not in _prepared:
        variant.use_threads(threads)
        _prepared[:] = [(name, threads)]
    return chosen


_ADDRESS = re.compile(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9](?:[A-Za-z0-9._-]*[A-Za-z0-9])?):([0-9]{1,5})\Z")
_MOST = 100_000
_WORKER_BYTES = 512 << 20  # memory of a worker with its libraries and a small problem


@dataclass(frozen=True)
class Workers:
    """Value of `--workers`.

    Attributes:
        count: number of workers; None for one per GPU, or one per processor core without GPUs.
        address: HOST:PORT of a Ray cluster to join; None for this machine (or for the cluster of RAY_ADDRESS).
        insecure: whether to join a cluster that other users can enter.
    """

    count: int | None = None
    address: str | None = None
    insecure: bool = False

    @classmethod
    def parse(cls, text: str, option: str = "--workers") -> Workers:
        """Parse `auto`, a number, HOST:PORT, or NUMBER@HOST:PORT. Raise `InputError`."""
        number, at, address = text.strip().rpartition("@")
        if not at and not _ADDRESS.match(address):
            number, address = address, ""
        counted = number in ("", "auto") or (number.isascii() and number.isdigit() and 1 <= int(number[:7]) <= _MOST)
        located = not (at or address) or (
            (match := _ADDRESS.match(address)) is not None and 0 < int(match.group(2)) < 65536
        )
        if not counted or not located or not text.strip():
            if "://" in text:
                hint = "; start the command on a machine of the cluster, and give the address of its head node"
            else:
                hint = ""
            raise InputError(
                f"{option} {text}: expected auto, a number, the address HOST:PORT of a Ray cluster, or NUMBER@HOST:PORT{hint}"
            )
        return cls(None if number in ("", "auto") else int(number), address or None)


@dataclass(frozen=True)
class Share:
    """Number of workers, and resources of each: `cpus` is an integer, or 1/k if k workers share a core; `gpus` is 0, 1, or 1/k."""

    count: int
    cpus: float
    gpus: float

    @property
    def threads(self) -> int:
        """Threads of the processor for each worker."""
        return max(1, int(self.cpus))


def share(machines: Sequence[tuple[float, float]], count: int | None, gpu: bool, most: int | None = None) -> Share:
    """Return how workers share the machines.

    Args:
        machines: (cores, GPUs) of each machine.
        count: number of workers; None for one per GPU, or one per core without `gpu`.
        gpu: whether they compute on GPUs.
        most: maximum useful number of workers if `count` is None; None for no maximum.

    Raises:
        InputError: no machine has a core (a GPU).
    """
    cores = [int(c) for c, g in machines if c >= 1 and (not gpu or g >= 1)]
    gpus = [int(g) for c, g in machines if c >= 1 and g >= 1]
    devices = gpus if gpu else cores
    if not devices:
        raise InputError(f"workers: the cluster has no machine with a {'GPU' if gpu else 'processor core'} to use")
    total = sum(devices)
    count = min(total, most or total) if count is None else count
    if not gpu:
        return Share(count, _most_each(cores, count), 0.0)
    each = min(_most_each(gpus, count), 1.0)
    fitting = [int(g / each + 1e-9) for g in gpus]
    per_worker = min(c // n if c >= n else 1 / -(-n // c) for c, n in zip(cores, fitting, strict=True))
    return Share(count, float(per_worker), each)


def most_by_memory(most: int | None) -> int | None:
    """Return the maximum number of workers for the free memory of this machine or container, 512 MiB each; `most` if that is unknown."""
    free = limits.free_memory()
    if not free:
        return most
    fitting = max(1, free // _WORKER_BYTES)
    return fitting if most is None else min(most, fitting)


def _most_each(devices: Sequence[int], count: int) -> float:
    """Return the maximum number of devices for each of `count` workers, without workers across machines: an integer, or 1/k."""
    for each in range(max(devices), 0, -1):
        if sum(n // each for n in devices) >= count:
            return float(each)
    return 1 / -(-count // sum(devices))
