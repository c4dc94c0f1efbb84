"""A file means what Mitsuba makes of it: given as initial value or truth, the scene's own file equals the scene's own value."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

import unrender as ur
from tiers import quick
from unrender import methods
from unrender.core import periodic
from unrender.core.errors import InputError
from unrender.io import parameter_values, volumes
from unrender.io.parameter_values import FileConversion
from unrender.rendering.mitsuba.renderer import MitsubaRenderer

HEIGHT, WIDTH = 4, 6
PICTURE = np.random.default_rng(1).uniform(0.05, 0.95, (HEIGHT, WIDTH, 3)).astype(np.float32)
VIEW = ur.View(np.zeros((4, 4, 3), np.float32))

BITMAPS = {
    "byte": ("byte.png", {"format": "variant"}),
    "byte_raw": ("byte.png", {"format": "variant", "raw": True}),
    "word": ("word.png", {"format": "auto"}),
    "word_raw": ("word.png", {"format": "variant", "raw": True}),
    "grey": ("grey.png", {"format": "variant"}),
    "grey_raw": ("grey.exr", {"format": "variant", "raw": True}),
    "alpha": ("alpha.png", {"format": "variant"}),
    "jpeg": ("photo.jpg", {"format": "variant"}),
    "single": ("single.exr", {}),
    "half": ("half.exr", {}),
    "rounded": ("single.exr", {"format": "fp16", "raw": True}),
}
"""{name of a texture: its file, and its settings}."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files of every kind that a scene reads."""
    place = tmp_path_factory.mktemp("files")
    byte = (PICTURE * 255).astype(np.uint8)
    grey = byte[..., :1]
    alpha = np.concatenate([byte, grey], axis=2)
    written: dict[str, np.ndarray] = {
        "byte.png": byte,
        "word.png": (PICTURE * 65535).astype(np.uint16),
        "grey.png": grey,
        "grey.exr": PICTURE[..., :1].copy(),
        "alpha.png": alpha,
        "single.exr": 3 * PICTURE,
        "half.exr": (3 * PICTURE).astype(np.float16),
    }
    for name, values in written.items():
        mi.Bitmap(values).write(str(place / name))
    Image.fromarray(byte).save(place / "photo.jpg")
    for channels in (1, 3, 6):
        grid = np.random.default_rng(channels).uniform(0.1, 0.9, (2, 3, 4, channels))
        volumes.write_grid(place / f"grid{channels}.vol", grid)
    (place / "block.obj").write_text(_OBJ)
    mesh: Any = mi.load_dict({"type": "obj", "filename": str(place / "block.obj")})
    count = mesh.vertex_count()
    mesh.add_attribute("vertex_paint", 3, np.random.default_rng(2).uniform(0, 1, 3 * count).astype(np.float32))
    mesh.add_attribute(
        "face_paint", 3, np.random.default_rng(3).uniform(0, 1, 3 * mesh.face_count()).astype(np.float32)
    )
    mesh.write_ply(str(place / "block.ply"))
    return place


_OBJ = """v 0 0 0
v 1 0 0
v 1 1 0.2
v 0 1 0.1
v 0.5 0.5 1
vt 0 0
vt 1 0
vt 1 1
vt 0.2 0.8
vn 0 0 1
vn 0 1 0
f 1/1/1 2/2/1 3/3/1
f 1/2/2 3/1/2 4/4/2
f 1/1/1 2/2/2 5/3/1
"""


