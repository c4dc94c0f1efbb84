"""Conventions of captures: what a known camera saw of a known mesh, written in each format, is imported to where it was."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

pytest.importorskip("cv2", reason="photographs need OpenCV: pip install 'unrender[capture]'")

from PIL import Image

import made_capture as made
from tiers import quick
from unrender.app.capture import formats, importing
from unrender.app.capture.cameras import FISHEYE, Lens, project
from unrender.app.capture.capture import reinterpreted
from unrender.app.capture.importing import ImportOptions
from unrender.app.capture.views import prepare
from unrender.core.errors import InputError
from unrender.io import images

CENTRED = Lens(48, 40, 60.0, 60.0, 24.0, 20.0)
PINHOLE = Lens(48, 40, 60.0, 60.0, 21.3, 22.1)
OBLONG = Lens(96, 80, 120.0, 126.0, 45.0, 43.0)
RADIAL = Lens(96, 80, 120.0, 118.0, 45.0, 43.0, distortion=(-0.25, 0.12, 0.004, -0.006))
WIDE = Lens(48, 40, 45.0, 45.5, 23.0, 21.0, FISHEYE, (-0.08, 0.02, -0.01, 0.003))
CASES: dict[str, tuple[Lens, made.Writer]] = {
    "NeRF": (CENTRED, lambda f, s, lens: made.write_transforms(f, s, lens, angle_only=True)),
    "instant-ngp": (PINHOLE, made.write_transforms),
    "instant-ngp, OpenCV": (RADIAL, made.write_transforms),
    "nerfstudio, fisheye": (WIDE, made.write_transforms),
    "COLMAP, text": (PINHOLE, lambda f, s, lens: made.write_colmap(f, s, lens, False)),
    "COLMAP, binary": (OBLONG, lambda f, s, lens: made.write_colmap(f, s, lens, True)),
    "COLMAP, OpenCV": (RADIAL, lambda f, s, lens: made.write_colmap(f, s, lens, True)),
    "COLMAP, fisheye": (WIDE, lambda f, s, lens: made.write_colmap(f, s, lens, False)),
    "LLFF": (CENTRED, made.write_llff),
}


@pytest.fixture(scope="module")
def mesh(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The known mesh."""
    return made.mesh(tmp_path_factory.mktemp("mesh") / "mesh.obj")


@pytest.mark.parametrize("name", CASES)
def test_points_fall_where_the_camera_saw_them(name: str, tmp_path: Path) -> None:
    lens, write = CASES[name]
    shots = made.shots(None, lens)
    write(tmp_path, shots, lens)
    points = np.random.default_rng(0).uniform(-0.4, 0.8, (50, 3))
    capture = formats.read(tmp_path)
    assert len(capture.photographs) == len(shots)
    for photograph, shot in zip(capture.photographs, shots, strict=True):
        local = np.c_[points, np.ones(50)] @ np.linalg.inv(shot.to_world).T
        found_lens = photograph.lens or Lens.of_field_of_view(photograph.field_of_view, lens.width, lens.height)
        at, depth = project(found_lens.scaled(lens.width, lens.height), photograph.camera_to_world, points)
        np.testing.assert_allclose(depth, local[:, 2], atol=1e-6)
        np.testing.assert_allclose(at, _seen(lens, local), atol=1e-3)


def _seen(lens: Lens, local: np.ndarray) -> np.ndarray:
    """In pixels, of points in Mitsuba's axes of a camera."""
    return made.distorted(lens, -local[:, :2] / local[:, 2:3]) * [lens.fx, lens.fy] + [lens.cx, lens.cy]


@pytest.mark.parametrize("name", quick(CASES, "instant-ngp, OpenCV"))
def test_the_imported_scene_renders_what_the_photographs_show(name: str, mesh: Path, tmp_path: Path) -> None:
    """Normals in place of colours: no noise of light. To a tenth of a pixel."""
    from skimage.registration import phase_cross_correlation

    lens, write = CASES[name]
    shots = made.shots(mesh, lens, 3)
    write(tmp_path / "capture", shots, lens)
    options = ImportOptions(mesh=mesh, resolution=48, hold_out=0, texture=4)
    found = importing.import_capture(tmp_path / "capture", tmp_path / "problem", options)
    assert min(found.overlaps) > 0.97
    shown = _references(tmp_path / "problem")
    for picture, (reference, mask) in zip(_normals(tmp_path / "problem"), shown, strict=True):
        inside = np.any(picture > 0.01, -1, keepdims=True) & np.any(reference > 0.01, -1, keepdims=True)
        shift, *_ = phase_cross_correlation(reference * inside, picture * inside, upsample_factor=100)
        assert np.abs(shift).max() <= 0.1
        # Eight bits, and the resampling of a curved picture.
        assert np.abs(picture - reference)[mask].mean() < 0.006


