# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false

"""Path gradients of shapes as a user asks for them: what is refused, mini-batches, broken meshes, recovery by large steps."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from kernels import on_device, recorded
from tiers import quick
from unrender.core.random import Key
from unrender.gallery import meshes
from unrender.methods.base import method
from unrender.rendering.mitsuba import geometry_notices
from unrender.rendering.mitsuba.edges import edges_of
from unrender.rendering.mitsuba.film import views_of
from unrender.rendering.mitsuba.geometry_terms import BoundaryTerm
from unrender.rendering.mitsuba.integrators.boundary_paths import Picture
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.mitsuba.session import MitsubaSession
from unrender.rendering.renderer import SampleRequest

SIZE = 16
KEY = "thing.vertex_positions"


def scene(faces: np.ndarray | None = None, **more: Any) -> dict[str, Any]:
    points, whole = meshes.icosphere(1)
    thing = meshes.triangles("thing", 0.4 * points, whole if faces is None else faces, {"type": "diffuse"})
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    place = mi.ScalarTransform4f().look_at([0, 0.5, 3], [0, 0, 0], [0, 1, 0])
    floor = mi.ScalarTransform4f().translate([0, -0.6, 0]).rotate([1, 0, 0], -90).scale(3)
    return {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 30, "to_world": place, "film": film},
        "light": {"type": "directional", "direction": [-0.3, -1, -0.5]},
        "floor": {"type": "rectangle", "to_world": floor},
        "thing": thing,
    } | more


def gradient(description: Any, key: str = KEY, request: SampleRequest | None = None) -> np.ndarray:
    renderer = MitsubaRenderer(description, 2)
    session, values = renderer.prepare([key], None), renderer.values([key])
    rendering = session.image(values, request or SampleRequest(0, 16, 3))
    return np.array(session.adjoint(values, rendering.paths, renderer.array(np.ones(rendering.images.shape)))[key])


def sheet(bsdf: dict[str, Any]) -> dict[str, Any]:
    """A sheet that light passes straight on: the gradient by a block behind it had the wrong sign."""
    return {"type": "rectangle", "bsdf": bsdf}


CUT_OUT = sheet({"type": "mask", "opacity": 0.5, "inner": {"type": "diffuse"}})
CUT_MIRROR = sheet({"type": "mask", "opacity": 0.3, "inner": {"type": "twosided", "inner": {"type": "conductor"}}})
WINDOW = sheet({"type": "thindielectric"})


@pytest.mark.parametrize(
    ("more", "key", "message"),
    [
        ({"camera": {"type": "orthographic"}}, KEY, r"limited to perspective sensors; the scene has none"),
        ({"camera": {"type": "orthographic"}}, "thing.rotation", r"limited to perspective sensors"),
        ({"ball": {"type": "sphere", "radius": 0.1}}, "ball.translation", r"ball is not a mesh \(Sphere\)"),
        ({"camera": {"type": "orthographic"}}, "camera.translation", "limited to perspective sensors"),
        ({"sheet": CUT_OUT}, KEY, r"opacity masks, .* null surfaces \(sheet\)"),
        ({"sheet": CUT_OUT}, "camera.translation", r"opacity masks, .* null surfaces \(sheet\)"),
        ({"sheet": CUT_MIRROR}, KEY, r"opacity masks, .* null surfaces \(sheet\)"),
        ({"sheet": CUT_MIRROR}, "camera.translation", r"opacity masks, .* null surfaces \(sheet\)"),
        ({"sheet": WINDOW}, KEY, r"thin glass and null surfaces \(sheet\)"),
        ({"sheet": WINDOW}, "thing.translation.x", r"thin glass and null surfaces \(sheet\)"),
        ({"fog": {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}}, KEY, "with media"),
        (
            {"ball": {"type": "sphere", "emitter": {"type": "area"}}},
            "ball.translation",
            r"ball is not a mesh \(Sphere\)",
        ),
    ],
)
def test_what_has_no_boundary_is_refused_in_one_line(more: dict[str, Any], key: str, message: str) -> None:
    renderer = MitsubaRenderer(lambda: scene(**more), 2)
    with pytest.raises(ur.InputError, match=message) as caught:
        renderer.prepare([key], None)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(f"parameter {key}: it cannot be recovered by path gradients, since")


def test_where_there_is_no_boundary_auto_is_smoothed_and_says_why() -> None:
    reference = np.full((SIZE, SIZE, 3), 0.2, np.float32)
    ball = {"type": "sphere", "radius": 0.1}
    for key, why in (("ball.translation", "plateaus"), ("thing.translation", "--method plain has path gradients")):
        unknowns, views = [ur.Parameter(key)], [ur.View(reference)]
        problem = ur.Problem(lambda: scene(ball=ball), unknowns, views, loss=ur.losses.L1(), max_depth=2)
        choice = method("auto").plan(problem)
        assert isinstance(choice.estimator, ur.SmoothedDerivatives)
        assert why in choice.reasons[0]


@pytest.mark.parametrize("broken", quick(["open", "fin", "slivers"], "fin"))
def test_broken_meshes_have_finite_gradients(broken: str) -> None:
    _, faces = meshes.icosphere(1)
    faces = {
        "open": faces[:-7],
        "fin": np.concatenate([faces, [[faces[0, 0], faces[0, 1], 30]]]),
        "slivers": np.concatenate([faces, [[3, 3, 4], [5, 6, 5]]]),
    }[broken]
    found = gradient(lambda: scene(faces))
    assert np.isfinite(found).all()
    assert np.abs(found).max() > 0


def test_auto_smooths_colours_of_vertices_over_the_edges_of_their_mesh() -> None:
    """As (n V,), or given as (V, n); positions are left to `LargeSteps`."""
    colours = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    points, faces = meshes.icosphere(1)
    thing = meshes.triangles("thing", 0.4 * points, faces, colours)
    thing.add_attribute("vertex_color", 3, np.full(3 * len(points), 0.8, np.float32))
    key, start = "thing.vertex_color", np.linspace(0.2, 0.9, 3 * len(points)).reshape(-1, 3)
    problem = ur.Problem(
        scene(thing=thing), [ur.Parameter(key, initial=start)], [ur.View(np.full((SIZE, SIZE, 3), 0.1))], max_depth=2
    )
    np.testing.assert_allclose(problem.initial_values()[key], start.ravel(), rtol=1e-6)
    chosen: Any = method("auto").plan(problem, {})
    assert chosen.optimizer.preconditioned == (key,)
    assert "two states would share" in chosen.reasons[0]  # a mesh that is made already: no control variates
    assert chosen.estimator.image == ur.images.Plain()
    result = ur.optimize(problem, chosen, steps=3, seed=0)
    moved = result.parameters[key] - problem.initial_values()[key]
    assert np.isfinite(moved).all()
    assert (moved != 0).mean() > 0.9  # those behind, too
    positions = ur.Problem(scene(), [ur.Parameter(KEY)], [ur.View(np.zeros((SIZE, SIZE, 3)))], max_depth=2)
    chosen = method("auto").plan(positions, {})
    assert chosen.optimizer.keys == (KEY,)
    assert chosen.optimizer.others.preconditioned == ()


@pytest.mark.slow
def test_slivers_change_nothing() -> None:
    _, faces = meshes.icosphere(1)
    with_slivers = gradient(lambda: scene(np.concatenate([faces, [[3, 3, 4], [5, 6, 5]]])))
    np.testing.assert_allclose(with_slivers, gradient(lambda: scene(faces)), rtol=1e-3, atol=1e-3)


def test_points_are_projected_as_the_sensor_does() -> None:
    """Also where its principal point is beside the middle and its film cropped, as after calibration."""
    described = scene()
    film = {"width": 40, "height": 24, "crop_width": 20, "crop_height": 16, "crop_offset_x": 7, "crop_offset_y": 3}
    described["camera"]["film"] |= film
    described["camera"] |= {"principal_point_offset_x": 0.2, "principal_point_offset_y": -0.1}
    loaded = mi.load_dict(described)
    sensor = loaded.sensors()[0]
    picture = Picture(loaded, sensor, 1)
    points = mi.Point3f(np.random.default_rng(0).uniform(-0.1, 0.1, (3, 8)).astype(np.float32))
    its = dr.zeros(mi.SurfaceInteraction3f, 8)
    its.p = points
    told, _ = sensor.sample_direction(its, mi.Point2f(0.5))
    uv, depth = picture.project(points)
    assert (np.array(told.pdf) > 0).any()
    inside = np.array(told.pdf) > 0
    np.testing.assert_allclose((np.array(uv) * [[20], [16]])[:, inside], np.array(told.uv)[:, inside], atol=1e-3)
    assert (np.array(depth) > 0).all()
    moved = points + mi.Point3f(1e-3, -2e-3, 1e-3)
    motion = np.array(picture.project_motion(points, uv, mi.Vector3f(1e-3, -2e-3, 1e-3)))
    np.testing.assert_allclose(motion, np.array(picture.project(moved)[0]) - np.array(uv), rtol=0.02, atol=1e-6)


@pytest.mark.slow
def test_a_mini_batch_of_all_pixels_is_the_whole_view() -> None:
    """The boundary's numbers are the same where pixels are drawn: the same gradient, but for the order of sums."""
    every = SampleRequest(0, 16, 3, pixels=mi.UInt32(np.arange(SIZE * SIZE)))
    whole, batch = gradient(scene), gradient(scene, request=every)
    np.testing.assert_allclose(batch, whole, rtol=1e-3, atol=1e-3 * np.abs(whole).max())
    none = gradient(scene, request=SampleRequest(0, 16, 3, pixels=mi.UInt32([0, 1])))
    assert np.abs(none).max() < 0.2 * np.abs(whole).max()


