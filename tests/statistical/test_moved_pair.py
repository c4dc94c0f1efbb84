# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false

"""Pairs of states whose meshes move: both images against separate renders, derivatives by replay, what related paths are worth."""

from __future__ import annotations

from functools import cache
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from zscores import agree

from unrender.gallery import meshes
from unrender.rendering.mitsuba.integrators.moved_pair import MovedPair
from unrender.rendering.mitsuba.integrators.moved_vertices import BoundingEllipsoids, bounding_ellipsoids
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.mitsuba.session import MitsubaSession
from unrender.rendering.renderer import SampleRequest, Space

VERTICES, SCALE, DEPTH = "ball.vertex_positions", "ball.scale", 4
RUNS, SPP = 32, 32
CLAY = {"type": "twosided", "b": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.6, 0.5]}}}

pytestmark = pytest.mark.slow


def room(fineness: int = 1, **more: Any) -> dict[str, Any]:
    """The Cornell box with a ball of triangles in place of its boxes."""
    points, faces = meshes.icosphere(fineness)
    found = {key: value for key, value in mi.cornell_box().items() if not key.endswith("-box") and key != "integrator"}
    found["sensor"]["film"] = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    return {**found, "ball": meshes.triangles("ball", np.array([0.0, -0.3, 0.0]) + 0.5 * points, faces, CLAY), **more}


@cache
def renderer(key: str, fineness: int = 1) -> MitsubaRenderer:
    return MitsubaRenderer(lambda: room(fineness), DEPTH, [key])


def states(of: MitsubaRenderer, key: str, step: float) -> tuple[Any, Any]:
    """Two, of which the current one is so far off."""
    before = of.values([key])
    value = np.array(before[key])
    shift = step if key == SCALE else step * np.sin(7.0 * np.roll(value.reshape(-1, 3), 1, 1)).reshape(value.shape)
    return {key: of.array(value + shift)}, before


def pair(
    of: MitsubaRenderer, key: str, step: float, space: Space, runs: int, spp: int
) -> tuple[np.ndarray, np.ndarray]:
    session = of.prepare([key], space)
    rendering = session.image_pair(*states(of, key, step), SampleRequest(0, runs * spp, 1, runs), space)
    return np.array(rendering.images, float), np.array(rendering.previous, float)


def alone(of: MitsubaRenderer, key: str, step: float, previous: bool, seed: int) -> np.ndarray:
    session = of.prepare([key], "path")
    rendering = session.image(states(of, key, step)[previous], SampleRequest(0, RUNS * SPP, seed, RUNS))
    return np.array(rendering.images, float)


