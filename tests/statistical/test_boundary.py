# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

"""Path gradients of moving meshes, boundaries included, against finite differences of renders with the geometry moved."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tiers import quick
from unrender.core.errors import InputError
from unrender.gallery import meshes
from unrender.rendering.mitsuba.integrators.boundary_sampling import EmitterPoints
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

SIZE, RUNS, STEP = 20, 8, 0.01
LIMIT = 4.5
"""Of a score with the noise measured in 8 runs each: one in 2000 or so."""


def weights() -> np.ndarray:
    """Of the pixels: different everywhere, so that no motion cancels."""
    noise = np.random.default_rng(0).uniform(0.5, 1.5, (SIZE, SIZE, 3))
    return noise * np.linspace(0, 1, SIZE)[None, :, None] * np.linspace(1, 0.2, SIZE)[:, None, None]


def room(**more: Any) -> dict[str, Any]:
    """A Cornell box with other things in it."""
    described = mi.cornell_box()
    del described["small-box"], described["large-box"]
    described["sensor"]["film"] = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    return described | more


def block() -> dict[str, Any]:
    place = mi.ScalarTransform4f().translate([0.1, -0.4, 0.1]).rotate([1, 1, 0], 40).scale(0.25)
    return room(moving={"type": "cube", "to_world": place, "bsdf": {"type": "diffuse"}})


def off_centre() -> dict[str, Any]:
    """A principal point beside the middle, as calibrated cameras have, and a cropped film."""
    described = block()
    film = {"width": SIZE + 8, "height": SIZE + 4, "crop_width": SIZE, "crop_height": SIZE}
    described["sensor"] |= {"principal_point_offset_x": 0.12, "principal_point_offset_y": -0.08}
    described["sensor"]["film"] |= {**film, "crop_offset_x": 3, "crop_offset_y": 2}
    return described


def screened() -> dict[str, Any]:
    """A sheet before the near clipping plane, which nobody sees, hides half of the block from the camera itself."""
    described = block()
    sheet = mi.ScalarTransform4f().translate([0.25, 0, 3.4]).scale([0.25, 0.5, 1])
    described["sensor"]["near_clip"] = 1.0
    return described | {"sheet": {"type": "rectangle", "to_world": sheet, "bsdf": {"type": "diffuse"}}}


def receiver() -> dict[str, Any]:
    """What moves receives the shadow of a ball that stands still, and casts one."""
    place = mi.ScalarTransform4f().translate([0.0, -0.6, 0.3]).rotate([1, 0, 0], -90).scale(0.5)
    plate = {"type": "rectangle", "to_world": place, "bsdf": {"type": "twosided", "inner": {"type": "diffuse"}}}
    points, faces = meshes.icosphere(3)
    ball = meshes.triangles("ball", 0.25 * points + np.array([0, -0.1, 0.2]), faces, {"type": "diffuse"})
    return room(moving=plate, ball=ball)


def smooth() -> dict[str, Any]:
    """A smooth ball between a sun, a lamp at a point, and open air: a delta emitter's shadow has a border, too."""
    points, faces = meshes.icosphere(4)
    ball = meshes.triangles("moving", 0.3 * points + np.array([0, -0.3, 0.1]), faces, {"type": "diffuse"})
    described = room(
        moving=ball,
        sun={"type": "directional", "direction": [-0.5, -1, -0.3], "irradiance": {"type": "rgb", "value": 3.0}},
        lamp={"type": "point", "position": [0.5, 0.9, 0.5], "intensity": {"type": "rgb", "value": 0.5}},
    )
    for name in ("light", "ceiling", "red-wall", "back"):
        del described[name]
    return described


def beside(**bsdf: Any) -> Callable[[], dict[str, Any]]:
    """The block above a floor, and before a wall, of another material, which show it again."""

    def described() -> dict[str, Any]:
        found = block()
        for name in ("floor", "back"):
            found[name]["bsdf"] = bsdf
        return found

    return described