@pytest.mark.slow
def test_moments_of_pixels_have_the_boundary_term() -> None:
    """The boundary's image of derivatives along a tangent, weighted, is its gradient along that: forward and backward mode on the same
    samples. Its square is what a moment has more than path replay tells."""
    renderer = MitsubaRenderer(scene, 2)
    session, values = renderer.prepare([KEY], None), renderer.values([KEY])
    assert isinstance(session, MitsubaSession)
    random = np.random.default_rng(0)
    weights, tangent = random.normal(size=(SIZE, SIZE, 3)), random.normal(size=np.array(values[KEY]).shape)
    pixels = random.permutation(SIZE * SIZE)[:100]
    request = SampleRequest(0, 16, 3, 2)
    term, loaded = session._boundary, session._pair.loaded()
    assert term is not None
    session.image(values, request)
    session._pair.clear_gradients()
    term.accumulate(loaded, request, renderer.array(np.stack([weights, weights])))
    gradient = np.array(loaded.take_gradients()[KEY])
    tangents = {KEY: renderer.array(tangent)}
    loaded.set_tangents(values, tangents, frozenset(values))
    nothing = mi.TensorXf(np.zeros((1, SIZE, SIZE, 3), np.float32))
    (view,) = views_of(request, nothing, session._pair.resolutions)
    sensor, seed, samples = term._samples(loaded, request, view)
    image = np.array(term._integrator.tangent_image(loaded.scene, sensor, seed, samples))
    np.testing.assert_allclose((image * weights).sum(), (gradient * tangent).sum(), rtol=1e-3)
    assert (image**2).sum() > 0
    for asked in (request, SampleRequest(0, 16, 3, 2, pixels=mi.UInt32(pixels.astype(np.uint32)))):
        paths = session.image(values, asked).paths
        whole = np.array(session.tangent_moment(values, paths, tangents))
        more = np.array(term.tangent_moment(loaded, asked)).reshape(whole.shape[1:])
        session._boundary = None
        replayed = np.array(session.tangent_moment(values, paths, tangents))
        session._boundary = term
        np.testing.assert_allclose(whole, replayed + more, rtol=1e-3, atol=1e-6)
        assert more.sum() > 0
    np.testing.assert_allclose(
        np.array(term.tangent_moment(loaded, request)).reshape(-1, 3), image.reshape(-1, 3) ** 2, rtol=1e-3, atol=1e-6
    )


