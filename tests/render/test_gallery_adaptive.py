"""The gallery's problems for pixel mini-batches: solvable at their truth, unsolved at their start, and difficult where they say so."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

import unrender as ur
from tiers import quick
from unrender.gallery import parts, planets
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import CountingSession, SampleRequest

SPP = 1024
SMALL = {
    "mirror-trio": {"resolution": 16},
    "sun-glossy": {"resolution": 16, "texture_resolution": 8},
    "plain-and-textured": {"resolution": 16, "texture_resolution": 8},
    "two-planets": {"resolution": 16, "texture_resolution": 8, "views": 4},
    "caustic": {"resolution": 16, "texture_resolution": 8},
    "three-textures": {"resolution": 16, "texture_resolution": 8},
    "globe-and-mirror": {"resolution": 16, "texture_resolution": 8},
}
UNKNOWN = {
    "mirror-trio": {"mirror.bsdf.alpha.value": ()},
    "sun-glossy": {"doll.bsdf.diffuse_reflectance.data": (8, 8, 3)},
    "plain-and-textured": {
        "bin.bsdf.brdf_0.reflectance.value": (3,),
        "cushion.bsdf.brdf_0.reflectance.data": (8, 8, 3),
    },
    "two-planets": {"free.bsdf.reflectance.data": (8, 8, 3), "enclosed.bsdf.reflectance.data": (8, 8, 3)},
    "caustic": {"floor.bsdf.reflectance.data": (8, 8, 3)},
    "three-textures": {f"{name}.bsdf.reflectance.data": (8, 8, 3) for name in ("ball", "jar", "cone")},
    "globe-and-mirror": {"globe.bsdf.reflectance.data": (8, 8, 3)},
}
VIEWS = {
    "mirror-trio": 1, "sun-glossy": 4, "plain-and-textured": 1, "two-planets": 16, "caustic": 1, "three-textures": 4,
    "globe-and-mirror": 1,
}  # fmt: skip
NAMES = list(UNKNOWN)


@pytest.fixture(scope="module", params=quick(NAMES, "sun-glossy"))
def small(request) -> ur.Problem:
    return ur.gallery.problem(request.param, **SMALL[request.param], reference_spp=SPP)


def start_of(problem: ur.Problem) -> dict[str, np.ndarray]:
    return {key: np.array(value) for key, value in problem.initial().items()}


def renders(problem: ur.Problem, parameters: dict[str, np.ndarray], view: int, runs: int = 24) -> np.ndarray:
    """(runs, H, W, 3) independent pictures of 32 samples per pixel."""
    pictures = [ur.render(problem, parameters, view, spp=32, seed=100 + run) for run in range(runs)]
    return np.stack(pictures).astype(float)


def scores(pictures: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """z scores of mean(pictures) - reference in each channel of blocks of 4 x 4 pixels; the reference's noise follows from theirs."""

    def blocks(x: np.ndarray) -> np.ndarray:
        *lead, height, width, channels = x.shape
        return x.reshape(*lead, height // 4, 4, width // 4, 4, channels).mean(axis=(-4, -2)).reshape(*lead, -1)

    runs = len(pictures)
    variance = blocks(pictures).var(axis=0, ddof=1) * (1 / runs + 32 / SPP)
    # What has no noise (the sky itself) still differs by the rounding of single precision.
    t = (blocks(pictures).mean(axis=0) - blocks(reference)) / np.sqrt(variance + 1e-6**2)
    return np.abs(stats.norm.isf(stats.t.sf(np.abs(t), runs - 1).clip(1e-300)))


def limit(count: int, level: float = 1e-4) -> float:
    """The bound on the largest of `count` scores, at `level` after Šidák."""
    return float(stats.norm.isf((1 - (1 - level) ** (1 / count)) / 2))


def seen(problem: ur.Problem, sensor: int = 0) -> np.ndarray:
    """The id of what the middle of each pixel sees: (H, W), "" where nothing."""
    scene = problem.renderer.pair.current  # pyright: ignore[reportAttributeAccessIssue]
    height, width = np.asarray(problem.views[sensor].reference).shape[:2]
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    where = mi.Point2f(u.ravel().astype(np.float32), v.ravel().astype(np.float32))
    ray, _ = scene.sensors()[sensor].sample_ray(0, 0.5, where, 0.5)
    names = np.full(height * width, "", dtype=object)
    hit = scene.ray_intersect(ray).shape
    for shape in scene.shapes():
        names[np.array(hit == mi.ShapePtr(shape))] = shape.id()
    return names.reshape(height, width)


def at_depth(problem: ur.Problem, depth: int, spp: int = 256, sensor: int = 0) -> np.ndarray:
    """The true picture (H, W, 3) by paths of at most `depth` segments."""
    assert isinstance(problem.renderer, MitsubaRenderer)
    renderer = MitsubaRenderer(problem.renderer.pair.description, max_depth=depth)
    truth = {key: renderer.array(value) for key, value in problem.truth.items()}
    session = renderer.prepare(list(truth), None)
    return np.array(session.image(truth, SampleRequest(sensor, spp, 1)).images)[0]


# ---------------------------------------------------------------------------------------------------- each problem


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.slow
def test_pictures_have_the_size_and_number_that_were_promised(name):
    problem = ur.gallery.problem(name, reference_spp=1)
    side = 48 if name == "two-planets" else 64
    assert [np.asarray(view.reference).shape for view in problem.views] == [(side, side, 3)] * VIEWS[name]
    assert problem.loss == ur.losses.L2()


@pytest.mark.slow
def test_what_is_unknown_has_gradients_and_is_carried(small):
    assert {key: value.shape for key, value in small.truth.items()} == UNKNOWN[small.name]
    for parameter in small.parameters:
        info = small.renderer.parameters()[parameter.key]
        assert info.differentiable, info.reason
        assert info.shares_paths, info.reason
    assert small.notices == []


def test_truth_and_start_lie_inside_the_bounds_and_differ(small):
    for key, start in start_of(small).items():
        low, high = small.unknowns[key].bounds
        assert low is not None
        assert high is not None
        for values in (small.truth[key], start):
            assert np.all(values >= low)
            assert np.all(values <= high)
    errors = small.parameter_error(small.initial())
    assert all(error > 0.08 for error in errors.values()), errors


@pytest.mark.slow
def test_the_truth_renders_to_the_reference_and_the_start_does_not(small):
    for view, given in enumerate(small.views):
        reference = np.asarray(given.reference, float)
        assert np.isfinite(reference).all()
        true = scores(renders(small, small.truth, view), reference)
        false = scores(renders(small, start_of(small), view), reference)
        assert true.max() < limit(true.size), (view, true.max())
        assert false.max() > 1.3 * limit(false.size), (view, false.max())


def test_pictures_are_well_exposed(small):
    for given in small.views:
        reference = np.asarray(given.reference, float)
        assert 0.02 < np.median(reference) < 0.6
        assert np.mean(reference.max(axis=-1) > 1) < 0.05


# Options, rate, and samples per pixel, steps where all pixels are rendered; of the caustic more, for what it is. Of the globe a part is in
# no picture, and that of the ball at its lower end, so less of the error can go.
LEFT = {"globe-and-mirror": 0.98}
DESCENTS = {
    "mirror-trio": ({}, 0.01, 8, 40),
    "sun-glossy": ({}, 0.02, 8, 30),
    "plain-and-textured": ({}, 0.02, 8, 40),
    "two-planets": ({}, 0.02, 8, 30),
    "caustic": ({"resolution": 32, "texture_resolution": 32}, 0.01, 16, 60),
    "three-textures": ({"resolution": 64}, 0.02, 8, 80),
    "globe-and-mirror": ({"resolution": 64}, 0.01, 8, 80),
}


@pytest.mark.parametrize(
    ("name", "drawn"),
    [*((name, False) for name in NAMES), ("mirror-trio", True)],
    ids=lambda given: {True: "uniform", False: "all"}.get(given, given),
)
@pytest.mark.slow
def test_a_plain_descent_approaches_the_truth(name, drawn):
    options, rate, spp, steps = DESCENTS[name]
    problem = ur.gallery.problem(name, **SMALL[name] | options, reference_spp=512)
    estimator = ur.PathGradient(spp=spp)
    if drawn:
        pixels = sum(np.asarray(view.reference)[..., 0].size for view in problem.views)
        estimator = ur.PathGradient(pixels=ur.pixels.Uniform(pixels // 2), spp=spp // 2)
        steps *= 2
    found = ur.optimize(problem, estimator, ur.optimizers.Adam(rate), steps=steps, seed=1)
    assert found.skipped == 0
    assert found.warnings == []
    before, after = problem.parameter_error(found.initial), problem.parameter_error(found.parameters)
    for key in before:
        assert after[key] < LEFT.get(name, 0.9) * before[key], (key, before[key], after[key])


@pytest.mark.parametrize("name", quick(NAMES, "three-textures"))
def test_equal_calls_give_equal_problems(name):
    first, second = (ur.gallery.problem(name, **SMALL[name], reference_spp=4) for _ in range(2))
    for a, b in zip(first.views, second.views, strict=True):
        np.testing.assert_array_equal(a.reference, b.reference)
    for key, value in start_of(first).items():
        np.testing.assert_array_equal(value, start_of(second)[key])


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("mirror-trio", {"texture_resolution": 8}, "no option texture_resolution"),
        ("mirror-trio", {"max_depth": 2}, "max_depth must be a whole number of at least 3, got 2"),
        ("sun-glossy", {"views": 33}, "views must be at most 32, got 33"),
        ("sun-glossy", {"loss": "relativel2"}, "did you mean RelativeL2?"),
        ("two-planets", {"max_depth": 5}, "max_depth must be a whole number of at least 6, got 5"),
        ("two-planets", {"views": 0}, "views must be a whole number of at least 1, got 0"),
        ("three-textures", {"views": 33}, "views must be at most 32, got 33"),
        ("globe-and-mirror", {"max_depth": 6}, "max_depth must be a whole number of at least 7, got 6"),
        ("caustic", {"max_depth": 3}, "max_depth must be a whole number of at least 4, got 3"),
    ],
)
def test_a_bad_option_is_one_clear_line(name, options, message):
    with pytest.raises(ur.InputError) as caught:
        ur.gallery.problem(name, **options)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------------------------------------------- their difficulties


@pytest.mark.slow
def test_the_roughness_shows_in_the_mirror_alone_which_fills_a_part_of_the_picture():
    problem = ur.gallery.problem("mirror-trio", resolution=48, reference_spp=256)
    mirror = seen(problem) == "mirror"
    assert 0.04 < mirror.mean() < 0.2
    start = ur.render(problem, start_of(problem), spp=256, seed=4)
    change = np.abs(start - np.asarray(problem.views[0].reference)).mean(axis=-1)
    assert change[mirror].sum() > 0.3 * change.sum()
    assert change[mirror].mean() > 5 * np.median(change[~mirror])
    # Within it, what is mirrored matters: not all of its pixels alike.
    assert change[mirror].max() > 2 * np.median(change[mirror])


def test_the_sun_is_small_and_bright_and_mirrored_in_the_lacquer():
    problem = ur.gallery.problem("sun-glossy", views=1, reference_spp=256)
    on_doll = np.asarray(problem.views[0].reference)[seen(problem) == "doll"].max(axis=-1)
    assert on_doll.size > 300
    assert on_doll.max() > 4 * np.median(on_doll)


@pytest.mark.slow
def test_a_relative_loss_gives_the_dark_pixels_more_of_the_whole():
    shares = []
    for loss in ("L2", "RelativeL2"):
        problem = ur.gallery.problem("sun-glossy", views=1, reference_spp=256, loss=loss)
        reference = np.asarray(problem.views[0].reference)
        picture = ur.render(problem, start_of(problem), spp=256, seed=4)
        value = np.asarray(problem.loss.value(picture, reference)).mean(axis=-1)
        on_doll = seen(problem) == "doll"
        dark = on_doll & (reference.mean(axis=-1) < np.median(reference[on_doll].mean(axis=-1)))
        shares.append(value[dark].sum() / value[on_doll].sum())
    assert shares[1] > 1.3 * shares[0]


@pytest.mark.slow
def test_bin_and_cushion_fill_about_as_many_pixels():
    problem = ur.gallery.problem("plain-and-textured", reference_spp=1)
    names = seen(problem)
    sizes = [np.mean(names == name) for name in ("bin", "cushion")]
    assert min(sizes) > 0.08
    assert max(sizes) < 2.5 * min(sizes)


def test_each_planet_starts_as_the_other_and_the_glass_is_no_parameter():
    problem = ur.gallery.problem("two-planets", **SMALL["two-planets"], reference_spp=1)
    start = start_of(problem)
    free, enclosed = UNKNOWN["two-planets"]
    np.testing.assert_array_equal(start[free], problem.truth[enclosed])
    np.testing.assert_array_equal(start[enclosed], problem.truth[free])
    assert not any("glass" in parameter.key or "hollow" in parameter.key for parameter in problem.parameters)


@pytest.mark.slow
def test_only_paths_of_six_segments_reach_the_enclosed_planet_and_they_are_noisy():
    problem = ur.gallery.problem("two-planets", views=4, resolution=32, texture_resolution=16, reference_spp=256)
    assert isinstance(problem.renderer, MitsubaRenderer)
    names = seen(problem)
    free, glass = names == "free", names == "glass"
    # The middle of the glass shows the planet: at five segments it is black but for what the glass mirrors.
    inner = glass & (np.asarray(problem.views[0].reference).mean(axis=-1) > 3 * at_depth(problem, 5).mean(axis=-1))
    assert inner.mean() > 0.25 * glass.mean()
    assert at_depth(problem, 2)[free].mean() > 0.05
    spread = renders(problem, problem.truth, 0).std(axis=0).mean(axis=-1)
    assert np.median(spread[inner]) > 2 * np.median(spread[free])


@pytest.mark.slow
def test_paths_into_the_sky_have_no_vertices_and_those_through_glass_the_most():
    problem = ur.gallery.problem("two-planets", **SMALL["two-planets"], reference_spp=1)
    start = problem.initial()
    session = problem.renderer.prepare(list(start), None)
    assert isinstance(session, CountingSession)
    count = np.array(session.vertices(start, SampleRequest(0, 64, 1)))[..., 0]
    names = seen(problem)
    assert np.median(count[names == ""]) == 0
    assert 1 <= np.median(count[names == "free"]) < np.median(count[names == "glass"]) <= 6


@pytest.mark.parametrize("planet", [planets.blue, planets.red])
def test_a_planet_has_no_seam_and_is_of_real_paint(planet):
    picture = planet(64)
    assert picture.shape == (64, 64, 3)
    assert picture.dtype == np.float32
    assert 0.02 < picture.min() < picture.max() < 0.95
    across = np.abs(picture[:, 0] - picture[:, -1]).mean()
    assert across < 2 * np.abs(np.diff(picture, axis=1)).mean()


@pytest.mark.slow
def test_three_things_are_seen_from_all_around_beside_ground_that_tells_little():
    problem = ur.gallery.problem("three-textures", reference_spp=1)
    for sensor in range(4):
        names = seen(problem, sensor)
        assert all(np.mean(names == name) > 0.015 for name in ("ball", "jar", "cone"))
        assert np.mean(names == "ground") > 0.5


@pytest.mark.slow
def test_the_mirror_shows_the_globe_by_paths_of_seven_segments():
    problem = ur.gallery.problem("globe-and-mirror", resolution=32, texture_resolution=16, reference_spp=256)
    names = seen(problem)
    assert 0.05 < np.mean(names == "mirror") < 0.3
    assert 0.15 < np.mean(names == "glass") < 0.5
    reference, without = (x.mean(axis=-1) for x in (np.asarray(problem.views[0].reference), at_depth(problem, 6)))
    mirrored = (names == "mirror") & (reference > 1.5 * without + 0.02)
    assert mirrored.sum() > 0.15 * np.sum(names == "mirror")


@pytest.mark.slow
def test_the_caustic_lights_the_floor_by_few_bright_samples():
    problem = ur.gallery.problem("caustic", resolution=32, reference_spp=512)
    floor = seen(problem) == "floor"
    reference = np.asarray(problem.views[0].reference).mean(axis=-1)
    without = at_depth(problem, 3).mean(axis=-1)
    assert reference[floor].sum() > 1.5 * without[floor].sum()  # lamps through glass need four segments
    bright = floor & (reference > 3 * without)
    assert bright.sum() > 50
    one = np.stack([ur.render(problem, problem.truth, 0, spp=1, seed=run) for run in range(64)]).mean(axis=-1)[
        :, bright
    ]
    assert np.median(one) < 0.5 * one.mean()  # most samples miss
    assert one.max() > 10 * one.mean()


def test_a_sky_has_its_sun_where_it_was_put_and_its_colours_elsewhere():
    towards = np.array([0.6, 0.64, 0.48])
    picture = parts.picture(towards, 0.2, (9.0, 8.0, 7.0), ((0, 0, 1), (0, 1, 0), (1, 0, 0)), rows=64)
    assert picture.shape == (64, 128, 3)
    sky = mi.load_dict({"type": "scene", "sky": parts.environment(picture)}).emitters()[0]

    def look(direction) -> np.ndarray:
        si = mi.SurfaceInteraction3f()
        si.wi = mi.Vector3f((-np.asarray(direction, float)).tolist())
        return np.array(sky.eval(si)).ravel()

    np.testing.assert_allclose(look(towards), [9, 8, 7], rtol=1e-4)
    assert np.argmax(look([0.0, 1.0, 0.0])) == 2
    np.testing.assert_allclose(look([0.0, -1.0, 0.0]), [1, 0, 0], atol=1e-4)
    # The share of the sphere, times how much larger the picture shows it at that height.
    share = (1 - np.cos(0.2)) / 2 * (2 / np.pi) / np.sqrt(1 - 0.64**2)
    assert np.mean(picture[..., 0] == 9) == pytest.approx(share, rel=0.1)
