"""Textures eliminated from the steps of a lamp, in Mitsuba's scenes: the response against least squares of Mitsuba's pictures."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from unrender.core.random import Key
from unrender.rendering.partial import EliminatedParameters

pytestmark = pytest.mark.mitsuba

SIDE, TEXELS, STEPS = 8, 3, 20
WALL, LAMP = "wall.bsdf.reflectance.data", "lamp.position"
PLACE = np.array([0.3, 0.2, 1.2])
PAINT = np.random.default_rng(0).uniform(0.3, 0.8, (TEXELS, TEXELS, 3)).astype(np.float32)


def scene(place: np.ndarray = PLACE, paint: np.ndarray = PAINT) -> dict[str, Any]:
    """A wall with a texture under a point lamp."""
    look = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}}
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(np.asarray(paint, np.float32)), "raw": True}
    return {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 35, "to_world": look, "film": film},
        "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}},
        "lamp": {"type": "point", "position": place.tolist(), "intensity": {"type": "rgb", "value": 4.0}},
    }


def picture(place: np.ndarray = PLACE, paint: np.ndarray = PAINT) -> np.ndarray:
    path = mi.load_dict({"type": "path", "max_depth": 2})
    return np.array(mi.render(mi.load_dict(scene(place, paint)), integrator=path, spp=1024), np.float64).ravel()


def response_by_differences() -> np.ndarray:
    """Return the change of the texture per unit of the lamp's position that explains most of the picture's change, (3, texels)."""
    base = picture()
    units = np.eye(PAINT.size).reshape(-1, *PAINT.shape)
    texture = np.stack([(picture(paint=PAINT + 0.1 * unit) - base) / 0.1 for unit in units], axis=1)
    lamp = np.stack([(picture(PLACE + 0.02 * x) - picture(PLACE - 0.02 * x)) / 0.04 for x in np.eye(3)], axis=1)
    return -np.linalg.lstsq(texture, lamp, rcond=None)[0].T


def response_of_estimator() -> np.ndarray:
    unknown = [ur.Parameter(WALL, initial=PAINT), ur.Parameter(LAMP, initial=PLACE)]
    reference = (0.9 * picture()).reshape(SIDE, SIDE, 3).astype(np.float32)
    problem = ur.Problem(scene, unknown, [ur.View(reference)], max_depth=2)
    hybrid = ur.estimators.HybridGradient(ur.PathGradient(spp=4), ur.GaussNewton(32, 16), eliminated=(WALL,))
    state = hybrid.init(problem, problem.initial())
    for step in range(STEPS):
        _, state = hybrid.estimate(problem, problem.initial(), state, Key(0, step))
    assert state.response is not None
    return state.response.slopes[WALL].reshape(3, -1)


def test_the_response_is_that_of_least_squares(monkeypatch: pytest.MonkeyPatch) -> None:
    """A texture that follows the lamp by a half is found out: the response becomes twice as long."""
    expected = response_by_differences()

    def error() -> float:
        return float(np.linalg.norm(response_of_estimator() - expected) / np.linalg.norm(expected))

    sound = error()
    init = EliminatedParameters.__init__

    def half(self: EliminatedParameters, inner: Any, held: Any, origin: Any, slopes: Any, bounds: Any) -> None:
        init(self, inner, held, origin, {key: 0.5 * x for key, x in slopes.items()}, bounds)

    monkeypatch.setattr(EliminatedParameters, "__init__", half)
    faulty = error()
    assert sound < 0.15
    assert faulty > 0.5