def sky() -> dict[str, Any]:
    """The block above a floor, out of doors."""
    found = block()
    for name in ("light", "ceiling", "red-wall", "green-wall", "back"):
        del found[name]
    y, x = np.mgrid[:8, :16].astype(np.float32)
    light = np.stack([1 + np.sin(x / 3), 1.5 + 0 * x, 2 - y / 8], axis=-1).astype(np.float32)
    return found | {"sky": {"type": "envmap", "bitmap": mi.Bitmap(light)}}


def lamps() -> dict[str, Any]:
    """The block out of doors between two square lamps, which have one normal each, under a sky and a sun."""
    place = mi.ScalarTransform4f().look_at([0.7, 0.9, -0.5], [0.1, -0.4, 0.1], [0, 1, 0]).scale(0.2)
    other = mi.ScalarTransform4f().look_at([-0.6, 0.9, -0.4], [0.1, -0.4, 0.1], [0, 1, 0]).scale(0.15)
    shine = {"type": "area", "radiance": {"type": "rgb", "value": 60.0}}
    return sky() | {
        "lamp": {"type": "rectangle", "to_world": place, "emitter": shine},
        "other-lamp": {"type": "rectangle", "to_world": other, "emitter": shine},
        "sun": {"type": "directional", "direction": [-0.5, -1, -0.3], "irradiance": {"type": "rgb", "value": 1.0}},
    }


def shining(kind: str = "rectangle", radiance: Any = 6.0, tilt: float = 25.0) -> Callable[[], dict[str, Any]]:
    """A lamp that moves, in sight unless its tilt is 90°, above a block that throws a shadow."""

    def described() -> dict[str, Any]:
        place = mi.ScalarTransform4f().translate([0.4, 0.5, 0.2]).rotate([1, 0.1, 0], tilt).scale(0.22)
        emitter = {"type": "area", "radiance": radiance() if callable(radiance) else {"type": "rgb", "value": radiance}}
        bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
        found = block() | {"moving": {"type": kind, "to_world": place, "bsdf": bsdf, "emitter": emitter}}
        del found["light"]
        return found | {"block": block()["moving"]}

    return described


def patches() -> dict[str, Any]:
    values = np.random.default_rng(0).uniform(0.5, 6.0, (4, 4, 3)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}


def gradients(
    description: Any, key: str, depth: int, spp: int, boundary: bool = True, lit: bool | None = None
) -> np.ndarray:
    """(RUNS, n)."""
    renderer = MitsubaRenderer(description, depth, [key])
    session: Any = renderer.prepare([key], None)
    if lit is not None:
        session._boundary._integrator._table.lit = lit
    if not boundary:
        session._boundary = None
    values, weight = renderer.values([key]), renderer.array(weights()[None])
    found = []
    for run in range(RUNS):
        paths = session.image(values, SampleRequest(0, spp, run, groups=1)).paths
        found.append(np.array(session.adjoint(values, paths, weight)[key]).reshape(-1))
    return np.stack(found).astype(float)


def differences(
    description: Any, key: str, depth: int, spp: int, step: float = STEP, directions: np.ndarray | None = None
) -> np.ndarray:
    """(RUNS, n), central, with the same random numbers on both sides; along directions (n, size), or each element's."""
    renderer = MitsubaRenderer(description, depth)
    session = renderer.prepare([key], None, derivatives=False)
    loaded = np.array(renderer.values([key])[key])
    steps = (np.eye(max(loaded.size, 1)) if directions is None else directions) * step
    states = np.concatenate([loaded + steps.reshape(-1, *loaded.shape), loaded - steps.reshape(-1, *loaded.shape)])
    found = []
    for run in range(RUNS):
        images = np.array(session.image_batch({key: states}, SampleRequest(0, spp, 500 + run))).astype(float)
        sums = (images * weights()).sum(axis=(1, 2, 3))
        found.append((sums[: len(steps)] - sums[len(steps) :]) / (2 * step))
    return np.stack(found)


def samples_of(description: Any) -> tuple[int, int]:
    """Samples per pixel of gradients and of differences. With fewer, noise would hide a lamp's missing part."""
    moving = description()["moving"]
    return (96, 1024) if isinstance(moving, dict) and "emitter" in moving else (48, 256)


def scores(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    error = np.sqrt(a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b))
    return (a.mean(axis=0) - b.mean(axis=0)) / error


