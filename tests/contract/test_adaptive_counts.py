"""Different numbers of samples per pixel, on problems whose answers are known."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy import stats

import unrender as ur
from analytic import exact_gradient, problem
from tests.analytic import AnalyticRenderer
from unrender.core import arrays
from unrender.core.random import Key
from unrender.estimators.sample_groups import GradientRequest
from unrender.pixels.base import DrawStatistics, MiniBatch
from unrender.runs.folder.state import pack, unpack
from unrender.scene.batches import FullView, SampleCounts, SampleShares, rounded
from unrender.scene.executor import LOCAL

CV, Counts = ur.images.RecursiveControlVariate, ur.pixels.AdaptiveCounts


def few_pixels(sparse: float = 0.1, grain: float = 0.0, truth: float = 0.9) -> ur.Problem:
    """A picture of 8 × 8 pixels, few of which know of the parameters."""
    rng = np.random.default_rng(5)
    matrix = rng.random((64 * 3, 4)) * np.repeat(rng.random(64) < sparse, 3)[:, None]
    renderer = AnalyticRenderer({"x": np.full(4, 0.6)}, matrix, 0.1, 0.5, grain, shape=(8, 8))
    return ur.Problem(renderer, [ur.Parameter("x", 0.5)], [ur.View(renderer.exact({"x": np.full(4, truth)}))])


def masked(masks: list[np.ndarray], loss: Any = None) -> ur.Problem:
    """Views through masks."""
    given = problem(loss, views=len(masks))
    views = [dataclasses.replace(view, mask=mask) for view, mask in zip(given.views, masks, strict=True)]
    return ur.Problem(given.renderer, given.parameters, views, given.loss, truth=given.truth)


def steps(asked: ur.Problem, estimator: Any, count: int, state: Any = None, first: int = 0) -> tuple[list[Any], Any]:
    state = estimator.init(asked, asked.initial()) if state is None else state
    found = []
    for step in range(first, first + count):
        estimate, state = estimator.estimate(asked, asked.initial(), state, Key(0, step))
        found.append(estimate)
    return found, state


# ---------------------------------------------------------------- numbers


def test_numbers_of_samples_sum_to_all_and_are_their_shares_on_the_average() -> None:
    shares = np.random.default_rng(0).random((5, 7)) ** 4
    offsets = (np.arange(400) + 0.5) / 400
    found = np.array([rounded(shares, 6, 2, offset) for offset in offsets])
    assert (found.sum(axis=(1, 2)) == 6 * 35).all()
    exact = 2 + 4 * shares / shares.mean()
    assert found.min() == 2
    assert np.abs(found - exact).max() < 1 + 1e-9
    np.testing.assert_allclose(found.mean(axis=0), exact, atol=1 / 200)
    for useless in (np.zeros((2, 2)), np.full((2, 2), np.nan), np.full((2, 2), np.inf)):
        assert (rounded(useless, 5, 2, 0.3) == 5).all()
    one_pixel = np.zeros((3, 3))
    one_pixel[1, 1] = 1e300
    assert rounded(one_pixel, 100, 2, 0.999)[1, 1] == 2 + 98 * 9  # many more samples than pixels
    assert rounded(np.ones((1, 1)), 3, 2, 0.5).tolist() == [[3]]


@pytest.mark.parametrize("device", [False, True])
def test_means_and_leave_one_out_means_are_those_of_each_pixel(device: bool) -> None:
    def array(values: np.ndarray) -> Any:
        if not device:
            return np.array(values, np.float64)
        import mitsuba as mi

        return mi.TensorXf(mi.Float(np.float32(values).ravel()) + 0, values.shape)

    if device:
        ur.use("llvm_ad_rgb")
    rng = np.random.default_rng(1)
    numbers = rng.integers(2, 9, (4, 3))
    counts = SampleCounts.of(numbers, array)
    values = rng.random((1, int(numbers.sum()), 3))
    samples = array(values)
    parts = np.split(values[0], np.cumsum(numbers.ravel())[:-1])
    close: dict[str, Any] = {"rtol": 2e-5, "atol": 1e-7}
    means = np.array([part.mean(axis=0) for part in parts]).reshape(4, 3, 3)
    np.testing.assert_allclose(arrays.numpy(counts.means(samples)), means, **close)
    others = [(part.sum(axis=0) - part) / (len(part) - 1) for part in parts]
    np.testing.assert_allclose(arrays.numpy(counts.others(samples))[0], np.concatenate(others), **close)
    variance = [part.var(axis=0, ddof=1) / len(part) for part in parts]
    found = arrays.numpy(counts.variance_of_mean(samples)).reshape(-1, 3)
    np.testing.assert_allclose(found, np.array(variance), rtol=1e-4, atol=1e-6)
    assert np.array_equal(np.array(counts.pixels), np.repeat(np.arange(12), numbers.ravel()))


# ---------------------------------------------------------------- gradients


@pytest.mark.parametrize(
    "image", [ur.images.Plain(), pytest.param(CV(), marks=pytest.mark.slow)], ids=["plain", "control variate"]
)
def test_gradients_are_unbiased_whatever_the_numbers(image: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """One sample weighs one over its pixel's number; with a control variate, after steps with other numbers."""
    asked = problem(views=2, noise=0.8)
    at = asked.initial()
    exact = np.concatenate([g.ravel() for g in exact_gradient(asked, at).values()])
    last = tuple(np.random.default_rng(9).random((4, 4)) ** 6 for _ in range(2))

    def worst(runs: int) -> float:
        rows, rng = [], np.random.default_rng(2)
        for seed in range(runs):
            state, found = image.init(asked, at), None
            for step in range(3 if isinstance(image, CV) else 1):
                shares = last if step != 1 else tuple(rng.random((4, 4)) ** 6 for _ in range(2))
                batch = MiniBatch(None, shares=SampleShares(2, shares, (rng.random(), rng.random())))
                request = GradientRequest(at, image, state, 5, Key(seed, step), batch=batch)
                found = LOCAL.estimate_gradient(asked, request)
                state = found.image
            assert found is not None
            rows.append(np.concatenate([g.ravel() for g in found.gradient.values()]))
        return float(np.abs((np.mean(rows, axis=0) - exact) / (np.std(rows, axis=0, ddof=1) / np.sqrt(runs))).max())

    limit = stats.norm.isf((1 - (1 - 1e-3) ** (1 / exact.size)) / 2)
    assert worst(160) < limit
    own = FullView.loss_derivative

    def equal(frame: FullView, image: Any) -> Any:
        assert frame.counts is not None
        return own(frame, image) * frame.counts.spread(frame.counts.divisors) / 5

    monkeypatch.setattr(FullView, "loss_derivative", equal)
    assert worst(160) > 1.5 * limit, "weights as with equal numbers went unseen"


