"""Unknowns that the references do not determine, as a user types them: one line each, and finite values."""

from __future__ import annotations

import json
import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

WALL, LAMP, OTHER, HIDDEN = (
    "wall.bsdf.reflectance.value",
    "lamp.intensity.value",
    "other.intensity.value",
    "ball.bsdf.reflectance.value",
)
STARTS = {WALL: 0.3, LAMP: 3.0, OTHER: 1.0, HIDDEN: 0.4}


def lamp(name: str, intensity: float) -> str:
    return (
        f'<emitter type="point" id="{name}"><point name="position" x="0.5" y="0.5" z="2"/>'
        f'<rgb name="intensity" value="{intensity}"/></emitter>'
    )


def written(folder: Path, size: int, *keys: str) -> Path:
    """Write a wall under two lamps at one place, with a ball behind it, and a problem of these unknowns."""
    scene = (
        '<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="2"/></integrator>'
        '<sensor type="perspective"><float name="fov" value="40"/>'
        '<transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>'
        f'<film type="hdrfilm"><integer name="width" value="{size}"/><integer name="height" value="{size}"/>'
        '<rfilter type="box"/></film></sensor>'
        '<shape type="rectangle" id="wall"><bsdf type="diffuse"><rgb name="reflectance" value="0.5,0.4,0.3"/></bsdf></shape>'
        '<shape type="sphere" id="ball"><point name="center" x="0" y="0" z="-3"/><float name="radius" value="0.3"/>'
        '<bsdf type="diffuse"><rgb name="reflectance" value="0.8,0.1,0.1"/></bsdf></shape>'
        f"{lamp('lamp', 6.0)}{lamp('other', 2.0)}</scene>"
    )
    (folder / "scene.xml").write_text(scene)
    image = mi.render(mi.load_string(scene), spp=64)
    mi.Bitmap(np.array(image)).write(str(folder / "reference.exr"))
    lines = ['scene = "scene.xml"', "max_depth = 2"]
    for key in keys:
        lines += ["[[parameters]]", f'key = "{key}"', f"initial = {STARTS[key]}"]
    path = folder / "problem.toml"
    path.write_text("\n".join([*lines, "[[views]]", 'reference = "reference.exr"']) + "\n")
    return path


def played(unrender, path: Path, variant: str) -> list[str]:
    """Run the problem, check that all numbers of its folder are finite, and return the lines about its unknowns."""
    answer = unrender("run", path, "--steps", 40, "--final-spp", 4, "--out", "out", "--variant", variant)
    assert answer.status == 0, answer.error
    assert "Traceback" not in answer.out + answer.error
    assert re.search(r"^= \S+ +\S", answer.out, re.M)
    assert "(at the end)" not in answer.out  # the best verified values may be those of an earlier step
    with np.load("out/parameters.npz") as found:
        assert all(np.isfinite(x).all() for x in found.values())
    assert "NaN" not in Path("out/run.json").read_text()
    return json.loads(Path("out/run.json").read_text())["undetermined"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("keys", "size"),
    [((WALL, LAMP), 12), ((LAMP, OTHER), 12), ((WALL, LAMP), 4)],
    ids=["light x albedo", "one lamp twice", "sixteen pixels"],
)
def test_a_pair_that_only_its_product_or_sum_determines(
    unrender, tmp_path: Path, mitsuba_variant: str, keys: tuple[str, str], size: int
) -> None:
    lines = played(unrender, written(tmp_path, size, *keys), mitsuba_variant)
    for key, other in (keys, keys[::-1]):
        (own,) = (line for line in lines if line.startswith(f"{key}: "))
        assert other in own
        assert "\n" not in own


@pytest.mark.slow
def test_a_number_that_no_picture_shows(unrender, tmp_path: Path, mitsuba_variant: str) -> None:
    lines = played(unrender, written(tmp_path, 12, WALL, HIDDEN), mitsuba_variant)
    assert len([line for line in lines if line.startswith(f"{HIDDEN}: ")]) == 1
    assert not any(line.startswith(WALL) for line in lines)


def test_an_unknown_that_is_given_twice(unrender, tmp_path: Path) -> None:
    answer = unrender("run", written(tmp_path, 4, WALL, WALL), "--steps", 2)
    assert (answer.status, answer.error.count("\n")) == (2, 1)
    assert f"parameters[1].key: {WALL} is given twice" in answer.error
