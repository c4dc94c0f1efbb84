"""Weights and images of a control variate along a path of parameters, and how images vary between runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from along import follow

import unrender as ur
from unrender.core import arrays
from unrender.core.trees import Tree


def track(problem: ur.Problem, path: Sequence[Tree], spp: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Images and weights (0 at the first step) of one run of `RecursiveControlVariate`, (steps, H, W, 3) each."""
    found = list(follow(problem, ur.images.RecursiveControlVariate(), path, spp, seed))
    used = [arrays.numpy(estimate.info["control_weight"]) for estimate in found[1:]]
    images = np.stack([arrays.numpy(estimate.mean()) for estimate in found]).astype(np.float64)
    return images, np.stack([np.zeros_like(used[0]), *used])


def squares(stack: np.ndarray) -> np.ndarray:
    """(runs, steps) of images (runs, steps, H, W, 3): sums over pixels, whose mean over runs is the summed variance between runs."""
    runs = len(stack)
    return np.square(stack - stack.mean(axis=0)).sum(axis=(2, 3, 4)) * runs / (runs - 1)
