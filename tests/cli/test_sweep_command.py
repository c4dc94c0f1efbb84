"""`unrender sweep`, and `--workers`, as a user types them."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import typer

import unrender as ur
from unrender.app.cli import tasks
from unrender.app.cli.signals import DOUBTFUL, FAILED, INTERRUPTED, WAITING
from unrender.app.sweeps.record import write_sweep
from unrender.gallery import analytic
from unrender.runs.budget import Budget
from unrender.scene.problem import Problem

TOY = ["quad", "--method", "plain", "--steps", 20, "--final-spp", 1]
GRID = [*TOY, "--over", "learning_rate=0.03,0.3"]


def sweep_json(folder: str = "s") -> dict[str, Any]:
    return json.loads(Path(folder, "sweep.json").read_text())


def trials(folder: str) -> list[tuple]:
    return [(t["settings"], t["status"], t["error"], t["runs"][0]["steps"]) for t in sweep_json(folder)["trials"]]


@pytest.mark.slow
def test_a_grid_in_this_process(unrender, mitsuba_variant: str) -> None:
    answer = unrender("sweep", *GRID, "--seeds", 2, "--out", "s", "--variant", mitsuba_variant)
    assert (answer.status, answer.error) == (0, "")
    record = sweep_json()
    assert (record["status"], record["best"], record["best_line"]) == ("finished", 1, "-s learning_rate=0.3")
    line = f"to run it: unrender run quad --method plain --steps 20 --final-spp 1 --variant {mitsuba_variant} -s"
    assert f"best: -s learning_rate=0.3\n{line}" in answer.out
    assert Path("s/compare.html").exists()
    runs = [run for trial in record["trials"] for run in trial["runs"]]
    assert [run["folder"] for run in runs] == [f"trial-{i:03d}-seed{k}" for i in range(2) for k in range(2)]
    for run in runs:
        stored = json.loads(Path("s", run["folder"], "run.json").read_text())
        assert (stored["status"], stored["steps"], stored["seed"]) == ("finished", 20, run["seed"])
    best = record["trials"][1]
    assert best["error"] == pytest.approx(sum(run["error"] for run in best["runs"]) / 2)
    assert unrender("run", *TOY, "-s", "learning_rate=0.3", "--out", "r", "--variant", mitsuba_variant).status == 0
    alone, within = (json.loads(Path(p, "run.json").read_text()) for p in ("r", "s/trial-001-seed0"))
    assert alone["settings"]["options"] == within["settings"]["options"]
    again = unrender("sweep", *GRID, "--out", "s")
    assert (again.status, "contains earlier results" in again.error) == (2, True)


@pytest.mark.slow
def test_an_interrupted_sweep_goes_on_where_it_was(
    unrender, monkeypatch: pytest.MonkeyPatch, mitsuba_variant: str
) -> None:
    command = ["sweep", *TOY, "--over", "learning_rate=0.001:1:log", "--trials", 4, "--variant", mitsuba_variant]
    assert unrender(*command, "--out", "whole").status == 0
    carry_out, begun = tasks.carry_out, []

    def interrupted(job: tasks.Job, task: tasks.RunTask, *others: Any) -> Any:
        begun.append(task.name)
        if len(begun) == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return carry_out(job, task, *others)

    with monkeypatch.context() as patches:
        patches.setattr(tasks, "carry_out", interrupted)
        answer = unrender(*command, "--out", "s")
    assert (answer.status, answer.error) == (130, "unrender: interrupted\n")
    assert "to continue: unrender sweep s" in answer.out
    assert (sweep_json()["status"], len(sweep_json()["trials"])) == ("interrupted", 2)
    stamps = [os.stat(f"s/trial-00{i}-seed0/run.json").st_mtime_ns for i in range(2)]
    assert unrender("sweep", "s").status == 0
    assert sweep_json()["status"] == "finished"
    assert trials("s") == trials("whole")
    assert stamps == [os.stat(f"s/trial-00{i}-seed0/run.json").st_mtime_ns for i in range(2)]
    assert unrender("report", "s").out.strip() == "s/compare.html"
    more = unrender("sweep", "s", "--trials", 5)
    assert (more.status, len(trials("s"))) == (0, 5)
    refused = unrender("sweep", "s", "--steps", 3)
    assert (refused.status, "continues with its original options; leave out --steps" in refused.error) == (2, True)
    for short, full in (("-p", "--problem-set"), ("-s", "--set"), ("-m", "--method")):
        refused = unrender("sweep", "s", short, "a=1")
        assert (refused.status, f"leave out {full}\n" in refused.error) == (2, True)


def test_a_trial_that_cannot_be_carried_out_is_one_line_and_the_others_go_on(
    unrender, monkeypatch: pytest.MonkeyPatch, mitsuba_variant: str
) -> None:
    carry_out = tasks.carry_out

    def broken(job: tasks.Job, task: tasks.RunTask, *others: Any) -> Any:
        if task.settings["learning_rate"] == "0.003":
            raise RuntimeError("out\nof memory")
        return carry_out(job, task, *others)

    over = ["--over", "learning_rate=0.003,0.03"]
    with monkeypatch.context() as patches:
        patches.setattr(tasks, "carry_out", broken)
        answer = unrender("sweep", *TOY, *over, "--out", "s", "--variant", mitsuba_variant)
    assert answer.status == 0
    assert "failed (trial 0): RuntimeError: out of memory\n" in answer.out
    assert [trial["status"] for trial in sweep_json()["trials"]] == ["failed", "finished"]
    assert sweep_json()["best"] == 1
    assert unrender("sweep", "s").status == 0  # tried once more
    assert [trial["status"] for trial in sweep_json()["trials"]] == ["finished", "finished"]


@pytest.mark.slow
def test_a_sweep_of_a_gallery_problem_that_has_changed_is_not_continued(unrender, monkeypatch: Any) -> None:
    over = ["--over", "learning_rate=0.001:0.1:log", "--search", "random", "--trials", 1, "--steps", 2, "--out", "s"]
    assert unrender("sweep", "exponential", "-m", "plain", *over).status == 0
    build = analytic.Exponential.problem
    for change, words in (
        ({"initial": 1.6}, "initial was () of mean 1.5 and deviation 0, is () of mean 1.6 and deviation 0"),
        ({"learning_rate": 0.5}, "learning_rate was None, is 0.5"),
    ):

        def changed(self: Any, name: str, change: Any = change) -> Problem:
            made = build(self, name)
            return made.replaced(parameters=[replace(made.parameters[0], **change)])

        monkeypatch.setattr(analytic.Exponential, "problem", changed)
        answer = unrender("sweep", "s", "--trials", 2)
        assert answer.refuses(f"trial 0: parameter rate: {words}; begin another sweep, or take the change back")
    monkeypatch.setattr(analytic.Exponential, "problem", build)
    assert unrender("sweep", "s", "--trials", 2).status == 0


def test_a_sweep_whose_problem_has_changed_is_not_continued(unrender, problem: Path, mitsuba_variant: str) -> None:
    over = ["--over", "learning_rate=0.001:0.1:log", "--search", "random", "--trials", 1, "--steps", 2]
    over += ["--final-spp", 2, "--variant", mitsuba_variant, "--out", "s"]
    text = problem.read_text().replace("truth = [0.6", "initial = 0.3\ntruth = [0.6")
    problem.write_text(text)
    assert unrender("sweep", "problem.toml", "-m", "plain", *over).status == 0
    for old, new, change in (
        ("0.3", "0.25", "initial has changed"),
        ("[0.6", "[0.5", "truth has changed"),
        ("0.3", "0.3\nlearning_rate = 0.5", "learning_rate was None, is 0.5"),
    ):
        problem.write_text(text.replace(old, new))
        answer = unrender("sweep", "s", "--trials", 2)
        assert answer.refuses(f"trial 0: parameter wall.bsdf.reflectance.value: {change}; begin another sweep")
    problem.write_text(text)
    assert unrender("sweep", "s", "--trials", 2).status == 0
    mi.Bitmap(np.ones((4, 6, 3), np.float32)).write("photo.exr")
    answer = unrender("sweep", "s", "--trials", 3)
    assert answer.refuses(
        "s: its problem has changed since trial 0: view 0: reference has changed; begin another sweep"
    )
    assert len(trials("s")) == 2


SCENE = """<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="2"/></integrator>
<sensor type="perspective"><transform name="to_world"><lookat origin="0,0,3" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/><rfilter type="box"/></film></sensor>
<shape type="rectangle" id="a"><bsdf type="diffuse"><rgb name="reflectance" value="0.2"/></bsdf></shape>
<shape type="sphere" id="b"><bsdf type="diffuse"><rgb name="reflectance" value="0.3"/></bsdf></shape>
<emitter type="point" id="lamp"><point name="position" x="0" y="0" z="2"/><rgb name="intensity" value="{}"/></emitter></scene>"""
WORLDS = """scene = "one.xml"
[[parameters]]
key = "paint"
initial = 0.05
keys = {"a.bsdf.reflectance.value" = 1.0, "b.bsdf.reflectance.value" = 0.5}
[[views]]
reference = "photo.npy"
with = {"lamp.intensity.value" = [4, 4, 4]}
[[views]]
reference = "photo.npy"
scene = "two.xml"
"""


@pytest.mark.slow
def test_views_of_different_worlds_and_ties(unrender, mitsuba_variant: str) -> None:
    """Trials without a truth and with final pictures of one sample had failed, and were said to have gradients that are not finite."""
    for name, intensity in (("one.xml", 2), ("two.xml", 5)):
        Path(name).write_text(SCENE.format(intensity))
    np.save("photo.npy", np.full((8, 8, 3), 0.1, np.float32))
    Path("p.toml").write_text(WORLDS)
    words = [
        "p.toml",
        "--method",
        "plain",
        "--steps",
        8,
        "--over",
        "learning_rate=0.001,0.05",
        "--variant",
        mitsuba_variant,
    ]
    refused = unrender("sweep", *words, "--final-spp", 1, "--out", "refused")
    line = "unrender: --final-spp: expected 2 or more, since trials without a truth are ranked by final pictures\n"
    assert (refused.status, refused.error) == (2, line)
    answer = unrender("sweep", *words, "--final-spp", 16, "--out", "s")
    assert (answer.status, answer.error) == (0, "")
    errors = [trial["error"] for trial in sweep_json()["trials"]]
    assert sweep_json()["best"] == np.argmin(errors)
    assert max(errors) > 1.1 * min(errors)
    assert (
        unrender("run", *words[:5], "-s", "learning_rate=0.05", "--out", "r", "--variant", mitsuba_variant).status == 0
    )
    alone, within = (Path(p, "history.jsonl").read_text().splitlines() for p in ("r", "s/trial-001-seed0"))
    assert [json.loads(line)["loss"] for line in alone] == [json.loads(line)["loss"] for line in within]


def test_a_sweep_from_python_is_the_commands(unrender, monkeypatch: pytest.MonkeyPatch) -> None:
    plans, over = [], {"learning_rate": "0.01:0.1:log", "spp": [1, 4]}

    def run_trials(console: Any, session: Any, record: Any, search: Any) -> None:
        plans.append((record.plan, session.workers, session.threads, search.trials))
        write_sweep(session.folder, record)

    monkeypatch.setattr("unrender.app.cli.sweep_driver.run_trials", run_trials)
    found = ur.app.sweep("quad", "plain", over, steps=3, trials=5, settings={"beta_2": 0.9}, threads=1, out="python")
    words = ["--method", "plain", "--over", "learning_rate=0.01:0.1:log", "--over", "spp=1,4", "--steps", 3]
    assert unrender("sweep", "quad", *words, "--trials", 5, "-s", "beta_2=0.9", "--threads", 1).status == 0
    assert plans[0] == plans[1]
    assert found.plan == plans[0][0]
    with pytest.raises(ur.InputError, match="nothing to vary"):
        ur.app.sweep("quad", "plain")
    with pytest.raises(ur.InputError, match="contains earlier results"):
        ur.app.sweep("quad", "plain", over, out="python")


@pytest.mark.parametrize("status", [FAILED, DOUBTFUL, INTERRUPTED])
def test_a_sweep_from_python_returns_doubtful_and_failed_trials(
    status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run_trials(console: Any, session: Any, record: Any, search: Any) -> None:
        write_sweep(session.folder, record)
        raise typer.Exit(status)

    monkeypatch.setattr("unrender.app.cli.sweep_driver.run_trials", run_trials)
    interrupted = pytest.raises(KeyboardInterrupt) if status == INTERRUPTED else contextlib.nullcontext()
    with interrupted:
        assert ur.app.sweep("quad", "plain", {"spp": [1, 4]}, steps=3, out=tmp_path / "s").plan.steps == 3


COMPARED = ["compare", "quad", "--methods", "plain", "--seconds", 1, "--final-spp", 1]
SWEPT = ["sweep", "quad", "--method", "plain", "--over", "learning_rate=0.03,0.3", "--seconds", 1, "--final-spp", 1]


@pytest.mark.parametrize("command", [COMPARED, SWEPT])
def test_the_seconds_of_a_run_cover_its_compilation_and_pictures(
    unrender, monkeypatch: pytest.MonkeyPatch, command: list, mitsuba_variant: str
) -> None:
    """As in `unrender run`. The budget of each run begins with it."""
    check, left, began = Budget.on_start, [], []

    def on_start(self: Budget, run: Any) -> None:
        check(self, run)
        left.append(run.time_left())
        began.append(run.deadline - 1.0)

    monkeypatch.setattr(Budget, "on_start", on_start)
    monkeypatch.setattr(Budget, "on_update", lambda self, run, *_: run.stop("seconds"))
    answer = unrender(*command, "--out", "s", "--variant", mitsuba_variant)
    assert answer.status in (0, 3), answer.error
    assert len(left) == (2 if command is SWEPT else 1)
    assert all(seconds < 1.0 for seconds in left)
    assert began == sorted(set(began))


def test_a_sweep_tells_once_of_seconds_that_allow_few_steps(
    unrender, monkeypatch: pytest.MonkeyPatch, mitsuba_variant: str
) -> None:
    monkeypatch.setattr(Budget, "on_update", lambda self, run, *_: run.stop("seconds"))
    answer = unrender(*SWEPT, "--out", "s", "--variant", mitsuba_variant)
    assert answer.out.count("note: the budget of 1 s allows about 1 step;") == 1


@pytest.mark.parametrize("command", [["sweep", *GRID], ["compare", "quad", "--seconds", 1]])
def test_without_ray_one_line_says_what_to_install(unrender, monkeypatch: pytest.MonkeyPatch, command: list) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    answer = unrender(*command, "--workers", 2, "--out", "s")
    assert answer.refuses("")
    assert "pip install 'unrender[ray]'" in answer.error
    assert not Path("s").exists()


def test_without_optuna_one_line_says_what_to_install(unrender, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    answer = unrender("sweep", *GRID, "--search", "tpe", "--out", "s")
    assert (answer.status, "pip install 'unrender[sweep]'" in answer.error, Path("s").exists()) == (2, True, False)


# ---------------------------------------------------------------------- on workers


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Any]:
    """Starts the command in a process of its own, in a group of its own, which is ended with the test."""
    pytest.importorskip("ray")
    begun: list[subprocess.Popen] = []

    def start(*arguments: object) -> subprocess.Popen:
        command = [sys.executable, "-m", "unrender", *map(str, arguments)]
        process = subprocess.Popen(
            command,
            cwd=tmp_path,
            env=os.environ | {"RAY_worker_niceness": "0"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        begun.append(process)
        return process

    yield start
    for process in begun:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


LONG = [
    *("poster", "-p", "resolution=16", "-m", "plain", "--over", "learning_rate=0.003,0.01,0.03", "--final-spp", 2),
    *("--steps", 3000, "--threads", 1),
]


def wait_for(process: subprocess.Popen, folder: Path, pattern: str, count: int) -> list[Path]:
    """Return the files, as soon as there are so many. A command that ends before fails at once, with what it said."""
    until = time.monotonic() + 200
    while len(found := sorted(folder.glob(pattern))) < count:
        assert process.poll() is None, f"ended without {pattern}: {process.communicate()}"
        assert time.monotonic() < until, f"no {pattern}"
        time.sleep(0.05)
    return found


@pytest.mark.slow
def test_workers_find_what_one_process_does_though_one_is_killed(started: Any, tmp_path: Path, unrender) -> None:
    process = started("sweep", *LONG, "--steps", 600, "--workers", 2, "--out", "s")
    lock = wait_for(process, tmp_path / "s", "trial-*/checkpoints/*/manifest.json", 1)[0].parents[2] / "lock"
    os.kill(json.loads(lock.read_text())["pid"], signal.SIGKILL)
    out, error = process.communicate(timeout=300)
    assert (process.returncode, error) == (0, "")
    assert "3/3 trial" in out
    record = sweep_json("s")
    assert sorted(trial["attempts"] for trial in record["trials"]) == [1, 1, 2]
    alone = unrender("sweep", *LONG, "--steps", 600, "--out", "alone")
    assert alone.status == 0
    assert trials("s") == trials("alone")


@pytest.mark.slow
def test_an_interrupt_ends_workers_and_what_was_reached_is_kept(started: Any, tmp_path: Path) -> None:
    process = started("sweep", *LONG, "--steps", 200_000, "--workers", 2, "--out", "s")
    wait_for(process, tmp_path / "s", "trial-*/checkpoints/*/manifest.json", 2)
    os.killpg(process.pid, signal.SIGINT)
    began = time.monotonic()
    out, error = process.communicate(timeout=60)
    assert time.monotonic() - began < 30
    assert (process.returncode, error.removeprefix(f"unrender: {WAITING}\n")) == (130, "unrender: interrupted\n")
    assert "to continue: unrender sweep s" in out
    assert json.loads((tmp_path / "s/sweep.json").read_text())["status"] == "interrupted"
    assert json.loads((tmp_path / "s/trial-000-seed0/run.json").read_text())["steps"] > 0
