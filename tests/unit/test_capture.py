"""Parts of imports by closed forms: hulls, atlases, undistortion, meshes."""

from __future__ import annotations

import io
import json
import os
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms, PngImagePlugin

from tiers import quick

pytest.importorskip("cv2", reason="photographs need OpenCV: pip install 'unrender[capture]'")

import unrender
from unrender.app.capture import formats, hull, importing, pictures, views
from unrender.app.capture.cameras import Lens, project, rigid
from unrender.app.capture.capture import AXES, Capture, CapturedView, Photograph, pose, reinterpreted
from unrender.app.capture.formats import colmap, files, lights
from unrender.app.capture.mesh import Mesh, decimate, normals, smooth, unwrap, without_crumbs
from unrender.app.capture.views import Resampling, pinhole
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
    triangles = small.vertices[small.faces]
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    # The centroid of the surface: where vertices are dense is the decimation's own affair.
    np.testing.assert_allclose(area @ triangles.mean(axis=1) / area.sum() / 1e6, CENTRE, atol=0.005)


def test_an_atlas_has_no_overlaps_and_keeps_the_surface() -> None:
    pytest.importorskip("xatlas", reason="atlases need xatlas: pip install 'unrender[capture]'")
    ball = decimate(hull.visual_hull(_views(24), 24), 400)
    found = unwrap(ball, 128)
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
        unwrap(mesh, 16, seconds=0.2, command=(sys.executable, str(sleeper)))
    sleeper.write_text("raise SystemExit('its charts fill 3 atlases')\n")
    with pytest.raises(InputError, match="could not be made: its charts fill 3 atlases"):
        unwrap(mesh, 16, command=(sys.executable, str(sleeper)))


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
    for given, scale in ((5 * good[:3], 5), (np.diag([6.0, 6, 6, 3]), 2), (np.diag([1e200, 1e200, 1e200, 1]), 1e200)):
        found, length = rigid(given, "here")
        np.testing.assert_allclose(found, good)
        assert length == pytest.approx(scale)
    tilted = np.eye(4)
    tilted[3, 0] = 0.1
    mirrored = np.diag([1.0, 1, -1, 1])
    huge = [[10**400, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
    beyond = np.diag([1e300, 1e300, 1e300, 1e-300])
    none = (np.zeros((4, 4)), np.full((4, 4), np.nan), [[1, 2], [3, 4]], "text", None)
    for bad in (mirrored, tilted, np.diag([1.0, 1, 1, 0]), huge, beyond, *none):
        with pytest.raises(InputError, match=r"^here: "):
            rigid(bad, "here")


@pytest.mark.parametrize("cut", [4, 20, 40, 60])
def test_a_cut_model_is_one_line(cut: int, tmp_path: Path) -> None:
    (tmp_path / "cameras.bin").write_bytes((b"\1" + 200 * b"\0")[:cut])
    (tmp_path / "images.bin").write_bytes((b"\5" + 200 * b"\0")[:cut])
    with pytest.raises(InputError, match=r"(cameras|images)\.bin: "):
        colmap.read(tmp_path)


def _rotation() -> np.ndarray:
    return _camera(np.array([0.4, 0.5, -0.7]), 2.0)[:3, :3]


@pytest.mark.parametrize("world_to_camera", [False, True])
@pytest.mark.parametrize("axes", AXES)
def test_a_scale_of_a_matrix_leaves_the_camera_where_it_is(axes: str, world_to_camera: bool) -> None:
    """x' = s R x + t: what is at 0 is the camera, at -R^T t / s; of camera to world, it is t."""
    scale, t, turn = 2.5, np.array([1.0, -2.0, 3.0]), _rotation()
    stored = np.column_stack([scale * turn, t])
    expected = np.linalg.solve(stored[:, :3], -t) if world_to_camera else t
    found, length = pose(stored, axes, world_to_camera, "here")
    np.testing.assert_allclose(found[:3, 3], expected)
    photograph = Photograph("a", Path("a.png"), LENS, found, scale=length)
    capture = Capture(Path(), "transforms", (photograph,), axes, world_to_camera)
    for other in (False, True):
        (moved,) = reinterpreted(capture, "opencv", other).photographs
        np.testing.assert_allclose(moved.camera_to_world, pose(stored, "opencv", other, "here")[0], atol=1e-12)


def test_lenses_that_leave_no_pixel_or_have_no_width_are_refused() -> None:
    with pytest.raises(InputError, match=r"40 x 40 pixels at a scale of 0\.01"):
        pinhole(Lens(40, 40, 48.0, 48.0, 20.0, 20.0), 0.01)
    with pytest.raises(InputError, match="angle of view"):
        Lens.of_field_of_view(5e-324, 40, 40)
    with pytest.raises(InputError, match="width and height"):
        Lens(10**400, 40, 48.0, 48.0, 20.0, 20.0)
    with pytest.raises(InputError, match="--voxels 512"):
        importing.ImportOptions(voxels=512)


def test_the_atlas_program_imports_nothing_from_the_current_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("xatlas", reason="atlases need xatlas: pip install 'unrender[capture]'")
    (tmp_path / "numpy.py").write_text("open('was-run', 'w')\n")
    assert unrender.__file__ is not None
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.path.relpath(Path(unrender.__file__).parents[1]))
    assert unwrap(Mesh(np.eye(3), np.array([[0, 1, 2]])), 16).uv is not None
    assert not (tmp_path / "was-run").exists()


# ---------------------------------------------------------------------- files


def _picture(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


def _transforms(folder: Path, names: list[str], **more: object) -> None:
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in names]
    document = {"camera_angle_x": 0.8, "frames": frames, **more}
    (folder / "transforms.json").write_text(json.dumps(document))


NAMES = ["images/left/1.jpg", "images/right/1.jpg"]


@pytest.mark.parametrize("place", ["masks/images/{}/1.png", "masks/{}/1.png", "masks/{}/1.jpg.png"])
def test_masks_of_photographs_in_folders_are_told_apart(place: str, tmp_path: Path) -> None:
    for name in NAMES:
        _picture(tmp_path / name)
    masks = [_picture(tmp_path / place.format(side)) for side in ("left", "right")]
    _transforms(tmp_path, NAMES)
    assert [photograph.mask for photograph in formats.read(tmp_path).photographs] == masks
    given = formats.read(tmp_path, masks=tmp_path / "masks")
    assert [photograph.mask for photograph in given.photographs] == masks


def test_a_mask_of_two_photographs_is_refused(tmp_path: Path) -> None:
    for name in (*NAMES, "masks/1.png"):
        _picture(tmp_path / name)
    _transforms(tmp_path, NAMES)
    with pytest.raises(InputError, match=r"masks/1\.png: shared by two photographs"):
        formats.read(tmp_path)


def test_a_principal_point_beside_an_angle_of_view_is_kept(tmp_path: Path) -> None:
    _picture(tmp_path / "a.png")
    _transforms(tmp_path, ["a.png"], w=60, h=40, cx=25.0, cy=22.0)
    lens = formats.read(tmp_path).photographs[0].lens
    assert lens is not None
    assert (lens.cx, lens.cy) == (25, 22)
    assert lens.fx == lens.fy == pytest.approx(30 / np.tan(0.4))
    for more in ({"cx": 25.0}, {"w": 10**400, "h": 40}, {"w": 60, "h": 40, "camera_angle_x": 5e-324}):
        _transforms(tmp_path, ["a.png"], **more)
        with pytest.raises(InputError, match=r"transforms\.json: frames\[0\]: "):
            formats.read(tmp_path)


def test_masks_beside_llffs_photographs_are_not_counted(tmp_path: Path) -> None:
    masks = [_picture(tmp_path / "images" / f"{name}_mask.png") for name in "ab"]
    files = [_picture(tmp_path / "images" / f"{name}.jpg") for name in "ab"]
    row = np.r_[np.column_stack([np.eye(3), np.zeros(3), [40, 60, 50]]).ravel(), 1, 9]
    np.save(tmp_path / "poses_bounds.npy", np.array([row, row]))
    found = formats.read(tmp_path).photographs
    assert [(photograph.file, photograph.mask) for photograph in found] == list(zip(files, masks, strict=True))


def test_the_alpha_of_a_floating_point_photograph_is_its_mask(tmp_path: Path) -> None:
    mi = pytest.importorskip("mitsuba")
    unrender.use("llvm_ad_rgb")
    colours, alpha = np.full((6, 8, 3), 0.6, np.float32), np.linspace(0, 1, 48, dtype=np.float32).reshape(6, 8, 1)
    mi.Bitmap(np.concatenate([colours * alpha, alpha], axis=2)).write(str(tmp_path / "a.exr"))
    found = pictures.read(tmp_path / "a.exr")
    np.testing.assert_allclose(np.asarray(found.alpha), alpha[..., 0])
    assert found.premultiplied
    np.testing.assert_allclose(found.values, colours * alpha)
    np.testing.assert_allclose(pictures.read_mask(tmp_path / "a.exr"), alpha[..., 0])


def _soft_edges(folder: Path) -> np.ndarray:
    """Write three photographs of a folder with transforms.json: premultiplied colour 0.6, with an alpha of 0.1 near the edge."""
    mi = pytest.importorskip("mitsuba")
    unrender.use("llvm_ad_rgb")
    alpha = np.zeros((32, 32, 1), np.float32)
    alpha[4:-4, 4:-4], alpha[8:-8, 8:-8] = 0.1, 1.0
    names = [f"{index}.exr" for index in range(3)]
    for name in names:
        mi.Bitmap(np.concatenate([0.6 * alpha, alpha], axis=2).repeat([3, 1], axis=2)).write(str(folder / name))
    directions = ([1, 0, 0.2], [0, 0.1, 1], [-1, 0.3, 0.1])
    frames = [
        {"file_path": name, "transform_matrix": _camera(np.array(direction), 3.0).tolist()}
        for name, direction in zip(names, directions, strict=True)
    ]
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.6, "frames": frames}))
    return alpha


