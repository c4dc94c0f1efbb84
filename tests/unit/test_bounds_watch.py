"""Numbers that end at their bounds are told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer


def test_numbers_that_end_at_their_bounds_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """One whose best value is beyond its bound; not one within, one that began there, nor one without two ends. A texture at bounds of its
    own, not at the ends of its physical range, but for the least roughness: a run ended with most of a map there, in silence."""
    names = ("beyond", "within", "there", "open", "map", "physical", "rough")
    sizes = dict.fromkeys(names, 1) | {"map": 2, "physical": 2, "rough": 2}
    matrix = np.eye(10)[np.arange(48) % 10]  # each number has pixels of its own
    target = np.array([1.5, 0.5, 1.5, 1.5, 1.5, 0.5, 1.5, 1.5, -0.5, 1.5])
    values = {name: np.full(() if n == 1 else (n,), 0.4) for name, n in sizes.items()}
    renderer = AnalyticRenderer(values, matrix)
    infos = dict(renderer.parameters())
    infos |= {key: replace(infos[key], lowest=low, highest=1.0) for key, low in (("physical", 0.0), ("rough", 0.02))}
    monkeypatch.setattr(renderer, "parameters", lambda: infos)
    reference = (matrix @ target).reshape(4, 4, 3)
    parameters = [
        ur.Parameter(name, 1.0 if name == "there" else 0.4, bounds=(0.02 if name == "rough" else 0, 1))
        for name in names
        if name != "open"
    ]
    parameters.append(ur.Parameter("open", 0.4, bounds=(None, 1)))
    problem = ur.Problem(renderer, parameters, [ur.View(reference)], max_depth=1)
    result = ur.optimize(problem, ur.PathGradient(spp=4), ur.optimizers.Adam(0.05), steps=200)
    assert [line for line in result.warnings if "next to its bound" in line] == [
        f"parameter {key}: {ended}: if this is unexpected, try {wider}another seed or a lower learning_rate"
        for key, ended, wider in (
            ("beyond", "ended at 1, next to its bound 1", "wider bounds, "),
            ("map", "1 of 2 values ended next to its bound 1", "wider bounds, "),
            ("rough", "1 of 2 values ended next to its bound 0.02", ""),
        )
    ]
