# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

"""Views whose references are depths, positions, normals, albedos or masks: values, gradients, runs, and bad input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from tiers import quick
from unrender.core.errors import InputError
from unrender.estimators.fresh_pictures import Residuals
from unrender.rendering import AOVS
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest
from unrender.runs.determination import undetermined
from unrender.runs.verification import misfit
from unrender.scene.fingerprint import fingerprint

pytestmark = pytest.mark.mitsuba

SIZE, BALL, FLOOR, MOVES = 8, "ball.vertex_positions", "floor.bsdf.reflectance.value", "floor.translation.z"
CHANNELS = {"depth": 1, "position": 3, "sh_normal": 3, "albedo": 3}


def scene(x: float = 0.0, paint: tuple[float, ...] = (0.4, 0.5, 0.6), **more: Any) -> dict[str, Any]:
    """A red ball above a floor, before an empty background."""
    look = mi.ScalarTransform4f().look_at([0, 0.5, 4], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    ground = mi.ScalarTransform4f().translate([0, -0.8, 0]).rotate([1, 0, 0], -90).scale(1.5)
    return {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 40, "to_world": look, "film": film},
        "light": {"type": "point", "position": [0, 3, 3], "intensity": {"type": "rgb", "value": [10.0, 10.0, 10.0]}},
        "floor": {
            "type": "rectangle",
            "to_world": ground,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(paint)}},
        },
        "ball": {
            "type": "sphere",
            "radius": 0.7,
            "center": [x, 0.0, 0.0],
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.2, 0.1]}},
        },
        **more,
    }


@pytest.fixture(scope="module")
def renderer() -> MitsubaRenderer:
    return MitsubaRenderer(scene, 3, [BALL])


def images(renderer: Any, values: dict[str, np.ndarray], seeds: range, spp: int = 1024) -> np.ndarray:
    session = renderer.prepare(list(values), None, derivatives=False)
    tree = {key: renderer.array(x) for key, x in values.items()}
    return np.stack([session.image(tree, SampleRequest(0, spp, seed)).images.numpy()[0] for seed in seeds])


def picture(name: str, **of: Any) -> np.ndarray:
    """A picture of many samples by Mitsuba's own integrator, which has no masks."""
    made = mi.load_dict(scene(**of))
    if name == "mask":
        renderer = MitsubaRenderer(lambda: scene(**of), 1).with_aov("mask")
        return images(renderer, {FLOOR: np.array([0.4, 0.5, 0.6])}, range(1), 4096)[0, ..., :1]
    integrator = mi.load_dict({"type": "aov", "aovs": f"a:{name}"})
    return np.array(mi.render(made, integrator=integrator, spp=1024))


def problem(views: list[ur.View], keys: tuple[str, ...] = (FLOOR,), **options: Any) -> ur.Problem:
    return ur.Problem(scene, [ur.Parameter(key) for key in keys], views, **options)


