"""What the pictures do not determine is named: parameters without influence, a factor between light and colour, unseen cells."""

from __future__ import annotations

import time
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from tiers import slow
from unrender.app import report
from unrender.core.errors import InputError
from unrender.rendering.renderer import ReplacedMesh
from unrender.runs import determination
from unrender.runs.determination import common_factor, undetermined, undetermined_cells, with_lost
from unrender.runs.final_images import render_final_images
from unrender.runs.least_squares import checked_keys
from unrender.runs.refinement import remeshed
from unrender.runs.result import Result
from unrender.runs.verification import LOST, fit_status

SIZE = 8
LIGHT, COLOUR, GLOSS = "lamp.intensity.value", "wall.bsdf.reflectance.value", "wall.bsdf.clearcoat_gloss.value"


def scene(material: dict[str, Any], **others: Any) -> dict[str, Any]:
    """A wall before a lamp."""
    look = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 40, "to_world": look, "film": film},
        "lamp": {"type": "point", "position": [1, 1, 2], "intensity": {"type": "rgb", "value": [6, 5, 4]}},
        "wall": {"type": "rectangle", "bsdf": material},
        **others,
    }


def problem(described: dict[str, Any], *keys: str, truth: dict[str, Any] | None = None) -> ur.Problem:
    """These parameters of a scene, which start at its own values."""
    view = ur.View(np.full((SIZE, SIZE, 3), 0.3, np.float32))
    return ur.Problem(described, [ur.Parameter(key) for key in keys], [view], max_depth=2, truth=truth)


DIFFUSE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.4, 0.3, 0.2]}}
GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.5, 0.5]}}


def test_a_parameter_without_influence_is_named_and_others_are_not():
    """A sheen's tint where there is no sheen, and the gloss of a clear coat that is not there."""
    keys = [f"wall.bsdf.{name}.value" for name in ("base_color", "roughness", "sheen_tint", "clearcoat_gloss")]
    material = {"type": "principled", "sheen": 0.0, "clearcoat": 0.0, "sheen_tint": 0.5, "clearcoat_gloss": 0.5}
    made = problem(scene(material), *keys)
    lines = undetermined(made, made.initial_values(), 16)
    assert [line.partition(":")[0] for line in lines] == keys[2:]
    assert undetermined(made, made.initial_values(), 16, seconds=0.0) == []  # the first alone, which is determined
    seen = {key: np.ones(()) for key in keys[:2]} | {key: np.zeros(()) for key in keys[2:]}
    for most, count in ((0.0, 1), (np.inf, 2)):  # those without a gradient come first
        assert undetermined(made, made.initial_values(), 16, 0.0, most=most, sensitivities=seen) == lines[:count]
    late = {"most": 1.0, "sensitivities": seen, "path_seconds": 1.0}  # one test would take longer than there is time
    assert undetermined(made, made.initial_values(), 16, 0.0, **late) == []
    errors = {
        keys[2]: np.full(1, 0.1),
        keys[3]: np.full(1, 0.3),
    }  # least squares know the first one: precise references
    assert undetermined(made, made.initial_values(), 16, errors=errors) == lines[1:]


def test_a_parameter_that_another_hides_ends_no_run_of_the_method_that_its_error_advises():
    """Alone it has no derivative: the error of `auto` advised a method that ended with the same error."""
    made = problem(scene({"type": "principled", "clearcoat": 0.0, "clearcoat_gloss": 0.5}), GLOSS)
    with pytest.raises(
        InputError, match="no picture depends on it, since another parameter, such as a weight of 0, hides it"
    ):
        ur.optimize(made, ur.PathGradient(spp=2), ur.optimizers.Adam(0.01), steps=1)
    assert ur.sensitivity(made) == {}
    assert [line.partition(":")[0] for line in undetermined(made, made.initial_values(), 16)] == [GLOSS]


