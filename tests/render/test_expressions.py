"""Parameters of a scene that are functions of unknowns: derivatives against differences, recoveries, files, and input that is wrong."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from drjit import nn

import unrender as ur
from tiers import quick
from unrender.core import arrays
from unrender.core.errors import InputError, KeyedError
from unrender.estimators.base import as_numpy
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.methods import method
from unrender.rendering.expression_texts import parse
from unrender.rendering.expressions import ExpressionRenderer
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.photographs import scene_values
from unrender.scene.fingerprint import fingerprint

pytestmark = pytest.mark.mitsuba

PAINT, LEFT, RIGHT = "wall.bsdf.reflectance.data", "left.intensity.value", "right.intensity.value"
LAMPS = {LEFT: "strength * [1, 0.8, 0.6]", RIGHT: "0.5 * strength * [1, 0.8, 0.6]"}
ROWS = 4


def scene(strength: float = 2.0, paint: Any = 0.5) -> dict[str, Any]:
    """A wall with a texture under two lamps of one colour, the right of which is half as bright."""
    look = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    texture = mi.Bitmap(np.broadcast_to(np.asarray(paint, np.float32), (ROWS, ROWS, 3)).copy())
    colour = np.array([1, 0.8, 0.6]) * strength
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sensor": {"type": "perspective", "fov": 35, "to_world": look, "film": film},
        "wall": {
            "type": "rectangle",
            "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": texture, "raw": True}},
        },
        "left": {"type": "point", "position": [-1, 0, 2], "intensity": {"type": "rgb", "value": colour.tolist()}},
        "right": {"type": "point", "position": [1, 0, 2], "intensity": {"type": "rgb", "value": (colour / 2).tolist()}},
    }


def picture(**of: Any) -> np.ndarray:
    return np.array(mi.render(mi.load_dict(scene(**of)), spp=512, seed=mi.UInt32(3)))


def problem(
    reference: np.ndarray, expressions: dict[str, Any], *parameters: ur.Parameter, **options: Any
) -> ur.Problem:
    return ur.Problem(scene, parameters, [ur.View(reference)], expressions=expressions, **options)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2 * a + b", [2 + 3.0, 4 + 3.0]),
        ("a ** 2 - b / 4", [1 - 0.75, 4 - 0.75]),
        ("-a[1] + [1, 2] + b ** 0.5 * 0", [-1.0, 0.0]),
        ("(a * a) ** 0.25 - b ** 0.75 * 0", [1.0, 2**0.5]),
        ("(a - 1) ** (b / 3) + a ** [2, 0.5] - 2 ** b / 8", [0.0, 2**0.5]),
        ("(a - 1) ** (b - 3) + 0 ** (b - 3) + 0 ** b", [2.0, 2.0]),
        ("exp(log(a)) + sqrt(b) * 0", [1.0, 2.0]),
        ("max(a, 1.5) + min(b, 2)", [3.5, 4.0]),
        ("mix(a, b, 0.25) + abs(sin(0)) + cos(0) - 1 + tanh(0)", [1.5, 2.25]),
    ],
)
def test_texts_are_evaluated(text: str, expected: list[float]) -> None:
    class Values(dict[str, Any]):
        like = mi.TensorXf([0.0])

    values = Values(a=mi.TensorXf([1.0, 2.0]), b=mi.TensorXf([3.0]))
    assert np.array(parse("x", text)(values)) == pytest.approx(np.array(expected))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a +",
        "__import__('os').system('true')",
        "a.real",
        "(lambda: 1)()",
        "a if b else c",
        "exp(a, b)",
        "[1, 'x']",
        "f(a)",
        "a @ b",
    ]
    + [
        "True",
        "'a'",
        "a[b]",
        "{1: 2}",
        "exp(x=1)",
        "+".join("a" * 900),
        "(" * 80 + "a" + ")" * 80 + "**1" * 60,
        "open"[:0] + "a; b",
    ],
)
def test_texts_of_other_kinds_are_refused(text: str) -> None:
    with pytest.raises(KeyedError) as caught:
        parse("lamp", text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("image", quick(["plain", "rcv"], "rcv"))
def test_gradients_by_unknowns_are_sums_over_the_parameters(image: str) -> None:
    """Equal random numbers: the gradient by the strength is that by both lamps, times the derivatives of the functions."""
    estimator = ur.PathGradient(RecursiveControlVariate(), spp=8) if image == "rcv" else ur.PathGradient(spp=8)
    reference, tint = picture(strength=3.0), np.array([1, 0.8, 0.6])
    one = problem(reference, LAMPS, ur.Parameter("strength", initial=2.0))
    apart = ur.Problem(scene, [ur.Parameter(LEFT), ur.Parameter(RIGHT)], [ur.View(reference)])
    gradients = []
    for made in (one, apart):
        point, state = made.initial(), estimator.init(made, made.initial())
        for step in range(3):
            estimate, state = estimator.estimate(made, point, state, ur.Key(1, step))
        gradients.append(as_numpy(estimate).gradient)
    expected = (gradients[1][LEFT] * tint).sum() + 0.5 * (gradients[1][RIGHT] * tint).sum()
    assert gradients[0]["strength"] == pytest.approx([expected], rel=1e-4)
    assert gradients[0]["strength"] != pytest.approx([1.03 * expected], rel=1e-4)


def test_a_view_that_knows_what_an_expression_sets_adds_nothing() -> None:
    """The derivative of that view ended a run, since Dr.Jit drops products with 0."""
    views = [ur.View(picture()), ur.View(picture(), known={LEFT: 0.0, RIGHT: 0.0})]
    unknown = ur.Parameter("strength", 1.5)
    alone, both = (ur.Problem(scene, [unknown], seen, expressions=LAMPS) for seen in (views[:1], views))
    one, other = (ur.estimate(made, ur.PathGradient(spp=8)).gradient["strength"] for made in (alone, both))
    assert one != 0
    np.testing.assert_array_equal(one, other)


def test_tangents_are_carried_through_functions() -> None:
    """The squared derivative by the strength along 1 is that by both lamps along the functions' derivatives."""
    reference, tint = picture(), np.array([1, 0.8, 0.6], np.float32)
    one = problem(reference, LAMPS, ur.Parameter("strength", initial=2.0))
    apart = ur.Problem(scene, [ur.Parameter(LEFT), ur.Parameter(RIGHT)], [ur.View(reference)])
    request = ur.rendering.renderer.SampleRequest(0, 8, 5)
    moments = []
    for made, tangents in ((one, {"strength": np.ones(1, np.float32)}), (apart, {LEFT: tint, RIGHT: 0.5 * tint})):
        point = made.initial()
        session = made.renderer.prepare(list(point), None)
        paths = session.image(point, request).paths
        along = {key: made.renderer.array(x) for key, x in tangents.items()}
        moments.append(arrays.numpy(session.tangent_moment(point, paths, along)))
    assert moments[0].max() > 0
    assert moments[0] == pytest.approx(moments[1], rel=1e-4)


