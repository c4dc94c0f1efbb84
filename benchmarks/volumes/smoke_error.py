"""Errors of smoke's grids as far as an image determines them: the albedo of empty voxels shows in none."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Tree, arrays
from benchmarks.paths import truth as true_parameters

EXTINCTION, ALBEDO = (f"smoke.interior_medium.{name}.data" for name in ("sigma_t", "albedo"))


def measure(problem: ur.Problem) -> Callable[[Tree], dict[str, float]]:
    """ "both", and for the record extinction, scattering, and albedo over all voxels."""

    def fields(parameters: Any) -> dict[str, np.ndarray]:
        extinction, albedo = (np.asarray(arrays.numpy(parameters[key]), np.float64) for key in (EXTINCTION, ALBEDO))
        return {"extinction": extinction, "scattering": extinction * albedo, "albedo": albedo}

    truth = fields(true_parameters(problem))

    def errors(parameters: Tree) -> dict[str, float]:
        return {name: float(np.sqrt(np.mean((x - truth[name]) ** 2))) for name, x in fields(parameters).items()}

    start = errors(problem.initial())

    def relative(parameters: Tree) -> dict[str, float]:
        found = {name: error / start[name] for name, error in errors(parameters).items()}
        return {"both": (found["extinction"] + found["scattering"]) / 2, **found}

    return relative