@pytest.fixture(scope="module")
def renderer(folder: Path) -> MitsubaRenderer:
    """One scene with everything in it that a file can fill."""
    turned = mi.ScalarTransform4f().translate([0.1, 0.2, -3]).rotate([0, 1, 0], 30).scale([0.5, -0.7, 1.1])
    diffuse = {"type": "diffuse"}
    scene: dict[str, Any] = {
        "type": "scene",
        "camera": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
        "sky": {"type": "envmap", "filename": str(folder / "single.exr")},
        "solid": {"type": "obj", "filename": str(folder / "block.obj"), "to_world": turned, "bsdf": diffuse},
        "flat": {
            "type": "obj",
            "filename": str(folder / "block.obj"),
            "face_normals": True,
            "flip_tex_coords": False,
            "bsdf": diffuse,
        },
        "sheet": {
            "type": "ply",
            "filename": str(folder / "block.ply"),
            "to_world": turned,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_paint"}},
        },
        "group": {
            "type": "shapegroup",
            "leaf": {"type": "ply", "filename": str(folder / "block.ply"), "to_world": turned, "bsdf": diffuse},
        },
        "tree": {"type": "instance", "group": {"type": "ref", "id": "group"}},
        "fog": {
            "type": "cube",
            "bsdf": {"type": "null"},
            "interior": {
                "type": "heterogeneous",
                "sigma_t": {"type": "gridvolume", "filename": str(folder / "grid1.vol")},
                "albedo": {"type": "gridvolume", "filename": str(folder / "grid3.vol")},
                "phase": {"type": "sggx", "S": {"type": "gridvolume", "filename": str(folder / "grid6.vol")}},
            },
        },
    }
    for name, (file, settings) in BITMAPS.items():
        texture = {"type": "bitmap", "filename": str(folder / file), **settings}
        scene[name] = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}}
    return MitsubaRenderer(scene)


KEYS = {
    **{f"{name}.bsdf.reflectance.data": file for name, (file, _) in BITMAPS.items()},
    "sky.data": "single.exr",
    "fog.interior_medium.sigma_t.data": "grid1.vol",
    "fog.interior_medium.albedo.data": "grid3.vol",
    "fog.interior_medium.phase_function.S.data": "grid6.vol",
    "solid.vertex_positions": "block.obj",
    "solid.vertex_normals": "block.obj",
    "solid.vertex_texcoords": "block.obj",
    "flat.vertex_positions": "block.obj",
    "flat.vertex_texcoords": "block.obj",
    "sheet.vertex_positions": "block.ply",
    "sheet.vertex_normals": "block.ply",
    "sheet.vertex_paint": "block.ply",
    "sheet.face_paint": "block.ply",
    "group.leaf.vertex_paint": "block.ply",
}


def of_file(renderer: MitsubaRenderer, key: str, path: Path) -> np.ndarray:
    """The values that a file gives to a parameter of the scene."""
    info = renderer.parameters()[key]
    return parameter_values.fill(path, info.shape, info.conversion)[0]


@pytest.mark.parametrize("key", KEYS)
def test_the_scenes_own_file_is_the_scenes_own_value(renderer: MitsubaRenderer, folder: Path, key: str):
    own = np.array(renderer.values([key])[key])
    assert own.size
    np.testing.assert_array_equal(of_file(renderer, key, folder / KEYS[key]), own)


@pytest.mark.parametrize("key", [key for key in KEYS if not key.endswith(("normals", "texcoords"))])
def test_truth_and_start_by_the_scenes_own_file_have_no_error(renderer: MitsubaRenderer, folder: Path, key: str):
    path = folder / KEYS[key]
    inside = (-10.0, 10.0)
    problem = ur.Problem(renderer, [ur.Parameter(key, initial=path, bounds=inside)], [VIEW], truth={key: path})
    assert problem.parameter_error(renderer.values([key])) == {key: 0.0}
    assert problem.parameter_error(problem.initial_values()) == {key: 0.0}


def test_what_is_half_a_pixel_off_upside_down_or_decoded_twice_has_an_error(renderer: MitsubaRenderer, folder: Path):
    """The faults that the tests above are there to catch."""
    sky = np.array(renderer.values(["sky.data"])["sky.data"])
    resampled = parameter_values.fill(folder / "single.exr", sky.shape)[0]
    assert np.abs(resampled - sky).max() > 0.1
    assert np.abs(of_file(renderer, "sky.data", folder / "single.exr")[::-1] - sky).max() > 0.1
    raw = np.array(renderer.values(["byte_raw.bsdf.reflectance.data"])["byte_raw.bsdf.reflectance.data"])
    assert np.abs(parameter_values.fill(folder / "byte.png", raw.shape)[0] - raw).max() > 0.1


