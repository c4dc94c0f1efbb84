"""One unknown that stands for several parameters: its values, gradients, ranges, files and what it refuses."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from unrender.app.exporting import scene_folder
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.parameter_errors import Role
from unrender.rendering.renderer import ParameterInfo, SampleRequest
from unrender.rendering.tied import Tie, with_ties
from unrender.scene import fingerprint, serialization

LEFT, RIGHT = "left.bsdf.alpha.value", "right.bsdf.alpha.value"
LAMPS = ("key.intensity.value", "fill.intensity.value")


def scene() -> dict[str, Any]:
    place = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}}
    metal = {"type": "roughconductor", "alpha": 0.3}
    return {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 45, "to_world": place().look_at([0, 2, 4], [0, 0.3, 0], [0, 1, 0]), "film": film},
        "floor": {"type": "rectangle", "to_world": place().rotate([1, 0, 0], -90).scale(2)},
        "left": {"type": "sphere", "center": [-0.6, 0.4, 0], "radius": 0.4, "bsdf": dict(metal)},
        "right": {"type": "sphere", "center": [0.6, 0.4, 0], "radius": 0.4, "bsdf": dict(metal)},
        "key": {"type": "point", "position": [1, 3, 1], "intensity": {"type": "rgb", "value": [8.0, 8.0, 4.0]}},
        "fill": {"type": "point", "position": [-2, 2, 2], "intensity": {"type": "rgb", "value": [4.0, 4.0, 2.0]}},
    }  # fmt: skip


TIES = (Tie("gloss", {LEFT: 1.0, RIGHT: 1.0}), Tie("light", {LAMPS[0]: 1.0, LAMPS[1]: 0.5}))


BRIGHT = [6.0, 6.0, 3.0]
DIM = [3.0, 3.0, 1.5]


def pixels(renderer: Any, values: dict[str, Any], seed: int = 3) -> np.ndarray:
    session = renderer.prepare(list(values), None, derivatives=False)
    tree = {key: renderer.array(np.asarray(value, np.float32)) for key, value in values.items()}
    return session.image(tree, SampleRequest(0, 8, seed)).images.numpy()[0]


def test_a_tie_renders_as_its_members_at_these_values() -> None:
    plain = MitsubaRenderer(scene, 3)
    tied = with_ties(plain, TIES)
    known = tied.parameters()
    assert {"gloss", "light"} <= set(known)
    assert not {LEFT, RIGHT, *LAMPS} & set(known)
    found = pixels(tied, {"gloss": 0.2, "light": BRIGHT})
    expected = pixels(plain, {LEFT: 0.2, RIGHT: 0.2, LAMPS[0]: BRIGHT, LAMPS[1]: DIM})
    np.testing.assert_array_equal(found, expected)
    assert not np.array_equal(found, pixels(plain, {LEFT: 0.2, LAMPS[0]: BRIGHT})), "a member was left out"
    assert np.array(tied.values(["light"])["light"]).tolist() == [8.0, 8.0, 4.0]
    states = {"gloss": np.array([0.2, 0.4]), "light": np.broadcast_to(np.asarray(BRIGHT, np.float32), (2, 3))}
    batch = tied.prepare(["gloss", "light"], None, False).image_batch(states, SampleRequest(0, 8, 3)).numpy()
    np.testing.assert_allclose(batch[0], found, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("factor", [0.5, -1.0])
def test_ranges_are_those_in_which_every_member_is_within_its_own(factor: float) -> None:
    found = with_ties(MitsubaRenderer(scene, 3), [Tie("light", {LAMPS[0]: factor, LAMPS[1]: factor})]).parameters()[
        "light"
    ]
    assert (found.lowest, found.highest) == ((0.0, None) if factor > 0 else (None, -0.0))


def test_the_gradient_of_a_tie_is_the_sum_of_its_members_gradients_by_their_factors() -> None:
    """In closed form from the members' own gradients; a factor that was forgotten would show."""
    plain = MitsubaRenderer(scene, 3)
    tied = with_ties(plain, TIES)
    values = {"gloss": 0.2, "light": BRIGHT}
    members = {LEFT: 0.2, RIGHT: 0.2, LAMPS[0]: BRIGHT, LAMPS[1]: DIM}
    request = SampleRequest(0, 8, 5, 2)
    weights = mi.TensorXf(np.random.default_rng(0).uniform(0, 1, (2, 12, 12, 3)).astype(np.float32))

    def gradients(renderer: Any, at: dict[str, Any]) -> dict[str, np.ndarray]:
        session = renderer.prepare(list(at), "path")
        tree = {key: renderer.array(np.asarray(value, np.float32)) for key, value in at.items()}
        before = {key: renderer.array(1.1 * np.asarray(value, np.float32)) for key, value in at.items()}
        one = session.adjoint(tree, session.image(tree, request).paths, weights)
        pair = session.image_pair(tree, before, SampleRequest(0, 8, 5, 2, both_gradients=True), "path")
        both = session.adjoint_pair(tree, before, pair.paths, weights, weights)
        return {
            f"{number} {key}": np.array(value)
            for number, found in enumerate((one, *both))
            for key, value in found.items()
        }

    own, found = gradients(plain, members), gradients(tied, values)
    for number in range(3):
        gloss = own[f"{number} {LEFT}"] + own[f"{number} {RIGHT}"]
        light = own[f"{number} {LAMPS[0]}"] + 0.5 * own[f"{number} {LAMPS[1]}"]
        assert found[f"{number} gloss"] == pytest.approx(gloss, rel=1e-4)
        assert found[f"{number} light"] == pytest.approx(light, rel=1e-4)
        assert found[f"{number} light"] != pytest.approx(light + 0.5 * own[f"{number} {LAMPS[1]}"], rel=1e-2)


