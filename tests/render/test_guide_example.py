"""The scene of the guide's example."""

from __future__ import annotations

import re
from pathlib import Path

import mitsuba as mi
import numpy as np

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "guide" / "texture.md"


def test_the_photograph_hangs_upright(tmp_path: Path) -> None:
    found = re.search(r"```xml\n(.*?)```", EXAMPLE.read_text(), re.DOTALL)
    assert found is not None
    (tmp_path / "room.xml").write_text(found[1])
    mi.Bitmap(np.full((32, 32, 3), 128, np.uint8)).write(str(tmp_path / "grey.png"))
    scene = mi.load_file(str(tmp_path / "room.xml"))
    parameters = mi.traverse(scene)
    picture = np.zeros((32, 32, 3), np.float32)
    picture[:16] = (0.9, 0.1, 0.1)  # the upper half of a picture, as everyone stores it
    picture[:, :16, 2] = 0.9
    parameters["wall.bsdf.reflectance.data"] = mi.TensorXf(picture)
    parameters.update()
    photo = np.asarray(mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 2}), spp=8))
    assert photo[16:30, 16:48, 0].mean() > 5 * photo[34:48, 16:48, 0].mean()
    assert photo[16:48, 16:30, 2].mean() > 2 * photo[16:48, 34:48, 2].mean()  # nor is it mirrored
