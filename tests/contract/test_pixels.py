"""Drawn pixels: cells, tables, references, and the schemes' own rules, on problems whose answers are known."""

from __future__ import annotations

import dataclasses
from collections import Counter
from typing import Any

import numpy as np
import pytest
from scipy import stats

import unrender as ur
from analytic import exact_gradient, problem
from tests.analytic import AnalyticRenderer
from unrender.core.random import Key
from unrender.pixels import pixel_statistics
from unrender.pixels import tiles as cells_module
from unrender.pixels.pixel_statistics import denoise_side_by_side
from unrender.pixels.tiles import Grid, InverseCdfTable, Tiles, cut
from unrender.scene.batches import FullView, PixelBatch, PixelSample
from unrender.scene.references import References

SCHEMES: dict[str, Any] = {
    "uniform": ur.pixels.Uniform,
    "loss": ur.pixels.LossProportional,
    "adaptive": ur.pixels.Adaptive,
}


def two_views(shapes: list[tuple[int, int]], most: int) -> Tiles:
    return cells_module._cut(tuple(shapes), most)


def array(values: np.ndarray) -> np.ndarray:
    return np.array(values, np.float64)


# ---------------------------------------------------------------- cells


@pytest.mark.parametrize("most", [1, 2, 5, 17, 60, 10_000])
def test_cells_cover_every_pixel_of_every_view_once(most: int) -> None:
    shapes = [(5, 7), (3, 4), (1, 9)]
    found = two_views(shapes, most)
    seen: Counter[tuple[int, int]] = Counter()
    for view, x, y, w, h, film in zip(
        found.views, found.x, found.y, found.widths, found.heights, found.films, strict=True
    ):
        assert film == shapes[view][1]
        for row in range(y, y + h):
            seen.update((int(view), int(row * film + column)) for column in range(x, x + w))
    assert set(seen.values()) == {1}
    assert len(seen) == sum(h * w for h, w in shapes)
    assert len(found.views) <= max(most, len(shapes))


def test_cells_are_as_fine_as_they_may_be() -> None:
    assert two_views([(8, 8)], 64).grids == (Grid(8, 8, 1),)
    assert two_views([(8, 8)], 63).grids == (Grid(4, 4, 2),)
    assert two_views([(4096, 4096)] * 16, 20_000).grids[0].rows == 35


def test_maps_split_join_and_coarsen() -> None:
    found = two_views([(5, 7), (4, 4)], 1000)
    values = np.random.default_rng(0).random((len(found.views), 3))
    assert np.array_equal(found.join(found.split(values)), values)
    assert np.array_equal(found.coarsen(values, 0), values)
    level = found.split(found.coarsen(values, 1))
    first = found.split(values)[0]
    np.testing.assert_allclose(level[0][2:4, 4:6], np.broadcast_to(first[2:4, 4:6].mean((0, 1)), (2, 2, 3)))
    np.testing.assert_allclose(level[0][4, 6], first[4, 6])  # a block that the border cuts
    whole = found.split(found.coarsen(values, 10))[1]
    np.testing.assert_allclose(whole, np.broadcast_to(found.split(values)[1].mean((0, 1)), (4, 4, 3)))


def test_coarse_means_count_pixels_and_not_cells() -> None:
    found = two_views([(5, 4)], 6)  # cells of 2 x 2, but for the last row
    assert found.grids == (Grid(3, 2, 2),)
    values = np.arange(6.0)[:, None] * np.ones(3)
    expected = (np.array([0, 1, 2, 3]).sum() * 4 + (4 + 5) * 2) / 20
    np.testing.assert_allclose(found.coarsen(values, 2), expected)


# ---------------------------------------------------------------- tables


def run_lengths(table: InverseCdfTable) -> np.ndarray:
    return np.diff([*np.asarray(table.starts, np.int64), 1 << 32])


def test_a_table_never_forgets_a_cell_and_tells_its_exact_probability() -> None:
    found = two_views([(6, 6)], 36)
    probabilities = np.full(36, 1e-14)
    probabilities[20] = 1.0
    table = InverseCdfTable.of(found, probabilities, array)
    runs = run_lengths(table)
    assert runs.min() >= 1
    assert runs.sum() == 1 << 32
    np.testing.assert_allclose(table.weights[:, 0], found.sizes * (1 << 32) / runs)


