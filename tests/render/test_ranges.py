"""Physical ranges belong to the slots that read a value; every key of every plugin has one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from scripts.coverage import ranges_page
from scripts.coverage.plugins import PLUGINS
from scripts.coverage.scenes import scene, wheel
from unrender.rendering.mitsuba.ranges import CLASSES, KINDS
from unrender.rendering.mitsuba.renderer import MitsubaRenderer

VIEW = ur.View(np.full((16, 16, 3), 0.5, np.float32))


def bounds(description: Any, **starts: Any) -> dict[str, tuple[float | None, float | None]]:
    """The bounds of parameters, whose keys have '__' for '.', with their initial values."""
    parameters = [ur.Parameter(key.replace("__", "."), start) for key, start in starts.items()]
    return {key: unknown.bounds for key, unknown in ur.Problem(description, parameters, [VIEW]).unknowns.items()}


def sheet(textures: dict[str, Any], attributes: dict[str, int]) -> Any:
    """A scene whose ball is a cube of a principled BSDF with these textures and mesh attributes."""

    def description() -> dict[str, Any]:
        mesh: Any = mi.load_dict(
            {"type": "cube", "bsdf": {"type": "twosided", "b": {"type": "principled", **textures}}}
        )
        for name, channels in attributes.items():
            count = mesh.vertex_count() if name.startswith("vertex_") else mesh.face_count()
            mesh.add_attribute(name, channels, np.full(count * channels, 0.5, np.float32))
        return scene(ball=mesh)

    return description


def attribute(name: str, scale: float = 1.0) -> dict[str, Any]:
    return {"type": "mesh_attribute", "name": name, "scale": scale}


def test_the_scenes_are_those_of_all_plugins_of_the_wheel() -> None:
    assert sorted({name.partition(",")[0] for name in PLUGINS}) == wheel()


@pytest.mark.parametrize("kind", sorted({plugin.kind for plugin in PLUGINS.values()}))
def test_no_key_of_a_plugin_is_without_a_range(kind: str) -> None:
    found = [row for name, plugin in PLUGINS.items() if plugin.kind == kind for row in ranges_page.rows(name, plugin)]
    assert found
    assert ranges_page.missing(found) == []


def test_a_missing_entry_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(KINDS["BSDF"], "alpha")
    monkeypatch.delitem(CLASSES["Hair"], "scale_tilt")
    found = [row for name in ("roughplastic", "hair") for row in ranges_page.rows(name, PLUGINS[name])]
    assert ranges_page.missing(found) == ["roughplastic: alpha", "hair: scale_tilt"]


def test_the_page_has_every_plugin() -> None:
    written = ranges_page.page()
    valued = [name for name, plugin in PLUGINS.items() if plugin.kind not in ranges_page.NO_VALUES]
    assert [n for n in valued if ranges_page.rows(n, PLUGINS[n]) and f"| `{n}` |" not in written] == []


def test_mesh_attributes_have_the_range_of_the_slot_that_reads_them() -> None:
    textures = {
        "base_color": attribute("vertex_color", 2.0),
        "roughness": attribute("vertex_rough"),
        "metallic": attribute("face_metal", -1.0),
    }
    description = sheet(textures, {"vertex_color": 3, "vertex_rough": 1, "face_metal": 1, "vertex_idle": 1})
    found = bounds(
        description, ball__vertex_color=0.2, ball__vertex_rough=0.5, ball__face_metal=-0.5, ball__vertex_idle=0.5
    )
    assert found["ball.vertex_color"] == (0.0, 0.5)
    assert found["ball.vertex_rough"] == (0.02, 1.0)
    assert found["ball.face_metal"] == (-1.0, 0.0)
    assert found["ball.vertex_idle"] == (None, None)


def test_roughness_and_media_change_the_form_of_scattering_and_a_colour_does_not() -> None:
    """By the slot that reads the values, directly or as a mesh attribute."""
    principled = scene(ball={"type": "sphere", "bsdf": {"type": "principled", "roughness": 0.3, "metallic": 0.2}})
    plastic = scene(ball={"type": "sphere", "bsdf": {"type": "roughplastic", "alpha": 0.3}})
    textures = {"base_color": attribute("vertex_color"), "roughness": attribute("vertex_rough")}
    fog = {"type": "homogeneous", "phase": {"type": "hg", "g": 0.5}}
    cloud = scene(ball={"type": "sphere", "bsdf": {"type": "null"}, "interior": fog})
    described = (principled, plastic, cloud, sheet(textures, {"vertex_color": 3, "vertex_rough": 1}))
    known = {key: info for one in described for key, info in MitsubaRenderer(one, 3).parameters().items()}
    expected = {
        "ball.bsdf.base_color.value": "",
        "ball.bsdf.roughness.value": "bsdf",
        "ball.bsdf.metallic.value": "bsdf",
        "ball.bsdf.diffuse_reflectance.value": "",
        "ball.bsdf.alpha": "bsdf",
        "ball.interior_medium.sigma_t.value.value": "medium",
        "ball.interior_medium.albedo.value.value": "medium",
        "ball.interior_medium.phase_function.g": "medium",
        "ball.vertex_color": "",
        "ball.vertex_rough": "bsdf",
    }
    assert {key: known[key].scattering for key in expected} == expected


def test_an_attribute_of_two_slots_has_the_range_of_both_and_another_mesh_its_own() -> None:
    textures = {"base_color": attribute("vertex_x"), "roughness": attribute("vertex_x")}

    def description() -> dict[str, Any]:
        found = sheet(textures, {"vertex_x": 1})()
        light = {"type": "area", "radiance": attribute("vertex_x")}
        lamp: Any = mi.load_dict(
            {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 3, 0]), "emitter": light}
        )
        lamp.add_attribute("vertex_x", 3, np.full(lamp.vertex_count() * 3, 4.0, np.float32))
        return {**found, "lamp": lamp}

    found = bounds(description, ball__vertex_x=0.5, lamp__vertex_x=4.0)
    assert found == {"ball.vertex_x": (0.02, 1.0), "lamp.vertex_x": (0.0, None)}


def test_textures_by_reference_in_nested_textures_and_in_volumes_have_the_range_of_the_slot() -> None:
    board = {"type": "checkerboard", "color0": {"type": "rgb", "value": [0.2, 0.3, 0.4]}}
    alpha = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((4, 4, 1), 0.3, np.float32)), "raw": True}
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(np.full((2, 2, 2, 3), 0.5, np.float32))}
    masked = {"type": "mask", "opacity": 0.5, "b": {"type": "diffuse", "reflectance": {"type": "ref", "id": "board"}}}
    described = scene(
        map=alpha,
        board=board,
        ball={"type": "sphere", "bsdf": {"type": "roughconductor", "alpha": {"type": "ref", "id": "map"}}},
        cube={"type": "cube", "bsdf": masked},
        block={"type": "cube", "bsdf": {"type": "diffuse", "reflectance": {"type": "volume", "volume": grid}}},
    )
    known = MitsubaRenderer(described, 3).parameters()
    ends = {key: (info.lowest, info.highest) for key, info in known.items() if info.differentiable}
    expected = {"map": (0.02, 1.0), "board.color0": (0.0, 1.0), "block.bsdf.reflectance.volume": (0.0, 1.0)}
    for name, limits in expected.items():  # an object that two others hold has the name of one of them
        here = {"map": "ball.bsdf.alpha", "board.color0": "cube.bsdf.nested_bsdf.reflectance.color0"}.get(name, name)
        (found,) = (ends[key] for key in ends if key.rpartition(".")[0] in (name, here))
        assert found == limits, name


@pytest.mark.parametrize(("start", "expected"), [(1.3, (1.01, 5.0)), (0.8, (0.2, 0.99)), (1.004, (1.002, 5.0))])
def test_an_index_of_refraction_stays_on_the_side_of_one_on_which_it_starts(start: float, expected: Any) -> None:
    glass = scene(ball={"type": "sphere", "bsdf": {"type": "roughdielectric", "alpha": 0.2, "int_ior": 1.5}})
    assert bounds(glass, ball__bsdf__eta=start)["ball.bsdf.eta"] == pytest.approx(expected, rel=1e-5)


def test_the_angles_of_a_spotlight_do_not_bound_each_other() -> None:
    """Each had the other one's loaded value as a bound, which excluded the truth if both were unknown."""
    light = {"type": "spot", "cutoff_angle": 30.0, "beam_width": 20.0}
    found = bounds(scene(lamp=light), lamp__cutoff_angle=30.0, lamp__beam_width=20.0)
    assert found == dict.fromkeys(("lamp.cutoff_angle", "lamp.beam_width"), (0.0, 90.0))


