"""`unrender resume`: what it goes on with, and what it refuses."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import unrender as package
from unrender.runs.folder import checkpoint

QUICK = ["--final-spp", "4"]
pytestmark = pytest.mark.usefixtures("short_ends")  # tests/render/test_resume.py has whole ends


@pytest.fixture
def stopped(run_once, mitsuba_variant: str) -> Path:
    """A run of six steps that looks as if it had died in the eighth."""
    words = ["--steps", 6, "--checkpoint-every", 2, "--seed", 5, "--set", "learning_rate=0.02", *QUICK]
    folder = run_once(*words, "--variant", mitsuba_variant)
    record = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**record, "status": "running"}))
    method = (folder / "method.toml").read_text()
    (folder / "method.toml").write_text(method.replace("steps = 6", "steps = 10"))
    return folder


@pytest.mark.usefixtures("short_ends")
def test_resume_goes_on_and_says_so(unrender, stopped: Path):
    answer = unrender("resume", "result")
    assert answer.status == 0, answer.error
    assert "step 10/10" in answer.out
    assert "resumed after step 6" in " ".join(answer.out.split())
    assert f"page: {Path('result', 'report.html')}" in answer.out
    record = json.loads((stopped / "run.json").read_text())
    assert (record["status"], record["steps"], record["seed"], record["resumed"]) == ("finished", 10, 5, [6])
    assert record["method"] == "auto"
    assert record["command"].startswith("unrender run problem.toml")
    assert record["settings"]["options"]["learning_rate"] == 0.02
    assert [path.name for path in sorted((stopped / checkpoint.FOLDER).iterdir())] == [
        "00000006",
        "00000008",
        "00000010",
    ]
    again = unrender("resume", "result")
    assert again.status == 2
    assert again.error.startswith("unrender: run folder result: finished, after 10 steps and ")
    more = unrender("resume", "result", "--steps", 12)
    assert more.status == 0, more.error
    with np.load(stopped / "parameters.npz") as found:
        assert all(np.isfinite(found[key]).all() for key in found)
    assert len((stopped / "history.jsonl").read_text().splitlines()) == 12


@pytest.mark.slow
def test_resume_shows_what_changed(unrender, stopped: Path):
    scene = stopped.parent / "wall.xml"
    scene.write_text(scene.read_text().replace("0.2", "0.25"))
    answer = unrender("resume", "result")
    assert answer.status == 2
    assert answer.error.startswith("unrender: run folder result: changed since: ")
    assert "file wall.xml has changed" in answer.error
    assert answer.error.count("\n") == 1
    forced = unrender("resume", "result", "--force")
    assert forced.status == 0, forced.error
    assert "warning resumed with force although changed since: " in forced.out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "nowhere: no such run folder"),
        (["problem.toml"], "problem.toml: a file, expected a run folder"),
        (["."], ".: not a run folder: run.json is missing"),
        (["result", "--steps", "0"], "--steps 0: expected at least 1"),
        (["result", "--seconds", "nan"], "--seconds nan: expected a number above 0"),
        (["result", "--steps", "3"], "6 steps are done, expected a budget of more, got steps=3"),
        (["result", "--variant", "scalar_rgb"], "--variant scalar_rgb: expected"),
    ],
)
def test_resume_refuses_in_one_line(unrender, stopped: Path, words: list[str], message: str):
    del stopped
    answer = unrender("resume", *words)
    assert answer.refuses(message)


@pytest.mark.usefixtures("short_ends")
def test_a_second_run_in_the_folder_is_refused(unrender, stopped: Path, mitsuba_variant: str):
    """By another process, which holds it."""
    code = "import sys; from pathlib import Path; from unrender.runs.folder.lock import Lock\n"
    code += "Lock(Path(sys.argv[1])).acquire(); print('held', flush=True); sys.stdin.read()"
    environment = {**os.environ, "PYTHONPATH": str(Path(package.__file__).parents[1])}
    other = subprocess.Popen(
        [sys.executable, "-c", code, str(stopped)],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        for words in (["resume", "result"], ["run", "problem.toml", "--out", "result", "--overwrite"]):
            answer = unrender(*words, "--variant", mitsuba_variant)
            assert answer.status == 2
            assert f"run folder result: in use by process {other.pid} on " in answer.error
    finally:
        other.communicate()
    assert unrender("resume", "result").status == 0
