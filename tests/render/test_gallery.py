"""The gallery: its options, its pictures, and that each problem is what it says: solvable at its truth, unsolved at its start."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from callbacks import of_the_run
from scipy import stats

import unrender as ur
from tiers import quick, slow
from unrender.backend import cache
from unrender.gallery import meshes, parts, poses, specification
from unrender.gallery.analytic import QuadraticRenderer
from unrender.gallery.sunlit import SunlitVase
from unrender.methods import method
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

NAMES = ur.gallery.names()
SMALL = {"resolution": 16, "texture_resolution": 8, "reference_spp": 2048}

# What each problem of unknown materials and lights promises to leave unknown.
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
    "poster": {"poster.bsdf.reflectance.data": (8, 8, 1)},
    "wall": {"back.bsdf.reflectance.data": (8, 8, 3)},
}
RENDERED = list(UNKNOWN)

# What is unknown where poses are, and whether the loss is flat at the start.
POSES = {
    "box2": ["box_0.translation.x", "box_0.translation.y"],
    "box10": [f"box_{number}.translation.{axis}" for number in range(5) for axis in "xy"],
    "mug": ["mug.rotation.y"],
    "shadow": ["ball.translation.x", "ball.translation.z"],
    "bunny": ["bunny.translation.x", "bunny.translation.z", "bunny.rotation.y"],
    "stage-lights": [
        *("spot.rotation.x", "spot.rotation.z"),
        *(f"softbox.translation.{axis}" for axis in "xyz"),
        *("beamer.rotation.x", "beamer.rotation.y"),
    ],
}
PLATEAUS = ["box2", "box10", "mug", "shadow"]
WITHOUT_RENDERER = ["exponential", "quad"]
# See test_gallery_adaptive.py.
DRAWN = [
    "mirror-trio", "sun-glossy", "plain-and-textured", "two-planets", "caustic", "three-textures", "globe-and-mirror",
]  # fmt: skip
MESHES = [
    "sphere-to-mesh",
    "sphere-to-bunny",
    "shadow-art",
    "statue",
    "relief",
    "lenses",
]  # test_shapes.py, test_mesh_runs.py, test_relief.py, test_lenses.py
WORLDS_AND_PRIORS = [
    "one-jar",
    "noisy-tiles",
    "two-posters",
]  # see test_view_worlds.py, test_rendered_priors.py, test_ties.py
VOLUMES = ["three-bodies", "tea", "smoke", "nerf-volume"]  # see test_gallery_volumes.py


@pytest.fixture(scope="module", params=quick(RENDERED, "indirect-room"))
def small(request) -> ur.Problem:
    return ur.gallery.problem(request.param, **SMALL)


def renders(
    problem: ur.Problem, parameters: dict[str, np.ndarray], view: int, runs: int = 24, spp: int = 32
) -> np.ndarray:
    """(runs, H, W, 3) independent pictures."""
    return np.stack([ur.render(problem, parameters, view, spp=spp, seed=100 + run) for run in range(runs)]).astype(
        float
    )


def scores(
    pictures: np.ndarray, reference: np.ndarray, samples: int, reference_samples: int, rounding: float = 1e-10
) -> np.ndarray:
    """z scores of mean(pictures) - reference: of each channel of blocks of 4 x 4 pixels, and last of the whole picture but
    its brightest things. The reference's noise is inferred from the pictures' by the number of
    samples; `rounding` is a standard error that is there without any noise."""

    def parts(x: np.ndarray) -> np.ndarray:
        *lead, height, width, channels = x.shape
        blocks = x.reshape(*lead, height // 4, 4, width // 4, 4, channels).mean(axis=(-4, -2))
        whole = (x * (reference < 3)).mean(axis=(-3, -2, -1), keepdims=True)
        return np.concatenate([blocks.reshape(*lead, -1), whole.reshape(*lead, 1)], axis=-1)

    runs = len(pictures)
    variance = parts(pictures).var(axis=0, ddof=1) * (1 / runs + samples / reference_samples)
    t = (parts(pictures).mean(axis=0) - parts(reference)) / np.sqrt(variance + rounding**2)
    return np.abs(stats.norm.isf(stats.t.sf(np.abs(t), runs - 1).clip(1e-300)))


def limit(count: int, level: float = 1e-4) -> float:
    """The bound on the largest of `count` scores, at `level` after Šidák."""
    return float(stats.norm.isf((1 - (1 - level) ** (1 / count)) / 2))


# ---------------------------------------------------------------------------------------------------- names, options


def test_the_first_problem_is_the_one_to_begin_with():
    assert NAMES[0] == "indirect-room"
    assert {*RENDERED, *POSES, *WITHOUT_RENDERER, *DRAWN, *VOLUMES, *MESHES, *WORLDS_AND_PRIORS, "camera"} == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_summary_is_one_line(name):
    line = ur.gallery.summary(name)
    assert line.endswith(".")
    assert 20 < len(line) < 120
    assert "\n" not in line


@pytest.mark.parametrize("name", NAMES)
def test_options_say_kind_and_default(name):
    options = {option.name: option for option in ur.gallery.options(name)}
    rendered = {"resolution", "reference_spp", "max_depth"} if name not in WITHOUT_RENDERER else set()
    textured = {"texture_resolution"} if name in {*RENDERED, *DRAWN} - {"mirror-trio"} else set()
    assert {"loss", *rendered, *textured} <= set(options)
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
        (
            {"loss": "l1"},
            'loss: expected "L1" or "L2" or "RelativeL2" or "Huber" or "Perceptual" or "Censored", got "l1"; did you mean L1?',
        ),
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


@pytest.mark.slow
def test_reference_spp_lowers_the_noise_and_equal_calls_give_equal_references():
    coarse, again, fine, finer = (
        np.asarray(ur.gallery.problem("lamp", resolution=8, texture_resolution=4, reference_spp=spp).views[0].reference)
        for spp in (16, 16, 1024, 1040)
    )
    np.testing.assert_array_equal(coarse, again)
    dim = fine < 1  # the bulb itself has no noise but at its edge
    assert np.std((coarse - fine)[dim]) > 3 * np.std((finer - fine)[dim])


def test_references_of_several_passes_are_the_mean_of_what_mitsuba_renders_with_such_samplers(monkeypatch):
    described = SunlitVase(resolution=8, texture_resolution=4).scene()
    sensors = [name for name, entry in described.items() if isinstance(entry, dict) and entry["type"] == "perspective"]
    monkeypatch.setattr(specification, "_LANES", 2 * 64)
    with cache.bypassed():
        found = specification.reference(mi.load_dict(described), 0, 5, 5)
    for name in sensors:
        described[name]["sampler"] = {"type": "multijitter", "sample_count": 2}
    scene, integrator = mi.load_dict(described), mi.load_dict({"type": "path", "max_depth": 5})
    seeds = [specification._REFERENCE.fold(0).fold(done).uint32() for done in (0, 2, 4)]
    parts = [mi.render(scene, sensor=0, integrator=integrator, spp=2, seed=mi.UInt32(seed)).numpy() for seed in seeds]
    np.testing.assert_allclose(found, np.mean(parts, axis=0), rtol=1e-5)


# ---------------------------------------------------------------------------------------------------- each problem


def test_what_is_unknown(small):
    assert {key: value.shape for key, value in small.truth.items()} == UNKNOWN[small.name]
    traversed = mi.traverse(small.renderer.pair.current).keys()
    assert all(parameter.key in traversed for parameter in small.parameters)
    assert small.notices == []


def test_truth_and_start_lie_inside_the_bounds_and_differ(small):
    for key, start in ur.gallery.problem(small.name, **SMALL | {"reference_spp": 1}).initial().items():
        truth, (low, high) = small.truth[key], small.unknowns[key].bounds
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
        if small.name == "poster":
            continue  # one lamp, direct light: hardly any noise
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
@pytest.mark.slow
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


@pytest.mark.slow
def test_the_spiral_is_five_numbers_by_default():
    problem = ur.gallery.problem("spiral", resolution=8, reference_spp=1)
    assert {key: value.shape for key, value in problem.truth.items()} == {
        "spiral.bsdf.brdf_0.base_color.value": (3,),
        "spiral.bsdf.brdf_0.metallic.value": (),
        "spiral.bsdf.brdf_0.roughness.value": (),
    }
    found = ur.optimize(problem, ur.MetaEstimator(coupled=True), ur.optimizers.MetaAdam(), steps=3)
    assert not of_the_run(found.warnings)
    assert all(np.any(value != found.initial[key]) for key, value in found.parameters.items())


def test_the_exponential_has_the_mean_that_it_shows():
    problem = ur.gallery.problem("exponential")
    session = problem.renderer.prepare(["rate"], "path")
    many = [session.image(problem.truth, SampleRequest(0, 1000, seed)).images.mean() for seed in range(200)]
    assert abs(np.mean(many) - 2) < 4 * np.std(many) / np.sqrt(200)
    step = 1e-5
    sides = [
        session.image({"rate": np.array(0.8 + side)}, SampleRequest(0, 64, 3, groups=4)).images.mean()
        for side in (step, -step)
    ]
    paths = session.image({"rate": np.array(0.8)}, SampleRequest(0, 64, 3, groups=4)).paths
    slope = session.adjoint({"rate": np.array(0.8)}, paths, np.full((4, 1, 1, 3), 1 / 3))["rate"]
    assert slope == pytest.approx((sides[0] - sides[1]) / (2 * step), rel=1e-6)


@pytest.mark.slow
def test_the_room_of_ajar_is_lit_through_the_gap_alone():
    """No emitter can be sampled from most of what the camera sees, and yet it is not dark."""
    problem = ur.gallery.problem("ajar", resolution=32, texture_resolution=8, reference_spp=256)
    assert isinstance(problem.renderer, MitsubaRenderer)
    renderer = MitsubaRenderer(problem.renderer.pair.description, max_depth=2)  # direct light alone
    truth = {key: renderer.array(value) for key, value in problem.truth.items()}
    session = renderer.prepare(list(truth), None)
    direct = np.array(session.image(truth, SampleRequest(0, 256, 1)).images)[0]
    reference = np.asarray(problem.views[0].reference)
    assert np.mean(direct.max(-1) == 0) > 0.6
    assert np.mean(reference.max(-1) > 0.01) > 0.9


@pytest.mark.slow
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


# ---------------------------------------------------------------------------------------------------- poses


@pytest.fixture(scope="module", params=quick(POSES, "box2"))
def posed(request) -> ur.Problem:
    return ur.gallery.problem(request.param, reference_spp=256)


def losses(problem: ur.Problem, points: np.ndarray, spp: int = 256, seed: int = 7) -> np.ndarray:
    """The loss in view 0 at points (B, n) of the scalar parameters, with the same random numbers at each."""
    return np.array(problem.loss_values(0, pictures(problem, points, spp, seed)))


def pictures(problem: ur.Problem, points: np.ndarray, spp: int = 256, seed: int = 7):
    keys = [parameter.key for parameter in problem.parameters]
    session = problem.renderer.prepare(keys, None, derivatives=False)
    columns = np.asarray(points, np.float32).T
    return session.image_batch(dict(zip(keys, columns, strict=True)), SampleRequest(0, spp, seed))


def start_of(problem: ur.Problem) -> np.ndarray:
    return np.array([float(np.asarray(value).item()) for value in problem.initial().values()])


def test_poses_are_counted_from_the_truth(posed):
    assert [parameter.key for parameter in posed.parameters] == POSES[posed.name]
    assert {key: value.tolist() for key, value in posed.truth.items()} == dict.fromkeys(POSES[posed.name], 0.0)
    for key, (low, high) in ((key, unknown.bounds) for key, unknown in posed.unknowns.items()):
        for value in (0.0, float(np.asarray(posed.initial()[key]).item())):
            assert low is None or low < value
            assert high is None or value < high
    # The smallest is how far one square moves along its longer side.
    assert all(error > 0.04 for error in posed.parameter_error(posed.initial()).values())
    assert posed.notices == []


def test_the_true_poses_render_to_the_reference_and_the_starts_do_not(posed):
    reference, truth = np.asarray(posed.views[0].reference, float), 0 * start_of(posed)
    seen = np.concatenate([np.array(pictures(posed, truth[None], spp=32, seed=100 + run)) for run in range(24)])
    true = scores(seen.astype(float), reference, 32, 256, rounding=1e-4)
    assert true.max() < limit(true.size)
    false, least = losses(posed, np.stack([start_of(posed), truth]))
    assert false > 100 * least


@pytest.mark.parametrize("name", quick([*PLATEAUS, "bunny"], "box2"))
def test_a_plateau_is_flat_and_there_is_none_for_the_bunny(name):
    problem = ur.gallery.problem(name, reference_spp=256)
    start = start_of(problem)
    moves = np.concatenate([np.zeros((1, start.size)), 0.03 * np.eye(start.size), -0.03 * np.eye(start.size)])
    here, *there = losses(problem, start + moves)
    change = np.abs(np.array(there) / here - 1)
    if name in PLATEAUS:
        assert change.max() < 0.01  # that of pixels which an edge divides
    else:
        assert change[[0, 1, 3, 4]].min() > 0.02


@pytest.mark.slow
def test_a_cup_with_its_handle_hidden_looks_the_same_whichever_way_it_is_turned():
    problem = ur.gallery.problem("mug", reference_spp=64)
    start = start_of(problem)
    turns = np.radians([[0.0], [-10.0], [10.0], [-60.0]])
    seen = np.array(pictures(problem, start + turns, spp=1024))
    difference = np.abs(seen - seen[0]).max(axis=-1)
    # What is left lies at outlines, which are polygons'.
    assert [np.mean(picture > 0.01) < 0.005 for picture in difference] == [True, True, True, False]
    assert difference[3].mean() > 50 * difference[1:3].mean()


@pytest.mark.slow
def test_a_cup_s_angle_and_its_label_are_recovered_in_one_run():
    problem = ur.gallery.problem("mug", label=6, resolution=24, reference_spp=256)
    choice = method("auto").plan(problem, {"sigma": 0.6, "spp": 2})
    assert isinstance(choice.estimator, ur.estimators.HybridGradient)
    assert choice.estimator.keys == ("mug.rotation.y",)
    found = ur.optimize(problem, choice, steps=60)
    angle, label = problem.parameter_error(found.parameters).values()
    assert angle < 0.06
    assert label < 0.3 * problem.parameter_error(found.initial)["mug.bsdf.brdf_0.bsdf_1.reflectance.data"]


def test_the_pose_of_the_cup_turns_it_about_its_axis():
    shapes = ur.gallery.problem("mug", resolution=4, reference_spp=1).renderer.pair.current.shapes()  # pyright: ignore[reportAttributeAccessIssue]
    box = next(shape for shape in shapes if shape.id() == "mug").bbox()
    np.testing.assert_allclose(np.array(box.center()).reshape(3)[[0, 2]], 0, atol=1e-6)


@pytest.mark.parametrize("name", ["box2", "shadow"])
@pytest.mark.slow
def test_what_moves_stays_in_the_picture_within_its_bounds(name):
    problem = ur.gallery.problem(name, reference_spp=1)
    corners = np.array([unknown.bounds for unknown in problem.unknowns.values()], float)
    points = np.array([(0, 0)] + [(corners[0, a], corners[1, b]) for a in (0, 1) for b in (0, 1)])
    brightness = np.array(pictures(problem, points)).mean(axis=(1, 2))
    np.testing.assert_allclose(brightness[1:], brightness[[0] * 4], rtol=2e-3)


def test_no_square_is_drawn_to_the_place_of_another():
    contrasts = np.array([square.colour for square in poses._FIVE]) - poses._GREY
    products = contrasts @ contrasts.T
    assert np.all(products[~np.eye(5, dtype=bool)] <= 1e-12)
    assert np.all(np.abs(contrasts).max(axis=1) >= 0.4 - 1e-12)


def test_the_ball_itself_is_never_in_the_picture():
    problem = ur.gallery.problem("shadow", resolution=16, reference_spp=1)
    sensor = problem.renderer.pair.current.sensors()[0]  # pyright: ignore[reportAttributeAccessIssue]
    u = (np.arange(64) + 0.5) / 64
    grid = mi.Point2f(*(axis.ravel().astype(np.float32) for axis in np.meshgrid(u, u)))
    ray, _ = sensor.sample_ray(0, 0.5, grid, 0.5)
    origin, direction = np.array(ray.o), np.array(ray.d)
    assert origin[1].max() < 4 - 0.32  # below the ball
    assert direction[1].max() < 0  # and looking down


@pytest.mark.parametrize(
    ("name", "sigma", "rate", "steps"),
    [
        slow("box2", 0.35, 0.05, 90),
        slow("mug", 0.6, 0.05, 100),
        slow("shadow", 0.35, 0.05, 90),
        slow("bunny", 0.15, 0.03, 90),
    ],
)
def test_smoothed_derivatives_find_the_pose(name, sigma, rate, steps):
    problem = ur.gallery.problem(name, resolution=24, reference_spp=256)
    schedule = ur.optimizers.schedules.Exponential(steps / 2)
    estimator = ur.SmoothedDerivatives(sigma=sigma, samples=32, schedule=schedule)
    result = ur.optimize(problem, estimator, ur.optimizers.Adam(rate), steps=steps, seed=3)
    errors = problem.parameter_error(result.parameters)
    assert max(errors.values()) < 0.08, errors


# ---------------------------------------------------------------------------------------------------- meshes


SPHERE = {"resolution": 16, "reference_spp": 64, "subdivisions": 1, "views": 3}


@pytest.mark.slow
def test_the_sphere_has_the_vertices_that_were_asked_for_and_no_truth():
    for subdivisions, count in ((1, 42), (3, 642)):
        problem = ur.gallery.problem("sphere-to-mesh", **SPHERE | {"subdivisions": subdivisions, "reference_spp": 1})
        points = np.array(problem.initial()["sphere.vertex_positions"]).reshape(-1, 3)
        assert points.shape == (count, 3)
        np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.7, rtol=1e-5)
        assert problem.truth == {}
        assert [view.sensor for view in problem.views] == [0, 1, 2]


@pytest.mark.slow
def test_every_view_tells_the_sphere_from_the_body():
    problem = ur.gallery.problem("sphere-to-mesh", **SPHERE)
    ball = {key: np.array(value) for key, value in problem.initial().items()}
    for view in range(3):
        reference = np.asarray(problem.views[view].reference, float)
        assert np.isfinite(reference).all()
        false = scores(renders(problem, ball, view, runs=8), reference, 32, 64, rounding=1e-4)
        assert false.max() > 1.3 * limit(false.size)


@pytest.mark.slow
def test_smoothed_derivatives_bring_the_sphere_nearer_to_the_body():
    problem = ur.gallery.problem("sphere-to-mesh", **SPHERE)
    estimator = ur.SmoothedDerivatives(sigma=0.05, samples=32, spp=2)
    result = ur.optimize(problem, estimator, ur.optimizers.Adam(0.02), steps=12, seed=1)
    first, last = (sum(step["loss"] for step in part) for part in (result.history[:2], result.history[-2:]))
    assert last < 0.8 * first


TETRAHEDRON = """v 0 0 0
v 3 0 0
v 0 3 0
v 0 0 3
f 1 3 2
f 1 4 3
f 1 2 4
f 2 3 4
"""


@pytest.mark.parametrize(("name", "scale"), [("bunny", 1.0), ("sphere-to-mesh", 2.0)])
def test_a_mesh_from_a_file_is_brought_to_size_and_place(name, scale, tmp_path):
    path = tmp_path / "body.obj"
    path.write_text(TETRAHEDRON)
    problem = ur.gallery.problem(name, mesh=path, resolution=8, reference_spp=1)
    assert [parameter.key for parameter in problem.parameters] == POSES.get(name, ["sphere.vertex_positions"])
    made = meshes.standing if name == "bunny" else meshes.centred
    box = mi.load_dict(made(str(path), {"type": "diffuse"})).bbox()
    low, high = np.array(box.min).reshape(3), np.array(box.max).reshape(3)
    np.testing.assert_allclose(high - low, scale, rtol=1e-6)
    np.testing.assert_allclose((low + high) / 2, [0, 0.5 if name == "bunny" else 0, 0], atol=1e-6)


@pytest.mark.parametrize("name", ["bunny", "sphere-to-mesh"])
@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("body.obj", None, "no such file"),
        ("body.stl", "solid", "must be the path of a .ply or .obj file"),
        ("body.obj", "nonsense", "Mitsuba could not read it"),
        ("body.ply", "nonsense", "Mitsuba could not read it"),
        ("body.obj", "v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n", "expected vertices with some extent"),
        ("body.obj", "v 0 0 0\nv 0 0 1\nv 0 1 0\nf 1 2 9\n", "Mitsuba could not read it"),
    ],
)
def test_a_mesh_that_cannot_be_read_is_one_clear_line(name, file, text, message, tmp_path):
    path = tmp_path / file
    if text is not None:
        path.write_text(text)
    with pytest.raises(ur.InputError) as caught:
        ur.gallery.problem(name, mesh=str(path), resolution=8, reference_spp=1)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("given", [7, None, ["body.obj"]])
def test_a_mesh_is_given_by_its_path(given):
    with pytest.raises(ur.InputError, match=r"mesh must be the path of a \.ply or \.obj file, got"):
        ur.gallery.problem("bunny", mesh=given)


@pytest.mark.parametrize(
    "name",
    quick([*RENDERED, *POSES, *VOLUMES, "sphere-to-mesh"], "indirect-room", "box2"),
)
def test_equal_calls_give_equal_problems(name):
    first, second = (ur.gallery.problem(name, resolution=8, reference_spp=4) for _ in range(2))
    for a, b in zip(first.views, second.views, strict=True):
        # Threads sum a mesh's vertex normals in the order in which they finish: the last digits differ, another seed's
        # picture by percents.
        np.testing.assert_allclose(
            np.asarray(a.reference), np.asarray(b.reference), rtol=1e-4 if name == "sphere-to-mesh" else 0.0
        )
    for key, value in first.initial().items():
        np.testing.assert_array_equal(np.array(value), np.array(second.initial()[key]))


def test_the_poster_is_a_thousand_numbers_by_default():
    problem = ur.gallery.problem("poster", reference_spp=1)
    assert {key: value.shape for key, value in problem.truth.items()} == {"poster.bsdf.reflectance.data": (32, 32, 1)}


# ---------------------------------------------------------------------------------------------------- the quadratic


def test_the_loss_of_the_quadratic_is_the_polynomial():
    problem = ur.gallery.problem("quad")
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20, 2))
    session = problem.renderer.prepare(["x"], None)
    batch = session.image_batch({"x": points}, SampleRequest(0, 1, 0))
    polynomial = 5 * points[:, 0] ** 2 + 5 * points[:, 1] ** 2 + 7.5 * points[:, 0] * points[:, 1]
    np.testing.assert_allclose(problem.loss_values(0, batch), polynomial, rtol=1e-12)
    for point, image in zip(points, batch, strict=True):
        np.testing.assert_allclose(session.image({"x": point}, SampleRequest(0, 4, 1, groups=2)).images, [image] * 2)
    assert np.asarray(problem.initial()["x"]).tolist() == [1.5, 1.0]
    assert problem.loss_value(0, np.zeros((1, 1, 3))) == 0


def test_the_gradient_of_the_quadratic_is_exact():
    problem = ur.gallery.problem("quad")
    point = np.array([0.3, -1.1])
    session = problem.renderer.prepare(["x"], "path")
    for request in (SampleRequest(0, 2, 1, groups=2), SampleRequest(0, 2, 1, groups=2, pixels=np.array([0]))):
        rendering = session.image_pair({"x": point}, {"x": 2 * point}, request, "path")
        assert rendering.images.shape == ((2, 1, 1, 3) if request.pixels is None else (2, 1, 3))
        weights, weights_before = (np.asarray(images) * 2 / 3 for images in (rendering.images, rendering.previous))
        now, before = session.adjoint_pair({"x": point}, {"x": 2 * point}, rendering.paths, weights, weights_before)
        np.testing.assert_allclose(now["x"], [10 * 0.3 - 7.5 * 1.1, -10 * 1.1 + 7.5 * 0.3], rtol=1e-12)
        np.testing.assert_allclose(before["x"], 2 * now["x"], rtol=1e-12)


def test_newton_solves_the_quadratic_in_a_few_steps_and_path_gradients_descend_it():
    problem = ur.gallery.problem("quad")
    estimator = ur.SmoothedDerivatives(sigma=0.3, samples=4096, order="hessian")
    found = ur.optimize(problem, estimator, ur.optimizers.Newton(trust_radius=None), steps=4, seed=0)
    assert max(problem.parameter_error(found.parameters).values()) < 0.1
    found = ur.optimize(problem, ur.PathGradient(spp=2), ur.optimizers.Adam(0.1), steps=200)
    assert max(problem.parameter_error(found.parameters).values()) < 0.01


@pytest.mark.parametrize(
    ("matrix", "point", "message"),
    [
        (np.eye(4), np.zeros(4), "n from 1 to 3"),
        (np.eye(2), np.zeros(3), "n from 1 to 3"),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), np.zeros(2), "symmetric"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), np.zeros(2), "no eigenvalue below 0"),
    ],
)
def test_a_form_that_no_picture_has_is_refused(matrix, point, message):
    with pytest.raises(ur.InputError, match=message):
        QuadraticRenderer(matrix, point)


def test_the_quadratic_knows_its_one_parameter():
    renderer = QuadraticRenderer(np.eye(3), np.ones(3))
    renderer.prepare(["x"], "path")
    np.testing.assert_array_equal(renderer.values(["x"])["x"], 1)
    with pytest.raises(ur.InputError, match="parameter y: the scene has none of that name; it has x"):
        renderer.prepare(["y"], None)


# ---------------------------------------------------------------------------------------------------- pieces


@pytest.mark.parametrize("name", ["astronaut", "chelsea", "coffee", "gravel"])
def test_photographs_are_reflectances(name):
    picture = parts.photograph(name, 16)
    assert picture.shape == (16, 16, 3)
    assert picture.dtype == np.float32
    assert parts.DARKEST <= picture.min() < picture.max() <= parts.BRIGHTEST
    # Averaged, not picked: a small picture has the mean of a large one.
    np.testing.assert_allclose(picture.mean(axis=(0, 1)), parts.photograph(name, 128).mean(axis=(0, 1)), atol=0.01)


def test_a_photograph_is_smoothed_once_and_each_caller_has_its_own(monkeypatch: pytest.MonkeyPatch):
    resized, calls = parts._resized, []
    monkeypatch.setattr(parts, "_resized", lambda *given: calls.append(given) or resized(*given))
    first = parts.photograph("coffee", 3)
    first[:] = 0
    assert parts.photograph("coffee", 3).min() >= np.float32(parts.DARKEST)
    assert len(calls) == 1


def test_a_bitmap_keeps_its_values_and_stands_upright():
    values = np.arange(12, dtype=np.float32).reshape(2, 2, 3) / 12
    texture = mi.load_dict(parts.bitmap(values))
    np.testing.assert_array_equal(np.array(mi.traverse(texture)["data"]), values)
    si = mi.SurfaceInteraction3f()
    si.uv = mi.Point2f([0.01, 0.99], [0.99, 0.01])  # top left, bottom right
    seen = np.array(texture.eval(si)).T
    np.testing.assert_allclose(seen, [values[0, 0], values[1, 1]], atol=0.02)


def test_a_repeated_bitmap_is_mirrored():
    values = np.linspace(0, 1, 8, dtype=np.float32)[None, :].repeat(8, 0)
    texture = mi.load_dict(parts.bitmap(values, repeat=(2, 1)))
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


@pytest.mark.parametrize("subdivisions", [0, 1, 3])
def test_an_icosphere_is_a_closed_sphere_that_faces_outward(subdivisions):
    points, faces = meshes.icosphere(subdivisions)
    assert points.shape == (10 * 4**subdivisions + 2, 3)
    assert faces.shape == (20 * 4**subdivisions, 3)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, rtol=1e-12)
    a, b, c = points[faces.T]
    volume = np.einsum("ij,ij->i", np.cross(a, b), c) / 6
    assert np.all(volume > 0)
    assert volume.sum() < 4 / 3 * np.pi
    if subdivisions == 3:
        assert volume.sum() > 0.98 * 4 / 3 * np.pi
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = {(int(i), int(j)) for i, j in sides}
    assert len(there) == len(sides)
    assert all((j, i) in there for i, j in there)


def test_a_swept_circle_is_a_torus_that_faces_outward():
    angle = np.linspace(0, np.pi, 65)
    path = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    mesh = meshes.sheets("handle", [meshes.Sheet(meshes.sweep(path, 0.2, 48))], {"type": "diffuse"})
    assert float(np.array(mesh.surface_area()).item()) == pytest.approx(np.pi * 2 * np.pi * 0.2, rel=2e-3)
    si = mi.load_dict({"type": "scene", "mesh": mesh}).ray_intersect(
        mi.Ray3f(mi.Point3f(0, 3, 0.01), mi.Vector3f(0, -1, 0))
    )
    assert float(np.array(si.t).item()) == pytest.approx(1.8, abs=2e-3)
    assert float(np.array(si.n.y).item()) > 0.9
    assert float(np.array(si.sh_frame.n.y).item()) > 0.99


def test_sheets_make_one_mesh_whose_fronts_are_outside():
    axes = np.diag([0.5, 1.0, 0.5])
    pieces = [meshes.Sheet(meshes.ellipsoid(axes, np.array(centre), 24, 32)) for centre in ((-1, 0, 0), (1, 0.5, 0))]
    mesh = meshes.sheets("pair", pieces, {"type": "diffuse"})
    assert mesh.vertex_count() == 2 * 24 * 33
    box = mesh.bbox()
    np.testing.assert_allclose(np.array(box.min).reshape(3), [-1.5, -1, -0.5], atol=6e-3)
    np.testing.assert_allclose(np.array(box.max).reshape(3), [1.5, 1.5, 0.5], atol=6e-3)
    scene = mi.load_dict({"type": "scene", "mesh": mesh})
    si = scene.ray_intersect(
        mi.Ray3f(mi.Point3f([-1, 1, -1, 1], [0, 0.5, 0, 0.5], [3, 3, -3, -3]), mi.Vector3f(0, 0, [-1, -1, 1, 1]))
    )
    np.testing.assert_allclose(np.array(si.t), 2.5, atol=1e-2)
    np.testing.assert_allclose(np.abs(np.array(si.sh_frame.n.z)), 1, atol=1e-2)
    assert np.all(np.array(si.n.z) * [1, 1, -1, -1] > 0.9)


def test_the_normals_of_triangles_follow_their_vertices():
    points, faces = meshes.icosphere(2)
    mesh = meshes.triangles("ball", points, faces, {"type": "diffuse"})
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float((points * [1, 0.5, 1]).ravel().astype(np.float32))
    parameters.update()
    normals = np.array(parameters["vertex_normals"]).reshape(-1, 3)
    expected = points / [1, 0.5, 1]
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert np.min(np.einsum("ij,ij->i", normals, expected)) > 0.97


def test_the_sun_of_the_vase_casts_the_light_that_its_direction_says():
    from unrender.gallery import sunlit

    scene = mi.load_dict({"type": "scene", "sky": {"type": "envmap", "bitmap": mi.Bitmap(sunlit._sky())}})
    sky = scene.emitters()[0]
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f((-sunlit.SUN).tolist())
    away = mi.SurfaceInteraction3f()
    away.wi = mi.Vector3f((sunlit.SUN * [1, -1, 1]).tolist())
    assert np.array(sky.eval(si)).min() > 100
    assert np.array(sky.eval(away)).max() < 1


def test_photographs_are_written_where_nothing_is(tmp_path):
    place = ur.gallery.photographs(tmp_path / "new" / "vase", views=3, size=8, spp=1)
    assert sorted(path.name for path in place.rglob("*.*")) == ["00.png", "01.png", "02.png", "transforms.json"]
    with pytest.raises(ur.InputError, match="holds other things"):
        ur.gallery.photographs(tmp_path / "new")
    with pytest.raises(ur.InputError, match="photographs: views must be"):
        ur.gallery.photographs(tmp_path / "few", views=2)
    assert not (tmp_path / "few").exists()
