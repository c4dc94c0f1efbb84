"""The processes of a parallel test run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_a_run_goes_on_after_a_process_that_ended(tmp_path: Path) -> None:
    """Where the others were done, the one in its place waited for ever."""
    (tmp_path / "conftest.py").write_text("from tests.conftest import pytest_xdist_make_scheduler\n")
    for number in range(1, 6):
        (tmp_path / f"test_{number}.py").write_text("def test() -> None:\n    pass\n")
    bodies = ("pass", "time.sleep(1.0)\n    os._exit(3)", "pass")  # the other process has run all other files by then
    ends = "".join(f"def test_{number}() -> None:\n    {body}\n\n" for number, body in enumerate(bodies))
    (tmp_path / "test_0.py").write_text(f"import os, time\n\n{ends}")
    words = ["-q", "-n", "2", "--dist", "loadfile", "--max-worker-restart=2", "-p", "no:cacheprovider"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    environment["PYTHONPATH"] = f"{ROOT / 'src'}{os.pathsep}{ROOT}"
    ended = subprocess.run(
        [sys.executable, "-m", "pytest", *words],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert "1 failed, 7 passed" in ended.stdout, ended.stdout + ended.stderr
    assert "crashed while running 'test_0.py::test_1'" in ended.stdout
