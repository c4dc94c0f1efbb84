"""Parts of imports by closed forms: hulls, atlases, undistortion, meshes."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2", reason="photographs need OpenCV: pip install 'unrender[capture]'")

from unrender.capture import atlas, hull
from unrender.capture.cameras import Lens, project, rigid
from unrender.capture.formats import colmap
from unrender.capture.mesh import Mesh, decimate, normals, smooth, without_crumbs
from unrender.capture.undistortion import Resampling, pinhole
from unrender.capture.views import CapturedView
from unrender.core.errors import InputError

LENS = Lens(64, 64, 80.0, 80.0, 32.0, 32.0)
CENTRE, RADIUS = np.array([10.0, -3.0, 2.0]), 0.7


def _camera(direction: np.ndarray, distance: float) -> np.ndarray:
    backwards = direction / np.linalg.norm(direction)
    right = np.cross([0.3, 1.0, 0.1], backwards)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(backwards, right), backwards], 1)
    matrix[:3, 3] = CENTRE + distance * backwards
    return matrix


def _views(count: int) -> list[CapturedView]:
    """A ball's masks, from all around: a pixel is covered where its ray passes the centre within the radius."""
    found = []
    for index in range(count):
        height, turn = 1 - 2 * (index + 0.5) / count, 2.4 * index
        across = np.sqrt(1 - height**2)
        matrix = _camera(np.array([across * np.cos(turn), height, across * np.sin(turn)]), 3.0)
        x, y = np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5)
        rays = np.stack([(x - 32) / 80, -(y - 32) / 80, -np.ones_like(x)], -1) @ matrix[:3, :3].T
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        to = CENTRE - matrix[:3, 3]
        passed = np.linalg.norm(np.cross(rays, to), axis=-1)
        mask = np.clip((RADIUS - passed) * 80 / 3 + 0.5, 0, 1)
        found.append(CapturedView(str(index), LENS, matrix, np.zeros((64, 64, 3)), mask, np.ones((64, 64)), False))
    return found


def test_the_hull_of_a_balls_masks_is_the_ball() -> None:
    mesh = hull.shape(_views(24), 40, 3000)
    distances = np.linalg.norm(mesh.vertices - CENTRE, axis=1)
    assert abs(distances.mean() - RADIUS) < 0.02 * RADIUS  # a hull of 24 masks is a little larger
    assert distances.min() > 0.97 * RADIUS
    assert distances.max() < 1.12 * RADIUS
    outward = (normals(mesh) * (mesh.vertices - CENTRE)).sum(1) / distances
    assert outward.min() > 0.7


def test_masks_of_different_things_leave_no_hull() -> None:
    views = _views(6)
    views[3].camera_to_world[:3, 3] += [0, 0, 10]
    with pytest.raises(InputError, match="no point lies inside all masks"):
        hull.shape(views, 24, 1000)


def test_smoothing_neither_shrinks_nor_keeps_noise() -> None:
    ball = hull.visual_hull(_views(24), 30)
    noise = np.random.default_rng(0).normal(0, 0.01, ball.vertices.shape)
    smoothed = smooth(Mesh(ball.vertices + noise, ball.faces), 10)
    sizes = [np.linalg.norm(v - CENTRE, axis=1) for v in (ball.vertices, ball.vertices + noise, smoothed.vertices)]
    assert abs(sizes[2].mean() / sizes[0].mean() - 1) < 0.005
    assert np.std(sizes[2] - sizes[0]) < 0.5 * np.std(sizes[1] - sizes[0])


def test_crumbs_are_left_out_and_decimation_keeps_the_place() -> None:
    ball = hull.visual_hull(_views(24), 30)
    crumb = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]) + len(ball.vertices)
    both = Mesh(np.concatenate([ball.vertices, crumb]), np.concatenate([ball.faces, faces]))
    assert len(without_crumbs(both, 0.02).faces) == len(ball.faces)
    far = Mesh(1e6 * ball.vertices, ball.faces)
    small = decimate(far, 500)
    assert len(small.faces) <= 500
    np.testing.assert_allclose(small.vertices.mean(0) / 1e6, CENTRE, atol=0.05)


def test_an_atlas_has_no_overlaps_and_keeps_the_surface() -> None:
    pytest.importorskip("xatlas", reason="atlases need xatlas: pip install 'unrender[capture]'")
    ball = decimate(hull.visual_hull(_views(24), 24), 400)
    found = atlas.unwrap(ball, 128)
    assert found.uv is not None
    assert found.uv.min() >= 0
    assert found.uv.max() <= 1
    np.testing.assert_allclose(
        np.sort(found.vertices[found.faces], 0), np.sort(ball.vertices[ball.faces], 0), atol=1e-6
    )
    # Texels by the triangles that hold their middles.
    x, y = np.meshgrid((np.arange(128) + 0.5) / 128, (np.arange(128) + 0.5) / 128)
    count = np.zeros((128, 128), int)
    for a, b, c in found.uv[found.faces]:
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if abs(area) > 1e-12:
            s = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
            t = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
            count += (s > 1e-6) & (t > 1e-6) & (s + t < 1 - 1e-6)
    assert count.max() == 1
    assert (count == 1).mean() > 0.3