def test_two_lamps_of_one_strength_are_recovered() -> None:
    made = problem(picture(strength=3.0), LAMPS, ur.Parameter("strength", initial=1.0), truth={"strength": 3.0})
    result = ur.optimize(made, "auto", steps=80, progress=False)
    assert result.parameters["strength"] == pytest.approx([3.0], rel=0.03)
    assert result.status == "finished"


@pytest.mark.slow
def test_a_palette_and_its_mask_are_recovered() -> None:
    """A texture of two colours, mixed by a mask: seven numbers and sixteen in place of 48."""
    mask = np.zeros((ROWS, ROWS, 1), np.float32)
    mask[:, 2:] = 1.0
    truth = np.array([0.2, 0.3, 0.6]) * (1 - mask) + np.array([0.8, 0.5, 0.1]) * mask
    made = problem(
        picture(paint=truth),
        {PAINT: "mix(palette[0], palette[1], mask)"},
        ur.Parameter("palette", initial=[[0.4, 0.4, 0.4], [0.6, 0.6, 0.6]], bounds=(0, 1)),
        ur.Parameter("mask", initial=0.25 + 0.5 * mask, bounds=(0, 1)),
    )
    result = ur.optimize(made, "auto", steps=200, progress=False)
    found = scene_values(made.renderer, result.parameters)[PAINT]
    assert np.sqrt(np.mean((found - truth) ** 2)) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["sines", "hash grid"])
