"""The processes in which the tests run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = """
import os

def test_first():
    pass

def test_that_ends_its_process():
    with open("ended", "a") as file:
        file.write("once ")
    os._exit(1)

def test_last():
    pass
"""


@pytest.mark.slow
def test_a_test_that_ends_its_process_runs_once_and_the_others_run(tmp_path: Path) -> None:
    """A test that waits for ever ends so at the limit of time. Each process that took it over would wait as long again."""
    (tmp_path / "conftest.py").write_text("from tests.conftest import pytest_xdist_make_scheduler")
    (tmp_path / "test_some.py").write_text(TESTS)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-n",
        "2",
        "--dist",
        "loadfile",
        "-p",
        "no:cacheprovider",
        "-c",
        os.devnull,
    ]
    root = Path(__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": f"{root / 'src'}{os.pathsep}{root}", "PYTEST_ADDOPTS": ""}
    environment = {name: value for name, value in environment.items() if not name.startswith("PYTEST_XDIST")}
    done = subprocess.run(
        [*command, "--rootdir", ".", "test_some.py"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert "1 failed, 2 passed" in done.stdout, done.stdout
    assert (tmp_path / "ended").read_text() == "once "
