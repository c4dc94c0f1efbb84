"""What Mitsuba's renderer accepts, refuses and keeps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from kernels import recorded
from tiers import quick
from unrender.rendering.mitsuba import mesh_layout
from unrender.rendering.mitsuba.loaded_scene import LoadedScene
from unrender.rendering.mitsuba.parameters import from_tensor, to_tensor
from unrender.rendering.mitsuba.path_cache.session import CachingSession
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest, Space


def box(**more: Any) -> dict[str, Any]:
    """Mitsuba's Cornell box, small, its back wall with a texture."""
    found = mi.cornell_box()
    found["sensor"]["film"].update(width=16, height=16)
    values = np.random.default_rng(0).uniform(0.2, 0.8, (8, 8, 3)).astype(np.float32)
    found["back"]["bsdf"] = {
        "type": "diffuse",
        "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True},
    }
    return {**found, **more}


WALL = "back.bsdf.reflectance.data"


def problem(scene: Any, key: str = WALL, views: int = 1, **options: Any) -> ur.Problem:
    return ur.Problem(scene, [ur.Parameter(key, **options)], [ur.View(np.full((16, 16, 3), 0.3))] * views, max_depth=3)


def test_values_survive_the_way_to_a_tensor_and_back() -> None:
    for value in (
        mi.Float(0.3),
        mi.Color3f(0.1, 0.2, 0.3),
        mi.TensorXf(np.arange(6.0, dtype=np.float32), (1, 2, 3)),
        mi.Float([1, 2]),
    ):
        again = from_tensor(to_tensor(value), value)
        assert type(again) is type(value)
        assert np.array_equal(np.array(again), np.array(value))


@pytest.mark.parametrize(
    ("more", "key", "message"),
    [
        ({}, "sensor.to_world", 'no derivatives'),
        ({}, "light.to_world", "no derivatives"),
        ({}, "small-box.faces", "not differentiable"),
        ({"lens": {"type": "sphere", "bsdf": {"type": "dielectric"}}}, "lens.bsdf.eta", "a plain number, which Mitsuba compiles"),
        ({}, "back.bsdf.reflectanse.data", "did you mean back.bsdf.reflectance.data"),
        (
            {"ball": {"type": "sphere", "b": {"type": "blendbsdf", "weight": 0.5, "a": {"type": "conductor"}, "b": {"type": "diffuse"}}}},
            "ball.bsdf.weight.value",
            "mixes perfectly specular lobes",
        ),
    ],
)  # fmt: skip
def test_what_a_pair_cannot_carry_is_refused_in_one_line(more: dict[str, Any], key: str, message: str) -> None:
    renderer = MitsubaRenderer(box(**more))
    with pytest.raises(ur.InputError, match=message) as caught:
        renderer.prepare([key], "path")
    assert "\n" not in str(caught.value)


def test_a_shape_without_a_name_is_refused_with_the_cure(tmp_path: Path) -> None:
    """Mitsuba names it by its address, which differs between two loads."""
    file = tmp_path / "scene.xml"
    file.write_text('<scene version="3.0.0"><sensor type="perspective"/><shape type="sphere"/></scene>')
    renderer = MitsubaRenderer(file)
    key = next(k for k in renderer.parameters() if k.endswith("reflectance.value"))
    with pytest.raises(ur.InputError, match="no id in the XML"):
        renderer.prepare([key], None)


def test_a_ready_made_object_cannot_be_in_two_states() -> None:
    mesh = mi.load_dict({"type": "cube", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.4}}})
    key = "cube.bsdf.reflectance.value"
    shared = problem(box(cube=mesh), key)
    estimator = ur.PathGradient(ur.images.RecursiveControlVariate(), spp=2)
    with pytest.raises(ur.InputError, match="function that returns the dictionary"):
        ur.optimize(shared, estimator, ur.optimizers.Adam(), steps=1)

    def scene() -> dict[str, Any]:
        return box(cube={"type": "cube", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.4}}})

    assert ur.optimize(problem(scene, key), estimator, ur.optimizers.Adam(), steps=2).steps == 2


