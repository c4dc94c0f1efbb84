"""What the four views that tests at the end render do not show is not undetermined. All in NumPy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.rendering.renderer import SampleRequest
from unrender.runs.map_uncertainty import uncertainty

SIDE = 8


class OfOneView(AnalyticRenderer):
    """Shows the unknown b in view 1 only."""

    def _paths(self, request: SampleRequest) -> Any:
        paths = super()._paths(request)
        count = SIDE * SIDE if request.pixels is None else len(request.pixels)
        sensors = np.full(count, request.sensor) if request.sensors is None else np.asarray(request.sensors)
        vars(paths)["seen"] = np.repeat(sensors == 1, 3)
        return paths

    def _images(self, parameters: Any, paths: Any) -> np.ndarray:
        a, b = self.matrix[self._rows(paths.pixels)].T
        linear = a * parameters["a"] + b * parameters["b"] * vars(paths)["seen"]
        images = linear * (1 + self.noise * paths.centred[0])
        return images.reshape(paths.groups, *((SIDE, SIDE) if paths.pixels is None else (len(paths.pixels),)), 3)

    def adjoint(self, parameters: Any, paths: Any, weights: Any) -> Any:
        a, b = self.matrix[self._rows(paths.pixels)].T
        factors = np.asarray(weights).reshape(paths.groups, -1) * (1 + self.noise * paths.centred[0])
        mean = factors.mean(axis=0)
        return {"a": np.asarray(mean @ a), "b": np.asarray(mean @ (b * vars(paths)["seen"]))}

    def image_batch(self, parameters: Any, request: SampleRequest) -> np.ndarray:
        states = [dict(zip(parameters, values, strict=True)) for values in zip(*parameters.values(), strict=True)]
        return np.concatenate([self._images(state, self._paths(replace(request, groups=1))) for state in states])


@pytest.mark.mitsuba
def test_a_number_that_one_of_many_views_shows_is_determined(tmp_path: Path) -> None:
    truth = {"a": np.array(0.7), "b": np.array(0.8)}
    matrix = np.random.default_rng(0).uniform(0.2, 1.0, (SIDE * SIDE * 3, 2))
    start = {"a": np.array(0.5), "b": np.array(0.5)}
    exact, renderer = (OfOneView(start, matrix, noise=noise, shape=(SIDE, SIDE), sensors=8) for noise in (0.0, 0.1))
    views = [ur.View(exact.image(truth, SampleRequest(sensor, 4, 0)).images[0], sensor) for sensor in range(8)]
    parameters = [ur.Parameter(key, bounds=(0, 1)) for key in truth]
    problem = ur.Problem(renderer, parameters, views, truth=truth)
    estimator, adam = ur.PathGradient(spp=4), ur.optimizers.Adam(0.02)
    result = ur.optimize(problem, estimator, adam, steps=150, run_directory=tmp_path)
    assert abs(result.parameters["b"] - 0.8) < 0.01
    assert list(result.undetermined) == ["b: no standard error: the views that are tested do not show it"]
    assert set(result.standard_error) == {"a"}
    found = uncertainty(problem, result)
    assert set(found.standard_error) == {"a"}
    assert found.missing == tuple(result.undetermined)
