"""The loss as a function that can be evaluated anywhere, and nothing else."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from unrender import arrays
from unrender.keys import Key
from unrender.problem.bounds import project
from unrender.problem.problem import Problem
from unrender.rendering.port import Shot
from unrender.trees import Tree


class BlackBox:
    """The problem's loss at any points, all with the same random numbers.

    Args:
        problem: whose renderer has selected the parameters (`Renderer.select`, `derivatives=False`).
        parameters: the current ones; they give keys and shapes.
        spp: samples per pixel.
        key: of the renders' random numbers.

    Attributes:
        samples: paths traced so far.
    """

    def __init__(self, problem: Problem, parameters: Tree, spp: int, key: Key):
        self.problem, self.parameters, self.spp, self.key = problem, parameters, spp, key
        self.samples = 0

    def losses(self, points: np.ndarray) -> np.ndarray:
        """(B, n), all parameters flattened in key order, to (B,). Points outside the bounds count as the nearest inside.

        Unbiased for the expected loss of images with this noise.
        """
        return self._losses(points)[0]

    def here(self) -> tuple[float, dict[int, Any]]:
        """The loss at the parameters themselves, and each view's image (H, W, 3)."""
        point = np.concatenate([arrays.numpy(x).ravel() for x in self.parameters.values()])
        losses, images = self._losses(point[None])
        return float(losses[0]), {view: arrays.mean_first(image) for view, image in images.items()}

    def _losses(self, points: np.ndarray) -> tuple[np.ndarray, dict[int, Any]]:
        renderer, stacked, start = self.problem.renderer, {}, 0
        for key, x in self.parameters.items():
            shape = arrays.shape(x)
            size = math.prod(shape)
            part = points[:, start : start + size].reshape(len(points), *shape)
            stacked[key] = project(part, *self.problem.bounds[key])
            start += size
        images, parts = {}, []
        for index, view in enumerate(self.problem.views):
            shot = Shot(view.sensor, self.spp, self.key.fold(index).uint32())
            images[index] = renderer.image_batch(stacked, shot)
            parts.append(self.problem.loss_values(index, images[index]))
            height, width = renderer.resolutions()[view.sensor]
            self.samples += len(points) * self.spp * height * width
        arrays.evaluate(parts)
        return np.stack([arrays.numpy(part).astype(np.float64) for part in parts]).sum(axis=0), images
