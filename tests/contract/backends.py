"""Every renderer that answers the port, each with a small scene, for the suites that hold all of them to one contract."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import mitsuba as mi
import numpy as np

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.core import arrays
from unrender.gallery.analytic import ExponentialRenderer, QuadraticRenderer
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import Renderer, SampleRequest

TEXTURE, LAMP = "back.bsdf.reflectance.data", "light.emitter.radiance.value"
SIZE = 8


@dataclass(frozen=True)
class Backend:
    """A renderer to hold to the contract.

    Attributes:
        make: the renderer, new.
        keys: the parameters that the suite changes.
        others: parameters of another session of the same renderer.
        derivatives: whether those of `keys` are differentiable.
        same_paths: whether equal seeds give smooth images of the parameters, so that finite differences need no averaging.
        step: by which parameters are changed, relative.
    """

    make: Callable[[], Renderer]
    keys: tuple[str, ...]
    others: tuple[str, ...] = ()
    derivatives: bool = True
    same_paths: bool = True
    step: float = 0.05

    @lru_cache(maxsize=1)  # noqa: B019 (one)
    def renderer(self) -> Renderer:
        """That of the test before, where it was this backend's; else a new one: see `no_scene_outlives_its_file`."""
        return self.make()


def linear() -> Renderer:
    """Two parameters, two sensors, noise that follows the parameters and noise that does not."""
    rng = np.random.default_rng(0)
    values = {"colour": rng.uniform(0.3, 0.9, 3), "map": rng.uniform(0.3, 0.9, (2, 2, 1))}
    return AnalyticRenderer(values, rng.uniform(0, 1, (48, 7)), 0.1, noise=0.5, grain=0.2, sensors=2)


def surface() -> dict[str, Any]:
    """Mitsuba's Cornell box with one ball and a sky, its back wall with a texture, seen by two cameras."""
    described = mi.cornell_box()
    del described["small-box"], described["large-box"]
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    described["sensor"]["film"] = film
    aside = mi.ScalarTransform4f().look_at([0.6, 0.4, 3.4], [0, 0, 0], [0, 1, 0])
    described["second"] = {"type": "perspective", "fov": 45, "to_world": aside, "film": dict(film)}
    texels = np.random.default_rng(0).uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "format": "variant"}
    described["back"]["bsdf"] = {"type": "diffuse", "reflectance": texture}
    described["ball"] = {
        "type": "sphere",
        "center": [-0.3, -0.5, 0.2],
        "radius": 0.4,
        "bsdf": {"type": "roughconductor", "alpha": 0.3},
    }
    described["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": 0.3}}
    return described


def medium() -> dict[str, Any]:
    """A cube of smoke above a floor, under a lamp and a sky."""
    to = mi.ScalarTransform4f
    rng = np.random.default_rng(1)

    def grid(low: float, high: float) -> dict[str, Any]:
        volume = mi.VolumeGrid(rng.uniform(low, high, (4, 4, 4, 1)).astype(np.float32))
        place = to().translate([-1, -1, -1]).scale(2)
        return {"type": "gridvolume", "grid": volume, "raw": True, "to_world": place}

    lamp = to().look_at([1.5, -1, 3], [0, 0, 0], [0, 1, 0]) @ to().scale(0.6)
    return {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 35,
            "to_world": to().look_at([0, -5, 2.2], [0, 0, 0], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
        },
        "body": {
            "type": "cube",
            "bsdf": {"type": "null"},
            "interior": {"type": "heterogeneous", "sigma_t": grid(0.2, 1.5), "albedo": grid(0.4, 0.9)},
        },
        "floor": {
            "type": "rectangle",
            "to_world": to().translate([0, 0, -1.3]).scale(3),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.5, 0.3]}},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": lamp,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [9.0, 8.0, 6.0]}},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}},
    }


BACKENDS = {
    "linear": Backend(linear, ("colour", "map"), ("colour",)),
    "quadratic": Backend(lambda: QuadraticRenderer(np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([0.7, 0.4])), ("x",)),
    "exponential": Backend(lambda: ExponentialRenderer(0.5), ("rate",), step=1e-3),
    "surface": Backend(lambda: MitsubaRenderer(surface, 3), (TEXTURE, LAMP), (LAMP, "ball.bsdf.alpha.value")),
    "medium": Backend(
        lambda: MitsubaRenderer(medium, 4),
        ("body.interior_medium.sigma_t.data", "body.interior_medium.albedo.data"),
        ("floor.bsdf.reflectance.value",),
        same_paths=False,
    ),
    "poses": Backend(
        lambda: MitsubaRenderer(surface, 3),
        ("ball.translation", "ball.scale"),
        (TEXTURE, LAMP),
        derivatives=False,
        same_paths=False,
    ),
}


def problem(parameters: tuple[str, ...] = (TEXTURE, LAMP)) -> ur.Problem:
    """Of the surface scene: two parameters from a start that is wrong, one view."""
    renderer = MitsubaRenderer(surface, 3)
    session = renderer.prepare([], None)
    reference = arrays.numpy(session.image({}, SampleRequest(0, 256, 99)).images[0])
    starts = {TEXTURE: 0.5, LAMP: 10.0}
    return ur.Problem(
        renderer, [ur.Parameter(key, initial=starts.get(key)) for key in parameters], [ur.View(reference)], max_depth=3
    )