def test_a_shift_of_a_fraction_of_a_pixel_would_be_seen(mesh: Path, tmp_path: Path) -> None:
    """The fault that the test above is to catch: pixel centres taken at whole numbers."""
    wrong = Lens(PINHOLE.width, PINHOLE.height, PINHOLE.fx, PINHOLE.fy, PINHOLE.cx - 0.5, PINHOLE.cy - 0.5)
    made.write_transforms(tmp_path / "capture", made.shots(mesh, PINHOLE, 3), wrong)
    importing.import_capture(
        tmp_path / "capture", tmp_path / "problem", ImportOptions(mesh=mesh, hold_out=0, texture=4)
    )
    shown = _references(tmp_path / "problem")
    for picture, (reference, mask) in zip(_normals(tmp_path / "problem"), shown, strict=True):
        assert np.abs(picture - reference)[mask].mean() > 0.006


def test_colmap_images_without_their_lines_of_points_are_refused(tmp_path: Path) -> None:
    """Every second image was taken for such a line: half of the photographs were skipped."""
    made.write_colmap(tmp_path, made.shots(None, RADIAL), RADIAL, binary=False)
    file = tmp_path / "sparse/0/images.txt"
    file.write_text("\n".join(line for line in file.read_text().splitlines() if line and not line.startswith("1.5")))
    with pytest.raises(InputError, match=r"images\.txt:3: expected the points of the image before"):
        formats.read(tmp_path)


@pytest.mark.slow
def test_a_colmap_model_by_colmap_itself(tmp_path: Path) -> None:
    """What pycolmap writes, new entries and all."""
    pycolmap = pytest.importorskip("pycolmap")
    shots = made.shots(None, RADIAL)
    made.write_colmap(tmp_path / "text", shots, RADIAL, binary=False)
    made.write_colmap(tmp_path / "binary", shots, RADIAL, binary=True)
    (tmp_path / "text/sparse/0/points3D.txt").write_text("")
    images_file = tmp_path / "text/sparse/0/images.txt"
    images_file.write_text(images_file.read_text().replace("4.5 9", "4.5 -1"))
    model = pycolmap.Reconstruction(str(tmp_path / "text" / "sparse" / "0"))
    for path in (tmp_path / "binary" / "sparse" / "0").iterdir():
        path.unlink()
    model.write_binary(str(tmp_path / "binary" / "sparse" / "0"))
    ours, theirs = (formats.read(tmp_path / name).photographs for name in ("text", "binary"))
    assert [photograph.lens for photograph in ours] == [photograph.lens for photograph in theirs]
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one.camera_to_world, other.camera_to_world, atol=1e-12)


def _split_files(folder: Path, shots: list[made.Shot], ending: str) -> None:
    """transforms_train.json of all shots but the last, transforms_test.json of the last."""
    for name, part in (("train", shots[:-1]), ("test", shots[-1:])):
        made.save(part, folder / name, masks=None)
        frames = [
            {"file_path": f"{name}/{s.name}{ending}", "transform_matrix": (s.to_world @ made.GL).tolist()} for s in part
        ]
        document = {"camera_angle_x": 2 * np.arctan(CENTRED.width / (2 * CENTRED.fx)), "frames": frames}
        (folder / f"transforms_{name}.json").write_text(json.dumps(document))


def test_the_layout_of_stanford_orb(mesh: Path, tmp_path: Path) -> None:
    """train/NAME.png, train_mask/NAME.png, test likewise; each set has its file, frames have no ending."""
    shots = made.shots(mesh, CENTRED)
    _split_files(tmp_path / "orb", shots, "")
    for name, part in (("train", shots[:-1]), ("test", shots[-1:])):
        made.save(part, tmp_path / "orb" / name, masks=f"{name}_mask")
    _check_split(tmp_path, "orb", mesh)


