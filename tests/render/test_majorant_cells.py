# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Majorant supergrids: they bound the extinction wherever a ray may look, and walks through them use up what they should."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from kernels import on_device, recorded
from tiers import quick
from unrender.io.volumes import write_grid
from unrender.rendering.mitsuba import emissive
from unrender.rendering.mitsuba.integrators import majorant_supergrid
from unrender.rendering.mitsuba.integrators.majorant_supergrid import MajorantSupergrids, SupergridTraversal
from unrender.rendering.mitsuba.scene_loading import attached_media, extinction_transforms
from unrender.rendering.renderer import SampleRequest

SHAPE = (17, 33, 22)
POINTS = 200_000


def turned() -> Any:
    to = mi.ScalarTransform4f
    return to().translate([3, -2, 1]).rotate([0.6, 0.0, 0.8], 40).scale([1.0, 2.0, 0.5]).translate([-0.5, -0.5, -0.5])


def mirrored() -> Any:
    to = mi.ScalarTransform4f
    return to().translate([1, -3, 2]).rotate([0, 0, 1], 90).scale([2.0, -1.5, 3.0])


PLACES = {
    "cube": lambda: mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2),
    "turned": turned,
    "mirrored": mirrored,
}


def values(channels: int = 1, seed: int = 1) -> np.ndarray:
    """Single voxels far above their neighbours, so that one that was forgotten is missed."""
    rng = np.random.default_rng(seed)
    return (rng.uniform(0, 1, (*SHAPE, channels)) + 20 * (rng.uniform(0, 1, (*SHAPE, channels)) < 0.01)).astype(
        np.float32
    )


def transform(place: str) -> np.ndarray:
    return np.array(PLACES[place]().matrix, np.float64)


def supergrids(of: Any, place: str) -> MajorantSupergrids:
    return MajorantSupergrids({number(of): of}, {number(of): transform(place)})


def medium(place: str = "cube", wrap: str = "clamp", channels: int = 1, scale: float = 1.0, **more: Any) -> Any:
    grid = mi.VolumeGrid(values(channels))
    volume = {"type": "gridvolume", "grid": grid, "raw": True, "to_world": PLACES[place](), "wrap_mode": wrap, **more}
    return mi.load_dict({"type": "heterogeneous", "scale": scale, "sigma_t": volume, "albedo": 0.5})


def number(of: Any) -> int:
    return int(dr.reinterpret_array(mi.UInt32, mi.MediumPtr(of)).numpy()[0])


def volume(of: Any) -> Any:
    return mi.traverse(of).properties["sigma_t.data"][2]


def tables(of: Any, place: str) -> tuple[MajorantSupergrids, dict[str, Any]]:
    grids = supergrids(of, place)
    return grids, {"frames": grids.frames, "layout": grids.layout, "majorants": grids.values()}


def points(of: Any) -> np.ndarray:
    """Anywhere in the medium's box, and crowded at its faces."""
    box = volume(of).bbox()
    low, high = np.array(box.min).ravel(), np.array(box.max).ravel()
    shares = np.random.default_rng(2).beta(0.5, 0.5, (3, POINTS))
    return low[:, None] + shares * (high - low)[:, None]


def extinction(of: Any, where: np.ndarray) -> np.ndarray:
    mei = dr.zeros(mi.MediumInteraction3f, where.shape[1])
    mei.p = mi.Point3f(where)
    return np.array(of.get_scattering_coefficients(mei, True)[2])


def majorants(of: Any, where: np.ndarray, place: str = "cube") -> np.ndarray:
    """Those that a walk finds which begins there."""
    count = where.shape[1]
    ray = mi.Ray3f(mi.Point3f(where), mi.Vector3f(0, 0, 1))
    cells = SupergridTraversal(
        tables(of, place)[1], mi.MediumPtr(of), ray, mi.Float(0), mi.Float(1e-6), None, mi.Bool(True)
    )
    return np.array(cells.start().σ̄) * np.ones(count)


@pytest.fixture(autouse=True)
def _variant() -> None:
    ur.use()
    emissive.register()


@pytest.mark.parametrize("place", quick(PLACES, "turned"))
@pytest.mark.parametrize("wrap", quick(["clamp", "repeat", "mirror"], "mirror"))
def test_majorants_bound_the_extinction_everywhere(place: str, wrap: str) -> None:
    for channels, filter_type in ((1, "trilinear"), (3, "trilinear"), (1, "nearest")):
        cloud = medium(place, wrap, channels, scale=2.5, filter_type=filter_type)
        where = points(cloud)
        assert (extinction(cloud, where).max(axis=0) <= majorants(cloud, where, place) * (1 + 1e-5)).all()


