"""`unrender import` as a user types it: a problem that runs, conventions that look flipped, and captures that are wrong."""

from __future__ import annotations

import json
import os
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from conftest import Unrender
from tiers import quick

pytest.importorskip("cv2", reason="photographs need OpenCV: pip install 'unrender[capture]'")
pytest.importorskip("xatlas", reason="atlases need xatlas: pip install 'unrender[capture]'")

pytest.importorskip("fast_simplification", reason="hulls need fast-simplification: pip install 'unrender[capture]'")

import made_capture as made
import unrender as ur
from unrender.app.capture.cameras import Lens
from unrender.app.stages import stages_file
from unrender.io import images, toml_lines

LENS = Lens(40, 40, 48.0, 48.0, 20.0, 20.0)
SMALL = ("--voxels", 24, "--faces", 400, "--texture", 16)
VIEWS = 9
MATERIAL, NORMALS = ("base_color.data", "roughness.data", "metallic.data"), "asset.bsdf.normalmap.data"


@pytest.fixture(scope="module")
def mesh(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made.mesh(tmp_path_factory.mktemp("mesh") / "mesh.obj")


@pytest.fixture(scope="module")
def made_folder(mesh: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "head"
    made.write_transforms(folder, made.shots(mesh, LENS, VIEWS), LENS)
    return folder


@pytest.fixture
def capture(made_folder: Path, tmp_path: Path) -> Path:
    """Nine photographs with masks and transforms.json, to be spoilt."""
    return Path(shutil.copytree(made_folder, tmp_path / "head"))


def edit(capture: Path, change: Callable[[dict[str, Any]], None]) -> None:
    document = json.loads((capture / "transforms.json").read_text())
    change(document)
    (capture / "transforms.json").write_text(json.dumps(document))


def matrices(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def spoil(capture: Path) -> None:
        def every(document: dict[str, Any]) -> None:
            for frame in document["frames"]:
                frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()

        edit(capture, every)

    return spoil


# ---------------------------------------------------------------------- a problem that runs


@pytest.mark.slow
def test_masks_alone_become_a_problem_that_runs(unrender: Unrender, capture: Path) -> None:
    answer = unrender("import", capture, "--out", "asset", *SMALL)
    assert answer.status == 0, answer.error
    assert "transforms: 7 photographs and 2 held out, 40 x 40" in answer.out
    covered = float(answer.out.split("with IoU ")[1].split(",")[0])
    assert covered > 0.93
    folder = Path("asset")
    assert {path.name for path in folder.iterdir()} == {
        *("scene.xml", "problem.toml", "held-out.toml", "stages.toml", "asset.ply", "check.png"),
        *("references", "masks", "textures"),
    }
    assert [path.name for path in Path().iterdir() if "part" in path.name] == []
    # The hull's normals are unknown, from the third stage on.
    assert _keys(folder) == [*(f"asset.bsdf.nested_bsdf.{name}" for name in MATERIAL), NORMALS, "light.data"]
    stages = stages_file.read(folder / "stages.toml").stages
    assert [NORMALS in stage.unknowns for stage in stages] == [False, False, True, True]
    assert [set(stage.unknowns) for stage in stages[2:]] == 2 * [set(_keys(folder))]


@pytest.mark.slow
def test_normals_of_a_mesh_that_is_given_are_taken_as_they_are(unrender: Unrender, capture: Path, mesh: Path) -> None:
    answer = unrender("import", capture, "--mesh", mesh, "--out", "asset", "--resolution", 20, "--texture", 4)
    assert answer.status == 0, answer.error
    assert _keys(Path("asset")) == [*(f"asset.bsdf.{name}" for name in MATERIAL), "light.data"]


def _keys(folder: Path) -> list[str]:
    """The unknowns of a problem file."""
    return [
        table["key"] for table in toml_lines.parse((folder / "problem.toml").read_text(), "problem.toml")["parameters"]
    ]


@pytest.mark.slow
def test_unknowns_by_choice_are_parameters_of_the_scene(unrender: Unrender, capture: Path, mesh: Path) -> None:
    given = ("import", capture, "--mesh", mesh, "--out", "asset", "--resolution", 20, "--texture", 4, "--band", 2)
    answer = unrender(*given, "--unknowns", "exposure, shape,light,normal,metallic,roughness,colour")
    assert answer.status == 0, answer.error
    problem = ur.Problem.from_file("asset/problem.toml")
    material = "asset.bsdf.nested_bsdf"
    assert {key: value.shape for key, value in problem.initial_values().items() if key != "asset.vertex_positions"} == {
        f"{material}.base_color.data": (4, 4, 3),
        f"{material}.roughness.data": (4, 4, 1),
        f"{material}.metallic.data": (4, 4, 1),
        "asset.bsdf.normalmap.data": (4, 4, 3),
        "light.data": (16, 34, 3),
        "exposure": (7, 3),
    }
    assert problem.unknowns["asset.vertex_positions"].preconditioner.strength == 20  # pyright: ignore
    held_out = ur.Problem.from_file("asset/held-out.toml")
    assert [*held_out.initial_values(), "exposure"] == list(problem.initial_values())
    # The band counts a tenth, in training views alone.
    weights = {float(weight) for view in problem.views for weight in np.unique(np.asarray(view.mask))}
    assert np.allclose(sorted(weights), [0, 26 / 255, 1], atol=2e-3)
    assert {float(weight) for view in held_out.views for weight in np.unique(np.asarray(view.mask))} == {0.0, 1.0}
    stages = stages_file.read("asset/stages.toml")
    assert [stage.name for stage in stages.stages] == ["coarse-materials", "materials", "normals", "detail", "shape"]
    assert {key for stage in stages.stages for key in stage.unknowns} == set(problem.initial_values())
    assert all("exposure" in stage.unknowns for stage in stages.stages)
    for wrong in ("", "color", "colour,lihgt"):
        answer = unrender(*given, "--overwrite", "--unknowns", wrong)
        assert answer.status == 2
        assert answer.error.startswith("unrender: --unknowns: ")


@pytest.mark.slow
def test_saturated_photographs_are_censored(unrender: Unrender, capture: Path, mesh: Path) -> None:
    given = ("import", capture, "--mesh", mesh, "--out", "asset", "--resolution", 20, "--texture", 4, "--overwrite")
    assert unrender(*given).status == 0
    assert ur.Problem.from_file("asset/problem.toml").loss == ur.losses.L1()
    for path in (capture / "images").iterdir():
        picture = np.array(Image.open(path)).astype(int)
        Image.fromarray((picture * 3).clip(0, 255).astype(np.uint8)).save(path)
    assert unrender(*given).status == 0
    assert ur.Problem.from_file("asset/problem.toml").loss == ur.losses.Censored(ur.losses.L1(), 0.95)


@pytest.mark.slow
def test_a_response_is_fitted_or_named(unrender: Unrender, capture: Path, mesh: Path) -> None:
    given = ("import", capture, "--mesh", mesh, "--out", "asset", "--resolution", 20, "--texture", 4, "--overwrite")
    answer = unrender(*given, "--response", "linear")
    assert answer.status == 0, answer.error
    linear = np.asarray(ur.Problem.from_file("asset/problem.toml").views[0].reference)
    answer = unrender(*given, "--response", "fit")
    assert answer.status == 0, answer.error
    assert "note: response: light and object are static" in answer.out
    problem = ur.Problem.from_file("asset/problem.toml")
    assert problem.initial_values()["response"].shape == (3, 2)
    assert "response" not in ur.Problem.from_file("asset/held-out.toml").initial_values()
    inside = np.asarray(problem.views[0].mask) > 0
    assert (np.asarray(problem.views[0].reference)[inside] < linear[inside]).mean() > 0.9
    for wrong in (("--response", "film"), ("--response", "fit", "--unknowns", "colour,exposure")):
        answer = unrender(*given, *wrong)
        assert (answer.status, answer.error.count("\n")) == (2, 1)
    # Held-out photographs are judged through the curve that was found.
    words = ("--steps", 1, "--final-spp", 1, "--out", "run")
    assert unrender("run", "asset/problem.toml", *words, "--method", "plain").status == 0
    psnr = []
    for response in ([[0.0, 0.0]] * 3, [[0.0, -1.0]] * 3):
        values: dict[str, Any] = dict(np.load("run/parameters.npz"))
        values["response"] = np.array(response, np.float32)
        np.savez("run/parameters.npz", **values)
        answer = unrender("judge", "run", "--spp", 4, "--overwrite")
        assert answer.status == 0, answer.error
        psnr.append(json.loads(Path("run/judge/judge.json").read_text())["mean"]["psnr"])
    assert abs(psnr[0] - psnr[1]) > 0.1


@pytest.mark.slow
def test_what_is_written_runs(unrender: Unrender, capture: Path) -> None:
    folder = Path("asset")
    assert unrender("import", capture, "--out", folder, *SMALL).status == 0
    answer = unrender("run", folder / "problem.toml", "--steps", 3, "--final-spp", 1, "--out", "run")
    assert answer.status == 0, answer.error
    losses = [json.loads(line)["loss"] for line in Path("run/history.jsonl").read_text().splitlines()]
    assert losses[-1] < losses[0]


def test_an_earlier_import_is_replaced_only_when_asked(unrender: Unrender, capture: Path, mesh: Path) -> None:
    given = ("import", capture, "--mesh", mesh, "--out", "asset", "--resolution", 20, "--texture", 4)
    assert unrender(*given).status == 0
    before = Path("asset/problem.toml").read_bytes()
    again = unrender(*given, "--hold-out", 0)
    assert again.status == 2
    assert "--overwrite" in again.error
    assert Path("asset/problem.toml").read_bytes() == before
    _cut(_photograph(capture))
    assert unrender(*given, "--hold-out", 0, "--overwrite").status == 2
    assert Path("asset/problem.toml").read_bytes() == before
    _photograph(capture).unlink()
    assert unrender(*given, "--hold-out", 0, "--overwrite").status == 0
    assert not Path("asset/held-out.toml").exists()


@pytest.mark.slow
def test_nothing_but_an_earlier_import_is_removed(unrender: Unrender, capture: Path, mesh: Path) -> None:
    given = ("import", capture, "--mesh", mesh, "--resolution", 20, "--texture", 4, "--overwrite", "--out")
    assert unrender(*given, "asset").status == 0
    answer = unrender(*given, "asset", "--check")
    assert (answer.status, "holds no earlier results (check)" in answer.error) == (2, True)
    Path("asset/run").mkdir()
    answer = unrender(*given, "asset")
    assert (answer.status, "asset: contains other files, such as run" in answer.error) == (2, True)
    Path("asset/run").rmdir()
    capture.rename("asset/masks/head")
    answer = unrender("import", "asset/masks/head", *given[2:], "asset")
    assert (answer.status, "is inside it and would be removed" in answer.error) == (2, True)
    Path("empty").mkdir()
    os.chdir("empty")
    answer = unrender("import", "../asset/masks/head", *given[2:], ".")
    assert (answer.status, "the current directory" in answer.error, answer.error.count("\n")) == (2, True, 1)
    assert Path("../asset/problem.toml").is_file()


@pytest.mark.parametrize(
    ("option", "value"), [("--texture", 64), ("--band", 2), ("--unknowns", "colour"), ("--field", 8)]
)
def test_check_refuses_what_it_would_ignore(option: str, value: object, unrender: Unrender, capture: Path) -> None:
    answer = unrender("import", capture, "--check", "--out", "look", option, value)
    assert (answer.status, f"{option}: does not apply to a check" in answer.error) == (2, True), answer.error
    assert not Path("look").exists()


@pytest.mark.slow
def test_check_draws_every_photograph(unrender: Unrender, capture: Path) -> None:
    answer = unrender("import", capture, "--check", "--out", "look", *SMALL[:4])
    assert answer.status == 0, answer.error
    assert len(list(Path("look/check").glob("*.png"))) == VIEWS
    assert not Path("look/problem.toml").exists()
    picture = np.array(Image.open("look/check/0000-view_0.png"))
    orange, blue = (
        (picture == np.round(np.array(c) * 255 + 1e-9)).all(-1).sum() for c in ([1, 0.55, 0.05], [0.1, 0.55, 1])
    )
    assert orange + blue > 300  # outlines of 320 pixels' width


# ---------------------------------------------------------------------- conventions that look flipped

FLIPPED = {
    "OpenCV's axes": (matrices(lambda m: m @ np.diag([1.0, -1, -1, 1])), "give --axes opencv"),
    "LLFF's axes": (matrices(lambda m: m @ made.GL @ made.LLFF), "give --axes llff"),
    "the inverse": (matrices(np.linalg.inv), "give --axes opengl --world-to-camera"),
    "COLMAP's matrices": (
        matrices(lambda m: np.linalg.inv(m @ np.diag([1.0, -1, -1, 1]))),
        "--axes opencv --world-to-camera",
    ),
}


CASES = [f"{given}: {name}" for name in FLIPPED for given in ("hull", "mesh")]


@pytest.mark.parametrize("case", quick(CASES, "hull: COLMAP's matrices"))
def test_a_flipped_convention_is_named(case: str, unrender: Unrender, capture: Path, mesh: Path) -> None:
    given, name = case.split(": ")
    spoil, remedy = FLIPPED[name]
    spoil(capture)
    shape = ("--mesh", mesh, *SMALL[4:]) if given == "mesh" else SMALL
    answer = unrender("import", capture, "--out", "asset", *shape)
    assert answer.refuses(remedy)
    assert not Path("asset").exists()
    words = answer.error.split(": give ")[1].split()
    assert unrender("import", capture, "--out", "asset", *shape, *words).status == 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda v: v[:, [0, 2, 1]] * [1, -1, 1], "up would give"),
        (lambda v: v * 100, "0.01 times as large"),
        (lambda v: v * [1, 1, -1], "z mirrored"),
    ],
)
@pytest.mark.slow
def test_a_mesh_in_another_world_is_named(
    change: Callable[[np.ndarray], np.ndarray], said: str, unrender: Unrender, capture: Path, mesh: Path, tmp_path: Path
) -> None:
    lines = mesh.read_text().splitlines()
    vertices = change(np.array([line.split()[1:] for line in lines if line.startswith("v ")], float))
    rest = [line for line in lines if not line.startswith("v ")]
    moved = tmp_path / "moved.obj"
    moved.write_text("\n".join([*(f"v {a} {b} {c}" for a, b, c in vertices), *rest]))
    answer = unrender("import", capture, "--mesh", moved, "--check", "--out", "look")
    assert answer.status == 2
    assert said in answer.error
    assert Path("look/check.png").is_file()  # to see why