def test_a_network_of_drjit_over_coordinates_is_a_texture(encoding: str) -> None:
    """Weights of `drjit.nn`, and cells of a hash grid, are unknowns of a Python function. Without its gradient, nothing would change."""
    grid: Any = nn.HashGridEncoding(mi.Float, 2, n_levels=2, base_resolution=2, hashmap_size=64, init_scale=0.1)
    first, inputs = ((nn.SinEncode(2),), 2) if encoding == "sines" else ((), grid.n_output_features)
    net: Any = nn.Sequential(*first, nn.Linear(-1, 8), nn.Tanh(), nn.Linear(-1, 3), nn.Tanh())
    net = net.alloc(mi.TensorXf, inputs, dr.rng(1))
    at = np.mgrid[:ROWS, :ROWS].reshape(2, -1).astype(np.float32) / (2 * ROWS)  # sines have the period 1

    def texture(values: Any) -> Any:
        net.update({key: values[key] for key in net})
        features: Any = at
        if encoding == "hash grid":
            grid.data = values["grid"].array
            features = grid([mi.Float(at[0]), mi.Float(at[1])])
        return dr.reshape(0.5 + 0.45 * dr.moveaxis(net(mi.TensorXf(features)), 0, -1), (ROWS, ROWS, 3))

    ramp = np.stack([0.3 + at[0], 0.7 - at[1], np.full(ROWS * ROWS, 0.5)], axis=1).reshape(ROWS, ROWS, 3)
    unknowns = [ur.Parameter(key, initial=np.array(net[key])) for key in net]
    if encoding == "hash grid":
        unknowns.append(ur.Parameter("grid", initial=np.array(grid.data)))
    made = problem(picture(paint=ramp), {PAINT: texture}, *unknowns)
    result = ur.optimize(made, "auto", steps=100, progress=False)
    before, after = (
        np.std(ur.render(made, values, spp=256) - made.views[0].reference)
        for values in (made.initial_values(), result.parameters)
    )
    assert after < 0.3 * before
    assert not made.origin  # a function cannot be read from a file again


def box(size: float = 1.0) -> dict[str, Any]:
    """A box under a lamp and a sky. No face's plane contains the camera, where the derivative by the size has two sides."""
    look = mi.ScalarTransform4f().look_at([1.4, 2, 5], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": {"type": "perspective", "fov": 40, "to_world": look, "film": film},
        "box": {"type": "cube", "to_world": mi.ScalarTransform4f().scale(size), "bsdf": {"type": "diffuse"}},
        "sky": {"type": "constant"},
        "lamp": {"type": "point", "position": [2, 3, 4], "intensity": 10.0},
    }