@pytest.mark.parametrize("fault", ["neighbours", "place"])
def test_a_bound_that_forgets_something_is_seen(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """So the test above can fail: cells that look no further than their own voxels, and a grid half a cell away."""
    monkeypatch.setattr(majorant_supergrid, "_MARGIN", 1.0)
    if fault == "neighbours":

        def narrow(found: Any, shape: tuple[int, int, int], size: int, cells: int) -> Any:
            outer, count, inner = shape
            padded = np.zeros((outer, cells * size, inner), np.float32)
            padded[:, :count] = np.array(found).reshape(shape)
            return mi.Float(padded.reshape(outer, cells, size, inner).max(axis=2).ravel())

        monkeypatch.setattr(majorant_supergrid, "_pool", narrow)
    else:
        found = majorant_supergrid.to_local
        shift = np.array([[0, 0, 0, 0.05]] * 3)
        monkeypatch.setattr(majorant_supergrid, "to_local", lambda *of: found(*of) + shift)
    cloud = medium()
    where = points(cloud)
    assert not (extinction(cloud, where).max(axis=0) <= majorants(cloud, where)).all()


def reached(cell: int, size: int, voxels: int) -> list[int]:
    """Those that interpolation in a cell looks at, along one axis, whether the grid repeats, mirrors or clamps."""
    found = range(cell * size - 1, (cell + 1) * size + 1)
    mirrored = {-1 - n if n < 0 else 2 * voxels - 1 - n if n >= voxels else n for n in found}
    return sorted({n % voxels for n in found} | mirrored)


def test_majorants_are_those_of_a_loop_over_voxels() -> None:
    grids, found = tables(medium(channels=3, scale=2.0), "cube")
    x, y, z = (int(n) for n in found["layout"].numpy().reshape(-1, 4)[-1, :3])
    data = 2.0 * values(3).max(axis=-1)
    sizes = [majorant_supergrid.cell_size(n) for n in SHAPE]
    expected = np.full((z + 2, y + 2, x + 2), data.max())
    for cell in np.ndindex(z, y, x):
        box = data[np.ix_(*[reached(c, k, n) for c, k, n in zip(cell, sizes, SHAPE, strict=True)])]
        bound = min(majorant_supergrid._MARGIN * box.max(), data.max())
        expected[cell[0] + 1, cell[1] + 1, cell[2] + 1] = bound
    np.testing.assert_allclose(found["majorants"].numpy().reshape(expected.shape), expected, rtol=1e-6)
    assert grids.every


@pytest.mark.parametrize("place", PLACES)
def test_a_walk_uses_up_the_optical_depth_that_it_was_given(place: str) -> None:
    """Against sums of fine steps; some rays go along axes, some begin inside, some outside the grid."""
    cloud = medium(place)
    box = volume(cloud).bbox()
    low, high = np.array(box.min).ravel(), np.array(box.max).ravel()
    rng = np.random.default_rng(3)
    count, steps = 64, 20_000
    a, b = (low[:, None] + rng.uniform(0, 1, (3, count)) * (high - low)[:, None] for _ in range(2))
    b[1:, :8] = a[1:, :8]
    b[0, 8:16] = a[0, 8:16]
    length = np.linalg.norm(b - a, axis=0)
    ray = mi.Ray3f(mi.Point3f(a), mi.Vector3f((b - a) / length))
    near, far = mi.Float(0.1 * length), mi.Float(length)
    cells = SupergridTraversal(tables(cloud, place)[1], mi.MediumPtr(cloud), ray, near, far, None, mi.Bool(True))
    asked = rng.exponential(3, (2, count))
    place_ = cells.start()
    reached = []
    for depth in asked:
        place_ = cells.advance(place_, mi.Float(depth), place_.t < far)
        reached.append(np.array(place_.t))
    t = 0.1 * length + 0.9 * length * (np.arange(steps)[:, None] + 0.5) / steps
    where = a[:, None] + t * ((b - a) / length)[:, None]
    σ̄ = majorants(cloud, where.reshape(3, -1), place).reshape(steps, count)
    for end, total in zip(reached, np.cumsum(asked, axis=0), strict=True):
        depth = np.where(t < end, σ̄, 0).sum(axis=0) * 0.9 * length / steps
        stops = end < length * (1 - 1e-6)
        assert stops.any()
        np.testing.assert_allclose(depth[stops], total[stops], atol=0.03)
        assert (depth[~stops] <= total[~stops] + 0.03).all()
    assert (reached[1] > 0.9999 * length).any()


def test_new_values_are_seen_and_old_ones_are_not_worked_out_again() -> None:
    cloud = medium()
    grids = supergrids(cloud, "cube")
    before = grids.values()
    assert grids.values().index == before.index
    parameters = mi.traverse(cloud)
    parameters["sigma_t.data"] = mi.TensorXf(3 * values())
    parameters.update()
    np.testing.assert_allclose(grids.values().numpy(), 3 * before.numpy(), rtol=1e-6)


def test_new_values_compile_no_kernels() -> None:
    cloud = medium()
    grids = supergrids(cloud, "cube")
    parameters = mi.traverse(cloud)
    for seed in range(4):
        parameters["sigma_t.data"] = on_device(values(seed=seed))
        parameters.update()
        with recorded() as found:
            dr.eval(grids.values())
            dr.sync_thread()
        assert found
        assert seed < 2 or not any(found)


def test_media_without_a_grid_that_pays_keep_one_majorant() -> None:
    small = {"type": "gridvolume", "grid": mi.VolumeGrid(np.ones((4, 4, 4, 1), np.float32)), "raw": True}
    for description in (
        {"type": "homogeneous", "albedo": 0.5},
        {"type": "heterogeneous", "sigma_t": small, "albedo": 0.5},
        {"type": "heterogeneous", "sigma_t": {"type": "constvolume", "value": 2.0}, "albedo": 0.5},
    ):
        plain = mi.load_dict(description)
        assert not MajorantSupergrids({number(plain): plain}, {number(plain): np.eye(4)})


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("form", ["dictionary", "XML"])
@pytest.mark.parametrize("use_grid_bbox", [False, True])
def test_transforms_are_read_from_the_description(place: str, form: str, use_grid_bbox: bool, tmp_path: Path) -> None:
    """Of an extinction of x + y + z in the grid's own coordinates: media that are shared, nested, or a sensor's; others have none."""
    z, y, x = np.meshgrid(*[(np.arange(n) + 0.5) / n for n in SHAPE], indexing="ij")
    file = tmp_path / "grid.vol"
    write_grid(file, x + y + z, (-1.0, 0.0, 2.0, 1.0, 3.0, 4.0) if use_grid_bbox else (0.0, 0.0, 0.0, 1.0, 1.0, 1.0))
    volume = {
        "type": "gridvolume",
        "filename": str(file),
        "raw": True,
        "to_world": PLACES[place](),
        "use_grid_bbox": use_grid_bbox,
        "accel": False,  # a GPU's texture units interpolate with 8 bits
    }
    fog = {"type": "heterogeneous", "sigma_t": volume, "albedo": 0.5}
    description = {
        "type": "scene",
        "shared": fog,
        "camera": {"type": "perspective", "medium": {"type": "ref", "id": "shared"}},
        "first": {"type": "cube", "interior": {"type": "homogeneous"}, "exterior": {"type": "ref", "id": "shared"}},
        "second": {"type": "sphere", "exterior": dict(fog)},
        "third": {"type": "sphere", "exterior": {**fog, "sigma_t": {**volume, "to_world": PLACES["mirrored"]()}}},
    }  # fmt: skip
    if form == "XML":
        state = mi.parser.parse_dict(mi.parser.ParserConfig(mi.variant()), description)
        mi.parser.write_file(state, str(tmp_path / "scene.xml"))
    given = tmp_path / "scene.xml" if form == "XML" else description
    how = {"parallel": False, "optimize": False}
    scene = mi.load_file(str(given), **how) if form == "XML" else mi.load_dict(description, **how)
    media = dict(attached_media(scene))
    found = extinction_transforms(given)
    without = set(media) - set(found)
    assert without == {("" if form == "XML" else "first", "interior", 0)}  # Mitsuba writes no ids
    assert len(found) == 4
    inside = np.random.default_rng(0).uniform(0.1, 0.9, (3, 100))
    for key, matrix in found.items():
        to_local = majorant_supergrid.to_local(mi.traverse(media[key]).properties["sigma_t.data"][2], matrix)
        assert to_local is not None
        where = np.linalg.solve(to_local[:, :3], inside - to_local[:, 3:])
        np.testing.assert_allclose(extinction(media[key], where)[0], inside.sum(axis=0), rtol=1e-4)


def test_a_transform_that_is_not_the_volumes_is_refused() -> None:
    cloud = medium("turned")
    assert majorant_supergrid.to_local(volume(cloud), transform("cube")) is None
    assert majorant_supergrid.to_local(volume(cloud), transform("turned")) is not None


@pytest.mark.slow
def test_a_grid_that_changes_its_resolution_has_new_cells() -> None:
    fine, coarse, small = (
        ur.gallery.problem("smoke", resolution=8, grid_resolution=size, reference_spp=1) for size in (32, 16, 8)
    )
    truth = {key: fine.renderer.array(value) for key, value in fine.truth.items()}
    request = SampleRequest(0, 4, 1)
    session = fine.renderer.prepare(list(truth), None)
    expected = np.array(session.image(truth, request).images[0])
    for problem in (coarse, small):
        before = problem.initial()
        session = problem.renderer.prepare(list(before), None)
        first = np.array(session.image(before, request).images[0])
        np.testing.assert_allclose(np.array(session.image(truth, request).images[0]), expected, rtol=1e-4)
        np.testing.assert_allclose(np.array(session.image(before, request).images[0]), first, rtol=1e-4)
