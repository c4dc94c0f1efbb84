"""The library works where what the application needs is not installed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tiers import quick, slow

APPLICATION = ("typer", "starlette", "uvicorn", "jinja2", "ray", "optuna", "rich")
SCRIPT = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {absent}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Absent())
import unrender as ur
"""
RUN = """
problem = ur.gallery.problem("exponential")
result = ur.optimize(problem, "rcv", steps=3, run_directory="run", progress=False)
ur.resume("run", steps=5)
result.save("saved")
"""
NAMES = "print(len([getattr(ur, name) for name in ur.__all__]))\n"
TELL = """
print(sorted(name for name in sys.modules if name.startswith("unrender.app.")))
"""


def run(folder: Path, absent: tuple[str, ...], does: str = RUN) -> subprocess.CompletedProcess[str]:
    code = SCRIPT.format(absent=set(absent)) + does + TELL
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, timeout=300)


@pytest.mark.parametrize("does", [NAMES, slow(RUN)], ids=["names", "a run"])
def test_the_library_needs_nothing_of_the_application(tmp_path: Path, does: str) -> None:
    done = run(tmp_path, APPLICATION, does)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("name", quick(["numpy", "safetensors"], "numpy"))
def test_what_it_needs_is_missed(tmp_path: Path, name: str) -> None:
    assert run(tmp_path, (name,)).returncode != 0