@pytest.mark.parametrize("name", ["positions", "normals", "texcoords"])
def test_one_number_fills_no_vertices(name: str) -> None:
    """All vertices were at one point, and the run said only at its end that pictures do not determine them."""
    key, paint = f"box.vertex_{name}", "box.bsdf.reflectance.value"
    view, unknown = ur.View(np.zeros((16, 16, 3), np.float32)), ur.Parameter(key)
    renderer = ur.Problem(box, [unknown], [view]).renderer
    problem = partial(ur.Problem, renderer)
    with pytest.raises(
        ur.InputError, match=r"initial: expected a mesh file or an array of shape .*, got the number 0\.5"
    ):
        problem([ur.Parameter(key, initial=0.5)], [view])
    with pytest.raises(ur.InputError, match="initial: expected different values, got 0 for all"):
        problem([ur.Parameter(key, initial=np.zeros(renderer.parameters()[key].shape))], [view])
    with pytest.raises(ur.InputError, match=f"truth.{key}: expected a mesh file"):
        problem([unknown], [view], truth={key: 1.0})
    with pytest.raises(ur.InputError, match=f"view 0: known: {key}: expected a mesh file"):
        problem([ur.Parameter(paint)], [replace(view, known={key: 1.0})])
    with pytest.raises(ur.InputError, match=f"expression of {key}: all of its .* numbers are 1 at the initial values"):
        problem([ur.Parameter("size", initial=0.5)], [view], expressions={key: "2 * size"})
    if name == "positions":
        point = np.tile([1.0, 2.0, 3.0], renderer.parameters()[key].shape[0] // 3)
        with pytest.raises(ur.InputError, match=f"parameter {key}: initial: all 24 vertices are at one point"):
            problem([ur.Parameter(key, initial=point)], [view])
        with pytest.raises(ur.InputError, match=f"expression of {key}: all of its 24 vertices are at one point"):
            problem([ur.Parameter("size", initial=point)], [view], expressions={key: "2 * size"})


@pytest.mark.slow
def test_a_mesh_may_follow_a_number_silhouettes_included() -> None:
    """Vertices are a function of the box's size: the gradient against differences of pictures, and the size from one picture."""
    key = "box.vertex_positions"
    base = np.array(mi.traverse(mi.load_dict(box()))[key])  # pyright: ignore

    def shot(size: float, spp: int, seed: int) -> np.ndarray:
        return np.array(mi.render(mi.load_dict(box(size)), spp=spp, seed=mi.UInt32(seed)))

    reference = shot(1.2, 256, 9)
    made = ur.Problem(
        box,
        [ur.Parameter("size", initial=1.0, bounds=(0.3, 2.0))],
        [ur.View(reference)],
        expressions={key: lambda values: values["size"] * mi.TensorXf(base)},
    )
    estimator, point, found = ur.PathGradient(spp=32), made.initial(), []
    for seed in range(12):
        estimate = estimator.estimate(made, point, estimator.init(made, point), ur.Key(seed))[0]
        found.append(float(as_numpy(estimate).gradient["size"][0]))
    mean, error = np.mean(found), np.std(found, ddof=1) / np.sqrt(len(found))
    slopes = []
    for seed in range(6):
        ends = [np.mean((shot(1 + step, 2048, seed) - reference) ** 2) for step in (0.02, -0.02)]
        slopes.append((ends[0] - ends[1]) / 0.04)
    noise = np.hypot(error, np.std(slopes, ddof=1) / np.sqrt(len(slopes)))
    assert abs(mean - np.mean(slopes)) < 4 * noise + 0.02 * abs(mean)
    assert abs(1.2 * mean - np.mean(slopes)) > 4 * noise + 0.02 * abs(mean)
    result = ur.optimize(made, "auto", steps=60, progress=False)
    assert result.parameters["size"] == pytest.approx([1.2], abs=0.01)


# ---------------------------------------------------------------------- files

XML = """<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="2"/></integrator>
<sensor type="perspective"><transform name="to_world"><lookat origin="0,0,3" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/><rfilter type="box"/></film></sensor>
<shape type="rectangle" id="wall"><bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
<emitter type="point" id="lamp"><point name="position" x="0" y="0" z="2"/><rgb name="intensity" value="2"/></emitter></scene>"""


def file(
    folder: Path,
    expression: str = "strength * [1, 0.5, 0.25]",
    key: str = "lamp.intensity.value",
    initial: str = "initial = 1.0",
) -> Path:
    (folder / "scene.xml").write_text(XML)
    np.save(folder / "picture.npy", np.full((8, 8, 3), 0.05, np.float32))
    text = (
        f'scene = "scene.xml"\n[expressions]\n"{key}" = "{expression}"\n[[parameters]]\nkey = "strength"\n{initial}\n'
    )
    (folder / "problem.toml").write_text(text + '[[views]]\nreference = "picture.npy"\n')
    return folder / "problem.toml"


@pytest.mark.slow
@pytest.mark.usefixtures("short_ends")
def test_a_file_has_expressions_and_its_run_resumes(tmp_path: Path) -> None:
    made = ur.Problem.from_file(file(tmp_path))
    assert isinstance(made.renderer, ExpressionRenderer)
    assert fingerprint(made)["expression of lamp.intensity.value"] == "strength * [1, 0.5, 0.25]"
    assert ur.render(made, spp=4)[..., 0].mean() == pytest.approx(4 * ur.render(made, spp=4)[..., 2].mean(), rel=1e-4)
    ur.optimize(made, "auto", steps=6, run_directory=tmp_path / "run", progress=False)
    straight = ur.optimize(made, "auto", steps=12, run_directory=tmp_path / "straight", progress=False)
    resumed = ur.resume(tmp_path / "run", steps=12)
    assert resumed.parameters["strength"] == pytest.approx(straight.parameters["strength"], rel=1e-5)
    again = made.replaced(parameters=[ur.Parameter("strength", initial=2.0)])
    assert again.initial_values()["strength"] == pytest.approx([2.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"expression": "power"}, r"problem.toml:3: expressions.*: no parameter is called power"),
        ({"expression": "2.0"}, r"it reads no unknown"),
        ({"expression": "strength[1]"}, r"strength\[1\] is not there: strength has 1 row, the first is strength\[0\]"),
        ({"expression": "sinh(strength)"}, r"'sinh\(strength\)' is not allowed; there are numbers, .*, tanh"),
        ({"expression": "strength +"}, r"it is no expression"),
        ({"expression": "-strength"}, r"intensity.value: expected at least 0, got -1 to -1 at the initial"),
        ({"expression": "1 / (strength - 1)"}, r"it is not finite at the initial values"),
        ({"expression": "strength * 1" + "0" * 400}, r"it is not finite at the initial values"),
        ({"expression": "strength * [1" + "0" * 400 + "]"}, r"a list must have numbers"),
        ({"expression": "sqrt(strength - 1)"}, r"its derivative by strength is not finite at the initial values"),
        ({"expression": "(strength - 1) ** 0.5"}, r"its derivative by strength is not finite at the initial values"),
        ({"expression": "(strength - 1) ** 0.3"}, r"its derivative by strength is not finite at the initial values"),
        ({"expression": "(strength - 1) ** 0.75"}, r"its derivative by strength is not finite at the initial values"),
        (
            {"expression": "(strength - 1) ** (strength / 2)"},
            r"its derivative by strength is not finite at the initial",
        ),
        ({"expression": "strength * [1, 2]"}, r"has the shape \(2,\), lamp.intensity.value has \(3,\)"),
        ({"key": "lamp.colour"}, r"the scene has no parameter lamp.colour"),
        ({"initial": ""}, r"parameters\[0\].key: an unknown of expressions needs a finite initial value"),
        ({"initial": "initial = []"}, r"needs a finite initial value: a number"),
        ({"expression": "Sqrt(strength)"}, r"'Sqrt\(strength\)' is not allowed; .*; did you mean sqrt\?$"),
        ({"expression": "sqrt(x=strength)"}, r"is not allowed; there are .*, \w+$"),
        ({"expression": "strength ^ 2"}, r"is not allowed; .*; a power is \*\*$"),
        ({"initial": 'initial = "nix.npy"'}, r"parameters\[0\].initial: .*nix.npy: no such file"),
        (
            {"initial": 'initial = 1.0\n[[parameters]]\nkey = "lamp.intensity.value"'},
            r"parameters\[1\].key: lamp.intensity.value has an expression, which sets it; leave out one of them",
        ),
        (
            {"initial": 'initial = 1.0\n[[parameters]]\nkeys = ["lamp.intensity.value"]'},
            r"parameters\[1\].keys: lamp.intensity.value has an expression",
        ),
    ],
)
def test_an_expression_that_cannot_be_is_refused_in_one_line(
    tmp_path: Path, change: dict[str, str], message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        ur.Problem.from_file(file(tmp_path, **change))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("expressions", "message"),
    [
        ([LEFT], "expressions: expected texts or functions by key of the scene, got "),
        ({LEFT: lambda _: None}, "expression of left.intensity.value: the function returned None, expected a Dr.Jit"),
        ({LEFT: lambda _: "strength"}, "the function returned 'strength', expected a Dr.Jit tensor"),
    ],
)
def test_what_is_no_function_of_tensors_is_refused_in_one_line(expressions: Any, message: str) -> None:
    """A text as the result did not end."""
    with pytest.raises(InputError, match=message):
        problem(picture(), expressions, ur.Parameter("strength", initial=1.0))


