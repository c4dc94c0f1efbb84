"""Bias of a loss and of its derivative along the extinction of fog (RCV Fig. 6): `three-bodies`.

The true extinction of the fog times a factor, all else at the truth: the mean over noisy renders of the L1 and the L2
loss, and of their derivatives by the factor, at 1, 4, 16 and 64 spp; where the mean loss is least, and where the mean
derivative is zero, with standard errors by resampling the runs. A run has the same random numbers at every factor. At
factor 1.2, 4 spp, the mean of `unrender.PathGradient` must agree with the derivative.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Tree
from benchmarks.paths import converged
from benchmarks.volumes.fig6_landscape.landscape import LOSSES, SPP, Values, check, places, sample, statistics

KEY = "fog.interior_medium.sigma_t.value.value"
CHECK_FACTOR, CHECK_SPP = 1.2, 4
DRAWS = 200
QUICK = {"resolution": 8, "runs": 3, "factors": 3, "reference_spp": 512}


def errors(factors: list[float], values: Values) -> dict[str, dict[str, dict[str, float | None]]]:
    """Standard errors of `places`, from runs sampled with replacement; None where half of the samples have no such place."""
    rng = np.random.default_rng(0)
    samples: list[Any] = []
    for _ in range(DRAWS):
        runs = values["L1"]["1"].shape[1]
        some = rng.integers(runs, size=runs)  # of all factors, whose random numbers are the same
        resampled = {name: {spp: x[:, some] for spp, x in entry.items()} for name, entry in values.items()}
        samples.append(places(factors, resampled))

    def error(*path: str) -> float | None:
        name, spp, what = path
        found = [one[name][spp][what] for one in samples if one[name][spp][what] is not None]
        return float(np.std(found, ddof=1)) if 2 * len(found) > DRAWS else None

    return {
        name: {str(spp): {what: error(name, str(spp), what) for what in ("least", "stop")} for spp in SPP}
        for name in LOSSES
    }


def run(resolution: int = 32, runs: int = 96, factors: int = 11, reference_spp: int = 16384) -> dict[str, Any]:
    """Losses and derivatives at every factor.

    Args:
        factors: points between 0.5 and 1.5
    """
    made = ur.gallery.problem("three-bodies", resolution=resolution, reference_spp=1)
    problem = made.replaced(parameters=[ur.Parameter(KEY)])
    truth = np.asarray(made.truth[KEY])

    def at(factor: float) -> Tree:
        return {KEY: problem.renderer.array(factor * truth)}

    points = np.linspace(0.5, 1.5, factors).tolist()
    reference = converged(problem, at(1.0), reference_spp).mean
    values = sample(problem, at, points, runs, reference, reference_spp // 8, common=True)
    return {
        "factors": points,
        "table": statistics(values),
        "places": places(points, values),
        "check": check(problem, at(CHECK_FACTOR), {KEY: truth}, reference, CHECK_SPP, 4 * runs),
        "errors": errors(points, values),
    }
