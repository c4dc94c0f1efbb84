"""Views that turn distant lights: sensors of one scene, with the images and gradients of scenes that are loaded with the turned light."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from kernels import recorded
from tiers import quick
from unrender.rendering.mitsuba import film, frozen
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.turns import Turns
from unrender.rendering.worlds import WorldsRenderer
from unrender.scene.fingerprint import fingerprint

MAP = (np.random.default_rng(0).uniform(0, 1, (8, 16, 3)) ** 4 * 5).astype(np.float32)
COLOUR, ROTATION = "ball.bsdf.base_color.value", "light.rotation"
TURNS = ([0.0, 1.0, 0.0], [0.3, -0.4, 0.2], [0.0, 0.0, 0.0])
pytestmark = pytest.mark.mitsuba
DATA = {"envmap": "light.data", "directional": "light.irradiance.value"}


def light(kind: str, vector: list[float] | None = None) -> dict[str, Any]:
    """The light as described, or turned by a rotation vector."""
    angle = float(np.linalg.norm(vector or [0.0]))
    turn: Any = mi.ScalarTransform4f()
    if vector and angle:
        turn = turn.rotate((np.array(vector) / angle).tolist(), float(np.degrees(angle)))
    if kind == "envmap":
        return {"type": "envmap", "bitmap": mi.Bitmap(MAP), "to_world": turn.rotate([1, 0, 0], 90)}
    direction = np.array(turn.matrix)[:3, :3] @ [-0.5, -1.0, -0.4]
    return {"type": "directional", "direction": direction.tolist(), "irradiance": 3.0}


def scene(kind: str, vector: list[float] | None = None, cameras: int = 1) -> dict[str, Any]:
    film_of = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    places = ([0, 1, 4], [4, 1, 0], [-3, 1, 3])
    looks = [mi.ScalarTransform4f().look_at(place, [0, 0, 0], [0, 1, 0]) for place in places[:cameras]]
    return {
        "type": "scene",
        "ball": {"type": "sphere", "bsdf": {"type": "principled", "roughness": 0.3}},
        "light": light(kind, vector),
    } | {
        f"camera_{n}": {"type": "perspective", "fov": 40, "to_world": at, "film": film_of} for n, at in enumerate(looks)
    }


def difference(one: Any, other: Any) -> float:
    """Mean absolute difference; that of two pictures of one light is below .01 by noise."""
    return float(np.abs(np.asarray(one) - np.asarray(other)).mean())


def problem(kind: str = "envmap", cameras: int = 1, keys: tuple[str, ...] = (COLOUR,), **more: Any) -> ur.Problem:
    """Views that turn the light, by one camera or by one each."""
    views = [
        ur.View(np.zeros((8, 8, 3)), sensor=min(n, cameras - 1), known={ROTATION: vector})
        for n, vector in enumerate(TURNS)
    ]
    return ur.Problem(
        lambda: scene(kind, None, cameras), [ur.Parameter(key) for key in keys], views, max_depth=3, **more
    )


@pytest.mark.parametrize("cameras", quick([1, 3], 1))
@pytest.mark.parametrize("kind", quick(["envmap", "directional"], "envmap"))
def test_images_and_gradients_are_those_of_scenes_with_the_turned_light(kind: str, cameras: int) -> None:
    ours, keys = problem(kind, cameras, (COLOUR, DATA[kind])), (COLOUR, DATA[kind])
    assert isinstance(ours.renderer, MitsubaRenderer)
    total = {key: np.zeros(ours.shapes()[key]) for key in keys}
    for n, vector in enumerate(TURNS):
        view = ur.View(np.zeros((8, 8, 3)), sensor=min(n, cameras - 1))
        parameters = [ur.Parameter(key) for key in keys]
        alone = ur.Problem(lambda v=vector: scene(kind, v, cameras), parameters, [view], max_depth=3)
        assert difference(ur.render(ours, view=n, spp=4096), ur.render(alone, spp=4096)) < 0.01
        gradient = ur.estimate(alone, ur.PathGradient(spp=4096), seed=n).gradient
        total = {key: total[key] + gradient[key] for key in keys}
    found = ur.estimate(ours, ur.PathGradient(spp=4096), seed=9).gradient
    for key in keys:
        np.testing.assert_allclose(found[key], total[key], atol=0.03 * np.abs(total[key]).max(), err_msg=key)
    if cameras == 1:
        assert difference(ur.render(ours, view=0, spp=4096), ur.render(ours, view=2, spp=4096)) > 0.03


@pytest.mark.parametrize("ready_made", [False, True])
def test_a_function_is_not_called_for_each_turn(ready_made: bool) -> None:
    """It was called once for each copy of a camera. Only ready-made sensors, which two copies cannot share, need that."""
    calls = []

    def described() -> dict[str, Any]:
        calls.append(0)
        made = scene("directional")
        return {**made, "camera_0": mi.load_dict(made["camera_0"])} if ready_made else made

    counts = []
    for turns in (2, 6):
        calls.clear()
        views = [ur.View(np.zeros((8, 8, 3)), known={ROTATION: [0.0, 0.1 * n, 0.0]}) for n in range(turns)]
        made = ur.Problem(described, [ur.Parameter(COLOUR)], views, max_depth=3)
        assert isinstance(made.renderer, MitsubaRenderer)
        sensors: Any = made.renderer.pair.current.sensors()
        assert len({id(sensor) for sensor in sensors}) == turns
        opened: list[Any] = [mi.traverse(sensor)["shutter_open"] for sensor in sensors]
        assert opened == list(range(turns))
        counts.append(len(calls))
    assert (counts[1] > counts[0]) == ready_made


@pytest.mark.parametrize("function", [False, True])
def test_a_sensor_that_turned_views_would_share_is_refused(function: bool) -> None:
    """All views were rendered under the light of the last one."""
    made = scene("directional")
    made["camera_0"] = mi.load_dict(made["camera_0"])
    views = [ur.View(np.zeros((8, 8, 3)), known={ROTATION: vector}) for vector in TURNS]
    with pytest.raises(ur.InputError, match="sensor camera_0 is a ready-made Mitsuba object, which views that turn"):
        ur.Problem((lambda: made) if function else made, [ur.Parameter(COLOUR)], views, max_depth=3)


def test_views_that_differ_by_more_are_worlds_and_unknown_rotations_turn_the_light_as_described() -> None:
    turned = problem()
    views = [*turned.original_views, ur.View(np.zeros((8, 8, 3)), known={"light.scale": 2.0})]
    assert isinstance(turned.replaced(views=views).renderer, WorldsRenderer)
    assert turned.replaced(views=turned.original_views[:2]).views[1].sensor == 1
    assert turned.replaced(name="again").renderer is turned.renderer
    unknown = [ur.Parameter(ROTATION, initial=[0.0, 0.1, 0.0])]
    free = turned.replaced(parameters=unknown, views=[*turned.original_views, ur.View(np.zeros((8, 8, 3)))])
    alone = ur.Problem(
        lambda: scene("envmap", [0.0, 0.1, 0.0]), [ur.Parameter(COLOUR)], [ur.View(np.zeros((8, 8, 3)))], max_depth=3
    )
    assert difference(ur.render(free, view=3, spp=4096), ur.render(alone, spp=4096)) < 0.01
    back = free.replaced(parameters=turned.parameters, views=turned.original_views)
    np.testing.assert_array_equal(ur.render(back, view=1, spp=4), ur.render(turned, view=1, spp=4))


@pytest.mark.parametrize("cameras", [1, 3])
def test_all_views_of_a_camera_follow_its_unknowns(cameras: int) -> None:
    """Copies of a camera for other rotations have no parameters: only the first view followed an unknown field of view."""
    key = "camera_0.x_fov"
    images = []
    for fov in (40.0, 60.0):
        made = problem("envmap", cameras, (COLOUR, key))
        made = made.replaced(parameters=[ur.Parameter(COLOUR), ur.Parameter(key, initial=fov)])
        images.append([ur.render(made, view=view, spp=64) for view in range(3)])
    for view in range(3):
        assert (difference(images[0][view], images[1][view]) > 0.05) is (view < 1 or cameras == 1)


def test_ids_with_dots_name_objects_of_files(tmp_path: Path) -> None:
    """Programs name objects Cube.001, and photographs are cat.0.tga: such ids are no keys of Mitsuba's dictionaries."""
    pictures = []
    for dot in "_.":
        (tmp_path / "scene.xml").write_text(
            f"""<scene version="3.0.0"><sensor type="perspective" id="cat{dot}0"><film type="hdrfilm">
            <integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>
            <shape type="cube" id="Cube{dot}001"><transform name="to_world"><translate z="6"/></transform></shape>
            <emitter type="directional" id="sun{dot}1"><vector name="direction" x="0" y="0" z="1"/></emitter></scene>"""
        )
        parameters = [ur.Parameter(f"Cube{dot}001.translation.x", initial=0.3)]
        views = [ur.View(np.zeros((8, 8, 3)), known={f"sun{dot}1.rotation": vector}) for vector in TURNS]
        problem = ur.Problem(tmp_path / "scene.xml", parameters, views)
        pictures.append([ur.render(problem, view=view, spp=16) for view in range(3)])
    np.testing.assert_array_equal(*pictures)
    assert np.min(np.mean(pictures, axis=(2, 3, 4))) > 0.01