@pytest.mark.parametrize(
    ("spread", "bounds", "told"),
    [(0.6, None, 1), (0.6, (0.0, 1.0), 1), (1e-5, None, 0), (0.005, None, 0), (0.0, None, 0), (1e-5, (0.0, 1.0), 1)],
)
def test_a_bump_map_is_determined_up_to_a_constant(spread: float, bounds: tuple[float, float] | None, told: int):
    """A nearly flat map without bounds may be right: its own details change the images too little to show that others would."""
    heights = (0.5 + spread * np.random.default_rng(0).uniform(-0.5, 0.5, (6, 6, 1))).astype(np.float32)
    bumps = {"type": "bitmap", "bitmap": mi.Bitmap(heights), "raw": True}
    bumped = scene({"type": "bumpmap", "arbitrary": bumps, "scale": 0.5, "bsdf": DIFFUSE})
    view = ur.View(np.full((SIZE, SIZE, 3), 0.3, np.float32))
    made = ur.Problem(bumped, [ur.Parameter("wall.bsdf.nested_texture.data", bounds=bounds)], [view], max_depth=2)
    lines = undetermined(made, made.initial_values(), 16)
    assert ["only differences of its elements are determined" in line for line in lines] == [True] * told


def test_light_and_colour_of_all_that_is_seen_share_a_factor():
    made = problem(scene(DIFFUSE), LIGHT, COLOUR, truth={LIGHT: [6, 5, 4], COLOUR: [0.4, 0.3, 0.2]})
    values = {LIGHT: np.array([12, 10, 8], np.float32), COLOUR: np.array([0.2, 0.15, 0.1], np.float32)}
    (line,) = common_factor(made, values, 16)
    assert line.startswith(f"{LIGHT} and {COLOUR}: determined up to a common factor only")
    assert "with lights divided by 2 and reflectances multiplied by it, errors are" in line
    errors = [float(word.rstrip(",")) for word in line.rpartition("errors are ")[2].split() if word[0].isdigit()]
    assert errors == pytest.approx([0.0, 0.0], abs=1e-6)


def test_a_factor_is_tested_with_few_samples_or_named_as_untested():
    made = problem(scene(DIFFUSE), LIGHT, COLOUR)
    values = made.initial_values()
    (line,) = common_factor(made, values, 64, seconds=0.0, per_pass=4, most=np.inf)
    assert line == f"{LIGHT} and {COLOUR}: determined up to a common factor only"
    (line,) = common_factor(made, values, 64, seconds=0.0, per_pass=4)
    assert line.startswith(f"whether {LIGHT} and {COLOUR} share a factor: the run is too short for this test")


def test_a_scale_and_the_values_that_it_multiplies_share_a_factor():
    """A sky with its scale, and a projector with its own."""
    pixels = np.random.default_rng(0).uniform(0.2, 1.0, (4, 8, 3)).astype(np.float32)
    sky = {"type": "envmap", "bitmap": mi.Bitmap(pixels), "scale": 2.0}
    made = problem(scene(DIFFUSE, sky=sky), "sky.data", "sky.scale")
    expected = "sky.scale and sky.data: determined up to a common factor only"
    assert common_factor(made, made.initial_values(), 16) == [expected]
    (line,) = common_factor(made, made.initial_values(), 16, seconds=0.0, per_pass=4)
    assert line.startswith("whether sky.scale and sky.data share a factor: the run is too short for this test")
    light = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}
    look = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    beam = {"type": "projector", "irradiance": light, "scale": 5.0, "to_world": look}
    made = problem(scene(DIFFUSE, beam=beam, sky=sky), "beam.irradiance.data", "beam.scale", "sky.scale")
    assert common_factor(made, made.initial_values(), 64) == [
        "beam.scale and beam.irradiance.data: determined up to a common factor only"
    ]


@pytest.mark.parametrize("keys", [(LIGHT, COLOUR), (LIGHT,), (COLOUR,)])
def test_a_surface_of_known_colour_determines_the_factor(keys: tuple[str, ...]):
    """As does a light that is known, since only one of the two is an unknown then."""
    turned = mi.ScalarTransform4f().translate([0, -0.6, 0.2]).scale(0.5)
    made = problem(scene(DIFFUSE, card={"type": "rectangle", "to_world": turned, "bsdf": GREY}), *keys)
    for seconds in (np.inf, 0.0) if len(keys) == 1 else (np.inf,):
        assert common_factor(made, made.initial_values(), 16, seconds) == []


def test_cells_that_hardly_change_the_pictures_are_told():
    seen = np.ones((8, 8, 3), np.float32)
    assert undetermined_cells({"wall": seen, "number": np.zeros((), np.float32)}) == []
    hidden = seen.copy()
    hidden[:, :4] = 0
    (line,) = undetermined_cells({"wall": hidden})
    assert line.startswith("wall: 50% of it hardly changes the pictures")


