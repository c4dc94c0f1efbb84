"""A problem with an unknown spectrum in a spectral variant: run, resume, export, and what an RGB variant says of it."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("spectral_variant")]

SPECTRUM, COLOUR = "ball.bsdf.reflectance.values", "wall.bsdf.reflectance.value"
SCENE = """<scene version="3.0.0">
<sensor type="perspective"><float name="fov" value="50"/><transform name="to_world">
<lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform><film type="hdrfilm"><integer name="width" value="12"/>
<integer name="height" value="12"/><rfilter type="box"/></film></sensor>
<shape type="rectangle" id="wall"><transform name="to_world"><scale value="2"/></transform>
<bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.2, 0.1"/></bsdf></shape>
<shape type="sphere" id="ball"><float name="radius" value="0.6"/><bsdf type="diffuse">
<spectrum type="regular" name="reflectance"><float name="wavelength_min" value="400"/><float name="wavelength_max" value="700"/>
<string name="values" value="0.1, 0.4, 0.7"/></spectrum></bsdf></shape>
<emitter type="constant"><rgb name="radiance" value="1, 1, 1"/></emitter></scene>"""
PROBLEM = f"""scene = "scene.xml"
max_depth = 3
[[parameters]]
key = "{SPECTRUM}"
initial = 0.5
[[parameters]]
key = "{COLOUR}"
initial = 0.5
[[views]]
reference = "reference.exr"
"""


@pytest.fixture
def problem(tmp_path: Path) -> Path:
    (tmp_path / "scene.xml").write_text(SCENE)
    path = mi.load_dict({"type": "path", "max_depth": 3})
    picture = mi.render(mi.load_file(str(tmp_path / "scene.xml")), integrator=path, spp=1024)  # pyright: ignore[reportArgumentType]
    mi.Bitmap(picture).write(str(tmp_path / "reference.exr"))
    (tmp_path / "problem.toml").write_text(PROBLEM)
    return tmp_path


def test_run_resume_and_export(unrender, problem: Path, spectral_variant: str) -> None:
    words = ("run", "problem.toml", "--variant", spectral_variant, "--steps", 40, "--final-spp", 4, "--out", "result")
    assert unrender(*words).status == 0
    answer = unrender("resume", "result", "--steps", 80)
    assert answer.status == 0, answer.error
    with np.load(problem / "result" / "parameters.npz") as found:
        values = {key: found[key] for key in (SPECTRUM, COLOUR)}
    np.testing.assert_allclose(values[COLOUR], [0.7, 0.2, 0.1], atol=0.02)
    np.testing.assert_allclose(values[SPECTRUM][:2], [0.1, 0.4], atol=0.1)  # the film hardly sees 700 nm
    answer = unrender("export", "result", "--out", "home", "--variant", spectral_variant)
    assert answer.status == 0, answer.error
    written = mi.traverse(mi.load_file(str(problem / "home" / "scene.xml")))
    np.testing.assert_allclose(np.array(written[SPECTRUM]), values[SPECTRUM], rtol=1e-5)
    coefficients = mi.srgb_model_fetch(mi.ScalarColor3f(*map(float, values[COLOUR])))  # pyright: ignore[reportAttributeAccessIssue]
    np.testing.assert_allclose(np.array(written[COLOUR]).ravel(), np.array(coefficients), rtol=1e-3)


def test_workers_render_the_colours_of_this_process(problem: Path, spectral_variant: str, mitsuba_variant: str) -> None:
    """Those of another kind would give gradients of other pictures."""
    pytest.importorskip("ray")
    with (problem / "problem.toml").open("a") as file:
        file.write('[[views]]\nreference = "reference.exr"\nweight = 2.0\n')
    made = ur.Problem.from_file(problem / "problem.toml")
    line = f"workers: {mitsuba_variant} renders other colours than {spectral_variant} of this process; use {spectral_variant}$"
    with pytest.raises(ur.InputError, match=line), ur.app.distribute(made, workers=2, variant=mitsuba_variant):
        pass
    alone = ur.optimize(made, "plain", steps=8, progress=False).parameters
    with ur.app.distribute(made, workers=2) as distributed:
        assert distributed.executor.variant == spectral_variant
        together = ur.optimize(distributed, "plain", steps=8, progress=False).parameters
    for key, value in alone.items():
        assert np.abs(value - 0.5).max() > 0.01
        np.testing.assert_allclose(together[key], value, rtol=1e-5)


def test_the_rgb_variant_names_the_spectral_one(
    unrender, problem: Path, mitsuba_variant: str, spectral_variant: str
) -> None:
    try:
        answer = unrender("run", "problem.toml", "--variant", mitsuba_variant, "--steps", 1)
    finally:
        unrender("run", "missing.toml", "--variant", spectral_variant)  # selects the variant of this module again
    assert answer.status == 2
    assert f"use the variant {spectral_variant}, or give an rgb colour in its place" in answer.error
