"""Poses of lights against scenes in which the light was moved for good, and what they refuse."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from benchmarks.shapes.lights import run as lights
from tiers import quick
from unrender.methods import method
from unrender.methods.rules import newton, places
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

TURN = np.array([0.1, 0.5, -0.2])
"""A rotation vector."""
SHIFT, SCALE = [0.3, -0.2, 0.25], 1.4
PICTURE = np.random.default_rng(0).uniform(0.2, 1, (4, 8, 3)).astype(np.float32)
EMITTER = {"type": "area", "radiance": {"type": "rgb", "value": 9.0}}


def motion(centre: Any, turn: Any = (0.0, 0.0, 0.0), shift: Any = (0.0, 0.0, 0.0), scale: float = 1.0) -> Any:
    """The matrix x -> c + shift + scale R (x - c)."""
    there = mi.ScalarTransform4f().translate((np.array(centre) + shift).tolist())
    angle = float(np.linalg.norm(turn))
    if angle:
        there = there.rotate((np.array(turn) / angle).tolist(), np.degrees(angle))
    return there.scale(scale).translate((-np.array(centre)).tolist())


def down(origin: list[float]) -> Any:
    return mi.ScalarTransform4f().look_at(origin, [0.2, 0, 0], [1, 0, 0])


HEAD = [0.0, 3.0, 1.0]
STANDS, LIES, FAR = (
    (HEAD, ("translation", "rotation")),
    ([0.3, 2, 0], ("translation", "rotation", "scale")),
    ([0, 0, 0], ("rotation",)),
)
LIGHTS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "point": ([0, 0, 0], ("translation",)),
    **dict.fromkeys(("spot", "projector"), STANDS),
    **dict.fromkeys(("directional", "envmap", "sunsky"), FAR),
    **dict.fromkeys(("rectangle", "cube", "sphere", "disk"), LIES),
}
"""{kind: what it turns about, the parts of its pose}."""


def light(kind: str, moved: Any = None) -> dict[str, Any]:
    """The light as it stands, or moved by a matrix."""
    m = mi.ScalarTransform4f() if moved is None else moved
    match kind:
        case "point":
            return {
                "type": kind,
                "position": (np.array([0, 2, 1]) + np.array(m.matrix)[:3, 3]).tolist(),
                "intensity": 9.0,
            }
        case "spot":
            return {"type": kind, "to_world": m @ down(HEAD), "intensity": 9.0}
        case "projector":
            picture = {"type": "bitmap", "bitmap": mi.Bitmap(PICTURE), "raw": True}
            return {"type": kind, "to_world": m @ down(HEAD), "irradiance": picture, "fov": 40, "scale": 9.0}
        case "directional":
            return {"type": kind, "to_world": m @ down([0, 0, 1])}
        case "envmap":
            return {"type": kind, "bitmap": mi.Bitmap(PICTURE), "to_world": m}
        case "sunsky":
            sun = np.array(m.matrix)[:3, :3] @ [0.3, 0.8, 0.4]
            return {"type": kind, "sun_direction": sun.tolist(), "to_world": m}
    place = mi.ScalarTransform4f().translate([0.3, 2, 0]).rotate([1, 0, 0], 90).scale(0.3)
    return {"type": kind, "to_world": m @ place, "emitter": EMITTER}


def test_auto_finds_a_far_rotation_beside_an_unknown_scale() -> None:
    sky = unknown_light("sky")[0]
    path = mi.load_dict({"type": "path", "max_depth": 2})
    reference = np.array(mi.render(mi.load_dict(room(lamp=sky)), integrator=path, spp=256))
    unknown = [ur.Parameter("lamp.rotation.y", initial=2.5), ur.Parameter("lamp.scale", initial=0.5)]
    plan = method("auto").plan(ur.Problem(room(lamp=sky), unknown, [ur.View(reference)], max_depth=2))
    assert any(reason.startswith("starts at other values") for reason in plan.reasons)
    start = {key: float(np.ravel(x)[0]) for key, x in plan.configured().start().items()}
    assert abs(start["lamp.rotation.y"]) < 1.0
    assert 0.7 < start["lamp.scale"] < 1.4


@pytest.mark.slow
@pytest.mark.parametrize("share", quick([None, 0.0], 0.0))
def test_auto_leaves_a_start_at_which_the_sun_lights_other_faces(
    share: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Places 45° apart miss the faces' range; on a plateau, where no derivative image resembles the residual, a start is looked for too."""
    if share is not None:
        monkeypatch.setattr(newton, "_explained", lambda *_: share)
    made = lights.problem("sunsky", views=3, seed=0, resolution=16, spp=64)
    plan = method("auto").plan(made)
    assert any(reason.startswith("starts at other values") for reason in plan.reasons)
    assert abs(float(np.ravel(plan.configured().start()["lamp.rotation.y"])[0])) < 0.3
    monkeypatch.setattr(places, "_PER_DIMENSION", 8)
    planted = method("auto").plan(made)
    assert not any(reason.startswith("starts at other values") for reason in planted.reasons)