@pytest.mark.parametrize(("size", "count"), [(0.07, 0), (0.03, 1)])
@pytest.mark.parametrize("unseen", [12, 36])
def test_elements_of_a_list_have_a_lower_limit_than_cells(size: float, count: int, unseen: int):
    """Few probes leave single elements uncertain, and cells are medians over neighbours."""
    seen = np.where(np.arange(48) < unseen, size, 1.0)
    assert len(undetermined_cells({"list": seen})) == count
    assert undetermined_cells({"wall": np.repeat(seen, 8).reshape(8, 48, 1)})


@pytest.mark.slow
def test_a_run_tells_in_its_folder(tmp_path: Any):
    material = {"type": "principled", "sheen": 0.0, "sheen_tint": 0.5}
    keys = "wall.bsdf.sheen_tint.value", "wall.bsdf.base_color.value"
    seen = ur.render(problem(scene(material), *keys), spp=64, seed=5)  # one that the base colour explains
    made = ur.Problem(scene(material), [ur.Parameter(key) for key in keys], [ur.View(seen)], max_depth=2)
    result = ur.optimize(made, steps=2, run_directory=tmp_path / "run")
    assert [line.partition(":")[0] for line in result.undetermined] == ["wall.bsdf.sheen_tint.value"]
    page = report.page(tmp_path / "run").read_text()
    assert "Not determined by the pictures" in page
    assert "wall.bsdf.sheen_tint.value: over its entire range" in page


@pytest.mark.slow
def test_a_run_that_ended_early_is_warned_in_its_folder(tmp_path: Any):
    seen = ur.render(problem(scene(DIFFUSE), COLOUR), spp=64, seed=5)
    made = ur.Problem(scene(DIFFUSE), [ur.Parameter(COLOUR, initial=0.1)], [ur.View(seen)], max_depth=2)
    result = ur.optimize(made, steps=2, run_directory=tmp_path / "run")
    (line,) = [line for line in result.warnings if "ended before it settled" in line]
    assert line.startswith(f"{COLOUR}: ")


def test_vertices_that_the_picture_does_not_show_keep_their_normals_and_are_named(tmp_path: Any):
    """The run starts at the truth, so that its gradients are noise. Five of a cube's six faces are hardly seen."""
    key, cube = "box.vertex_normals", {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.7), "bsdf": GREY}
    described = scene(GREY, box=cube)
    described["wall"]["to_world"] = mi.ScalarTransform4f().translate([0, 0, -1]).scale(3)
    view = ur.View(ur.render(problem(described, key), spp=1024))
    made = ur.Problem(described, [ur.Parameter(key)], [view], max_depth=3)
    result = ur.optimize(made, "auto", steps=30, run_directory=tmp_path)
    moved = np.abs(result.parameters[key] - result.initial[key]).reshape(-1, 3).max(axis=1)
    front = result.initial[key].reshape(-1, 3)[:, 2] > 0.5
    assert moved[~front].max() < 0.05
    assert any(line.startswith(f"{key}: ") and "hardly changes the pictures" in line for line in result.undetermined)
    for which, told in ((result.initial[key].reshape(-1, 3)[:, 2] < -0.5, True), (front, False)):
        turned = np.where(which[:, None], [0.8, 0.6, 0.0], result.initial[key].reshape(-1, 3)).astype(np.float32)
        lines = undetermined(made, {key: turned.ravel()}, 16)
        assert any("with its initial values, the pictures change by less than" in line for line in lines) is told


def test_pictures_show_only_the_ratios_of_a_tabulated_phase_functions_values():
    """A common factor changes no picture; the result has the initial length, and the error none of the factor."""
    phase = {"type": "tabphase", "values": "0.3, 0.5, 1, 2"}
    medium = {"type": "homogeneous", "albedo": 0.9, "sigma_t": 2.0, "phase": phase}
    described = scene(GREY, fog={"type": "cube", "bsdf": {"type": "null"}, "interior": medium})
    described["integrator"] = {"type": "volpath", "max_depth": 4}
    key = "fog.interior_medium.phase_function.values"
    made = problem(described, key, truth={key: problem(described, key).initial_values()[key]})
    assert any(f"{key}: pictures show only the ratios" in line for line in made.notices)
    initial = made.initial_values()[key]
    one, other = (ur.render(made, {key: np.float32(factor) * initial}, spp=64) for factor in (1.0, 1.5))
    np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4)
    assert made.parameter_error({key: 1.5 * initial})[key] == pytest.approx(0.0, abs=1e-6)
    factors = made.unknowns[key].normalised(1.5 * initial)
    assert factors is not None
    np.testing.assert_allclose(1.5 * initial * factors, initial, rtol=1e-5)


