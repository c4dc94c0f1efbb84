"""Versions of the software and hardware on which the numbers of a run depend."""

from __future__ import annotations

import platform
import sys
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from unrender.backend.limits import cores
from unrender.backend.variant import LLVM, current, llvm_version


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages on which the numbers depend."""
    return dict(_versions())


@cache
def _versions() -> dict[str, str]:
    versions_by_package = {"python": platform.python_version()}
    for package in ("unrender", "mitsuba", "drjit", "numpy"):
        try:
            versions_by_package[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions_by_package[package] = "not installed"
    return versions_by_package


def deciding_versions() -> dict[str, str]:
    """Return the versions on which the bits of a run's numbers depend: packages, LLVM, the variant."""
    return dict(_deciding_versions(current() or "none"))


@cache
def _deciding_versions(name: str) -> dict[str, str]:
    versions_by_package = {name: version for name, version in versions().items() if name != "python"}
    for package in ("scipy", "cholespy", "cma"):
        versions_by_package[package] = metadata.version(package)
    llvm = llvm_version() if name == LLVM else None
    return {**versions_by_package, "variant": name, **({"llvm": ".".join(map(str, llvm))} if llvm else {})}


def hardware() -> dict[str, Any]:
    """Return the processor, and the number of cores that this process may use."""
    return dict(_hardware())


@cache
def _hardware() -> dict[str, Any]:
    return {"processor": _processor(), "cores": cores(), "system": f"{platform.system()} {platform.machine()}"}


def _processor() -> str:
    if sys.platform == "linux":
        try:
            for line in Path("/proc/cpuinfo").read_text().splitlines():
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
        except OSError:
            pass
    return platform.processor() or platform.machine()
