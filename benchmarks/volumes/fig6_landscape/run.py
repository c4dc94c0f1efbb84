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
from benchmarks import figures, markdown
from benchmarks.internals import Tree
from benchmarks.paths import converged
from benchmarks.runner.records import Record
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
    values = sample(problem, at, points, runs, reference, reference_spp // 8)
    return {
        "factors": points,
        "table": statistics(values),
        "places": places(points, values),
        "check": check(problem, at(CHECK_FACTOR), {KEY: truth}, reference, CHECK_SPP, 4 * runs),
        "errors": errors(points, values),
    }


def table(record: Record) -> str:
    """Where the mean loss is least, and where its mean derivative is zero."""

    def summary(name: str, spp: str, what: str) -> str:
        place, error = record["places"][name][spp][what], record["errors"][name][spp][what]
        return "outside" if place is None else f"{place:.3f}" + ("" if error is None else f" ± {error:.3f}")

    kinds = ("least", "stop")
    places = [(name, spp) for name, entry in record["places"].items() for spp in entry]
    rows = [[name, spp, *(summary(name, spp, what) for what in kinds)] for name, spp in places]
    text = "`three-bodies`, {resolution}², {runs} renders at {count} factors from {factors[0]:g} to {factors[-1]:g} of the fog's true "
    text += "extinction, 1."
    return markdown.blocks(
        markdown.fill(text, record["settings"], record, {"count": len(record["factors"])}),
        markdown.table("loss | spp | mean loss least at | mean derivative 0 at", rows),
    )


def plot(record: Record) -> figures.Figure:
    """Mean loss and mean derivative against the factor."""
    panels = {
        f"{loss}: mean {what}": {
            f"{spp} spp": figures.band(record["factors"], *np.array(rows)[:, column : column + 2].T)
            for spp, rows in by_spp.items()
        }
        for loss, by_spp in record["table"].items()
        for what, column in (("loss", 0), ("derivative", 2))
    }
    return figures.curves(panels, "factor on the fog's extinction (truth 1)", "", columns=2, log="", level=0.0)