def test_bounds_across_a_singular_value_are_narrowed_and_a_start_at_it_is_refused() -> None:
    glass = scene(ball={"type": "sphere", "bsdf": {"type": "roughdielectric", "alpha": 0.2, "int_ior": 1.5}})
    given = ur.Problem(glass, [ur.Parameter("ball.bsdf.eta", 1.5, bounds=(0.9, 2.0))], [VIEW])
    assert given.unknowns["ball.bsdf.eta"].bounds == pytest.approx((1.01, 2.0))
    assert any("bounds narrowed to [1.01, 2]: images are singular at 1" in line for line in given.notices)
    inside = ur.Problem(glass, [ur.Parameter("ball.bsdf.eta", 1.5, bounds=(1.2, 2.0))], [VIEW])
    assert inside.unknowns["ball.bsdf.eta"].bounds == (1.2, 2.0)
    below = ur.Problem(glass, [ur.Parameter("ball.bsdf.eta", 0.7)], [VIEW])
    assert any("bounds narrowed to [0.2, 0.99]: images are singular at 1" in line for line in below.notices)
    assert not inside.notices
    with pytest.raises(ur.InputError, match=r"singular at 1: expected initial values on one side of it, got 1$"):
        ur.Problem(glass, [ur.Parameter("ball.bsdf.eta", 1.0)], [VIEW])