def test_the_pose_of_a_block_and_its_planted_faults() -> None:
    """Without the boundary, or with six tenths of it, the test fails."""
    expected = differences(block, "moving.translation.z", 2, 1024)
    found = gradients(block, "moving.translation.z", 2, 48)
    interior = gradients(block, "moving.translation.z", 2, 48, boundary=False)
    assert np.abs(scores(found, expected)).max() < LIMIT
    assert np.abs(scores(interior, expected)).max() > 8
    assert np.abs(scores(interior + 0.6 * (found - interior), expected)).max() > LIMIT


@pytest.mark.slow
def test_a_lamp_that_moves_and_planted_faults() -> None:
    """Its picture moves, and the light that it sends to surfaces. Without the second, or with nine tenths of both, the test fails."""
    lamp, key = shining(tilt=70.0), "moving.scale"
    expected, found = differences(lamp, key, 2, 1024, 0.05), gradients(lamp, key, 2, 64)
    assert np.abs(scores(found, expected)).max() < LIMIT
    assert np.abs(scores(gradients(lamp, key, 2, 64, lit=False), expected)).max() > 2 * LIMIT
    assert np.abs(scores(0.9 * found, expected)).max() > LIMIT


def test_points_on_emitters_span_the_solid_angle_that_each_emitter_has() -> None:
    """Of two square lamps above a point, one of them in the distance, and a sky; their points are drawn side by side."""
    half, heights, each = 0.3, (1.0, 2.5), 4096

    def lamp(height: float) -> dict[str, Any]:
        place = mi.ScalarTransform4f().translate([0, height, 0]).rotate([1, 0, 0], 90).scale(half)
        return {"type": "rectangle", "to_world": place, "emitter": {"type": "area"}}

    lamps = {f"lamp_{n}": lamp(height) for n, height in enumerate(heights)}
    scene: Any = mi.load_dict({"type": "scene", **lamps, "sky": {"type": "constant"}}, optimize=False)
    points = EmitterPoints(scene, 3, 3 * each, mi.Float(0))
    which = dr.arange(mi.UInt32, points.count)
    direction, distance = points.seen_from(mi.Point3f(0), which)
    measures = np.array(points.measure(mi.Point3f(0), which, distance, direction)).reshape(3, -1).astype(float)
    sums, errors = measures.sum(axis=1), measures.std(axis=1) * np.sqrt(measures.shape[1])
    squares = [4 * np.arcsin(half**2 / (half**2 + height**2)) for height in heights]  # a pyramid with a square base
    order = np.argsort(sums)
    np.testing.assert_array_less(np.abs(sums[order] - np.sort([*squares, 4 * np.pi])), 4 * errors[order] + 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("description", "key", "depth"),
    [
        (block, "moving.rotation.x", 2),
        (off_centre, "moving.translation.z", 2),
        (screened, "moving.translation.x", 2),
        (block, "moving.scale", 3),
        (block, "moving.translation.y", 4),
        (block, "moving.translation.z", 6),
        (receiver, "moving.translation.y", 2),
        (smooth, "moving.translation.y", 2),
        (beside(type="roughconductor", alpha=0.2), "moving.translation.y", 3),
        (beside(type="roughplastic", alpha=0.1), "moving.rotation.y", 4),
        (beside(type="conductor"), "moving.translation.y", 3),
        (sky, "moving.translation.x", 2),
        (sky, "moving.scale", 3),
        (lamps, "moving.translation.x", 2),
        (lamps, "moving.rotation.y", 3),
        (shining(), "moving.translation", 2),
        (shining(), "moving.rotation.x", 3),
        (shining(), "moving.scale", 5),
        (shining("cube"), "moving.rotation", 2),
        (shining("cube"), "moving.translation.x", 4),
        (shining(radiance=patches), "moving.translation", 2),
        (shining(radiance=patches), "moving.rotation.z", 3),
    ],
)
def test_poses_at_several_depths(description: Any, key: str, depth: int) -> None:
    few, many = samples_of(description)
    found, expected = gradients(description, key, depth, few), differences(description, key, depth, many)
    assert np.abs(scores(found, expected)).max() < LIMIT, (found.mean(axis=0), expected.mean(axis=0))


