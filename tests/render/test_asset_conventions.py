"""What other programs make of an export, by their own rules: closed forms on a made part, light and camera."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from unrender.app.exporting import formats, textures
from unrender.app.exporting.asset import Asset, Camera, Part
from unrender.app.exporting.materials import Material
from unrender.display.pictures import png

COLOURS = np.array([[[0.9, 0.1, 0.2], [0.1, 0.8, 0.3]], [[0.2, 0.3, 0.7], [0.6, 0.6, 0.1]]], np.float32)
ROUGHNESS = np.array([[0.2, 0.4], [0.6, 0.8]], np.float32)


def quad(mirrored: bool = False) -> Part:
    """A square that looks along +z; its texture's first row is at the top."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    uv = uv * [-1, 1] + [1, 0] if mirrored else uv
    normals = np.tile(np.array([[0, 0, 1]], np.float32), (4, 1))
    bumps = np.full((4, 4, 3), [0.6, 0.7, 0.9], np.float32)
    material = Material(COLOURS, ROUGHNESS, np.array(0.3), bumps, 1.5, False)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    return Part("quad", corners, faces, normals, uv.astype(np.float32), material)


def asset(*parts: Part, **changes: Any) -> Asset:
    return replace(Asset(parts, None, np.eye(3), (), ()), **changes)


def srgb(x: np.ndarray) -> np.ndarray:
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def test_gltf_as_trimesh_reads_it() -> None:
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("pygltflib")
    given = quad()
    found = trimesh.load(
        io.BytesIO(formats.glb(asset(given, replace(given, name="other")))), file_type="glb", process=False
    )
    assert list(found.geometry) == ["quad", "other"]
    mesh = found.geometry["quad"]
    np.testing.assert_allclose(mesh.face_normals, [[0, 0, 1]] * 2)
    np.testing.assert_array_equal(mesh.vertices, given.vertices)
    np.testing.assert_allclose(mesh.visual.uv[3], [0, 1])  # upper left; trimesh turns v upwards
    look = mesh.visual.material
    np.testing.assert_array_equal(np.asarray(look.baseColorTexture), np.round(255 * srgb(COLOURS)))
    packed = np.asarray(look.metallicRoughnessTexture) * [1, look.roughnessFactor, look.metallicFactor]
    np.testing.assert_allclose(packed[..., 1] / 255, ROUGHNESS, atol=0.003)  # perceptual: not squared
    np.testing.assert_allclose(packed[..., 2] / 255, 0.3, atol=0.003)


def test_obj_and_ply_as_mitsuba_reads_them(tmp_path: Path) -> None:
    """Its OBJ loader takes v upwards; its PLY loader does when it is told to."""
    given = quad()
    formats.write_obj(asset(given, replace(given, name="other", normals=None)), tmp_path)
    formats.write_ply(asset(given), tmp_path)
    for found in (
        mi.load_dict({"type": "obj", "filename": str(tmp_path / "asset.obj")}),
        mi.load_dict({"type": "ply", "filename": str(tmp_path / "quad.ply"), "flip_tex_coords": True}),
    ):
        values: Any = mi.traverse(found)
        corners = np.array(values["vertex_positions"]).reshape(-1, 3)[np.array(values["faces"]).reshape(-1, 3)[:2]]
        uv = np.array(values["vertex_texcoords"]).reshape(-1, 2)[np.array(values["faces"]).reshape(-1, 3)[:2]]
        np.testing.assert_allclose(corners, given.vertices[given.faces])
        assert given.uv is not None
        np.testing.assert_allclose(uv, given.uv[given.faces])
    text = (tmp_path / "asset.mtl").read_text()
    assert "map_Kd quad-base-colour.png" in text
    assert "Pm 0.3" in text
    assert all(
        (tmp_path / line.split()[1]).is_file() for line in text.splitlines() if line.startswith(("map_", "norm"))
    )


@pytest.mark.parametrize(("mirrored", "green"), [(False, 0.7), (True, 0.3)])
def test_green_of_normals_goes_up_the_picture(mirrored: bool, green: float) -> None:
    """Mitsuba's second tangent is n × ∂p/∂u. A picture that is seen from behind has that one down."""
    found = textures.normal_map(quad(mirrored))
    assert found is not None
    np.testing.assert_allclose(found / 255, np.full((4, 4, 3), [0.6, green, 0.9]), atol=0.003)


