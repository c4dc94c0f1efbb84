"""The command in containers: users without a name or a home folder, homes that cannot be written, numbers of threads."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tiers import quick

NAMELESS = """
import pwd, sys

def unknown(uid):
    raise KeyError(f"getpwuid(): uid not found: {uid}")

pwd.getpwuid = unknown
from unrender.app.cli.main import main
for line in sys.argv[1:]:
    if status := main(line.split()):
        sys.exit(f"{line}: status {status}")
"""
"""Commands, one line each, of a user whose number has no name, as of `docker run --user 4321`."""


def run(folder: Path, *lines: str, **environment: str) -> subprocess.CompletedProcess[str]:
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("HOME", "XDG", "UNRENDER", "DRJIT_CACHE"))
    }
    return subprocess.run(
        [sys.executable, "-c", NAMELESS, *lines],
        cwd=folder,
        env=kept | {"COLUMNS": "100"} | environment,
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_no_home_and_no_name(tmp_path: Path) -> None:
    done = run(tmp_path, "--version", "methods rcv", "gallery")
    told = [
        line
        for line in done.stderr.splitlines()
        if not line.startswith("jit_init(): the HOME environment variable is not set")
    ]
    assert (done.returncode, told) == (0, [])


@pytest.mark.parametrize(
    ("words", "output"),
    [("methods", ">&-"), ("methods --set a=1", "2>&-"), ("gallery", "| cat")],
)
def test_an_output_that_is_closed_or_lacks_characters(words: str, output: str, tmp_path: Path) -> None:
    """Both were tracebacks, of a run when it was over."""
    ascii_alone = {"LC_ALL": "C", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    line = f"set -o pipefail; {sys.executable} -m unrender.app.cli.main {words} {output}"
    done = subprocess.run(
        ["bash", "-c", line], cwd=tmp_path, env=os.environ | ascii_alone, capture_output=True, timeout=300
    )
    refused = words not in ("methods", "gallery")
    assert (done.returncode, done.stdout != b"") == (2 * refused, words == "gallery")
    assert done.stderr.count(b"\n") == (refused and "2>" not in output), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("home", quick(["missing", "file"], "missing"))
def test_a_home_that_cannot_be_written(tmp_path: Path, home: str) -> None:
    (tmp_path / "file").touch()
    line = "run exponential --method plain --steps 2 --final-spp 1 --out run"
    done = run(tmp_path, line, HOME=str(tmp_path / "file" / home))
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr + done.stdout
    assert (tmp_path / "run" / "run.json").exists()


def test_a_million_threads_are_one_line(unrender, tmp_path: Path, mitsuba_variant: str) -> None:
    words = ["exponential", "--method", "plain", "--steps", 1, "--threads", 1_000_000, "--variant", mitsuba_variant]
    answer = unrender("run", *words, "--out", tmp_path / "run")
    assert answer.status == 2
    assert answer.error.startswith("unrender: threads 1000000: this process may use ")
    assert answer.error.count("\n") == 1
    assert not (tmp_path / "run").exists()