@pytest.mark.slow
def test_an_expression_of_the_rotation_turns_the_light_as_described() -> None:
    """A view that knows what an expression sets is a world; the other view has the rotation of the expression."""
    views = [ur.View(np.zeros((8, 8, 3)), known={ROTATION: TURNS[0]}), ur.View(np.zeros((8, 8, 3)))]
    turn = {ROTATION: "angle * [0, 1, 0]"}
    made = ur.Problem(
        lambda: scene("envmap"), [ur.Parameter("angle", initial=-1.0)], views, max_depth=3, expressions=turn
    )
    for view, vector in enumerate((TURNS[0], [0.0, -1.0, 0.0])):
        alone = ur.Problem(
            lambda v=vector: scene("envmap", v), [ur.Parameter(COLOUR)], [ur.View(np.zeros((8, 8, 3)))], max_depth=3
        )
        assert difference(ur.render(made, view=view, spp=4096), ur.render(alone, spp=4096)) < 0.01


def test_recursive_control_variates_in_path_space_serve_turned_lights() -> None:
    """As worlds they were refused: the pair of states would have had a light that moves."""
    result = ur.optimize(problem(), "rcv", steps=3, progress=False)
    assert np.isfinite(result.history[-1]["loss"])


def test_rotations_are_part_of_the_fingerprint() -> None:
    one, other = problem(), problem()
    assert fingerprint(one) == fingerprint(other)
    views = [*one.original_views[:2], ur.View(np.zeros((8, 8, 3)), known={ROTATION: [0.0, 0.0, 0.1]})]
    assert fingerprint(one.replaced(views=views)) != fingerprint(one)


