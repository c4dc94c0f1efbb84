"""Priors of unknowns: derivatives, the noise of references, closed forms of posterior estimates, and input that is wrong."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.core import periodic, tables
from unrender.core.errors import InputError
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import (
    BlockEstimate,
    FreshGradient,
    Hessian,
    HessianProduct,
    LossFunction,
)
from unrender.estimators.penalties import penalized, penalty
from unrender.io import toml_lines
from unrender.methods import method
from unrender.preconditioners.mesh import MeshTopology
from unrender.scene.fingerprint import fingerprint
from unrender.scene.prior import Prior
from unrender.scene.references import likelihood_scale, standard_deviation

SIDE, SIZE = 16, 3
TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]), np.array([[0, 1, 2], [0, 1, 3], [1, 2, 3]])

TERMS: dict[str, dict[str, Any]] = {
    "near": {"near": 0.4, "std": 0.3},
    "near a colour": {"near": [0.2, 0.4, 0.6], "std": 0.3},
    "near the start": {"near": "initial", "std": 0.3},
    "palette": {"palette": [[0.0, 0.1, 0.2], [0.9, 0.8, 1.0]], "std": 0.2},
    "smoothness": {"smoothness": 0.2},
    "total variation": {"total_variation": 0.3},
    "all": {"near": 0.4, "palette": [[0.5] * 3], "std": 0.3, "smoothness": 0.2, "total_variation": 0.3, "weight": 2.0},
}
SHAPES = {"texture": (4, 5, 3), "volume": (3, 2, 4, 3), "colour": (3,), "vertices": (12,)}
OF_NEIGHBOURS = ("smoothness", "total variation", "all")


def bound(terms: dict[str, Any], shape: str, x: np.ndarray) -> Prior:
    topology = MeshTopology.of(*TETRAHEDRON, welded=False) if shape == "vertices" else None
    return Prior(**terms).on(x, 0, topology)


CASES = [(terms, shape) for terms in TERMS for shape in SHAPES if not (terms in OF_NEIGHBOURS and shape == "colour")]


@pytest.mark.parametrize(("terms", "shape"), CASES)
def test_the_gradient_is_that_of_the_value_and_the_product_bounds_its_slope(terms: str, shape: str) -> None:
    generator = np.random.default_rng(3)
    x, v = generator.random(SHAPES[shape]), generator.normal(size=SHAPES[shape])
    prior = bound(TERMS[terms], shape, generator.random(SHAPES[shape]))
    _, gradient = prior.evaluate(x)
    step = 1e-5
    ends = [prior.evaluate(x + sign * step * v) for sign in (1, -1)]
    assert gradient.shape == x.shape
    assert (ends[0][0] - ends[1][0]) / (2 * step) == pytest.approx(np.vdot(gradient, v), rel=1e-5)
    curvature = np.vdot(v, ends[0][1] - ends[1][1]) / (2 * step)
    product = np.vdot(v, prior.product(x, v))
    if terms in ("total variation", "all"):
        assert product >= curvature - 1e-6 * abs(curvature)
    else:
        assert product == pytest.approx(curvature, rel=1e-5)


def test_a_planted_factor_of_three_per_cent_in_a_gradient_is_caught() -> None:
    x, v = np.random.default_rng(0).random((2, 4, 5, 3))
    prior = bound(TERMS["smoothness"], "texture", x)
    difference = prior.evaluate(x + 1e-5 * v)[0] - prior.evaluate(x - 1e-5 * v)[0]
    assert difference / 2e-5 != pytest.approx(1.03 * np.vdot(prior.evaluate(x)[1], v), rel=1e-5)


def test_pairs_of_neighbours_are_counted_once() -> None:
    """A step of height h across a texture of 4 rows is 4 pairs; around an environment map, whose ends meet, it is 8."""
    x = np.zeros((4, 6, 1))
    x[:, 3:] = 0.5
    value, _ = Prior(smoothness=0.1).on(x).evaluate(x)
    assert value == pytest.approx(4 * 0.5**2 / (2 * 0.1**2))
    around = np.concatenate([x[:, -1:], x, x[:, :1]], axis=1)
    value, gradient = Prior(smoothness=0.1).on(around, repeated=1).evaluate(around)
    assert value == pytest.approx(8 * 0.5**2 / (2 * 0.1**2))
    assert (gradient[:, 0] == gradient[:, -2]).all()
    assert (gradient[:, -1] == gradient[:, 1]).all()


def test_a_value_and_a_palette_are_two_terms() -> None:
    x, colours = np.full(3, 0.5), [[0.9, 0.5, 0.5]]
    parts = [Prior(std=0.2, near=0.1).on(x), Prior(std=0.2, palette=colours).on(x)]
    both = Prior(std=0.2, near=0.1, palette=colours).on(x)
    assert both.evaluate(x)[0] == pytest.approx(sum(part.evaluate(x)[0] for part in parts))
    assert both.product(x, x) == pytest.approx(sum(part.product(x, x) for part in parts))


@pytest.mark.parametrize(("width", "repeated"), [(5, 1), (4, 1), (5, 0)])
def test_the_diagonal_is_that_of_the_products(width: int, repeated: int) -> None:
    """A map of an odd number of periodic columns has neighbours of equal parity."""
    x = periodic.pad(np.random.default_rng(2).random((3, width, 3)), repeated)
    prior = Prior(smoothness=0.2, total_variation=0.3).on(x, repeated)
    for row in range(3):
        for column in range(width):
            unit = np.zeros((3, width, 3))
            unit[row, column] = 1.0
            product = prior.product(x, periodic.pad(unit, repeated))[row, repeated + column]
            assert prior.diagonal(x)[row, repeated + column] == pytest.approx(product)


def test_expected_values_are_averaged_over_a_coarser_grid() -> None:
    full = np.arange(16.0).reshape(4, 4, 1)
    prior = Prior(near="initial", std=1.0).on(full)
    coarse = full.reshape(2, 2, 2, 2, 1).mean(axis=(1, 3))
    assert prior.evaluate(coarse)[0] == pytest.approx(0.0, abs=1e-12)


# ---------------------------------------------------------------------- the noise of references


@pytest.mark.parametrize("sigma", [0.01, 0.1])
def test_the_noise_of_a_picture_with_edges_is_estimated_within_ten_per_cent(sigma: float) -> None:
    rows, columns = np.mgrid[:64, :64] / 64
    picture = np.stack([rows + 0.5 * columns, (columns > 0.3) * 1.0, rows * rows], axis=-1)
    noisy = picture + np.random.default_rng(4).normal(0, sigma, picture.shape)
    assert standard_deviation(noisy) == pytest.approx(sigma, rel=0.1)
    noisy[:20] = np.nan
    mask = np.ones((64, 64))
    mask[40:] = 0
    assert standard_deviation(noisy, mask) == pytest.approx(sigma, rel=0.15)


def test_a_picture_without_noise_or_of_one_row_has_the_least() -> None:
    assert standard_deviation(np.full((8, 8, 3), 2.0)) == pytest.approx(2e-4)
    assert standard_deviation(np.ones((1, 8, 3))) == pytest.approx(1e-4)


def linear(
    prior: dict[str, Any] | None,
    sigma: float = 0.3,
    loss: ur.losses.Loss | None = None,
    weight: float = 1.0,
    **options: Any,
) -> tuple[ur.Problem, np.ndarray, np.ndarray]:
    """Pictures M x of SIZE numbers x, with noise of σ in the reference. Returns the problem, M, and the reference's values."""
    generator = np.random.default_rng(5)
    rows, columns, channels = (
        x.reshape(-1, 1) / size for x, size in zip(np.mgrid[:SIDE, :SIDE, :3], (SIDE, SIDE, 3), strict=True)
    )
    matrix, truth = 0.2 * np.concatenate([rows, columns, channels], axis=1), generator.random(SIZE)
    reference = matrix @ truth + generator.normal(0, sigma, len(matrix))
    renderer = AnalyticRenderer({"x": np.full(SIZE, 0.5)}, matrix, noise=1e-4, shape=(SIDE, SIDE))
    view = ur.View(reference.reshape(SIDE, SIDE, 3), weight=weight)
    unknown = ur.Parameter("x", prior=prior, **options)
    return ur.Problem(renderer, [unknown], [view], loss, truth={"x": truth}), matrix, reference