def test_lists_of_few_numbers_are_tested_by_least_squares():
    """A number and a list of five; a list that is too long is left out, and the number stays."""
    for size, count in ((5, 2), (24, 1)):
        values = {"x": np.full((), 0.5), "list": np.full(size, 0.5)}
        renderer = AnalyticRenderer(values, np.random.default_rng(0).random((192, 1 + size)), shape=(8, 8))
        made = ur.Problem(renderer, [ur.Parameter(key) for key in values], [ur.View(renderer.exact(values))])
        assert len(checked_keys(made, values, values)) == count


@pytest.mark.parametrize("bounds", [None, (0.0, None)])
def test_values_that_start_beside_the_solution_are_determined(bounds: tuple[float, None] | None, tmp_path: Any):
    """Pictures of the start and of the end are then equal; a number that moves far without changing them may be noise."""
    generator = np.random.default_rng(0)
    matrix, truth = generator.random((192, 6)), generator.random(6).astype(np.float32)
    matrix[:, 5] *= 1e-5
    names = [f"x{index}" for index in range(6)]
    renderer = AnalyticRenderer(dict.fromkeys(names, np.full((), 0.5)), matrix, noise=0.02, shape=(8, 8))
    near = [ur.Parameter(name, initial=1.001 * x, bounds=bounds) for name, x in zip(names, truth, strict=True)]
    made = ur.Problem(renderer, near, [ur.View((matrix @ truth).reshape(8, 8, 3))])
    result = ur.optimize(made, steps=40, run_directory=tmp_path)
    assert not [line for line in result.undetermined if not line.startswith("x5: ")]
    assert set(result.standard_error) >= set(names[:5])
    moved = {name: np.asarray(2.0 * x, np.float32) for name, x in made.initial_values().items()}
    lines = undetermined(made, moved, 16)
    assert [line.partition(":")[0] for line in lines] == ["x5"]
    assert undetermined(made, moved, 16, errors=dict.fromkeys(names, np.ones(()))) == []


@pytest.mark.parametrize(
    ("end", "is_lost"), [([40.0, 0.0, 0.0], True), ([0.0, 0.0, 0.3], False), slow([0.0, 0.0, 0.0], False)]
)
def test_a_ball_that_ends_outside_of_the_picture_does_not_fit(end: list[float], is_lost: bool):
    """It may cover so few pixels that the pictures hardly differ."""
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    look = mi.ScalarTransform4f().look_at([0, 1.2, 3], [0, 0.4, 0], [0, 1, 0])
    ball = {"type": "sphere", "center": [0.3, 0.2, 0.3], "radius": 0.2, "bsdf": {"type": "dielectric"}}
    described = {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 35, "to_world": look, "film": film},
        "sky": {"type": "constant"},
        "floor": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(2.0),
            "bsdf": GREY,
        },
        "ball": ball,
    }
    reference = np.array(mi.render(mi.load_dict(described | {"path": {"type": "path", "max_depth": 6}}), spp=1024))
    unknown = ur.Parameter("ball.translation", initial=[-0.3, 0.0, 0.0])
    made = ur.Problem(described, [unknown], [ur.View(reference)], max_depth=6)
    values = {"ball.translation": np.asarray(end, np.float32)}
    result = Result(values, made.initial_values(), [{}] * 60, 1.0, 0.0, "steps", verification={"best": "end"})
    found = render_final_images(made, result, 256)
    assert (found.misfit is not None and found.misfit.causes == (LOST,)) is is_lost
    assert fit_status(made, "finished", found.misfit, few=False) == ("does not fit" if is_lost else "finished")
    assert (found.misfit is not None) is any(end)


