"""The loss as a function that can be evaluated anywhere, and nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from unrender.core import arrays, checks, vectors
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import LOSSES, Estimate
from unrender.problem.bounds import project
from unrender.problem.problem import Problem
from unrender.rendering.renderer import SampleRequest


@dataclass(frozen=True)
class LossState:
    """Nothing is kept."""


@register
@dataclass(frozen=True)
class LossValues:
    """The loss at any points, and no derivative: for searches such as `optimizers.CMAES`.

    Every point of a step is rendered with the same random numbers. Unbiased for the expected loss of images with this noise.

    Args:
        spp: samples per pixel of a render, >= 1.
    """

    spp: int = 4

    def __post_init__(self):
        checks.integer("LossValues", "spp", self.spp, at_least=1)

    @property
    def provides(self) -> frozenset[str]:
        """The loss at any points."""
        return frozenset({LOSSES})

    def init(self, problem: Problem, parameters: Tree) -> LossState:
        """See `Estimator.init`. Raises `InputError` for a parameter that cannot be perturbed."""
        problem.renderer.select(list(parameters), None, derivatives=False)
        return LossState()

    def estimate(self, problem: Problem, parameters: Tree, state: LossState, key: Key) -> tuple[Estimate, LossState]:
        """See `Estimator.estimate`; the gradient is empty. `info`: "samples" (those that the optimizer asks for
        included), "images" per view."""
        box = BlackBox(problem, parameters, self.spp, key)
        return Estimate(box.here(), {}, losses=box.losses, info=box.info), state


class BlackBox:
    """The problem's loss at any points, all with the same random numbers.

    The loss at the parameters themselves is rendered once, beside the first points that are asked for: launches of small pictures cost
    as much as what is in them.

    Args:
        problem: whose renderer has selected the parameters (`Renderer.select`, `derivatives=False`).
        parameters: the current ones; they give keys and shapes.
        spp: samples per pixel.
        key: of the renders' random numbers.

    Attributes:
        info: for `Estimate.info`: "samples", the paths traced so far, and "images", each view's at the parameters themselves.
    """

    def __init__(self, problem: Problem, parameters: Tree, spp: int, key: Key):
        self.problem, self.parameters, self.spp, self.key = problem, parameters, spp, key
        self.info: dict[str, Any] = {"samples": 0}
        self._theta = vectors.ravel(parameters)
        self._here: float | None = None

    def losses(self, points: np.ndarray) -> np.ndarray:
        """(B, n), all parameters flattened in key order, to (B,). Points outside the bounds count as the nearest inside.

        Unbiased for the expected loss of images with this noise.
        """
        if len(points) == 1 and np.array_equal(points[0], self._theta):
            return np.array([self.here()])
        if self._here is not None:
            return self._losses(points)[0]
        return self._with_here(points)[1:]

    def here(self) -> float:
        """The loss at the parameters themselves."""
        if self._here is None:
            self._with_here(np.empty((0, self._theta.size)))
        assert self._here is not None
        return self._here

    def _with_here(self, points: np.ndarray) -> np.ndarray:
        losses, images = self._losses(np.concatenate([self._theta[None], points]))
        self.info["images"] = {view: image[0] for view, image in images.items()}
        self._here = float(losses[0])
        return losses

    def _losses(self, points: np.ndarray) -> tuple[np.ndarray, dict[int, Any]]:
        renderer, bounds = self.problem.renderer, self.problem.bounds
        stacked = {key: project(x, *bounds[key]) for key, x in vectors.parts(points, self.parameters).items()}
        images, parts = {}, []
        for index, view in enumerate(self.problem.views):
            request = SampleRequest(view.sensor, self.spp, self.key.fold(index).uint32())
            images[index] = renderer.image_batch(stacked, request)
            parts.append(self.problem.loss_values(index, images[index]))
            height, width = renderer.resolutions()[view.sensor]
            self.info["samples"] += len(points) * self.spp * height * width
        arrays.evaluate(parts)
        return np.stack([arrays.numpy(part).astype(np.float64) for part in parts]).sum(axis=0), images
