# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Connections that take emitters with given probabilities: images and gradients stay unbiased, and what the connections tell is right."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats
from zoo import DEPTH, scene
from zscores import agree, z_scores

from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.pixels.pixel_statistics import random_signs
from unrender.rendering.mitsuba import scene_pair
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

RUNS = 12
FLOOR, LAMP = "floor.bsdf.reflectance.data", "lamp.emitter.radiance.value"
SKEWED = np.array([0.1, 0.7, 0.2])
REQUEST = SampleRequest(0, 32, 1, 2)


def lit() -> dict[str, Any]:
    """A rough ball on a textured floor, under an area light, a point light and an environment map."""
    point = {"type": "point", "position": [-1, -1, 2], "intensity": {"type": "rgb", "value": [1, 2, 1]}}
    return {**scene({"type": "roughconductor", "alpha": 0.2}), "bulb": point}


@pytest.fixture(scope="module")
def renderer() -> MitsubaRenderer:
    return MitsubaRenderer(lit, DEPTH)


@contextmanager
def blind_density() -> Iterator[None]:
    """The planted fault: emitters are drawn with other probabilities than the densities know of."""
    right = scene_pair.emitter_tables

    def wrong(loaded: mi.Scene, probabilities: np.ndarray) -> dict[str, Any]:
        count = len(probabilities)
        return {**right(loaded, probabilities), "emitter_pmf": right(loaded, np.full(count, 1 / count))["emitter_pmf"]}

    scene_pair.emitter_tables = wrong
    try:
        yield
    finally:
        scene_pair.emitter_tables = right


def of(found: MitsubaRenderer, probabilities: np.ndarray | None, first: int) -> tuple[np.ndarray, np.ndarray]:
    """(runs, H, W, 3) images, and (runs, n) gradients of their brightness by blocks of the floor and the lamp's radiance."""
    at = found.values([FLOOR, LAMP])
    session = found.prepare([FLOOR, LAMP], "path")
    images, gradients = [], []
    for run in range(RUNS):
        rendering = session.image(at, replace(REQUEST, seed=first + run, emitters=probabilities))
        images.append(np.array(rendering.images).mean(axis=0))
        gradient = session.adjoint(at, rendering.paths, mi.TensorXf(np.ones(rendering.images.shape, np.float32)))
        floor = np.array(gradient[FLOOR]).astype(np.float64).reshape(2, 4, 2, 4, 3).sum(axis=(1, 3))
        gradients.append(np.concatenate([floor.ravel(), np.array(gradient[LAMP])]))
    return np.array(images), np.array(gradients)


def worst(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(z_scores(a, b)).max())


def limit(count: int) -> float:
    return float(stats.norm.isf((1 - (1 - 1e-3) ** (1 / count)) / 2))


def test_the_scene_s_own_probabilities_give_its_own_image(renderer: MitsubaRenderer) -> None:
    at = renderer.values([FLOOR])
    session = renderer.prepare([FLOOR], "path")
    np.testing.assert_allclose(session.emitters(), np.full(3, 1 / 3))
    own = np.array(session.image(at, REQUEST).images)
    given = np.array(session.image(at, replace(REQUEST, emitters=session.emitters())).images)
    assert np.quantile(np.abs(given - own) / own, 0.95) < 1e-4  # but for lanes on the very border between two emitters
    other = np.array(session.image(at, replace(REQUEST, emitters=SKEWED)).images)
    assert np.quantile(np.abs(other - own) / own, 0.5) > 1e-3


def test_images_and_gradients_are_unbiased_for_any_probabilities(renderer: MitsubaRenderer) -> None:
    images, gradients = of(renderer, None, 100)
    skewed_images, skewed_gradients = of(renderer, SKEWED, 200)
    assert agree(skewed_images, images)
    assert worst(skewed_gradients, gradients) < limit(gradients.shape[1])
    with blind_density():
        faulty_images, faulty_gradients = of(MitsubaRenderer(lit, DEPTH), SKEWED, 200)
    assert not agree(faulty_images, images), "a planted error went unseen"
    assert worst(faulty_gradients, gradients) > limit(gradients.shape[1]), "a planted error went unseen"


@pytest.mark.slow
@pytest.mark.parametrize("space", ["path", "primary"])
def test_both_states_of_a_pair_are_unbiased(renderer: MitsubaRenderer, space: Any) -> None:
    """Along one set of paths, whose emitters are drawn by the same probabilities."""
    current = renderer.values([FLOOR, LAMP])
    previous = {FLOOR: current[FLOOR] * 0.9, LAMP: current[LAMP] * 1.2}
    session = renderer.prepare([FLOOR, LAMP], space)
    pairs = [
        session.image_pair(current, previous, replace(REQUEST, seed=run, emitters=SKEWED), space) for run in range(RUNS)
    ]
    for state, parameters in (("images", current), ("previous", previous)):
        mine = np.array([np.array(getattr(pair, state)).mean(axis=0) for pair in pairs])
        alone = [np.array(session.image(parameters, replace(REQUEST, seed=500 + run)).images) for run in range(RUNS)]
        assert agree(mine, np.array(alone).mean(axis=1)), f"{state}"
    weights = mi.TensorXf(np.ones(pairs[0].images.shape, np.float32))
    now, before = session.adjoint_pair(current, previous, pairs[0].paths, weights, weights)
    request = replace(REQUEST, seed=0, emitters=SKEWED)
    for found, parameters in ((now, current), (before, previous)):
        if parameters is current or space == "primary":  # the other walks the current state's paths
            single = session.adjoint(parameters, session.image(parameters, request).paths, weights)
            np.testing.assert_allclose(np.array(found[LAMP]), np.array(single[LAMP]), rtol=1e-3)


