"""Standard errors of textures: against the spread of linear estimates with noise, the share of the data, and planted faults."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.io import images
from unrender.runs import final_images, image_sensitivity
from unrender.runs import map_uncertainty as module
from unrender.runs.folder import reader as folders
from unrender.runs.image_sensitivity import curvature, neighbour_means
from unrender.runs.map_uncertainty import of_residuals, pixel_noise, uncertainty
from unrender.scene.parameter import Parameter
from unrender.scene.prior import Prior
from unrender.scene.problem import Problem
from unrender.scene.references import View
from unrender.statistics.debiased import overlap

SIZE, TEXELS = 12, 6
NOISE = 0.02


def matrix() -> np.ndarray:
    """Pixels that see one texel each, four per texel, darker to the right; the last column is not seen."""
    made = np.zeros((SIZE, SIZE, 3, TEXELS, TEXELS, 3))
    for row in range(SIZE):
        for column in range(SIZE - 2):
            for channel in range(3):
                made[row, column, channel, row // 2, column // 2, channel] = 1.0 - 0.06 * column
    return made.reshape(3 * SIZE**2, 3 * TEXELS**2)


def problem(
    seed: int = 0,
    mask: np.ndarray | None = None,
    prior: dict[str, float] | None = None,
    noise: float | np.ndarray = NOISE,
    smooth: bool = False,
) -> Problem:
    rng = np.random.default_rng(seed)
    truth = {"wall": np.full((TEXELS, TEXELS, 3), 0.8) if smooth else rng.uniform(0.2, 0.8, (TEXELS, TEXELS, 3))}
    renderer = AnalyticRenderer(truth, matrix(), 0.0, 0.0, shape=(SIZE, SIZE), sensors=1)
    picture = renderer.exact(truth) + noise * rng.normal(size=(SIZE, SIZE, 3))
    if mask is not None:
        picture = np.where(mask[..., None] > 0, picture, 7.0)
    parameter = Parameter("wall", initial=0.5, bounds=(0, 1), prior=prior)
    return Problem(renderer, [parameter], [View(picture, mask=mask)], truth=truth)


def estimate(made: Problem, converged: float = 1.0) -> dict[str, np.ndarray]:
    """Least squares where a pixel sees something, as far as a descent that removed this share of the first residual."""
    a = matrix()
    picture = np.asarray(made.views[0].reference, np.float64).reshape(-1)
    weights = 1.0 if made.views[0].mask is None else np.repeat(np.asarray(made.views[0].mask).reshape(-1), 3)
    diagonal = (weights * a.T).T.T @ a
    seen = np.diag(diagonal) > 0
    start = np.full(a.shape[1], 0.5)
    step = np.zeros(a.shape[1])
    step[seen] = ((weights * a.T) @ (picture - a @ start))[seen] / np.diag(diagonal)[seen]
    return {"wall": (start + converged * step).reshape(TEXELS, TEXELS, 3).astype(np.float32)}


def scores(converged: float, mask: np.ndarray | None = None) -> np.ndarray:
    found = [score_map(problem(seed, mask), converged) for seed in range(4)]
    return np.concatenate([z[np.isfinite(z)] for z in found])


def score_map(made: Problem, converged: float) -> np.ndarray:
    """Return the scores of the elements, NaN where the references decide less than half."""
    values = estimate(made, converged)
    of = uncertainty(made, values)
    z = (values["wall"] - made.truth["wall"]) / of.standard_error["wall"]
    return np.where(of.data_share["wall"] > 0.5, z, np.nan)


@pytest.mark.parametrize("converged", [0.6, 0.9, 1.0])
def test_errors_have_the_stated_spread(converged: float) -> None:
    """Of early ends, whose error is what is left, and of the end, whose error is the noise."""
    assert scores(converged).std() == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_the_followed_fraction_is_that_of_the_solution(monkeypatch: pytest.MonkeyPatch, share: float) -> None:
    """Measured from the differences from the solution. Their opposite sign would give f / (2 f - 1), between 0 and 1: 0, 1 and 1."""
    found: list[float] = []
    followed = module._Cells._followed

    def recorded(*given: object) -> float:
        found.append(followed(*given))  # type: ignore[arg-type]
        return found[-1]

    monkeypatch.setattr(module._Cells, "_followed", recorded)
    for seed in range(4):
        made = problem(seed)
        uncertainty(made, estimate(made, share))
    assert np.mean(found) == pytest.approx(share, abs=0.05)


def test_what_smoothing_left_out_of_the_references_noise_is_no_error() -> None:
    """Smoothed least squares of a smooth wall: a ninth of the noise's variance is left. With the residual as the error z has 0.35."""
    found = []
    for seed in range(8):
        made = problem(seed, smooth=True)
        solution = estimate(made)["wall"]
        solution[:, -1] = solution[:, -2]  # not seen
        values = neighbour_means(solution, channels=True)
        error = uncertainty(made, {"wall": values}).standard_error["wall"]
        z = (values - made.truth["wall"]) / error
        found.append(z[1:-1, 1:-2])  # at borders the filter sees some cells twice
    assert 0.7 < np.std(found) < 1.6  # few blocks tell how much was left