@pytest.mark.slow
def test_auto_takes_path_gradients_of_many_aims_and_perturbed_renders_of_few() -> None:
    """Two renders for each of 32 numbers cost more than one adjoint; the loss smoothed over all of them rose."""
    many, few = (lights.problem(name, views=1, seed=0, resolution=8, spp=4) for name in ("spots", "spot"))
    assert isinstance(method("auto").plan(many).estimator, ur.PathGradient)
    assert isinstance(method("auto").plan(few).estimator, ur.GaussNewton)


def test_auto_takes_perturbed_renders_of_many_places_also_where_a_view_does_not_see_all_lights() -> None:
    """They have no path gradient, and the loss smoothed over all of them rose. The derivative images of a hidden light are zero."""
    many = lights.problem("places", views=1, seed=0, resolution=16, spp=64)
    assert isinstance(method("auto").plan(many).estimator, ur.GaussNewton)
    hidden = {"type": "spot", "to_world": mi.ScalarTransform4f().look_at([9, 3, 0], [9, 9, 0], [1, 0, 0])}
    seen = scene(light("spot"), other=hidden)
    target = image(scene(light("spot", motion(HEAD, shift=[0.3, 0.0, 0.0])), other=hidden), {}, 64)
    keys = ("lamp.translation.x", "other.translation.x")
    for count in (1, 2):
        made = ur.Problem(
            seen, [ur.Parameter(key, initial=0.0) for key in keys[:count]], [ur.View(target)], max_depth=3
        )
        assert isinstance(method("auto").plan(made).estimator, ur.GaussNewton)


@pytest.mark.parametrize(
    ("kind", "more", "key"),
    [
        ("spot", {"beam_width": 20.0, "cutoff_angle": 20.0}, "lamp.rotation.x"),
        ("spot", {"texture": {"type": "bitmap", "bitmap": mi.Bitmap(PICTURE), "raw": True}}, "lamp.rotation.x"),
        ("spot", {}, "lamp.translation"),
        ("projector", {}, "lamp.rotation"),
        ("directional", {}, "lamp.rotation"),
        ("sunsky", {}, "lamp.rotation"),
    ],
)
def test_poses_that_move_edges_of_light_or_shadow_have_no_path_gradient(kind: str, more: Any, key: str) -> None:
    """A beam without a falloff, a texture that may end at an edge, a place, from which shadows depend, and directions of sharp shadows."""
    smooth = MitsubaRenderer(scene(light("spot")), 3).parameters()["lamp.rotation.x"]
    assert smooth.differentiable
    info = MitsubaRenderer(scene(light(kind) | more), 3).parameters()[key]
    assert not info.differentiable
    assert "path gradients do not support it" in info.reason


VALUES = {"translation": SHIFT, "rotation": TURN, "scale": SCALE}


def scene(lamp: Any, **more: Any) -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}}
    camera = mi.ScalarTransform4f().look_at([0, 2, 4], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "to_world": camera, "film": film},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(2)},
        "ball": {"type": "sphere", "radius": 0.4, "center": [0, 0.4, 0]},
        "lamp": lamp,
        **more,
    }


def image(description: Any, values: dict[str, Any], spp: int = 16) -> np.ndarray:
    renderer = MitsubaRenderer(description, 3)
    session = renderer.prepare(list(values), None, derivatives=False)
    stacked = {key: np.asarray(value, np.float64)[None] for key, value in values.items()}
    if not stacked:
        return session.image({}, SampleRequest(0, spp, 7)).images.numpy()[0]
    return session.image_batch(stacked, SampleRequest(0, spp, 7)).numpy()[0]


@pytest.mark.parametrize("kind", LIGHTS)
def test_a_posed_light_shines_as_if_it_had_been_moved(kind: str) -> None:
    """Equal random numbers give equal pictures, up to rounding."""
    centre, parts = LIGHTS[kind]
    moved = motion(centre, **{{"translation": "shift", "rotation": "turn"}.get(p, p): VALUES[p] for p in parts})
    expected = image(scene(light(kind, moved)), {})
    found = image(scene(light(kind)), {f"lamp.{part}": VALUES[part] for part in parts})
    still = image(scene(light(kind)), {})
    scale = expected.mean()
    assert np.abs(found - expected).mean() < 2e-3 * scale
    assert np.abs(still - expected).mean() > 0.03 * scale, "a light that stands still went unseen"