@pytest.mark.parametrize("loses", [dr.detach, lambda x: mi.TensorXf(x.numpy())])
def test_a_function_that_loses_its_derivative_has_no_path_gradient(loses: Any) -> None:
    """The run ended at its start as "finished". Perturbed renders need no derivative. The start of a problem evaluates it once."""
    calls: list[Any] = []

    def function(values: Any) -> Any:
        calls.append(values)
        return loses(values["strength"]) * mi.TensorXf([1, 0.8, 0.6])

    made = problem(picture(), {LEFT: function}, ur.Parameter("strength", initial=1.0))
    assert len(calls) == 1
    with pytest.raises(InputError, match=r"by path gradients, since the function of left\.intensity\.value loses its"):
        ur.optimize(made, "plain", steps=1, progress=False)
    assert "perturbed renders" in method("auto").plan(made).lines[0]


def test_an_unknown_that_nothing_reads_is_refused() -> None:
    parameters = [ur.Parameter("strength", initial=1.0), ur.Parameter("other", initial=1.0)]
    with pytest.raises(InputError, match="parameter other: neither a parameter of the scene nor read by an expression"):
        problem(picture(), LAMPS, *parameters)


@pytest.mark.parametrize("text", ["0.1 + 0.5 * bumps ** 2", "bumps"])
def test_a_texture_that_an_expression_turns_into_a_roughness_has_no_map(text: str) -> None:
    """Nor has the roughness itself. Textures that colours transmit are linear."""
    image = mi.Bitmap(np.full((ROWS, ROWS, 1), 0.3, np.float32))
    colour = mi.Bitmap(np.full((ROWS, ROWS, 3), 0.5, np.float32))
    rough = {"type": "bitmap", "bitmap": image, "raw": True}
    clear = {"type": "bitmap", "bitmap": colour, "raw": True}
    made = scene()
    made["wall"]["bsdf"] = {"type": "roughconductor", "alpha": rough, "specular_reflectance": clear}
    made["pane"] = {"type": "rectangle", "bsdf": {"type": "roughdielectric", "specular_transmittance": dict(clear)}}
    known = MitsubaRenderer(made).parameters()
    alpha, passed = "wall.bsdf.alpha.data", "pane.bsdf.specular_transmittance.data"
    assert known[alpha].curved
    assert not known[passed].curved
    assert not known["wall.bsdf.specular_reflectance.data"].curved
    start = np.full((ROWS, ROWS, 1), 0.4, np.float32)
    of = ur.Problem(made, [ur.Parameter("bumps", initial=start)], [ur.View(picture())], expressions={alpha: text})
    assert of.renderer.parameters()["bumps"].curved
    assert not of.renderer.parameters()[passed].curved


