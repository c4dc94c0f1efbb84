"""The loss as a function of the parameters, without derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from unrender.core import arrays, checks, trees
from unrender.core.arrays import Array
from unrender.core.checks import Count
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, LossFunction
from unrender.rendering.renderer import RenderSession, SampleRequest
from unrender.scene.problem import Problem


@dataclass(frozen=True)
class LossState:
    """Empty state."""


@register
@dataclass(frozen=True)
class LossValues(checks.Checked):
    """The loss at any points, without derivatives: for searches such as `optimizers.CMAES`.

    Every point of a step is rendered with the same random numbers. Unbiased for the expected loss of images with this noise.

    Args:
        spp: samples per pixel of a render, >= 1.
    """

    spp: Count = 4

    provides = Capabilities(LossFunction)

    def init(self, problem: Problem, parameters: Tree) -> LossState:
        """Return the empty state. Raise `InputError` for a parameter that cannot be perturbed."""
        problem.renderer.prepare(list(parameters), None, derivatives=False)
        return LossState()

    def estimate(self, problem: Problem, parameters: Tree, state: LossState, key: Key) -> tuple[Estimate, LossState]:
        """Return an estimate with an empty gradient. `info`: "samples" (including those of the optimizer's evaluations), "images" per
        view."""
        box = BlackBox(problem, parameters, self.spp, key)
        return Estimate(box.center(), {}, (LossFunction(box.losses),), box.info), state


class BlackBox:
    """The problem's loss at any points, all with the same random numbers.

    The loss at the parameters is rendered once, in one batch with the first requested points: for small images the overhead of a launch
    exceeds the cost of rendering.

    Args:
        problem: problem whose loss is evaluated.
        parameters: current parameters; they determine keys and shapes.
        spp: samples per pixel.
        key: random key of the renders.
        debiased: whether to remove the bias of the loss by image noise, see `SmoothedDerivatives`.

    Attributes:
        info: values for `Estimate.info`: "samples", the paths traced so far, and "images", each view's at the parameters.
    """

    def __init__(self, problem: Problem, parameters: Tree, spp: int, key: Key, debiased: bool = False):
        self.problem, self.parameters, self.spp, self.key = problem, parameters, spp, key
        self.debiased = debiased
        self.info: dict[str, Any] = {"samples": 0}
        self._theta = trees.ravel(parameters)
        self._center: float | None = None

    def losses(self, points: np.ndarray) -> np.ndarray:
        """Return the loss at points (B, n), all parameters flattened in key order, as (B,). Points are projected onto the bounds.

        Unbiased for the expected loss of images with this noise.
        """
        if len(points) == 1 and np.array_equal(points[0], self._theta):
            return np.array([self.center()])
        if self._center is not None:
            return self._evaluate(points)[0]
        return self._evaluate_with_center(points)[1][1:]

    def center(self) -> float:
        """Return the loss at the parameters."""
        if self._center is None:
            return self._evaluate_with_center(np.empty((0, self._theta.size)))[0]
        return self._center

    def _evaluate_with_center(self, points: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the loss at the parameters, and at the parameters and `points` (B, n) in one array (1 + B,)."""
        losses, images = self._evaluate(np.concatenate([self._theta[None], points]))
        self.info["images"] = {view: image[0] for view, image in images.items()}
        self._center = float(losses[0])
        return self._center, losses

    def _evaluate(self, points: np.ndarray) -> tuple[np.ndarray, dict[int, Any]]:
        """Return the losses (B,) and, per view, the images (B, H, W, 3)."""
        renderer, unknowns = self.problem.renderer, self.problem.unknowns
        session = renderer.prepare(list(self.parameters), None, derivatives=False)
        stacked = {key: unknowns[key].project(x) for key, x in trees.parts(points, self.parameters).items()}
        images, parts = {}, []
        for index, view in enumerate(self.problem.views):
            request = SampleRequest(view.sensor, self.spp, self.key.fold(index).uint32())
            images[index], values = self._view(session, stacked, request, index)
            parts.append(values)
            height, width = renderer.resolutions()[view.sensor]
            self.info["samples"] += len(points) * self.spp * height * width
        arrays.evaluate(parts)
        return np.stack([arrays.numpy(part).astype(np.float64) for part in parts]).sum(axis=0), images

    def _view(self, session: RenderSession, states: Tree, request: SampleRequest, view: int) -> tuple[Array, Array]:
        """Return the images (B, H, W, 3) of a view, and their contribution to the losses (B,)."""
        if not self.debiased:
            images = session.image_batch(states, request)
            return images, self.problem.loss_values(view, images)
        first = request.spp // 2
        a = session.image_batch(states, replace(request, spp=first))
        b = session.image_batch(states, replace(request, spp=request.spp - first, seed=_other(request.seed)))
        share = first / request.spp
        images = a * share + b * (1.0 - share)
        loss_of_halves = self.problem.loss_values(view, a) * share + self.problem.loss_values(view, b) * (1.0 - share)
        # Let Q be the quadratic loss of the noise of one sample. The loss of the mean of n samples is L + Q / n, that of the halves
        # L + 2 Q / n.
        return images, self.problem.loss_values(view, images) * 2.0 - loss_of_halves


def _other(seed: int) -> int:
    """Return the seed of independent random numbers."""
    return Key(seed, 1).uint32()