# ---------------------------------------------------------------------- captures that are wrong


def _photograph(capture: Path, index: int = 2) -> Path:
    return capture / "images" / f"view_{index}.png"


def _mask(capture: Path, index: int = 2) -> Path:
    return capture / "masks" / f"view_{index}.png"


def _save(path: Path, values: np.ndarray, **options: Any) -> None:
    Image.fromarray(values).save(path, **options)


def _shrink(capture: Path) -> None:
    Image.open(_photograph(capture)).resize((40, 30)).save(_photograph(capture))


def _invert(capture: Path) -> None:
    for path in (capture / "masks").iterdir():
        _save(path, 255 - np.array(Image.open(path)))


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:200])


def _huge(capture: Path) -> None:
    data = bytearray(_photograph(capture).read_bytes())
    data[16:24] = (20_000).to_bytes(4, "big") * 2
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    _photograph(capture).write_bytes(data)


def _raw(capture: Path) -> None:
    _photograph(capture).rename(capture / "images" / "view_2.nef")
    _frame("file_path", "images/view_2.nef")(capture)


def _frame(name: str, value: Any) -> Callable[[Path], None]:
    return lambda capture: edit(capture, lambda document: document["frames"][2].update({name: value}))


def _top(name: str, value: Any) -> Callable[[Path], None]:
    return lambda capture: edit(capture, lambda document: document.update({name: value}))


BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no photograph": (lambda c: shutil.rmtree(c / "images"), "photographs are missing, the first images/view_"),
    "other proportions": (_shrink, "view_2.png: 40 x 30 pixels, but its camera has 40 x 40"),
    "a cut photograph": (lambda c: _cut(_photograph(c)), "view_2.png: cannot be read as a picture"),
    "an empty photograph": (lambda c: _photograph(c).write_bytes(b""), "view_2.png: cannot be read as a picture"),
    "400 megapixels": (
        _huge,
        "view_2.png: declares 20000x20000 pixels of 3 channels, expected at least one and at most 268435456 values",
    ),
    "a text": (lambda c: _photograph(c).write_text("no picture"), "view_2.png: cannot be read as a picture"),
    "inverted masks": (_invert, "of the picture's edge: inverted? expected white on the object; 9 of 9 masks are so"),
    "an empty mask": (lambda c: _save(_mask(c), np.zeros((40, 40), np.uint8)), "mask of images/view_2.png: empty"),
    "a cut mask": (lambda c: _cut(_mask(c)), "masks/view_2.png: cannot be read as a picture"),
    "a mask of other proportions": (lambda c: _save(_mask(c), np.full((10, 40), 255, np.uint8)), "other proportions"),
    "a missing mask": (lambda c: _mask(c).unlink(), "1 of 9 photographs have no mask, the first images/view_2.png"),
    "no masks": (
        lambda c: shutil.rmtree(c / "masks"),
        "head: neither masks nor a mesh: give --masks DIR or --mesh FILE, or --field N",
    ),
    "no file": (lambda c: (c / "transforms.json").unlink(), "head: no camera poses: expected transforms.json"),
    "no JSON": (lambda c: (c / "transforms.json").write_text("{"), "transforms.json"),
    "no frames": (_top("frames", []), "transforms.json: frames: expected a list of at least one frame"),
    "no name": (_frame("file_path", 7), "transforms.json: frames[2]: expected a table with file_path"),
    "a focal length of 400 digits": (_top("fl_x", 10**400), "fl_x: expected a number, got"),
    "a matrix of 400 digits": (
        _frame("transform_matrix", [[10**400] * 4] * 3),
        "frames[2]: transform_matrix: expected",
    ),
    "no matrix": (
        _frame("transform_matrix", None),
        "frames[2]: transform_matrix: expected a matrix of 3 x 4 or 4 x 4 numbers, missing",
    ),
    "NaN": (
        _frame("transform_matrix", [[float("nan")] * 4] * 4),
        "matrix: expected a matrix of finite numbers, got nan",
    ),
    "a shear": (_frame("transform_matrix", [[1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]), "columns are not a rotation"),
    "a mirror": (_frame("transform_matrix", np.diag([1, 1, -1, 1]).tolist()), "one axis is mirrored"),
    "a focal length of 0": (_top("fl_x", 0), "fx: expected a focal length in pixels, got 0"),
    "a focal length in words": (_top("fl_x", "50 mm"), "fl_x: expected a number, got '50 mm'"),
    "an unknown camera": (_top("camera_model", "EQUIRECTANGULAR"), "camera_model: expected OPENCV"),
    "a mask that is not there": (_frame("mask_path", "masks/no.png"), "masks/no.png: no such file"),
    "a raw file": (_raw, "view_2.nef: camera raw files are not read; develop them to .exr"),
    "a photograph twice": (_frame("file_path", "images/view_1.png"), "view_1.png: listed twice, with different poses"),
    "frames in a table": (_top("frames", {"0": {}}), "transforms.json: frames: expected a list of at least one frame"),
    "a frame of words": (
        _top("frames", ["images/view_0.png"]),
        "transforms.json: frames[0]: expected a table with file_path",
    ),
    "a lens in words": (_top("k1", "barrel"), "k1: expected a number, got 'barrel'"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_capture_is_one_line(name: str, unrender: Unrender, capture: Path) -> None:
    spoil, said = BAD[name]
    spoil(capture)
    answer = unrender("import", capture, "--out", "asset", *SMALL)
    assert answer.refuses("")
    assert said in answer.error
    assert sorted(path.name for path in Path().iterdir()) == ["head"]


# ---------------------------------------------------------------------- captures that are unusual, and right


def _rotate_by_exif(capture: Path) -> None:
    """Stored lying, with the tag that turns it upright; the camera is that of the upright picture."""
    for path in sorted((capture / "images").iterdir()):
        picture = Image.open(path).crop((0, 5, 40, 35))
        exif = Image.Exif()
        exif[0x0112] = 6
        picture.transpose(Image.Transpose.ROTATE_90).save(
            path.with_suffix(".jpg"), exif=exif, quality=100, subsampling=0
        )
        path.unlink()
    for path in (capture / "masks").iterdir():
        Image.open(path).crop((0, 5, 40, 35)).save(path)

    def upright(document: dict[str, Any]) -> None:
        document.update(h=30, cy=15.0)
        for frame in document["frames"]:
            frame["file_path"] = frame["file_path"].replace(".png", ".jpg")

    edit(capture, upright)


def _as_16_bit(capture: Path) -> None:
    import cv2

    path = _photograph(capture, 0)
    cv2.imwrite(str(path), np.array(Image.open(path))[..., ::-1].astype(np.uint16) * 257)


def _as_cmyk(capture: Path) -> None:
    Image.open(_photograph(capture, 0)).convert("CMYK").save(capture / "images/view_0.jpg", quality=100, subsampling=0)
    _photograph(capture, 0).unlink()
    edit(capture, lambda document: document["frames"][0].update(file_path="images/view_0.jpg"))


def _rename(capture: Path) -> None:
    for part in ("images", "masks"):
        (capture / part / "view_0.png").rename(capture / part / "Schöne Büste 1.png")
    edit(capture, lambda document: document["frames"][0].update(file_path="images/Schöne Büste 1.png"))


def _larger(capture: Path) -> None:
    path = _photograph(capture, 0)
    Image.open(path).resize((80, 80), Image.Resampling.BOX).save(path)


def _as_alpha(capture: Path) -> None:
    for path in sorted((capture / "images").iterdir()):
        picture = Image.open(path)
        picture.putalpha(Image.open(capture / "masks" / path.name))
        picture.save(path)
    shutil.rmtree(capture / "masks")


def _missing(capture: Path) -> None:
    _photograph(capture, 3).unlink()


def _twice(capture: Path) -> None:
    edit(capture, lambda document: document["frames"].append(document["frames"][2]))


def _without_pose(capture: Path) -> None:
    shutil.copy(_photograph(capture), capture / "images" / "another.png")


UNUSUAL: dict[str, tuple[Callable[[Path], Any], str]] = {
    "EXIF rotation": (_rotate_by_exif, "9 photographs rotated by their EXIF orientation"),
    "16 bits": (_as_16_bit, ""),
    "CMYK": (_as_cmyk, ""),
    "spaces and umlauts": (_rename, ""),
    "mixed sizes": (_larger, ""),
    "alpha": (_as_alpha, ""),
    "a missing photograph": (_missing, "1 of 9 photographs are missing and were skipped, the first images/view_3.png"),
    "a photograph twice": (_twice, "1 of 10 photographs are listed again and were skipped"),
    "a picture without a pose": (_without_pose, "1 pictures have no pose and were skipped, the first another.png"),
    "a world of a million": (matrices(lambda m: np.c_[m[:, :3], m[:, 3] * [1e6, 1e6, 1e6, 1]]), ""),
    "a scale in the matrices": (matrices(lambda m: m @ np.diag([3.0, 3.0, 3.0, 1.0])), ""),
}


@pytest.mark.parametrize("name", quick(UNUSUAL, "EXIF rotation"))
def test_an_unusual_capture_is_read_right(
    name: str, unrender: Unrender, capture: Path, made_folder: Path, mesh: Path
) -> None:
    spoil, said = UNUSUAL[name]
    spoil(capture)
    shape = SMALL if name == "a world of a million" else ("--mesh", mesh, "--texture", 4)
    answer = unrender("import", capture, "--out", "asset", "--hold-out", 0, *shape)
    assert answer.status == 0, answer.error
    assert said in answer.out
    assert float(answer.out.split("with IoU ")[1].split(",")[0]) > 0.93
    first = sorted(Path("asset/references").iterdir())[0]
    found = images.read(first).values
    expected = images.read(made_folder / "images" / "view_0.png").values
    if found.shape[0] == 30:
        expected = expected[5:35]
    if found.shape[0] == 80:  # not scaled down: --resolution is a limit
        found = found.reshape(40, 2, 40, 2, 3).mean((1, 3))
    assert np.abs(found - expected).max() < 0.05
    assert np.abs(found - expected).mean() < 0.004
