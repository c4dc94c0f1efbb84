# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Gradients of pixel mini-batches on a path tracer: the mean of many mini-batches is the gradient of all pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats
from zoo import scene
from zscores import z_scores

import unrender as ur
from benchmarks.adaptive.over_uniform.run import by_paths, rough_box
from benchmarks.internals import pixel_shares, second_moments
from unrender.core.random import Key
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

RUNS, COUNT = 800, 96
SCHEMES: dict[str, Any] = {
    "uniform": lambda: ur.PathGradient(pixels=ur.pixels.Uniform(COUNT), spp=2),
    "loss": lambda: ur.PathGradient(pixels=ur.pixels.LossProportional(COUNT), spp=2),
    "adaptive": lambda: ur.PathGradient(pixels=ur.pixels.Adaptive(COUNT), spp=2),
    "adaptive, as in the paper": lambda: ur.PathGradient(
        pixels=ur.pixels.Adaptive(COUNT, stratified=False, uniform=0.1, learn_from_draws=False, by_cost=False), spp=1
    ),
    "whole views, adaptive counts": lambda: ur.PathGradient(pixels=ur.pixels.AdaptiveCounts(uniform=0.1), spp=6),
}


def two_cameras() -> dict[str, Any]:
    """The zoo's scene, seen by two sensors whose films differ in size and shape."""
    description = scene({"type": "roughconductor", "alpha": 0.2}, environment=False)
    film = dict(description["sensor"]["film"], width=12, height=10)
    description["sensor"] = dict(description["sensor"], film=film)
    second = dict(description["sensor"], fov=25, film=dict(film, width=7, height=14))
    return {**description, "second": second}


def problem() -> ur.Problem:
    rng = np.random.default_rng(0)
    mask = rng.random((14, 7)) < 0.8
    references = [rng.uniform(0.0, 0.8, (10, 12, 3)), rng.uniform(0.0, 0.8, (14, 7, 3))]
    return ur.Problem(
        two_cameras(),
        [ur.Parameter("floor.bsdf.reflectance.data"), ur.Parameter("lamp.emitter.radiance.value")],
        [ur.View(references[0]), ur.View(references[1], sensor=1, weight=2.0, mask=mask)],
        max_depth=3,
    )


def flat(gradient: dict[str, Any]) -> np.ndarray:
    """Blocks of the texture, and the light's colour."""
    texture = np.array(gradient["floor.bsdf.reflectance.data"]).astype(np.float64)
    parts = texture.reshape(2, 4, 2, 4, 3).sum(axis=(1, 3)).ravel()
    return np.concatenate([parts, np.array(gradient["lamp.emitter.radiance.value"])])


def gradients(asked: ur.Problem, estimator: Any, runs: int) -> np.ndarray:
    state, at = estimator.init(asked, asked.initial()), asked.initial()
    rows = []
    for step in range(runs):
        found, state = estimator.estimate(asked, at, state, Key(1, step))
        rows.append(flat(found.gradient))
    return np.array(rows)


@pytest.fixture(scope="module")
def whole() -> tuple[ur.Problem, np.ndarray]:
    asked = problem()
    return asked, gradients(asked, ur.PathGradient(spp=16), 400)


@pytest.mark.slow  # in the quick tier, contract/test_pixels.py holds every sampler to it on an analytic renderer
@pytest.mark.parametrize("name", SCHEMES)
def test_mini_batches_are_unbiased(name: str, whole: tuple[ur.Problem, np.ndarray]) -> None:
    asked, expected = whole
    rows = gradients(asked, SCHEMES[name](), 400 if name.startswith("whole") else RUNS)
    limit = stats.norm.isf((1 - (1 - 1e-3) ** (1 / rows.shape[1])) / 2)
    assert np.abs(z_scores(rows, expected)).max() < limit
    assert np.abs(z_scores(rows * 1.2, expected)).max() > limit, "a planted weight error went unseen"


def test_chosen_pixels_of_several_sensors_are_those_of_each() -> None:
    """In one launch: the same pixels as renders of each sensor alone."""
    renderer = MitsubaRenderer(two_cameras(), 3)
    key = "floor.bsdf.reflectance.data"
    session = renderer.prepare([key], None)
    at = renderer.values([key])
    sizes = renderer.resolutions()
    assert sizes == [(10, 12), (14, 7)]
    rng = np.random.default_rng(1)
    sensors = rng.integers(0, 2, 60)
    pixels = np.array([rng.integers(0, sizes[s][0] * sizes[s][1]) for s in sensors])
    from unrender.core import arrays

    like = renderer.array(np.zeros(1))
    chosen = arrays.like_integers(pixels, like), arrays.like_integers(sensors, like)
    drawn = np.array(
        [np.array(session.image(at, SampleRequest(0, 64, seed, 1, *chosen)).images)[0] for seed in range(30)]
    )
    apart = np.zeros_like(drawn)
    for sensor in (0, 1):
        film = np.array(
            [np.array(session.image(at, SampleRequest(sensor, 64, 100 + seed)).images)[0] for seed in range(30)]
        )
        here = sensors == sensor
        apart[:, here] = film.reshape(30, -1, 3)[:, pixels[here]]
    z = np.abs(z_scores(drawn, apart))
    assert z.max() < stats.norm.isf((1 - (1 - 1e-3) ** (1 / z.size)) / 2)
    assert np.abs(z_scores(drawn[:, ::-1], apart)).max() > 10


@pytest.mark.slow
def test_first_map_of_a_rough_box_is_as_good_as_that_of_the_loss_derivative() -> None:
    """Variance over that of uniform pixels, by paths that the maps have not seen: of eight first maps of each sampler."""
    box = rough_box(reference_spp=256)
    at = box.initial()
    (moments,) = second_moments(box, at, [np.ones(1)], 1 << 16, 8, Key(0, 7))

    def logarithms(sampler: Any) -> np.ndarray:
        drawn = (sampler.draw(box, at, sampler.init(box, at), Key(seed))[1] for seed in range(8))
        return np.log([by_paths(moments, pixel_shares(box, sampler, state))[0] for state in drawn])

    ours, loss = logarithms(ur.pixels.Adaptive(1000)), logarithms(ur.pixels.LossProportional(1000))
    error = np.sqrt((ours.var(ddof=1) + loss.var(ddof=1)) / len(ours))
    assert ours.mean() < loss.mean() + 3 * error
    assert np.exp(ours.max()) < 1.0, "no better than uniform pixels"
    raw = logarithms(ur.pixels.Adaptive(1000, uniform=0.1, learn_from_draws=False, by_cost=False, denoiser="none"))
    assert raw.mean() > loss.mean() + 3 * error, "a planted worse map went unseen"
