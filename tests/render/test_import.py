"""Conventions of captures: what a known camera saw of a known mesh, written in each format, is imported to where it was."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

pytest.importorskip("cv2", reason="photographs need OpenCV: pip install 'unrender[capture]'")

import made_capture as made
from skimage.registration import phase_cross_correlation

from unrender.capture import formats, importing
from unrender.capture.cameras import FISHEYE, Lens, project
from unrender.capture.conventions import reinterpreted
from unrender.capture.importing import Options
from unrender.io import images

CENTRED = Lens(48, 40, 60.0, 60.0, 24.0, 20.0)
PINHOLE = Lens(48, 40, 60.0, 60.0, 21.3, 22.1)
OBLONG = Lens(96, 80, 120.0, 126.0, 45.0, 43.0)
RADIAL = Lens(96, 80, 120.0, 118.0, 45.0, 43.0, distortion=(-0.25, 0.12, 0.004, -0.006))
WIDE = Lens(96, 80, 90.0, 91.0, 46.0, 42.0, FISHEYE, (-0.08, 0.02, -0.01, 0.003))
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
def test_points_fall_where_the_camera_saw_them(name: str, mesh: Path, tmp_path: Path) -> None:
    lens, write = CASES[name]
    shots = made.shots(mesh, lens)
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


@pytest.mark.parametrize("name", CASES)
def test_the_imported_scene_renders_what_the_photographs_show(name: str, mesh: Path, tmp_path: Path) -> None:
    """Normals in place of colours: no noise of light. A shift of a tenth of a pixel would be seen."""
    lens, write = CASES[name]
    shots = made.shots(mesh, lens, 3)
    write(tmp_path / "capture", shots, lens)
    options = Options(mesh=mesh, resolution=48, hold_out=0, texture=4)
    found = importing.import_capture(tmp_path / "capture", tmp_path / "problem", options)
    assert min(found.overlaps) > 0.97
    shown = _references(tmp_path / "problem")
    for picture, (reference, mask) in zip(_normals(tmp_path / "problem"), shown, strict=True):
        inside = np.any(picture > 0.01, -1, keepdims=True) & np.any(reference > 0.01, -1, keepdims=True)
        shift, *_ = phase_cross_correlation(reference * inside, picture * inside, upsample_factor=100)
        assert np.abs(shift).max() <= 0.05
        # Eight bits, and the resampling of a curved picture.
        assert np.abs(picture - reference)[mask].mean() < 0.006


def test_a_shift_of_a_fraction_of_a_pixel_would_be_seen(mesh: Path, tmp_path: Path) -> None:
    """The fault that the test above is to catch: pixel centres taken at whole numbers."""
    wrong = Lens(PINHOLE.width, PINHOLE.height, PINHOLE.fx, PINHOLE.fy, PINHOLE.cx - 0.5, PINHOLE.cy - 0.5)
    made.write_transforms(tmp_path / "capture", made.shots(mesh, PINHOLE, 3), wrong)
    importing.import_capture(tmp_path / "capture", tmp_path / "problem", Options(mesh=mesh, hold_out=0, texture=4))
    shown = _references(tmp_path / "problem")
    for picture, (reference, mask) in zip(_normals(tmp_path / "problem"), shown, strict=True):
        assert np.abs(picture - reference)[mask].mean() > 0.006


def _normals(folder: Path) -> list[np.ndarray]:
    scene: Any = mi.load_file(str(folder / "scene.xml"))
    integrator = mi.load_dict({"type": "aov", "aovs": "n:sh_normal"})
    found = []
    for index in range(len(scene.sensors())):
        picture = np.array(mi.render(scene, sensor=index, integrator=integrator, spp=256))[..., :3]
        covered = np.array(
            mi.render(scene, sensor=index, integrator=mi.load_dict({"type": "aov", "aovs": "d:depth"}), spp=256)
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


def test_a_reading_by_another_convention_is_undone_by_naming_it(mesh: Path, tmp_path: Path) -> None:
    made.write_transforms(tmp_path, made.shots(mesh, PINHOLE, 2), PINHOLE)
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