def test_expressions_stand_beside_ties_and_unknowns_of_photographs() -> None:
    """Both have names that the scene lacks and no expression reads, and were refused as unknowns that nothing reads."""
    tie = ur.Parameter("shift", keys=["left.translation.y", "right.translation.y"], initial=0.25)
    made = problem(picture(), LAMPS, ur.Parameter("strength", initial=2.0), tie, ur.Parameter("exposure"))
    at = {"left.translation.y": 0.25, "right.translation.y": 0.25}
    alone = ur.Problem(scene, [ur.Parameter(key, initial=x) for key, x in at.items()], [ur.View(picture())])
    np.testing.assert_allclose(ur.render(made, spp=8), ur.render(alone, spp=8), rtol=1e-4)


@pytest.mark.usefixtures("short_ends")
def test_a_bounded_unknown_of_expressions_is_resumed(tmp_path: Path) -> None:
    """Its projection was not evaluated before the functions of it, which gave it their size."""
    unknown = ur.Parameter("strength", initial=1.0, bounds=(0.1, 10.0))
    made, parts = problem(picture(strength=3.0), LAMPS, unknown), (ur.PathGradient(spp=4), ur.optimizers.Adam(0.1))
    whole = ur.optimize(made, *parts, steps=4)
    ur.optimize(made, *parts, steps=2, run_directory=tmp_path)
    assert ur.resume(tmp_path, made, steps=4).parameters["strength"] == pytest.approx(whole.parameters["strength"])


