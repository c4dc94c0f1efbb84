"""Which scenes become assets, what is left out, and what is refused in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from unrender.app.exporting import asset as assets
from unrender.app.exporting import materials

_FILM = '<film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/></film>'
_SENSOR = f'<sensor type="perspective" id="camera">{_FILM}</sensor>'
_MAP = '<texture type="bitmap" name="{name}"><string name="filename" value="map.exr"/>{more}</texture>'
_SCALE = '<transform name="to_uv"><scale value="2"/></transform>'


def read(folder: Path, text: str) -> assets.Asset:
    """The asset of a scene, with map.exr of 8 x 4 texels."""
    mi.Bitmap(np.linspace(0, 1, 96, dtype=np.float32).reshape(4, 8, 3)).write(str(folder / "map.exr"))
    (folder / "scene.xml").write_text(f'<scene version="3.0.0">{_SENSOR}{text}</scene>')
    return assets.read(folder / "scene.xml")


def textured(name: str, more: str = "") -> str:
    return _MAP.format(name=name, more=more)


def shape(bsdf: str, kind: str = "cube", name: str = "body") -> str:
    return f'<shape type="{kind}" id="{name}">{bsdf}</shape>'


def test_several_shapes_under_an_even_sky(tmp_path: Path) -> None:
    numbers = '<float name="roughness" value="0.3"/><float name="clearcoat" value="0.5"/>'
    one = f'<bsdf type="principled">{textured("base_color")}{numbers}</bsdf>'
    two = '<bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.1 0.2 0.3"/></bsdf></bsdf>'
    light = '<emitter type="constant"><rgb name="radiance" value="1 2 3"/></emitter><emitter type="point" id="lamp"/>'
    other = shape('<bsdf type="conductor"/>', name="mirror") + shape(two, "sphere", "ball")
    found = read(tmp_path, light + shape(one, name="a b") + shape(two, "rectangle", "a-b") + other)
    assert [part.name for part in found.parts] == ["a-b", "a-b-1", "mirror"]
    first, second, mirror = (part.material for part in found.parts)
    assert first.base_colour.shape == (4, 8, 3)
    assert (float(first.roughness), float(first.metallic), round(first.ior, 6), first.two_sided) == (
        pytest.approx(0.3),
        0,
        1.5,
        False,
    )
    np.testing.assert_allclose(second.base_colour, [0.1, 0.2, 0.3], rtol=1e-6)
    assert (second.ior, second.two_sided) == (1, True)
    np.testing.assert_array_equal(mirror.base_colour, 0.5)
    assert found.environment is not None
    np.testing.assert_array_equal(found.environment[0, 0], [1, 2, 3])
    assert [camera.name for camera in found.cameras] == ["camera"]
    told = "\n".join(found.notices)
    for words in (
        "clearcoat: not carried over",
        "a SmoothConductor is not carried over",
        "ball: a Sphere is not a mesh",
        "lamp: a PointLight",
    ):
        assert words in told
    assert len(found.notices) == 4


@pytest.mark.parametrize(("kind", "roughness"), [("plastic", 0.0), ("roughplastic", 0.5)])
def test_a_plastic_keeps_its_texture(kind: str, roughness: float, tmp_path: Path) -> None:
    """Mitsuba's α is the square of the roughness."""
    alpha = '<float name="alpha" value="0.25"/>' if roughness else ""
    bsdf = f'<bsdf type="{kind}">{textured("diffuse_reflectance")}<float name="int_ior" value="1.6"/>{alpha}</bsdf>'
    found = read(tmp_path, shape(bsdf))
    (part,) = found.parts
    np.testing.assert_allclose(part.material.base_colour.ravel(), np.linspace(0, 1, 96), atol=1e-6)
    assert float(part.material.roughness) == pytest.approx(roughness)
    assert (float(part.material.metallic), part.material.ior) == (0.0, pytest.approx(1.6 / 1.000277, rel=1e-4))
    assert any("becomes a dielectric with its diffuse reflectance as base colour" in line for line in found.notices)


def test_a_normal_map_is_found_in_and_under_other_materials(tmp_path: Path) -> None:
    """Whichever wraps the other."""
    for inner in ("diffuse", "principled"):
        colour = "reflectance" if inner == "diffuse" else "base_color"
        bsdf = f'<bsdf type="{inner}">{textured(colour)}</bsdf>'
        mapped = f'<bsdf type="normalmap">{textured("normalmap", _RAW)}{bsdf}</bsdf>'
        for text in (mapped, f'<bsdf type="twosided">{mapped}</bsdf>'):
            (part,) = read(tmp_path, shape(text)).parts
            assert part.material.normal_map is not None
            assert part.material.base_colour.shape == (4, 8, 3)
            assert part.material.ior == pytest.approx(1.0 if inner == "diffuse" else 1.5)


