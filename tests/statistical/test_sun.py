# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false

"""Images and gradients under a sun, whose edge Mitsuba's `eval_direction` does not find: against Mitsuba's own images."""

from __future__ import annotations

from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats
from zscores import agree, z_scores

import unrender as ur
from tiers import quick, slow
from unrender.core.random import Key
from unrender.estimators.base import as_numpy
from unrender.rendering.mitsuba.integrators.boundary_sampling import _emitter_points as emitter_points
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest, Space

ALBEDO, TURBIDITY, SUN, TURN = "floor.bsdf.reflectance.value", "sky.turbidity", "sky.sun_direction", "sky.rotation.x"
GROUPS, SPP = 16, 1024
OFF = {ALBEDO: [0.4, 0.6, 0.5], TURBIDITY: 4.0, SUN: [0.8, 0.5, 0.3], TURN: 0.6}
"""Another value of each parameter."""


def turn(degrees: float) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().rotate([1, 0, 0], degrees)


def scene(**sky: Any) -> dict[str, Any]:
    """A floor under a sun, by default without the light of the sky: all samples then have almost the same value."""
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    camera = mi.ScalarTransform4f().look_at([0, 3, 1], [0, 0, 0], [0, 1, 0])
    floor = {"type": "rgb", "value": [0.5, 0.5, 0.5]}
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 10, "to_world": camera, "film": film},
        "floor": {
            "type": "rectangle",
            "to_world": turn(-90).scale(9),
            "bsdf": {"type": "diffuse", "reflectance": floor},
        },
        "sky": {"type": "sunsky", "sun_direction": [0.3, 0.86, 0.4], "to_world": turn(-90), "sky_scale": 0.0, **sky},
    }


def renderer(key: str, **more: Any) -> MitsubaRenderer:
    return MitsubaRenderer(lambda: {**scene(), **more}, 2, [key])


def mitsuba_images(description: dict[str, Any], first: int) -> np.ndarray:
    """Return independent images, (GROUPS, H, W, 3)."""
    loaded, path = mi.load_dict(description), mi.load_dict({"type": "path", "max_depth": 2})
    seeds = range(first, first + GROUPS)
    return np.array([mi.render(loaded, integrator=path, spp=SPP, seed=mi.UInt32(seed)) for seed in seeds], float)


@cache
def stock_images(first: int) -> np.ndarray:
    return mitsuba_images(scene(), first)


def images(of: MitsubaRenderer, values: dict[str, Any], seed: int, emitters: Any = None) -> np.ndarray:
    session = of.prepare(list(values), None, derivatives=False)
    request = SampleRequest(0, GROUPS * SPP, seed, GROUPS, emitters=emitters)
    return np.array(session.image(values, request).images, float)


def states(of: MitsubaRenderer, key: str) -> tuple[Any, Any]:
    return {key: of.array(np.array(OFF[key]))}, of.values([key])


def test_the_sun_is_as_bright_as_in_mitsuba_and_its_edge_is_seen() -> None:
    """Of four parts in a thousand that were missing, two would be seen."""
    ours, theirs = images(renderer(ALBEDO), {}, 1), stock_images(100)
    assert agree(ours, theirs, size=8)
    assert not agree(0.998 * ours, theirs, size=8), "two parts in a thousand went unseen"


@pytest.mark.slow
def test_with_other_probabilities_of_the_emitters_it_is_as_bright() -> None:
    """A dark lamp that is seldom chosen, so that it adds little noise."""
    lamp = {"type": "point", "position": [0, 2, 0], "intensity": 0.0}
    of = renderer(ALBEDO, lamp=lamp)
    suns = ["Sun" in emitter.class_name() for emitter in mi.load_dict({**scene(), "lamp": lamp}).emitters()]
    ours, theirs = images(of, {}, 1, np.where(suns, 0.998, 0.002)), stock_images(100)
    assert agree(ours, theirs, size=8)
    assert not agree(0.998 * ours, theirs, size=8), "two parts in a thousand went unseen"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "space"),
    [slow(ALBEDO, "path"), slow(TURBIDITY, "primary"), (SUN, "primary"), slow(TURN, "primary")],
)
def test_both_images_of_a_pair_agree_with_separate_renders(key: str, space: Space) -> None:
    of = renderer(key)
    now, before = states(of, key)
    pair = of.prepare([key], space, derivatives=False).image_pair(
        now, before, SampleRequest(0, GROUPS * SPP, 1, GROUPS), space
    )
    for shared, values in ((pair.images, now), (pair.previous, before)):
        assert agree(np.array(shared, float), images(of, values, 2), size=8)
    assert agree(np.array(pair.previous, float), stock_images(100), size=8)


@pytest.mark.parametrize("key", quick([TURBIDITY, SUN, TURN], SUN))
def test_differences_of_images_are_those_of_mitsuba_s(key: str) -> None:
    """Perturbed renders are made of these."""
    of = renderer(key)
    now, before = states(of, key)
    turned = turn(np.degrees(OFF[TURN]))
    sky = {
        TURBIDITY: {"turbidity": OFF[TURBIDITY]},
        SUN: {"sun_direction": OFF[SUN]},
        TURN: {"sun_direction": np.array(turned.matrix)[:3, :3] @ [0.3, 0.86, 0.4], "to_world": turned @ turn(-90)},
    }[key]
    ours = images(of, now, 1) - images(of, before, 2)
    theirs = mitsuba_images(scene(**sky), 100) - stock_images(200)
    assert agree(ours, theirs, size=8)
    assert not agree(0.998 * ours, theirs, size=8), "two parts in a thousand went unseen"


def test_path_gradients_under_the_sun_are_the_slope_of_the_loss() -> None:
    """The image is proportional to the albedo."""
    reference = np.full((8, 8, 3), 0.1, np.float32)
    problem = ur.Problem(scene, [ur.Parameter(ALBEDO)], [ur.View(reference)], max_depth=2)
    point, estimator = problem.initial(), ur.PathGradient(spp=4096)
    states = [estimator.init(problem, point) for _ in range(16)]
    estimates = [estimator.estimate(problem, point, state, Key(seed))[0] for seed, state in enumerate(states)]
    ours = np.array([as_numpy(estimate).gradient[ALBEDO] for estimate in estimates], float)
    first, second = np.split(mitsuba_images(scene(), 500), 2)
    theirs = np.array([2 * ((a - reference) * b / 0.5).mean((0, 1)) / 3 for a, b in zip(first, second, strict=True)])
    limit = stats.norm.isf(1e-3 / 6)
    assert np.abs(z_scores(ours, theirs)).max() < limit
    assert np.abs(z_scores(0.997 * ours, theirs)).min() > limit, "three parts in a thousand went unseen"


def test_no_point_of_the_sun_for_boundaries_of_shadows_is_dark() -> None:
    sun: Any = mi.load_dict(scene()["sky"])
    _, _, direction, *_ = emitter_points(sun, 1, 1 << 16, 0.0)
    it, ds = dr.zeros(mi.Interaction3f, 1 << 16), dr.zeros(mi.DirectionSample3f, 1 << 16)
    ds.d = direction
    centre = np.array([0.3, 0.86, 0.4]) / np.linalg.norm([0.3, 0.86, 0.4])
    of_sun = centre @ np.array(direction, float) > 0.9999
    lit = np.array(sun.eval_direction(it, ds))[0] > 0
    assert of_sun.sum() > 1 << 14
    assert lit[of_sun].mean() > 0.9999