def test_changes_that_neighbours_share_have_their_own_eigenvalue() -> None:
    """Each pixel sees a texel and half of its eight neighbours. The planted fault is an eigenvalue of 1."""
    mean = np.zeros((TEXELS, TEXELS, TEXELS, TEXELS))
    for row, column in np.ndindex(TEXELS, TEXELS):
        unit = np.zeros((TEXELS, TEXELS))
        unit[row, column] = 1.0
        mean[..., row, column] = neighbour_means(unit)
    s = mean.reshape(TEXELS**2, TEXELS**2)
    rows = np.eye(TEXELS**2) + 2.0 * s
    truth = {"wall": np.full((TEXELS, TEXELS, 1), 0.5)}
    a = np.repeat(rows, 3, axis=0)
    renderer = AnalyticRenderer(truth, a, 0.0, 0.0, shape=(TEXELS, TEXELS), sensors=1)
    made = Problem(renderer, [Parameter("wall", initial=0.4, bounds=(0, 1))], [View(renderer.exact(truth))])
    matrix_ = a.T @ a
    roots = np.sqrt(np.diag(matrix_))
    expected = np.trace(s @ (matrix_ / np.outer(roots, roots)) @ s.T) / np.trace(s @ s.T)
    assert expected > 1.5
    assert curvature(made, probes=64).smooth["wall"] == pytest.approx(expected, rel=0.25)
    assert curvature(problem()).smooth["wall"] == pytest.approx(1.0, abs=0.25)


def test_without_the_references_noise_the_end_would_seem_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "pixel_noise", lambda problem, halves: [np.full((SIZE, SIZE, 2), 1e-6)])
    assert scores(1.0).std() > 3