_RAW = '<boolean name="raw" value="true"/>'


@pytest.mark.parametrize("flipped", ["false", "true"])
@pytest.mark.parametrize("mirror", [1, -1])
@pytest.mark.parametrize("kind", ["rectangle", "cube", "cube-flat"])
def test_faces_and_normals_are_on_the_side_that_mitsuba_shades(
    kind: str, mirror: int, flipped: str, tmp_path: Path
) -> None:
    """Other programs leave out the back of faces."""
    place = f'<transform name="to_world"><scale x="{mirror}" y="1.3"/><rotate x="0.3" y="1" angle="33"/></transform>'
    more = (
        f'<boolean name="flip_normals" value="{flipped}"/><boolean name="face_normals" value="{kind == "cube-flat"}"/>'
    )
    text = shape(f"{place}{more.replace('True', 'true').replace('False', 'false')}", kind.split("-")[0])
    (part,) = read(tmp_path, text).parts
    corners = part.vertices[part.faces].astype(float)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    ray: Any = mi.Ray3f(mi.Point3f((corners.mean(1) + 0.01 * across).T), mi.Vector3f(-across.T))
    scene: Any = mi.load_file(str(tmp_path / "scene.xml"))
    shaded = np.array(scene.ray_intersect(ray).sh_frame.n).T
    np.testing.assert_allclose(np.sum(shaded * across, axis=1), 1, atol=1e-5)
    if part.normals is not None:
        np.testing.assert_allclose(part.normals[part.faces].mean(1), across, atol=1e-2)


def test_faces_turn_the_way_that_normals_point(tmp_path: Path) -> None:
    """A mirrored to_world turns the winding; a texture's transformation goes into the coordinates."""
    mirrored = '<transform name="to_world"><scale x="-1" y="2" z="1"/></transform>'
    bsdf = f'<bsdf type="diffuse">{textured("reflectance", _SCALE)}</bsdf>'
    for text in (bsdf, mirrored + bsdf):
        (part,) = read(tmp_path, shape(text)).parts
        corners = part.vertices[part.faces].astype(float)
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.all(np.sum(across * corners.mean(1), 1) > 0)
        assert part.uv is not None
        assert part.uv.max() == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (shape("", "sphere"), "no mesh that could be exported; body: a Sphere is not a mesh"),
        ('<emitter type="constant"/>', "no mesh that could be exported"),
        (
            shape(
                f'<string name="filename" value="bare.ply"/><bsdf type="diffuse">{textured("reflectance")}</bsdf>',
                "ply",
            ),
            "body has maps but no texture coordinates",
        ),
        (
            shape(f'<bsdf type="principled">{textured("base_color", _SCALE)}{textured("roughness")}</bsdf>'),
            "maps of one material have different to_uv",
        ),
    ],
)
def test_what_cannot_be_an_asset_is_one_line(text: str, message: str, tmp_path: Path) -> None:
    vertices = b"0 0 0\n1 0 0\n0 1 0\n"
    head = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "bare.ply").write_bytes(
        head + b"element face 1\nproperty list uchar int vertex_index\nend_header\n" + vertices + b"3 0 1 2\n"
    )
    with pytest.raises(ur.InputError, match=message) as refusal:
        read(tmp_path, text)
    assert "\n" not in str(refusal.value)


def test_maps_that_are_too_large_are_refused_and_nothing_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read(tmp_path, '<emitter type="constant"/>' + shape(f'<bsdf type="diffuse">{textured("reflectance")}</bsdf>'))
    views = [ur.View(np.zeros((4, 4, 3), np.float32))]
    problem: Any = ur.Problem(tmp_path / "scene.xml", [ur.Parameter("body.bsdf.reflectance.data")], views)
    monkeypatch.setattr(materials, "MOST_TEXELS", 7)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(ur.InputError, match="reflectance has 8 x 4 texels, expected at most 7 along a side"):
        ur.app.export((problem, problem.initial_values()), tmp_path / "out", formats=["obj"])
    assert sorted(tmp_path.iterdir()) == before
