"""`unrender run`, `report` and `compare`: what they leave, and how they end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import unrender as package
from tiers import quick, slow
from unrender.app.cli.signals import WAITING
from unrender.runs.final_images import render_final_images

KEY = "wall.bsdf.reflectance.value"
FILES = ["checkpoints", "history.jsonl", "initial.npz", "method.toml", "parameters.npz", "pictures.npz", "problem.toml"]
FILES += ["report.html", "run.json", "sensitivity.npz", "truth.npz"]
QUICK = ["--final-spp", "4"]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_run_recovers_the_wall_and_leaves_a_run_folder(unrender, problem: Path, mitsuba_variant: str):
    words = ["run", "problem.toml", "--steps", 90, "--set", "learning_rate=0.02", "--out", "result", "--seed", 3]
    answer = unrender(*words, "--variant", mitsuba_variant, *QUICK)
    assert answer.status == 0, answer.error
    folder = problem.parent / "result"
    assert names(folder) == FILES
    record = json.loads((folder / "run.json").read_text())
    assert (record["name"], record["method"], record["seed"], record["stopped"]) == ("problem", "auto", 3, "steps")
    assert record["choices"][0].startswith("recursive control variates, 16 samples per pixel")
    assert f"auto: {record['choices'][-1]}" in answer.out
    assert record["adapted"][0].startswith(f"learning rate, over the first: {KEY} ")
    assert record["command"].startswith("unrender run problem.toml --steps 90 --set learning_rate=0.02")
    assert record["settings"]["options"]["learning_rate"] == 0.02
    with np.load(folder / "parameters.npz") as found:
        np.testing.assert_allclose(found[KEY], [0.6, 0.5, 0.4], atol=0.02)
    with np.load(folder / "pictures.npz") as found:
        assert sorted(found) == [f"view0/{name}" for name in ("control_weight", "initial", "reference", "result")]
        np.testing.assert_allclose(found["view0/initial"].mean((0, 1)), 0.2, atol=0.02)
        np.testing.assert_allclose(found["view0/result"].mean((0, 1)), [0.6, 0.5, 0.4], atol=0.05)
        np.testing.assert_allclose(found["view0/reference"][0, 0], [0.6, 0.5, 0.4], rtol=1e-6)
    assert f"page: {Path('result', 'report.html')}" in answer.out
    assert "step 90/90" in answer.out
    assert f"{KEY} error 0.3109 before, 0.0" in " ".join(answer.out.split())


@pytest.mark.slow
@pytest.mark.parametrize("method", quick(["meta", "coupled"], "coupled"))
@pytest.mark.usefixtures("short_ends")
def test_run_by_methods_that_know_their_variance(unrender, problem: Path, mitsuba_variant: str, method: str):
    words = ["run", "problem.toml", "--method", method, "--steps", 120, "--out", "result", "--variant", mitsuba_variant]
    answer = unrender(*words, *QUICK, "--set", "learning_rate=0.004")
    assert answer.status == 0, answer.error
    with np.load(problem.parent / "result" / "parameters.npz") as found:
        np.testing.assert_allclose(found[KEY], [0.6, 0.5, 0.4], atol=0.02)
    assert unrender("report", "result").status == 0


@pytest.mark.slow
@pytest.mark.parametrize("settings", [[], ["--set", "optimizer=newton"]], ids=["newton-cg", "newton"])
def test_run_where_path_gradients_are_zero(unrender, problem: Path, mitsuba_variant: str, settings: list[str]):
    """`mug`: its handle is hidden at the start."""
    del problem
    words = ["run", "mug", "--method", "smoothed", "--set", "sigma=0.6", *settings, "--steps", 80]
    answer = unrender(*words, "--out", "mug", "--variant", mitsuba_variant, *QUICK)
    assert answer.status == 0, answer.error
    record = json.loads(Path("mug", "run.json").read_text())
    assert record["method"] == "smoothed"
    told = [json.loads(line) for line in Path("mug", "history.jsonl").read_text().splitlines()]
    assert told[0]["samples"] > 48 * 48 * 2 * 4
    with np.load(Path("mug", "parameters.npz")) as found:
        assert abs(float(found["mug.rotation.y"])) < 0.15
    assert unrender("report", "mug").status == 0
    still = unrender(
        "run", "mug", "--method", "rcv", "--steps", 10, "--out", "paths", "--variant", mitsuba_variant, *QUICK
    )
    assert still.status == 0, still.error
    with np.load(Path("paths", "parameters.npz")) as found:
        assert abs(float(found["mug.rotation.y"])) > 0.5
    if not settings:
        chosen = unrender("run", "mug", "--steps", 1, "--out", "auto", "--variant", mitsuba_variant, *QUICK)
        assert chosen.status == 0, chosen.error
        assert "auto: Gauss-Newton steps for 1 number from perturbed renders" in chosen.out


def test_run_of_the_gallery_s_problem_without_a_renderer(unrender, problem: Path, mitsuba_variant: str):
    del problem
    words = ["run", "exponential", "--method", "coupled", "--set", "spp=32", "--steps", 150, "--out", "toy"]
    answer = unrender(*words, "--variant", mitsuba_variant, *QUICK)
    assert answer.status == 0, answer.error
    assert "rate error 1 before, 0.0" in " ".join(answer.out.split())


@pytest.mark.slow
def test_run_takes_emitters_by_the_gradient_s_variance(unrender, problem: Path, mitsuba_variant: str):
    scene = problem.parent / "wall.xml"
    two = '<emitter type="constant"/><emitter type="point"><point name="position" value="0, 0, 1"/></emitter>'
    scene.write_text(scene.read_text().replace('<emitter type="constant"/>', two))
    words = ["run", "problem.toml", "--method", "plain", "--steps", 3, "--out", "result", "--variant", mitsuba_variant]
    answer = unrender(*words, *QUICK, "-s", "emitters=adaptive")
    assert answer.status == 0, answer.error
    record = json.loads((problem.parent / "result" / "run.json").read_text())
    assert record["settings"]["options"]["emitters"] == "adaptive"
    wrong = unrender(*words, "-s", "emitters=power")
    assert wrong.status == 2
    assert "option emitters: expected scene or adaptive, got 'power'" in wrong.error


@pytest.mark.usefixtures("short_ends")
def test_run_names_a_new_folder_each_time(unrender, tmp_path: Path, mitsuba_variant: str):
    for _ in range(2):
        words = ["run", "exponential", "--method", "plain", "--set", "steps=1", "--variant", mitsuba_variant]
        assert unrender(*words, "--final-spp", 1).status == 0
    assert names(tmp_path / "out") == ["exponential-plain", "exponential-plain-2"]


def test_run_replaces_earlier_results_only_when_told(unrender, problem: Path, mitsuba_variant: str):
    words = ["run", "problem.toml", "--steps", 1, "--out", "result", "--variant", mitsuba_variant, *QUICK]
    assert unrender(*words).status == 0
    (problem.parent / "result" / "notes.txt").write_text("mine")
    refused = unrender(*words)
    assert refused.status == 2
    assert refused.error == "unrender: --out result: contains earlier results; give --overwrite to replace them\n"
    problem.write_text(problem.read_text().replace("truth", "# truth"))
    assert unrender(*words, "--overwrite").status == 0
    assert names(problem.parent / "result") == [name for name in sorted([*FILES, "notes.txt"]) if name != "truth.npz"]


def test_run_leaves_no_folder_where_it_fails(unrender, problem: Path, mitsuba_variant: str, monkeypatch):
    def fail(**_):
        raise KeyboardInterrupt

    monkeypatch.setattr(import_module("unrender.runs.optimize"), "optimize", fail)
    answer = unrender("run", "problem.toml", "--out", "result", "--variant", mitsuba_variant)
    assert (answer.status, answer.error) == (130, "unrender: interrupted\n")
    assert not (problem.parent / "result").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("short_ends")
def test_run_says_what_was_done_to_the_input_and_warns_of_a_parameter_without_influence(
    unrender, problem: Path, mitsuba_variant: str
):
    mi.Bitmap(np.full((4, 6, 3), 188, np.uint8)).write(str(problem.parent / "photo.png"))
    hidden = '<shape type="sphere" id="hidden"><transform name="to_world"><translate z="50"/></transform>'
    hidden += '<bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape></scene>'
    scene = problem.parent / "wall.xml"
    scene.write_text(scene.read_text().replace("</scene>", hidden))
    text = problem.read_text().replace("photo.exr", "photo.png")
    problem.write_text(text + '[[parameters]]\nkey = "hidden.bsdf.reflectance.value"\n')
    answer = unrender("run", "problem.toml", "--steps", 8, "--variant", mitsuba_variant, *QUICK)
    assert answer.status == 0
    assert names(problem.parent / "out") == ["problem-auto"]
    assert "note: view 0: reference photo.png: 8-bit sRGB, linearised" in answer.out
    assert "warning parameter hidden.bsdf.reflectance.value: its gradient is zero" in answer.out


@pytest.mark.usefixtures("short_ends")
def test_compare_runs_methods_and_then_their_folders(unrender, problem: Path, mitsuba_variant: str):
    words = ["compare", "problem.toml", "--methods", "plain,rcv", "--seconds", 0.2, "--seeds", 2, "--out", "both"]
    words += ["--set", "rcv.spp=4", "--set", "learning_rate=0.02", "--variant", mitsuba_variant, *QUICK]
    answer = unrender(*words)
    assert answer.status == 0, answer.error
    folder = problem.parent / "both"
    runs = ["plain-seed0", "plain-seed1", "rcv-seed0", "rcv-seed1"]
    assert names(folder) == ["compare.html", "compare.json", *runs]
    for run in runs:
        record = json.loads((folder / run / "run.json").read_text())
        assert f"{record['method']}-seed{record['seed']}" == run
        assert record["stopped"] == "seconds"
        assert record["settings"]["options"]["learning_rate"] == 0.02
        assert record["settings"]["options"]["spp"] == (4 if record["method"] == "rcv" else 8)
    rows = [line.split() for line in answer.out.splitlines()]
    told = [row for row in rows if row and row[0] in ("plain", "rcv")]
    assert [row[:2] for row in told[:2]] == [["plain", "2"], ["rcv", "2"]]
    assert [row[0] for row in told[2:]] == ["plain", "rcv"]  # once more, with the measures of their pictures
    assert all(
        part in answer.out for part in (f"Parameter error (RMSE): {KEY}", "paths", "PSNR", "SSIM", "relative MSE")
    )
    assert f"page: {Path('both', 'compare.html')}" in answer.out

    again = unrender("compare", Path("both", "plain-seed0"), Path("both", "rcv-seed1"))
    assert again.status == 0
    assert "PSNR" in again.out
    assert names(problem.parent / "out" / "compare") == ["compare.html", "compare.json"]
    (folder / "plain-seed0" / "report.html").unlink(missing_ok=True)
    assert unrender("report", Path("both", "plain-seed0")).out.strip() == str(
        Path("both", "plain-seed0", "report.html")
    )
    assert unrender(*words).error.startswith("unrender: --out both: contains earlier results")


@pytest.mark.slow
@pytest.mark.usefixtures("short_ends")
def test_compare_takes_equal_steps(unrender, problem: Path, mitsuba_variant: str):
    words = [
        "compare",
        "problem.toml",
        "--methods",
        "plain",
        "--steps",
        3,
        "--out",
        "steps",
        "--variant",
        mitsuba_variant,
    ]
    answer = unrender(*words, *QUICK)
    assert answer.status == 0, answer.error
    record = json.loads((problem.parent / "steps" / "plain-seed0" / "run.json").read_text())
    assert (record["stopped"], record["steps"]) == ("steps", 3)
    refused = unrender("compare", "steps", "--steps", 3)
    assert "--steps does not apply to run folders" in refused.error


def test_ctrl_c_keeps_what_was_reached(problem: Path, mitsuba_variant: str):
    source = Path(package.__file__).parents[1]
    command = [
        sys.executable,
        "-m",
        "unrender.app.cli.main",
        "run",
        "problem.toml",
        "--seconds",
        "600",
        "--out",
        "result",
    ]
    process = subprocess.Popen(
        [*command, "--variant", mitsuba_variant, *QUICK],
        cwd=problem.parent,
        env={**os.environ, "PYTHONPATH": str(source)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    try:
        for line in process.stdout:
            if line.startswith("step "):
                process.send_signal(signal.SIGINT)
                break
        out, error = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 130, error
    assert error.removeprefix(f"unrender: {WAITING}\n") == "unrender: interrupted\n"
    assert "interrupted: the current state is saved" in out
    assert "to continue: unrender resume result" in out
    folder = problem.parent / "result"
    assert names(folder) == FILES
    record = json.loads((folder / "run.json").read_text())
    assert record["stopped"] == "interrupted"
    assert record["steps"] == len((folder / "history.jsonl").read_text().splitlines()) >= 1


@pytest.mark.slow
def test_a_reader_that_leaves_gets_no_traceback():
    source = Path(package.__file__).parents[1]
    process = subprocess.Popen(
        [sys.executable, "-m", "unrender.app.cli.main", "methods"],
        env={**os.environ, "PYTHONPATH": str(source)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait(timeout=60) == 1


@pytest.mark.parametrize("spp", [None, slow(4)])
def test_final_pictures_are_of_the_result(problem: Path, spp):
    made = package.Problem.from_file(problem)
    result = package.optimize(made, package.PathGradient(spp=2), package.optimizers.Adam(0.3), steps=1)
    shown = render_final_images(made, result, spp).pictures
    assert sorted(shown) == ["view0/initial", "view0/reference", "view0/result"]
    np.testing.assert_allclose(shown["view0/initial"].mean((0, 1)), result.initial[KEY], atol=0.02)
    np.testing.assert_allclose(shown["view0/result"].mean((0, 1)), result.parameters[KEY], atol=0.05)