def test_values_are_those_of_mitsubas_integrator(renderer: MitsubaRenderer) -> None:
    integrator = mi.load_dict({"type": "aov", "aovs": ",".join(f"{name}:{name}" for name in CHANNELS)})
    theirs = np.stack(
        [np.array(mi.render(renderer.pair.current, integrator=integrator, spp=1024, seed=seed)) for seed in range(8)]
    )
    first = 0
    for name, count in CHANNELS.items():
        ours = images(renderer.with_aov(name), {FLOOR: np.array([0.4, 0.5, 0.6])}, range(100, 108))
        expected = theirs[..., first : first + count]
        first += count
        error = np.sqrt((ours[..., :count].var(axis=0, ddof=1) + expected.var(axis=0, ddof=1)) / 8)
        difference = ours[..., :count].mean(axis=0) - expected.mean(axis=0)
        assert (np.abs(difference) < 6 * error + 1e-4).all(), name
        assert not (np.abs(1.05 * ours[..., :count].mean(axis=0) - expected.mean(axis=0)) < 6 * error + 1e-4).all()
    mask = images(renderer.with_aov("mask"), {FLOOR: np.array([0.4, 0.5, 0.6])}, range(2)).mean(axis=0)
    depth = theirs[..., 0].mean(axis=0)
    assert (mask[..., 0][depth == 0] == 0).all()
    assert mask[SIZE // 2, SIZE // 2] == pytest.approx(1.0)


def leaf() -> dict[str, Any]:
    """A rectangle with an opacity mask in front of the ball."""
    place = mi.ScalarTransform4f().translate([0.4, 0.3, 1.0]).scale(0.3)
    return {
        "leaf": {
            "type": "rectangle",
            "to_world": place,
            "bsdf": {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}},
        }
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", quick(AOVS, "depth"))
@pytest.mark.parametrize("masked", quick([False, True], True))
def test_derivatives_by_positions_are_those_of_differences(renderer: MitsubaRenderer, name: str, masked: bool) -> None:
    """The ball grows and is shifted: silhouettes move. Without them the derivative of all but the albedo would be wrong."""
    of = (MitsubaRenderer(lambda: scene(**leaf()), 3, [BALL]) if masked else renderer).with_aov(name)
    positions = of.values([BALL])[BALL].numpy().reshape(-1, 3)
    weights = np.random.default_rng(1).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
    along = positions + np.array([0.7, 0.2, 0.0], np.float32)

    def moved(step: float) -> np.ndarray:
        return images(of, {BALL: (positions + step * along).ravel()}, range(6), 1 << 14)

    slopes = np.sum((moved(0.02) - moved(-0.02)) / 0.04 * weights, axis=(1, 2, 3))
    session: Any = of.prepare([BALL], None)
    tree = {BALL: of.array(positions.ravel())}

    def agree(boundary: Any) -> bool:
        session._boundary, found = boundary, []
        for seed in range(50, 56):
            rendering = session.image(tree, SampleRequest(0, 4096, seed))
            gradient = session.adjoint(tree, rendering.paths, mi.TensorXf(weights[None]))[BALL].numpy()
            found.append(float(np.sum(gradient.reshape(-1, 3) * along)))
        error = np.sqrt((np.var(slopes, ddof=1) + np.var(found, ddof=1)) / 6)
        return bool(abs(np.mean(found) - np.mean(slopes)) < 5 * error)

    boundary = session._boundary
    assert agree(boundary)
    assert not agree(None)  # the planted fault: silhouettes that stand still


@pytest.mark.slow
def test_the_gradient_of_a_mesh_by_colour_depth_and_mask_is_the_slope_of_the_loss() -> None:
    """The ball grows and is shifted. A gradient without any of the three is found out."""
    names, weights = (None, "depth", "mask"), (200.0, 0.3, 2.0)
    path = mi.load_dict({"type": "path", "max_depth": 3})
    colour = np.array(mi.render(mi.load_dict(scene(0.2)), integrator=path, spp=1024))
    references = [colour, picture("depth", x=0.2), picture("mask", x=0.2)]
    views = [ur.View(*of) for of in zip(references, (0,) * 3, weights, strict=True)]
    views = [replace(view, aov=name) for view, name in zip(views, names, strict=True)]
    made = problem(views, (BALL,), max_depth=3)
    positions = made.initial_values()[BALL].reshape(-1, 3)
    along, step, runs = positions + np.array([0.7, 0.2, 0.0], np.float32), 0.02, 8

    def loss(at: np.ndarray, view: int, seed: int) -> float:
        pictures = [ur.render(made, {BALL: at.ravel()}, view, spp=1 << 13, seed=2 * seed + half) for half in (0, 1)]
        one, other = (np.asarray(one, float) - np.asarray(made.views[view].reference) for one in pictures)
        return weights[view] * float(np.mean(one * other))

    def slopes(view: int) -> np.ndarray:
        ends = [[loss(positions + sign * step * along, view, seed) for seed in range(runs)] for sign in (1, -1)]
        return (np.array(ends[0]) - np.array(ends[1])) / (2 * step)

    by_view = [slopes(view) for view in range(3)]
    estimates = [ur.estimate(made, ur.PathGradient(spp=2048), seed=seed).gradient[BALL] for seed in range(runs)]
    found = np.array([np.sum(gradient.reshape(-1, 3) * along) for gradient in estimates])

    def z(one: np.ndarray, other: np.ndarray) -> float:
        return abs(one.mean() - other.mean()) / np.sqrt((one.var(ddof=1) + other.var(ddof=1)) / runs)

    expected = sum(by_view)
    assert z(found, expected) < 4.5
    assert all(z(found, expected - of_view) > 4.5 for of_view in by_view)


@pytest.mark.slow
@pytest.mark.parametrize("method", quick(["auto", "plain", "rcv", "coupled", "adaptive"], "auto"))
def test_albedo_and_depth_share_one_descent(method: str) -> None:
    views = [ur.View(picture("albedo"), aov="albedo", weight=2.0), ur.View(picture("depth"), aov="depth")]
    made = ur.Problem(scene, [ur.Parameter(FLOOR, initial=0.2)], views, truth={FLOOR: [0.4, 0.5, 0.6]})
    result = ur.optimize(made, method, steps=60)
    assert made.parameter_error(result.parameters)[FLOOR] < 0.05
    assert ur.render(made, view=1, spp=64)[SIZE // 2, SIZE // 2, 0] == pytest.approx(3.3, abs=0.1)


def test_depths_do_not_hide_changes_of_colour_from_tests() -> None:
    """A light 1.2 times as bright was "not determined": it changes pictures by little beside distances of 4."""
    key = "light.intensity.value"
    views = [ur.View(np.full((SIZE, SIZE, 3), 0.04)), ur.View(np.full((SIZE, SIZE), 4.0), aov="depth")]
    made = problem(views, (key,))
    assert made.units == pytest.approx([1.0, 1e-2])
    assert [made.test_weights(view).mean() for view in (0, 1)] == [1.0, 1.0]
    assert problem(views[:1], (key,)).units == [1.0]
    assert not undetermined(made, {key: np.full(3, 12.0, np.float32)}, 16)


def test_a_wrong_depth_beside_colours_is_a_difference() -> None:
    """Depths of 2 for 4 are off by half, right colours by nothing: together by half over the root of 2. It had been a hundredth of that."""
    views = [ur.View(np.full((SIZE, SIZE, 3), 0.04)), ur.View(np.full((SIZE, SIZE), 4.0), aov="depth")]
    noise = np.random.default_rng(0).normal(1.0, 1e-3, (2, 8, SIZE, SIZE, 3)).astype(np.float32)
    images = [list(0.04 * noise[0]), list(2.0 * noise[1])]
    found = misfit(Residuals.of(problem(views, (MOVES,)), [0, 1], images), 0.05)
    assert found is not None
    assert found.error / found.size == pytest.approx(0.5 / np.sqrt(2.0), rel=0.01)


@pytest.mark.parametrize("name", ["depth", "mask"])
def test_a_pose_is_recovered_from_one_picture(name: str) -> None:
    made = problem([ur.View(picture(name, x=0.3), aov=name)], ("ball.translation.x",))
    result = ur.optimize(made, ur.GaussNewton(16, derivative_spp=8), ur.optimizers.AveragedNewton(), steps=15)
    assert result.parameters["ball.translation.x"] == pytest.approx(0.3, abs=0.03)


def test_a_camera_is_recovered_from_its_depths() -> None:
    """Depths are another sensor of the same camera: their derivative was left out, so the camera stayed at its start."""
    key, blank = "camera.translation.x", ur.View(np.zeros((SIZE, SIZE)), aov="depth")
    made = problem([blank], (key,))
    seen = np.asarray(ur.render(made, {key: np.float32(0.3)}, spp=256))[..., :1]
    made = made.replaced(views=[replace(blank, reference=seen)])
    result = ur.optimize(made, ur.GaussNewton(16, derivative_spp=8), ur.optimizers.AveragedNewton(), steps=15)
    assert result.parameters[key] == pytest.approx(0.3, abs=0.03)
    both = made.replaced(views=[ur.View(np.zeros((SIZE, SIZE, 3))), made.original_views[0]])
    assert [x.renderer.parameters()[key].sensor for x in (made, both)] == [made.views[0].sensor, None]


@pytest.mark.slow
def test_a_mesh_may_move_beside_opacity_masks_where_no_view_has_colour() -> None:
    """It was refused: the renderer of colour, which no view uses, has no such derivative."""
    depth = ur.View(np.ones((SIZE, SIZE)), aov="depth")
    made = ur.Problem(scene(**leaf()), [ur.Parameter(BALL)], [depth])
    assert ur.optimize(made, "plain", steps=1, progress=False).steps == 1
    assert not any("renders masks" in line for line in made.notices), "a notice about light in a picture of depths"
    colour = ur.View(np.ones((SIZE, SIZE, 3)))
    for views in ([depth, colour], [colour]):
        coloured = made.replaced(views=views)
        assert any("renders masks" in line for line in coloured.notices)
        with pytest.raises(InputError, match="do not support opacity masks"):
            coloured.renderer.prepare([BALL], None)


@pytest.mark.slow
def test_a_mesh_follows_masks() -> None:
    made = problem([ur.View(picture("mask", x=0.2), aov="mask")], (BALL,))
    result = ur.optimize(made, steps=60)
    start, end = (
        np.sqrt(np.mean((ur.render(made, values, spp=256) - np.asarray(made.views[0].reference)) ** 2))
        for values in (result.initial, result.parameters)
    )
    assert end < 0.4 * start


@pytest.mark.usefixtures("short_ends")
def test_a_file_names_the_aov_and_a_run_folder_keeps_it(tmp_path: Path) -> None:
    (tmp_path / "room.xml").write_text(XML)
    np.save(tmp_path / "depth.npy", picture("depth"))
    lines = ['scene = "room.xml"', "[[parameters]]", f'key = "{MOVES}"', "[[views]]", 'reference = "depth.npy"']
    (tmp_path / "problem.toml").write_text("\n".join([*lines, 'aov = "depth"']))
    made = ur.Problem.from_file(tmp_path / "problem.toml")
    (tmp_path / "other.toml").write_text("\n".join([*lines, 'aov = "mask"']))
    with pytest.raises(InputError, match=r"other.toml:5: views\[0\].reference: expected values from 0 to 1, got"):
        ur.Problem.from_file(tmp_path / "other.toml")
    ur.optimize(made, "plain", steps=1, run_directory=tmp_path / "run")
    again = ur.Problem.from_file(tmp_path / "run" / "problem.toml")
    assert again.original_views[0].aov == "depth"
    assert fingerprint(again) == fingerprint(made)


def test_masks_may_be_alpha_and_integers() -> None:
    coverage = np.zeros((SIZE, SIZE), np.uint8)
    coverage[2:6, 2:6] = 255
    cut = np.full((SIZE, SIZE, 4), 128, np.uint8)
    cut[..., 3] = coverage
    for given in (coverage, cut, coverage > 0, coverage / 255.0):
        view = problem([ur.View(given, aov="mask")], (MOVES,)).views[0]
        np.testing.assert_allclose(np.asarray(view.reference)[..., 0], coverage / 255.0)
        assert view.mask is None
    with pytest.raises(InputError, match=r"view 0: reference: its largest value is 0\.0039: expected 1 where"):
        problem([ur.View(coverage // 255, aov="mask")], (MOVES,))


XML = f"""<scene version="3.0.0"><sensor type="perspective"><float name="fov" value="40"/>
<film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/><rfilter type="box"/></film></sensor>
<shape type="rectangle" id="floor"><transform name="to_world"><translate z="3"/><rotate y="1" angle="180"/></transform>
<bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape></scene>"""
FOG = {"fog": {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}}
BAD: dict[str, tuple[Any, dict[str, Any], str]] = {
    "unknown": (np.zeros((SIZE, SIZE)), {"aov": "normal"}, "view 0: aov: expected one of depth, position, sh_normal"),
    "size": (np.zeros((SIZE, 4)), {"aov": "depth"}, "view 0: reference: 4x8 pixels"),
    "integers": (np.zeros((SIZE, SIZE), np.uint8), {"aov": "depth"}, "8- and 16-bit values cannot be a depth"),
    "one channel": (np.zeros((SIZE, SIZE)), {"aov": "sh_normal"}, "expected the three coordinates of a sh_normal"),
    "colours": (np.eye(SIZE)[..., None] * [1, 2, 3], {"aov": "depth"}, "expected one channel, or three equal ones"),
    "negative": (np.full((SIZE, SIZE), -1.0), {"aov": "depth"}, "64 pixels are negative"),
    "range": (np.full((SIZE, SIZE), 2.0), {"aov": "mask"}, "expected values from 0 to 1, got 2 to 2"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_views_are_refused_in_one_line(case: str) -> None:
    reference, options, message = BAD[case]
    with pytest.raises(InputError) as caught:
        problem([ur.View(reference, **options)])
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_has_no_such_pictures_is_refused() -> None:
    views = [ur.View(np.zeros((SIZE, SIZE)), aov="depth")]
    foggy = scene(**FOG)
    with pytest.raises(InputError, match="view 0: aov: depth is a property of surfaces, and the scene has media"):
        ur.Problem(foggy, [ur.Parameter(FLOOR)], views)
    with pytest.raises(InputError, match="aov: not supported together with the unknown exposure"):
        problem(views, (FLOOR, "exposure"))
    made = problem(views, ("camera.rotation.y",))
    with pytest.raises(InputError, match="path gradients of moving sensors do not support depth"):
        ur.optimize(made, "plain", steps=1)


DEPTH = ur.View(np.zeros((SIZE, SIZE)), aov="depth")
DARK = ur.View(np.zeros((SIZE, SIZE, 3)), known={"light.intensity.value": 0.0})
UNSEEN: list[tuple[str, list[ur.View], str]] = [
    (FLOOR, [DEPTH], "view 0 has the aov depth, which does not show it"),
    ("light.intensity.value", [replace(DEPTH, aov="albedo")], "view 0 has the aov albedo"),
    ("light.translation", [DEPTH, replace(DEPTH, aov="mask")], "view 0 has the aov depth, .* view 1 has the aov mask"),
    ("light.intensity.value", [DARK, DEPTH], "view 0 knows it, view 1 has the aov depth"),
    ("strength", [DARK, DEPTH], "view 0 knows it, view 1 has the aov depth"),
    (BALL.replace("positions", "normals"), [DEPTH], "view 0 has the aov depth"),
    ("other.rotation.y", [DARK], "view 0 has sensor 0, and it moves sensor 1"),
]


@pytest.mark.parametrize(("key", "views", "message"), UNSEEN)
def test_an_unknown_that_no_view_shows_is_refused(key: str, views: list[ur.View], message: str) -> None:
    """A run ended with the initial value, and said so in its last lines."""
    second = {"other": scene()["camera"]} if key.startswith("other") else {}
    derived = {"expressions": {"light.intensity.value": "strength"}} if key == "strength" else {}

    def made(*more: ur.View) -> ur.Problem:
        unknown = ur.Parameter(key, initial=1.0 if derived else None)
        return ur.Problem(lambda: scene(ball={"type": "cube"}, **second), [unknown], [*views, *more], **derived)

    with pytest.raises(InputError, match=rf"parameters\[0\].key: no view depends on {key}: {message}"):
        made()
    made(ur.View(np.zeros((SIZE, SIZE, 3)), sensor=len(second)))


def test_noise_in_other_units_is_no_scale_of_a_prior() -> None:
    """Depths in thousandths made a prior of the floor's paint 1e5 times as strong; exact ones halved it, and that of what both show stayed.

    For the floor's height the scale is the mean of those of the views alone by their curvatures, here from differences of pictures.
    """
    height, near = MOVES.replace(".z", ".y"), {"near": "initial", "std": 0.1}
    noise = np.abs(np.random.default_rng(0).normal(0, 0.03, (SIZE, SIZE, 3)))

    def made(key: str, *of: ur.View) -> ur.Problem:
        return ur.Problem(scene, [ur.Parameter(key, initial=None, prior=near)], of, max_depth=2)

    still = made(height, ur.View(np.zeros((SIZE, SIZE, 3))), DEPTH)
    pictures = [
        [ur.render(still, {height: np.array(y, np.float32)}, n, spp=256) for y in (-0.1, 0.0, 0.1)] for n in (0, 1)
    ]
    colour, exact = ur.View(pictures[0][1] + noise), replace(DEPTH, reference=pictures[1][1][..., :1])
    coarse = replace(DEPTH, reference=1000 * (exact.reference + noise[..., :1]))
    (alone,) = made(FLOOR, colour).prior_scales.values()
    for depth in (exact, coarse):
        assert made(FLOOR, colour, depth).prior_scales[FLOOR] == pytest.approx(alone, rel=1e-6)
    both, own = made(height, colour, exact), [made(height, view).prior_scales[height] for view in (colour, exact)]
    slopes = [np.mean(np.square(high - low)) for low, _, high in pictures]
    assert both.prior_scales[height] == pytest.approx(np.average(own, weights=slopes), rel=0.5)


def test_albedos_that_depend_on_normals_show_them() -> None:
    """A rough conductor's do; its normals were refused as an unknown."""
    metal = {"type": "cube", "bsdf": {"type": "roughconductor", "alpha": 0.3}}
    key, renderer = "ball.vertex_normals", MitsubaRenderer(lambda: scene(ball=metal))
    normals = np.asarray(renderer.values([key])[key])
    one, other = (images(renderer.with_aov("albedo"), {key: normals + by}, range(1), 16) for by in (0.0, 0.2))
    assert np.abs(one - other).max() > 1e-3
    assert renderer.with_aov("albedo").parameters()[key].shown


def test_only_rays_that_hit_a_surface_have_a_vertex() -> None:
    renderer, request = MitsubaRenderer(scene()), SampleRequest(0, 4, 1)
    session: Any = renderer.with_aov("mask").prepare([FLOOR], None)
    mask = session.image({}, request).images.numpy()[0]
    assert 0 < mask.mean() < 1
    np.testing.assert_array_equal(session.vertices({}, request).numpy(), mask)