def test_charts_of_both_kinds_are_told_apart() -> None:
    left, right = quad(), quad(mirrored=True)
    assert left.uv is not None
    assert right.uv is not None
    uv = np.concatenate([left.uv * [0.5, 1], right.uv * [0.5, 1] + [0.5, 0]])
    both = replace(left, uv=uv, faces=np.concatenate([left.faces, right.faces + 4]))
    expected = np.repeat([[False] * 8 + [True] * 8], 16, 0)
    assert np.mean(textures.mirrored_texels(both, 16, 16) == expected) > 0.9  # but for the border itself


def test_blender_looks_the_light_up_where_mitsuba_does() -> None:
    """Both programs' formulas of the picture's coordinates, for a light that is turned."""
    turned = np.array(mi.ScalarTransform4f().rotate([0.48, 0.8, 0.36], 70).matrix, float)[:3, :3]
    found = formats.blender_settings(asset(quad(), environment=np.ones((2, 4, 3)), environment_to_world=turned))
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    x, y, z = np.linalg.inv(turned) @ directions.T
    mitsuba = np.stack([np.arctan2(x, -z) / (2 * np.pi) % 1, np.arccos(np.clip(y, -1, 1)) / np.pi])
    a, b, c = np.array(found["environment_rotation"]) @ np.array([directions.T[0], -directions.T[2], directions.T[1]])
    theirs = np.stack([(0.5 - np.arctan2(b, a) / (2 * np.pi)) % 1, 0.5 - np.arctan2(c, np.hypot(a, b)) / np.pi])
    np.testing.assert_allclose(theirs, mitsuba, atol=1e-6)


def test_blenders_cameras_see_what_mitsubas_do() -> None:
    pose = mi.ScalarTransform4f().look_at([1, 2, 3], [0.2, -0.1, 0.3], [0.1, 1, 0])
    size, offset = (40, 30), (0.06, -0.09)
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": "box"}}
    sensor = mi.load_dict({"type": "perspective", "fov": 38, "fov_axis": "x", "to_world": pose, "film": film,
                           "principal_point_offset_x": offset[0], "principal_point_offset_y": offset[1]})  # fmt: skip
    camera = Camera("c", np.array(pose.matrix, float), 38.0, offset, size, (0.1, 10.0))
    (found,) = formats.blender_settings(asset(quad(), cameras=(camera,)))["cameras"]
    places = np.random.default_rng(1).uniform(size=(20, 2))
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(*places.T.astype(np.float32)), mi.Point2f(0.5))
    # Blender: a sensor as wide as 1, shifted in widths; right, up, backwards.
    wide = 2 * np.tan(found["angle_x"] / 2)
    right = (places[:, 0] - 0.5 + found["shift"][0]) * wide
    up = ((0.5 - places[:, 1]) * size[1] / size[0] + found["shift"][1]) * wide
    local = np.stack([right, up, -np.ones(20)])
    world = np.array(found["matrix"])[:3, :3] @ local
    theirs = world / np.linalg.norm(world, axis=0)
    x, y, z = np.array(ray.d)
    np.testing.assert_allclose(theirs, [x, -z, y], atol=2e-5)


def test_diffuse_materials_do_not_shine() -> None:
    pytest.importorskip("pygltflib")
    part = quad()
    dull = replace(part, material=replace(part.material, ior=1.0))
    assert b'"KHR_materials_specular": {"specularFactor": 0.0}' in formats.glb(asset(dull)).replace(
        b'":', b'": '
    ).replace(b":  ", b": ")


def test_maps_of_different_sizes_are_packed() -> None:
    part = quad()
    part = replace(part, material=replace(part.material, metallic=np.full((8, 4), 0.25, np.float32)))
    found = textures.metallic_roughness(part)
    assert found.shape == (8, 4, 3)
    assert Image.open(io.BytesIO(png(found))).size == (4, 8)
    np.testing.assert_array_equal(found[..., 2], 64)
    np.testing.assert_array_equal(found[[0, 0, 7, 7], [0, 3, 0, 3], 1], np.round(255 * ROUGHNESS).ravel())
