"""Bias and variance of a loss derivative by the image that it is taken at (RCV Figs 7 and 10), with Eq. 14 as an ablation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.debiasing import bias_correction
from benchmarks.internals import Key, SampleRequest, Tree, arrays, prepare
from benchmarks.moments import Moments, paired_bias
from benchmarks.paths import converged, follow
from unrender.losses import Loss

METHODS = ("plain", "debiased", "rcv")


def derivatives(
    problem: ur.Problem,
    path: Sequence[Tree],
    losses: Mapping[str, Loss],
    target: np.ndarray,
    spp: int,
    runs: int,
    renders: int,
    reference_spp: int,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The derivative by each pixel at the last parameters of a path: of a plain render, of one whose bias `renders` more renders tell, and
    of a control variate that took the whole path; less the derivative at a converged image.

    Args:
        target: the reference, (H, W, 3).
        spp: of every render.
        runs: independent, per method.

    Returns:
        {"losses": {name: {"scale", method: `paired_bias` and variance, relative to the scale}}, "image_variance_ratio"}, and maps
        (H, W), means over channels.
    """
    image = converged(problem, path[-1], reference_spp, seed=123_456).mean
    exact = {name: loss.derivative(image, target) for name, loss in losses.items()}
    moments = {(name, method): Moments() for name in losses for method in METHODS}
    variance = {method: Moments() for method in ("plain", "rcv")}
    maps = {f"{name}/reference": slope.mean(axis=-1) for name, slope in exact.items()}

    def keep(name: str, method: str, slope: np.ndarray) -> None:
        moments[name, method].add(slope - exact[name])
        maps.setdefault(f"{name}/{method}", slope.mean(axis=-1))

    for run in range(runs):
        images = {
            "plain": _last(problem, ur.images.Plain(), path[-1:], spp, run),
            "rcv": _last(problem, ur.images.RecursiveControlVariate(), path, spp, run),
        }
        more = _independent(problem, path[-1], spp, renders, run)
        for method, noisy in images.items():
            variance[method].add(noisy)
            for name, loss in losses.items():
                keep(name, method, loss.derivative(noisy, target))
        for name, loss in losses.items():
            correction = bias_correction(lambda x, loss=loss: loss.derivative(x, target), more)
            keep(name, "debiased", loss.derivative(images["plain"], target) + correction)
    result: dict[str, Any] = {}
    for name, slope in exact.items():
        scale = float(np.abs(slope).mean())
        result[name] = {"scale": scale}
        for method in METHODS:
            found = moments[name, method]
            result[name][method] = {**paired_bias(found, scale), "variance": float(found.variance.mean() / scale**2)}
            maps[f"{name}/{method}/bias"] = found.mean.mean(axis=-1)
    gain = float(variance["plain"].variance.sum() / variance["rcv"].variance.sum())
    return {"losses": result, "image_variance_ratio": gain}, maps


def _last(problem: ur.Problem, estimator: Any, path: Sequence[Tree], spp: int, run: int) -> np.ndarray:
    *_, last = follow(problem, estimator, path, spp, run)
    return arrays.numpy(last.mean()).astype(np.float64)


def _independent(problem: ur.Problem, parameters: Tree, spp: int, renders: int, run: int) -> np.ndarray:
    request = SampleRequest(problem.views[0].sensor, spp * renders, Key(run, 0, 14).uint32(), renders)
    return arrays.numpy(prepare(problem, parameters).image(parameters, request).images).astype(np.float64)
