"""How much images tell of each element: against the matrix of linear images, and a planted fault."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.core.errors import InputError
from unrender.runs import image_sensitivity as module
from unrender.runs.image_sensitivity import insensitive, sensitivity
from unrender.runs.map_uncertainty import uncertainty
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem
from unrender.scene.references import View

SHAPE, TEXTURE = (8, 8), (4, 3, 2)
MATRIX = np.random.default_rng(0).random((8 * 8 * 3, 24)) * np.geomspace(0.001, 3.0, 24)


def problem(noise: float = 1.0, views: int = 2) -> Problem:
    truth = {"wall": np.full(TEXTURE, 0.5)}
    renderer = AnalyticRenderer(truth, MATRIX, 0.1, noise, shape=SHAPE, sensors=views)
    given = [View(renderer.exact(truth), sensor=view) for view in range(views)]
    return Problem(renderer, [Parameter("wall", initial=0.4, bounds=(0, 1))], given, truth=truth)


def z_score(probes: int = 2000) -> np.ndarray:
    """Of the mean square over elements, each in units of its expectation, with the spread over ten runs."""
    expected = 2 * (MATRIX**2).sum(axis=0).reshape(TEXTURE)
    found = [
        sensitivity(problem(), probes=probes // 10, spp=1, seed=seed)["wall"] ** 2 / expected for seed in range(10)
    ]
    means = np.array([each.mean() for each in found])
    return (means.mean() - 1) / (means.std(ddof=1) / np.sqrt(len(means)))


def test_it_is_the_root_of_the_sum_of_squares_over_pixels_of_all_views():
    exact = np.sqrt(2 * (MATRIX**2).sum(axis=0)).reshape(TEXTURE)
    found = sensitivity(problem(noise=0.0), probes=1000)["wall"]
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, exact, rtol=0.1)
    assert abs(z_score()) < 4


def test_noise_of_the_adjoint_would_be_counted_without_separate_paths(monkeypatch: pytest.MonkeyPatch):
    """Planted: both factors on the same paths, whose product has the variance of the derivative in it."""
    real = module._projections

    def same(problem: Problem, session: Any, parameters: Any, keys: Any, spp: int, key: Any, half: int, *more: Any):
        return real(problem, session, parameters, keys, spp, key, 0, *more)

    monkeypatch.setattr(module, "_projections", same)
    assert z_score(2000) > 8


@pytest.mark.parametrize("rows", [4, 9])
def test_cells_that_no_pixel_sees_are_hardly_seen(rows: int):
    """Those beside seen ones too, and those that bounced light alone shows, even if they are most. One that noise has made 0 among seen
    ones is seen."""
    expected = np.zeros((12, 9), bool)
    expected[:rows] = True
    for bounced in (0.0, 0.07):
        found = np.ones((12, 9, 3), np.float32)
        found[:rows] = bounced
        found[10, 5] = 0.0
        np.testing.assert_array_equal(insensitive(found), expected)
    assert insensitive(np.zeros((2, 2, 3))).all()


@pytest.mark.parametrize("share", [0.02, 0.1, 1.0])
def test_paths_that_are_fewer_than_the_cells_do_not_make_seen_ones_unseen(share: float) -> None:
    draw = np.random.default_rng(0)
    values = draw.uniform(0.5, 2.0, (128, 96, 3)) * (draw.random((128, 96, 1)) < share)
    values[:, 48:] = 0.0
    assert 1.0 - insensitive(values).mean() == pytest.approx(0.5, abs=0.08)


def test_time_ends_it_after_one_probe(monkeypatch: pytest.MonkeyPatch):
    counts: list[int] = []
    real = module._projections

    def counted(*arguments: Any) -> Any:
        counts.append(1)
        return real(*arguments)

    monkeypatch.setattr(module, "_projections", counted)
    sensitivity(problem(), seconds=0.0)
    assert len(counts) == 2


@pytest.mark.parametrize(
    ("function", "given", "message"),
    [
        *(
            (function, given, message)
            for function in (sensitivity, uncertainty)
            for given, message in (
                ({"problem": "wall"}, "expected a Problem, such as that of Problem.from_file, got 'wall'"),
                ({"values": "out"}, "parameters: expected values by key of the problem's unknowns, got 'out'"),
                ({"values": {"wall": np.zeros((2, 2, 2))}}, "parameter wall: expected shape"),
                ({"seconds": "long"}, "seconds must be a number, got 'long'"),
                ({"seconds": 10**400, "seed": "first"}, "seed: expected a whole number"),
                ({"seed": "first"}, "seed: expected a whole number"),
            )
        ),
        (sensitivity, {"probes": 0}, "probes must be a whole number of at least 1"),
        (sensitivity, {"views": 0}, "views must be a whole number of at least 1, got 0"),
        (uncertainty, {"values": None}, r"parameters: expected \['wall'\], got \[\]"),
        (uncertainty, {"values": {"wall": np.full(TEXTURE, np.nan)}}, "parameter wall: expected finite numbers"),
        (uncertainty, {"values": {"wall": np.full(TEXTURE, "0.5")}}, "parameter wall: expected finite numbers"),
        (uncertainty, {"values": {"wall": np.full(TEXTURE, 128, np.uint8)}}, "parameter wall: expected linear values"),
        (uncertainty, {"values": {"wall": [[1, 2], [3]]}}, "parameter wall: .*, got rows of different lengths$"),
    ],
)
def test_refuses_what_makes_no_sense(function: Any, given: dict[str, Any], message: str):
    """Most were tracebacks. Of values that are not finite it was said that no picture depends on them."""
    with pytest.raises(InputError, match=message):
        function(**({"problem": problem(), "values": {"wall": np.full(TEXTURE, 0.5)}} | given))
    assert ur.runs.sensitivity is sensitivity
