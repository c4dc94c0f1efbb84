"""`unrender export`: what it writes, and what it refuses."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from unrender.io import images

KEY = "wall.bsdf.reflectance.value"
TEXTURE = "back.bsdf.reflectance.data"
QUICK = ["--final-spp", "4"]


@pytest.fixture
def run(run_once, mitsuba_variant: str) -> Path:
    return run_once("--steps", 3, "--variant", mitsuba_variant, *QUICK)


def test_a_toml_problems_result_goes_home(unrender, run: Path, mitsuba_variant: str) -> None:
    answer = unrender("export", "result", "--variant", mitsuba_variant, "--spp", 16)
    assert answer.status == 0, answer.error
    assert answer.out.strip() == f"scene: {Path('result', 'scene', 'scene.xml')}"
    with np.load(run / "parameters.npz") as found:
        value = found[KEY]
    scene = mi.load_file(str(run / "scene" / "scene.xml"))
    np.testing.assert_allclose(np.array(mi.traverse(scene)[KEY]).reshape(-1), value, rtol=1e-6)
    # A white sky over a wall that fills the picture: its colour is the picture's, without noise.
    np.testing.assert_allclose(np.array(mi.render(scene)).mean((0, 1)), value, atol=0.05)  # pyright: ignore[reportArgumentType]
    told = json.loads((run / "scene" / "parameters.json").read_text())
    np.testing.assert_allclose(told[KEY]["value"], value, rtol=1e-6)
    rows = list(csv.DictReader((run / "scene" / "parameters.csv").read_text().splitlines()))
    assert [row["parameter"] for row in rows] == [KEY] * 3
    np.testing.assert_allclose([float(row["value"]) for row in rows], value, rtol=1e-6)


def test_an_export_of_another_scene_is_told(unrender, run: Path, mitsuba_variant: str) -> None:
    wall = run.parent / "wall.xml"
    wall.write_text(wall.read_text().replace('<emitter type="constant"/>', '<emitter type="point" id="bulb"/>'))
    answer = unrender("export", "result", "--variant", mitsuba_variant)
    assert answer.status == 0, answer.error
    (line,) = (line for line in answer.out.splitlines() if line.startswith("note: "))
    assert line.startswith("note: result: the result is of an earlier scene, since ")
    assert "scene: bulb is new" in line
    assert "file wall.xml has changed" in line
    answer = unrender("run", "result")
    assert answer.status == 2
    assert "result: a folder, expected a problem file; it is a run folder: `unrender resume result`" in answer.error


@pytest.mark.slow
def test_a_gallery_problems_maps_are_pictures(unrender, tmp_path: Path, mitsuba_variant: str) -> None:
    options = ["-p", "resolution=8", "-p", "texture_resolution=4", "-p", "reference_spp=2"]
    words = ["run", "indirect-room", *options, "--steps", 2, "--out", "room", "--variant", mitsuba_variant, *QUICK]
    assert unrender(*words).status == 0
    with np.load(tmp_path / "room" / "parameters.npz") as found:
        texture = found[TEXTURE].copy()
    texture[0, 0] = [0.0, 0.5, 1.25]
    np.savez(tmp_path / "room" / "parameters.npz", **{TEXTURE: texture})  # pyright: ignore[reportArgumentType]
    answer = unrender("export", "room", "--out", "home", "--variant", mitsuba_variant)
    assert answer.status == 0, answer.error
    assert f"note: {TEXTURE}: 1 values outside [0, 1] are clipped in maps/back.bsdf.reflectance.png" in answer.out
    maps = tmp_path / "home" / "maps"
    np.testing.assert_array_equal(images.read(maps / "back.bsdf.reflectance.exr").values, texture)
    picture = np.array(Image.open(maps / "back.bsdf.reflectance.png"))
    assert picture[0, 0].tolist() == [0, 188, 255]
    text = (tmp_path / "home" / "scene.xml").read_text()
    assert str(tmp_path) not in text  # nothing but relative paths
    moved = tmp_path / "elsewhere"
    (tmp_path / "home").rename(moved)
    assert np.array(mi.render(mi.load_file(str(moved / "scene.xml")), spp=2)).shape == (8, 8, 3)  # pyright: ignore[reportArgumentType]
    np.testing.assert_array_equal(np.array(mi.traverse(mi.load_file(str(moved / "scene.xml")))[TEXTURE]), texture)


def test_what_is_there_is_replaced_only_on_demand(unrender, run: Path, mitsuba_variant: str) -> None:
    variant = ["--variant", mitsuba_variant]
    assert unrender("export", "result", "--out", "home", *variant).status == 0
    before = (run.parent / "home" / "scene.xml").read_bytes()
    answer = unrender("export", "result", "--out", "home", "--spp", 7, *variant)
    assert (answer.status, answer.out) == (2, "")
    assert "home: holds an earlier export; give --overwrite" in answer.error
    assert (run.parent / "home" / "scene.xml").read_bytes() == before
    assert unrender("export", "result", "--out", "home", "--spp", 7, "--overwrite", *variant).status == 0
    assert 'value="7"' in (run.parent / "home" / "scene.xml").read_text()
    (run.parent / "home" / "mine.txt").write_text("keep me")
    answer = unrender("export", "result", "--out", "home", "--overwrite", *variant)
    assert answer.status == 2
    assert "holds other things" in answer.error
    assert sorted(path.name for path in run.parent.iterdir() if path.name.startswith(".")) == []


def _mkdir(folder: Path) -> None:
    (folder / "other").mkdir()


def _remove(name: str):
    return lambda folder: (folder / name).unlink()


def _shape(folder: Path) -> None:
    np.savez(folder / "result" / "parameters.npz", allow_pickle=False, **{KEY: np.zeros((2, 2), np.float32)})


def _python(folder: Path) -> None:
    (folder / "result" / "problem.toml").write_text('name = "made in Python"\n')


def _function(folder: Path) -> None:
    (folder / "result" / "problem.toml").write_text('scene = "wall.xml"\nloss = "__main__.mine"\n')


@pytest.mark.parametrize(
    ("spoil", "words", "message"),
    [
        (None, ["nowhere"], "nowhere: no such run folder"),
        (_mkdir, ["other"], "run.json is missing"),
        (_remove("result/parameters.npz"), ["result"], "parameters.npz"),
        (_remove("result/problem.toml"), ["result"], "problem.toml"),
        (_remove("wall.xml"), ["result"], "wall.xml"),
        (_shape, ["result"], f"parameter {KEY}: expected shape (3,), got (2, 2)"),
        (_python, ["result"], "the problem was made in Python; pass it"),
        (_function, ["result"], "the problem was made in Python; pass it"),
        (None, ["result", "--out", "photo.exr"], "photo.exr: a file, expected a folder"),
        (None, ["result", "--out", "result"], "holds other things"),
        (None, ["result", "--out", "photo.exr/home"], "photo.exr"),
    ],
)
def test_mistakes_are_one_line(unrender, run: Path, mitsuba_variant: str, spoil, words, message: str) -> None:
    if spoil is not None:
        spoil(run.parent)
    answer = unrender("export", *words, "--variant", mitsuba_variant)
    assert answer.refuses(message)
    assert answer.error.startswith("unrender: ")
    assert not list(run.parent.glob(".*.part")) + list((run).glob(".*.part"))


def test_a_folder_that_cannot_be_written_is_one_line(unrender, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object, **options: object) -> None:
        raise PermissionError(13, "Permission denied")

    if os.geteuid() == 0:  # whom no folder refuses
        monkeypatch.setattr(Path, "mkdir", refuse)
    else:
        run.parent.chmod(0o500)
    answer = unrender("export", "result", "--out", "home")
    run.parent.chmod(0o700)
    assert answer.status == 2
    assert "export to home: Permission denied" in answer.error


@pytest.mark.parametrize("name", ["quad", "exponential"])
def test_what_mitsuba_does_not_render_has_no_scene(unrender, tmp_path: Path, name: str, mitsuba_variant: str) -> None:
    words = ["run", name, "--method", "plain", "--steps", 2, "--out", "toy", "--variant", mitsuba_variant]
    assert unrender(*words, *QUICK).status == 0
    answer = unrender("export", "toy", "--variant", mitsuba_variant)
    assert answer.status == 2
    assert f"{name}: it is not rendered by Mitsuba, so there is no scene to export" in answer.error
