"""Choice of the LLVM library that compiles Dr.Jit's CPU kernels, among those that are installed.

Dr.Jit loads the first `libLLVM` it finds, on import, and one that is too old aborts the process at the first differentiable render. So
the choice is made here, before Dr.Jit is imported, and no candidate is loaded into this process.

Imports the standard library only, because the set-up script runs this file before anything is installed.
"""

from __future__ import annotations

import ctypes.util
import functools
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

ENVIRONMENT_VARIABLE = "DRJIT_LIBLLVM_PATH"
"""Environment variable with the path of the library. Dr.Jit reads it once, on import."""

OLDEST = 17
"""Oldest supported major version. Dr.Jit refuses 14. Versions 15 and 16 abort on processors with AVX-512 at the first gradient ("Cannot
select: fminimum"). On such a processor 17, 18, 19 and 22 gave equal gradients."""

NEWEST = 22
"""Newest tested major version. A newer one is used only if there is no other."""

_FILE_NAME = re.compile(r"^libLLVM(-\d|\.\d|\.so|\.dylib)")
_VERSION_IN_NAME = re.compile(r"^libLLVM(?:-|\.so\.|\.)(\d+)")
_VERSION_IN_FOLDER = re.compile(r"/llvm[@-]?(\d+)/|/Cellar/llvm/(\d+)\.")


@dataclass(frozen=True)
class Library:
    """An installed LLVM library; its major version is None if neither the file's name nor the library reports it."""

    path: Path
    major: int | None


def folders(environment: Mapping[str, str] = os.environ, root: Path = Path("/")) -> list[Path]:
    """Return the existing folders to search: those of conda and of this Python, then the system's, Homebrew's and MacPorts'."""
    conda = [Path(prefix) / "lib" for prefix in (environment.get("CONDA_PREFIX"), sys.prefix) if prefix]
    patterns = [
        f"usr/lib/{platform.machine()}-linux-gnu",
        "usr/lib/llvm-*/lib",
        "usr/lib64",
        "usr/lib64/llvm*/lib",
        "usr/lib",
        "usr/lib/llvm*/lib",
        "usr/local/lib",
        "opt/homebrew/opt/llvm*/lib",
        "usr/local/opt/llvm*/lib",
        "home/linuxbrew/.linuxbrew/opt/llvm*/lib",
        "opt/local/libexec/llvm-*/lib",
    ]
    return conda + [folder for pattern in patterns for folder in sorted(root.glob(pattern))]


def candidates(places: Iterable[Path] | None = None) -> Iterator[Path]:
    """Yield the LLVM libraries in `places` (default: `folders()`). Links to one file count once."""
    seen: set[Path] = set()
    for folder in folders() if places is None else places:
        try:
            files = sorted(file for file in folder.iterdir() if _FILE_NAME.match(file.name) and file.suffix != ".a")
        except OSError:
            continue
        for file in files:
            real = file.resolve()
            if real not in seen and real.is_file():
                seen.add(real)
                yield file


def version_by_name(path: Path) -> int | None:
    """Return the major version according to the file's name, its link target or its parent folders; None if they do not contain it."""
    for file in (path, path.resolve()):
        if match := _VERSION_IN_NAME.match(file.name):
            return int(match[1])
    for file in (path, path.resolve()):
        if match := _VERSION_IN_FOLDER.search(file.as_posix()):
            return int(match[1] or match[2])
    return None


@functools.cache
def version_by_asking(path: Path) -> int | None:
    """Return the major version that the library reports; None if it cannot be loaded or is older than 16.

    A separate process loads it, because two LLVM libraries in one process collide.
    """
    ask = (
        "import ctypes, sys; v = [ctypes.c_uint() for _ in range(3)]; "
        "ctypes.CDLL(sys.argv[1]).LLVMGetVersion(*map(ctypes.byref, v)); print(v[0].value)"
    )
    try:
        answer = subprocess.run(
            [sys.executable, "-I", "-c", ask, str(path)], capture_output=True, text=True, timeout=60, check=False
        )
        return int(answer.stdout)
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return None


def identify(path: Path) -> Library:
    """Return the library at `path` with its version, by its name if possible; the version is None if there is no file.

    A bare file name, which the loader resolves, is not checked for existence.
    """
    if path.parent != Path() and not path.is_file():
        return Library(path, None)
    major = version_by_name(path)
    return Library(path, version_by_asking(path) if major is None else major)


def choose(paths: Iterable[Path] | None = None) -> Library | None:
    """Choose a library among `paths` (default: `candidates()`).

    The newest tested version is preferred, then the oldest of the newer ones; None if none is usable. Libraries for another processor, such
    as 32-bit ones on a 64-bit system, are skipped. A library is asked for its version only if no file name shows a usable one, because that
    takes a second.
    """
    paths = [path for path in (candidates() if paths is None else paths) if _is_for_this_machine(path)]
    named = [Library(path, version_by_name(path)) for path in paths]
    versions = (Library(library.path, version_by_asking(library.path)) for library in named if library.major is None)
    return _best(named) or _best(versions)


def is_usable(major: int | None) -> bool:
    """Return whether the version is known and not too old."""
    return major is not None and major >= OLDEST


def _best(libraries: Iterable[Library]) -> Library | None:
    usable = sorted((each for each in libraries if is_usable(each.major)), key=lambda each: each.major or 0)
    tried = [each for each in usable if (each.major or 0) <= NEWEST]
    # The first of equal versions wins, so that a conda environment's library precedes the system's.
    tried = [each for each in tried if each.major == tried[-1].major]
    return next(iter(tried or usable), None)


def _is_for_this_machine(path: Path) -> bool:
    """Return whether the file's ELF header has the word size and processor of the running Python; True if Python has no ELF header."""
    try:
        with open(path, "rb") as library, open(sys.executable, "rb") as python:
            ours, theirs = python.read(20), library.read(20)
    except OSError:
        return False
    if ours[:4] != b"\x7fELF":
        return True
    return theirs[:5] == ours[:5] and theirs[18:20] == ours[18:20]


def missing_companions() -> list[str]:
    """Return the missing system libraries that Dr.Jit's wheel links to and does not contain. Minimal Debian systems lack libatomic, without
    which Dr.Jit cannot be imported."""
    if sys.platform != "linux":
        return []
    missing = []
    for name in ("libatomic.so.1", "libstdc++.so.6"):
        try:
            ctypes.CDLL(name)
        except OSError:
            missing.append(name)
    return missing
