"""Settings of a scene that are not used are told, and only those."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unrender as ur

XML = """<scene version="3.0.0">
    <sensor type="perspective"><film type="hdrfilm">
        <integer name="width" value="4"/><integer name="height" value="4"/>{film}
    </film></sensor>{integrator}
    <shape type="rectangle"><bsdf type="diffuse"/></shape>
    <shape type="sphere" id="lamp"><emitter type="area"/></shape>
</scene>"""
BOX = '<rfilter type="box"/>'
KEY = "lamp.emitter.radiance.value"


def notices(scene: Any, max_depth: int = 6) -> list[str]:
    view = ur.View(np.full((4, 4, 3), 0.5, np.float32))
    return ur.Problem(scene, [ur.Parameter(KEY)], [view], max_depth=max_depth).notices


def xml(folder: Path, integrator: str = "", film: str = BOX) -> Path:
    path = folder / "scene.xml"
    path.write_text(XML.format(integrator=integrator, film=film))
    return path


def test_nothing_is_said_of_a_scene_whose_settings_are_used(tmp_path: Path) -> None:
    assert notices(xml(tmp_path)) == []
    same = '<integrator type="prb"><integer name="max_depth" value="6"/></integrator>'
    assert notices(xml(tmp_path, same)) == []


@pytest.mark.parametrize(
    ("integrator", "words"),
    [
        (
            '<integrator type="path"/>',
            "integrator (PathIntegrator, max_depth unlimited) is not used: paths have up to 6",
        ),
        ('<integrator type="direct"/>', "integrator (DirectIntegrator"),
        ('<integrator type="path"><integer name="max_depth" value="3"/></integrator>', "max_depth 3) is not used"),
        (
            '<integrator type="path"><integer name="max_depth" value="6"/>'
            '<boolean name="hide_emitters" value="true"/></integrator>',
            "hide_emitters is not used",
        ),
    ],
)
def test_an_integrator_that_is_not_used_is_told(tmp_path: Path, integrator: str, words: str) -> None:
    (line,) = notices(xml(tmp_path, integrator))
    assert words in line
    assert "\n" not in line


def test_a_reconstruction_filter_is_told_also_the_default_one(tmp_path: Path) -> None:
    for film in ("", '<rfilter type="gaussian"/>'):
        (line,) = notices(xml(tmp_path, film=film))
        assert "reconstruction filter (gaussian) is not used" in line


def test_a_dictionary_tells_the_same() -> None:
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
    scene = {
        "type": "scene",
        "camera": {"type": "perspective", "film": film},
        "lamp": {"type": "sphere", "emitter": {"type": "area"}},
        "integrator": {"type": "path", "max_depth": 6, "hide_emitters": True},
    }
    (line,) = notices(scene)
    assert "hide_emitters is not used" in line
    scene["integrator"]["hide_emitters"] = False
    assert notices(scene) == []


def test_an_object_without_an_id_in_a_file_is_named_as_such(tmp_path: Path) -> None:
    with pytest.raises(ur.InputError, match=r'nothing has the id wall: give the object that holds bsdf.*id="wall"'):
        ur.Problem(xml(tmp_path), [ur.Parameter("wall.bsdf.reflectance.value")], [ur.View(np.zeros((4, 4, 3)))])


def test_mitsuba_s_own_optimizer_is_refused_in_one_line(tmp_path: Path) -> None:
    import mitsuba as mi

    made = ur.Problem(xml(tmp_path), [ur.Parameter(KEY)], [ur.View(np.zeros((4, 4, 3)))])
    for given in (mi.ad.Adam(lr=0.1), mi.ad.Adam, mi.ad.SGD(lr=0.1)):
        with pytest.raises(ur.InputError, match=r"expected unrender.optimizers.\w+\(learning_rate=...\)"):
            ur.optimize(made, ur.PathGradient(), given, steps=1)  # pyright: ignore[reportArgumentType]