@pytest.mark.parametrize(
    ("value", "expected"),
    [([0.0, 1.0], "3"), ("north", "rotation"), ([0.0, np.nan, 0.0], "finite"), (None, "rotation")],
)
def test_a_rotation_that_cannot_be_is_one_line(value: Any, expected: str) -> None:
    views = [ur.View(np.zeros((8, 8, 3)), known={ROTATION: value})]
    with pytest.raises(ur.InputError, match=expected) as raised:
        ur.Problem(lambda: scene("envmap"), [ur.Parameter(COLOUR)], views)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("sharing", quick([True, False], True))
def test_turned_views_share_their_kernels(sharing: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """In one recording, or in one for each view whose time is an input."""
    monkeypatch.setattr(frozen, "_MANY", 3 if sharing else 4)
    given = problem()
    pictures = [ur.render(given, view=0, spp=4)]
    with recorded() as new:
        pictures += [ur.render(given, view=view, spp=4) for view in (1, 2)]
    assert new
    assert not any(new)
    assert np.abs(pictures[1] - pictures[0]).mean() > 0.01  # the light has turned
    monkeypatch.setattr(film, "open_at_different_times", lambda sensors: False)  # as if time were a constant
    fresh = problem()
    ur.render(fresh, view=0, spp=4)
    with recorded() as new:
        again = ur.render(fresh, view=1, spp=4)
    assert any(new) != sharing
    np.testing.assert_array_equal(again, pictures[1])


def test_the_exported_scene_is_that_of_the_description(tmp_path: Path) -> None:
    given = problem()
    ur.app.export((given, given.initial_values()), tmp_path / "out")
    exported: Any = mi.load_file(str(tmp_path / "out" / "scene.xml"))
    (found,) = exported.emitters()
    assert found.class_name() == "EnvironmentMapEmitter"
    expected = np.array(light("envmap")["to_world"].matrix)
    known: Any = mi.traverse(found)
    np.testing.assert_allclose(np.array(known["to_world"].matrix).reshape(4, 4), expected, atol=1e-6)
    assert len(exported.sensors()) == 1


def test_equal_rotations_of_a_sensor_are_one() -> None:
    views = [ur.View(np.zeros((8, 8, 3)), known={ROTATION: vector}) for vector in (TURNS[0], TURNS[1], TURNS[0])]
    made = ur.Problem(lambda: scene("envmap"), [ur.Parameter(COLOUR)], views)
    assert [view.sensor for view in made.views] == [0, 1, 0]
    renderer: Any = made.renderer
    assert renderer.turns == Turns((0, 0), (("light", (tuple(TURNS[0]), tuple(TURNS[1]))),))
