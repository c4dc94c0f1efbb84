"""Build the wheel and the source archive into `dist`, and start the wheel in an empty environment.

The wheel is installed without its dependencies, so nothing large is downloaded: the environment finds packages of others in the one that
runs this. `python -I scripts/package.py` from the root of the repository.
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


def _run(*command: str, cwd: Path | None = None, python: Path | None = None) -> str:
    found = subprocess.run(
        [str(python or sys.executable), *command], cwd=cwd, capture_output=True, text=True, check=False
    )
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
    records = [name for name in names if ("/benchmarks/" in name or "/scripts/" in name) and name.endswith(RECORDS)]
    if records or sdist.stat().st_size > LARGEST_SDIST:
        sys.exit(f"package: the source archive has {sdist.stat().st_size} bytes and holds {records[:3]}")
    for name in ("SECURITY.md", "LICENSE", "pyproject.toml", "src/unrender/__init__.py"):
        if not any(each.partition("/")[2] == name for each in names):
            sys.exit(f"package: the source archive lacks {name}")


def _check_start(wheel: Path, place: Path) -> str:
    """Install the wheel into an empty environment and start its command there. Returns the version that it prints."""
    scripts, purelib = ("Scripts", "Lib/site-packages") if sys.platform == "win32" else ("bin", "")
    _run("-m", "venv", "--without-pip", str(place))
    python = place / scripts / "python"
    options = ("--quiet", "--disable-pip-version-check", "--no-deps", "--no-index")
    _run("-m", "pip", "--python", str(python), "install", *options, str(wheel))
    inside = place / (purelib or f"lib/python{sys.version_info[0]}.{sys.version_info[1]}/site-packages")
    others = [path for path in sys.path if path.endswith(("site-packages", "dist-packages"))]
    (inside / "others.pth").write_text("".join(f"{path}\n" for path in others))
    file = _run("-I", "-c", "import unrender; print(unrender.__file__)", cwd=place, python=python).strip()
    if not file.startswith(str(inside)):
        sys.exit(f"package: {file} was imported, expected the wheel's")
    command = str(place / scripts / "unrender")
    _run("-I", command, "methods", cwd=place, python=python)
    return _run("-I", command, "--version", cwd=place, python=python).strip()


def main() -> None:
    """Build, check, install into an empty environment, start."""
    shutil.rmtree(ROOT / "dist", ignore_errors=True)
    with tempfile.TemporaryDirectory() as name:
        place = Path(name).resolve()
        tools = place / "tools"
        _run(
            "-m",
            "pip",
            "install",
            "--quiet",
            "--disable-pip-version-check",
            "--target",
            str(tools),
            "hatchling",
            "twine",
        )
        found = f"import os, sys; sys.path.insert(0, {str(tools)!r}); os.chdir({str(ROOT)!r});"
        build = (
            f"{found} from hatchling import build; print(build.build_sdist('dist')); print(build.build_wheel('dist'))"
        )
        sdist, wheel = (ROOT / "dist" / each for each in _run("-c", build).split()[-2:])
        _check_sdist(sdist)
        _check_wheel(wheel)
        check = f"{found} from twine.commands.check import check; sys.exit(check({[str(sdist), str(wheel)]!r}))"
        _run("-c", check)
        version = _check_start(wheel, place / "empty")
    print(
        f"unrender {version}: {wheel.name} {wheel.stat().st_size >> 10} KiB, {sdist.name} {sdist.stat().st_size >> 10} KiB"
    )


if __name__ == "__main__":
    main()