def test_the_scale_turns_a_loss_into_a_log_likelihood() -> None:
    """2 σ² / N of a mean square, b / N of a mean magnitude with the mean magnitude b, whatever the weight of the view."""
    sigma, count = 0.3, SIDE * SIDE * 3
    squares, magnitudes = (linear(None, sigma, loss)[0] for loss in (ur.losses.L2(), ur.losses.L1()))
    assert likelihood_scale(squares) == pytest.approx(2 * sigma**2 / count, rel=0.2)
    assert likelihood_scale(magnitudes) == pytest.approx(sigma * math.sqrt(2 / math.pi) / count, rel=0.1)
    weighted = linear(None, sigma, weight=7.0)[0]
    assert likelihood_scale(weighted) == pytest.approx(7 * likelihood_scale(squares), rel=1e-5)


def test_a_grey_picture_has_one_value_per_pixel() -> None:
    """It counted as three with independent noise, so that priors had a third of their weight."""
    _, _, reference = linear(None)
    grey = reference.reshape(SIDE, SIDE, 3)[..., :1]
    scales = []
    for picture in (grey, np.broadcast_to(grey, (SIDE, SIDE, 3)) * [1.0, 1.0, 1.0 + 1e-6]):
        renderer = AnalyticRenderer({"x": np.full(SIZE, 0.5)}, np.zeros((SIDE * SIDE * 3, SIZE)), shape=(SIDE, SIDE))
        scales.append(likelihood_scale(ur.Problem(renderer, [ur.Parameter("x")], [ur.View(picture)])))
    assert scales[0] == pytest.approx(3 * scales[1], rel=0.2)