def problem(**options: Any) -> ur.Problem:
    path = mi.load_dict({"type": "path", "max_depth": 3})
    described = scene()
    described["left"]["bsdf"]["alpha"] = described["right"]["bsdf"]["alpha"] = 0.15
    for lamp, light in (("key", [10.0, 10.0, 5.0]), ("fill", [5.0, 5.0, 2.5])):
        described[lamp]["intensity"]["value"] = light
    reference = np.array(mi.render(mi.load_dict(described, optimize=False), integrator=path, spp=512))
    unknown = [
        ur.Parameter("gloss", initial=0.3, keys=[LEFT, RIGHT]),
        ur.Parameter(keys={LAMPS[0]: 1.0, LAMPS[1]: 0.5}, initial=6.0),
    ]
    return ur.Problem(
        scene, unknown, [ur.View(reference)], max_depth=3, truth={"gloss": 0.15, LAMPS[0]: [10.0, 10.0, 5.0]}, **options
    )


@pytest.mark.slow
def test_ties_are_recovered_and_exported(tmp_path: Path) -> None:
    unknown = problem()
    assert list(unknown.shapes()) == ["gloss", LAMPS[0]]
    result = ur.optimize(unknown, steps=80, progress=False, seed=1)
    before, after = (unknown.parameter_error(values) for values in (result.initial, result.parameters))
    assert all(after[key] < 0.6 * before[key] for key in before), (before, after)
    done = ur.app.export((unknown, result.parameters), tmp_path / "scene")
    values: Any = MitsubaRenderer(str(done.scene)).pair.current_parameters
    roughness = [float(values[key][0]) for key in (LEFT, RIGHT)]
    assert roughness == pytest.approx([float(result.parameters["gloss"])] * 2, rel=1e-4)
    for key, factor in zip(LAMPS, (1, 0.5), strict=True):
        np.testing.assert_allclose(np.array(values[key]).ravel(), factor * result.parameters[LAMPS[0]], rtol=1e-4)


def test_a_tie_is_singular_where_a_member_is() -> None:
    """It was where the first member's own value is: bounds of 1.01 and more let the other cross 1."""
    known = {key: ParameterInfo((), lowest=0.2, highest=5.0, singular=1.0) for key in "ab"}
    assert Tie("both", {"a": 0.8, "b": 0.8}).info(known).singular == 1.25
    with pytest.raises(ur.InputError, match=r"singular at 1 and 1\.25; expected equal"):
        Tie("both", {"a": 1.0, "b": 0.8}).info(known)


@pytest.mark.parametrize("role", ["value", "height", "normal", "direction"])
def test_values_are_tied_unless_they_are_encoded_differently(role: Role) -> None:
    """A bump height is a number, as in another texture; a texel of a normal map is a vector."""
    known = {"a": ParameterInfo((2, 2, 1)), "b": ParameterInfo((2, 2, 1), role=role)}
    tie = Tie("both", {"a": 1.0, "b": 1.0})
    if role in ("value", "height"):
        assert tie.info(known).shape == (2, 2, 1)
    else:
        with pytest.raises(ur.InputError, match="read their values differently"):
            tie.info(known)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([{"keys": [LEFT, "rihgt.bsdf.alpha.value"]}], "did you mean right.bsdf.alpha.value?"),
        ([{"keys": [LEFT, LAMPS[0]]}], "has the shape (3,), left.bsdf.alpha.value (); expected equal shapes"),
        ([{"keys": ["floor.bsdf.reflectance.value", LAMPS[0]]}], "expected parameters of one kind"),
        ([{"keys": ["left.translation", "right.rotation"]}], "read their values differently"),
        ([{"keys": [LEFT, RIGHT]}, {"key": RIGHT}], "is an unknown of its own"),
        ([{"key": "a", "keys": [LEFT, RIGHT]}, {"key": "b", "keys": [RIGHT]}], "is tied to a already"),
        ([{"keys": {LEFT: 0.0}}], f"keys: {LEFT}: expected a finite factor other than 0, got 0.0"),
        ([{"keys": {LEFT: math.nan}}], f"keys: {LEFT}: expected a finite factor other than 0, got nan"),
        (
            [{"keys": {LAMPS[0]: -1.0, LAMPS[1]: 1.0}}],
            "no range of values is within the ranges of key.intensity.value and fill",
        ),
        ([{"keys": []}], "expected at least one key"),
        ([{"keys": [LEFT, LEFT]}], "a key is given twice"),
        ([{"keys": LEFT}], "expected a list of keys"),
        ([{"key": "floor.bsdf.reflectance.value", "keys": [LEFT, RIGHT]}], "is a parameter of the scene itself"),
    ],
)
def test_what_cannot_be_tied_is_one_line_that_names_the_field(given: list[dict[str, Any]], words: str) -> None:
    views = [ur.View(np.zeros((12, 12, 3)))]
    with pytest.raises(ur.InputError) as caught:
        ur.Problem(scene, [ur.Parameter(**fields) for fields in given], views)
    assert words in str(caught.value)
    assert "keys" in str(caught.value)
    assert "\n" not in str(caught.value)


