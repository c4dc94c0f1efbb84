"""Settings of a scene are used; those that are not are told, and only those."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from unrender.core.errors import InputError

XML = """<scene version="3.0.0">
    <sensor type="perspective"><film type="hdrfilm">
        <integer name="width" value="4"/><integer name="height" value="4"/>{film}
    </film></sensor>{integrator}
    <shape type="rectangle"><bsdf type="diffuse"/></shape>
    <shape type="sphere" id="lamp"><point name="center" x="0" y="0" z="5"/><emitter type="area"/></shape>
</scene>"""
BOX = '<rfilter type="box"/>'
KEY = "lamp.emitter.radiance.value"


def problem(scene: Any, max_depth: int | None = 6) -> ur.Problem:
    return ur.Problem(scene, [ur.Parameter(KEY)], [ur.View(np.full((4, 4, 3), 0.5, np.float32))], max_depth=max_depth)


def notices(scene: Any, max_depth: int | None = 6) -> list[str]:
    return problem(scene, max_depth).notices


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
        ('<integrator type="direct"/>', "integrator (DirectIntegrator, max_depth 2) is not used"),
        ('<integrator type="depth"/>', "integrator (DepthIntegrator) is not used"),
        ('<integrator type="ptracer"/>', "integrator (ParticleTracerIntegrator, max_depth unlimited) is not used"),
        ('<integrator type="path"><integer name="max_depth" value="3"/></integrator>', "max_depth 3) is not used"),
    ],
)
def test_an_integrator_that_is_not_used_is_told(tmp_path: Path, integrator: str, words: str) -> None:
    (line,) = notices(xml(tmp_path, integrator))
    assert words in line
    assert "\n" not in line


@pytest.mark.parametrize(
    ("integrator", "depth"),
    [
        ("", 6),
        ('<integrator type="direct"/>', 2),
        ('<integrator type="direct_projective"/>', 2),
        ('<integrator type="prb_basic"/>', 6),
        ('<integrator type="prb_projective"><integer name="max_depth" value="3"/></integrator>', 3),
        ('<integrator type="volpath"><integer name="max_depth" value="9"/></integrator>', 9),
        ('<integrator type="volpathmis"><integer name="max_depth" value="9"/></integrator>', 9),
        ('<integrator type="prbvolpath"><integer name="max_depth" value="5"/></integrator>', 5),
        (
            '<integrator type="aov"><string name="aovs" value="d:depth"/>'
            '<integrator type="path"><integer name="max_depth" value="4"/></integrator></integrator>',
            4,
        ),
    ],
)
def test_the_scene_s_integrator_decides_the_depth_where_none_is_given(
    tmp_path: Path, integrator: str, depth: int
) -> None:
    made = problem(xml(tmp_path, integrator), None)
    assert made.max_depth == depth
    assert made.notices == []


def test_a_path_without_a_limit_has_a_documented_one(tmp_path: Path) -> None:
    made = problem(xml(tmp_path, '<integrator type="path"/>'), None)
    assert made.max_depth == 64
    (line,) = made.notices
    assert "no limit of depth: paths have up to 64 segments" in line


def test_reconstruction_filters_and_hidden_emitters_are_used(tmp_path: Path) -> None:
    for film in ("", '<rfilter type="gaussian"/>', '<rfilter type="lanczos"/>'):
        assert notices(xml(tmp_path, film=film)) == []
    assert ur.render(problem(xml(tmp_path)), spp=4).any()
    hidden = '<integrator type="path"><integer name="max_depth" value="6"/><boolean name="hide_emitters" value="true"/></integrator>'
    made = problem(xml(tmp_path, hidden))
    assert made.notices == []
    assert not ur.render(made, spp=4).any()


def test_a_parameter_of_the_file_hides_emitters(tmp_path: Path) -> None:
    for value in ("true", "false"):
        path = '<integrator type="path"><boolean name="hide_emitters" value="$hide"/></integrator>'
        nested = f'<integrator type="aov"><string name="aovs" value="d:depth"/>{path}</integrator>'
        hidden = f'<default name="hide" value="{value}"/>{nested}'
        assert ur.render(problem(xml(tmp_path, hidden)), spp=4).any() == (value == "false")


@pytest.mark.parametrize("kind", ["aov", "moment"])
def test_a_loaded_scene_hides_emitters_by_a_nested_integrator(kind: str) -> None:
    """Its description, in which the setting was looked for, is not known; they were rendered."""
    aov = {"type": "aov", "aovs": "d:depth", "path": {"type": "path", "max_depth": 3, "hide_emitters": True}}
    loaded = mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
            "integrator": {"type": "moment", "inner": aov} if kind == "moment" else aov,
            "wall": {"type": "rectangle"},
            "sky": {"type": "constant"},
        }
    )
    key = "wall.bsdf.reflectance.value"
    made = ur.Problem(loaded, [ur.Parameter(key)], [ur.View(np.zeros((4, 4, 3)))])
    assert made.max_depth == 3
    assert made.notices == []
    assert not ur.render(made, spp=4).any()


def test_hidden_emitters_beside_what_moves_are_refused() -> None:
    scene = {
        "type": "scene",
        "camera": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
        "integrator": {"type": "path", "hide_emitters": True},
        "wall": {"type": "rectangle"},
        "lamp": {"type": "sphere", "emitter": {"type": "area"}},
    }
    made = ur.Problem(scene, [ur.Parameter("wall.translation")], [ur.View(np.zeros((4, 4, 3)))])
    with pytest.raises(ur.InputError, match="hide_emitters is not supported with moving objects"):
        ur.estimate(made, ur.PathGradient())


def test_hidden_emitters_beside_media_are_refused() -> None:
    scene = {
        "type": "scene",
        "camera": {"type": "perspective"},
        "integrator": {"type": "volpath", "hide_emitters": True},
        "fog": {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}},
        "lamp": {"type": "sphere", "emitter": {"type": "area"}},
    }
    with pytest.raises(ur.InputError, match="hide_emitters is not supported with participating media"):
        notices(scene)


def test_an_object_without_an_id_in_a_file_is_named_as_such(tmp_path: Path) -> None:
    with pytest.raises(ur.InputError, match=r'nothing has the id wall: give the object that holds bsdf.*id="wall"'):
        ur.Problem(xml(tmp_path), [ur.Parameter("wall.bsdf.reflectance.value")], [ur.View(np.zeros((4, 4, 3)))])


def test_mitsuba_s_own_optimizer_is_refused_in_one_line(tmp_path: Path) -> None:
    import mitsuba as mi

    made = ur.Problem(xml(tmp_path), [ur.Parameter(KEY)], [ur.View(np.zeros((4, 4, 3)))])
    for given in (mi.ad.Adam(lr=0.1), mi.ad.Adam, mi.ad.SGD(lr=0.1)):
        with pytest.raises(ur.InputError, match=r"expected unrender.optimizers.\w+\(learning_rate=...\)"):
            ur.optimize(made, ur.PathGradient(), given, steps=1)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ('<bsdf type="diffuse"/>', '<bsdf type="roughconductor"><float name="alfa" value="0.3"/></bsdf>', 'float "alfa"'),
        ('<bsdf type="diffuse"/>', '<bsdf type="diffuse"><rgb name="colour" value="1 0 0"/></bsdf>', '"colour"'),
        ('<shape type="rectangle">', '<shape type="rectangle"><boolean name="flipnormals" value="true"/>', '"flipnormals"'),
        ('<film type="hdrfilm">', '<film type="hdrfilm"><integer name="hight" value="4"/>', '"hight"'),
        ("</scene>", '<integrator type="path"><integer name="maxdepth" value="3"/></integrator></scene>', '"maxdepth"'),
    ],
)  # fmt: skip
def test_a_property_that_its_plugin_does_not_know_is_refused_as_by_mitsuba(
    tmp_path: Path, old: str, new: str, named: str
) -> None:
    """The search for equal objects read all properties, and Mitsuba refuses only those that nobody has read."""
    path = xml(tmp_path)
    path.write_text(path.read_text().replace(old, new, 1))
    for load in (mi.load_file, notices):
        with pytest.raises(Exception, match=named):
            load(str(path))


def test_a_misspelt_property_of_a_dictionary_is_refused() -> None:
    with pytest.raises(InputError, match=r'unreferenced property.*"max_dept"'):
        notices(mi.cornell_box() | {"integrator": {"type": "path", "max_dept": 3}})
