"""Limits of this process: processor cores and memory, including a container's limits."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

_GROUPS, _MOUNT, _MEMORY = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup"), Path("/proc/meminfo")
_STATUS = Path("/proc/self/status")
_UNLIMITED = 1 << 60  # smallest value that version 1 of control groups uses for "no limit", in bytes


def cores() -> int:
    """Return the number of processor cores that this process may use, >= 1. A container's fractional share is rounded up."""
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    shares = [math.ceil(share) for share in _processor_shares()]
    return max(1, min([available, *shares]))


def free_memory() -> int:
    """Return the available memory of this machine or container in bytes; 0 if unknown."""
    candidates = [max(limit - used, 1) for limit, used in _group_memory()]
    try:
        lines = _MEMORY.read_text().splitlines()
        candidates += [int(line.split()[1]) << 10 for line in lines if line.startswith("MemAvailable")]
    except (OSError, ValueError, IndexError):
        pass
    return min(candidates, default=0)


def free_gpu_memory() -> int:
    """Return the free memory of the visible GPU in bytes; 0 if unknown."""
    device = os.environ.get("CUDA_VISIBLE_DEVICES", "0").split(",")[0]
    free = first_line("nvidia-smi", f"--id={device}", "--query-gpu=memory.free", "--format=csv,noheader,nounits")
    return int(free) << 20 if free and free.isdigit() else 0


def first_line(program: str, *arguments: str) -> str | None:
    """Return the first line that a program prints; None if there is no such program, or it fails."""
    if not shutil.which(program):
        return None
    try:
        answer = subprocess.run([program, *arguments], capture_output=True, text=True, timeout=20, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip().partition("\n")[0] or None


def group_memory() -> int:
    """Return the memory limit of this process's control groups in bytes; 0 if there is none."""
    return min((limit for limit, _ in _group_memory()), default=0)


def address_space() -> int:
    """Return the limit of this process's address space in bytes (`ulimit -v`); 0 if there is none."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return 0 if limit == resource.RLIM_INFINITY else max(limit, 1)


def most_address_space() -> int:
    """Return the peak size of this process's address space in bytes; 0 if unknown."""
    try:
        lines = _STATUS.read_text().splitlines()
        return next((int(line.split()[1]) << 10 for line in lines if line.startswith("VmPeak:")), 0)
    except (OSError, ValueError, IndexError):
        return 0


def _processor_shares() -> Iterator[float]:
    """Yield the processor seconds per second of each control group that has a limit."""
    for folder in _groups("cpu"):
        words = _words(folder / "cpu.max")  # version 2: "max 100000" or "150000 100000"
        if not words:
            words = [*_words(folder / "cpu.cfs_quota_us"), *_words(folder / "cpu.cfs_period_us")]
        numbers = [int(word) for word in words if word.isdigit()]
        if len(numbers) == 2 and min(numbers) > 0:
            yield numbers[0] / numbers[1]


def _group_memory() -> Iterator[tuple[int, int]]:
    """Yield (limit, bytes in use) of each control group that has a limit."""
    for limit, used in (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes")):
        for folder in _groups("memory"):
            words = [*_words(folder / limit), *_words(folder / used)]
            if len(words) == 2 and all(word.isdigit() for word in words) and int(words[0]) < _UNLIMITED:
                yield int(words[0]), int(words[1])


def _groups(controller: str) -> Iterator[Path]:
    """Yield the folders of this process's control group and its parents, whose limits also apply. A container may see only the topmost."""
    try:
        lines = _GROUPS.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, _, rest = line.partition(":")
        controllers, _, name = rest.partition(":")
        if controllers and controller not in controllers.split(","):
            continue
        # Version 2 lists no controllers. Version 1 mounts each set of controllers under the set's name or that of one member.
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
