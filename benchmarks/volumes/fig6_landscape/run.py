"""Bias of a loss and of its derivative along the extinction of fog (RCV Fig. 6): `three-bodies`.

The true extinction of the fog times a factor, all else at the truth: the mean over noisy renders of the L1 and the L2
loss, and of their derivatives by the factor, at 1, 4, 16 and 64 spp; where the mean loss is least, and where the mean
derivative is zero, with standard errors by resampling the runs. A run has the same random numbers at every factor. At
factor 1.2, 4 spp, the mean of `unrender.PathGradient` must agree with the derivative.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import Key, SampleRequest, Tree, arrays, prepare
from benchmarks.moments import Moments
from benchmarks.paths import converged
from benchmarks.runner.records import Record
from benchmarks.suite.scenes import LOSSES

KEY = "fog.interior_medium.sigma_t.value.value"
CHECK_FACTOR, CHECK_SPP = 1.2, 4
DRAWS = 200
QUICK = {"resolution": 8, "runs": 3, "factors": 3, "reference_spp": 512}
SPP = (1, 4, 16, 64)

State = Callable[[float], Tree]
"""The parameters at a factor."""
Values = dict[str, dict[str, np.ndarray]]
"""Of each loss and sample count: (factors, runs, 2), loss and derivative."""


def slopes(problem: ur.Problem, at: State, factor: float, spp: int, change: float = 0.02) -> np.ndarray:
    """dI/dfactor, (H, W, 3), on paths that both sides share."""
    higher, lower, found = at(factor + change), at(factor - change), Moments()
    session = prepare(problem, higher, "path")
    for number in range(max(1, spp // 64)):
        request = SampleRequest(problem.views[0].sensor, 64, Key(31_337, number).uint32())
        pair = session.image_pair(higher, lower, request, "path")
        found.add((arrays.numpy(pair.images)[0] - arrays.numpy(pair.previous)[0]) / (2 * change))
    return found.mean


def sample(
    problem: ur.Problem, at: State, factors: Sequence[float], runs: int, reference: np.ndarray, slope_spp: int
) -> Values:
    """Loss and derivative of every run at every factor. The derivative is the mean of loss' (noisy image) · dI/dfactor.

    A run has the same random numbers at every factor, so that what the factor does not change has the same noise.
    """
    found: Values = {name: {str(spp): np.zeros((len(factors), runs, 2)) for spp in SPP} for name in LOSSES}
    for index, factor in enumerate(factors):
        parameters, slope = at(factor), slopes(problem, at, factor, slope_spp)
        session = prepare(problem, parameters)
        for spp in SPP:
            for run in range(runs):
                request = SampleRequest(problem.views[0].sensor, spp, Key(run, 0, spp).uint32())
                image = arrays.numpy(session.image(parameters, request).images[0]).astype(np.float64)
                for name, loss in LOSSES.items():
                    value, derivative = loss.value(image, reference), loss.derivative(image, reference) * slope
                    found[name][str(spp)][index, run] = value.mean(), derivative.mean()
        print(f"factor {factor:.2f}", flush=True)
    return found


def statistics(values: Values) -> dict[str, dict[str, list[list[float]]]]:
    """Mean and standard error of the loss, and of the derivative, at every factor."""

    def rows(x: np.ndarray) -> list[list[float]]:
        mean, error = x.mean(axis=1), x.std(axis=1, ddof=1) / np.sqrt(x.shape[1])
        return np.stack([mean[:, 0], error[:, 0], mean[:, 1], error[:, 1]], axis=1).tolist()

    return {name: {spp: rows(x) for spp, x in entry.items()} for name, entry in values.items()}


def places(factors: Sequence[float], values: Values) -> dict[str, dict[str, dict[str, float | None]]]:
    """Where the mean loss is least, and where its mean derivative is zero."""
    x = np.asarray(factors)
    return {
        name: {
            spp: {"least": least(x, v[..., 0].mean(axis=1)), "stop": stop(x, v[..., 1].mean(axis=1))}
            for spp, v in entry.items()
        }
        for name, entry in values.items()
    }


def least(x: np.ndarray, y: np.ndarray) -> float | None:
    """Where a curve is least, by a parabola through its lowest point's neighbours; None at an end."""
    n = int(np.argmin(y))
    if n in (0, len(x) - 1):
        return None
    a, b, _ = np.polyfit(x[n - 1 : n + 2], y[n - 1 : n + 2], 2)
    return float(-b / (2 * a))


def stop(x: np.ndarray, y: np.ndarray) -> float | None:
    """Where a derivative crosses from below 0 to above, so that a descent stops; None if it does not."""
    for n in range(len(x) - 1):
        if y[n] < 0 <= y[n + 1]:
            return float(x[n] - y[n] * (x[n + 1] - x[n]) / (y[n + 1] - y[n]))
    return None


def check(
    problem: ur.Problem, parameters: Tree, along: dict[str, np.ndarray], reference: np.ndarray, spp: int, runs: int
) -> dict[str, list[float]]:
    """The derivative along a direction by the library's own estimator: mean and standard error, per loss."""
    found: dict[str, list[float]] = {}
    for name, loss in LOSSES.items():
        view = ur.View(reference.astype(np.float32))
        posed = problem.replaced(views=[view], loss=loss)
        estimator = ur.PathGradient(spp=spp, adjoint_spp=spp)
        state, values = estimator.init(posed, parameters), []
        for run in range(runs):
            estimate, _ = estimator.estimate(posed, parameters, state, Key(run, 0, 99))
            parts = [np.sum(arrays.numpy(estimate.gradient[key]) * way) for key, way in along.items()]
            values.append(float(sum(parts)))
        found[name] = [float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))]
    return found


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
