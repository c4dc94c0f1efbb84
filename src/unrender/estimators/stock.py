"""Gradient of a standard Mitsuba optimisation loop, as a baseline."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

from unrender.core import arrays, checks, trees
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient
from unrender.estimators.path import PathGradient, PathGradientState
from unrender.rendering.renderer import StockRenderer
from unrender.scene.problem import Problem


@dataclass(frozen=True)
class StockState:
    """State between steps.

    Attributes:
        path: state of the path gradient that replaces it; None if the renderer has a stock loop.
    """

    path: PathGradientState | None = None


@register
@dataclass(frozen=True)
class StockGradient:
    """The gradient of a standard Mitsuba loop: `mi.render` of each view, the loss, `dr.backward`, with independent samples for image
    and adjoint.

    With `optimizers.Adam`, whose steps are those of `mi.ad.Adam`, it is the loop of Mitsuba's tutorials. Neighbouring pixels share
    samples, as in Mitsuba's film; elsewhere in `unrender` each pixel has its own samples. For renderers other than Mitsuba, it is
    `PathGradient(spp=spp, adjoint_spp=spp)`, which estimates the same from the same number of samples.

    Unbiased for a loss whose derivative is linear in the image; otherwise biased by the image's noise.

    Args:
        spp: samples per pixel and view of the image, and again of the adjoint, >= 1.
    """

    spp: int = 16

    def __post_init__(self):
        checks.integer("StockGradient", "spp", self.spp, at_least=1)

    provides = Capabilities(Gradient)

    def init(self, problem: Problem, parameters: Tree) -> StockState:
        """Return the state before the first step. Raise `InputError` for a parameter that Mitsuba cannot differentiate."""
        problem.renderer.prepare(list(parameters), None)
        known = problem.renderer.parameters()
        if camera := next((key for key in parameters if known[key].viewpoint), ""):
            raise InputError(
                f"parameter {camera}: Mitsuba's loop has no gradient by the pose of a sensor; use --method plain"
            )
        if isinstance(problem.renderer, StockRenderer):
            return StockState()
        return StockState(self._path.init(problem, parameters))

    def estimate(self, problem: Problem, parameters: Tree, state: StockState, key: Key) -> tuple[Estimate, StockState]:
        """Return an estimate and the next state. `info`: "samples" (paths traced for images and adjoints), "images" per view."""
        renderer = problem.renderer
        if state.path is not None or not isinstance(renderer, StockRenderer):
            path = state.path or self._path.init(problem, parameters)
            estimate, path = self._path.estimate(problem, parameters, path, key)
            return estimate, StockState(path)
        loop = renderer.stock()
        parts, losses, images, samples = [], [], {}, 0
        for index, view in enumerate(problem.views):
            seeds = key.fold(index).fold(0).uint32(), key.fold(index).fold(1).uint32()
            images[index], gradient = loop.gradient(
                parameters,
                view.sensor,
                self.spp,
                seeds,
                lambda image, index=index: problem.loss_derivative(index, image),
            )
            losses.append(problem.loss_value(index, images[index]))
            height, width = renderer.resolutions()[view.sensor]
            samples += 2 * self.spp * height * width
            parts.append(gradient)
        total = reduce(trees.add, parts)
        arrays.evaluate(total, losses)
        loss = sum(arrays.number(value) for value in losses)
        return Estimate(loss, total, info={"samples": samples, "images": images}), state

    @property
    def _path(self) -> PathGradient:
        return PathGradient(spp=self.spp, adjoint_spp=self.spp)