@pytest.mark.slow
def test_adaptive_mini_batches_find_the_silhouettes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a black body all that moves is its outline and its shadow, which path replay knows nothing of."""
    points, faces = meshes.icosphere(1)
    black = meshes.triangles("thing", 0.4 * points, faces, {"type": "diffuse", "reflectance": 0.0})
    reference = np.zeros((SIZE, SIZE, 3), np.float32)
    problem = ur.Problem(lambda: scene(thing=black), [ur.Parameter(KEY)], [ur.View(reference)], max_depth=2)
    start, learning, repetitions = problem.initial(), 1, 24

    def variance(sampler: Any) -> float:
        estimator = ur.PathGradient(ur.images.Plain(), sampler, spp=2)
        state, found = estimator.init(problem, start), []
        for step in range(learning + repetitions):
            estimate, after = estimator.estimate(problem, start, state, Key(0, step))
            if step < learning:
                state = after
            else:
                found.append(np.array(estimate.gradient[KEY], float))
        return float(np.var(found, axis=0, ddof=1).sum())

    sampler = ur.pixels.Adaptive(64, samples=1024, uniform=0.1, denoiser="pooling")
    uniform, adaptive = variance(ur.pixels.Uniform(64)), variance(sampler)
    assert adaptive < 0.7 * uniform
    monkeypatch.setattr(
        BoundaryTerm,
        "tangent_moment",
        lambda self, scene, request, combined: mi.TensorXf(dr.zeros(mi.Float, 3 * dr.width(request.pixels))),
    )
    assert variance(sampler) > 0.7 * uniform


@pytest.mark.slow
def test_steps_compile_nothing_new() -> None:
    renderer = MitsubaRenderer(scene, 3)
    session = renderer.prepare([KEY], None)
    start, weights = np.array(renderer.values([KEY])[KEY]), renderer.array(np.ones((1, SIZE, SIZE, 3)))
    for step in range(5):
        values = {KEY: on_device(start * (1 + 0.01 * step))}
        with recorded() as found:
            session.adjoint(values, session.image(values, SampleRequest(0, 4, step)).paths, weights)
        if step >= 3:
            assert not any(found), f"{sum(found)} new kernels at step {step}"


@pytest.mark.slow
def test_estimators_follow_one_another_on_a_rectangle() -> None:
    """The tangents of adaptive pixels must not meet what control variates have left attached in the previous scene."""
    reference = np.full((SIZE, SIZE, 3), 0.2, np.float32)
    problem = ur.Problem(scene, [ur.Parameter("floor.translation.y")], [ur.View(reference)], max_depth=2)
    image = ur.images.RecursiveControlVariate(space="primary")
    for estimator in (ur.PathGradient(image, spp=4), ur.PathGradient(pixels=ur.pixels.Adaptive(64), spp=4)):
        assert ur.optimize(problem, estimator, ur.optimizers.Adam(1e-3), steps=2).skipped == 0


@pytest.mark.slow
def test_a_sphere_becomes_the_body_by_large_steps() -> None:
    """And not without the borders of what is visible."""
    options = {"resolution": 24, "views": 3, "subdivisions": 2, "reference_spp": 64, "strength": 10}
    problem = ur.gallery.problem("sphere-to-mesh", **options)
    result = ur.optimize(problem, ur.PathGradient(spp=8), ur.optimizers.Adam(0.03, uniform=True), steps=25)
    assert result.history[-1]["loss"] < 0.5 * result.history[0]["loss"]
    assert result.skipped == 0


def test_a_mesh_that_touches_or_crosses_another_shape_is_told_once() -> None:
    def lines(height: float, **more: Any) -> list[str]:
        floor = mi.ScalarTransform4f().translate([0, height, 0]).rotate([1, 0, 0], -90).scale(3)
        described = scene(**more)
        described["floor"]["to_world"] = floor
        return [line for line in MitsubaRenderer(described, 2, [KEY]).notices if "touches" in line]

    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij")).reshape(3, -1).T * 0.3
    sides = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]]
    block = {"thing": meshes.triangles("thing", corners, np.array(sides), {"type": "diffuse"})}
    assert lines(-0.6) == lines(-0.6, **block) == []
    assert len(lines(-0.35)) == 1  # the sphere reaches through the floor
    assert lines(-0.3, **block) == [  # the block stands on it
        "thing touches or crosses floor, where path gradients of its vertices are noisy and may be biased: leave a gap between them"
    ]
    diamond = 0.3 * np.concatenate([np.eye(3), -np.eye(3)])
    around = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    stands = {"thing": meshes.triangles("thing", diamond, np.array(around), {"type": "diffuse"})}
    assert lines(-0.3, **stands) == []  # one point of it rests on the floor
    assert not [line for line in MitsubaRenderer(scene(), 2, ["thing.translation"]).notices if "touches" in line]


def test_contact_is_looked_for_only_where_the_box_of_another_shape_meets_that_of_the_mesh(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    searched: list[Any] = []

    def edges(mesh: Any, positions: Any) -> Any:
        searched.append(mesh.id())
        return edges_of(mesh, positions)

    monkeypatch.setattr(geometry_notices, "edges_of", edges)
    for height, expected in ((-0.6, []), (-0.35, ["thing"])):
        described = scene()
        described["floor"]["to_world"] = mi.ScalarTransform4f().translate([0, height, 0]).rotate([1, 0, 0], -90)
        geometry_notices.contact_notices(mi.load_dict(described), [KEY])
        assert searched == expected


def test_a_mesh_that_views_show_in_mirrors_or_through_smooth_glass_is_told() -> None:
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    meter = {"type": "sphere", "center": [5, 0, 0], "sensor": {"type": "irradiancemeter", "film": film}}

    def lines(bsdf: dict[str, Any], place: Any, **more: Any) -> list[str]:
        pane = {"type": "rectangle", "to_world": place, "bsdf": bsdf}
        return [line for line in MitsubaRenderer(scene(pane=pane, **more), 6, [KEY]).notices if "mirrors" in line]

    before = mi.ScalarTransform4f().translate([0, 0.2, 1])
    below = mi.ScalarTransform4f().translate([0, -0.5, 0]).rotate([1, 0, 0], -90)
    assert lines({"type": "dielectric"}, before)[0].startswith(
        "views show 100% of thing in mirrors or through smooth glass, where"
    )
    assert len(lines({"type": "conductor"}, below, meter=meter)) == 1
    assert lines({"type": "roughconductor"}, below) == lines({"type": "diffuse"}, below) == []
    assert lines({"type": "conductor"}, below.translate([9, 0, 0])) == []  # out of sight


def test_a_seam_of_the_sphere_that_is_equal_up_to_rounding_has_no_border() -> None:
    u, v = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 5)))
    turn, tilt = 2 * np.pi * u, np.pi * v
    points = np.stack([np.sin(tilt) * np.cos(turn), np.cos(tilt), -np.sin(tilt) * np.sin(turn)], -1)
    corner = (np.arange(4)[:, None] * 9 + np.arange(8)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 9, corner + 1], -1), np.stack([corner + 1, corner + 9, corner + 10], -1)]
    )
    mesh = meshes.triangles("thing", points, faces, {"type": "diffuse"}, np.stack([u, v], -1))
    edges = edges_of(mesh, None)
    assert len(edges.always) == 72  # of 26 vertices and 48 faces
    assert not edges.always.any()


def test_a_mesh_whose_texture_has_jumps_is_told() -> None:
    def lines(**texture: Any) -> list[str]:
        points, faces = meshes.icosphere(1)
        material = {"type": "twosided", "inner": {"type": "diffuse", "reflectance": texture}}
        thing = meshes.triangles("thing", 0.4 * points, faces, material, np.abs(points[:, :2]))
        return [line for line in MitsubaRenderer(scene(thing=thing), 2, [KEY]).notices if "jumps" in line]

    colours = np.random.default_rng(0).uniform(0, 1, (8, 8, 3)).astype(np.float32)
    bitmap = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(colours)}
    assert lines(**bitmap) == lines(**bitmap, wrap_mode="mirror") == lines(type="rgb", value=0.5) == []
    grey = mi.Bitmap(np.full((5, 7, 3), 0.37, np.float32))
    assert (
        lines(**bitmap | {"bitmap": grey, "to_uv": mi.ScalarTransform4f().scale(3.1)}) == []
    )  # it differs by rounding
    assert len(lines(**bitmap, filter_type="nearest")) == len(lines(type="checkerboard")) == 1


def test_shadows_of_spheres_on_a_mesh_with_unknown_vertices_are_told() -> None:
    def lines(centre: list[float], kind: str = "sphere") -> list[str]:
        place = mi.ScalarTransform4f().translate(centre).scale(0.2)
        ball = {"type": kind, "to_world": place, "bsdf": {"type": "diffuse"}}
        return [line for line in MitsubaRenderer(scene(ball=ball), 2, [KEY]).notices if "shadow" in line]

    assert lines([0.2, 0.9, 0.4]) == [
        "ball: path gradients omit the motion of its shadow on thing, because it is not a mesh: load it as a mesh"
    ]
    assert lines([0.2, 0.9, 0.4], "cube") == lines([1.5, 0.9, 0.4]) == []  # a mesh, and beside the light


def test_fog_and_a_distant_mirror_are_no_shadow_and_no_reflection() -> None:
    """Null surfaces let rays pass: a fog sphere was said to cast a shadow, and a mirror out of sight to show a mesh within fog."""
    fog = {"type": "homogeneous", "sigma_t": 0.3, "albedo": 0.5}
    place = mi.ScalarTransform4f().translate([0.2, 0.9, 0.4]).scale(0.2)
    cloud = {"type": "sphere", "to_world": place, "bsdf": {"type": "null"}, "interior": fog}
    away = mi.ScalarTransform4f().translate([50.0, 50.0, 50.0])
    mirror = {"type": "rectangle", "to_world": away, "bsdf": {"type": "conductor"}}
    around = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.7), "bsdf": {"type": "null"}, "interior": fog}
    notices = MitsubaRenderer(scene(cloud=cloud, mirror=mirror, around=around), 2, [KEY]).notices
    assert not [line for line in notices if "shadow" in line or "mirrors" in line]