def descended(problem: ur.Problem) -> ur.Result:
    adam = ur.optimizers.Adam(0.03, schedule=ur.schedules.Cosine(400))
    return ur.optimize(problem, ur.PathGradient(spp=4), adam, steps=400)


def test_a_loss_without_a_value_near_the_references_has_no_scale() -> None:
    class Logarithmic(ur.losses.L1):
        def value(self, image: Any, reference: Any) -> Any:
            return np.where(image > 0, np.abs(np.log(np.maximum(image, 1e-9))), np.nan)

    with pytest.raises(InputError, match="prior: its scale is the loss at the references plus noise"):
        likelihood_scale(linear({"near": 0.5, "std": 0.1}, loss=Logarithmic())[0])


def test_a_descent_ends_at_the_posterior_mean() -> None:
    """(Mᵀ M / σ² + I / τ²)⁻¹ (Mᵀ y / σ² + m / τ²), which lies well between the prior's mean and the estimate without a prior."""
    prior = {"near": [0.1, 0.9, 0.4], "std": 0.05}
    problem, matrix, y = linear(prior)
    variance = problem.prior_scales["x"] * len(y) / 2
    normal = matrix.T @ matrix / variance + np.eye(SIZE) / 0.05**2
    expected = np.linalg.solve(normal, matrix.T @ y / variance + np.array(prior["near"]) / 0.05**2)
    without = np.linalg.lstsq(matrix, y, rcond=None)[0]
    assert np.abs(expected - without).max() > 0.02
    assert np.abs(expected - prior["near"]).max() > 0.02
    result = descended(problem)
    assert result.parameters["x"] == pytest.approx(expected, abs=2e-3)
    assert result.verification["status"] == "finished"
    assert result.verification["best"] == "end"


def test_the_noise_of_renderings_is_no_standard_error_beside_a_prior() -> None:
    """A run had one of a hundredth of the prior's, and `uncertainty` said that there is none."""
    for prior in (None, {"near": 0.5, "std": 0.1}):
        run = ur.optimize(linear(prior)[0], ur.GaussNewton(8), ur.optimizers.AveragedNewton(), steps=30)
        assert ("x" in run.standard_error) == (prior is None)


def test_a_better_posterior_with_a_worse_picture_is_no_failure() -> None:
    """A descent that starts at the best picture moves to the prior, and the check at the end counts both."""
    _, matrix, y = linear(None)
    best = np.linalg.lstsq(matrix, y, rcond=None)[0]
    prior = {"near": 0.0, "std": 0.01}
    problem, _, _ = linear(prior, initial=best.tolist())
    result = descended(problem)
    assert result.verification["status"] == "finished"
    assert np.abs(result.parameters["x"]).max() < np.abs(best).max() * 0.7
    start, end = (result.verification[name][0] for name in ("start", "end"))
    assert end < start


# ---------------------------------------------------------------------- estimates


def test_every_derivative_of_an_estimate_has_the_priors_part() -> None:
    problem, _, _ = linear({"near": 0.2, "std": 0.1})
    x = {"x": np.array([0.5, 0.1, 0.3], np.float32)}
    s = problem.prior_scales["x"]
    value, slope = s * np.sum((x["x"] - 0.2) ** 2) / (2 * 0.1**2), s * (x["x"] - 0.2) / 0.1**2
    zero = {"x": np.zeros(SIZE, np.float32)}
    block = BlockEstimate(("x",), Estimate(0.0, zero, (Hessian(np.zeros((SIZE, SIZE))),)))
    capabilities = (
        FreshGradient(zero),
        Hessian(np.eye(SIZE)),
        HessianProduct(lambda v: v),
        LossFunction(lambda points: np.zeros(len(points))),
        block,
    )
    found = penalized(Estimate(1.0, zero, capabilities), problem, x)
    assert found.loss == pytest.approx(1.0 + value)
    assert penalty(problem, x) == pytest.approx(value)
    assert found.gradient["x"] == pytest.approx(slope)
    assert found.require("test", FreshGradient).values["x"] == pytest.approx(slope)
    assert found.hessian == pytest.approx(np.eye(SIZE) * (1 + s / 0.1**2))
    v = {"x": np.array([1.0, 2.0, 3.0], np.float32)}
    product, losses = found.hvp, found.losses
    assert product is not None
    assert losses is not None
    assert product(v)["x"] == pytest.approx(v["x"] * (1 + s / 0.1**2))
    assert losses(np.stack([x["x"], np.full(SIZE, 0.2)])) == pytest.approx([value, 0.0], abs=1e-9)
    inner = found.require("test", BlockEstimate).estimate
    assert inner.gradient["x"] == pytest.approx(slope)
    assert inner.hessian == pytest.approx(np.eye(SIZE) * s / 0.1**2)
    assert penalized(Estimate(1.0, zero), linear(None)[0], x).loss == 1.0


