"""Numbers that end at their bounds are told."""

from __future__ import annotations

import numpy as np

import unrender as ur
from tests.analytic import AnalyticRenderer


def test_numbers_that_end_at_their_bounds_are_told() -> None:
    """One whose best value is beyond its bound; not one within, one that began there, one without two ends, nor a texture."""
    names = ("beyond", "within", "there", "open", "map")
    sizes = dict.fromkeys(names, 1) | {"map": 2}
    matrix = np.eye(6)[np.arange(48) % 6]  # each number has pixels of its own
    target = np.array([1.5, 0.5, 1.5, 1.5, 1.5, 1.5])
    values = {name: np.full(() if n == 1 else (n,), 0.4) for name, n in sizes.items()}
    renderer = AnalyticRenderer(values, matrix)
    reference = (matrix @ target).reshape(4, 4, 3)
    parameters = [
        ur.Parameter(name, 1.0 if name == "there" else 0.4, bounds=(0, 1)) for name in names if name != "open"
    ]
    parameters.append(ur.Parameter("open", 0.4, bounds=(None, 1)))
    problem = ur.Problem(renderer, parameters, [ur.View(reference)], max_depth=1)
    result = ur.optimize(problem, ur.PathGradient(spp=4), ur.optimizers.Adam(0.05), steps=200)
    assert [line for line in result.warnings if "next to its bound" in line] == [
        "parameter beyond: ended at 1, next to its bound 1: if this is unexpected, try another seed or a lower learning_rate"
    ]
