"""Bias and variance of a loss derivative by the image that it is taken at (RCV Figs 7 and 10), with Eq. 14 as an ablation.

⟨∂L⟩ = ∂L(I) + ∂L(E[I]) − E[∂L(I)] for an image I (RCV Eq. 14): the last two terms are the bias that the noise of I gives its derivative,
with the opposite sign. Both expectations are means over independent renders at the same parameters, so what is left of the bias is that of
the mean of all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import (
    Estimate,
    FullView,
    Key,
    PlainState,
    SampleRequest,
    Tree,
    arrays,
    leave_one_out_groups,
    prepare,
    trees,
)
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


def bias_correction(derivative: Callable[[Any], Any], images: Any) -> Any:
    """∂L(mean of the images) − mean of ∂L of each, (H, W, 3): what Eq. 14 adds to the derivative at another such image.

    Args:
        derivative: of the loss, by images (..., H, W, 3).
        images: (N, H, W, 3), independent, N >= 2.
    """
    return derivative(arrays.mean_over_first(images)) - arrays.mean_over_first(derivative(images))


@dataclass(frozen=True)
class DebiasedGradient:
    """`unrender.PathGradient(spp=spp)` with the bias of its loss derivative subtracted, Eq. 14.

    Biased still, as a plain gradient at `renders` times as many samples is. Its variance is a plain gradient's and, for the noise of the
    subtracted term, about 1 / `renders` more.

    Args:
        spp: samples per pixel, in leave-one-out groups: at least two, so neither 1 nor a prime above 16.
        renders: independent images for the expectations, each of as many samples as a group's image of all others, >= 2.
    """

    spp: int = 2
    renders: int = 64

    def __post_init__(self):
        if leave_one_out_groups(self.spp) < 2 or self.renders < 2:
            raise ValueError(f"DebiasedGradient: no groups of {self.spp} samples, or too few renders: {self.renders}")

    @property
    def provides(self) -> ur.protocols.Capabilities:
        """A gradient."""
        return ur.protocols.Capabilities(ur.protocols.Gradient)

    def init(self, problem: ur.Problem, parameters: Tree) -> PlainState:
        prepare(problem, parameters)
        return PlainState()

    def estimate(
        self, problem: ur.Problem, parameters: Tree, state: PlainState, key: Key
    ) -> tuple[Estimate, PlainState]:
        session, groups = prepare(problem, parameters), leave_one_out_groups(self.spp)
        size = self.spp - self.spp // groups
        gradients, losses, samples = [], [], 0
        for view in range(len(problem.views)):
            frame, of_view = FullView(problem, view), key.fold(view)
            found, _ = ur.images.Plain().estimate(problem, parameters, state, frame, self.spp, groups, of_view.fold(0))
            more = frame.request(size * self.renders, of_view.fold(1).uint32(), self.renders)
            correction = bias_correction(frame.loss_derivative, session.image(parameters, more).images)
            weights = frame.loss_derivative(found.others()) + arrays.add_first_axis(correction)
            gradients.append(session.adjoint(parameters, found.paths, weights))
            losses.append(frame.loss_value(found.mean()))
            samples += (self.spp + more.spp) * frame.pixels
        gradient = trees.map(lambda *each: sum(each[1:], each[0]), *gradients)
        arrays.evaluate(gradient, losses)
        loss = sum(arrays.number(value) for value in losses)
        return Estimate(loss, gradient, info={"samples": samples}), state