@pytest.mark.usefixtures("short_ends", "one_thread")
def test_a_run_with_functions_of_python_is_resumed_bit_for_bit_or_refused(tmp_path: Path) -> None:
    """Another function of the same name was taken for the one of the run, and the descent went on with it."""

    def made(factor: float = 0.5, power: float = 1.0) -> ur.Problem:
        def lamp(values: Any) -> Any:
            return factor * values["strength"] * mi.TensorXf([1.0, 0.8, 0.6])

        def squares(image: Any, reference: Any) -> Any:
            return dr.mean(dr.square(image - reference), axis=None) * power

        unknown = ur.Parameter("strength", initial=1.0, bounds=(0.1, 10.0))
        return problem(reference, {LEFT: LAMPS[LEFT], RIGHT: lamp}, unknown, loss=squares)

    reference, parts = picture(strength=3.0), (ur.PathGradient(spp=4), ur.optimizers.Adam(0.1))
    whole = ur.optimize(made(), *parts, steps=4)
    ur.optimize(made(), *parts, steps=2, run_directory=tmp_path)
    with pytest.raises(
        InputError,
        match=r"changed since: value of the expression of right\.intensity\.value near the start has changed;",
    ):
        ur.resume(tmp_path, made(factor=0.6), steps=4)
    with pytest.raises(InputError, match=r"changed since: loss near the first reference was \S+, is \S+;"):
        ur.resume(tmp_path, made(power=2.0), steps=4)
    with pytest.raises(InputError, match="the problem was made in Python; pass it"):
        ur.resume(tmp_path, steps=4)
    result = ur.resume(tmp_path, made(), steps=4)
    assert result.parameters["strength"].tobytes() == whole.parameters["strength"].tobytes()


def test_an_unknown_number_sets_a_number_of_the_scene() -> None:
    """Its shape (1,) was refused for the shape () of a translation or a roughness."""
    key = "left.translation.x"
    made = problem(np.zeros((8, 8, 3)), {key: "0.5 * place"}, ur.Parameter("place", initial=0.4))
    found = scene_values(made.renderer, {"place": np.array([0.6], np.float32)})
    assert found[key] == pytest.approx(0.3)
    assert found[key].shape == ()
