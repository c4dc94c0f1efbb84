"""Limits of containers, of both versions of control groups, and how many threads may be asked for."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from unrender.backend import limits, variant, versions
from unrender.core.errors import InputError


@pytest.fixture
def container(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine of 64 cores with 8 GiB left; its control groups lie in `mount`."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)), raising=False)
    (tmp_path / "meminfo").write_text("MemTotal: 9 kB\nMemAvailable: 8388608 kB\n")
    (tmp_path / "mount").mkdir()
    monkeypatch.setattr(limits, "_MEMORY", tmp_path / "meminfo")
    monkeypatch.setattr(limits, "_MOUNT", tmp_path / "mount")
    monkeypatch.setattr(limits, "_GROUPS", tmp_path / "cgroup")
    return tmp_path


def write(folder: Path, **files: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(text + "\n")


def test_no_container_has_all(container: Path) -> None:
    assert (limits.cores(), limits.free_memory()) == (64, 8 << 30)


@pytest.mark.parametrize(
    ("quota", "count"), [("150000 100000", 2), ("50000 100000", 1), ("max 100000", 64), ("9900000 100000", 64)]
)
def test_processor_share_of_version_2(container: Path, quota: str, count: int) -> None:
    (container / "cgroup").write_text("0::/\n")
    write(container / "mount", cpu__max=quota)
    assert limits.cores() == count


def test_limits_of_groups_above_hold_too(container: Path) -> None:
    (container / "cgroup").write_text("0::/slice/job\n")
    write(container / "mount/slice/job", cpu__max="max 100000", memory__max="max", memory__current="5")
    write(container / "mount/slice", cpu__max="300000 100000", memory__max=str(2 << 30), memory__current=str(1 << 30))
    assert (limits.cores(), limits.free_memory()) == (3, 1 << 30)


def test_version_1(container: Path) -> None:
    (container / "cgroup").write_text("5:memory:/docker/ab\n4:cpu,cpuacct:/docker/ab\n1:name=systemd:/\n0::/\n")
    write(container / "mount/cpu,cpuacct/docker/ab", cpu__cfs_quota_us="250000", cpu__cfs_period_us="100000")
    write(
        container / "mount/memory/docker/ab", memory__limit_in_bytes=str(3 << 30), memory__usage_in_bytes=str(1 << 30)
    )
    assert (limits.cores(), limits.free_memory()) == (3, 2 << 30)
    write(container / "mount/cpu,cpuacct/docker/ab", cpu__cfs_quota_us="-1")
    write(container / "mount/memory/docker/ab", memory__limit_in_bytes=str((1 << 63) - 4096))
    assert (limits.cores(), limits.free_memory()) == (64, 8 << 30)


def test_a_container_that_sees_its_own_group_as_the_topmost(container: Path) -> None:
    """Version 1 without a name space of its own: the name is the machine's, and no folder has it."""
    (container / "cgroup").write_text("4:cpu:/docker/ab\n5:memory:/docker/ab\n")
    write(container / "mount/cpu", cpu__cfs_quota_us="100000", cpu__cfs_period_us="100000")
    write(container / "mount/memory", memory__limit_in_bytes=str(1 << 30), memory__usage_in_bytes=str(2 << 30))
    assert (limits.cores(), limits.free_memory()) == (1, 1)


@pytest.mark.parametrize("count", [9, 1_000_000])
def test_more_threads_than_a_few_for_each_core_are_refused(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    monkeypatch.setattr(limits, "cores", lambda: 2)
    variant.check_threads(8)
    with pytest.raises(InputError, match=f"threads {count}: this process may use 2 cores; expected at most 8"):
        variant.check_threads(count)


@pytest.mark.parametrize(
    ("name", "expected"), [("llvm_ad_rgb", "19.1.7"), ("llvm_ad_spectral", "19.1.7"), ("cuda_ad_rgb", None)]
)
def test_every_variant_of_the_cpu_records_its_llvm(
    monkeypatch: pytest.MonkeyPatch, name: str, expected: str | None
) -> None:
    monkeypatch.setattr(versions, "current", lambda: name)
    monkeypatch.setattr(versions, "llvm_version", lambda: (19, 1, 7))
    versions._deciding_versions.cache_clear()
    assert versions.deciding_versions().get("llvm") == expected
    versions._deciding_versions.cache_clear()