def test_an_array_is_rounded_to_half_precision_as_its_file_is(renderer: MitsubaRenderer, tmp_path: Path):
    """It was not, so that a run folder, which stores the array as a file, did not resume."""
    key = "rounded.bsdf.reflectance.data"
    info = renderer.parameters()[key]
    np.save(tmp_path / "picture.npy", PICTURE)
    array = parameter_values.fill(PICTURE, info.shape, info.conversion)[0]
    assert not np.array_equal(array, PICTURE)
    np.testing.assert_array_equal(array, of_file(renderer, key, tmp_path / "picture.npy"))


def test_rounding_to_half_precision_leaves_no_bounds(renderer: MitsubaRenderer):
    """0.1 is rounded to 0.09998: an initial value of 0.1 was moved into bounds from 0.1 with a notice, and a true one was out of reach."""
    key = "rounded.bsdf.reflectance.data"
    unknown = ur.Parameter(key, 0.1, bounds=(0.1, 0.7))
    for truth in (0.1, 0.7):
        made = ur.Problem(renderer, [unknown], [VIEW], truth={key: truth})
        assert made.notices == []
        assert (made.unknowns[key].initial == np.float32(0.1)).all()
    made = ur.Problem(renderer, [replace(unknown, initial=0.0999)], [VIEW], truth={key: 0.701})
    assert len(made.notices) == 2
    assert "such as 0.0999" in made.notices[0]
    assert "no run can reach: such as 0.701" in made.notices[1]


# ------------------------------------------------------------------ environment maps


def test_an_environment_map_takes_a_picture_of_another_size_before_it_is_padded(
    renderer: MitsubaRenderer, tmp_path: Path
):
    """A wave that goes around once has no seam after it was scaled."""
    angle = 2 * np.pi * (np.arange(24) + 0.5) / 24
    wave = np.broadcast_to((1 + np.cos(angle))[None, :, None], (16, 24, 3)).astype(np.float32)
    mi.Bitmap(np.ascontiguousarray(wave)).write(str(tmp_path / "wave.exr"))
    info = renderer.parameters()["sky.data"]
    found, notice = parameter_values.fill(tmp_path / "wave.exr", info.shape, info.conversion)
    assert notice == "wave.exr: scaled from 24x16 to 6x4"
    np.testing.assert_array_equal(found, periodic.repeat(found, 1))
    expected = 1 + np.cos(2 * np.pi * (np.arange(WIDTH) + 0.5) / WIDTH)
    np.testing.assert_allclose(found[1, 1:-1, 0], expected, atol=0.1)
    np.testing.assert_allclose(found[1, 1], found[1, -2], atol=1e-3)


def test_an_environment_map_takes_arrays_with_and_without_its_repeated_columns():
    picture = np.arange(HEIGHT * WIDTH * 3, dtype=np.float32).reshape(HEIGHT, WIDTH, 3)
    shape, around = (HEIGHT, WIDTH + 2, 3), FileConversion(repeated=1)
    padded, _ = parameter_values.fill(picture, shape, around)
    np.testing.assert_array_equal(padded, np.concatenate([picture[:, -1:], picture, picture[:, :1]], axis=1))
    stale = padded.copy()
    stale[:, [0, -1]] = -7
    np.testing.assert_array_equal(parameter_values.fill(stale, shape, around)[0], padded)
    with pytest.raises(
        InputError, match=r"expected .* an array of shape \(4, 6, 3\), got an array of shape \(4, 7, 3\)"
    ):
        parameter_values.fill(np.zeros((HEIGHT, WIDTH + 1, 3)), shape, around)


def test_an_array_file_fills_an_environment_map(renderer: MitsubaRenderer, tmp_path: Path):
    np.save(tmp_path / "sky.npy", 3 * PICTURE)
    np.testing.assert_array_equal(
        of_file(renderer, "sky.data", tmp_path / "sky.npy"), np.array(renderer.values(["sky.data"])["sky.data"])
    )


