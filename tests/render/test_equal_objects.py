# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

"""Equal objects, which Mitsuba merges where it loads a scene by itself, are told where one of them is unknown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur


def matte(value: float = 0.5) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [value] * 3}}


def textured(roughness: float, picture: Path) -> dict[str, Any]:
    return {"type": "principled", "base_color": {"type": "bitmap", "filename": str(picture)}, "roughness": roughness}


def scene(first: dict[str, Any], second: dict[str, Any], **more: Any) -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "film": film},
        "first": {"type": "rectangle", "bsdf": first},
        "second": {"type": "sphere", "bsdf": second},
    } | more


def notices(described: Any, key: str) -> list[str]:
    return ur.Problem(described, [ur.Parameter(key)], [ur.View(np.zeros((4, 4, 3)))], max_depth=2).notices


@pytest.mark.parametrize(
    ("key", "other"),
    [
        ("first.bsdf.reflectance.value", "second.bsdf.brdf_0.reflectance.value"),
        ("second.bsdf.brdf_0.reflectance.value", "first.bsdf.reflectance.value"),
    ],
)
def test_both_keys_are_named(key: str, other: str) -> None:
    described = scene(matte(), {"type": "twosided", "inner": matte()})
    (line,) = notices(described, key)
    assert key in line
    assert other in line
    assert "optimize=False" in line
    assert "\n" not in line
    merged = mi.traverse(mi.load_dict(described))
    assert not {key, other} <= {*merged.keys()}
    assert {key, other} <= {*mi.traverse(mi.load_dict(described, optimize=False)).keys()}


def test_two_unknowns_share_the_notice() -> None:
    keys = ["first.bsdf.reflectance.value", "second.bsdf.reflectance.value"]
    parameters = [ur.Parameter(key) for key in keys]
    (line,) = ur.Problem(scene(matte(), matte()), parameters, [ur.View(np.zeros((4, 4, 3)))], max_depth=2).notices
    assert all(key in line for key in keys)


def test_a_tie_of_all_that_mitsuba_merges_is_no_notice() -> None:
    """It was said to be separate from its own members."""
    keys = [f"{name}.bsdf.reflectance.value" for name in ("first", "second", "third")]
    described = scene(matte(), matte(), third={"type": "disk", "bsdf": matte()})

    def told(tied: Any) -> list[str]:
        made = ur.Problem(described, [ur.Parameter("paint", keys=tied, initial=0.4)], [ur.View(np.zeros((4, 4, 3)))])
        renamed = made.replaced(parameters=[ur.Parameter("clay", keys=tied, initial=0.4)])
        assert renamed.notices == made.notices
        return made.notices

    assert told(keys) == []
    (line,) = told(keys[:2])
    assert line.startswith(f"{keys[0]}: first.bsdf equals third.bsdf, ")
    (line,) = told(dict(zip(keys, (1.0, 0.5, 1.0), strict=True)))
    assert line.startswith(f"{keys[0]}: first.bsdf equals second.bsdf and 1 more, ")


def test_equal_textures_of_other_materials(tmp_path: Path) -> None:
    mi.Bitmap(np.ones((4, 4, 3), np.float32)).write(str(tmp_path / "a.exr"))
    described = scene(textured(0.2, tmp_path / "a.exr"), textured(0.3, tmp_path / "a.exr"))
    (line,) = notices(described, "first.bsdf.base_color.data")
    assert "second.bsdf.base_color.data" in line
    assert notices(described, "first.bsdf.roughness.value") == []


def test_nothing_is_said_of_what_differs_is_shared_or_known() -> None:
    assert notices(scene(matte(), matte(0.501)), "first.bsdf.reflectance.value") == []
    shared = {"type": "ref", "id": "clay"}
    described = {"type": "scene", "clay": matte(), **scene(shared, shared)}
    assert notices(described, "clay.reflectance.value") == []
    lamp = {"type": "sphere", "emitter": {"type": "area"}}
    assert notices(scene(matte(), matte(), lamp=lamp), "lamp.emitter.radiance.value") == []


def test_a_texture_that_equal_materials_share_is_one(tmp_path: Path) -> None:
    """Its key was said to change one of the materials only."""
    mi.Bitmap(np.full((4, 4, 3), 0.5, np.float32)).write(str(tmp_path / "a.exr"))
    shared = {"type": "diffuse", "reflectance": {"type": "ref", "id": "paint"}}
    described = scene(shared, {"type": "twosided", "inner": shared})
    paint = {"type": "bitmap", "filename": str(tmp_path / "a.exr")}
    key = "first.bsdf.reflectance.data"
    assert notices({"type": "scene", "paint": paint, **described}, key) == []
    third = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": paint}}
    (line,) = notices({"type": "scene", "paint": paint, **described, "third": third}, key)
    assert "third.bsdf.reflectance.data are separate" in line


def test_files_tell_the_same(tmp_path: Path) -> None:
    material = '<bsdf type="diffuse" id="{}"><rgb name="reflectance" value=".5"/></bsdf>'
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/>'
        '<integer name="height" value="4"/></film></sensor>'
        + material.format("one")
        + material.format("two")
        + '<shape type="rectangle"><ref id="one"/></shape><shape type="sphere"><ref id="two"/></shape></scene>'
    )
    (line,) = notices(tmp_path / "scene.xml", "two.reflectance.value")
    assert "two equals one" in line
    assert "one.reflectance.value" in line
