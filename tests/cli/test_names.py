"""Names and numbers that no file could hold: refused before the first step, in the command and in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from conftest import Unrender
from tiers import slow

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="names of any bytes")


@pytest.mark.parametrize("seed", [2**63, 10**30, -1])
@pytest.mark.parametrize("command", ["run", "compare", "sweep"])
def test_a_seed_that_no_record_holds_is_refused(command: str, seed: int, unrender: Unrender, tmp_path: Path) -> None:
    more = {"run": [], "compare": ["--methods", "plain,auto"], "sweep": ["--method", "plain", "--over", "spp=1,2"]}[
        command
    ]
    answer = unrender(command, "indirect-room", "--seed", seed, "--seconds", "1", "--out", "out", *more)
    assert answer.refuses("seed")
    assert not (tmp_path / "out").exists()


def test_the_last_seed_of_a_comparison_counts(unrender: Unrender) -> None:
    answer = unrender(
        "compare", "indirect-room", "--methods", "plain,auto", "--seed", 2**63 - 1, "--seeds", 2, "--seconds", 1
    )
    assert answer.status == 2
    assert "--seed: expected a whole number from -2**63 to 2**63 - 2" in answer.error


@pytest.mark.parametrize("locale", ["C.UTF-8", "POSIX"])
def test_an_out_folder_that_is_not_utf_8_is_refused_before_the_work(locale: str, problem: Path, tmp_path: Path) -> None:
    command = [os.fsencode(sys.executable), b"-m", b"unrender", b"run", os.fsencode(problem), b"--steps", b"1"]
    found = subprocess.run(
        [*command, b"--out", b"caf\xe9"],
        cwd=tmp_path,
        env={**os.environ, "LC_ALL": locale},
        capture_output=True,
        check=False,
    )
    assert found.returncode == 2, found.stderr
    assert b"a name that is not UTF-8" in found.stderr
    assert found.stderr.count(b"\n") == 1
    assert not os.path.exists(os.fsencode(tmp_path) + b"/caf\xe9")


@pytest.mark.parametrize("apart", [False, slow(True)], ids=["this process", "its own"])
def test_a_working_folder_that_is_not_utf_8_is_refused_before_the_work(
    apart: bool, problem: Path, unrender: Unrender, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The problem's own path goes into run.json, too."""
    folder = os.fsencode(tmp_path) + b"/caf\xe9"
    os.mkdir(folder)
    for name in ("wall.xml", "photo.exr", "problem.toml"):
        os.rename(tmp_path / name, os.path.join(folder, name.encode()))
    words = ["run", "problem.toml", "--steps", "1", "--out", str(tmp_path / "out")]
    if apart:
        found = subprocess.run([sys.executable, "-m", "unrender", *words], cwd=folder, capture_output=True, check=False)
        status, error = found.returncode, found.stderr.decode()
    else:
        monkeypatch.chdir(os.fsdecode(folder))
        answer = unrender(*words)
        status, error = answer.status, answer.error
    assert status == 2, error
    assert "not UTF-8" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out" / "run.json").exists()