def test_an_exported_environment_map_is_read_back_exactly(renderer: MitsubaRenderer, folder: Path, tmp_path: Path):
    scene = tmp_path / "scene.xml"
    scene.write_text(
        f"""<scene version="3.0.0">
          <sensor type="perspective">
            <film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/></film>
          </sensor>
          <emitter type="envmap" id="sky"><string name="filename" value="{folder / "single.exr"}"/></emitter>
        </scene>"""
    )
    problem = ur.Problem(scene, [ur.Parameter("sky.data", initial=0.5)], [VIEW], max_depth=2)
    sky = periodic.pad(2 * PICTURE, 1)
    ur.app.export((problem, {"sky.data": sky}), tmp_path / "out", formats=["mitsuba"])
    for written in ("maps/sky.exr", "textures/sky.exr"):
        found = of_file(renderer, "sky.data", tmp_path / "out" / written)
        np.testing.assert_array_equal(found, sky)


# ------------------------------------------------------------------ meshes


def test_a_mesh_file_of_another_mesh_is_refused(renderer: MitsubaRenderer, folder: Path, tmp_path: Path):
    (tmp_path / "one.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"one\.obj: has 9 numbers at its vertices, and the scene's mesh has \d+"):
        of_file(renderer, "solid.vertex_positions", tmp_path / "one.obj")
    with pytest.raises(InputError, match=r"block\.obj: the mesh has no vertex_paint"):
        of_file(renderer, "sheet.vertex_paint", folder / "block.obj")
    with pytest.raises(InputError, match=r"block\.obj: a mesh file cannot fill this parameter"):
        of_file(renderer, "sky.data", folder / "block.obj")
    with pytest.raises(InputError, match=r"none\.ply: no such file"):
        of_file(renderer, "sheet.vertex_positions", tmp_path / "none.ply")


def test_a_malformed_mesh_file_is_one_line(renderer: MitsubaRenderer, tmp_path: Path):
    (tmp_path / "bad.ply").write_text("ply\nformat ascii 1.0\nelement vertex 3\nend_header\n")
    with pytest.raises(InputError, match=r"bad\.ply: ") as caught:
        of_file(renderer, "sheet.vertex_positions", tmp_path / "bad.ply")
    assert "\n" not in str(caught.value)


# ------------------------------------------------------------------ descents


@pytest.mark.parametrize("method", quick(["auto", "plain", "smoothed"], "plain"))
def test_repeated_columns_follow_in_a_descent(folder: Path, method: str):
    scene = {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}},
        },
        "sky": {"type": "envmap", "filename": str(folder / "single.exr")},
        "ball": {"type": "sphere", "bsdf": {"type": "diffuse"}},
    }
    problem = ur.Problem(scene, [ur.Parameter("sky.data", initial=1.0)], [VIEW], max_depth=2)
    estimator, optimizer = ("auto", None) if method == "auto" else methods.method(method).start({})
    result = ur.optimize(problem, estimator, optimizer, steps=3)
    found = result.parameters["sky.data"]
    assert np.ptp(found) > 0
    np.testing.assert_array_equal(found, periodic.repeat(found, 1))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(4, 4, 3), (4, 4), (3,)])
def test_integers_of_a_stored_picture_are_no_linear_values(dtype: type, shape: tuple[int, ...], tmp_path: Path) -> None:
    """A reflectance of 128 became 1 in silence, also from a file. Zeros and ones, as of a mask, mean what they are."""
    stored = np.full(shape, 128, dtype)
    whole = (4, 4, 3) if len(shape) != 2 else (4, 4, 1)
    with pytest.raises(InputError, match="integers of 8 or 16 bits up to 128"):
        parameter_values.fill(stored, whole)
    with pytest.raises(InputError, match="integers of 8 or 16 bits up to 128"):
        parameter_values.fill(mi.Bitmap(np.full((4, 4, 3), 128, dtype)), (4, 4, 3))
    for name, save in (("a.npy", np.save), ("a.npz", np.savez)):
        save(tmp_path / name, stored)
        with pytest.raises(InputError, match=rf"{name}: expected linear values.* up to 128"):
            parameter_values.fill(tmp_path / name, whole)
        save(tmp_path / name, stored > 1)
        assert parameter_values.fill(tmp_path / name, whole)[0].max() == 1
    assert parameter_values.fill(stored / np.float32(256), whole)[0].max() == 0.5
    assert parameter_values.fill(stored // 128, whole)[0].max() == 1
