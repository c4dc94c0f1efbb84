"""Versions of the software and hardware on which the numbers of a run depend."""

from __future__ import annotations

import platform
import re
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from unrender.backend.limits import cores, first_line
from unrender.backend.variant import current, llvm_version


@cache
def versions() -> Mapping[str, str]:
    """Return {name: version} of Python and of the packages on which the numbers depend; "not installed" for a missing one."""
    versions_by_package = {"python": platform.python_version()}
    for package in ("unrender", "mitsuba", "drjit", "numpy"):
        try:
            versions_by_package[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions_by_package[package] = "not installed"
    return versions_by_package


def deciding_versions() -> dict[str, str]:
    """Return {name: version} on which the bits of a run's numbers depend: packages, the variant, and LLVM on a CPU."""
    return dict(_deciding_versions(current() or "none"))


@cache
def _deciding_versions(name: str) -> dict[str, str]:
    versions_by_package = {name: version for name, version in versions().items() if name != "python"}
    for package in ("scipy", "cholespy", "cma"):
        versions_by_package[package] = metadata.version(package)
    llvm = llvm_version() if name.startswith("llvm") else None
    return {**versions_by_package, "variant": name, **({"llvm": ".".join(map(str, llvm))} if llvm else {})}


@cache
def hardware() -> Mapping[str, Any]:
    """Return the processor, the number of cores that this process may use, and the operating system: keys processor, cores, system."""
    return {"processor": processor(), "cores": cores(), "system": f"{platform.system()} {platform.machine()}"}


def processor() -> str:
    """Return the name of the processor, or of its kind if the system does not tell it."""
    try:
        if match := re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE):
            return match[1]
    except OSError:
        pass
    return first_line("sysctl", "-n", "machdep.cpu.brand_string") or platform.processor() or platform.machine()
