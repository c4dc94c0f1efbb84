"""Errors of images of a problem without a truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Key, SampleRequest, Tree, arrays, prepare


class ImageErrors:
    """How far renders of groups of views are from their references, relative to the start.

    They are free of rendering noise: products of two independent renders' differences.

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
        found, parameters = {}, {key: self.array(value) for key, value in parameters.items()}
        for name, group in self.groups.items():
            squares = []
            for number in group:
                request = SampleRequest(self.views[number].sensor, self.spp, Key(424_242, number).uint32(), 2)
                images = arrays.numpy(self.session.image(parameters, request).images).astype(np.float64)
                a, b = images - np.asarray(self.views[number].reference, np.float64)
                squares.append(float(np.mean(a * b)))
            found[name] = max(float(np.mean(squares)), 0.0) ** 0.5
        return found