def test_states_of_a_batch_set_the_values_that_change(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some BSDFs compute tables when they are set, which took most of the time of Gauss-Newton steps by a `roughplastic`."""
    renderer, keys, request = MitsubaRenderer(box()), [WALL, "light.emitter.radiance.value"], SampleRequest(0, 2, 1)
    wall, light = (renderer.values(keys)[key].numpy() for key in keys)
    states = {keys[0]: np.stack([wall] * 4), keys[1]: np.stack([light, light, 2 * light, light])}
    update, updated = LoadedScene._update, []

    def noted(self: LoadedScene, changed: list[str]) -> None:
        updated.append([*changed])
        update(self, changed)

    monkeypatch.setattr(LoadedScene, "_update", noted)
    images = renderer.prepare(keys, None, derivatives=False).image_batch(states, request).numpy()
    assert updated == [keys, keys[1:], keys[1:]]
    brighter = {keys[0]: states[keys[0]][2:3], keys[1]: states[keys[1]][2:3]}
    alone = renderer.prepare(keys, None, derivatives=False).image_batch(brighter, request).numpy()
    np.testing.assert_array_equal(images, [images[0], images[0], alone[0], images[0]])
    assert (alone[0] > 1.5 * images[0]).any()


@pytest.mark.parametrize("error", [RuntimeError("out of memory"), KeyboardInterrupt()])
def test_values_of_an_update_that_failed_are_set_again(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_: Any) -> None:
        raise error

    states, request = [{WALL: np.full((1, 8, 8, 3), x, np.float32)} for x in (0.2, 0.8)], SampleRequest(0, 2, 1)
    fresh, session = (MitsubaRenderer(box()).prepare([WALL], None, derivatives=False) for _ in range(2))
    expected = fresh.image_batch(states[1], request).numpy()
    session.image_batch(states[0], request)
    with monkeypatch.context() as patched:
        patched.setattr(mi.SceneParameters, "update", fails)
        with pytest.raises(type(error)):
            session.image_batch(states[1], request)
    np.testing.assert_array_equal(session.image_batch(states[1], request).numpy(), expected)


CV = ur.images.RecursiveControlVariate
STEADY: dict[str, tuple[Any, int]] = {
    # estimator, kernels that the thirty steps after the tenth may still add: Dr.Jit orders the inputs of some in several ways
    "plain": (ur.PathGradient(ur.images.Plain(), spp=2), 0),
    "rcv": (ur.PathGradient(CV(), spp=2), 0),
    "meta": (ur.MetaEstimator(), 10),
    "meta, primary space": (ur.MetaEstimator(space="primary"), 10),
    "coupled": (ur.MetaEstimator(coupled=True), 10),
    "coupled, rcv": (ur.MetaEstimator(coupled=True, image=CV()), 10),
}


@pytest.mark.parametrize("name", quick(STEADY, "meta"))
def test_no_kernel_is_compiled_after_warm_up(name: str) -> None:
    estimator, spare = STEADY[name]
    optimizer = ur.optimizers.MetaAdam() if isinstance(estimator, ur.MetaEstimator) else ur.optimizers.Adam()
    asked = problem(box(), initial=0.5)
    launched: list[int] = []
    new: list[int] = []

    class Count(ur.protocols.Callback):
        """Looks at the kernels between one step's end and the next's."""

        def on_start(self, run: Any) -> None:
            self.recording = recorded()
            self.found = self.recording.__enter__()

        def on_step(self, run: Any, record: dict[str, Any]) -> None:
            self.recording.__exit__(None, None, None)
            launched.append(len(self.found))
            new.append(sum(self.found))
            self.recording = recorded()
            self.found = self.recording.__enter__()

        def on_end(self, run: Any, result: ur.Result) -> None:
            self.recording.__exit__(None, None, None)

    ur.optimize(asked, estimator, optimizer, steps=40 if spare else 16, callbacks=[Count()])
    assert min(launched) > 0
    assert sum(new[6 if not spare else 10 :]) <= spare, new


def test_a_kernel_that_is_compiled_each_step_is_noticed() -> None:
    """The test above can fail: a Python number that changes makes a new kernel."""
    x = dr.opaque(mi.Float, 1.0, 64)
    counts = []
    for step in range(3):
        with recorded() as found:
            dr.eval(x * (0.123456 + step / 7))
        counts.append(sum(found))
    assert counts[1:] == [1, 1]


@pytest.mark.slow
def test_moving_geometry_runs_in_primary_space() -> None:
    key = "small-box.vertex_positions"
    renderer = MitsubaRenderer(box(), 3)
    session = renderer.prepare([key], "primary")
    current = renderer.values([key])
    previous = {key: current[key] + 0.02}
    pair = session.image_pair(current, previous, SampleRequest(0, 64, 1), "primary")
    alone = session.image(previous, SampleRequest(0, 64, 1))
    assert pair.previous is not None
    assert np.array_equal(np.array(pair.previous[0]), np.array(alone.images[0]))
    assert not np.array_equal(np.array(pair.previous[0]), np.array(pair.images[0]))
    gradient = session.adjoint(
        current, session.image(current, SampleRequest(0, 64, 1)).paths, renderer.array(np.ones((1, 16, 16, 3)))
    )
    assert np.isfinite(np.array(gradient[key])).all()
    assert np.abs(np.array(gradient[key])).max() > 0


@pytest.mark.parametrize("space", ["path", "primary"])
def test_both_states_of_texture_coordinates_have_the_same_random_numbers(tmp_path: Path, space: Space) -> None:
    """Texture coordinates and normals are a shape's, but move no point."""
    points = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    sheet = mesh_layout.build(
        "sheet",
        points,
        np.array([[0, 1, 2], [0, 2, 3]], np.uint32),
        None,
        points[:, :2],
        mi.load_dict({"type": "diffuse"}),
    )
    sheet.write_ply(str(tmp_path / "sheet.ply"))
    texture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.random.default_rng(0).random((4, 4, 3)).astype(np.float32)),
        "raw": True,
    }
    scene = {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
        },
        "sheet": {
            "type": "ply",
            "filename": str(tmp_path / "sheet.ply"),
            "bsdf": {"type": "diffuse", "reflectance": texture},
        },
        "sky": {"type": "constant"},
    }
    key, renderer = "sheet.vertex_texcoords", MitsubaRenderer(scene, 2)
    session = renderer.prepare([key], "primary")
    current = renderer.values([key])
    previous = {key: current[key] + 0.05}
    pair = session.image_pair(current, previous, SampleRequest(0, 4, 1), space)
    assert pair.previous is not None
    for images, values in ((pair.images, current), (pair.previous, previous)):
        alone = session.image(values, SampleRequest(0, 4, 1))
        assert np.array_equal(np.array(images), np.array(alone.images))
    assert not np.array_equal(np.array(pair.previous), np.array(pair.images))