def test_unknowns_beside_a_remeshed_mesh_are_not_tested_for_loss():
    """Its initial values are those of another mesh."""
    positions = "body.vertex_positions"
    made = problem(scene(GREY, body={"type": "cube"}), positions, COLOUR)
    vertices = np.array([[0, 0, 0.5], [1, 0, 0.5], [0, 1, 0.5]], np.float32)
    moved = remeshed(made, {positions: ReplacedMesh(vertices, np.array([[0, 1, 2]]), vertices[:, :2])})
    result = Result(
        moved.initial_values(), made.initial_values(), [{}], 1.0, 0.0, "steps", verification={"best": "end"}
    )
    ends = [(np.zeros((SIZE, SIZE, 3), np.float32),) * 2]
    assert with_lost(moved, result, None, [COLOUR], ends, 4) is None


def test_unknowns_with_values_that_the_renderer_rejects_are_not_lost(monkeypatch: pytest.MonkeyPatch):
    made = problem(scene(GREY), COLOUR)
    values = {COLOUR: np.full(3, 0.9, np.float32)}
    result = Result(values, made.initial_values(), [{}], 1.0, 0.0, "steps", verification={"best": "end"})
    ends = [(np.zeros((SIZE, SIZE, 3), np.float32),) * 2]

    def reject(*_: object):
        raise InputError("rejected")

    monkeypatch.setattr(determination, "change_of_images", reject)
    assert with_lost(made, result, None, [COLOUR], ends, 4) is None


@pytest.mark.parametrize(
    ("key", "start", "end", "is_lost"),
    [
        ("wall.translation", [0.0, 0.0, 0.3], [0.0, 0.0, 1e-4], False),
        ("wall.rotation.x", 0.5, 1e-3, False),
        (LIGHT, [6.0, 5.0, 4.0], [1e-3, 1e-3, 1e-3], False),
        ("wall.translation", [0.0, 0.0, 0.0], [-50.0, -50.0, -50.0], True),
    ],
)
def test_values_that_end_near_0_are_not_lost(
    key: str, start: list[float] | float, end: list[float] | float, is_lost: bool
):
    """A tenth of such a value changes no picture; a step from a place outside of the picture must not lead back to the start."""
    view = ur.View(np.full((SIZE, SIZE, 3), 0.3, np.float32))
    made = ur.Problem(scene(GREY), [ur.Parameter(key, initial=start)], [view], max_depth=2)
    values = {key: np.asarray(end, np.float32)}
    result = Result(values, made.initial_values(), [{}], 1.0, 0.0, "steps", verification={"best": "end"})
    found = with_lost(made, result, None, [key], [(np.zeros((SIZE, SIZE, 3), np.float32),) * 2], 16)
    assert (found is not None) is is_lost


@pytest.mark.parametrize(("remaining", "changes"), [(-1.0, 0), (0.01, 2), (np.inf, 4)])
def test_the_test_of_lost_unknowns_ends_with_the_time(monkeypatch: pytest.MonkeyPatch, remaining: float, changes: int):
    made = problem(scene(GREY), COLOUR, LIGHT)
    done: list[int] = []

    def change(*_: object) -> determination.Change:
        done.append(len(done))
        time.sleep(0.01)
        return determination.Change(0.09, 0.0, 0.09)

    monkeypatch.setattr(determination, "change_of_images", change)
    values = made.initial_values()
    result = Result(values, values, [{}], 1.0, 0.0, "steps", verification={"best": "end"})
    ends = [(np.zeros((SIZE, SIZE, 3), np.float32),) * 2]
    assert with_lost(made, result, None, [COLOUR, LIGHT], ends, 4, lambda: remaining) is None
    assert len(done) == changes


def test_pixels_outside_the_mask_do_not_determine_a_factor():
    """A card of known colour that no loss sees."""
    turned = mi.ScalarTransform4f().translate([0, -0.6, 0.2]).scale(0.5)
    described = scene(DIFFUSE, card={"type": "rectangle", "to_world": turned, "bsdf": GREY})
    reference = np.full((SIZE, SIZE, 3), 0.3, np.float32)
    for first, count in ((0, 0), (SIZE // 2, 1)):
        mask = (np.arange(SIZE) < SIZE - first)[:, None] * np.ones((SIZE, SIZE), np.float32)
        made = ur.Problem(
            described, [ur.Parameter(LIGHT), ur.Parameter(COLOUR)], [ur.View(reference, mask=mask)], max_depth=2
        )
        assert len(common_factor(made, made.initial_values(), 16)) == count