AXES = ["lamp.rotation.x", "lamp.rotation.y", "lamp.rotation.z"]
OF_FUNCTION = {"lamp.rotation": lambda known: 0.1 * np.ones(3, np.float32) * known["turn"]}


@pytest.mark.parametrize(
    ("kinds", "unknowns", "expressions", "told"),
    [
        (["directional"], [ur.Parameter(AXES[0][:-2])], {}, True),
        (["spot"], [ur.Parameter(key) for key in AXES], {}, True),
        (["spot"], [ur.Parameter(key) for key in AXES[::2]], {}, False),
        (["projector"], [ur.Parameter(AXES[0][:-2])], {}, False),
        (["directional"], [ur.Parameter(AXES[0][:-2], prior={"near": 0.0, "std": 0.1})], {}, False),
        (["directional", "spot"], [ur.Parameter("rig", keys=["lamp.rotation", "lamp1.rotation"])], {}, False),
        (["directional"], [ur.Parameter("turn", initial=1.0)], OF_FUNCTION, False),
    ],
)
def test_three_numbers_of_a_turn_that_has_two_are_told(kinds: Any, unknowns: Any, expressions: Any, told: bool) -> None:
    """A run with a directional light ended 9 standard errors from the truth in the third number. One turn of two lights has three."""
    more = {f"lamp{n}": light(kind) for n, kind in enumerate(kinds) if n}
    reference = np.full((12, 12, 3), 0.5, np.float32)
    made = ur.Problem({**scene(light(kinds[0])), **more}, unknowns, [ur.View(reference)], expressions=expressions)
    assert any("about its own axis" in notice for notice in made.notices) is told


def test_states_of_a_batch_and_what_is_left_out_again() -> None:
    renderer = MitsubaRenderer(scene(light("spot")), 3)
    both = renderer.prepare(["lamp.translation", "lamp.rotation.x"], None, derivatives=False)
    shifts, turns = np.array([SHIFT, [0, 0, 0], SHIFT]), np.array([0.2, 0.0, 0.2])
    request = SampleRequest(0, 4, 3)
    images = both.image_batch({"lamp.translation": shifts, "lamp.rotation.x": turns}, request).numpy()
    assert np.array_equal(images[0], images[2])
    assert np.array_equal(images[1], renderer.prepare([], None, False).image({}, request).images.numpy()[0])
    one = {"lamp.translation": renderer.array(np.array(SHIFT, np.float32))}
    alone = renderer.prepare(["lamp.translation"], None, False)
    first = alone.image(one, request).images.numpy()
    both.image_batch({"lamp.translation": shifts[:1], "lamp.rotation.x": turns[:1]}, request)
    assert np.array_equal(alone.image(one, request).images.numpy(), first), "a rotation that was unset remained"


@pytest.mark.parametrize("kind", ["spot", "rectangle"])
def test_a_posed_light_beside_a_posed_shape(kind: str) -> None:
    """A shape that emits changes the scene's acceleration structure; poses of others are then written into the scene, too."""
    ball = {"type": "sphere", "radius": 0.4, "center": [0.5, 0.6, -0.2]}
    expected = image(scene(light(kind, motion(LIGHTS[kind][0], shift=SHIFT)), ball=ball), {}, spp=64)
    values = {"lamp.translation": SHIFT, "ball.translation": [0.5, 0.2, -0.2]}
    found = image(scene(light(kind)), values, spp=64)
    assert np.abs(found - expected).mean() < 0.03 * expected.mean()
    only = image(scene(light(kind)), {"ball.translation": [0.5, 0.2, -0.2]}, spp=64)
    assert np.abs(only - expected).mean() > 0.06 * expected.mean()


@pytest.mark.parametrize(
    ("kind", "keys", "words"),
    [
        ("point", ["lamp.rotation"], "did you mean lamp.position"),
        ("point", ["lamp.position", "lamp.translation"], "lamp.position places the same object"),
        ("spot", ["lamp.rotation", "lamp.rotation.y"], "sets the same coordinate"),
        ("cube", ["lamp.vertex_positions", "lamp.scale"], "lamp.vertex_positions places the same object"),
        ("envmap", ["lamp.translation"], "did you mean"),
        ("spot", ["lamp.to_world"], "its type AffineTransform4f has no derivatives"),
    ],
)
def test_what_cannot_be_posed_is_refused_in_one_line(kind: str, keys: list[str], words: str) -> None:
    renderer = MitsubaRenderer(scene(light(kind)), 3)
    with pytest.raises(ur.InputError) as caught:
        renderer.prepare(keys, None, derivatives=False)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "kind",
    quick([kind for kind in LIGHTS if kind not in ("cube", "disk")], "point", "projector", "envmap", "rectangle"),
)
def test_an_exported_light_stands_where_its_pose_put_it(kind: str, tmp_path: Path) -> None:
    values = {f"lamp.{part}": np.asarray(VALUES[part], np.float32) for part in LIGHTS[kind][1]}
    problem = ur.Problem(
        scene(light(kind)), [ur.Parameter(key) for key in values], [ur.View(np.zeros((12, 12, 3)))], max_depth=3
    )
    done = ur.app.export((problem, values), tmp_path / "scene")
    expected = image(scene(light(kind)), values)
    assert np.abs(image(str(done.scene), {}) - expected).mean() < 5e-3 * expected.mean()