def bulbs(behind: bool) -> dict[str, Any]:
    """A textured wall and a floor under two bulbs; `behind` a shade that leaves the wall what the floor gives back."""
    to = mi.ScalarTransform4f
    pixels = np.random.default_rng(0).uniform(0.2, 0.9, (8, 8, 3)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "filter_type": "nearest"}
    found: dict[str, Any] = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 40,
            "to_world": to().look_at([0, 1.2, 4], [0, 1.2, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
        },
        "wall": {
            "type": "rectangle",
            "to_world": to().translate([0, 1.2, 0]).scale(1.2),
            "bsdf": {"type": "diffuse", "reflectance": texture},
        },
        "floor": {
            "type": "rectangle",
            "to_world": to().translate([0, -1, 2]).rotate([1, 0, 0], -90).scale(3),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.4, 0.3]}},
        },
        "near": {"type": "point", "position": [0.6, -0.5, 0.8], "intensity": {"type": "rgb", "value": [2, 2, 1]}},
        "far": {"type": "point", "position": [-0.6, -0.5, 1.2], "intensity": {"type": "rgb", "value": [9, 9, 9]}},
    }
    if behind:
        found["shade"] = {
            "type": "rectangle",
            "to_world": to().translate([0, -0.4, 1]).rotate([1, 0, 0], -90).scale([1.5, 0.99, 1]),
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.0}},
        }
    return found


WALL, GROUND = "wall.bsdf.reflectance.data", "floor.bsdf.reflectance.value"


def told(behind: bool, depth: int, probabilities: np.ndarray, seed: int, noise: bool = False) -> tuple[Any, float]:
    """What connections tell with random weights, and the sum of the squared derivatives, or of the squared radiance, of whole paths."""
    keys = [WALL, GROUND] if behind else [WALL]
    made = MitsubaRenderer(lambda: bulbs(behind), depth)
    session, at = made.prepare(keys, None), made.values(keys)
    tangents = {key: made.array(sign) for key, sign in random_signs(at, Key(seed)).items()}
    request = SampleRequest(0, 1, seed, 1, emitters=probabilities)
    rendering = session.image(at, request)
    weights = np.zeros((1, 16, 16, 3), np.float32)
    weights[..., 1] = np.random.default_rng(0).random((16, 16))  # of one channel: squares of sums are sums of squares
    parts = [mi.TensorXf(weights * share) for share in ((0, 1) if noise else (1, 0))]
    found = session.emitter_moments(at, rendering.paths, tangents, *parts)
    whole = np.array(rendering.images[0]) ** 2 if noise else session.tangent_moment(at, rendering.paths, tangents)
    return found, float((weights[0] ** 2 * np.array(whole)).sum())


@pytest.mark.slow
@pytest.mark.parametrize(("behind", "depth"), [(False, 2), (True, 3)])
@pytest.mark.parametrize("noise", [False, True])
def test_where_paths_have_one_connection_it_tells_all_of_them(behind: bool, depth: int, noise: bool) -> None:
    """Directly or, behind a shade, after a bounce, whose throughput has a derivative of its own."""
    found, whole = told(behind, depth, np.array([0.3, 0.7]), 5, noise)
    assert whole > 0
    assert found.sums.sum() == pytest.approx(whole, rel=1e-4)
    again, _ = told(behind, depth, np.array([0.3, 0.7]), 5, noise)
    np.testing.assert_array_equal(found.sums, again.sums)
    np.testing.assert_array_equal(found.squares, again.squares)


@pytest.mark.slow
def test_second_moments_follow_from_any_probabilities() -> None:
    """M_e = p_e E[y of e]: of bulbs, to which no other strategy leads, whatever they are drawn with."""
    sums = []
    for probabilities in (np.array([0.3, 0.7]), np.array([0.8, 0.2])):
        runs = [told(False, 3, probabilities, seed)[0].sums * probabilities for seed in range(1, 13)]
        sums.append(np.array(runs))
    bound = limit(2)
    assert worst(sums[0], sums[1]) < bound
    assert worst(sums[0] / np.array([0.3, 0.7]), sums[1] / np.array([0.8, 0.2])) > bound, "a planted error went unseen"


def test_probabilities_that_make_no_sense_are_refused(renderer: MitsubaRenderer) -> None:
    session, at = renderer.prepare([FLOOR], "path"), renderer.values([FLOOR])
    for wrong in (np.ones(2) / 2, np.array([1.5, -0.5, 0.0]), np.full(3, 0.5)):
        with pytest.raises(InputError, match="probabilities of 3 emitters"):
            session.image(at, replace(REQUEST, emitters=wrong))