@pytest.mark.slow
def test_the_variance_of_a_control_variate_is_known_with_other_numbers_at_each_step() -> None:
    asked, rng = problem(noise=0.8), np.random.default_rng(3)
    at, image = asked.initial(), CV()
    schedule = [tuple(rng.random((1, 4, 4)) ** 4) for _ in range(12)]
    images, told = [], []
    for seed in range(100):
        state, found = image.init(asked, at), None
        for step, shares in enumerate(schedule):
            batch = MiniBatch(None, shares=SampleShares(2, shares, (0.5,)))
            request = GradientRequest(at, image, state, 6, Key(seed, step), batch=batch)
            found = LOCAL.estimate_gradient(asked, request)
            state = found.image
        assert found is not None
        images.append(found.images[0])
        told.append(found.info["variance"][0])
    actual, variance = np.var(images, axis=0), np.mean(told, axis=0)
    assert 0.8 < float(np.exp(np.log(variance / actual).mean())) < 1.25
    assert np.corrcoef(np.log(variance).ravel(), np.log(actual).ravel())[0, 1] > 0.7


@pytest.mark.parametrize(
    "image", [pytest.param(ur.images.Plain(), marks=pytest.mark.slow), CV()], ids=["plain", "control variate"]
)
def test_samples_go_where_the_variance_is(image: Any) -> None:
    asked = few_pixels(0.2, grain=0.05)
    rows: dict[str, np.ndarray] = {}
    for name, sampler in {"equal": ur.pixels.All(), "adaptive": Counts(refresh=2)}.items():
        estimator = ur.PathGradient(image, sampler, spp=8)
        found, state = steps(asked, estimator, 20)
        assert {estimate.info["samples"] for estimate in found} == {8 * 64}
        again = [estimator.estimate(asked, asked.initial(), state, Key(1, run))[0] for run in range(80)]
        rows[name] = np.array([estimate.gradient["x"] for estimate in again])
    renderer = asked.renderer
    assert isinstance(renderer, AnalyticRenderer)
    known = (renderer.matrix.reshape(64, -1) > 0).any(axis=1).reshape(8, 8)
    probability = found[-1].info["pixel_probability"][0]
    assert probability.mean() == pytest.approx(1.0, rel=1e-5)
    assert probability[known].mean() > 2 * probability[~known].mean()
    assert rows["adaptive"].var(axis=0).sum() < 0.7 * rows["equal"].var(axis=0).sum()


# ---------------------------------------------------------------- state, and others


