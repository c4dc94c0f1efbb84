"""Errors of rendered pictures, free of the renderings' noise."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Key, SampleRequest, Tree, arrays, prepare
from unrender.statistics import debiased

Pair = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Two independent renderings, and the reference, (H, W, C) each."""


def picture_error(pairs: Iterable[Pair]) -> float:
    """Return the root mean square error over pictures of equal size (`debiased.rmse`)."""
    one, two, reference = (np.concatenate(each) for each in zip(*pairs, strict=True))
    return debiased.rmse(one, two, reference)[0]


def views_error(problem: ur.Problem, values: Mapping[str, np.ndarray], spp: int) -> float:
    """Return the `picture_error` of all views with these values of the unknowns, from two renderings of `spp` samples per pixel."""

    def pair(index: int) -> Pair:
        one, two = (ur.render(problem, values, index, spp=spp, seed=seed) for seed in (1, 2))
        return one, two, np.asarray(problem.views[index].reference)

    return picture_error(map(pair, range(len(problem.views))))


class ImageErrors:
    """How far renders of groups of views are from their references, relative to the start.

    Args:
        made: `nerf-volume` with all views.
        options: that it was made with.
        groups: numbers of views by name.
        spp: of two renders.
    """

    def __init__(self, made: ur.Problem, options: dict[str, Any], groups: Mapping[str, Sequence[int]], spp: int):
        own = ur.gallery.problem("nerf-volume", **{**options, "reference_spp": 1})
        self.session, self.groups, self.spp = prepare(own, made.initial()), groups, spp
        self.views, self.array = made.views, made.renderer.array
        self.start = self.errors(made.initial())

    def __call__(self, parameters: Tree) -> dict[str, float]:
        return {name: error / self.start[name] for name, error in self.errors(parameters).items()}

    def errors(self, parameters: Tree) -> dict[str, float]:
        """Root mean square over each group's views."""
        parameters = {key: self.array(value) for key, value in parameters.items()}

        def pair(number: int) -> Pair:
            request = SampleRequest(self.views[number].sensor, self.spp, Key(424_242, number).uint32(), 2)
            one, two = arrays.numpy(self.session.image(parameters, request).images)
            return one, two, np.asarray(self.views[number].reference)

        return {name: picture_error(map(pair, group)) for name, group in self.groups.items()}