def waves(positions: np.ndarray) -> np.ndarray:
    """Three ways (3, 3 V) to bend a mesh of positions (3 V,); vertices at one place move as one."""
    place = positions.reshape(-1, 3).astype(float)
    phases = 6 * place.sum(axis=1)[:, None] + np.arange(3)
    return np.stack([np.sin(phases + 2 * n).ravel() for n in range(3)])


@pytest.mark.slow
@pytest.mark.parametrize(("description", "depth"), [(block, 3), (smooth, 2), (sky, 2), (shining("cube"), 3)])
def test_vertices_along_waves(description: Any, depth: int) -> None:
    key = "moving.vertex_positions"
    directions = waves(np.array(MitsubaRenderer(description, depth).values([key])[key]))
    few, many = samples_of(description)
    found = gradients(description, key, depth, few) @ directions.T
    expected = differences(description, key, depth, many, 0.003, directions)
    assert np.abs(scores(found, expected)).max() < LIMIT, (found.mean(axis=0), expected.mean(axis=0))


@pytest.mark.slow
def test_a_planted_fault_of_three_per_cent() -> None:
    """From many samples of the pose that moves most."""
    found = gradients(block, "moving.translation.z", 2, 512)
    expected = differences(block, "moving.translation.z", 2, 8192, 0.02)
    assert np.abs(scores(found, expected)).max() < LIMIT
    assert np.abs(scores(1.03 * found, expected)).max() > LIMIT


@pytest.mark.parametrize("kind", ["conductor", "dielectric", "plastic", "twosided"])
@pytest.mark.parametrize("key", ["moving.translation", "moving.vertex_positions"])
def test_moving_mirrors_and_glass_have_no_path_gradient(kind: str, key: str) -> None:
    """Measured against differences, theirs have even the wrong sign. Perturbed renders support them."""
    bsdf = {"type": kind, "inner": {"type": "conductor"}} if kind == "twosided" else {"type": kind}
    renderer = MitsubaRenderer(lambda: block() | {"moving": {**block()["moving"], "bsdf": bsdf}}, 3)
    with pytest.raises(
        InputError, match=r"directions of a moving perfectly specular lobe .*, or a rough BSDF$"
    ) as caught:
        renderer.prepare([key], None)
    assert str(caught.value).count("--method smoothed") == 1
    assert not renderer.parameters()[key].differentiable
    renderer.prepare([key], None, derivatives=False)
    assert MitsubaRenderer(block, 3).parameters()[key].differentiable


def others() -> dict[str, tuple[dict[str, Any], str]]:
    """{name: (objects beside the moving block, key)} of parameters whose derivatives Mitsuba's `prb` lacks."""
    before = mi.ScalarTransform4f().translate([0.1, -0.2, 0.8]).scale(0.4)
    grey = {"type": "rgb", "value": 0.5}
    mirror = {"type": "twosided", "inner": {"type": "conductor", "specular_reflectance": grey}}
    return {
        "mirror": (
            {"sheet": {"type": "rectangle", "to_world": before, "bsdf": mirror}},
            "sheet.bsdf.brdf_0.specular_reflectance.value",
        ),
        "sky": (sky(), "sky.rotation"),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", quick(("mirror", "sky"), "mirror"))
def test_other_gradients_beside_a_moving_shape_are_those_without_it(name: str) -> None:
    more, key = others()[name]
    found = []
    for keys in ([key], [key, "moving.translation"]):
        renderer = MitsubaRenderer(more if "moving" in more else block() | more, 3, keys)
        session, values = renderer.prepare(keys, None), renderer.values(keys)
        weight = renderer.array(weights()[None])
        runs = [session.image(values, SampleRequest(0, 64, run + 100 * len(keys))).paths for run in range(RUNS)]
        found.append(np.stack([np.array(session.adjoint(values, paths, weight)[key]).reshape(-1) for paths in runs]))
    alone, beside_it = (x.astype(float) for x in found)
    assert np.abs(scores(beside_it, alone)).max() < LIMIT, (beside_it.mean(axis=0), alone.mean(axis=0))
    assert np.abs(scores(0.0 * beside_it, alone)).max() > LIMIT, "a lost derivative went unseen"