@pytest.mark.parametrize("stratified", [True, False])
def test_draws_follow_the_table(stratified: bool) -> None:
    found = two_views([(5, 7), (3, 4)], 20)
    rng = np.random.default_rng(1)
    probabilities = rng.random(len(found.views)) * found.sizes
    table = InverseCdfTable.of(found, probabilities, array)
    counts: Counter[tuple[int, int]] = Counter()
    total = 0
    for seed in range(400):
        draw = table.draw(50, Key(seed), stratified)
        counts.update(zip(draw.views.tolist(), draw.pixels.tolist(), strict=True))
        total += 50
    expected, observed = [], []
    share = probabilities / probabilities.sum() / found.sizes
    for cell in range(len(found.views)):
        for row in range(found.heights[cell]):
            for column in range(found.widths[cell]):
                pixel = (found.y[cell] + row) * found.films[cell] + found.x[cell] + column
                expected.append(share[cell] * total)
                observed.append(counts[(int(found.views[cell]), int(pixel))])
    assert sum(observed) == total
    assert stats.chisquare(observed, expected).pvalue > 1e-3
    wrong = np.array(expected) * np.where(np.arange(len(expected)) % 2, 1.15, 0.85)
    assert stats.chisquare(observed, wrong / wrong.sum() * total).pvalue < 1e-3, "a planted error went unseen"


def test_weighted_sums_over_draws_are_unbiased_and_stratified_ones_quieter() -> None:
    found = two_views([(6, 6)], 36)
    rng = np.random.default_rng(2)
    values, probabilities = rng.random(36), rng.random(36) + 0.1
    table = InverseCdfTable.of(found, probabilities, array)
    spread = []
    for stratified in (True, False):
        sums = []
        for seed in range(600):
            draw = table.draw(72, Key(seed), stratified)
            sums.append((values[draw.pixels] * draw.weights[:, 0]).sum())
        error = np.std(sums, ddof=1) / np.sqrt(len(sums))
        assert abs(np.mean(sums) - values.sum()) < 3.5 * error
        spread.append(np.std(sums))
    assert spread[0] < 0.7 * spread[1]


def test_the_device_draws_as_numpy_does() -> None:
    """Other random numbers, the same probabilities: weights of equal pixels are equal, indices in range, sums right."""
    ur.use("llvm_ad_rgb")
    import mitsuba as mi

    found = two_views([(30, 40), (10, 10)], 200)
    probabilities = np.random.default_rng(3).random(len(found.views)) + 0.1
    on_host = InverseCdfTable.of(found, probabilities, array)

    def on_device(values: np.ndarray) -> Any:
        return mi.TensorXf(mi.Float(np.float32(values).ravel()) + 0, values.shape)

    table = InverseCdfTable.of(found, probabilities, on_device)
    np.testing.assert_array_equal(table.starts.numpy(), on_host.starts)
    np.testing.assert_allclose(table.weights.numpy(), on_host.weights, rtol=1e-6)
    for stratified in (True, False):
        means = []
        for seed in range(40):
            draw = table.draw(1000, Key(seed), stratified)
            views, pixels = draw.views.numpy(), draw.pixels.numpy()
            assert set(views) == {0, 1}
            assert pixels[views == 0].max() < 1200
            assert pixels[views == 1].max() < 100
            means.append(draw.weights.numpy().sum())
        error = np.std(means, ddof=1) / np.sqrt(len(means))
        assert abs(np.mean(means) - 1300) < 3.5 * error + 1e-2


@pytest.mark.parametrize("stratified", [True, False])
def test_one_pixel_at_a_time_follows_the_table_on_the_device(stratified: bool) -> None:
    """The one stratum is as long as the integers are many."""
    ur.use("llvm_ad_rgb")
    import mitsuba as mi

    found = two_views([(2, 2)], 4)
    table = InverseCdfTable.of(
        found, np.array([1.0, 2, 3, 4]), lambda x: mi.TensorXf(mi.Float(np.float32(x).ravel()) + 0, x.shape)
    )
    drawn = np.concatenate([table.draw(1, Key(seed), stratified).pixels.numpy() for seed in range(300)])
    assert stats.chisquare(np.bincount(drawn, minlength=4), np.array([30, 60, 90, 120])).pvalue > 1e-3


# ---------------------------------------------------------------- references