def spreads_of_halves() -> tuple[float, float]:
    """Return the spread of the scores of the upper and of the lower half, whose pixels have five times the noise."""
    noise = np.where(np.arange(SIZE) < SIZE // 2, 0.2 * NOISE, NOISE)[:, None, None]
    z = np.stack([score_map(problem(seed, noise=noise), 1.0) for seed in range(6)])
    # Rows beside the border between both halves share their noise.
    return float(np.nanstd(z[:, :2])), float(np.nanstd(z[:, -2:]))


def test_errors_follow_the_noise_of_the_pixels_that_see_a_texel() -> None:
    for spread in spreads_of_halves():
        assert spread == pytest.approx(1.0, abs=0.25)


def test_one_noise_for_all_pixels_would_be_wrong_in_both_halves(monkeypatch: pytest.MonkeyPatch) -> None:
    def mean(of: Problem, halves: object) -> list[np.ndarray]:
        return [np.broadcast_to(noise.mean(axis=(0, 1)), noise.shape) for noise in pixel_noise(of, halves)]  # type: ignore[arg-type]

    monkeypatch.setattr(module, "pixel_noise", mean)
    quiet, loud = spreads_of_halves()
    assert quiet < 0.5
    assert loud > 1.25


def limits(converged: float, error: float = 0.0, noise: float = NOISE) -> list[tuple[str, ...]]:
    """Return the lines of four problems; values have an own error of this size in each element."""
    found = []
    for seed in range(4):
        made = problem(seed, noise=noise)
        values = estimate(made, converged)["wall"]
        values += (error * np.random.default_rng(seed + 9).normal(size=values.shape)).astype(np.float32)
        found.append(uncertainty(made, {"wall": values}).limited)
    return found


def test_a_line_says_that_the_references_noise_limits_a_texture() -> None:
    """Texels with the noise of four pixels. An own error of the same size adds to it, and so does the rest of an early end."""
    own = 0.5 * NOISE / np.sqrt(np.mean(np.square(1.0 - 0.06 * np.arange(SIZE - 2))))
    for lines in limits(1.0):
        assert len(lines) == 1
        assert "now limit it (100% of its squared error)" in lines[0]
    for lines in (*limits(1.0, own), *limits(0.9), *limits(0.0), *limits(1.0, noise=0.0), *limits(1.0, own, 0.0)):
        assert not lines


def test_what_no_pixel_sees_has_the_spread_of_the_seen_and_no_share_of_the_data() -> None:
    made = problem()
    found = uncertainty(made, estimate(made))
    share, error = found.data_share["wall"], found.standard_error["wall"]
    assert share.dtype == error.dtype == np.float32
    assert share[:, -1].max() < 0.02
    assert share[:, :-1].min() > 0.8
    assert error[:, -1].mean() == pytest.approx(np.std(made.truth["wall"] - 0.5), rel=0.3)


def test_pixels_out_of_the_mask_are_no_data() -> None:
    mask = np.ones((SIZE, SIZE), np.float32)
    mask[:4] = 0.0
    made = problem(mask=mask)
    found = uncertainty(made, estimate(made))
    assert found.data_share["wall"][:2].max() < 0.02
    assert scores(0.9, mask).std() == pytest.approx(1.0, abs=0.25)


def test_a_prior_takes_its_share() -> None:
    made = problem(prior={"near": 0.5, "std": 0.01})
    free = problem()
    values = estimate(free)
    loose, tight = (uncertainty(one, values).data_share["wall"][:, :-1].mean() for one in (free, made))
    assert tight < 0.6 * loose


def test_the_diagonal_of_a_priors_curvature_is_that_of_its_product() -> None:
    x = np.random.default_rng(0).random((5, 6, 2)).astype(np.float32)
    prior = Prior(near=0.5, std=0.1, smoothness=0.2, total_variation=0.1)
    bound = prior.on(x)
    expected = [bound.product(x, one.reshape(x.shape)).reshape(-1)[n] for n, one in enumerate(np.eye(x.size))]
    np.testing.assert_allclose(bound.diagonal(x).reshape(-1), expected, rtol=1e-6)


def test_texels_that_share_each_pixel_with_neighbours_have_no_standard_error(monkeypatch: pytest.MonkeyPatch) -> None:
    made = problem()
    a = matrix()
    texels = a.reshape(-1, TEXELS, TEXELS, 3)
    rows = texels + np.roll(texels, 1, axis=1)
    mixed = 0.25 * (rows + np.roll(rows, 1, axis=2)).reshape(a.shape)
    places = np.indices((TEXELS, TEXELS, 3)).reshape(3, -1)
    near = (
        np.abs(places[:, :, None] - places[:, None])[:2].max(axis=0) <= 1
    )  # the first and last columns are mixed, too
    products = np.square(mixed.T @ mixed) * near
    made.renderer.matrix = mixed  # type: ignore[attr-defined]
    values = estimate(problem())
    assert curvature(made, values).overlap["wall"] == pytest.approx(products.sum() / products.trace(), rel=0.1)
    monkeypatch.setattr(module, "misfit_of_views", lambda *given: None)
    assert not uncertainty(made, values).standard_error
    monkeypatch.setattr(module, "_MOST_OVERLAP", 3.0)
    assert "wall" in uncertainty(made, values).standard_error


def test_elements_that_share_pixels_have_an_overlap_and_no_standard_error() -> None:
    """Blocks of four texels in one pixel: Σ_ij H_ij² is four times the sum over the diagonal."""
    texels = 2 * SIZE
    a = np.zeros((SIZE, SIZE, 3, texels, texels, 3))
    for row in range(SIZE):
        for column in range(SIZE):
            for channel in range(3):
                a[row, column, channel, 2 * row : 2 * row + 2, 2 * column : 2 * column + 2, channel] = 0.25
    truth = {"wall": np.full((texels, texels, 3), 0.5)}
    renderer = AnalyticRenderer(truth, a.reshape(3 * SIZE**2, -1), 0.0, 0.0, shape=(SIZE, SIZE), sensors=1)
    made = Problem(renderer, [Parameter("wall", initial=0.4, bounds=(0, 1))], [View(renderer.exact(truth))])
    assert curvature(made).overlap["wall"] == pytest.approx(4.0, rel=0.3)
    found = uncertainty(made, made.initial_values())
    assert not found.standard_error
    assert found.missing == (
        "wall: no map of standard errors: pixels see several texels, so errors of texels depend on each other",
    )
    assert curvature(problem()).overlap["wall"] == pytest.approx(1.0, abs=0.2)


def test_a_map_that_pictures_may_not_follow_is_to_be_compared_with_a_longer_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A roughness map a third of its first error away left 3 % of the picture, and no word that it had not converged."""
    made = problem()
    infos = {key: dataclasses.replace(of, resizable=True) for key, of in made.renderer.parameters().items()}
    monkeypatch.setattr(AnalyticRenderer, "parameters", lambda self: infos)
    (line,) = uncertainty(made, made.initial_values()).missing
    assert "differ little before it has converged; compare it with that of a run of more steps" in line


@pytest.mark.slow
@pytest.mark.mitsuba
@pytest.mark.parametrize("reference_spp", [8, 1024])
def test_runs_state_errors_of_the_right_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reference_spp: int
) -> None:
    """A wall of 400 texels, from noisy and from clean pictures; the run folder, the page and the export have the maps."""

    monkeypatch.setattr(final_images, "_SENSITIVITY_SHARE", 100.0)  # also on a busy machine
    made = ur.gallery.problem("wall", resolution=40, texture_resolution=20, reference_spp=reference_spp)
    key = "back.bsdf.reflectance.data"
    result = ur.optimize(made, steps=40, run_directory=tmp_path / "run")
    found = uncertainty(made, result.parameters)
    error, share = found.standard_error[key], found.data_share[key]
    z = ((result.parameters[key] - made.truth[key]) / error)[share >= 0.5]
    assert (share >= 0.5).mean() > 0.8
    assert z.std() == pytest.approx(1.0, abs=0.35)
    if reference_spp == 8:  # clean references take more samples than the final pictures of a short run may have
        run = folders.read(tmp_path / "run")
        np.testing.assert_array_equal(run.standard_error[key], result.standard_error[key])
        np.testing.assert_array_equal(run.data_share[key], result.data_share[key])
        assert np.median(run.standard_error[key] / error) == pytest.approx(1.0, abs=0.3)
        assert key not in run.record.standard_error
        exported = ur.app.export(tmp_path / "run", tmp_path / "export")
        record = json.loads((exported.folder / "parameters.json").read_text())[key]
        written = images.read(exported.folder / record["standard_error"]).values
        np.testing.assert_allclose(written, run.standard_error[key], rtol=1e-6)


def test_a_texture_of_which_the_picture_is_no_linear_function_has_no_map(monkeypatch: pytest.MonkeyPatch) -> None:
    made = problem()
    curved = {key: dataclasses.replace(info, resizable=True) for key, info in made.renderer.parameters().items()}
    assert "wall" in uncertainty(made, estimate(made)).standard_error
    monkeypatch.setattr(AnalyticRenderer, "parameters", lambda self: curved)
    assert not uncertainty(made, estimate(made)).standard_error


def test_volumes_have_no_map() -> None:
    """Although here no pixel sees two voxels: rays pass many in general, and the overlap does not tell it reliably."""
    truth = {"fog": np.random.default_rng(0).uniform(0.2, 0.8, (1, TEXELS, TEXELS, 3))}
    renderer = AnalyticRenderer(truth, matrix(), 0.0, 0.0, shape=(SIZE, SIZE), sensors=1)
    made = Problem(renderer, [Parameter("fog", initial=0.4, bounds=(0, 1))], [View(renderer.exact(truth))])
    found = uncertainty(made, made.initial_values())
    assert not found.standard_error
    assert found.missing == (
        "fog: no map of standard errors: rays pass many voxels, so errors of voxels depend on each other; see ur.runs.sensitivity",
    )


def test_too_few_probes_or_samples_give_no_map() -> None:
    made = problem()
    values = estimate(made)
    picture = np.asarray(made.views[0].reference)
    few = of_residuals(made, values, [[picture], [picture]], curvature(made, values, probes=4))
    assert (not few.standard_error, "too short for this test" in few.missing[0]) == (True, True)
    noisy = [[picture + np.random.default_rng(seed).normal(size=picture.shape)] for seed in range(2)]
    enough = curvature(made, values, noise=pixel_noise(made, noisy))
    found = of_residuals(made, values, noisy, enough)
    assert (not found.standard_error, "too few samples" in found.missing[0]) == (True, True)


def projections(matrix: np.ndarray, noise: float, seed: int, probes: int = 32) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return two noisy products of a symmetric J (N, N) with each of some vectors of signs, as maps of one channel."""
    rng = np.random.default_rng(seed)
    side = math.isqrt(len(matrix))
    made = []
    for _ in range(probes):
        exact = matrix @ rng.choice([-1.0, 1.0], len(matrix))
        one, other = (exact + noise * rng.normal(size=exact.shape) for _ in range(2))
        made.append((one.reshape(side, side, 1), other.reshape(side, side, 1)))
    return made


def test_the_overlap_is_that_of_neighbours_and_of_significant_others() -> None:
    """Noise twice as large as the elements. The sum over all pairs has 1.48 ± 0.41 here, this one 1.95 ± 0.13."""
    side = 16
    line = np.eye(side) + 0.25 * (np.eye(side, k=1) + np.eye(side, k=-1))
    near = np.kron(line, line)
    products = np.square(near @ near)
    expected = float(products.sum() / products.trace())
    found = [overlap(projections(near, 2.0, seed)) for seed in range(12)]
    assert np.mean(found) == pytest.approx(expected, abs=0.15)
    assert np.std(found) < 0.3
    mirrored = np.eye(side**2) + np.eye(side**2)[::-1]
    assert overlap(projections(mirrored, 0.1, 0)) == pytest.approx(2.0, abs=0.5)
    assert overlap(projections(np.eye(side**2), 2.0, 0)) < 1.25
    assert all(math.isnan(overlap(projections(np.eye(side**2), 50.0, seed))) for seed in range(4))


def test_a_residual_that_noise_hides_gives_no_map() -> None:
    """Known noise of the references is no limit then: errors of 7,000 were stated for reflectances of leaves behind a door."""
    rng = np.random.default_rng(0)
    ones = np.ones((16, 16))
    cells = module._Cells(rng.normal(size=(16, 16, 3)), ones, 1e-3 * ones)
    for size, stated in ((0.01, True), (1.0, False)):
        gradients = tuple(size * rng.normal(size=(16, 16, 3)) for _ in range(2))
        assert (cells.posterior(gradients, 1.0, True, 0.0) is not None) == stated  # type: ignore[arg-type]


def test_an_overlap_that_is_not_measured_gives_no_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """The projections of one probe alone fit into memory. The planted fault is an overlap of 1."""
    made = problem()
    monkeypatch.setattr(image_sensitivity, "_PROJECTIONS", 3 * TEXELS**2)
    assert np.isinf(curvature(made).overlap["wall"])
    found = uncertainty(made, estimate(made))
    assert not found.standard_error
    assert found.missing == (
        "wall: no map of standard errors: it has too many texels to measure whether pixels see several of them",
    )
    monkeypatch.setattr(image_sensitivity, "FEWEST_PROBES", 1)
    monkeypatch.setattr(image_sensitivity, "overlap", lambda *given: 1.0)
    assert "wall" in uncertainty(made, estimate(made)).standard_error
    monkeypatch.setattr(image_sensitivity, "overlap", lambda *given: math.nan)
    assert "noise of the renderings hides" in uncertainty(made, estimate(made)).missing[0]


@pytest.mark.parametrize("grey", [True, False])
def test_noise_that_channels_share_is_that_of_one_channel(grey: bool) -> None:
    """A texture of one channel, with references whose noise is equal in red, green and blue, and independent."""
    z = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        truth = {"wall": rng.uniform(0.2, 0.8, (TEXELS, TEXELS, 1))}
        rows = np.kron(np.eye(TEXELS), np.ones((2, 1)))
        a = np.repeat(np.kron(rows, rows), 3, axis=0)
        renderer = AnalyticRenderer(truth, a, 0.0, 0.0, shape=(SIZE, SIZE), sensors=1)
        noise = NOISE * rng.normal(size=(SIZE, SIZE, 1 if grey else 3))
        made = Problem(renderer, [Parameter("wall", initial=0.5, bounds=(0, 1))], [View(renderer.exact(truth) + noise)])
        picture = np.asarray(made.views[0].reference, np.float64).ravel()
        values = np.linalg.lstsq(a, picture, rcond=None)[0].reshape(TEXELS, TEXELS, 1).astype(np.float32)
        error = uncertainty(made, {"wall": values}).standard_error["wall"]
        z.append((values - truth["wall"]) / error)
    assert np.std(z) == pytest.approx(1.0, abs=0.2)
