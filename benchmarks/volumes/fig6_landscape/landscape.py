"""A loss and its derivative along one line through parameter space, estimated from noisy renders (RCV Fig. 6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

import unrender as ur
from benchmarks.internals import Key, SampleRequest, Tree, arrays, prepare
from benchmarks.moments import Moments
from benchmarks.suite.scenes import LOSSES

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