def test_colours_of_a_field_stay_multiplied_with_alpha(tmp_path: Path) -> None:
    (tmp_path / "capture").mkdir()
    alpha = _soft_edges(tmp_path / "capture")
    unrender.app.import_capture(tmp_path / "capture", tmp_path / "out", unrender.app.ImportOptions(field=4, hold_out=0))
    written = sorted((tmp_path / "out" / "references").iterdir())
    assert len(written) == 3
    np.testing.assert_allclose(pictures.read(written[0]).values, 0.6 * alpha.repeat(3, axis=2), atol=1e-3)


def test_colours_of_a_field_are_multiplied_with_the_alpha_of_png_files(tmp_path: Path) -> None:
    """Their colours are not multiplied, and those of transparent pixels mean nothing."""
    (tmp_path / "capture").mkdir()
    alpha = _soft_edges(tmp_path / "capture")
    for file in (tmp_path / "capture").glob("*.exr"):
        coverage = (255 * alpha).round().astype(np.uint8)
        colours = np.where(coverage > 0, 255, 90).astype(np.uint8).repeat(3, axis=2)
        Image.fromarray(np.concatenate([colours, coverage], axis=2)).save(file.with_suffix(".png"))
        file.unlink()
    table = tmp_path / "capture" / "transforms.json"
    table.write_text(table.read_text().replace(".exr", ".png"))
    unrender.app.import_capture(tmp_path / "capture", tmp_path / "out", unrender.app.ImportOptions(field=4, hold_out=0))
    written = sorted((tmp_path / "out" / "references").iterdir())
    np.testing.assert_allclose(pictures.read(written[0]).values, alpha.repeat(3, axis=2), atol=3e-3)


