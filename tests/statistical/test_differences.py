"""The variance of a finite difference of gradients falls with the square of the step (Balint et al. 2023, Eq. 14), in path space."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import unrender as ur
from tiers import quick
from unrender.core import arrays, trees
from unrender.core.random import Key
from unrender.estimators.sample_groups import gather
from unrender.images.base import PairRequest
from unrender.images.plain import PlainState

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
            both = gather(problem, start, ur.images.Plain(), PlainState(), 2, Key(1, run), pair_request=pair_request)
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