# ------------------------------------------------------------------ recovered from one tiny picture


def room(**more: Any) -> dict[str, Any]:
    """A floor and a box, seen obliquely, 16 x 16."""
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at([0, 3, 5], [0, 0, 0], [0, 1, 0])
    place = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(3)
    return {
        "type": "scene",
        "cam": {"type": "perspective", "fov": 40, "to_world": view, "film": film},
        "floor": {"type": "rectangle", "to_world": place},
        "box": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0.3, 0]).scale(0.3)},
        **more,
    }


def unknown_light(name: str) -> tuple[dict[str, Any], dict[str, Any], dict[str, float]]:
    """The light, the start, and the largest errors: some five times those of five seeds."""
    head = mi.ScalarTransform4f().look_at([0, 4, 2], [0.2, 0, 0], [1, 0, 0])
    random = np.random.default_rng(3)
    match name:
        case "spot":  # its turn about its own axis does not show
            lamp = {"type": "spot", "to_world": head, "intensity": 20.0, "cutoff_angle": 25.0}
            return lamp, {"rotation.x": 0.15, "rotation.z": -0.12}, {"rotation.x": 0.02, "rotation.z": 0.02}
        case "projector":
            picture = mi.Bitmap(random.uniform(0, 1, (8, 8, 3)).astype(np.float32))
            irradiance = {"type": "bitmap", "bitmap": picture, "raw": True}
            lamp = {"type": "projector", "to_world": head, "irradiance": irradiance, "fov": 30, "scale": 20.0}
            start = {"translation": [0.2, -0.2, 0.1], "rotation": [0.1, 0.08, -0.1]}
            return lamp, start, {"translation": 0.15, "rotation": 0.04}
        case "lamp":
            place = mi.ScalarTransform4f().translate([0.5, 2, 0.5]).rotate([1, 0, 0], 90).scale(0.3)
            lamp = {"type": "rectangle", "to_world": place, "emitter": EMITTER}
            return lamp, {"translation": [-0.4, 0.4, 0.3]}, {"translation": 0.02}
    picture = random.uniform(0, 1, (8, 16, 3)).astype(np.float32) ** 3
    picture[1:3, 5:7] += 20
    return {"type": "envmap", "bitmap": mi.Bitmap(picture)}, {"rotation.y": 0.5}, {"rotation.y": 0.01}


@pytest.mark.slow
@pytest.mark.parametrize("name", quick(["spot", "projector", "lamp", "sky"], "sky"))
def test_auto_recovers_the_pose_of_a_light(name: str) -> None:
    lamp, start, allowed = unknown_light(name)
    path = mi.load_dict({"type": "path", "max_depth": 3})
    reference = np.array(mi.render(mi.load_dict(room(lamp=lamp)), integrator=path, spp=2048))
    unknown = [ur.Parameter(f"lamp.{part}", initial=value) for part, value in start.items()]
    truth = {f"lamp.{part}": np.zeros(np.shape(value)) for part, value in start.items()}
    problem = ur.Problem(room(lamp=lamp), unknown, [ur.View(reference)], max_depth=3, truth=truth)
    result = ur.optimize(problem, steps=20, progress=False)
    assert "Gauss-Newton steps" in result.choices[0]
    assert result.status == "finished"
    errors = problem.parameter_error(result.parameters)
    assert all(errors[f"lamp.{part}"] < most for part, most in allowed.items()), errors


@pytest.mark.parametrize(("place", "able"), [(1.0, True), ([-1.0, 1.0, 1.0], True), (2.0, False)])
def test_a_sky_whose_directions_are_scaled_has_no_path_gradient(place: Any, able: bool) -> None:
    """Its light by emitter sampling is twice that by BSDF sampling in Mitsuba, and gradients by its texels were a quarter off."""
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((4, 8, 3), np.float32))}
    sky["to_world"] = mi.ScalarTransform4f().rotate([1, 0, 0], 90).scale(place)
    known = MitsubaRenderer({"type": "scene", "eye": {"type": "perspective"}, "sky": sky}, 2).parameters()
    assert (known["sky.data"].differentiable, known["sky.rotation"].differentiable) == (able, able)
    assert known["sky.data"].perturbable
    assert known["sky.scale"].differentiable