def test_colours_of_masked_photographs_are_divided_by_alpha(tmp_path: Path) -> None:
    alpha = _soft_edges(tmp_path)
    (stored, *_), _ = views.prepare(formats.read(tmp_path), 32, None, 0)
    np.testing.assert_allclose(np.asarray(stored.mask), alpha[..., 0])
    np.testing.assert_allclose(stored.values, 0.6 * (alpha > 0).repeat(3, axis=2), rtol=1e-5)


def test_broken_exif_is_passed_over(tmp_path: Path) -> None:
    text = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x02\0\x04\0\0\0ab\0\0\0\0\0\0"  # an orientation in letters
    for exif in (text, b"Exif\0\0II*\0\xff\xff\xff\xff"):
        Image.new("RGB", (8, 6)).save(tmp_path / "a.jpg", exif=exif)
        assert pictures.upright(tmp_path / "a.jpg", None) == (8, 6, 1)


@pytest.mark.parametrize(
    ("orientation", "lens", "expected"),
    [
        (6, (8, 6), (8, 6, 1)),
        (6, (6, 8), (6, 8, 6)),
        (3, (8, 6), None),  # turned by 180°, it has the same size
        (6, (8, 8), None),
        (6, None, None),
        (9, None, (8, 6, 1)),  # none of EXIF's
    ],
)
def test_exif_that_the_size_of_the_camera_does_not_decide_is_refused(
    orientation: int, lens: tuple[int, int] | None, expected: tuple[int, int, int] | None, tmp_path: Path
) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.new("RGB", (8, 8) if lens == (8, 8) else (8, 6)).save(tmp_path / "a.jpg", exif=exif)
    camera = lens and Lens(*lens, 8.0, 8.0, 4.0, 4.0)
    if expected:
        assert pictures.upright(tmp_path / "a.jpg", camera) == expected
        return
    with pytest.raises(
        InputError, match=rf"its EXIF orientation is {orientation}, and nothing tells .*; remove the orientation for"
    ):
        pictures.upright(tmp_path / "a.jpg", camera)


