"""Scenes that the project did not make, where they are at hand."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur

ESTIMATOR = ur.PathGradient(ur.images.RecursiveControlVariate(), spp=4)


@pytest.mark.slow
def test_the_tutorials_cornell_box(assets: Path, tmp_path: Path) -> None:
    """A mirror, glass, an emitter on a mesh, BSDFs that nothing uses: the colour of the walls comes back."""
    text = (assets / "tutorials/cbox.xml").read_text().replace('"meshes/', f'"{assets / "tutorials/meshes"}/')
    (tmp_path / "scene.xml").write_text(text.replace('name="res" value="256"', 'name="res" value="24"'))
    scene = mi.load_file(str(tmp_path / "scene.xml"))
    image = np.array(mi.render(scene, spp=512, integrator=mi.load_dict({"type": "path", "max_depth": 4})))
    keys = {
        "red.reflectance.value": (0.570068, 0.0430135, 0.0443706),
        "green.reflectance.value": (0.105421, 0.37798, 0.076425),
    }
    problem = ur.Problem(
        tmp_path / "scene.xml",
        [ur.Parameter(key, initial=0.5) for key in keys],
        [ur.View(image)],
        loss=ur.losses.L1(),
        max_depth=4,
        truth=keys,
    )
    found = ur.optimize(problem, ESTIMATOR, ur.optimizers.Adam(learning_rate=0.03), steps=60)
    start = problem.parameter_error(problem.initial())
    end = problem.parameter_error(found.parameters)
    assert all(end[key] < 0.35 * start[key] for key in keys), (start, end)
    assert not found.warnings


@pytest.mark.slow
def test_spot_under_the_museum(assets: Path) -> None:
    """A textured mesh from an OBJ file under a measured environment map: its mean colour comes near."""
    to = mi.ScalarTransform4f
    texture = mi.Bitmap(str(assets / "spot/spot_texture.png")).convert(
        mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False
    )
    texture = texture.resample(mi.ScalarVector2u(32, 32))

    def scene() -> dict[str, object]:
        return {
            "type": "scene",
            "camera": {
                "type": "perspective",
                "fov": 40,
                "to_world": to().look_at([1.5, 0.7, 2.6], [0, 0.1, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}},
            },
            "sky": {"type": "envmap", "filename": str(assets / "textures/museum.exr")},
            "spot": {
                "type": "obj",
                "filename": str(assets / "spot/spot.obj"),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": texture, "raw": True}},
            },
        }

    loaded = mi.load_dict(scene())
    image = np.array(mi.render(loaded, spp=512, integrator=mi.load_dict({"type": "path", "max_depth": 4})))
    key = "spot.bsdf.reflectance.data"
    problem = ur.Problem(scene, [ur.Parameter(key, initial=0.9)], [ur.View(image)], max_depth=4)
    found = ur.optimize(problem, ESTIMATOR, ur.optimizers.Adam(learning_rate=0.03), steps=120)
    before, after = (
        float(np.sqrt(np.mean((ur.render(problem, values, spp=256) - image) ** 2)))
        for values in (found.initial, found.parameters)
    )
    assert after < 0.65 * before
