"""Commands that install what `pip` does not provide: LLVM, and the C libraries that Dr.Jit links to.

Imports the standard library only, because the set-up script runs this file before anything is installed.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Mapping, Sequence

NEEDS = ("llvm", "libatomic.so.1", "libstdc++.so.6", "venv")
"""Names of the requirements."""

APT_LLVM = ("libllvm19", "libllvm20", "libllvm21", "libllvm22", "libllvm18", "libllvm17t64", "libllvm17")
"""Packages of Debian and Ubuntu with a supported LLVM, in order of preference."""

_APT = {"libatomic.so.1": "libatomic1", "libstdc++.so.6": "libstdc++6", "venv": "python3-venv"}
_DNF = {"llvm": "llvm-libs", "libatomic.so.1": "libatomic", "libstdc++.so.6": "libstdc++", "venv": "python3"}
_PACMAN = {"llvm": "llvm-libs", "libatomic.so.1": "gcc-libs", "libstdc++.so.6": "gcc-libs", "venv": "python"}
_BREW = {"llvm": "llvm@19", "venv": "python"}
_CONDA = {"llvm": "libllvm19", "libatomic.so.1": "libgcc", "libstdc++.so.6": "libstdcxx", "venv": "python"}


def manager(environment: Mapping[str, str] = os.environ) -> str | None:
    """Return the package manager: conda in a conda environment, else the system's; None if none is known."""
    if environment.get("CONDA_PREFIX"):
        return "conda"
    return next((name for name in ("apt-get", "dnf", "pacman", "brew") if shutil.which(name)), None)


def command(needs: Sequence[str], by: str | None = None) -> str:
    """Return one shell command that installs `needs` (from `NEEDS`) with the package manager `by`.

    The default is `manager()`, and conda if that is unknown. Needs for which a manager has no package are omitted.
    """
    by = by or manager()
    sudo = "" if is_root() else "sudo "
    if by == "apt-get":
        return _apt_command(needs, sudo)
    managers = {
        "dnf": (f"{sudo}dnf install ", _DNF),
        "pacman": (f"{sudo}pacman -S ", _PACMAN),
        "brew": ("brew install ", _BREW),
    }
    prefix, table = managers.get(by or "", ("conda install -c conda-forge ", _CONDA))
    return prefix + _names(needs, table)


def apt_packages(needs: Sequence[str]) -> list[str] | None:
    """Return Debian's packages for `needs`; None if apt offers no supported LLVM (no package lists, or an old release)."""
    packages = [_APT[need] for need in needs if need != "llvm"]
    if "llvm" in needs:
        llvm = _known_to_apt(APT_LLVM)
        if llvm is None:
            return None
        packages.insert(0, llvm)
    return packages


def is_root() -> bool:
    """Return whether this process has root rights."""
    return hasattr(os, "geteuid") and os.geteuid() == 0


def _apt_command(needs: Sequence[str], sudo: str) -> str:
    packages = apt_packages(needs)
    if packages is None and _known_to_apt(("coreutils",)) is None:
        # Without package lists, as in a fresh container, name the package that all current releases have.
        packages = [APT_LLVM[0]] + [_APT[need] for need in needs if need != "llvm"]
    if packages is not None:
        return f"{sudo}apt-get update && {sudo}apt-get install -y {' '.join(packages)}"
    script = f"curl -fsSO https://apt.llvm.org/llvm.sh && {sudo}bash llvm.sh 19"
    others = [_APT[need] for need in needs if need != "llvm"]
    return script + (f" && {sudo}apt-get install -y {' '.join(others)}" if others else "")


def _known_to_apt(packages: Sequence[str]) -> str | None:
    """Return the first of `packages` that apt can install, or None."""
    try:
        answer = subprocess.run(
            ["apt-cache", "policy", *packages],
            capture_output=True,
            text=True,
            timeout=15,
            check=False,
            env={**os.environ, "LC_ALL": "C"},
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    known = set(re.findall(r"^(\S+):\n.*\n  Candidate: (?!\(none\))", answer.stdout, re.MULTILINE))
    return next((package for package in packages if package in known), None)


def _names(needs: Sequence[str], table: Mapping[str, str]) -> str:
    return " ".join(dict.fromkeys(table[need] for need in needs if need in table))