def test_only_errors_of_pillow_are_errors_of_the_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def raising(picture: Image.Image) -> int:
        raise TypeError("a fault of the program")

    path = tmp_path / "a.jpg"
    Image.new("RGB", (64, 64)).save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) - 60])
    with pytest.raises(InputError, match=r"a\.jpg: cannot be read as a picture"):
        pictures.read(path)
    path.write_bytes(whole)
    monkeypatch.setattr(pictures.images, "orientation", raising)
    with pytest.raises(TypeError, match="a fault of the program"):
        pictures.upright(path, None)


def test_colour_profiles_and_exposures_of_photographs_are_told(tmp_path: Path) -> None:
    """Exposures only where they differ, and are no unknowns."""
    names = ["a.jpg", "b.jpg", "c.png"]
    for name, speed in zip(names, (100, 250, 0), strict=True):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x829A: 0.02, 0x829D: 4.0, 0x8827: speed})
        Image.new("RGB", (8, 6)).save(tmp_path / name, exif=exif)
    assert pictures.notices([tmp_path / names[0], tmp_path / names[2]], False) == []
    (line,) = pictures.notices([tmp_path / name for name in names], False)
    assert line == "exposures differ by a factor of 2.5 by EXIF: list exposure among --unknowns to recover them"
    assert pictures.notices([tmp_path / name for name in names], True) == []
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()
    Image.new("RGB", (8, 6)).save(tmp_path / "a.jpg", icc_profile=profile)
    (line,) = pictures.notices([tmp_path / name for name in names], False)
    assert line == "a.jpg: a colour profile that is not sRGB is ignored; convert to sRGB"
    Image.new("RGB", (8, 6)).save(tmp_path / "b.jpg", icc_profile=profile)
    assert pictures.notices([tmp_path / name for name in names], False)[0].startswith("a.jpg and 1 more: a colour pro")
    # Pillow opens no TIFF files of 16 bits in RGB.
    Image.new("RGB", (8, 6)).save(tmp_path / "a.tif", icc_profile=profile)
    Image.new("I;16", (8, 6)).save(tmp_path / "b.tif", icc_profile=profile)
    (line,) = pictures.notices([tmp_path / "a.tif", tmp_path / "b.tif"], False)
    assert line.startswith("a.tif and 1 more: a colour profile")


