"""Brute-force debiasing of a loss derivative (RCV Eq. 14): an ablation, which renders many times what it saves.

⟨∂L⟩ = ∂L(I) + ∂L(E[I]) − E[∂L(I)] for an image I: the last two terms are the bias that the noise of I gives its derivative, with the
opposite sign. Both expectations are means over independent renders at the same parameters, so what is left of the bias is that of the
mean of all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import unrender as ur
from benchmarks.internals import Estimate, FullView, Key, PlainState, Tree, arrays, leave_one_out_groups, prepare, trees


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