@pytest.mark.slow
def test_the_layout_of_synthetic4relight(mesh: Path, tmp_path: Path) -> None:
    """train/NAME_rgb.exr and train/NAME_mask.png, test/NAME_rgba.png; frames are called train/NAME."""
    shots = made.shots(mesh, CENTRED)
    folder = tmp_path / "s4r"
    _split_files(folder, shots, "")
    for shot in shots[:-1]:
        (folder / "train" / f"{shot.name}.png").unlink()
        mi.Bitmap(shot.picture).write(str(folder / "train" / f"{shot.name}_rgb.exr"))
        Image.fromarray((shot.mask[..., 0] * 255).astype(np.uint8)).save(folder / "train" / f"{shot.name}_mask.png")
    last = folder / "test" / f"{shots[-1].name}.png"
    picture = Image.open(last)
    picture.putalpha(Image.fromarray((shots[-1].mask[..., 0] * 255).astype(np.uint8)))
    picture.save(last.with_name(f"{shots[-1].name}_rgba.png"))
    last.unlink()
    _check_split(tmp_path, "s4r", mesh)


def _check_split(place: Path, name: str, mesh: Path) -> None:
    found = importing.import_capture(
        place / name, place / "problem", ImportOptions(mesh=mesh, resolution=48, texture=4)
    )
    assert (found.views, found.held_out) == (3, 1)
    assert min(found.overlaps) > 0.97
    for picture, (reference, mask) in zip(_normals(place / "problem"), _references(place / "problem"), strict=True):
        assert np.abs(picture - reference)[mask].mean() < 0.006


@pytest.mark.slow
def test_the_hull_of_real_masks_covers_them(assets: Path, tmp_path: Path) -> None:
    """`ethiopian-head`: 57 masks carve it, 9 others judge it."""
    folder = assets / "photographs" / "ethiopian-head"
    if not folder.is_dir():
        pytest.skip(f"no photographs: {folder} is not a folder")
    found, refusal = importing.check(folder, tmp_path / "check", ImportOptions(resolution=125, voxels=64))
    assert refusal == ""
    assert (found.views, found.held_out) == (57, 9)
    assert np.mean(found.overlaps[::8]) > 0.95  # those held out


@pytest.mark.slow
def test_a_real_lens_is_undistorted(assets: Path) -> None:
    """`fox`: OpenCV's coefficients, principal point off the middle, 17 of 67 photographs missing."""
    folder = assets / "photographs" / "fox"
    if not folder.is_dir():
        pytest.skip(f"no photographs: {folder} is not a folder")
    capture = formats.read(folder)
    assert len(capture.photographs) == 50
    assert "17 of 67 photographs are missing" in capture.notices[0]
    views, _ = prepare(replace(capture, photographs=capture.photographs[:3]), 128, None, 0)
    assert all(view.values.shape == (128, 72, 3) and view.shown.mean() > 0.95 for view in views)


def _normals(folder: Path) -> list[np.ndarray]:
    scene: Any = mi.load_file(str(folder / "scene.xml"))
    integrator = mi.load_dict({"type": "aov", "aovs": "n:sh_normal"})
    found = []
    for index in range(len(scene.sensors())):
        picture = np.array(mi.render(scene, sensor=index, integrator=integrator, spp=144))[..., :3]
        covered = np.array(
            mi.render(scene, sensor=index, integrator=mi.load_dict({"type": "aov", "aovs": "d:depth"}), spp=144)
        )
        found.append(np.where(covered > 0, 0.8 * (picture / 2 + 0.5), 0))
    return found


def _references(folder: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    names = sorted(path.stem for path in (folder / "references").iterdir())
    return [
        (
            images.read(folder / f"references/{n}.exr").values,
            images.read(folder / f"masks/{n}.png", False).values[..., 0] > 0.5,
        )
        for n in names
    ]


def test_a_reading_by_another_convention_is_undone_by_naming_it(tmp_path: Path) -> None:
    made.write_transforms(tmp_path, made.shots(None, PINHOLE, 2), PINHOLE)
    capture = formats.read(tmp_path)
    for axes in ("opencv", "llff", "opengl"):
        for inverse in (True, False):
            there = reinterpreted(capture, axes, inverse)
            back = reinterpreted(there, capture.axes, capture.world_to_camera)
            for one, other in zip(back.photographs, capture.photographs, strict=True):
                np.testing.assert_allclose(one.camera_to_world, other.camera_to_world, atol=1e-12)
            moved = there.photographs[0].camera_to_world
            assert (axes, inverse) == ("opengl", False) or not np.allclose(
                moved, capture.photographs[0].camera_to_world
            )