# ---------------------------------------------------------------------- input


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        ({}, "expected near, palette, smoothness or total_variation"),
        ({"near": 0.5}, "near or palette needs std"),
        ({"std": 0.5}, "near or palette needs std"),
        ({"near": "start", "std": 0.5}, "or \"initial\", got 'start'"),
        ({"near": [0.1, 0.2], "std": 0.5}, "a number or 3 numbers"),
        ({"near": math.nan, "std": 0.5}, "finite"),
        ({"near": 0.5, "std": 0.0}, "std must be a finite number > 0"),
        ({"palette": [0.1, 0.2, 0.3], "std": 0.1}, "a list of colours of 3 numbers"),
        ({"near": np.zeros((4, 4, 3)), "std": 0.5}, "one number per channel, got an array of shape (4, 4, 3)"),
        ({"palette": np.zeros((4, 4, 3)), "std": 0.5}, "a list of colours, got an array of shape"),
        ({"palette": [], "std": 0.1}, "a list of colours of 3 numbers"),
        ({"palette": "red", "std": 0.1}, "finite numbers"),
        ({"smoothness": 0.1}, "need a texture, a volume or vertices"),
        ({"smooth": 0.1}, "smooth"),
        (3.0, "expected a table such as"),
        ({"near": True, "std": 0.5}, 'near must be a number, one number per channel, or "initial", got True'),
        ({"near": 5, "std": 0.5}, "near: expected at least 0 and at most 1 as the unknown's bounds, got 5"),
        ({"palette": [[128.0, 0.2, 0.1]], "std": 0.5}, "palette: expected at least 0 and at most 1 as the unknown's"),
    ],
)
def test_a_prior_that_does_not_suit_is_refused_in_one_line(prior: Any, message: str) -> None:
    with pytest.raises(InputError, match=r"parameter x: prior: (?!prior)") as caught:
        linear(prior, bounds=(0.0, 1.0))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_positions_of_vertices_have_no_smoothness() -> None:
    positions = TETRAHEDRON[0].reshape(-1)
    with pytest.raises(InputError, match="bilaplacian"):
        Prior(smoothness=0.1).on(positions, topology=MeshTopology.of(*TETRAHEDRON), moving=True)
    value, _ = (
        Prior(near="initial", std=0.1)
        .on(positions, topology=MeshTopology.of(*TETRAHEDRON), moving=True)
        .evaluate(positions)
    )
    assert value == 0.0


def test_arrays_and_tuples_of_a_prior_are_stored_as_they_are_read_back() -> None:
    """A run folder was refused for arrays, and a run with a tuple did not resume: its file has a list."""
    arrays: Any = {"near": np.array([0.5, 0.4]), "palette": [np.array([0.1, 0.2])], "std": np.float32(0.5)}
    given = Prior(**arrays)
    assert repr(given) == repr(Prior(**tables.fields(given)))
    assert given == Prior(near=(0.5, 0.4), palette=[[0.1, 0.2]], std=0.5)


def test_a_prior_is_part_of_a_problem_and_its_fingerprint(tmp_path: Path) -> None:
    with_prior, without = linear({"near": 0.2, "std": 0.1})[0], linear(None)[0]
    assert with_prior.unknowns["x"].prior == Prior(near=0.2, std=0.1)
    key = "parameter x: prior"
    assert fingerprint(with_prior)[key] != ""
    assert key not in fingerprint(without)
    ur.optimize(with_prior, ur.PathGradient(spp=4), ur.optimizers.Adam(0.1), steps=3, run_directory=tmp_path / "run")
    stored = toml_lines.parse((tmp_path / "run" / "problem.toml").read_text(), "problem.toml")
    assert stored["parameters"][0]["prior"] == {"near": 0.2, "std": 0.1, "weight": 1.0}
    assert method("plain").plan(with_prior).lines[-1] == "prior of x: near 0.2, std 0.1"
    assert replace(Prior(smoothness=0.1), weight=2.0).describe() == "smoothness 0.1, weight 2.0"
