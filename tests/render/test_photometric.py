"""A folder with known lights as a problem: what it renders of the true normals and colours are the photographs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2", reason="photographs need OpenCV: pip install 'unrender[capture]'")

from PIL import Image

import unrender as ur
from unrender.losses.metrics import srgb

WIDTH, HEIGHT = 20, 12
DIRECTIONS = np.array([[0, 0, 1], [0.5, 0, 1], [-0.5, 0.2, 1], [0, 0.6, 1], [0.3, -0.5, 1], [-0.2, -0.4, 1.0]])
COLOUR, NORMAL = "plate.bsdf.nested_bsdf.reflectance.data", "plate.bsdf.normalmap.data"


@pytest.mark.slow
@pytest.mark.parametrize("linear", [True, False])
def test_true_normals_and_colours_render_the_photographs(linear: bool, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    normals = np.concatenate([rng.uniform(-0.2, 0.2, (HEIGHT, WIDTH, 2)), np.ones((HEIGHT, WIDTH, 1))], 2)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    colours = rng.uniform(0.2, 0.8, (HEIGHT, WIDTH, 3))
    towards = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
    values = np.einsum("kd,ijd->kij", towards, normals)[..., None] * colours
    folder = tmp_path / "capture"
    folder.mkdir()
    rows = [" ".join(map(str, row)) for row in DIRECTIONS]
    (folder / "lights.txt").write_text("\n".join([str(len(rows)), *rows]))
    for index, one in enumerate(values):
        shown = one if linear else srgb(one)
        exif = Image.Exif()
        exif[0x010F] = "maker"  # Pillow takes EXIF without it for empty
        exif.get_ifd(0x8769).update({0x829A: 0.02, 0x829D: 4.0, 0x8827: 100 if index else 250})
        Image.fromarray((255 * shown + 0.5).astype(np.uint8)).save(folder / f"{index}.png", exif=exif)

    found = ur.app.import_capture(folder, tmp_path / "plate", ur.app.ImportOptions(hold_out=0))
    assert (found.kind, found.views, found.held_out, found.size) == ("lights", 6, 0, (WIDTH, HEIGHT))
    assert any("linear" in notice for notice in found.notices) == linear
    assert any("exposures differ by a factor of 2.5 by EXIF" in notice for notice in found.notices)
    with pytest.raises(ur.InputError, match="overwrite=True"):
        ur.app.import_capture(folder, tmp_path / "plate")
    problem = ur.Problem.from_file(tmp_path / "plate" / "problem.toml")
    # Only the product of colour and light is known: a brightness is the first picture's.
    shapes = {key: value.shape for key, value in problem.initial_values().items()}
    assert shapes == {COLOUR: (HEIGHT, WIDTH, 3), NORMAL: (HEIGHT, WIDTH, 3)}
    given = {COLOUR: (colours / 2).astype(np.float32), NORMAL: ((normals + 1) / 2).astype(np.float32)}
    pictures = [np.asarray(ur.render(problem, given, view=view, spp=4)) for view in range(len(values))]
    factor = (values[0] * pictures[0]).sum() / (pictures[0] ** 2).sum()
    for picture, one, view in zip(pictures, values, problem.views, strict=True):
        np.testing.assert_allclose(factor * picture, one, atol=2e-3)
        np.testing.assert_allclose(np.asarray(view.reference), one, atol=6e-3)  # 8 bits
    assert np.abs(factor * pictures[1] - values[2]).max() > 0.05