@pytest.mark.slow
def test_gradients_of_two_states_of_moving_geometry_are_each_its_own() -> None:
    """In primary space: the previous scene's adjoint on the same random numbers, to the rounding of sums."""
    key = "small-box.vertex_positions"
    renderer = MitsubaRenderer(box(), 3)
    session = renderer.prepare([key], "primary")
    current = renderer.values([key])
    previous = {key: current[key] + 0.02}
    weights = renderer.array(np.random.default_rng(0).random((2, 16, 16, 3)))
    pair = session.image_pair(current, previous, SampleRequest(0, 64, 1, groups=2), "primary")
    both = session.adjoint_pair(current, previous, pair.paths, weights, weights)
    for state, found in zip((current, previous), both, strict=True):
        alone = session.adjoint(state, session.image(state, SampleRequest(0, 64, 1, groups=2)).paths, weights)
        a, b = np.array(found[key]), np.array(alone[key])
        assert np.abs(a - b).max() < 1e-4 * np.abs(b).max()
    assert np.abs(np.array(both[0][key]) - np.array(both[1][key])).max() > 0


@pytest.mark.slow
def test_meta_estimation_of_moving_geometry_says_that_it_is_in_primary_space() -> None:
    asked = problem(box(), "small-box.vertex_positions")
    found = ur.optimize(asked, ur.MetaEstimator(), ur.optimizers.MetaAdam(1e-3), steps=3)
    assert found.info["space"] == {"small-box.vertex_positions": "primary"}
    assert found.skipped == 0
    related = ur.optimize(asked, ur.MetaEstimator(space="path"), ur.optimizers.MetaAdam(1e-3), steps=3)
    assert related.skipped == 0


def test_textures_of_which_pictures_are_no_linear_function_are_known() -> None:
    bitmaps = {
        name: {"type": "bitmap", "bitmap": mi.Bitmap(np.full((2, 2, 1), 0.5, np.float32)), "raw": True}
        for name in "abc"
    }
    scene = box(
        metal={"type": "sphere", "bsdf": {"type": "roughconductor", "alpha": bitmaps["a"]}},
        leaf={"type": "sphere", "bsdf": {"type": "mask", "opacity": bitmaps["b"], "leaf": {"type": "diffuse"}}},
        paint={"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": bitmaps["c"]}},
    )
    known = MitsubaRenderer(scene, 2).parameters()
    assert known["metal.bsdf.alpha.data"].curved
    assert known["leaf.bsdf.opacity.data"].curved
    assert not known["paint.bsdf.reflectance.data"].curved


def test_chosen_pixels_are_the_pixels_of_the_film() -> None:
    renderer = MitsubaRenderer(box(), 3)
    session = renderer.prepare([WALL], None)
    now = renderer.values([WALL])
    whole = np.array(session.image(now, SampleRequest(0, 4096, 1)).images[0]).reshape(-1, 3)
    chosen = np.array([3, 100, 17, 255])
    some = np.array(session.image(now, SampleRequest(0, 4096, 2, pixels=mi.UInt32(chosen))).images[0])
    assert some.shape == (4, 3)
    np.testing.assert_allclose(some, whole[chosen], rtol=0.15, atol=0.01)