def test_a_declared_gamma_of_photographs_that_are_decoded_as_srgb_is_told(tmp_path: Path) -> None:
    info = PngImagePlugin.PngInfo()
    info.add(b"gAMA", (100_000).to_bytes(4, "big"))
    Image.new("RGB", (8, 6)).save(tmp_path / "a.png", pnginfo=info)
    (line,) = pictures.notices([tmp_path / "a.png"], False)
    assert line == "a.png: a gamma of 1 is declared, that of sRGB is 0.455; give --response 1"
    assert pictures.notices([tmp_path / "a.png"], False, pictures.LINEAR) == []


def test_a_photograph_of_a_thousand_scans_is_refused(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    Image.new("RGB", (8, 6)).save(buffer, "JPEG", progressive=True)
    (tmp_path / "a.jpg").write_bytes(buffer.getvalue()[:-2] + 1000 * b"\xff\xda\0\2")
    with pytest.raises(InputError, match=r"a\.jpg: cannot be read as a picture: more than 100 scans"):
        pictures.upright(tmp_path / "a.jpg", None)


def test_a_tiff_of_another_kind_names_exr(tmp_path: Path) -> None:
    import cv2

    cv2.imwrite(str(tmp_path / "a.tif"), np.ones((6, 8, 3), np.float32))
    with pytest.raises(InputError, match=r"a\.tif: cannot be read as a picture; save floating-point values as \.exr"):
        pictures.upright(tmp_path / "a.tif", None)


def test_a_side_that_opencv_does_not_take_is_refused_of_mitsubas_kinds_too(tmp_path: Path) -> None:
    (tmp_path / "a.pfm").write_bytes(b"PF\n32768 1\n-1.0\n" + bytes(12 * 32768))
    with pytest.raises(InputError, match=r"a\.pfm: 32768 x 1 pixels, expected at most"):
        pictures.upright(tmp_path / "a.pfm", None)


@pytest.mark.parametrize("name", ["xatlas", "fast_simplification"])
def test_a_missing_package_is_told_before_photographs_are_read(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for file in ("a.png", "a_mask.png"):  # empty: to read them is an error
        _picture(tmp_path / file)
    _transforms(tmp_path, ["a.png"])
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=r"pip install 'unrender\[capture\]'"):
        importing.import_capture(tmp_path, tmp_path / "out", importing.ImportOptions())


@pytest.mark.parametrize("kind", quick(["colmap", "transforms", "llff", "lights"], "colmap", "llff"))
def test_a_hundred_thousand_photographs_are_one_line(kind: str, tmp_path: Path) -> None:
    """Before a file of them is looked for, which would take hours."""
    count = files.MOST + 1
    if kind == "colmap":
        (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, 10, 12, 10, 10, 5, 6))
        image = struct.pack("<i7di", 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.png\0" + struct.pack("<Q", 0)
        (tmp_path / "images.bin").write_bytes(struct.pack("<Q", count) + count * image)
    elif kind == "transforms":
        (tmp_path / "transforms.json").write_text(json.dumps({"frames": count * [{"file_path": "a.png"}]}))
    elif kind == "llff":
        np.save(tmp_path / "poses_bounds.npy", np.ones((count, 17)))
    else:
        (tmp_path / "lights.txt").write_text(
            f"{count}\n" + "1 0 1\n0 1 1\n-1 0 1\n" * (count // 3) + "0 0 1\n" * (count % 3)
        )
    read = lights.read if kind == "lights" else formats.FORMATS[kind].read
    with pytest.raises(InputError, match=f": {count} photographs, expected at most {files.MOST}; use a subset"):
        read(tmp_path, None)
