"""`unrender judge`, `unrender turntable` and the formats of `unrender export`: on a wall under an even sky, whose pictures are known."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from unrender.io import images

KEY = "wall.bsdf.reflectance.value"
FOUND = np.array([0.5, 0.4, 0.3], np.float32)
TRUTH = np.array([0.6, 0.5, 0.4], np.float32)
MASK = np.array([[1, 1, 1, 0, 0, 0]] * 4, np.float32)


@pytest.fixture
def run(run_once, problem: Path, mitsuba_variant: str) -> Path:
    """A run of two steps whose result is set to `FOUND`, and held-out.toml beside its problem: the left half counts."""
    folder = run_once("--steps", 2, "--variant", mitsuba_variant, "--method", "plain", "--final-spp", 4)
    np.savez(folder / "parameters.npz", **{KEY: FOUND})  # pyright: ignore[reportArgumentType]
    mi.Bitmap(MASK[..., None]).write(str(problem.parent / "mask.exr"))
    (problem.parent / "held-out.toml").write_text(problem.read_text() + 'mask = "mask.exr"\n')
    return folder


def srgb(x: np.ndarray) -> np.ndarray:
    return 1.055 * x ** (1 / 2.4) - 0.055


def sky(path: Path, level: float) -> Path:
    mi.Bitmap(np.full((4, 8, 3), level, np.float32)).write(str(path))
    return path


def read(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture) / 255


EXPECTED = float(-10 * np.log10(np.mean((srgb(FOUND) - srgb(TRUTH)) ** 2)))
"""A diffuse wall under a sky of radiance 1 that fills the picture has the radiance of its reflectance."""


def test_a_wall_is_judged_by_its_photograph(unrender, run: Path, mitsuba_variant: str) -> None:
    answer = unrender("judge", "result", "--variant", mitsuba_variant, "--spp", 4096)
    assert answer.status == 0, answer.error
    folder = run / "judge"
    record = json.loads((folder / "judge.json").read_text())
    assert [each["name"] for each in record["photographs"]] == ["photo"]
    assert record["mean"]["psnr"] == pytest.approx(EXPECTED, abs=0.1)
    assert record["photographs"][0]["exposure"] == 1
    assert f"{record['mean']['psnr']:.2f}" in answer.out
    # The least squares of one colour against another are exact: what is left is nothing.
    assert record["albedo"]["rmse"] == pytest.approx(0.1, abs=1e-4)
    assert record["albedo"]["scaled_rmse"] < 1e-4
    np.testing.assert_allclose(record["albedo"]["factors"], TRUTH / FOUND, rtol=1e-4)
    assert read(folder / "sheet.png").shape[1] > 700
    shown = read(folder / "pictures" / "0000-photo-rendering.png")
    np.testing.assert_allclose(shown[:, :3].mean((0, 1)), srgb(FOUND), atol=0.01)
    assert not shown[:, 3:].any()
    assert np.ptp(read(folder / "environment.png")) == 0


def test_a_tie_is_judged_by_its_members(unrender, problem: Path, mitsuba_variant: str) -> None:
    """Held-out photographs have a scene of their own, whose parameters are the members of ties, not the unknown that stands for them."""
    tied = f'key = "paint"\nkeys = {{ "{KEY}" = 0.5 }}\nbounds = [0, 2]'
    text = problem.read_text().replace(f'key = "{KEY}"', tied).replace("[0.6, 0.5, 0.4]", "[1.2, 1.0, 0.8]")
    problem.write_text(text)
    (problem.parent / "held-out.toml").write_text(text)
    words = ["--steps", 1, "--out", "result", "--variant", mitsuba_variant, "--method", "plain", "--final-spp", 4]
    answer = unrender("run", "problem.toml", *words)
    assert answer.status == 0, answer.error
    np.savez(problem.parent / "result" / "parameters.npz", paint=2 * FOUND)
    answer = unrender("judge", "result", "--variant", mitsuba_variant, "--spp", 4096)
    assert answer.status == 0, answer.error
    record = json.loads((problem.parent / "result" / "judge" / "judge.json").read_text())
    assert record["notices"] == []
    assert record["mean"]["psnr"] == pytest.approx(EXPECTED, abs=0.1)
    assert record["albedo"]["rmse"] == pytest.approx(0.1, abs=1e-4)


@pytest.mark.slow
def test_under_another_light(unrender, run: Path, mitsuba_variant: str) -> None:
    """Twice the light: twice the picture; the photograph of that is named, or nothing is measured."""
    variant = ["--variant", mitsuba_variant, "--spp", 4096]
    light = sky(run.parent / "sky.exr", 2.0)
    answer = unrender("judge", "result", "--environment", light, *variant)
    assert answer.status == 0, answer.error
    assert "nothing is measured" in answer.out
    assert json.loads((run / "judge" / "judge.json").read_text())["mean"] is None
    mi.Bitmap(np.ascontiguousarray(np.broadcast_to(2 * TRUTH, (4, 6, 3)))).write(str(run.parent / "twice.exr"))
    (run.parent / "relit.toml").write_text((run.parent / "problem.toml").read_text().replace("photo.exr", "twice.exr"))
    words = ["--environment", light, "--held-out", "relit.toml", "--out", "relit", *variant]
    assert unrender("judge", "result", *words).status == 0
    record = json.loads((run.parent / "relit" / "judge.json").read_text())
    factor = record["photographs"][0]["exposure"]  # above 1, so that it is shown darker
    assert factor < 1
    expected = -10 * np.log10(np.mean((srgb(2 * FOUND * factor) - srgb(2 * TRUTH * factor)) ** 2))
    assert record["mean"]["psnr"] == pytest.approx(expected, abs=0.1)


@pytest.mark.slow
def test_a_film_of_luminance_under_another_light(unrender, problem: Path, mitsuba_variant: str) -> None:
    """The photograph is grey, and so is the rendering that is compared with it."""
    scene, weights = problem.with_name("wall.xml"), np.array([0.2126, 0.7152, 0.0722])
    scene.write_text(scene.read_text().replace("<rfilter", '<string name="pixel_format" value="luminance"/><rfilter'))
    mi.Bitmap(np.full((4, 6, 1), 0.4 * weights @ TRUTH, np.float32)).write(str(problem.with_name("photo.exr")))
    words = ["--variant", mitsuba_variant]
    answer = unrender("run", "problem.toml", "--steps", 1, "--out", "result", "-m", "plain", "--final-spp", 1, *words)
    assert answer.status in (0, 5), answer.error
    np.savez(problem.parent / "result" / "parameters.npz", **{KEY: FOUND})  # pyright: ignore[reportArgumentType]
    words += ["--environment", sky(problem.with_name("sky.exr"), 0.4), "--held-out", "problem.toml", "--spp", 4096]
    answer = unrender("judge", "result", *words)
    assert answer.status == 0, answer.error
    record = json.loads((problem.parent / "result" / "judge" / "judge.json").read_text())
    expected = -20 * np.log10(abs(srgb(0.4 * weights @ FOUND) - srgb(0.4 * weights @ TRUTH)))
    assert record["mean"]["psnr"] == pytest.approx(expected, abs=0.1)


@pytest.mark.slow
def test_a_turntable_turns(unrender, run: Path, mitsuba_variant: str) -> None:
    """The wall is seen from the front, then from behind, where it is black."""
    words = ["--frames", 4, "--size", 16, "--spp", 16, "--elevation", 0, "--background", "black"]
    words += ["--environment", sky(run.parent / "sky.exr", 1.0)]
    for out in ("video.gif", "frames"):
        answer = unrender("turntable", "result", *words, "--out", out, "--variant", mitsuba_variant)
        assert answer.status == 0, answer.error
    frames = [read(run.parent / "frames" / f"{index:04d}.png") for index in range(4)]
    assert frames[0][8, 8].min() > 0.2
    assert frames[2][8, 8].max() == 0
    with Image.open(run.parent / "video.gif") as video:
        # From the side and from behind nothing is seen: one frame, that stays.
        assert getattr(video, "n_frames", 1) == 2
    pytest.importorskip("imageio_ffmpeg")
    assert unrender("turntable", "result", *words, "--variant", mitsuba_variant).status == 0
    assert (run / "turntable.mp4").stat().st_size > 500


@pytest.mark.slow
def test_formats_stand_beside_one_another(unrender, run: Path, mitsuba_variant: str) -> None:
    variant = ["--variant", mitsuba_variant]
    answer = unrender("export", "result", "--format", "obj,blender,ply", "--out", "home", *variant)
    assert answer.status == 0, answer.error
    assert "folder: home" in answer.out
    names = {path.name for path in (run.parent / "home").iterdir()}
    assert {"asset.glb", "environment.exr", "environment.hdr", "obj", "ply", "open_in_blender.py"} <= names
    assert not names & {"scene.xml", "meshes", "textures"}
    compile((run.parent / "home" / "open_in_blender.py").read_text(), "open_in_blender.py", "exec")
    lit = images.read(run.parent / "home" / "environment.exr").values
    np.testing.assert_allclose(lit, 1)
    answer = unrender("export", "problem.toml", "--out", "begin", "--format", "obj", *variant)
    assert answer.status == 0, answer.error
    assert "Kd 0.2 0.2 0.2" in (run.parent / "begin" / "obj" / "asset.mtl").read_text()
    assert unrender("export", "problem.toml", "--out", "begin", "--format", "obj", "--overwrite", *variant).status == 0


@pytest.mark.slow
def test_lights_that_turn_with_the_object_are_told(unrender, problem: Path, mitsuba_variant: str) -> None:
    scene, variant = problem.with_name("wall.xml"), ["--variant", mitsuba_variant]
    lamp = '<emitter type="point"><point name="position" x="0" y="0" z="3"/></emitter>'
    scene.write_text(scene.read_text().replace("<shape", lamp + "<shape"))
    answer = unrender("run", "problem.toml", "--steps", 1, "--out", "result", "--final-spp", 1, "-m", "plain", *variant)
    assert answer.status in (0, 5), answer.error
    answer = unrender("turntable", "result", "--frames", 1, "--size", 8, "--spp", 1, "--out", "frames", *variant)
    assert answer.status == 0, answer.error
    assert "note: PointLight: turns with the scene; only environment maps stand still, see --environment" in answer.out


@pytest.mark.parametrize(("rate", "milliseconds"), [(24.0, 40), (35.0, 30), (50.0, 20), (0.5, 2000)])
def test_frames_of_a_gif_last_the_nearest_hundredths(
    tmp_path: Path, mitsuba_variant: str, rate: float, milliseconds: int
) -> None:
    assert mitsuba_variant
    from unrender.app.evaluation.turntable import write_video

    write_video(tmp_path / "a.gif", [np.full((8, 8, 3), grey, np.uint8) for grey in (0, 128, 255)], rate)
    with Image.open(tmp_path / "a.gif") as picture:
        assert (picture.n_frames, picture.info["duration"]) == (3, milliseconds)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["export", "problem.toml", "--format", "gbl"], "--format gbl: expected mitsuba, glb,"),
        (["export", "problem.toml", "--format", ","], "--format: expected one or more of"),
        (["judge", "nowhere"], "nowhere: no such run folder"),
        (["judge", "."], "run.json is missing"),
        (["judge", ".", "--environment", "none.exr"], "--environment none.exr: no such file"),
        (["judge", ".", "--environment", "wall.xml"], "--environment wall.xml: unknown kind of picture"),
        (["judge", ".", "--out", "photo.exr"], "--out photo.exr: a file, expected a folder"),
        (["judge", ".", "--out", "."], "the folder holds other things"),
        (["turntable", "nowhere"], "nowhere: no such run folder"),
        (["turntable", ".", "--size", 33], "--size 33: expected an even number"),
        (["turntable", ".", "--up", "0,0,0"], "expected three numbers, not all 0"),
        (["turntable", ".", "--up", "up"], "--up up: expected three numbers, such as 0,1,0"),
        (["turntable", ".", "--background", "pink"], "--background pink: expected light, black"),
        (["turntable", ".", "--elevation", 90], "--elevation 90: expected above -90"),
        (["turntable", ".", "--rate", "nan"], "--rate nan: expected above 0"),
        (
            ["turntable", ".", "--rate", 60, "--out", "x.gif"],
            "--rate 60: expected 0.002 to 50 frames per second for a .gif",
        ),
        (["turntable", ".", "--rate", 1e-4, "--out", "x.gif"], "--rate 0.0001: expected 0.002 to 50 frames per second"),
        (["turntable", ".", "--out", "x.avi"], "--out x.avi: expected a name that ends in .mp4 or .gif"),
        (["turntable", ".", "--out", "photo.exr/x.gif"], "is not a folder that can be written to"),
        (["turntable", ".", "--out", "there.gif"], "--out there.gif: exists; give --overwrite"),
        (["turntable", ".", "--out", "full"], "--out full: the folder contains other files"),
    ],
)
def test_mistakes_are_one_line(
    unrender, problem: Path, mitsuba_variant: str, words: list[object], message: str
) -> None:
    (problem.parent / "there.gif").write_bytes(b"")
    (problem.parent / "full").mkdir()
    (problem.parent / "full" / "mine.txt").write_text("keep me")
    before = sorted(path.name for path in problem.parent.iterdir())
    answer = unrender(*words, "--variant", mitsuba_variant)
    assert answer.refuses(message)
    assert sorted(path.name for path in problem.parent.iterdir()) == before


@pytest.mark.slow
def test_mistakes_about_what_is_judged_are_one_line(unrender, run: Path, mitsuba_variant: str) -> None:
    def refused(*words: object) -> str:
        answer = unrender(*words, "--variant", mitsuba_variant)
        assert answer.refuses("")
        return answer.error

    assert "none.toml: no such file" in refused("judge", "result", "--held-out", "none.toml")
    (run.parent / "held-out.toml").write_text((run.parent / "held-out.toml").read_text().replace(KEY, "wall.other"))
    assert "wall.other" in refused("judge", "result")
    (run.parent / "other.xml").write_text((run.parent / "wall.xml").read_text())
    (run.parent / "held-out.toml").write_text((run.parent / "problem.toml").read_text() + 'scene = "other.xml"\n')
    assert 'judge does not support views with their own "with" or "scene"' in refused("judge", "result")
    (run.parent / "held-out.toml").unlink()
    line = refused("judge", "result")
    assert "no held-out.toml at " in line
    assert "held-out.toml; give --held-out FILE" in line
    assert unrender("judge", "result", "--held-out", "problem.toml", "--variant", mitsuba_variant).status == 0
    assert "holds an earlier judgement" in refused("judge", "result", "--held-out", "problem.toml")
    (run / "parameters.npz").unlink()
    for words in (
        ["judge", "result", "--out", "new"],
        ["turntable", "result"],
        ["export", "result", "--format", "glb"],
    ):
        assert "parameters.npz" in refused(*words)
    assert not (run.parent / "new").exists()