@pytest.mark.parametrize("on_device", [0, 1 << 20])
def test_references_are_looked_up_pixel_by_pixel_wherever_they_live(on_device: int) -> None:
    rng = np.random.default_rng(4)
    views = [
        ur.View(rng.random((3, 5, 3)).astype(np.float32), weight=2.0),
        ur.View(rng.random((2, 2, 3)).astype(np.float32), mask=rng.random((2, 2))),
    ]
    found = References(views, array, on_device)
    assert found.in_host_memory == (on_device == 0)
    which, pixels = np.array([1, 0, 0, 1], np.uint32), np.array([3, 14, 0, 3], np.uint32)
    values, factors = found.at(which, pixels)
    pictures = [np.asarray(view.reference).reshape(-1, 3) for view in views]
    np.testing.assert_allclose(values, [pictures[v][p] for v, p in zip(which, pixels, strict=True)])
    masks = [np.ones(15), np.asarray(views[1].mask).ravel()]
    expected = [masks[v][p] * views[v].weight / pictures[v].size for v, p in zip(which, pixels, strict=True)]
    np.testing.assert_allclose(factors[:, 0], expected, rtol=1e-6)


def test_a_batch_of_all_pixels_is_the_whole_problem() -> None:
    asked = problem(ur.losses.Huber(), views=2)
    renderer = asked.renderer
    assert isinstance(renderer, AnalyticRenderer)
    image = renderer.exact(asked.initial())
    flat = np.concatenate([image.reshape(-1, 3)] * 2)
    draw = PixelSample(
        np.repeat([0, 1], 16).astype(np.uint32), np.tile(np.arange(16), 2).astype(np.uint32), np.ones((32, 1))
    )
    batch = PixelBatch(asked, draw)
    views = [FullView(asked, 0), FullView(asked, 1)]
    assert batch.loss_value(flat) == pytest.approx(sum(view.loss_value(image) for view in views))
    whole = np.concatenate([view.loss_derivative(image).reshape(-1, 3) for view in views])
    np.testing.assert_allclose(batch.loss_derivative(flat), whole)


# ---------------------------------------------------------------- schemes


