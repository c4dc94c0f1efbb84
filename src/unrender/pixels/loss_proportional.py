"""Pixels drawn in proportion to the size of the loss derivative: the scheme before the adaptive one (Su and Gkioulekas 2024)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unrender.keys import Key
from unrender.pixels.base import Pick
from unrender.pixels.cells import Cells
from unrender.pixels.refreshed import Clean, MapDenoiser, Maps, RefreshedState, Refreshing
from unrender.problem.problem import Problem
from unrender.trees import Tree


@dataclass(frozen=True)
class LossProportional:
    """p_j ∝ |∂L/∂I_j| (Eq. 5 of the paper of `Adaptive`): how much a pixel counts, but not how noisy or how telling it is.

    Args:
        count, refresh, samples, uniform, stratified, denoiser: see `Adaptive`.
    """

    count: int
    refresh: int = 20
    samples: int | None = None
    uniform: float = 0.1
    stratified: bool = True
    denoiser: MapDenoiser = "auto"

    def __post_init__(self):
        self._refreshing.check()

    @property
    def _refreshing(self) -> Refreshing:
        return Refreshing(
            "LossProportional",
            self.count,
            self.refresh,
            self.samples,
            self.uniform,
            self.stratified,
            self.denoiser,
            levels=0,
            moments=False,
            make=lambda seen: (seen.sizes[0],),
            density=_density,
        )

    def init(self, problem: Problem, parameters: Tree) -> RefreshedState:
        """See `PixelSampler.init`."""
        del parameters
        return self._refreshing.init(problem)

    def draw(self, problem: Problem, parameters: Tree, state: RefreshedState, key: Key) -> tuple[Pick, RefreshedState]:
        """See `PixelSampler.draw`."""
        return self._refreshing.draw(problem, parameters, state, key)

    def observe(self, problem: Problem, state: RefreshedState, gradient: Tree) -> RefreshedState:
        """Nothing to learn from."""
        del problem, gradient
        return state


def _density(cells: Cells, maps: Maps, clean: Clean) -> np.ndarray:
    del cells
    return clean(maps[0]).sum(axis=1)
