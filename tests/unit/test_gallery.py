"""The gallery: its options, its pictures, and that each problem is what it says: solvable at its truth, unsolved at its start."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

import unrender as ur
from unrender.gallery import meshes, textures
from unrender.rendering.mitsuba_renderer import MitsubaRenderer
from unrender.rendering.port import Shot

NAMES = ur.gallery.names()
RENDERED = [name for name in NAMES if name != "exponential"]
SMALL = {"resolution": 16, "texture_resolution": 8, "reference_spp": 2048}

# What each problem promises to leave unknown.
UNKNOWN = {
    "indirect-room": {"back.bsdf.reflectance.data": (8, 8, 3)},
    "glossy-room": {
        "tile.bsdf.base_color.data": (8, 8, 3),
        "tile.bsdf.roughness.data": (8, 8, 1),
        "ball.bsdf.metallic.data": (8, 8, 1),
        "ball.bsdf.roughness.data": (8, 8, 1),
    },
    "sunlit-vase": {"vase.bsdf.brdf_0.base_color.data": (8, 8, 3)},
    "lamp": {"bulb.emitter.radiance.value": (3,), "mural.bsdf.reflectance.data": (8, 8, 3)},
    "spiral": {
        "spiral.bsdf.brdf_0.base_color.data": (8, 8, 3),
        "spiral.bsdf.brdf_0.metallic.data": (8, 8, 1),
        "spiral.bsdf.brdf_0.roughness.data": (8, 8, 1),
    },
    "ajar": {
        "back.bsdf.reflectance.data": (8, 8, 3),
        "pot.bsdf.brdf_0.reflectance.data": (8, 8, 3),
        "leaves.bsdf.brdf_0.reflectance.data": (8, 8, 3),
    },
    "chalice": {"chalice.bsdf.brdf_0.roughness.data": (8, 8, 1)},
}


@pytest.fixture(scope="module", params=RENDERED)
def small(request) -> ur.Problem:
    return ur.gallery.problem(request.param, **SMALL)


def renders(
    problem: ur.Problem, parameters: dict[str, np.ndarray], view: int, runs: int = 24, spp: int = 32
) -> np.ndarray:
    """(runs, H, W, 3) independent pictures."""
    return np.stack([ur.render(problem, parameters, view, spp=spp, seed=100 + run) for run in range(runs)]).astype(
        float
    )


def scores(pictures: np.ndarray, reference: np.ndarray, samples: int, reference_samples: int) -> np.ndarray:
    """z scores of mean(pictures) - reference: of each channel of blocks of 4 x 4 pixels, and last of the whole picture but
    its brightest things. The reference's noise is inferred from the pictures' by the number of samples."""

    def parts(x: np.ndarray) -> np.ndarray:
        *lead, height, width, channels = x.shape
        blocks = x.reshape(*lead, height // 4, 4, width // 4, 4, channels).mean(axis=(-4, -2))
        whole = (x * (reference < 3)).mean(axis=(-3, -2, -1), keepdims=True)
        return np.concatenate([blocks.reshape(*lead, -1), whole.reshape(*lead, 1)], axis=-1)

    runs = len(pictures)
    variance = parts(pictures).var(axis=0, ddof=1) * (1 / runs + samples / reference_samples)
    t = (parts(pictures).mean(axis=0) - parts(reference)) / np.sqrt(variance + 1e-20)
    return np.abs(stats.norm.isf(stats.t.sf(np.abs(t), runs - 1).clip(1e-300)))


def limit(count: int, level: float = 1e-4) -> float:
    """The bound on the largest of `count` scores, at `level` after Šidák."""
    return float(stats.norm.isf((1 - (1 - level) ** (1 / count)) / 2))


# ---------------------------------------------------------------------------------------------------- names, options


def test_the_first_problem_is_the_one_to_begin_with():
    assert NAMES[0] == "indirect-room"
    assert set(RENDERED) == set(UNKNOWN)


@pytest.mark.parametrize("name", NAMES)
def test_a_summary_is_one_line(name):
    line = ur.gallery.summary(name)
    assert line.endswith(".")
    assert 20 < len(line) < 120
    assert "\n" not in line


@pytest.mark.parametrize("name", NAMES)
def test_options_say_kind_and_default(name):
    options = {option.name: option for option in ur.gallery.options(name)}
    rendered = {"resolution", "texture_resolution", "reference_spp", "max_depth"} if name in RENDERED else set()
    assert {"loss", *rendered} <= set(options)
    assert all(isinstance(option.default, int) for option in options.values() if option.kind is int)
    assert all(option.about for option in options.values())


@pytest.mark.parametrize("ask", [ur.gallery.problem, ur.gallery.summary, ur.gallery.options])
def test_an_unknown_name_is_told_the_nearest(ask):
    with pytest.raises(ur.InputError, match=r"gallery: no problem indirect_room; did you mean indirect-room\?$"):
        ask("indirect_room")
    with pytest.raises(ur.InputError, match=f"it has {', '.join(NAMES)}$"):
        ask("zzz")
    with pytest.raises(ur.InputError, match="no problem None"):
        ask(None)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolutoin": 8}, "gallery problem sunlit-vase: no option resolutoin; did you mean resolution?"),
        ({"zzz": 8}, "no option zzz; it has resolution, texture_resolution, views, reference_spp, max_depth, loss"),
        ({"resolution": 2}, "resolution must be a whole number of at least 4, got 2"),
        ({"resolution": 8.0}, "resolution must be a whole number of at least 4, got 8.0"),
        ({"resolution": "8"}, "resolution must be a whole number of at least 4, got '8'"),
        ({"texture_resolution": 1}, "texture_resolution must be a whole number of at least 2, got 1"),
        ({"reference_spp": 0}, "reference_spp must be a whole number of at least 1, got 0"),
        ({"reference_spp": True}, "reference_spp must be a whole number of at least 1, got True"),
        ({"max_depth": 1}, "max_depth must be a whole number of at least 2, got 1"),
        ({"views": 0}, "views must be a whole number of at least 1, got 0"),
        ({"views": 99}, "views must be at most 16, got 99"),
        ({"loss": "l1"}, 'loss: expected "L1" or "L2" or "RelativeL2" or "Huber", got "l1"; did you mean L1?'),
        ({"loss": ur.losses.L1}, "loss must be one of unrender.losses or its name"),
        ({"loss": 1}, "loss must be one of unrender.losses or its name, got 1"),
    ],
)
def test_a_bad_option_is_one_clear_line(options, message):
    with pytest.raises(ur.InputError) as caught:
        ur.gallery.problem("sunlit-vase", **options)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_options_act():
    plain = ur.gallery.problem("sunlit-vase", resolution=8, texture_resolution=4, reference_spp=1)
    other = ur.gallery.problem(
        "sunlit-vase", resolution=12, texture_resolution=6, reference_spp=2, views=2, max_depth=2, loss="Huber"
    )
    assert [np.asarray(view.reference).shape for view in plain.views] == [(8, 8, 3)] * 3
    assert [np.asarray(view.reference).shape for view in other.views] == [(12, 12, 3)] * 2
    assert [value.shape for value in plain.truth.values()] == [(4, 4, 3)]
    assert [value.shape for value in other.truth.values()] == [(6, 6, 3)]
    assert (plain.max_depth, other.max_depth) == (5, 2)
    assert (plain.loss, other.loss) == (ur.losses.L1(), ur.losses.Huber())


def test_reference_spp_lowers_the_noise_and_equal_calls_give_equal_references():
    coarse, again, fine, finer = (
        np.asarray(ur.gallery.problem("lamp", resolution=8, texture_resolution=4, reference_spp=spp).views[0].reference)
        for spp in (16, 16, 1024, 1040)
    )
    np.testing.assert_array_equal(coarse, again)
    dim = fine < 1  # the bulb itself has no noise but at its edge
    assert np.std((coarse - fine)[dim]) > 3 * np.std((finer - fine)[dim])


def test_references_in_several_passes_weigh_each_by_its_samples(monkeypatch):
    from unrender.gallery import recipe

    options = {"resolution": 8, "texture_resolution": 4, "reference_spp": 5}
    scene = ur.gallery.problem("sunlit-vase", **options).renderer.pair.current  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setattr(recipe, "_LANES", 2 * 64)
    whole = recipe.reference(scene, 0, 5, 5)
    integrator = mi.load_dict({"type": "path", "max_depth": 5})
    total = np.zeros((8, 8, 3))
    for done, take in ((0, 2), (2, 2), (4, 1)):
        seed = recipe._REFERENCE.fold(0).fold(done).uint32()
        total += take * mi.render(scene, sensor=0, integrator=integrator, spp=take, seed=mi.UInt32(seed)).numpy()
    np.testing.assert_allclose(whole, total / 5, rtol=1e-5)


# ---------------------------------------------------------------------------------------------------- each problem


def test_what_is_unknown(small):
    assert {key: value.shape for key, value in small.truth.items()} == UNKNOWN[small.name]
    traversed = mi.traverse(small.renderer.pair.current).keys()
    assert all(parameter.key in traversed for parameter in small.parameters)
    assert small.notices == []


def test_truth_and_start_lie_inside_the_bounds_and_differ(small):
    for key, start in ur.gallery.problem(small.name, **SMALL | {"reference_spp": 1}).initial().items():
        truth, (low, high) = small.truth[key], small.bounds[key]
        assert low is not None
        for values in (truth, start.numpy()):
            assert np.all(values >= low)
            assert high is None or np.all(values <= high)
    errors = small.parameter_error(small.initial())
    assert all(error > 0.05 for error in errors.values()), errors


def test_textures_vary_so_that_no_single_value_is_the_answer(small):
    for key, truth in small.truth.items():
        if truth.ndim == 3:
            assert truth.std(axis=(0, 1)).min() > 0.03, key


def test_the_truth_renders_to_the_reference_and_the_start_does_not(small):
    start = {key: value.numpy() for key, value in small.initial().items()}
    for view, given in enumerate(small.views):
        reference = np.asarray(given.reference, float)
        assert np.isfinite(reference).all()
        true = scores(renders(small, small.truth, view), reference, 32, SMALL["reference_spp"])
        false = scores(renders(small, start, view), reference, 32, SMALL["reference_spp"])
        assert true.max() < limit(true.size), (view, true.max())
        assert true[-1] < limit(1), (view, true[-1])
        assert false.max() > 1.3 * limit(false.size), (view, false.max())


def test_pictures_are_well_exposed_and_noisy(small):
    for view, given in enumerate(small.views):
        reference = np.asarray(given.reference, float)
        assert 0.02 < np.median(reference) < 0.6
        noise = np.abs(ur.render(small, small.truth, view, spp=1, seed=5) - reference)
        assert np.median(noise) > 0.1 * np.median(reference)


def test_every_parameter_follows_a_path_of_another_state_and_is_seen(small):
    estimator = ur.PathGradient(image=ur.images.RecursiveControlVariate(space="path"), spp=8)
    result = ur.optimize(small, estimator, ur.optimizers.Adam(learning_rate=0.02), steps=12, seed=1)
    assert result.skipped == 0
    assert result.warnings == []
    for key, value in result.parameters.items():
        moved = np.abs(value - result.initial[key]) > 1e-4
        assert moved.mean() > 0.75, key  # texels that some camera sees


@pytest.mark.parametrize(
    ("name", "key", "factor"),
    [
        ("indirect-room", "back.bsdf.reflectance.data", 0.6),
        ("sunlit-vase", "vase.bsdf.brdf_0.base_color.data", 0.4),
        ("lamp", "mural.bsdf.reflectance.data", 0.5),
        ("lamp", "bulb.emitter.radiance.value", 0.5),
        ("glossy-room", "tile.bsdf.base_color.data", 0.6),
        ("glossy-room", "ball.bsdf.metallic.data", 0.9),
    ],
)
def test_the_descent_approaches_the_truth(recovered, name, key, factor):
    problem, result = recovered(name)
    before, after = problem.parameter_error(result.initial)[key], problem.parameter_error(result.parameters)[key]
    assert after < factor * before


@pytest.fixture(scope="module")
def recovered():
    done = {}

    def recover(name):
        if name not in done:
            problem = ur.gallery.problem(name, **SMALL)
            estimator = ur.PathGradient(image=ur.images.RecursiveControlVariate(space="path"), spp=8)
            done[name] = problem, ur.optimize(problem, estimator, ur.optimizers.Adam(0.02), steps=120, seed=2)
        return done[name]

    return recover


def test_the_spiral_is_five_numbers_by_default():
    problem = ur.gallery.problem("spiral", resolution=8, reference_spp=1)
    assert {key: value.shape for key, value in problem.truth.items()} == {
        "spiral.bsdf.brdf_0.base_color.value": (3,),
        "spiral.bsdf.brdf_0.metallic.value": (),
        "spiral.bsdf.brdf_0.roughness.value": (),
    }
    found = ur.optimize(problem, ur.MetaEstimator(coupled=True), ur.optimizers.MetaAdam(), steps=3)
    assert not found.warnings
    assert all(np.any(value != found.initial[key]) for key, value in found.parameters.items())


def test_the_exponential_has_the_mean_that_it_shows():
    problem = ur.gallery.problem("exponential")
    renderer = problem.renderer
    many = [renderer.image(problem.truth, Shot(0, 1000, seed)).images.mean() for seed in range(200)]
    assert abs(np.mean(many) - 2) < 4 * np.std(many) / np.sqrt(200)
    step = 1e-5
    sides = [
        renderer.image({"rate": np.array(0.8 + side)}, Shot(0, 64, 3, groups=4)).images.mean() for side in (step, -step)
    ]
    paths = renderer.image({"rate": np.array(0.8)}, Shot(0, 64, 3, groups=4)).paths
    slope = renderer.adjoint({"rate": np.array(0.8)}, paths, np.full((4, 1, 1, 3), 1 / 3))["rate"]
    assert slope == pytest.approx((sides[0] - sides[1]) / (2 * step), rel=1e-6)


def test_the_room_of_ajar_is_lit_through_the_gap_alone():
    """No emitter can be sampled from most of what the camera sees, and yet it is not dark."""
    problem = ur.gallery.problem("ajar", resolution=32, texture_resolution=8, reference_spp=256)
    assert isinstance(problem.renderer, MitsubaRenderer)
    renderer = MitsubaRenderer(problem.renderer.pair.description, max_depth=2)  # direct light alone
    truth = {key: renderer.array(value) for key, value in problem.truth.items()}
    renderer.select(list(truth), None)
    direct = np.array(renderer.image(truth, Shot(0, 256, 1)).images)[0]
    reference = np.asarray(problem.views[0].reference)
    assert np.mean(direct.max(-1) == 0) > 0.6
    assert np.mean(reference.max(-1) > 0.01) > 0.9


def test_nothing_but_the_ceiling_sees_the_lamp_of_the_indirect_room():
    problem = ur.gallery.problem("indirect-room", resolution=4, texture_resolution=4, reference_spp=1)
    scene = problem.renderer.pair.current  # pyright: ignore[reportAttributeAccessIssue]
    rng = np.random.default_rng(0)
    count, lit = 20000, {}
    with dr.suspend_grad():  # other problems' emitters, still alive in this process, may carry gradients
        for shape in scene.shapes():
            where = shape.sample_position(0, mi.Point2f(rng.random((2, count)).astype(np.float32)))
            si = dr.zeros(mi.SurfaceInteraction3f, count)
            si.p, si.n, si.sh_frame = where.p, where.n, mi.Frame3f(where.n)
            ds, weight = scene.sample_emitter_direction(si, mi.Point2f(rng.random((2, count)).astype(np.float32)))
            sees = (dr.dot(ds.d, where.n) > 0) & (dr.max(weight) > 0)
            lit[shape.id()] = float(np.mean(np.array(sees)))
    assert lit.pop("ceiling") > 0.2
    assert lit == dict.fromkeys(lit, 0.0)


# ---------------------------------------------------------------------------------------------------- pieces


@pytest.mark.parametrize("name", ["astronaut", "chelsea", "coffee", "gravel"])
def test_photographs_are_reflectances(name):
    picture = textures.photograph(name, 16)
    assert picture.shape == (16, 16, 3)
    assert picture.dtype == np.float32
    assert textures.DARKEST <= picture.min() < picture.max() <= textures.BRIGHTEST
    # Averaged, not picked: a small picture has the mean of a large one.
    np.testing.assert_allclose(picture.mean(axis=(0, 1)), textures.photograph(name, 128).mean(axis=(0, 1)), atol=0.01)


def test_to_linear_is_the_standard_curve():
    np.testing.assert_allclose(
        textures.to_linear(np.array([0, 0.04, 0.5, 1.0])), [0, 0.0030959752, 0.2140411, 1], rtol=1e-6
    )


def test_a_bitmap_keeps_its_values_and_stands_upright():
    values = np.arange(12, dtype=np.float32).reshape(2, 2, 3) / 12
    texture = mi.load_dict(textures.bitmap(values))
    np.testing.assert_array_equal(np.array(mi.traverse(texture)["data"]), values)
    si = mi.SurfaceInteraction3f()
    si.uv = mi.Point2f([0.01, 0.99], [0.99, 0.01])  # top left, bottom right
    seen = np.array(texture.eval(si)).T
    np.testing.assert_allclose(seen, [values[0, 0], values[1, 1]], atol=0.02)


def test_a_repeated_bitmap_is_mirrored():
    values = np.linspace(0, 1, 8, dtype=np.float32)[None, :].repeat(8, 0)
    texture = mi.load_dict(textures.bitmap(values, repeat=(2, 1)))
    si = mi.SurfaceInteraction3f()
    si.uv = mi.Point2f([0.1, 0.4, 0.6, 0.9], 0.5)
    a, b, c, d = np.array(texture.eval(si))[0]
    assert a < b
    assert a == pytest.approx(d, abs=1e-3)
    assert b == pytest.approx(c, abs=1e-3)


def test_a_lathed_cylinder_has_its_area_its_normals_and_its_texture_coordinates():
    rows, columns, radius = 5, 64, 0.5
    points = meshes.lathe(np.full(rows, radius), np.linspace(0, 2, rows), columns)
    mesh = meshes.sheet("cylinder", points, {"type": "diffuse"}, closed=True)
    side = 2 * radius * math.sin(math.pi / columns)
    assert float(np.array(mesh.surface_area()).item()) == pytest.approx(columns * side * 2, rel=1e-4)
    scene = mi.load_dict({"type": "scene", "mesh": mesh})
    angle = np.array([0.0, 1.0, 3.1, -3.1, -1.0])  # around the seam too
    d = mi.Vector3f(-np.sin(angle), 0, -np.cos(angle))
    o = mi.Point3f(3 * np.sin(angle), 0.7, 3 * np.cos(angle))
    si = scene.ray_intersect(mi.Ray3f(o, d))
    assert np.all(si.is_valid())
    np.testing.assert_allclose(np.array(si.uv), [angle / (2 * np.pi) + 0.5, np.full(5, 0.35)], atol=2e-3)
    cosine = -np.array(si.sh_frame.n.x * d.x + si.sh_frame.n.y * d.y + si.sh_frame.n.z * d.z)
    np.testing.assert_allclose(cosine, 1, atol=1e-4)
    assert np.all(np.array(si.n.x * d.x + si.n.z * d.z) < 0)  # the front is outside


def test_the_sun_of_the_vase_casts_the_light_that_its_direction_says():
    from unrender.gallery import sunlit_vase

    scene = mi.load_dict({"type": "scene", "sky": {"type": "envmap", "bitmap": mi.Bitmap(sunlit_vase._sky())}})
    sky = scene.emitters()[0]
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f((-sunlit_vase._SUN).tolist())
    away = mi.SurfaceInteraction3f()
    away.wi = mi.Vector3f((sunlit_vase._SUN * [1, -1, 1]).tolist())
    assert np.array(sky.eval(si)).min() > 100
    assert np.array(sky.eval(away)).max() < 1
