"""How much of the machine this process may use: processor cores and memory, within a container's limits too."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

_GROUPS, _MOUNT, _MEMORY = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup"), Path("/proc/meminfo")
_STATUS = Path("/proc/self/status")
_UNLIMITED = 1 << 60
"""Bytes from which on version 1 of control groups means no limit."""


def cores() -> int:
    """Return how many of the processor's cores this process may use, >= 1: a container's share is rounded up."""
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    shares = [math.ceil(share) for share in _processor_shares()]
    return max(1, min([available, *shares]))


def free_memory() -> int:
    """Return the bytes that this machine, or this container, has left; 0 where that is unknown."""
    found = list(_memory_left())
    try:
        lines = _MEMORY.read_text().splitlines()
        found += [int(line.split()[1]) << 10 for line in lines if line.startswith("MemAvailable")]
    except (OSError, ValueError, IndexError):
        pass
    return min(found, default=0)


def group_memory() -> int:
    """Return the bytes that this process's control groups may use; 0 where none has a limit."""
    return min((limit for limit, _ in _group_memory()), default=0)


def address_space() -> int:
    """Return the bytes of addresses that this process may use (`ulimit -v`); 0 where that is not limited."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return 0 if limit == resource.RLIM_INFINITY else max(limit, 1)


def most_address_space() -> int:
    """Return the most bytes of addresses that this process has used so far; 0 where that is unknown."""
    try:
        lines = _STATUS.read_text().splitlines()
        return next((int(line.split()[1]) << 10 for line in lines if line.startswith("VmPeak:")), 0)
    except (OSError, ValueError, IndexError):
        return 0


def _processor_shares() -> Iterator[float]:
    """Processor seconds per second, of each group that has a limit."""
    for folder in _groups("cpu"):
        words = _words(folder / "cpu.max")  # version 2: "max 100000" or "150000 100000"
        if not words:
            words = [*_words(folder / "cpu.cfs_quota_us"), *_words(folder / "cpu.cfs_period_us")]
        numbers = [int(word) for word in words if word.isdigit()]
        if len(numbers) == 2 and min(numbers) > 0:
            yield numbers[0] / numbers[1]


def _memory_left() -> Iterator[int]:
    """Bytes, of each group that has a limit."""
    return (max(limit - used, 1) for limit, used in _group_memory())


def _group_memory() -> Iterator[tuple[int, int]]:
    """The limit and the bytes in use, of each group that has a limit."""
    for limit, used in (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes")):
        for folder in _groups("memory"):
            words = [*_words(folder / limit), *_words(folder / used)]
            if len(words) == 2 and all(word.isdigit() for word in words) and int(words[0]) < _UNLIMITED:
                yield int(words[0]), int(words[1])


def _groups(controller: str) -> Iterator[Path]:
    """The folders of this process's group and of those above it, whose limits hold too. A container may see the topmost alone."""
    try:
        lines = _GROUPS.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, _, rest = line.partition(":")
        controllers, _, name = rest.partition(":")
        if controllers and controller not in controllers.split(","):
            continue
        # Version 2 has no controllers there. Version 1 mounts each set of them, by its name or by that of one of them.
        mounts = [_MOUNT, _MOUNT / "unified"] if not controllers else [_MOUNT / controllers, _MOUNT / controller]
        for mount in dict.fromkeys(mounts):
            group = Path(os.path.normpath(f"{mount}/{name}"))
            for folder in (group, *group.parents):
                if folder.is_relative_to(mount) and folder.is_dir():
                    yield folder


def _words(path: Path) -> list[str]:
    try:
        return path.read_text().split()
    except OSError:
        return []