def test_a_state_that_was_stored_goes_on_as_it_would_have() -> None:
    asked = few_pixels(0.2)
    estimator = ur.PathGradient(CV(), Counts(refresh=3), spp=4)
    _, state = steps(asked, estimator, 7)
    expected, _ = steps(asked, estimator, 5, state, 7)
    found, _ = steps(asked, estimator, 5, unpack(pack(state)), 7)
    for one, other in zip(expected, found, strict=True):
        np.testing.assert_array_equal(one.gradient["x"], other.gradient["x"])


@pytest.mark.parametrize(
    "made",
    [
        lambda: ur.PathGradient(CV(), Counts(), spp=4, fresh_from=8),
        lambda: ur.PathGradient(CV(), Counts(), spp=4, tolerance=2.0),
        lambda: ur.MetaEstimator(4, 3, pixels=Counts()),
        lambda: ur.MetaEstimator(coupled=True, spp=4, image=CV(), pixels=Counts()),
    ],
)
def test_others_take_different_numbers(made: Any) -> None:
    """Masks, views and a loss that is not linear likewise: the truth is neared."""
    asked = masked([np.tri(4), 1 - np.tri(4, k=-2)], ur.losses.L1())
    adam = ur.optimizers.MetaAdam(0.01) if isinstance(made(), ur.MetaEstimator) else ur.optimizers.Adam(0.02)
    found = ur.optimize(asked, made(), adam, steps=25)
    first, last = (max(asked.parameter_error(at).values()) for at in (asked.initial(), found.parameters))
    assert last < 0.9 * first
    assert not found.warnings


# ---------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Counts(least=1), "AdaptiveCounts: least must be"),
        (lambda: Counts(refresh=0), "AdaptiveCounts: refresh must be"),
        (lambda: Counts(uniform=0.0), "AdaptiveCounts: uniform must be"),
        (lambda: Counts(uniform=1.5), "AdaptiveCounts: uniform must be a share"),
        (lambda: ur.PathGradient(pixels=Counts(), spp=2), "spp must be at least 3, got 2"),
        (lambda: ur.PathGradient(pixels=Counts(), spp=4, adjoint_spp=1), "leave out adjoint_spp"),
        (lambda: ur.PathGradient(ur.images.Denoised(), Counts(), spp=4), "Denoised needs full views"),
        (lambda: ur.MetaEstimator(pixels=Counts()), "spp must be at least 3, got 1"),
    ],
)
def test_what_makes_no_sense_is_refused(make: Any, message: str) -> None:
    with pytest.raises(ur.InputError, match=message):
        make()


def test_losses_of_whole_images_and_views_of_workers_are_refused() -> None:
    @dataclasses.dataclass(frozen=True)
    class Whole(ur.losses.L2):
        pixelwise = False  # pyright: ignore[reportAssignmentType]

    asked = problem().replaced(loss=Whole())
    with pytest.raises(
        ur.InputError, match="Whole is a loss of full images, in which each pixel needs as many samples"
    ):
        Counts().init(asked, asked.initial())


def test_maps_that_tell_nothing_leave_equal_numbers() -> None:
    """A parameter that no pixel sees; an image without noise or error; a black view; values that are not finite."""
    unseen, exact = few_pixels(0.0), few_pixels(0.3, truth=0.5)
    renderer = exact.renderer
    assert isinstance(renderer, AnalyticRenderer)
    renderer.noise = 0.0
    for asked in (unseen, exact):
        found, state = steps(asked, ur.PathGradient(CV(), Counts(), spp=4), 6)
        assert all(np.isfinite(np.concatenate([g.ravel() for g in one.gradient.values()])).all() for one in found)
        assert np.isfinite(state.pixels.density).all()
        if asked is not exact:  # whose errors are those of rounding
            np.testing.assert_allclose(found[-1].info["pixel_probability"][0], 1.0, rtol=1e-6)
    sampler = Counts()
    state = sampler.init(unseen, unseen.initial())
    nothing = np.full((64, 3), np.nan)
    learnt = sampler.learn(unseen, state, None, DrawStatistics(nothing, nothing, np.full(64, 4.0)))
    np.testing.assert_array_equal(learnt.density, 1.0)
    two, rng = problem(views=2), np.random.default_rng(4)
    seen = rng.random((32, 3)) * np.repeat([1.0, 0.0], 16)[:, None]
    learnt = sampler.learn(two, sampler.init(two, two.initial()), None, DrawStatistics(seen, seen, np.full(32, 4.0)))
    np.testing.assert_allclose(learnt.density[16:], 1.0)
    assert learnt.density[:16].std() > 0.01
    assert learnt.density[:16].mean() == pytest.approx(1.0)
