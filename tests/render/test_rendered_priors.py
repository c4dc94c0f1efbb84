"""Priors in rendered problems: with every method's kind of step, from Python and from a file."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from unrender.core.errors import InputError
from unrender.methods import method
from unrender.scene.prior import Prior
from unrender.scene.references import likelihood_scale

pytestmark = pytest.mark.mitsuba

PAINT, SIZE, KEY = 8, 16, "wall.bsdf.reflectance.data"


def scene(values: Any = 0.5) -> dict[str, Any]:
    """A wall with a texture, seen from the front, lit by a lamp."""
    texture = np.full((PAINT, PAINT, 3), values, np.float32)
    look = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    paint = {"type": "bitmap", "bitmap": mi.Bitmap(texture), "raw": True}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": {"type": "perspective", "fov": 35, "to_world": look, "film": film},
        "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": paint}},
        "lamp": {"type": "point", "position": [1.0, 1.0, 3.0], "intensity": 8.0},
    }


def noisy(sigma: float) -> np.ndarray:
    """The picture of a wall of one grey, with noise."""
    image = np.array(mi.render(mi.load_dict(scene(0.6)), spp=64, seed=mi.UInt32(1)))
    return np.maximum(image + np.random.default_rng(2).normal(0, sigma, image.shape), 0).astype(np.float32)


def picture_at(position: np.ndarray) -> np.ndarray:
    """The picture of a wall of one grey, its lamp at a place."""
    made = scene(0.6)
    made["lamp"]["position"] = position.tolist()
    return np.array(mi.render(mi.load_dict(made), spp=64, seed=mi.UInt32(1))).astype(np.float64)


def recovered(prior: dict[str, Any] | None, name: str = "auto", **options: Any) -> float:
    """The texture's error of a short descent."""
    unknown = ur.Parameter(KEY, initial=0.5, prior=prior)
    problem = ur.Problem(scene, [unknown], [ur.View(noisy(0.15))], truth={KEY: 0.6})
    result = ur.optimize(problem, method(name).plan(problem, options), steps=120, progress=False)
    return problem.parameter_error({KEY: result.parameters[KEY]})[KEY]


@cache
def without_prior(name: str) -> float:
    return recovered(None, name)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["auto", "plain", "rcv"])
@pytest.mark.parametrize("prior", [{"smoothness": 0.02}, {"total_variation": 0.02}, {"near": 0.6, "std": 0.01}])
def test_a_true_prior_takes_most_of_the_noise_out_of_a_texture(name: str, prior: dict[str, Any]) -> None:
    assert recovered(prior, name) < 0.6 * without_prior(name)


@pytest.mark.slow
def test_gauss_newton_steps_of_a_lamp_lead_to_the_posterior_mean() -> None:
    """(P + I / τ²)⁻¹ (P x + m / τ²), x the place without a prior, P = Jᵀ J / σ² by differences of pictures."""
    key, expected, start = "lamp.position", np.array([0.8, 1.2, 3.2]), [1.3, 0.8, 2.8]
    picture = noisy(0.1)

    def made(prior: dict[str, Any] | None) -> ur.Problem:
        return ur.Problem(lambda: scene(0.6), [ur.Parameter(key, initial=start, prior=prior)], [ur.View(picture)])

    bare = made(None)
    assert "Gauss-Newton" in method("auto").plan(bare).lines[0]
    x = ur.optimize(bare, "auto", steps=40, progress=False).parameters[key]
    jacobian = np.stack([picture_at(x + e) - picture_at(x - e) for e in 0.05 * np.eye(3)], axis=-1).reshape(-1, 3) / 0.1
    precision = jacobian.T @ jacobian / (likelihood_scale(bare) * picture.size / 2)
    std = float(np.sqrt(3 / np.trace(precision)))
    result = ur.optimize(made({"near": expected.tolist(), "std": std}), "auto", steps=40, progress=False)
    mean = np.linalg.solve(precision + np.eye(3) / std**2, precision @ x + expected / std**2)
    assert np.abs(mean - x).max() > 0.3 * std
    assert result.parameters[key] == pytest.approx(mean, abs=0.15 * std)


@pytest.mark.slow
def test_priors_take_noise_out_of_tiles() -> None:
    """0.032, 0.019 and 0.023 after 120 steps at 64² pixels."""
    errors = {}
    for prior in ("none", "total_variation", "palette"):
        made = ur.gallery.problem("noisy-tiles", prior=prior, resolution=48, texture_resolution=24)
        (errors[prior],) = made.parameter_error(ur.optimize(made, steps=80, progress=False).parameters).values()
    assert errors["total_variation"] < 0.75 * errors["none"]
    assert errors["palette"] < 0.85 * errors["none"]
    with pytest.raises(ur.InputError, match="prior must be one of total_variation, palette, none, got 'tv'"):
        ur.gallery.problem("noisy-tiles", prior="tv")


XML = """<scene version="3.0.0">
<sensor type="perspective"><transform name="to_world"><lookat origin="0,0,3" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film></sensor>
<shape type="rectangle" id="wall"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
<string name="filename" value="paint.exr"/><boolean name="raw" value="true"/></texture></bsdf></shape>
<emitter type="constant"/></scene>"""


def test_a_problem_file_has_priors(tmp_path: Path) -> None:
    mi.Bitmap(noisy(0.1)).write(str(tmp_path / "picture.exr"))
    mi.Bitmap(np.full((PAINT, PAINT, 3), 0.5, np.float32)).write(str(tmp_path / "paint.exr"))
    (tmp_path / "scene.xml").write_text(XML)
    head = ['scene = "scene.xml"', "[[parameters]]", f'key = "{KEY}"']
    tail = ["[[views]]", 'reference = "picture.exr"']
    (tmp_path / "wall.toml").write_text("\n".join([*head, "prior = { smoothness = 0.05 }", *tail]))
    problem = ur.Problem.from_file(tmp_path / "wall.toml")
    assert problem.unknowns[KEY].prior == Prior(smoothness=0.05)
    (tmp_path / "wall.toml").write_text("\n".join([*head, "prior = { smoothness = -1 }", *tail]))
    with pytest.raises(InputError, match=r"wall.toml:4: parameters\[0\].prior: .*smoothness must be"):
        ur.Problem.from_file(tmp_path / "wall.toml")
