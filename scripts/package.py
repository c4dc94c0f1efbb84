"""Build the wheel and the source archive into `dist`, and start the wheel from an empty folder.

The wheel is installed without its dependencies, so nothing large is downloaded: modules are found in the folder first and packages of
others in the environment that runs this. `python -I scripts/package.py` from the root of the repository.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

LARGEST_SDIST = 8 << 20
"""Bytes. Records of benchmarks are not part of it."""
ROOT = Path(__file__).resolve().parents[1]
RECORDS = (".json", ".npz", ".png")


def _run(*command: str, cwd: Path | None = None) -> str:
    found = subprocess.run([sys.executable, *command], cwd=cwd, capture_output=True, text=True, check=False)
    if found.returncode:
        sys.exit(f"package: {' '.join(command)[:200]} failed:\n{found.stdout}{found.stderr}")
    return found.stdout


def _check_wheel(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    sources = [
        path for path in (ROOT / "src" / "unrender").rglob("*") if path.is_file() and "__pycache__" not in path.parts
    ]
    missing = [str(path) for path in sources if str(path.relative_to(ROOT / "src")) not in names]
    others = [name for name in names if not name.startswith(("unrender/", "unrender-"))]
    if missing or others:
        sys.exit(f"package: the wheel lacks {missing[:3]} or holds {others[:3]}")


def _check_sdist(sdist: Path) -> None:
    with tarfile.open(sdist) as archive:
        names = archive.getnames()
    records = [name for name in names if "/benchmarks/" in name and name.endswith(RECORDS)]
    if records or sdist.stat().st_size > LARGEST_SDIST:
        sys.exit(f"package: the source archive has {sdist.stat().st_size} bytes and holds {records[:3]}")
    for name in ("SECURITY.md", "LICENSE", "pyproject.toml", "src/unrender/__init__.py"):
        if not any(each.partition("/")[2] == name for each in names):
            sys.exit(f"package: the source archive lacks {name}")


def main() -> None:
    """Build, install into an empty folder, start."""
    shutil.rmtree(ROOT / "dist", ignore_errors=True)
    with tempfile.TemporaryDirectory() as place:
        tools, empty = Path(place, "tools"), Path(place, "empty")
        _run("-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--target", str(tools), "hatchling")
        build = (
            f"import os, sys; sys.path.insert(0, {str(tools)!r}); os.chdir({str(ROOT)!r}); from hatchling import build;"
            "print(build.build_sdist('dist')); print(build.build_wheel('dist'))"
        )
        sdist, wheel = (ROOT / "dist" / name for name in _run("-c", build).split()[-2:])
        _check_sdist(sdist)
        _check_wheel(wheel)
        options = ("--quiet", "--disable-pip-version-check", "--no-deps", "--no-index", "--target", str(empty))
        _run("-m", "pip", "install", *options, str(wheel))
        start = (
            f"import sys; sys.path.insert(0, {str(empty)!r}); import unrender; print(unrender.__file__);"
            "from unrender.app.cli.main import main; sys.exit(main(['--version']))"
        )
        file, version = _run("-I", "-c", start, cwd=Path(place)).split()
        if not file.startswith(str(empty)):
            sys.exit(f"package: {file} was imported, expected the wheel's")
        _run("-I", "-c", start.replace("'--version'", "'methods'"), cwd=Path(place))
    print(
        f"unrender {version}: {wheel.name} {wheel.stat().st_size >> 10} KiB, {sdist.name} {sdist.stat().st_size >> 10} KiB"
    )


if __name__ == "__main__":
    main()
