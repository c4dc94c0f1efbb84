"""The visual hull of masks: all points that no photograph shows to be empty.

A. Laurentini, "The visual hull concept for silhouette-based image understanding", PAMI 1994. The field at a point is the minimum over
the photographs of its signed distance to the mask's edge, positive inside, in world units: pixels times depth over focal length. Its
zero level set is the hull, so marching cubes place vertices within a voxel. Concavities that no silhouette shows are filled.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from unrender.app.capture.cameras import Lens, project
from unrender.app.capture.capture import AXES, Capture, CapturedView, CapturedViews, reinterpreted
from unrender.app.capture.mesh import Mesh, decimate, smooth, without_crumbs
from unrender.app.capture.silhouettes import Silhouettes, overlap
from unrender.core.errors import InputError
from unrender.io.stored_pictures import PictureStore, StoredPicture

_COARSE = 32
_REFINED = 4  # number of fine voxels per coarse voxel along each axis
_CHUNK = 1 << 17
_UNKNOWN = 1e4  # distance in pixels where a photograph gives no information
_CRUMBS = 0.02
_SMOOTHING = 10

Camera = tuple[Lens, np.ndarray]
"""A lens and its pose."""


def shape(views: CapturedViews, resolution: int, faces: int) -> Mesh:
    """Return an initial shape from the masks of `views`: the hull without components of less than 2 % of its faces, smoothed and decimated.

    It has about `faces` triangles, from `resolution` voxels along the longest side. Raises `InputError` if no point is inside all masks.
    """
    return decimate(smooth(without_crumbs(visual_hull(views, resolution), _CRUMBS), _SMOOTHING), faces)


def visual_hull(views: CapturedViews, resolution: int) -> Mesh:
    """Return the zero level set of `field`, by marching cubes. Raise `InputError` if it is empty."""
    from skimage import measure

    cameras = [(view.lens, view.camera_to_world) for view in views]
    store = PictureStore()
    distances = [store.add(_distance(view)) for view in views]
    low, high = _box(*_first_ball(views), cameras, distances)
    spacing = float((high - low).max()) / resolution
    counts = np.ceil((high - low) / spacing).astype(int) + 3  # one empty voxel around it
    low = (low + high) / 2 - (counts - 1) / 2 * spacing
    values = _refined(cameras, distances, low, spacing, counts)
    values[0], values[-1] = np.minimum(values[0], -spacing), np.minimum(values[-1], -spacing)
    for side in (0, -1):
        values[:, side] = np.minimum(values[:, side], -spacing)
        values[:, :, side] = np.minimum(values[:, :, side], -spacing)
    if values.max() <= 0:
        raise InputError(EMPTY)
    # The field is a distance only near its zero level set. Clamp distant values, which would distort interpolation.
    vertices, faces, _, _ = measure.marching_cubes(
        np.clip(values, -4 * spacing, 4 * spacing), 0.0, gradient_direction="ascent"
    )
    return Mesh(vertices.astype(float) * spacing + low, faces.astype(np.int64))


EMPTY = "no point lies inside all masks: poses, masks or their order do not belong together"


def field(cameras: Sequence[Camera], distances: Sequence[StoredPicture], points: np.ndarray) -> np.ndarray:
    """Return the field at points (N, 3), (N,): positive inside. `distances` are those of the masks, in pixels."""
    from scipy import ndimage

    minimum = np.full(len(points), np.inf)
    for (lens, pose), stored in zip(cameras, distances, strict=True):
        distance = np.asarray(stored)
        at, depth = project(lens, pose, points)
        pixels = ndimage.map_coordinates(distance, (at - 0.5).T[::-1], order=1, mode="nearest")
        outside = (at < 0) | (at > (lens.width, lens.height))
        if any((side > 0).any() for side in (distance[0], distance[-1], distance[:, 0], distance[:, -1])):
            pixels[outside.any(1)] = _UNKNOWN
        else:  # the object ends inside the picture
            off = np.abs(at - np.clip(at, 0, (lens.width, lens.height))).max(1)
            pixels = np.where(outside.any(1), np.minimum(pixels, 0) - off, pixels)
        np.minimum(minimum, np.where(depth > 0, pixels * depth / lens.fx, -np.inf), out=minimum)
    return minimum


def _distance(view: CapturedView) -> np.ndarray:
    """Return the signed distance (H, W) in pixels to a mask's edge, positive inside, with subpixel accuracy where coverage is
    fractional."""
    from scipy import ndimage

    assert view.mask is not None
    inside = view.mask > 0.5
    within, beyond = (np.asarray(ndimage.distance_transform_edt(part)) for part in (inside, ~inside))
    signed = np.where(inside, within - 0.5, 0.5 - beyond)
    if inside.all():
        signed = np.full(inside.shape, _UNKNOWN)
    edge = np.abs(signed) <= 0.5
    signed[edge] = view.mask[edge] - 0.5
    signed[view.shown < 0.5] = _UNKNOWN
    return signed


def _box(
    middle: np.ndarray, radius: float, cameras: Sequence[Camera], distances: Sequence[StoredPicture]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a box around the hull. Coarse grids refine it iteratively, starting from a ball."""
    low, high = middle - radius, middle + radius
    for _ in range(4):
        spacing = float((high - low).max()) / _COARSE
        axes = [np.linspace(low[axis], high[axis], _COARSE + 1) for axis in range(3)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
        values = _evaluated(cameras, distances, points.reshape(-1, 3)).reshape(points.shape[:3])
        near = values > -spacing
        if not near.any():
            raise InputError(EMPTY)
        occupied = points[near]
        touched = np.isclose(occupied.min(0), low), np.isclose(occupied.max(0), high)
        extent = high - low
        new_low, new_high = occupied.min(0) - spacing, occupied.max(0) + spacing
        low = np.where(touched[0], low - extent / 4, new_low)
        high = np.where(touched[1], high + extent / 4, new_high)
        if not (touched[0].any() or touched[1].any()) and np.all(high - low > 0.7 * extent):
            break
    return low, high


def _first_ball(views: CapturedViews) -> tuple[np.ndarray, float]:
    """Return the point nearest to the rays through the centroids of all masks, and the radius of a ball there that covers every mask."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        assert view.mask is not None
        rows, columns = np.nonzero(view.mask > 0.5) if (view.mask > 0.5).any() else np.nonzero(view.mask > 0)
        x = (columns.mean() + 0.5 - view.lens.cx) / view.lens.fx
        y = (rows.mean() + 0.5 - view.lens.cy) / view.lens.fy
        direction = view.camera_to_world[:3, :3] @ np.array([x, -y, -1.0])
        direction /= np.linalg.norm(direction)
        across = np.eye(3) - np.outer(direction, direction)
        matrix += across
        right += across @ view.camera_to_world[:3, 3]
    middle = np.linalg.lstsq(matrix, right, rcond=1e-6)[0]
    radii = []
    for view in views:
        assert view.mask is not None
        rows, columns = np.nonzero(view.mask > 0)
        _, depth = project(view.lens, view.camera_to_world, middle[None])
        half = max(np.ptp(rows) + 1, np.ptp(columns) + 1) / 2
        radii.append(abs(float(depth[0])) * half / view.lens.fx)
    return middle, 1.2 * float(np.max(radii))


def _evaluated(cameras: Sequence[Camera], distances: Sequence[StoredPicture], points: np.ndarray) -> np.ndarray:
    chunks = [points[start : start + _CHUNK] for start in range(0, len(points), _CHUNK)]
    return np.concatenate([field(cameras, distances, chunk) for chunk in chunks])


def _refined(
    cameras: Sequence[Camera], distances: Sequence[StoredPicture], low: np.ndarray, spacing: float, counts: np.ndarray
) -> np.ndarray:
    """Return the field on a grid, evaluated only where a coarser grid indicates that its zero level set is near."""
    from scipy import ndimage

    coarse_counts = -(-(counts - 1) // _REFINED) + 1
    indices = np.stack(np.meshgrid(*(np.arange(n) for n in coarse_counts), indexing="ij"), -1)
    coarse = _evaluated(cameras, distances, (low + indices * (_REFINED * spacing)).reshape(-1, 3))
    coarse = np.clip(coarse, -_UNKNOWN * spacing, _UNKNOWN * spacing).reshape(coarse_counts)
    fine = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), -1)
    values = ndimage.map_coordinates(coarse, (fine / _REFINED).reshape(-1, 3).T, order=1, mode="nearest")
    near = np.abs(values) < 2 * _REFINED * spacing
    values[near] = _evaluated(cameras, distances, low + fine.reshape(-1, 3)[near] * spacing)
    return values.reshape(counts)


SUFFICIENT = 0.6
"""Mean intersection over union of silhouettes and masks below which an import is refused."""
_CLEAR = 0.15  # minimum increase of the overlap by which another convention is named
_VIEWS = 10
_VOXELS = 40
_SCALES = (0.001, 0.01, 0.1, 10.0, 100.0, 1000.0)


@dataclass(frozen=True)
class Trial:
    """Another reading of the same files: its convention, what to type, and the mean intersection over union with the masks."""

    what: str
    remedy: str
    overlap: float


def explain(capture: Capture, views: CapturedViews, mesh: Mesh | None, mean_overlap: float) -> str:
    """Return one line on why masks and mesh, or masks and poses, do not fit; `mean_overlap` is their overlap as read."""
    whose = "the mesh covers" if mesh is not None else "a shape carved from all masks covers"
    line = f"{whose} the masks with an overlap (IoU) of {mean_overlap:.2f}, expected at least {SUFFICIENT:g}"
    best = max(trials(capture, views, mesh), key=lambda trial: trial.overlap, default=None)
    if best is None or best.overlap < mean_overlap + _CLEAR:
        return f"{line}; no other convention of axes fits better: poses, masks or the order of names may be wrong"
    return f"{line}; {best.what} would give {best.overlap:.2f}: {best.remedy}"


def trials(capture: Capture, views: CapturedViews, mesh: Mesh | None) -> list[Trial]:
    """Return other conventions of the poses and, with a mesh, of its axes and scale, each with its overlap on at most ten views."""
    chosen = np.unique(np.linspace(0, len(views) - 1, min(len(views), _VIEWS)).round().astype(int))
    few = [_reduced(views[index]) for index in chosen]
    names = [views[index].name for index in chosen]
    results = []
    for axes, inverse in [(axes, inverse) for inverse in (False, True) for axes in AXES]:
        if (axes, inverse) == (capture.axes, capture.world_to_camera):
            continue
        other = {p.name: p.camera_to_world for p in reinterpreted(capture, axes, inverse).photographs}
        posed = [replace(view, camera_to_world=other[name]) for view, name in zip(few, names, strict=True)]
        direction = "world-to-camera" if inverse else "camera-to-world"
        remedy = f"give --axes {axes}" + (f" --{direction}" if inverse != capture.world_to_camera else "")
        results.append(Trial(f"{direction} matrices with {axes} axes", remedy, _fit(posed, mesh)))
    upside_down = [replace(v, camera_to_world=v.camera_to_world @ np.diag([-1.0, -1.0, 1.0, 1.0])) for v in few]
    results.append(Trial("pictures turned by 180°", "turn the photographs and masks", _fit(upside_down, mesh)))
    for what, remedy, moved in _meshes(mesh):
        results.append(Trial(what, remedy, _fit(few, moved)))
    return results


def _meshes(mesh: Mesh | None) -> Iterator[tuple[str, str, Mesh]]:
    if mesh is None:
        return
    x, y, z = np.asarray(mesh.vertices, float).T
    export = "export the mesh with the up axis of the cameras"
    turned = {"z up": (x, -z, y), "y up": (x, z, -y), "x and z turned by 180° about y": (-x, y, -z)}
    turned["x and y turned by 180° about z"] = (-x, -y, z)
    for what, columns in turned.items():
        yield f"a mesh with {what}", export, Mesh(np.stack(columns, 1), mesh.faces)
    for axis, name in enumerate("xyz"):
        sign = np.where(np.arange(3) == axis, -1.0, 1.0)
        yield f"a mesh with {name} mirrored", f"mirror the mesh along {name}", Mesh(mesh.vertices * sign, mesh.faces)
    for scale in _SCALES:
        yield (
            f"a mesh {scale:g} times as large",
            "scale the mesh to the cameras' unit",
            Mesh(mesh.vertices * scale, mesh.faces),
        )


def _fit(views: CapturedViews, mesh: Mesh | None) -> float:
    try:
        shape = visual_hull(views, _VOXELS) if mesh is None else mesh
    except InputError:
        return 0.0
    return float(np.mean(overlap(Silhouettes(shape), views)))


def _reduced(view: CapturedView) -> CapturedView:
    factor = max(1, min(view.lens.width, view.lens.height) // 48)
    width, height = view.lens.width // factor, view.lens.height // factor

    def smaller(values: np.ndarray) -> np.ndarray:
        blocks = values[: height * factor, : width * factor].reshape(height, factor, width, factor)
        return blocks.mean((1, 3))

    sizes = {name: getattr(view.lens, name) / factor for name in ("fx", "fy", "cx", "cy")}
    lens = replace(view.lens, width=width, height=height, **sizes)
    assert view.mask is not None
    return replace(view, lens=lens, mask=smaller(view.mask), shown=smaller(view.shown))
