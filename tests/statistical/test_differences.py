"""Finite differences of gradients (Balint et al. 2023, Eqs 3 to 5): with images of other paths they are unbiased, and in path space their
variance falls with the square of the step (Eq. 14)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats
from zscores import z_scores

import unrender as ur
from tiers import quick
from unrender.core import arrays, trees
from unrender.core.random import Key
from unrender.estimators import sample_groups
from unrender.estimators.sample_groups import GradientRequest
from unrender.images.base import ImageEstimate, PairRequest, PlainState
from unrender.scene.executor import LOCAL

STEPS = (0.1, 0.03, 0.01)


def slope(problem: ur.Problem, space: Any, runs: int = 24) -> float:
    """Of log Var ΔF against log step, the variance summed over all elements, from the start towards the truth."""
    start = problem.initial()
    truth = {key: problem.renderer.array(value) for key, value in problem.truth.items()}
    problem.renderer.prepare(list(start), "path")
    variances = []
    for step in STEPS:
        previous = {key: x + (truth[key] - x) * arrays.scalar(step, x) for key, x in start.items()}
        rows = []
        for run in range(runs):
            pair_request = PairRequest(previous, space)
            request = GradientRequest(start, ur.images.Plain(), PlainState(), 2, Key(1, run), pair_request=pair_request)
            both = LOCAL.estimate_gradient(problem, request)
            assert both.previous is not None
            difference = trees.numpy(trees.subtract(both.gradient, both.previous))
            rows.append(np.concatenate([x.ravel() for x in difference.values()]))
        variances.append(np.var(rows, axis=0, ddof=1).sum())
    return float(np.polyfit(np.log(STEPS), np.log(variances), 1)[0])


@pytest.mark.parametrize("name", quick(["spiral", "indirect-room"], "indirect-room"))
def test_in_path_space_the_variance_falls_with_the_square_of_the_step(name: str) -> None:
    problem = ur.gallery.problem(name, resolution=24, texture_resolution=8, reference_spp=256, loss="RelativeL2")
    assert slope(problem, "path") == pytest.approx(2, abs=0.2)


@pytest.mark.slow
def test_in_primary_space_it_does_not_where_roughness_moves_the_paths() -> None:
    """So the test above can fail: equal random numbers lead apart in a share of the paths that grows with the step."""
    problem = ur.gallery.problem("spiral", resolution=24, texture_resolution=8, reference_spp=256)
    assert slope(problem, "primary") < 1.75


def paired_gradients(problem: ur.Problem, spp: int, difference_spp: int | None, runs: int) -> np.ndarray:
    """(runs, n): of pairs of states a fifth of the way to the truth apart, the current one's gradient and the difference."""
    start = problem.initial()
    truth = {key: problem.renderer.array(value) for key, value in problem.truth.items()}
    previous = {key: x + (truth[key] - x) * arrays.scalar(0.2, x) for key, x in start.items()}
    asked = PairRequest(previous, "path", difference_spp=difference_spp)
    rows = []
    for run in range(runs):
        key = Key(spp, run)
        request = GradientRequest(start, ur.images.Plain(), PlainState(), spp, key, pair_request=asked)
        found = LOCAL.estimate_gradient(problem, request)
        current = found.gradient if difference_spp is None else found.paired
        both = (trees.numpy(current), trees.numpy(trees.subtract(current, found.previous)))
        rows.append(np.concatenate([x.ravel() for tree in both for x in tree.values()]))
    return np.stack(rows)


@pytest.mark.slow
def test_at_the_images_of_other_paths_the_difference_is_unbiased(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against leave-one-out groups. Faults that are seen: the current image for the previous one, images of the adjoint's own paths."""
    problem = ur.gallery.problem("indirect-room", resolution=24, texture_resolution=8, reference_spp=256, loss="L2")
    exact = paired_gradients(problem, 16, None, 48)

    def worst(spp: int) -> float:
        return float(np.abs(z_scores(paired_gradients(problem, spp, 1, 128), exact)).max())

    limit = float(stats.norm.isf((1 - (1 - 1e-3) ** (1 / exact.shape[1])) / 2))
    assert worst(2) < limit
    with monkeypatch.context() as swapped:
        swapped.setattr(ImageEstimate, "previous_mean", ImageEstimate.mean)
        assert worst(2) > limit
    sound, last = ur.images.Plain.estimate, []

    def remembered(*arguments: Any) -> Any:
        found = sound(*arguments)
        last[:] = [found[0].paths]
        return found

    monkeypatch.setattr(ur.images.Plain, "estimate", remembered)
    monkeypatch.setattr(sample_groups, "_paths", lambda *_: last[0])
    assert worst(1) > limit