def test_both_images_agree_with_separate_renders_and_a_planted_fault_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scale halves the areas of all triangles: a density that leaves that out is wrong."""
    of = renderer(SCALE)
    now, before = pair(of, SCALE, 0.4, "path", RUNS, SPP)
    # The current paths are those of `prb`, so that its adjoint replays them.
    np.testing.assert_array_equal(now, alone(of, SCALE, 0.4, previous=False, seed=1))
    apart = alone(of, SCALE, 0.4, previous=True, seed=2)
    assert agree(before, apart, size=4)
    blind = MitsubaRenderer(room, DEPTH, [SCALE])
    session = blind.prepare([SCALE], "path")
    monkeypatch.setattr(session, "_moved_kernel", MovedPair(DEPTH, areas=False))
    _, wrong = pair(blind, SCALE, 0.4, "path", RUNS, SPP)
    assert not agree(wrong, apart, size=4), "areas left out of the density went unseen"


def test_other_materials_agree() -> None:
    """Walls of rough metal, a floor of plastic, a mirror."""
    kinds = {
        "back": {"type": "roughconductor", "alpha": 0.2},
        "floor": {"type": "plastic"},
        "red-wall": {"type": "conductor"},
    }
    walls = {name: {**room()[name], "bsdf": bsdf} for name, bsdf in kinds.items()}
    of = MitsubaRenderer(lambda: room(**walls), DEPTH, [VERTICES])
    _, before = pair(of, VERTICES, 0.1, "path", RUNS, SPP)
    assert agree(before, alone(of, VERTICES, 0.1, previous=True, seed=2), size=4)


def crowded(tracer: MovedPair, sky: bool = False) -> tuple[Any, Any, Any]:
    """The room with a small ball, between a shelf that shadows it and the floor that it shadows, and a mirror: its session, and two
    states .15 apart."""
    points, faces = meshes.icosphere(1)
    shelf = mi.ScalarTransform4f().translate([0.35, 0.35, 0.1]).rotate([1, 0, 0], 90).scale(0.35)

    def scene() -> dict[str, Any]:
        more: dict[str, Any] = {"sky": {"type": "constant", "radiance": 0.3}} if sky else {}
        return room() | more | {
            "ball": meshes.triangles("ball", np.array([0.1, -0.2, 0.1]) + 0.25 * points, faces, CLAY),
            "shelf": {"type": "rectangle", "to_world": shelf, "bsdf": CLAY},
            "glass": meshes.triangles("glass", np.array([-0.55, -0.6, 0.2]) + 0.3 * points, faces, {"type": "conductor"}),
        }  # fmt: skip

    of = MitsubaRenderer(scene, DEPTH, [VERTICES])
    session, before = of.prepare([VERTICES], "path"), of.values([VERTICES])
    assert isinstance(session, MitsubaSession)
    session._moved_kernel = tracer
    return session, {VERTICES: of.array(np.array(before[VERTICES]) + 0.15)}, before


@pytest.mark.parametrize("sky", [False, True])
def test_rays_that_both_states_share_change_nothing(sky: bool) -> None:
    """Where something that moves shadows what stands still and is shadowed by it: sample for sample, up to rounding."""
    found = []
    for shared in (True, False):
        session, now, before = crowded(MovedPair(DEPTH, shared=shared), sky)
        rendering = session.image_pair(now, before, SampleRequest(0, RUNS, 1, RUNS), "path")
        found.append([np.array(images, float) for images in (rendering.images, rendering.previous)])
    np.testing.assert_array_equal(found[0][0], found[1][0])
    differ = np.abs(found[0][1] - found[1][1]) > 1e-3 * (1 + found[1][1])
    assert differ.mean() < 1e-3, differ.mean()


def test_moving_shadows_agree_and_bounds_that_miss_what_moves_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    session, now, before = crowded(MovedPair(DEPTH))
    request, other = SampleRequest(0, RUNS * SPP, 1, RUNS), SampleRequest(0, RUNS * SPP, 2, RUNS)
    apart = np.array(session.image(before, other).images, float)
    assert agree(np.array(session.image_pair(now, before, request, "path").previous, float), apart, size=4)
    monkeypatch.setattr(BoundingEllipsoids, "meet", lambda self, ray, t: t < 0)
    session._moved_kernel = MovedPair(DEPTH)
    wrong = np.array(session.image_pair(now, before, request, "path").previous, float)
    assert not agree(wrong, apart, size=4), "rays that what moves is in the way of went unseen"


def test_segments_that_meet_what_is_bounded_meet_its_ellipsoid() -> None:
    """Through points of triangles of flat, thin and round clouds, near and far; and not those that end before, or pass by."""
    generator = np.random.default_rng(0)
    cloud = generator.normal(size=(40, 3)) * [[1.0, 0.5, 0.0]] + [[3.0, 0.0, -2.0]]
    bounds = BoundingEllipsoids(bounding_ellipsoids([[mi.Float(cloud.ravel())], [mi.Float(cloud.ravel() + 100)]]))
    corners = cloud[generator.integers(40, size=(1000, 3))]
    through = np.einsum("nk,nkd->nd", generator.dirichlet(np.ones(3), 1000), corners)
    d = generator.normal(size=(1000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    far = 10.0 ** generator.uniform(-1, 3, size=(1000, 1))
    rays = mi.Ray3f(mi.Point3f((through - far * d).T), mi.Vector3f(d.T))
    assert np.all(bounds.meet(rays, mi.Float(far[:, 0] * 1.00001)))
    assert not np.any(np.array(bounds.meet(rays, mi.Float(far[:, 0] - 8)))[far[:, 0] > 9])
    aside = mi.Ray3f(mi.Point3f(3, 0, 0), mi.Vector3f(0.6, 0.8, 0))
    assert not np.any(bounds.meet(aside, mi.Float(np.inf)))


def test_carried_paths_differ_less_than_those_of_equal_random_numbers() -> None:
    """Geometric mean over pixels of Var[F - H] / Var F, small triangles; it falls nearly with the step's square."""
    of, found = renderer(VERTICES, 4), {}
    for space in ("primary", "path"):
        for step in (0.01, 0.0025):
            now, before = pair(of, VERTICES, step, space, 128, 1)
            ratio = (now - before).var(axis=0) / np.maximum(now.var(axis=0), 1e-12)
            found[space, step] = np.exp(np.log(np.maximum(ratio, 1e-7)).mean())
    assert found["path", 0.01] < 0.6 * found["primary", 0.01], found
    assert found["path", 0.0025] < 0.15 * found["path", 0.01], found


def test_adjoints_of_both_states_are_those_of_separate_renders() -> None:
    of = renderer(VERTICES)
    current, previous = states(of, VERTICES, 0.05)
    session, request = of.prepare([VERTICES], "path"), SampleRequest(0, 8, 1, 2)
    weights = of.array(np.random.default_rng(0).random((2, 16, 16, 3)))
    rendering = session.image_pair(current, previous, request, "path")
    both = session.adjoint_pair(current, previous, rendering.paths, weights, weights)
    for state, gradient in zip((current, previous), both, strict=True):
        single = session.adjoint(state, session.image(state, request).paths, weights)
        a, b = np.array(gradient[VERTICES]), np.array(single[VERTICES])
        assert np.abs(a - b).max() < 1e-4 * np.abs(b).max()