def test_steps_that_overshoot_stay_in_range() -> None:
    """Gradients point out of the range in most elements; steps are larger than the range."""
    textures = {"roughness": attribute("vertex_rough"), "metallic": attribute("vertex_metal")}
    keys = ["ball.vertex_rough", "ball.vertex_metal"]
    description = sheet(textures, {"vertex_rough": 1, "vertex_metal": 1})
    problem = ur.Problem(description, [ur.Parameter(key) for key in keys], [VIEW], max_depth=2)
    result = ur.optimize(problem, ur.PathGradient(spp=4), ur.optimizers.Adam(3.0), steps=4)
    for key, low in zip(keys, (0.02, 0.0), strict=True):
        assert np.all((low <= result.parameters[key]) & (result.parameters[key] <= 1.0)), key


def test_a_lens_stays_positive() -> None:
    camera = PLUGINS["thinlens"].build(Path())["camera"]
    known = bounds(scene(camera=camera), camera__aperture_radius=0.1, camera__focus_distance=3.0)
    assert known == {"camera.aperture_radius": (0.0, None), "camera.focus_distance": (0.0, None)}


def test_numbers_that_mitsuba_compiles_have_a_next_step() -> None:
    """The scale of a bump map or medium multiplies its texture or extinction; scales of the sky have no such parameter."""
    fog = {"type": "heterogeneous", "sigma_t": {"type": "constvolume", "value": 0.5}, "scale": 2.0}
    to_scene = {
        "type": "scene",
        "camera": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
        "sky": {"type": "sunsky"},
        "wall": {
            "type": "rectangle",
            "bsdf": {
                "type": "bumpmap",
                "relief": {"type": "bitmap", "bitmap": mi.Bitmap(np.full((4, 4, 1), 0.5, np.float32)), "raw": True},
                "inner": {"type": "diffuse"},
                "scale": 0.1,
            },
        },
        "box": {"type": "cube", "bsdf": {"type": "null"}, "interior": fog},
    }
    for key, hint in (
        ("wall.bsdf.scale", "recover wall.bsdf.nested_texture.data in its place"),
        ("box.interior_medium.scale", "recover box.interior_medium.sigma_t.value.value in its place"),
        ("sky.sky_scale", "run once for each of several values, and compare the losses"),
        ("sky.sun_scale", "run once for each of several values, and compare the losses"),
    ):
        with pytest.raises(ur.InputError, match=hint):
            ur.Problem(lambda: to_scene, [ur.Parameter(key)], [ur.View(np.zeros((4, 4, 3), np.float32))])