def test_an_atlas_that_does_not_end_is_given_up(tmp_path: Path) -> None:
    pytest.importorskip("xatlas", reason="atlases need xatlas: pip install 'unrender[capture]'")
    mesh = Mesh(np.eye(3), np.array([[0, 1, 2]]))
    sleeper = tmp_path / "sleeper.py"
    sleeper.write_text("import time\ntime.sleep(60)\n")
    with pytest.raises(InputError, match=r"the atlas of 1 faces was not ready within 0\.2 s"):
        atlas.unwrap(mesh, 16, seconds=0.2, command=(sys.executable, str(sleeper)))
    sleeper.write_text("raise SystemExit('its charts fill 3 atlases')\n")
    with pytest.raises(InputError, match="could not be made: its charts fill 3 atlases"):
        atlas.unwrap(mesh, 16, command=(sys.executable, str(sleeper)))


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.37])
def test_a_ramp_stays_a_ramp(scale: float) -> None:
    """Values that are linear in the position: any mean of pixels has that of its middle."""
    lens = Lens(60, 50, 70.0, 70.0, 31.0, 22.0)
    x, y = np.meshgrid(np.arange(60) + 0.5, np.arange(50) + 0.5)
    target = pinhole(lens, scale)
    values, shown = Resampling(lens, target).apply(np.stack([x, y], -1).astype(np.float32))
    assert values.shape[:2] == (int(50 * scale), int(60 * scale)) == shown.shape
    u, v = np.meshgrid(np.arange(target.width) + 0.5, np.arange(target.height) + 0.5)
    inner = (slice(2, -2), slice(2, -2))
    np.testing.assert_allclose(values[inner], np.stack([u, v], -1)[inner] / scale, atol=0.05)  # OpenCV counts in 1/32
    np.testing.assert_allclose([target.cx, target.cy], [31 * scale, 22 * scale])


def test_undistorting_puts_points_where_the_pinhole_has_them() -> None:
    lens = Lens(80, 60, 90.0, 88.0, 38.0, 31.0, distortion=(-0.2, 0.1, 0.003, -0.004))
    x, y = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
    target = pinhole(lens, 1.0)
    values, shown = Resampling(lens, target).apply(np.stack([x, y], -1).astype(np.float32))
    points = np.random.default_rng(1).uniform(-0.25, 0.25, (40, 3)) - [0, 0, 1]
    here, there = (project(each, np.eye(4), points)[0] for each in (target, lens))
    for at, wanted in zip(here, there, strict=True):
        column, row = (at - 0.5).round().astype(int)
        slope = np.stack(
            [values[row, column + 1] - values[row, column], values[row + 1, column] - values[row, column]], 1
        )
        np.testing.assert_allclose(values[row, column] + slope @ (at - [column + 0.5, row + 0.5]), wanted, atol=0.02)
    assert shown.min() == 1  # a barrel fills the picture


def test_a_folded_polynomial_shows_nothing_twice() -> None:
    """A strong barrel: 1 - 1.2 r² turns back at r = .53, within the picture of the pinhole."""
    lens = Lens(40, 40, 20.0, 20.0, 20.0, 20.0, distortion=(-1.2, 0.0, 0.0, 0.0))
    _, shown = Resampling(lens, pinhole(lens, 1.0)).apply(np.ones((40, 40, 1), np.float32))
    x, y = np.meshgrid(np.arange(40) - 19.5, np.arange(40) - 19.5)
    radius = np.hypot(x, y) / 20
    assert shown[radius < 0.45].min() == 1
    assert shown[radius > 0.65].max() == 0


def test_matrices_that_are_no_poses_are_refused() -> None:
    good = np.eye(4)
    np.testing.assert_allclose(rigid(5 * good[:3], "here"), good)
    for bad in (np.zeros((4, 4)), np.diag([1.0, 1, -1, 1]), np.full((4, 4), np.nan), [[1, 2], [3, 4]], "text", None):
        with pytest.raises(InputError, match=r"^here: "):
            rigid(bad, "here")


@pytest.mark.parametrize("cut", [4, 20, 40, 60])
def test_a_cut_model_is_one_line(cut: int, tmp_path: Path) -> None:
    (tmp_path / "cameras.bin").write_bytes((b"\1" + 200 * b"\0")[:cut])
    (tmp_path / "images.bin").write_bytes((b"\5" + 200 * b"\0")[:cut])
    with pytest.raises(InputError, match=r"(cameras|images)\.bin: "):
        colmap.read(tmp_path)
