"""Exports for other programs, read back by other libraries and rendered by plain Mitsuba: the picture is that of the scene."""

from __future__ import annotations

import dataclasses
import io
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import made_asset
from unrender.app.exporting import asset as assets
from unrender.app.exporting import formats, textures
from unrender.app.exporting.asset import Asset
from unrender.app.exporting.scene_folder import export
from unrender.io import images
from unrender.losses import metrics
from unrender.scene.problem import Problem

pytest.importorskip("pygltflib")
pytestmark = pytest.mark.slow
SPP = 128
FAINTEST = 3.0
"""dB that each planted fault costs at least."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Problem, dict[str, np.ndarray]]:
    problem = made_asset.write(tmp_path_factory.mktemp("made"))
    return problem, problem.initial_values()


@pytest.fixture(scope="module")
def exported(made: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    formats = ["mitsuba", "blender", "obj", "ply"]
    return export(made, tmp_path_factory.mktemp("out") / "asset", formats=formats).folder


@pytest.fixture(scope="module")
def picture(exported: Path) -> np.ndarray:
    return np.array(mi.render(_load(exported / "scene.xml"), spp=4 * SPP))


@pytest.fixture(scope="module")
def noise(exported: Path, picture: np.ndarray) -> float:
    """PSNR of the scene itself at other random numbers."""
    return metrics.psnr(np.array(mi.render(_load(exported / "scene.xml"), spp=SPP, seed=mi.UInt32(7))), picture)


def _load(path: Path) -> Any:
    return mi.load_file(str(path))


def _rendered(glb: bytes, exported: Path) -> np.ndarray:
    """The picture of a .glb file under the exported light, for the scene's camera: what glTF says, in Mitsuba's plugins."""
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.load(io.BytesIO(glb), file_type="glb", process=False)
    (mesh,) = scene.geometry.values()
    look = mesh.visual.material
    light = _load(exported / "scene.xml").environment()
    found: dict[str, Any] = {
        "type": "scene",
        "light": {
            "type": "envmap",
            "filename": str(exported / "environment.exr"),
            "to_world": mi.ScalarTransform4f(np.array(mi.traverse(light)["to_world"].matrix).reshape(4, 4)),  # pyright: ignore
        },
        "integrator": {"type": "path", "max_depth": 3},
    }
    corners = mesh.visual.uv[mesh.faces]  # of trimesh: v upwards
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    mirrored = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0] < 0
    for name, chosen in (("plain", ~mirrored), ("mirrored", mirrored)):
        found[name] = _mesh(name, mesh, mesh.faces[chosen], _principled(look, chosen is mirrored))
    return np.array(mi.render(mi.load_dict(found), sensor=_load(exported / "scene.xml").sensors()[0], spp=SPP))


def _mesh(name: str, mesh: Any, faces: np.ndarray, bsdf: dict[str, Any]) -> Any:
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    found: Any = mi.Mesh(name, len(mesh.vertices), len(faces), props, True, True)
    values: Any = mi.traverse(found)
    upright = mesh.visual.uv * [1, -1] + [0, 1]
    for key, given in (("positions", mesh.vertices), ("normals", mesh.vertex_normals), ("texcoords", upright)):
        values[f"vertex_{key}"] = mi.Float(np.array(given, np.float32).ravel())
    values["faces"] = mi.UInt32(np.array(faces, np.uint32).ravel())
    values.update()
    return found


def _principled(look: Any, mirrored: bool) -> dict[str, Any]:
    """Mitsuba's second tangent is n × ∂p/∂u, glTF's goes up the picture: they are opposite where a picture lies mirrored."""

    def bitmap(pixels: np.ndarray) -> dict[str, Any]:
        data = mi.TensorXf(np.ascontiguousarray(pixels, np.float32))
        return {"type": "bitmap", "data": data, "raw": True, "wrap_mode": "clamp"}

    base, packed, normal = (
        np.asarray(x, float) / 255 for x in (look.baseColorTexture, look.metallicRoughnessTexture, look.normalTexture)
    )
    linear = np.where(base <= 0.04045, base / 12.92, ((base + 0.055) / 1.055) ** 2.4)
    if mirrored:
        normal[..., 1] = 1 - normal[..., 1]
    principled = {
        "type": "principled",
        "base_color": bitmap(linear),
        "roughness": bitmap(packed[..., 1:2] * look.roughnessFactor),
        "metallic": bitmap(packed[..., 2:3] * look.metallicFactor),
    }
    wrapped = {"type": "normalmap", "normalmap": bitmap(normal), "bsdf": principled}
    return {"type": "twosided", "bsdf": wrapped}


def test_a_glb_read_back_shows_the_scenes_picture(exported: Path, picture: np.ndarray, noise: float) -> None:
    """Within 1 dB of what noise alone leaves."""
    found = metrics.psnr(_rendered((exported / "asset.glb").read_bytes(), exported), picture)
    print("PSNR", found, "noise", noise)
    assert found > noise - 1


def _altered(asset: Asset, **changes: Callable[[Any], Any]) -> bytes:
    """The .glb of an asset, with changes of its part."""
    (part,) = asset.parts
    changed = dataclasses.replace(part, **{name: change(getattr(part, name)) for name, change in changes.items()})
    return formats.glb(dataclasses.replace(asset, parts=(changed,)))


FAULTS = {
    "v upside down": {"uv": lambda uv: uv * [1, -1] + [0, 1]},
    "u and v exchanged": {"uv": lambda uv: uv[:, ::-1]},
    "left-handed": {"vertices": lambda x: x * [1, 1, -1], "normals": lambda n: n * [1, 1, -1]},
    "z up": {"vertices": lambda x: x @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]).T},
    "roughness squared": {"material": lambda m: dataclasses.replace(m, roughness=m.roughness**2)},
    "green of normals": {
        "material": lambda m: dataclasses.replace(m, normal_map=m.normal_map * [1, -1, 1] + [0, 1, 0])
    },
    "base colour not linear": {"material": lambda m: dataclasses.replace(m, base_colour=m.base_colour**2.2)},
    "roughness and metallic exchanged": {
        "material": lambda m: dataclasses.replace(m, roughness=m.metallic, metallic=m.roughness)
    },
}


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_are_seen(fault: str, exported: Path, picture: np.ndarray, noise: float) -> None:
    asset = assets.read(exported / "scene.xml")
    found = metrics.psnr(_rendered(_altered(asset, **FAULTS[fault]), exported), picture)
    print("PSNR", fault, found)
    assert found < noise - FAINTEST


def test_normals_of_mirrored_charts_are_turned(
    exported: Path, picture: np.ndarray, noise: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(textures, "mirrored_texels", lambda part, height, width: np.zeros((height, width), bool))
    found = metrics.psnr(_rendered(formats.glb(assets.read(exported / "scene.xml")), exported), picture)
    print("PSNR charts", found)
    assert found < noise - FAINTEST


def test_blender_shows_the_scenes_picture(exported: Path, picture: np.ndarray, tmp_path: Path) -> None:
    """But for diffuse lobes and for light that metal reflects more than once. Needs Blender."""
    program = shutil.which("blender")
    if program is None:
        pytest.skip("no blender on this machine")
    words = [program, "--background", "--python", str(exported / "open_in_blender.py"), "--", str(tmp_path / "out.exr")]
    subprocess.run(words, check=True, capture_output=True)
    found = images.read(tmp_path / "out.exr").values
    print("PSNR Blender", metrics.psnr(found, picture))
    assert metrics.psnr(found, picture) > 25
