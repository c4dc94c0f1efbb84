"""The height map of a plaque: pictures at the truth, the gradient against differences of Mitsuba's pictures, and the descent."""

from __future__ import annotations

from functools import partial

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from unrender.estimators.base import as_numpy
from unrender.gallery.heights import Relief, _heights
from unrender.rendering.mitsuba.scene_loading import load

pytestmark = pytest.mark.mitsuba

SIZE = Relief(resolution=12, height_resolution=6, reference_spp=1024)


@pytest.fixture(scope="module")
def problem() -> ur.Problem:
    return ur.gallery.problem("relief", resolution=12, height_resolution=6, reference_spp=1024)


def test_the_true_heights_render_the_references(problem: ur.Problem) -> None:
    for index, view in enumerate(problem.views):
        own = np.stack([ur.render(problem, problem.truth, index, spp=64, seed=seed) for seed in range(8)])
        flat = ur.render(problem, problem.initial_values(), index, spp=512)
        reference = np.asarray(view.reference)
        noise = own.std(axis=0, ddof=1) * np.sqrt(1 / 8 + 64 / 1024) + 1e-3
        assert np.abs((own.mean(axis=0) - reference) / noise).max() < 6
        assert np.abs((flat - reference) / noise).max() > 10


@pytest.mark.slow
def test_the_gradient_by_the_heights_is_the_slope_of_the_loss(problem: ur.Problem) -> None:
    """Along one direction: |z| < 4 against differences of the loss of Mitsuba's pictures, and a factor of 0.75 is found out."""
    width, direction = 0.05, _heights(SIZE.height_resolution)
    direction, start = direction / np.abs(direction).max(), 0.4 * direction
    references = [np.asarray(view.reference, np.float64) for view in problem.views]

    def losses(step: float, seed: int) -> float:
        """Return the sum of the losses of pictures, whose noise has no bias because two independent halves are multiplied."""
        total = 0.0
        for lit, reference in enumerate(references):
            scene = load(partial(SIZE._stage, start + step * direction, lit))
            integrator = mi.load_dict({"type": "path", "max_depth": SIZE.max_depth})
            one, other = (
                np.array(mi.render(scene, integrator=integrator, spp=512, seed=mi.UInt32(2 * seed + half))) - reference
                for half in (0, 1)
            )
            total += float(np.mean(one * other))
        return total

    slopes = np.array([(losses(width, seed) - losses(-width, seed)) / (2 * width) for seed in range(4)])
    estimator, found = ur.PathGradient(spp=64), []
    point = problem.replaced(parameters=[ur.Parameter("height", initial=start[..., None])]).initial()
    for seed in range(12):
        estimate = estimator.estimate(problem, point, estimator.init(problem, point), ur.Key(seed))[0]
        found.append(float(np.sum(as_numpy(estimate).gradient["height"][..., 0] * direction)))
    mean = float(np.mean(found))
    noise = np.hypot(np.std(found, ddof=1) / np.sqrt(len(found)), slopes.std(ddof=1) / np.sqrt(len(slopes)))
    assert abs(mean - slopes.mean()) < 4 * noise
    assert abs(0.75 * mean - slopes.mean()) > 4 * noise


@pytest.mark.slow
def test_auto_recovers_the_heights() -> None:
    problem = ur.gallery.problem("relief", resolution=24, height_resolution=12)
    result = ur.optimize(problem, steps=60, progress=False)
    start, end = (problem.parameter_error(x)["height"] for x in (problem.initial_values(), result.parameters))
    assert end < 0.4 * start


def test_a_map_of_one_height_is_refused_in_one_line() -> None:
    with pytest.raises(
        ur.InputError, match=r"height_resolution must be a whole number of at least 2, got 1$"
    ) as caught:
        ur.gallery.problem("relief", height_resolution=1)
    assert "\n" not in str(caught.value)