def exact_density(asked: ur.Problem, spp: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """|∂L/∂I| and sqrt(Σ_c E[(∂L/∂I)²] Σ_k E[(∂I/∂θ_k)²]) per pixel of view 0, L2 loss, `spp` samples, noise of one sample."""
    renderer = asked.renderer
    assert isinstance(renderer, AnalyticRenderer)
    image = renderer.exact(asked.initial())
    reference = np.asarray(asked.views[0].reference)
    linear = image - renderer.offset.reshape(image.shape)
    variance = (renderer.noise * linear) ** 2 / 3 / spp  # of noise (2u - 1)
    squares = 4 * ((image - reference) ** 2 + variance)
    moments_ = (renderer.matrix**2).sum(axis=1).reshape(image.shape) * (1 + renderer.noise**2 / 3)
    return np.abs(image - reference).sum(2), np.sqrt((squares * moments_).sum(2))


def test_adaptive_probabilities_are_those_of_equation_12(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pixel_statistics, "ROUNDS", 4000)
    asked = problem(views=1, noise=0.8)
    scheme = ur.pixels.Adaptive(16, levels=0, samples=16 * 4000, uniform=1e-6, denoiser="none")
    parameters = asked.initial()
    pick, _ = scheme.draw(asked, parameters, scheme.init(asked, parameters), Key(0))
    density = exact_density(asked)[1]
    np.testing.assert_allclose(pick.probability[0], density / density.mean(), rtol=0.05)


def test_probabilities_of_the_loss_are_those_of_equation_5() -> None:
    asked = problem(views=1, noise=0.0)
    scheme = ur.pixels.LossProportional(16, samples=32, uniform=1e-6, denoiser="none")
    parameters = asked.initial()
    pick, _ = scheme.draw(asked, parameters, scheme.init(asked, parameters), Key(0))
    density = exact_density(asked)[0]
    np.testing.assert_allclose(pick.probability[0], density / density.mean(), rtol=1e-5)


def test_a_uniform_share_is_kept() -> None:
    asked = problem(views=2)
    options: dict[str, Any] = {"uniform": 0.3, "samples": 1000, "denoiser": "none"}
    for scheme in (ur.pixels.Adaptive(64, **options), ur.pixels.LossProportional(64, **options)):
        parameters = asked.initial()
        pick, _ = scheme.draw(asked, parameters, scheme.init(asked, parameters), Key(0))
        maps = np.stack([pick.probability[view] for view in (0, 1)])
        assert maps.min() >= 0.3 - 1e-6
        assert maps.mean() == pytest.approx(1.0, rel=1e-5)
        assert maps.std() > 0.02


def test_the_adaptive_gradient_has_less_variance_than_the_others() -> None:
    """On a picture most of whose pixels tell nothing, and some of which are noisy."""
    rng = np.random.default_rng(5)
    matrix = rng.random((16 * 3, 4)) * np.repeat(rng.random(16) < 0.3, 3)[:, None]
    renderer = AnalyticRenderer({"x": np.full(4, 0.6)}, matrix, 0.1, 0.5, shape=(4, 4))
    reference = renderer.exact({"x": np.full(4, 0.9)}) + rng.normal(0, 0.3, (4, 4, 3)) ** 2
    asked = ur.Problem(renderer, [ur.Parameter("x", 0.5)], [ur.View(reference)])
    variances = {}
    for name, scheme in SCHEMES.items():
        options = {} if name == "uniform" else {"samples": 1600, "denoiser": "none", "uniform": 0.05}
        levels = {"levels": 0} if name == "adaptive" else {}
        estimator = ur.PathGradient(pixels=scheme(8, stratified=False, **options, **levels), spp=2)
        state = estimator.init(asked, asked.initial())
        rows = []
        for step in range(400):
            found, state = estimator.estimate(asked, asked.initial(), state, Key(0, step))
            rows.append(found.gradient["x"])
        variances[name] = np.var(rows, axis=0).sum()
    assert variances["adaptive"] < 0.85 * variances["loss"]
    assert variances["adaptive"] < 0.6 * variances["uniform"]


@pytest.mark.parametrize("count", [1, 3, 4, 5])
def test_maps_are_cleaned_side_by_side_and_come_back_in_their_places(count: int) -> None:
    maps = np.random.default_rng(6).random((count, 5, 7, 3)) * 1e-9
    seen: list[tuple[int, ...]] = []

    def clean(picture: np.ndarray) -> np.ndarray:
        seen.append(picture.shape)
        return picture

    np.testing.assert_allclose(denoise_side_by_side(maps, clean), maps)
    assert len(seen) == 1


def test_maps_are_made_anew_every_so_often() -> None:
    asked = problem()
    estimator = ur.PathGradient(pixels=ur.pixels.Adaptive(10, refresh=4, samples=32), spp=2)
    state = estimator.init(asked, asked.initial())
    samples = []
    for step in range(9):
        found, state = estimator.estimate(asked, asked.initial(), state, Key(0, step))
        samples.append(found.info["samples"])
    assert samples == [20 + 64, 20, 20, 20, 20 + 64, 20, 20, 20, 20 + 64]


@pytest.mark.parametrize("statistics", ["shared", "independent"])
@pytest.mark.parametrize("coupled", [False, True])
def test_a_step_ages_the_map_once_however_many_batches_it_draws(statistics: Any, coupled: bool) -> None:
    """And shows it one gradient: the second of a step would come from other pixels and fewer samples."""
    asked = problem(noise=0.9)
    seen: list[int] = []

    @dataclasses.dataclass(frozen=True)
    class Watched(ur.pixels.Adaptive):
        def observe(self, problem: Any, state: Any, gradient: Any) -> Any:
            seen.append(state.age)
            return super().observe(problem, state, gradient)

    pixels = Watched(10, refresh=4, samples=32, denoiser="none")
    estimator = ur.MetaEstimator(coupled=coupled, statistics=statistics, pixels=pixels)
    state = estimator.init(asked, asked.initial())
    ages, refreshes = [], []
    at = asked.initial()
    for step in range(9):
        at = {key: value + 0.01 for key, value in at.items()}
        _, state = estimator.estimate(asked, at, state, Key(0, step))
        ages.append(state.pixels.age)
        refreshes.append(state.pixels.refreshes)
    assert ages == [1, 2, 3, 4, 1, 2, 3, 4, 1]
    assert refreshes == [1] * 4 + [2] * 4 + [3]
    assert seen == ages


def test_batches_of_one_step_have_other_pixels_and_the_same_probabilities() -> None:
    asked = problem(noise=0.9)
    for name, scheme in SCHEMES.items():
        pixels = scheme(64, **({} if name == "uniform" else {"samples": 64, "denoiser": "none"}))
        first, state = pixels.draw(asked, asked.initial(), pixels.init(asked, asked.initial()), Key(0))
        again = pixels.redraw(asked, state, Key(1))
        assert not np.array_equal(first.sample.pixels, again.sample.pixels)
        weight_of = dict(zip(first.sample.pixels.tolist(), first.sample.weights[:, 0].tolist(), strict=True))
        shared = [i for i, pixel in enumerate(again.sample.pixels.tolist()) if pixel in weight_of]
        assert len(shared) > 10
        for i in shared:
            assert again.sample.weights[i, 0] == weight_of[int(again.sample.pixels[i])]
        assert again.samples == 0


def test_a_sampler_of_somebody_else_that_cannot_draw_again_still_works() -> None:
    asked = problem(noise=0.9)

    class Plainer:
        def __init__(self) -> None:
            self.inner = ur.pixels.Uniform(8)

        def init(self, problem: Any, parameters: Any) -> Any:
            return self.inner.init(problem, parameters)

        def draw(self, problem: Any, parameters: Any, state: Any, key: Key) -> Any:
            return self.inner.draw(problem, parameters, state, key)

        def observe(self, problem: Any, state: Any, gradient: Any) -> Any:
            return state

    found = []
    for pixels in (Plainer(), ur.pixels.Uniform(8)):
        estimator = ur.MetaEstimator(pixels=pixels)
        state = estimator.init(asked, asked.initial())
        for step in range(3):
            estimate, state = estimator.estimate(asked, asked.initial(), state, Key(0, step))
        found.append(estimate.gradient)
    for key in found[0]:
        np.testing.assert_array_equal(found[0][key], found[1][key])


def test_probabilities_that_cannot_be_estimated_are_equal() -> None:
    """Nothing to learn (no error, no noise), or values that are not finite."""
    exact = problem(noise=0.0)
    renderer = exact.renderer
    assert isinstance(renderer, AnalyticRenderer)
    solved = ur.Problem(
        renderer, [ur.Parameter(k, v) for k, v in exact.truth.items()], [ur.View(np.asarray(exact.views[0].reference))]
    )
    parameters = {k: np.asarray(v, np.float64) for k, v in exact.truth.items()}
    scheme = ur.pixels.Adaptive(16, denoiser="none")
    pick, _ = scheme.draw(solved, parameters, scheme.init(solved, parameters), Key(0))
    assert np.isfinite(pick.probability[0]).all()
    broken = {k: v * np.nan for k, v in parameters.items()}
    pick, _ = scheme.draw(solved, broken, scheme.init(solved, broken), Key(0))
    np.testing.assert_allclose(pick.probability[0], 1.0)


def test_a_refresh_that_saw_nothing_finite_is_forgotten() -> None:
    asked = problem(noise=0.9)
    scheme = ur.pixels.Adaptive(16, refresh=1, samples=64, denoiser="none")
    at = {k: np.asarray(v, np.float64) for k, v in asked.initial().items()}
    broken = {k: v * np.nan for k, v in at.items()}
    _, state = scheme.draw(asked, broken, scheme.init(asked, at), Key(0))
    state = scheme.observe(asked, state, broken)
    pick, state = scheme.draw(asked, at, state, Key(1))
    assert np.isfinite(pick.probability[0]).all()
    assert np.ptp(pick.probability[0]) > 0.1


def test_refreshes_count_alike_whatever_the_size_of_what_they_saw() -> None:
    """The second refresh sees variances in units of gradients a thousand times smaller: the same shapes, and as much weight."""
    asked = problem(noise=0.9)
    scheme = ur.pixels.Adaptive(16, refresh=1, samples=64, denoiser="none")
    at = asked.initial()
    found = []
    for second_moment in (1.0, 1e-6):
        _, state = scheme.draw(asked, at, scheme.init(asked, at), Key(0))
        state = dataclasses.replace(
            state, second_moment={k: np.full(np.shape(v), second_moment) for k, v in at.items()}
        )
        found.append(scheme.draw(asked, at, state, Key(1))[0].probability[0])
    np.testing.assert_allclose(found[0], found[1], rtol=1e-5)


def test_tangents_go_through_preconditioners() -> None:
    """In the coordinates of the descent, x = S u, the sum is over u."""
    asked = problem()

    class Halve:
        def check(self, key: str, shape: tuple[int, ...]) -> None: ...
        def apply(self, x: Any) -> Any:
            return x * 0.5

    eased = ur.Problem(
        asked.renderer, [dataclasses.replace(p, preconditioner=Halve()) for p in asked.parameters], asked.views
    )
    found = []
    for one in (asked, eased):
        whole = cut(one, 16)
        uniform_table = InverseCdfTable.of(whole, whole.sizes, one.renderer.array)
        seen = pixel_statistics.estimate_statistics(
            one, one.initial(), whole, uniform_table, 4, Key(0), [], pixel_statistics.scales(one.initial(), {})
        )
        found.append(seen.second_moment)
    np.testing.assert_allclose(found[1], found[0] * 0.25)


def test_relative_variances_are_not_ruled_by_one_bright_element() -> None:
    """Elements of four times the energy weigh half, whatever a single path brought another element; one never met stays finite."""
    second_moment = np.concatenate([np.full(500, 1.0), np.full(498, 4.0), [1e9, 0.0]])
    scales = pixel_statistics.scales({"a": second_moment}, {"a": second_moment})["a"]
    assert scales[0] / scales[500] == pytest.approx(2.0, rel=0.1)
    assert scales[0] / scales[-2] == pytest.approx(np.sqrt(1e9), rel=0.1)
    assert scales[0] < scales[-1] < 5 * scales[0]


def test_a_parameter_of_few_elements_counts_as_much_as_one_of_many() -> None:
    second_moment = {"colour": np.full(3, 0.2), "texture": np.full((20, 20, 3), 7.0)}
    scales = pixel_statistics.scales(second_moment, second_moment)
    shares = {name: float(np.sum(scales[name] ** 2 * second_moment[name])) for name in second_moment}
    assert shares["colour"] == pytest.approx(shares["texture"], rel=1e-6)


@pytest.mark.slow
def test_maps_are_means_over_refreshes() -> None:
    """At a standstill four of them have a quarter of the variance of one."""
    asked = problem(noise=0.9)
    scheme = ur.pixels.Adaptive(16, refresh=1, samples=64, denoiser="none")
    at = asked.initial()
    found: dict[int, list[np.ndarray]] = {1: [], 4: []}
    for seed in range(200):
        state = scheme.init(asked, at)
        for step in range(1, 5):
            _, state = scheme.draw(asked, at, state, Key(seed, step))
            if step in found:
                found[step].append(np.concatenate([part.ravel() for part in state.maps]))
    one, four = (np.var(found[n], axis=0, ddof=1).sum() for n in (1, 4))
    assert one / four == pytest.approx(4.0, rel=0.25)


def test_a_control_variate_found_at_whole_views_now_and_then() -> None:
    asked = problem(views=2, noise=0.9)
    image = ur.images.RecursiveControlVariate(whole_views=4)
    estimator = ur.PathGradient(image, ur.pixels.Uniform(16), spp=2)
    state = estimator.init(asked, asked.initial())
    whole = []
    for step in range(11):
        found, state = estimator.estimate(asked, asked.initial(), state, Key(0, step))
        whole.append(bool(found.info["images"]))
    assert whole == [True, False, False, False, False] * 2 + [True]
    # After a step of whole views.
    rendered = np.concatenate([memory.image.reshape(-1, 3) for memory in state.image.views])
    np.testing.assert_array_equal(state.image.snapshot.image, rendered)


@pytest.mark.parametrize("planted", [False, True])
def test_a_snapshot_remembers_what_mini_batches_render_of_its_state(planted: bool) -> None:
    """Its image stays unbiased, of its own state, with the variance that the recurrence says; that of the present state would not do."""
    asked = problem(noise=0.5)
    renderer, start = asked.renderer, asked.initial()
    assert isinstance(renderer, AnalyticRenderer)
    moved = {key: value + 0.2 for key, value in start.items()}
    image = ur.images.RecursiveControlVariate()
    rows = np.random.default_rng(0).integers(0, asked.pixels, 40)
    variance = np.zeros(0)
    drawn = PixelSample(np.zeros(40, np.uint32), rows.astype(np.uint32), np.ones((40, 1)))
    found: dict[bool, list[np.ndarray]] = {False: [], True: []}
    for seed in range(400):
        _, kept = image.estimate(asked, start, image.init(asked, start), FullView(asked, 0), 2, 2, Key(seed))
        state = image.prepare(asked, image.advance(start, image.init(asked, start), (kept,)))
        at = start if not planted else moved
        state = dataclasses.replace(state, parameters=at)
        _, told = image.estimate(asked, moved, state, PixelBatch(asked, drawn), 2, 2, Key(seed, 1))
        after = image.learn(asked, state, drawn, told)
        for learnt, each in ((False, state), (True, after)):
            assert each.snapshot is not None
            found[learnt].append(np.asarray(each.snapshot.image))
            variance = np.asarray(each.snapshot.relative_variance)
    learnt, exact = np.array(found[True]), renderer.exact(start).reshape(-1, 3)
    error = np.sqrt(learnt.var(0, ddof=1) / len(learnt))
    worst = np.abs((learnt.mean(0) - exact) / error).max()
    assert (worst > 4.2) == planted
    if planted:
        return
    times = np.bincount(rows, minlength=asked.pixels)
    np.testing.assert_allclose(variance, np.repeat(1 / (1 + times[:, None]), 3, axis=1))
    ratio = (learnt.var(0) / np.array(found[False]).var(0)).mean(1)
    assert abs(np.mean(ratio * (1 + times)) - 1) < 0.1


@pytest.mark.slow
def test_a_snapshot_makes_batches_quieter() -> None:
    asked = problem(noise=0.9)
    renderer = asked.renderer
    assert isinstance(renderer, AnalyticRenderer)
    at = asked.initial()
    exact = np.concatenate([g.ravel() for g in exact_gradient(asked, at).values()])
    errors = []
    for image in (ur.images.Plain(), ur.images.RecursiveControlVariate(whole_views=10)):
        estimator = ur.PathGradient(image, ur.pixels.Uniform(16), spp=2)
        squares = []
        for seed in range(30):
            state = estimator.init(asked, at)
            for step in range(40):
                found, state = estimator.estimate(asked, at, state, Key(seed, step))
                if step > 30 and not found.info["images"]:
                    squares.append((np.concatenate([g.ravel() for g in found.gradient.values()]) - exact) ** 2)
        errors.append(np.mean(squares))
    assert errors[1] < 0.8 * errors[0]


def test_what_makes_no_sense_is_refused() -> None:
    refused: list[tuple[Any, dict[str, Any], str]] = [
        (ur.pixels.Uniform, {"count": 0}, "count"),
        (ur.pixels.Uniform, {"count": 2.5}, "count"),
        (ur.pixels.Adaptive, {"count": -1}, "count"),
        (ur.pixels.Adaptive, {"count": 0}, "count"),
        (ur.pixels.Adaptive, {"count": 8, "levels": -1}, "levels"),
        (ur.pixels.Adaptive, {"count": 8, "refresh": 0}, "refresh"),
        (ur.pixels.Adaptive, {"count": 8, "uniform": 0.0}, "uniform"),
        (ur.pixels.Adaptive, {"count": 8, "uniform": 1.5}, "uniform"),
        (ur.pixels.Adaptive, {"count": 8, "samples": 0}, "samples"),
        (ur.pixels.LossProportional, {"count": 8, "denoiser": "median"}, "denoiser"),
    ]
    for kind, options, name in refused:
        with pytest.raises(ur.InputError, match=f"{kind.__name__}: {name}"):
            kind(**options)
    for pixels in (ur.pixels.All, "all", None, 100):
        with pytest.raises(ur.InputError, match="PathGradient: pixels"):
            ur.PathGradient(pixels=pixels)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ur.InputError, match="whole_views"):
        ur.images.RecursiveControlVariate(whole_views=0)

    @dataclasses.dataclass(frozen=True)
    class Blurred(ur.losses.L2):
        @property
        def pixelwise(self) -> bool:
            return False

    with pytest.raises(ur.InputError, match=r"Blurred is a loss of full images"):
        ur.optimize(problem(Blurred()), ur.PathGradient(pixels=ur.pixels.Uniform(8)), ur.optimizers.Adam(), steps=1)