def test_several_views_and_problems_in_one_process() -> None:
    one, two = problem(box(), views=2, initial=0.5), problem(box(), initial=0.5)
    estimator = ur.PathGradient(ur.images.RecursiveControlVariate(), spp=2)
    first = ur.optimize(one, estimator, ur.optimizers.Adam(), steps=4)
    second = ur.optimize(two, estimator, ur.optimizers.Adam(), steps=4)
    again = ur.optimize(two, estimator, ur.optimizers.Adam(), steps=4)
    assert set(first.info["control_weight"]) == {0, 1}
    np.testing.assert_allclose(second.parameters[WALL], again.parameters[WALL], rtol=1e-4, atol=1e-5)


def test_both_images_of_render_pair() -> None:
    asked = problem(box(), initial=0.5)
    now = {WALL: np.full((8, 8, 3), 0.5, np.float32)}
    before = {WALL: np.full((8, 8, 3), 0.3, np.float32)}
    a, b = ur.render_pair(asked, now, before, 16, 0)
    assert a.shape == b.shape == (16, 16, 3)
    assert a.mean() > b.mean()
    same = ur.render_pair(asked, now, now, 16, 0)
    assert np.array_equal(*same)


@pytest.mark.parametrize("channels", [1, 3])
def test_replayed_kernels_follow_every_value_that_numpy_hands_over(channels: int) -> None:
    """Borrowed memory would show stale texels in some of them, where the texture is stored as it is given."""
    key = "ball.bsdf.reflectance.data"
    rng = np.random.default_rng(3)

    def description() -> dict[str, Any]:
        texels = mi.Bitmap(np.full((8, 8, channels), 0.5, np.float32))
        texture = {"type": "bitmap", "raw": True, "bitmap": texels}
        return {
            "type": "scene",
            "camera": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
            "ball": {"type": "sphere", "center": [0, 0, 4], "bsdf": {"type": "diffuse", "reflectance": texture}},
            "sky": {"type": "constant"},
        }

    renderer = MitsubaRenderer(description, 3)
    session = renderer.prepare([key], None)
    assert isinstance(session, CachingSession)
    values = [rng.uniform(0.1, 0.9, (8, 8, channels)).astype(np.float32) for _ in range(12)]
    replayed = [np.array(session.image({key: renderer.array(v)}, SampleRequest(0, 4, 5)).images) for v in values]
    for value, image in zip(values, replayed, strict=True):
        session._functions.clear()
        session._inner._functions.clear()
        fresh = np.array(session.image({key: renderer.array(value)}, SampleRequest(0, 4, 5)).images)
        np.testing.assert_array_equal(image, fresh)


def test_a_number_stays_a_number() -> None:
    """Of shape (), in and out."""
    problem = ur.gallery.problem("mug", resolution=8, reference_spp=1)
    key = "mug.rotation.y"
    assert problem.renderer.array(np.array(0.25)).shape == ()
    assert problem.initial()[key].shape == ()
    assert ur.render(problem, problem.truth, spp=1).shape == (8, 8, 3)


def test_a_value_that_a_plugin_refuses_is_an_input_error() -> None:
    """The sky's turbidity has a range; bounds that leave it meet Mitsuba's own error, in one line, and what was set before stays."""
    key = "sky.turbidity"
    made = problem(box(sky={"type": "sunsky", "turbidity": 4.0}), key)
    assert made.unknowns[key].bounds == (1.0, 10.0)
    session = made.renderer.prepare([key], None, False)
    first = session.image({key: mi.TensorXf([3.0], ())}, SampleRequest(0, 4, 1)).images[0].numpy()
    with pytest.raises(
        ur.InputError, match=r"sky\.turbidity: Mitsuba refuses the value; give the parameter bounds: .*out of range"
    ):
        session.image({key: mi.TensorXf([0.6], ())}, SampleRequest(0, 4, 1))
    refused = mi.TensorXf([0.6], ())
    for _ in range(3):  # and is refused again, not taken for what the scene has
        with pytest.raises(ur.InputError, match="Mitsuba refuses"):
            session.image({key: refused}, SampleRequest(0, 4, 1))
    np.testing.assert_array_equal(
        session.image({key: mi.TensorXf([3.0], ())}, SampleRequest(0, 4, 1)).images[0].numpy(), first
    )


def test_more_camera_rays_than_a_launch_has_are_refused() -> None:
    session = problem(box()).renderer.prepare([WALL], None, False)
    with pytest.raises(
        ur.InputError, match=r"camera rays: a launch is limited to fewer than 2³²; reduce the samples per pixel"
    ):
        session.image({}, SampleRequest(0, 1 << 24, 1))
