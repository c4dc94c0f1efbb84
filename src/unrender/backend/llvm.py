"""The LLVM library that compiles Dr.Jit's CPU kernels: which are installed here, and which of them is safe.

Dr.Jit takes whatever `libLLVM` it finds first, already when it is imported, and one that is too old aborts the
process at the first differentiable render. So the choice is made here, before Dr.Jit is imported, and without loading
any candidate.

Only the standard library, and nothing of `unrender`: the set-up script runs this file before anything is installed.
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
"""What Dr.Jit reads, once, when it is imported."""

OLDEST = 17
"""The oldest major version that works. 14 is refused by Dr.Jit; 15 and 16 abort on processors with AVX-512 ("Cannot
select: fminimum") at the first gradient; 17, 18, 19 and 22 were run on one and gave the same gradient."""

NEWEST = 22
"""The newest major version that was tried. A newer one is used where there is no other."""

_FILE_NAME = re.compile(r"^libLLVM(-\d|\.\d|\.so|\.dylib)")
_VERSION_IN_NAME = re.compile(r"^libLLVM(?:-|\.so\.|\.)(\d+)")
_VERSION_IN_FOLDER = re.compile(r"/llvm[@-]?(\d+)/|/Cellar/llvm/(\d+)\.")


@dataclass(frozen=True)
class Library:
    """An installed LLVM library.

    Attributes:
        path: the file.
        major: its major version, or None where neither its name nor the library itself tells.
    """

    path: Path
    major: int | None


def folders(environment: Mapping[str, str] = os.environ, root: Path = Path("/")) -> list[Path]:
    """Where such libraries live: the active conda environment, then the system's and Homebrew's folders."""
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
    """Every LLVM library in `places` (default: `folders()`), each file once, links followed."""
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
    """The major version as the file's name, what it links to, or the folders above tell it; else None."""
    for file in (path, path.resolve()):
        if match := _VERSION_IN_NAME.match(file.name):
            return int(match[1])
    for file in (path, path.resolve()):
        if match := _VERSION_IN_FOLDER.search(file.as_posix()):
            return int(match[1] or match[2])
    return None


@functools.cache
def version_by_asking(path: Path) -> int | None:
    """The major version as the library itself tells it, in a process of its own: two LLVMs in one process collide.
    None where it cannot be loaded or is older than 16, which cannot tell."""
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
    """The library at `path` with its version, by name where that tells. A bare name, which the loader would search for,
    is taken at its word."""
    if path.parent != Path() and not path.is_file():
        return Library(path, None)
    major = version_by_name(path)
    return Library(path, version_by_asking(path) if major is None else major)


def choose(paths: Iterable[Path] | None = None) -> Library | None:
    """The library to use among `paths` (default: `candidates()`): the newest one that was tried, else the oldest of
    those that are newer still, else None. Those for another processor (32-bit ones beside 64-bit ones) are passed
    over.

    Libraries are only asked for their version where no name tells of a usable one: asking takes a second.
    """
    paths = [path for path in (candidates() if paths is None else paths) if _is_for_this_machine(path)]
    named = [Library(path, version_by_name(path)) for path in paths]
    asked = (Library(library.path, version_by_asking(library.path)) for library in named if library.major is None)
    return _best(named) or _best(asked)


def is_usable(major: int | None) -> bool:
    """Whether that version works: known, and not too old."""
    return major is not None and major >= OLDEST


def _best(libraries: Iterable[Library]) -> Library | None:
    usable = sorted((each for each in libraries if is_usable(each.major)), key=lambda each: each.major or 0)
    tried = [each for each in usable if (each.major or 0) <= NEWEST]
    # Among equals the first found, so that a conda environment's own goes before the system's.
    tried = [each for each in tried if each.major == tried[-1].major]
    return next(iter(tried or usable), None)


def _is_for_this_machine(path: Path) -> bool:
    """Whether the file's ELF header names the same word size and processor as the running Python's; True where there
    is none."""
    try:
        with open(path, "rb") as library, open(sys.executable, "rb") as python:
            ours, theirs = python.read(20), library.read(20)
    except OSError:
        return False
    if ours[:4] != b"\x7fELF":
        return True
    return theirs[:5] == ours[:5] and theirs[18:20] == ours[18:20]


def missing_companions() -> list[str]:
    """The system libraries that Dr.Jit's wheel links to, does not bring, and that are missing here: a minimal Debian
    has no libatomic, without which Dr.Jit cannot be imported."""
    if sys.platform != "linux":
        return []
    missing = []
    for name in ("libatomic.so.1", "libstdc++.so.6"):
        try:
            ctypes.CDLL(name)
        except OSError:
            missing.append(name)
    return missing