XML = """<scene version="3.0.0">
  <sensor type="perspective" id="camera">
  <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>
  <shape type="sphere" id="a"><bsdf type="diffuse"><rgb name="reflectance" value="0.2"/></bsdf></shape>
  <shape type="sphere" id="b"><bsdf type="diffuse"><rgb name="reflectance" value="0.4"/></bsdf></shape>
  <emitter type="constant" id="sky"/>
</scene>"""
ROWS = '\n[[parameters]]\n{fields}\n\n[[views]]\nreference = "photo.npy"\n'


def written(folder: Path, fields: str) -> Path:
    (folder / "scene.xml").write_text(XML)
    np.save(folder / "photo.npy", np.full((8, 8, 3), 0.5, np.float32))
    file = folder / "problem.toml"
    file.write_text('scene = "scene.xml"\n' + ROWS.format(fields=fields))
    return file


def test_a_problem_file_has_keys_and_factors_and_a_run_folder_keeps_them(tmp_path: Path) -> None:
    fields = (
        'key = "paint"\ninitial = 0.25\nkeys = { "a.bsdf.reflectance.value" = 1.0, "b.bsdf.reflectance.value" = 2.0 }'
    )
    first = ur.Problem.from_file(written(tmp_path, fields))
    assert first.unknowns["paint"].bounds == (0.0, 0.5)  # both reflectances stay below 1
    serialization.save(first, tmp_path / "run")
    again = ur.Problem.from_file(tmp_path / "run" / "problem.toml")
    assert again.unknowns["paint"].parameter.keys == {"a.bsdf.reflectance.value": 1.0, "b.bsdf.reflectance.value": 2.0}
    assert fingerprint.fingerprint(first) == fingerprint.fingerprint(again)
    other = fields.replace("2.0", "3.0")
    assert fingerprint.fingerprint(ur.Problem.from_file(written(tmp_path, other))) != fingerprint.fingerprint(first)


@pytest.mark.parametrize(
    ("fields", "line", "words"),
    [
        (
            "initial = 0.25",
            "problem.toml:",
            "missing, expected the name of a scene parameter, or several names as keys",
        ),
        (
            'keys = ["a.bsdf.reflectance.value", "sky.radiance.valu"]',
            "problem.toml:4",
            "no parameter sky.radiance.valu",
        ),
        ('keys = "a.bsdf.reflectance.value"', "problem.toml:4", "scene parameters that share one value"),
        ('keys = { "a.bsdf.reflectance.value" = 0 }', "problem.toml:4", "expected a finite factor other than 0"),
    ],
)
def test_a_wrong_tie_in_a_file_is_one_line_that_names_its_line(
    tmp_path: Path, fields: str, line: str, words: str
) -> None:
    with pytest.raises(ur.InputError) as caught:
        ur.Problem.from_file(written(tmp_path, fields))
    assert line in str(caught.value)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.usefixtures("short_ends")
def test_a_pattern_of_two_posters_and_the_paint_of_their_boards_are_recovered(tmp_path: Path) -> None:
    """The export's textures and paints are those of the result, by the expressions and the tie's factors."""
    made = ur.gallery.problem("two-posters", resolution=24, texture_resolution=8)
    result = ur.optimize(made, steps=40, progress=False, run_directory=tmp_path / "run")
    before, after = (made.parameter_error(values) for values in (result.initial, result.parameters))
    assert after["pattern"] < 0.2 * before["pattern"]
    assert after["boards"] < 0.02
    scene_folder.export((made, result.parameters), tmp_path / "asset")
    shown = np.array(mi.render(mi.load_file(str(tmp_path / "asset" / "scene.xml")), spp=512))[..., :3]
    np.testing.assert_allclose(
        shown.mean(axis=(0, 1)), ur.render(made, result.parameters, spp=512).mean(axis=(0, 1)), rtol=0.01
    )
