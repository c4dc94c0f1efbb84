"""Opacity masks under lamps: the closed form, and what Mitsuba's path integrator makes of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

SAID = "Mitsuba's path integrator renders masks with nothing behind them too dark"
KEY = "sheet.bsdf.opacity.value"


def scene(opacity: float, integrator: str = "path") -> dict[str, Any]:
    """A diffuse sheet that a lamp lights, before black."""
    look = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "integrator": {"type": integrator, "max_depth": 2},
        "sensor": {"type": "perspective", "fov": 20, "to_world": look, "film": film},
        "sheet": {"type": "rectangle", "bsdf": {"type": "mask", "opacity": opacity, "bsdf": {"type": "diffuse"}}},
        "lamp": {"type": "point", "position": [1, 1, 3], "intensity": 10.0},
    }


def cut_out(value: float, byte: bool = False) -> dict[str, Any]:
    """The sheet with a texture of opacity: 0, 1 and `value`."""
    described = scene(1.0)
    values = np.array([[0.0, 1.0], [1.0, value]], np.float32)[..., None]
    bitmap = mi.Bitmap((values * 255).astype(np.uint8) if byte else values)
    opacity = {"type": "bitmap", "bitmap": bitmap, "raw": True}
    described["sheet"]["bsdf"]["opacity"] = opacity | ({"format": "auto"} if byte else {})
    return described


@pytest.mark.parametrize("byte", [False, True])
def test_textures_of_opacity_have_the_notice_too(byte: bool) -> None:
    for value, said in ((0.5, True), (1.0, False)):
        notices = MitsubaRenderer(cut_out(value, byte), 2).notices
        assert any(notice.startswith(SAID) for notice in notices) == said


def theirs(opacity: float, integrator: str = "path") -> float:
    return float(np.mean(np.array(mi.render(mi.load_dict(scene(opacity, integrator)), spp=512))))


def test_a_sheet_reflects_in_proportion_to_its_opacity() -> None:
    """As `prb` and `volpath` have it. Without this difference the notice can go."""
    renderer = MitsubaRenderer(scene(0.6), 2)
    image = np.array(renderer.prepare([], None).image({}, SampleRequest(0, 512, 1)).images)
    whole = theirs(1.0)
    assert float(image.mean()) == pytest.approx(0.6 * whole, rel=2e-3)
    assert theirs(0.6, "prb") == pytest.approx(0.6 * whole, rel=2e-3)
    assert theirs(0.6) == pytest.approx(0.36 * whole, rel=2e-3)


def test_a_mask_before_an_environment_has_no_notice_and_is_no_darker() -> None:
    """Only paths that leave the scene lose their light."""
    described = scene(0.6) | {"sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}}}
    path, prb = (
        float(np.mean(np.array(mi.render(mi.load_dict(described), integrator=mi.load_dict({"type": kind}), spp=512))))
        for kind in ("path", "prb")
    )
    assert path == pytest.approx(prb, rel=2e-3)
    assert not any(notice.startswith(SAID) for notice in MitsubaRenderer(described, 2).notices)
    described["integrator"]["hide_emitters"] = True
    assert any(notice.startswith(SAID) for notice in MitsubaRenderer(described, 2).notices)


def test_an_exported_mask_is_as_bright_in_plain_mitsuba(tmp_path: Path) -> None:
    problem = ur.Problem(scene(0.6), [ur.Parameter(KEY)], [ur.View(np.zeros((4, 4, 3)))])
    done = ur.app.export((problem, {KEY: np.array(0.6)}), tmp_path / "out")
    image = np.mean(np.array(mi.render(mi.load_file(str(done.scene)), spp=512)))
    assert float(image) == pytest.approx(0.6 * theirs(1.0), rel=2e-3)


@pytest.mark.parametrize(
    ("opacity", "integrator", "keys", "said"),
    [(0.6, "path", (), True), (1.0, "path", (KEY,), True), (1.0, "path", (), False), (0.6, "prb", (KEY,), False)],
)
def test_the_notice_comes_where_references_may_be_wrong(
    opacity: float, integrator: str, keys: tuple[str, ...], said: bool
) -> None:
    notices = MitsubaRenderer(scene(opacity, integrator), 2, keys).notices
    assert any(notice.startswith(SAID) for notice in notices) == said


@pytest.mark.parametrize("kind", ["mask", "null", "thindielectric"])
def test_segments_that_a_volumetric_integrator_does_not_count_are_told(kind: str) -> None:
    """Without a notice, a wall behind a pane was 30 % darker than in a reference by `volpath` at depth 2."""
    pane = {"type": kind} | ({"opacity": 0.2, "bsdf": {"type": "diffuse"}} if kind == "mask" else {})
    images, notices = {}, {}
    for integrator in ("prb", "volpath"):
        described = scene(1.0, integrator) | {"sky": {"type": "constant"}}
        place = mi.ScalarTransform4f().translate([0, 0, 1])
        described["pane"] = {"type": "rectangle", "to_world": place, "bsdf": pane}
        renderer = MitsubaRenderer(described)
        images[integrator] = np.array(renderer.prepare([], None).image({}, SampleRequest(0, 16384, 1)).images).mean()
        images[f"their {integrator}"] = np.array(mi.render(mi.load_dict(described), spp=16384)).mean()
        notices[integrator] = [line for line in renderer.notices if "does not count segments" in line]
        assert not [line for line in MitsubaRenderer(described, 64).notices if "does not count" in line]
    assert images["prb"] == pytest.approx(images["their prb"], rel=0.04)  # four standard errors
    assert images["volpath"] < 0.9 * images["their volpath"]
    assert not notices["prb"]
    assert len(notices["volpath"]) == 1


def test_a_mask_around_a_mask_has_no_path_gradient() -> None:
    """A path that the inner mask lets pass would count as one that the outer one lets pass."""
    described = scene(0.5)
    described["sheet"]["bsdf"]["bsdf"] = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "diffuse"}}
    known = MitsubaRenderer(described, 2).parameters()[KEY]
    assert not known.differentiable
    assert known.perturbable
    assert MitsubaRenderer(scene(0.5), 2).parameters()[KEY].shares_paths
