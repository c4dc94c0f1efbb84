"""Fresh pictures judge a run: no false alarms, and planted faults are found. All in NumPy."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from tiers import quick, slow
from unrender.estimators import fresh_pictures
from unrender.estimators.fresh_pictures import FreshPictures, Residuals
from unrender.images.base import leave_one_out
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.runs import run, verification, verify
from unrender.runs.folder import reader
from unrender.runs.folder.schema import NOT_VERIFIED, RunRecord
from unrender.scene.prior import Prior
from unrender.statistics import debiased, paired_losses

SIDE, WIDE, SIZE = 12, 20, 6
RCV = ur.PathGradient(image=RecursiveControlVariate(), spp=4)


def made(
    seed: int = 0,
    start: float | None = 0.1,
    noise: float = 0.5,
    offset: float = 0.0,
    views: int = 1,
    loss: ur.losses.Loss | None = None,
    white: float = np.inf,
) -> ur.Problem:
    """A linear problem; `start` None begins at the truth, `offset` is light that the references have and the renderer has not. References
    are saturated at `white`."""
    generator = np.random.default_rng(seed)
    matrix, truth = generator.random((SIDE * SIDE * 3, SIZE)), generator.random(SIZE)
    renderer = AnalyticRenderer({"x": np.full(SIZE, 0.5)}, matrix, noise=noise, shape=(SIDE, SIDE), sensors=views)
    reference = np.minimum(matrix @ truth + offset, white).reshape(SIDE, SIDE, 3)
    begin = truth if start is None else np.full(SIZE, start)
    seen = [ur.View(reference, sensor) for sensor in range(views)]
    return ur.Problem(renderer, [ur.Parameter("x", initial=begin)], seen, loss, truth={"x": truth})


@ur.register
@dataclass(frozen=True)
class Rising(ur.schedules.Schedule):
    """A rate that rises after 70 steps and spoils what was reached."""

    def __call__(self, step: int) -> float:
        return 1.0 if step < 70 else 40.0


@dataclass(frozen=True)
class Away:
    """An optimizer that adds a constant at each step, whatever the gradient."""

    pace: float = 0.002
    schedule: ur.schedules.Schedule | None = None

    @property
    def requires(self) -> frozenset[str]:
        return frozenset()

    def init(self, parameters: Any, learning_rates: Any = None) -> int:
        return 0

    def update(self, estimate: Any, state: int, parameters: Any) -> tuple[Any, int]:
        return {key: value * 0 + self.pace for key, value in parameters.items()}, state + 1


@pytest.mark.slow
def test_a_loss_within_the_noise_of_few_paths_is_judged_by_more(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = made(start=None, noise=8.0)
    found = ur.optimize(problem, ur.PathGradient(spp=1024), Away(), steps=40)
    assert found.status == "worse than start"
    np.testing.assert_array_equal(found.parameters["x"], found.initial["x"])
    assert ur.optimize(problem, ur.PathGradient(spp=1024), Away(1e-9), steps=40).status == "finished"
    monkeypatch.setattr(verify, "_MOST_SHARE", 0.0)
    assert ur.optimize(problem, ur.PathGradient(spp=1024), Away(), steps=40).status == "finished"
    monkeypatch.undo()
    monkeypatch.setattr(run.Run, "time_left", lambda self: 0.0)
    assert ur.optimize(problem, ur.PathGradient(spp=1024), Away(), steps=40).status == "finished"


def test_a_larger_loss_at_the_end_of_a_run_of_few_paths_is_judged_by_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """A smoothed loss of many numbers rose: 4,000 paths did not tell it, and the values further away were returned."""
    problem, paths = made(start=None, noise=4.0), ur.PathGradient(spp=16)

    def statuses(pace: float) -> set[str]:
        return {ur.optimize(problem, paths, Away(pace), steps=40, seed=seed).status for seed in range(4)}

    assert statuses(0.002) == {"worse than start"}
    assert statuses(1e-9) == {"finished"}
    monkeypatch.setattr(verify, "_LEAST_DOUBTFUL", verify._LEAST_LARGER)
    assert "finished" in statuses(0.002)


@pytest.mark.parametrize("pace", [0.002, 1e-9])
def test_all_paths_are_at_most_a_fiftieth_of_the_runs_and_more_paths_have_their_own_random_numbers(
    pace: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers: dict[int, list[int]] = {}

    class Numbered(FreshPictures):
        def picture(self, parameters: Any, problem: Any = None) -> Any:
            numbers.setdefault(self.paths, []).append(self._key.fold(1).uint32())
            return super().picture(parameters, problem)

    monkeypatch.setattr(verify, "FreshPictures", Numbered)
    problem, forms = noting(made(start=None, noise=8.0), offset=0.0, noise=8.0)
    result = ur.optimize(problem, ur.PathGradient(spp=1024), Away(pace), steps=40)
    assert result.status == ("finished" if pace < 1e-3 else "worse than start")
    *fewer, many = (numbers[paths] for paths in sorted(numbers))
    assert (len(many), len(set(many))) == (2, 1)  # the start and the end
    assert not {number for of in fewer for number in of} & set(many)
    paths = sum(spp * SIDE * SIDE for spp, _ in forms)
    assert paths <= 0.02 * 40 * 1024 * SIDE * SIDE


@pytest.mark.slow
@pytest.mark.parametrize(("spp", "steps"), [(4, 64), (8, 150), (16, 300)])
def test_all_pictures_of_a_run_of_a_million_paths_use_at_most_a_fiftieth_of_them(spp: int, steps: int) -> None:
    """The start, candidates, the end, the control variate, and what larger images use."""
    problem, forms = noting(made(views=30))
    ur.optimize(problem, replace(RCV, spp=spp), ur.optimizers.Adam(0.03), steps=steps)
    paths = sum(of_pixel * (pixels or SIDE * SIDE) for of_pixel, pixels in forms)
    assert 3 * 4096 <= paths <= 0.02 * steps * spp * 30 * SIDE * SIDE


def test_a_run_of_sixty_steps_on_a_small_film_is_compared_with_an_earlier_step() -> None:
    """It has 2,304 pixels with 8 samples each, as by `auto`."""
    problem = made(views=16)
    result = ur.optimize(problem, ur.PathGradient(spp=8), ur.optimizers.Adam(0.01), steps=60)
    assert result.verification["change"]["step"] == 16


@pytest.mark.parametrize(("probability", "told"), [(0.5, False), (0.1, False), (0.02, True), (0.005, True)])
def test_pictures_whose_light_few_paths_bring_are_told(probability: float, told: bool) -> None:
    """Pixels of different brightness; the number in the line is that of the paths within a third."""
    generator, spp = np.random.default_rng(0), 16
    brightness = generator.uniform(0.5, 2.0, (400, 1))
    hits = generator.binomial(spp, probability, (4, 400, 1)) / (spp * probability)
    line = verification.rare_light([hits * brightness * np.ones(3)], np.ones(400), spp)
    assert bool(line) == told
    if told:
        assert int(line.split(" brings")[0].split()[-1]) == pytest.approx(1.0 / probability, rel=0.35)
    assert verification.rare_light([np.zeros((4, 9, 3))], np.ones(9), spp) == ""


def test_pixels_outside_the_mask_tell_nothing_of_rare_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of a picture has light that one path in 200 brings; a mask leaves that half out."""
    generator, spp = np.random.default_rng(0), 16
    hits = generator.binomial(spp, np.repeat([0.5, 0.005], 200)[:, None], (4, 400, 1)) / (
        spp * np.repeat([0.5, 0.005], 200)[:, None]
    )
    images = [part * np.ones(3) for part in np.split(hits, 2, axis=1)]
    mask = np.repeat([1.0, 0.0], 200)
    assert verification.rare_light(images, np.ones(400), spp)
    assert verification.rare_light(images, mask, spp) == ""

    noted: list[np.ndarray] = []
    monkeypatch.setattr(verify, "rare_light", lambda images, weights, spp: noted.append(weights) or "")
    masked = made()
    view = ur.View(masked.views[0].reference, 0, mask=np.arange(SIDE * SIDE).reshape(SIDE, SIDE) % 2)
    ur.optimize(
        ur.Problem(masked.renderer, masked.parameters, [view]), ur.PathGradient(spp=1), ur.optimizers.SGD(1e-3), steps=2
    )
    assert [list(weights) for weights in noted] == [list(np.arange(SIDE * SIDE) % 2)]


def test_parts_of_the_launches_have_the_same_mean() -> None:
    problem = made()
    one, several = FreshPictures(problem, 1, 1 << 17), FreshPictures(problem, 1, 1 << 17, parts=8)
    values = problem.initial()
    assert one.paths == several.paths
    (few,), (many,) = one.images(values), several.images(values)
    assert (len(few), len(many)) == (4, 32)
    np.testing.assert_allclose(many.mean(axis=0), few.mean(axis=0), rtol=1e-12)
    assert many.std(axis=0).mean() > 2.0 * few.std(axis=0).mean()


# ---------------------------------------------------------------------- the statistics


def skewed(generator: np.random.Generator, *shape: int) -> np.ndarray:
    """Noise of mean 0 with rare bright values, as of fireflies."""
    return generator.lognormal(0.0, 1.2, shape) - np.exp(0.72)


@pytest.mark.parametrize("name", ["normal", "skewed"])
def test_a_difference_of_nothing_rarely_exceeds_its_noise(name: str) -> None:
    """4,000 pairs of equal losses at a level of 1 in 100, so that a rate above the level would show: at most its 5 σ."""
    generator = np.random.default_rng(1)
    alarms = 0
    for _ in range(4000):
        noise = generator.normal(size=(2, 4, 64)) if name == "normal" else skewed(generator, 2, 4, 64)
        alarms += paired_losses.difference(noise[0], noise[1]).exceeds_noise(0.01)
    assert alarms <= 40 + 5 * np.sqrt(40)


def test_a_difference_is_estimated_with_its_standard_error() -> None:
    generator = np.random.default_rng(2)
    found = [
        paired_losses.difference(generator.normal(size=(4, 50)), generator.normal(0.3, 1, (4, 50))) for _ in range(500)
    ]
    values = np.array([one.value for one in found])
    errors = np.array([one.standard_error for one in found])
    assert abs(values.mean() - 15.0) < 4 * values.std() / np.sqrt(500)
    assert 0.9 < values.std() / np.sqrt((errors**2).mean()) < 1.1
    assert all(one.exceeds_noise(1e-3) == (one.value > 0) for one in found if abs(one.value) > 8 * one.standard_error)


def test_the_jackknife_takes_the_noise_out_of_a_quadratic_loss() -> None:
    generator = np.random.default_rng(3)
    losses = []
    for _ in range(4000):
        images = 0.2 + generator.normal(size=(4, 10))
        pseudo = paired_losses.pseudo_values(images.mean(axis=0) ** 2, leave_one_out(images) ** 2)
        losses.append(pseudo.mean())
    assert abs(np.mean(losses) - 0.04) < 4 * np.std(losses) / np.sqrt(len(losses))


@pytest.mark.parametrize("name", ["normal", "skewed"])
def test_independent_noise_has_no_systematic_part(name: str) -> None:
    """Of 2,000 scores none is above the threshold of a run, and few are above 3."""
    generator = np.random.default_rng(4)
    scores, squares = [], []
    for _ in range(2000):
        noise = [generator.normal(size=(256, 3)) if name == "normal" else skewed(generator, 256, 3) for _ in range(2)]
        found = paired_losses.systematic(noise[0] - noise[1])
        scores.append(found.score)
        squares.append(found.mean_square)
    assert max(scores) < 4.5
    assert np.mean(np.array(scores) > 3.0) < 0.01
    assert abs(np.mean(squares)) < 5 * np.std(squares) / np.sqrt(len(squares))


@pytest.mark.parametrize("rare", [0.3, 1.0, 3.0])
def test_rare_bright_samples_are_no_smooth_difference(rare: float) -> None:
    """Blocks of pixels that all of them miss are too dark and have little scatter: every second picture was reported."""
    generator, size, light = np.random.default_rng(6), (36, 36), 0.05
    chance = rare / 144  # of a pixel to have one, with `rare` of them in a block
    scores = []
    for _ in range(30):
        bright = light * (generator.poisson(chance, (4, *size, 1)) / chance - 1.0)
        values = (bright + generator.normal(0.0, 0.05, (4, *size, 3))).reshape(-1, 3)
        scores.append(paired_losses.in_blocks(values, np.ones(len(values), bool), [size] * 4, 5e-4).score)
    assert np.count_nonzero(np.array(scores) > paired_losses.SIGNIFICANT) <= 1


def test_a_shared_part_is_measured() -> None:
    generator = np.random.default_rng(5)
    found = [paired_losses.systematic(0.7 + generator.normal(size=(256, 3))) for _ in range(300)]
    squares = np.array([one.mean_square for one in found])
    assert abs(squares.mean() - 0.49) < 4 * squares.std() / np.sqrt(300)
    assert np.mean([one.score > 4.5 for one in found]) > 0.9


# ---------------------------------------------------------------------- runs that are right


@pytest.mark.parametrize("seeds", [range(4), slow(range(4, 78))], ids=str)
@pytest.mark.parametrize(
    "estimator",
    [
        slow(ur.PathGradient(spp=4)),
        RCV,
        slow(replace(RCV, pixels=ur.pixels.Uniform(32))),
        slow(ur.MetaEstimator()),
    ],
    ids=["plain", "control variate", "control variate of mini-batches", "meta"],
)
def test_runs_that_succeed_are_finished(estimator: Any, seeds: range) -> None:
    for seed in seeds:
        result = ur.optimize(made(seed % 7), estimator, ur.optimizers.Adam(0.03), steps=70, seed=seed)
        assert result.status == "finished", (seed, result.warnings, result.verification)
        assert result.verification["end"][0] < result.verification["start"][0]


@pytest.mark.parametrize(
    "loss", [ur.losses.L1(), ur.losses.RelativeL2(), ur.losses.Huber(0.1)], ids=lambda loss: type(loss).__name__
)
def test_every_loss_is_verified(loss: ur.losses.Loss) -> None:
    result = ur.optimize(made(loss=loss), RCV, ur.optimizers.Adam(0.03), steps=70)
    assert result.status == "finished"
    assert result.verification["end"][0] < 0.5 * result.verification["start"][0]


# ---------------------------------------------------------------------- runs that cannot succeed


def test_a_rate_that_is_too_high_ends_worse_than_it_began() -> None:
    problem = made(start=0.45)
    result = ur.optimize(problem, ur.PathGradient(spp=4), ur.optimizers.SGD(5.0), steps=10)
    assert result.status == "worse than start"
    np.testing.assert_array_equal(result.parameters["x"], result.initial["x"])
    assert np.abs(result.last["x"] - result.initial["x"]).max() > 1
    (line,) = [line for line in result.warnings if "worse than the initial one" in line]
    assert "lower learning_rate" in line


def test_a_descent_from_the_truth_that_leaves_it_is_told() -> None:
    result = ur.optimize(made(start=None), ur.PathGradient(spp=1), ur.optimizers.Adam(0.5), steps=20)
    assert result.status == "worse than start"
    assert result.best is result.parameters


@pytest.mark.parametrize(("known", "told"), [({"x": 0.9, "y": -2.0}, ["y"]), ({"x": 0.9}, []), ({}, [])])
def test_a_parameter_that_ends_further_from_its_truth_is_told(known: dict[str, float], told: list[str]) -> None:
    """The picture shows x + y / 10 alone: equal steps of Adam reach it with a y that is further away."""
    matrix = np.tile([[1.0, 0.1]], (SIDE * SIDE * 3, 1))
    renderer = AnalyticRenderer({"x": np.zeros(()), "y": np.zeros(())}, matrix, noise=0.1, shape=(SIDE, SIDE))
    reference = (matrix @ [0.9, -2.0]).reshape(SIDE, SIDE, 3)
    truth = {key: np.array(value) for key, value in known.items()}
    problem = ur.Problem(renderer, [ur.Parameter("x"), ur.Parameter("y")], [ur.View(reference)], truth=truth)
    result = ur.optimize(problem, ur.PathGradient(spp=4), ur.optimizers.Adam(0.05), steps=40)
    assert (result.status, result.verification["best"]) == ("finished", "end")
    assert [line.split()[0] for line in result.warnings if "further from the truth" in line] == told


def test_values_that_render_no_number_are_worse() -> None:
    class Broken(AnalyticRenderer):
        """Renders no number where the parameters are above 0.3, and more than one group is asked for."""

        def image(self, parameters: Any, request: Any) -> Any:
            found = super().image(parameters, request)
            bad = request.groups == 4 and float(np.max(parameters["x"])) > 0.3
            return replace(found, images=found.images * np.nan) if bad else found

    problem = made()
    assert isinstance(problem.renderer, AnalyticRenderer)
    broken = Broken({"x": np.full(SIZE, 0.5)}, problem.renderer.matrix, shape=(SIDE, SIDE))
    result = ur.optimize(
        problem.with_parts(renderer=broken), ur.PathGradient(spp=2), ur.optimizers.Adam(0.05), steps=30
    )
    assert result.status == "worse than start"
    assert result.verification["end"] == [None, None]


@dataclass(frozen=True)
class WrongWeight(RecursiveControlVariate):
    """Subtracts the previous image with another weight than it adds the memory with."""

    factor: float = 1.0

    def _combine_view(self, memory: Any, rendering: Any, asked: Any, frame: Any) -> Any:
        wrong = replace(rendering, previous=rendering.previous * self.factor)
        return super()._combine_view(memory, wrong, asked, frame)


@pytest.mark.parametrize("factor", quick([0.9, 0.97, 1.1], 0.97))
def test_a_memory_with_a_wrong_weight_disagrees(factor: float) -> None:
    for seed in range(3):
        estimator = ur.PathGradient(image=WrongWeight(factor=factor), spp=4)
        result = ur.optimize(made(seed), estimator, ur.optimizers.Adam(0.03), steps=120, seed=seed)
        assert result.status in ("memory disagrees", "worse than start"), result.verification
        assert any("differs from a fresh picture" in line for line in result.warnings)
        assert result.verification["memory"]["error"] > 0


# ---------------------------------------------------------------------- what is kept


def test_earlier_parameters_are_kept_where_they_are_better(tmp_path: Path) -> None:
    """A rate that rises after 64 steps spoils what was reached."""

    problem = made()
    adam = ur.optimizers.Adam(0.05, schedule=Rising())
    result = ur.optimize(problem, ur.PathGradient(spp=4), adam, steps=90)
    assert result.verification["best"] == "step 64"
    assert problem.parameter_error(result.parameters)["x"] < 0.5 * problem.parameter_error(dict(result.last))["x"]
    assert result.verification["best_loss"][0] < result.verification["end"][0]
    result.save(tmp_path / "run")
    found = reader.read(tmp_path / "run")
    np.testing.assert_array_equal(found.parameters["x"], result.parameters["x"].astype(np.float32))
    np.testing.assert_array_equal(np.load(tmp_path / "run" / "last.npz")["x"], result.last["x"].astype(np.float32))
    assert found.record.verified == "finished"


@pytest.mark.mitsuba
@pytest.mark.parametrize(
    ("done", "steps", "spp", "best", "compared"), [(32, 64, 64, "end", 32), (64, 90, 4, "step 64", None)]
)
def test_a_run_resumed_at_a_power_of_two_has_the_earlier_pictures_of_the_whole_run(
    done: int, steps: int, spp: int, best: str, compared: int | None, tmp_path: Path
) -> None:
    """A rate that rises after 70 steps spoils what was reached."""
    parts = ur.PathGradient(spp=spp), ur.optimizers.Adam(0.05, schedule=Rising())
    whole = ur.optimize(made(), *parts, steps=steps, run_directory=tmp_path / "whole")
    ur.optimize(made(), *parts, steps=done, run_directory=tmp_path / "resumed")
    resumed = ur.resume(tmp_path / "resumed", made(), steps=steps)
    assert whole.verification["best"] == best
    assert whole.verification.get("change", {}).get("step") == compared
    assert resumed.verification == whole.verification
    np.testing.assert_array_equal(resumed.parameters["x"], whole.parameters["x"])


def test_a_result_says_the_same_as_its_folder_and_old_folders_are_not_verified(tmp_path: Path) -> None:
    result = ur.optimize(made(), RCV, ur.optimizers.Adam(0.03), steps=70)
    result.save(tmp_path / "run")
    path = tmp_path / "run" / "run.json"
    record = json.loads(path.read_text())
    assert record["status"] == "finished"
    assert record["verification"] == dict(result.verification)
    assert not (tmp_path / "run" / "last.npz").exists()
    del record["verification"]
    path.write_text(json.dumps(record))
    assert reader.read(tmp_path / "run").record.verified == NOT_VERIFIED


def test_verification_changes_no_step_and_repeats() -> None:
    first, second = (ur.optimize(made(), RCV, ur.optimizers.Adam(0.03), steps=70) for _ in range(2))
    assert first.verification == second.verification
    np.testing.assert_array_equal(first.parameters["x"], second.parameters["x"])


def test_pixels_are_drawn_where_there_are_many() -> None:
    """30 views of 144 pixels are more than 4,096 pixels: a sample of pixels is verified, its loss that of all."""
    problem = made(views=30)
    result = ur.optimize(problem, ur.PathGradient(spp=2), ur.optimizers.Adam(0.03), steps=5)
    assert isinstance(problem.renderer, AnalyticRenderer)
    exact = problem.renderer.exact(result.parameters)
    loss = 30 * float(np.mean((exact - np.asarray(problem.views[0].reference)) ** 2))
    assert result.verification["paths"] == 1 << 12
    assert result.verification["end"][0] == pytest.approx(loss, rel=0.15)
    assert result.status == "finished"


@pytest.mark.parametrize(("views", "share"), [(1, 0.0), slow(30, 0.0), slow(30, 1.0)])
def test_pictures_of_other_pixels_are_not_subtracted(views: int, share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the end of a run that stands still, other or more pixels are rendered than before, unless both pictures have all."""
    fresh: list[Any] = []
    real = verify.misfit

    def noted(*arguments: Any) -> Any:
        fresh.append(arguments[-1])
        return real(*arguments)

    monkeypatch.setattr(verify, "_SHARE", share)
    monkeypatch.setattr(verify, "misfit", noted)
    result = ur.optimize(made(views=views, offset=0.5), ur.PathGradient(spp=8), ur.optimizers.Adam(0.03), steps=300)
    assert (result.verification["paths"] > 1 << 15) is (share == 1.0)
    assert fresh
    assert all((x is None) is (views == 30) for x in fresh)


class Noting(AnalyticRenderer):
    """Notes the form of each request of four groups."""

    forms: list[tuple[int, int | None]]

    def image(self, parameters: Any, request: Any) -> Any:
        if request.groups == 4:
            self.forms.append((request.spp, None if request.pixels is None else int(np.size(request.pixels))))
        return super().image(parameters, request)


def noting(problem: ur.Problem, offset: float = 0.5, noise: float = 0.5) -> tuple[ur.Problem, list[Any]]:
    """The problem, and the list of the forms that it is asked for from now on."""
    assert isinstance(problem.renderer, AnalyticRenderer)
    sensors = len(problem.views)
    renderer = Noting(
        {"x": np.full(SIZE, 0.5)}, problem.renderer.matrix, offset, noise, shape=(SIDE, SIDE), sensors=sensors
    )
    renderer.forms = []
    return problem.with_parts(renderer=renderer), renderer.forms


@pytest.mark.parametrize(("views", "form"), [(1, (16, None)), slow(30, (4, 1024))])
def test_all_pictures_of_a_short_run_have_one_form(views: int, form: Any) -> None:
    """The start, two candidates and the end: kernels are compiled once, and no parameters are rendered twice."""
    problem, forms = noting(made(views=views))
    ur.optimize(problem, ur.PathGradient(spp=2), ur.optimizers.Adam(0.03), steps=130)
    assert len(forms) == 4
    assert set(forms) == {form}


@pytest.mark.parametrize(("views", "form"), [(1, (16, None)), (30, (4, 30 * SIDE * SIDE)), (200, (4, 1 << 14))])
def test_more_paths_are_more_pixels_and_then_more_launches(views: int, form: Any) -> None:
    problem, forms = noting(made(views=views))
    values = problem.start(0)
    few, many = FreshPictures(problem, 1, 0), FreshPictures(problem, 1, 1 << 16)
    losses = [pictures.picture(values).loss for pictures in (few, many)]
    assert forms[-1] == form
    assert {spp for spp, _ in forms} == {form[0]}
    assert many.paths > 4 * few.paths
    assert losses[1][1] < 0.6 * losses[0][1]
    assert abs(losses[0][0] - losses[1][0]) < 4 * np.hypot(losses[0][1], losses[1][1])


# ---------------------------------------------------------------------- what no parameters can explain


def smooth(offset: float, seed: int, known: bool = True) -> ur.Problem:
    """Colours of broad blobs; `offset` is a gradient of light that the references have and the renderer has not."""
    x, y = np.meshgrid(*[np.linspace(0, 1, WIDE)] * 2)
    blobs = [np.exp(-8 * ((x - a) ** 2 + (y - b) ** 2)) for a, b in ((0.2, 0.2), (0.8, 0.3), (0.4, 0.8))]
    matrix = np.kron(np.stack([blob.ravel() for blob in blobs], axis=1), np.eye(3)) + 0.02
    truth = np.random.default_rng(seed).uniform(0.3, 0.9, 9)
    renderer = AnalyticRenderer({"x": np.full(9, 0.5)}, matrix, noise=0.3, shape=(WIDE, WIDE))
    reference = (matrix @ truth).reshape(WIDE, WIDE, 3) + offset * x[..., None] ** 4
    views = [ur.View(reference)]
    return ur.Problem(
        renderer, [ur.Parameter("x", initial=np.full(9, 0.5))], views, truth={"x": truth} if known else None
    )


UNEXPLAINED = "no longer improves"


@pytest.mark.parametrize("estimator", [ur.PathGradient(spp=4), slow(RCV)], ids=["plain", "control variate"])
def test_light_that_no_unknown_explains_is_told(estimator: Any) -> None:
    for seed in range(2):
        result = ur.optimize(smooth(0.5, seed), estimator, ur.optimizers.Adam(0.02), steps=300, seed=seed)
        assert any(UNEXPLAINED in line for line in result.warnings), (seed, result.verification)
        assert result.status == "does not fit"


@pytest.mark.parametrize(("offset", "status"), [(0.5, "finished"), (2.0, "does not fit")])
def test_references_without_a_known_truth_may_differ_by_a_quarter_as_photographs_do(offset: float, status: str) -> None:
    """No model fits photographs, so their differences are only told."""
    problem = smooth(offset, 0, known=False)
    result = ur.optimize(problem, ur.PathGradient(spp=4), ur.optimizers.Adam(0.02), steps=300)
    assert any(UNEXPLAINED in line for line in result.warnings)
    assert result.status == status


@pytest.mark.parametrize("seeds", [range(3), slow(range(3, 51))], ids=str)
@pytest.mark.parametrize("rate", [slow(0.02), 0.2])
def test_a_run_that_has_converged_has_nothing_unexplained(rate: float, seeds: range) -> None:
    for seed in seeds:
        result = ur.optimize(smooth(0.0, seed), RCV, ur.optimizers.Adam(rate), steps=200, seed=seed)
        assert not any(UNEXPLAINED in line for line in result.warnings), (seed, result.warnings)
        assert result.status == "finished"


NOT_CONVERGED = "and the run has not converged: its loss has fallen by"


@pytest.mark.parametrize(
    ("steps", "rate", "stopped"), [(16, 0.1, True), (100, 0.1, True), (16, 0.5, False), (100, 2.0, False)]
)
def test_a_run_that_stopped_on_its_way_is_told(steps: int, rate: float, stopped: bool) -> None:
    for seed in range(2):
        optimizer = ur.optimizers.Adam(rate / steps)
        result = ur.optimize(smooth(0.0, seed), ur.PathGradient(spp=4096 // steps), optimizer, steps=steps, seed=seed)
        assert any(NOT_CONVERGED in line for line in result.warnings) is stopped, (result.warnings, result.verification)
        assert result.status == "finished"


@pytest.mark.parametrize(("last", "told"), [(1.0, "no longer improves"), (0.5, NOT_CONVERGED)])
def test_averages_over_steps_are_no_progress(last: float, told: str) -> None:
    """The loss of the averages is half of that of an earlier step in both runs; the second one has come as far without them."""
    problem = made()
    run = ur.optimize(problem, ur.PathGradient(), ur.optimizers.Adam(0.01), steps=2)
    averages = replace(run, parameters={"x": np.zeros(SIZE)}, history=[{"step": step} for step in range(128)])
    check, pictures = verify.Verify(), FreshPictures(problem, 0, 0)
    spread = 1.0 + np.array([[-0.02], [-0.01], [0.01], [0.02]])

    def picture(loss: float) -> fresh_pictures.Picture:
        return fresh_pictures.Picture((1.0 + pictures.references + np.zeros((4, 1, 1)),), loss * spread)

    check._small, check._earlier = pictures, [verify.EarlierImage(64, picture(1.0), pictures)]
    differs, _ = check._residual(problem, averages, pictures, picture(0.5), picture(last))
    assert differs is not None
    assert told in differs.line


@pytest.mark.parametrize(("ratio", "still"), [(0.95, True), (0.5, False), (0.3, False)])
def test_a_loss_of_one_view_has_no_standard_error_and_is_compared_as_it_is(ratio: float, still: bool) -> None:
    pictures = FreshPictures(made(), 0, 0)
    pictures.sampled = True
    one, last = (fresh_pictures.Picture((), np.full((4, 1), loss)) for loss in (1.0, ratio))
    assert verify.EarlierImage(200, last, pictures).is_still(verify.EarlierImage(64, one, pictures)) is still


def test_a_difference_below_the_noise_of_a_pixel_is_not_compared_with_it() -> None:
    assert "(10% of the picture, 2.0 times its noise)" in verification.Misfit(0.1, 1.0, 0.05).describe()
    assert verification.Misfit(0.1, 1.0, 0.5).describe().endswith("by 0.1 (10% of the picture)")


SHORT = "has hardly improved since step"


@pytest.mark.parametrize(("factor", "told"), [(200.0, True), (1.0, False)])
def test_pictures_far_off_are_told_after_few_steps_without_a_folder(factor: float, told: bool) -> None:
    """References from 0 to 255 ended as finished, 99 % of the picture off, without a line: the run had too few paths for larger images."""
    made = smooth(0.0, 0, known=False)
    references, start = factor * np.asarray(made.views[0].reference), np.random.default_rng(0).uniform(0.3, 0.9, 9)
    made = ur.Problem(made.renderer, [ur.Parameter("x", initial=start)], [ur.View(references)])
    result = ur.optimize(made, ur.PathGradient(spp=4), ur.optimizers.Adam(0.002), steps=10)
    assert [verification.DIFFERS in line for line in result.warnings].count(True) == told


@pytest.mark.parametrize("steps", [40, pytest.param(60, marks=pytest.mark.slow)])
def test_light_that_no_unknown_explains_is_told_in_short_runs(steps: int) -> None:
    for seed in range(2):
        parts = ur.GaussNewton(256, 16), ur.optimizers.AveragedNewton()
        result = ur.optimize(smooth(0.5, seed), *parts, steps=steps, seed=seed)
        assert any(SHORT in line for line in result.warnings), (seed, result.verification)
        assert result.status == "does not fit"


@pytest.mark.parametrize(
    ("steps", "seeds"),
    [(10, range(2)), slow(10, range(2, 20)), slow(24, range(20)), slow(48, range(20))],
    ids=["10", "10-more", "24", "48"],
)
def test_short_runs_that_converge_or_are_incomplete_have_nothing_unexplained(steps: int, seeds: range) -> None:
    """Gauss-Newton steps arrive, and those of Adam are incomplete, also with references whose noise is a tenth of the picture."""
    for seed in seeds:
        problem = smooth(0.0, seed)
        if seed % 2:
            noise = 0.1 * np.random.default_rng(seed).standard_normal((WIDE, WIDE, 3))
            problem = ur.Problem(
                problem.renderer,
                [ur.Parameter("x", initial=np.full(9, 0.5))],
                [ur.View(np.asarray(problem.views[0].reference) + noise)],
            )
        for parts in (
            (ur.GaussNewton(256, 16), ur.optimizers.AveragedNewton()),
            (ur.PathGradient(spp=256), ur.optimizers.Adam(0.02)),
        ):
            result = ur.optimize(problem, *parts, steps=steps, seed=seed)
            assert not any(SHORT in line or UNEXPLAINED in line for line in result.warnings), (seed, result.warnings)


class Folded(AnalyticRenderer):
    """Linear in x³ - 3 x, which has two extrema."""

    def image(self, parameters: Any, request: Any) -> Any:
        return super().image({"x": folded(parameters["x"])}, request)

    def adjoint(self, parameters: Any, paths: Any, weights: Any) -> Any:
        found = super().adjoint({"x": folded(parameters["x"])}, paths, weights)
        return {"x": found["x"] * (3 * parameters["x"] ** 2 - 3)}


def folded(x: Any) -> Any:
    return x**3 - 3 * x


def tiny(side: int, start: float, seed: int, grain: float = 0.0, known: bool = True) -> ur.Problem:
    """Few pixels of one number, 2.6; `grain` is the relative noise of the references."""
    generator = np.random.default_rng(seed)
    matrix = generator.uniform(0.5, 1.5, (side * side * 3, 1))
    renderer = Folded({"x": np.full(1, start)}, matrix, noise=0.3, shape=(side, side))
    truth = np.full(1, 2.6)
    reference = (matrix @ folded(truth)) * (1 + grain * generator.normal(size=len(matrix)))
    views = [ur.View(reference.reshape(side, side, 3))]
    return ur.Problem(renderer, [ur.Parameter("x")], views, truth={"x": truth} if known else None)


@pytest.mark.parametrize("side", quick([1, 2, 5, 9], 2, 9))
@pytest.mark.parametrize("known", [False, slow(True)])
def test_a_local_minimum_of_few_pixels_is_told(side: int, known: bool) -> None:
    """From below the maximum at -1 the descent ends there."""
    for seed in range(2):
        problem = tiny(side, -2.0, seed, 0.02, known)
        result = ur.optimize(problem, ur.PathGradient(spp=4), ur.optimizers.Adam(0.02), steps=300, seed=seed)
        assert abs(result.parameters["x"][0] + 1) < 0.1
        assert any(UNEXPLAINED in line for line in result.warnings), (seed, result.verification)
        assert result.status == "does not fit"


@pytest.mark.parametrize("seeds", [range(2), slow(range(2, 26))], ids=str)
@pytest.mark.parametrize(("grain", "known"), [slow(0.0, False), (0.05, False), slow(0.0, True), (0.3, True)])
@pytest.mark.parametrize("side", [1, 4])
def test_few_pixels_that_have_converged_have_nothing_unexplained(
    side: int, grain: float, known: bool, seeds: range
) -> None:
    for seed in seeds:
        problem = tiny(side, 2.0, seed, grain, known)
        result = ur.optimize(problem, ur.PathGradient(spp=4), ur.optimizers.Adam(0.02), steps=200, seed=seed)
        assert not any(UNEXPLAINED in line for line in result.warnings), (seed, result.warnings)
        assert result.status == "finished"


# ---------------------------------------------------------------------- thirty runs that cannot succeed


def contradicting(seed: int) -> ur.Problem:
    """Two views of one scene whose references are of different scenes, as of swapped files."""
    one, other = smooth(0.0, seed), smooth(0.0, seed + 50)
    assert isinstance(one.renderer, AnalyticRenderer)
    renderer = AnalyticRenderer({"x": np.full(9, 0.5)}, one.renderer.matrix, noise=0.3, shape=(WIDE, WIDE), sensors=2)
    views = [ur.View(np.asarray(problem.views[0].reference), sensor) for sensor, problem in enumerate((one, other))]
    return ur.Problem(renderer, [ur.Parameter("x", initial=np.full(9, 0.5))], views)


def hopeless() -> list[Any]:
    """(problem, estimator, optimizer, steps, what is told) of each run."""
    plain = ur.PathGradient(spp=2)
    adam, told = ur.optimizers.Adam, "worse than start"
    found: list[Any] = []
    found += [
        pytest.param(made(s, 0.45), plain, ur.optimizers.SGD(r), 12, told, id=f"rate {r}")
        for s, r in enumerate((2.0, 5.0, 20.0, 1e3, 1e6))
    ]
    found += [
        pytest.param(made(s, None), plain, adam(r), 30, told, id=f"from the truth, rate {r}")
        for s, r in enumerate((0.3, 0.6, 1.0, 3.0, 30.0))
    ]
    found += [
        pytest.param(
            made(s),
            ur.PathGradient(image=WrongWeight(factor=f), spp=4),
            adam(0.03),
            120,
            "differs from a fresh picture",
            id=f"weight {f}",
        )
        for s, f in enumerate((0.8, 0.9, 0.95, 1.03, 1.1))
    ]
    found += [
        pytest.param(smooth(o, s), plain, adam(0.02), 300, UNEXPLAINED, id=f"other light {o}")
        for s, o in enumerate((0.4, 0.5, 0.7, 1.0, -0.4))
    ]
    found += [
        pytest.param(smooth(0.4, 10 + s), RCV, adam(0.02), 300, UNEXPLAINED, id=f"missing light {s}") for s in range(5)
    ]
    found += [
        pytest.param(contradicting(s), plain, adam(0.02), 300, UNEXPLAINED, id=f"swapped views {s}") for s in range(5)
    ]
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("problem", "estimator", "optimizer", "steps", "told"), hopeless())
def test_runs_that_cannot_succeed_tell_so(
    problem: ur.Problem, estimator: Any, optimizer: Any, steps: int, told: str
) -> None:
    result = ur.optimize(problem, estimator, optimizer, steps=steps)
    assert told == result.status or any(told in line for line in result.warnings), (result.status, result.verification)


# ---------------------------------------------------------------------- resuming


class Kill(ur.protocols.Callback):
    """Ends the run by an exception, as a second Ctrl-C does."""

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        if run.step == 85:
            raise KeyboardInterrupt


@pytest.mark.mitsuba
def test_a_resumed_run_keeps_the_same_parameters(tmp_path: Path) -> None:
    """Earlier parameters come back with the checkpoint, and the descent goes on from the last ones."""
    parts = ur.PathGradient(spp=4), ur.optimizers.Adam(0.05, schedule=Rising())
    whole = ur.optimize(made(), *parts, steps=90, run_directory=tmp_path / "whole", checkpoint_every=10)
    assert whole.verification["best"] == "step 64"
    options: Any = {"run_directory": tmp_path / "part", "checkpoint_every": 10, "callbacks": [Kill()]}
    with pytest.raises(KeyboardInterrupt):
        ur.optimize(made(), *parts, steps=90, **options)
    resumed = ur.resume(tmp_path / "part", made())
    assert resumed.resumed == [80]
    assert resumed.verification == whole.verification
    np.testing.assert_array_equal(resumed.parameters["x"], whole.parameters["x"])
    np.testing.assert_array_equal(resumed.last["x"], whole.last["x"])
    further = ur.resume(tmp_path / "whole", made(), steps=91)
    assert np.abs(further.last["x"] - whole.last["x"]).max() < 5 * 40 * 0.05
    assert np.abs(further.last["x"] - whole.parameters["x"]).max() > 0
    assert "last.npz" in {path.name for path in (tmp_path / "whole").iterdir()}


@pytest.mark.parametrize("improved", [True, False])
def test_a_difference_in_few_pixels_counts(improved: bool) -> None:
    """Single pixels, such as a lamp's reflection at another place of a mirror, are no difference that neighbours share."""
    generator, problem = np.random.default_rng(0), made()
    same = np.full((512, 3), 0.1), np.ones(512), [(16, 32)]
    residuals = generator.normal(0.0, 0.002, (4, 512, 3))
    assert not verification.misfit_of_numbers(problem, Residuals(residuals, *same), improved=improved)
    residuals[:, 7:512:32] += 0.15 * generator.choice((-1.0, 1.0), (16, 3))
    for images in (residuals, residuals[:2]):  # the two halves of a final picture
        found = verification.misfit_of_numbers(problem, Residuals(images, *same), improved=improved)
        assert found is not None
        assert found.line.startswith(verification.DIFFERS)


@pytest.mark.parametrize("light", [True, False])
def test_many_poses_of_lights_must_fit_as_few_numbers_do(light: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    keys, generator = [f"lamp_{n}.rotation.x" for n in range(32)], np.random.default_rng(0)
    renderer = AnalyticRenderer(dict.fromkeys(keys, np.zeros(1)), np.zeros((48, 32)))
    known = {key: replace(info, rigid=True, light=light) for key, info in renderer.parameters().items()}
    monkeypatch.setattr(AnalyticRenderer, "parameters", lambda self: known)
    problem = ur.Problem(renderer, [ur.Parameter(key) for key in keys], [ur.View(np.zeros((4, 4, 3)))])
    arguments: Any = np.ones((512, 3)), np.ones(512), [(16, 32)]
    noise = generator.normal(0.0, 0.01, (4, 512, 3))
    assert not verification.misfit_of_numbers(problem, Residuals(noise, *arguments))
    found = verification.misfit_of_numbers(problem, Residuals(0.1 + noise, *arguments))
    assert (found is not None and "two lights are in each other's place" in found.line) is light


def test_saturated_pixels_are_no_difference_for_a_loss_that_takes_them_as_bounds() -> None:
    """The true picture is brighter there. Another pixel that differs counts."""
    light, generator = np.asarray(made().views[0].reference), np.random.default_rng(0)
    white = float(np.quantile(light.max(axis=2), 0.2))
    images = [light + generator.normal(0.0, 0.01, light.shape) for _ in range(2)]
    for loss, told in ((ur.losses.L2(), True), (ur.losses.Censored(ur.losses.L2(), white), False)):
        problem = made(loss=loss, white=white)
        assert bool(verification.misfit_of_views(problem, [0], [images])) is told
        assert problem.test_weights(0).mean() == pytest.approx(1.0 if told else 0.2, abs=0.05)
        np.testing.assert_array_equal(FreshPictures(problem, 0, 0).weights, problem.test_weights(0).ravel())
        assert verification.misfit_of_views(problem, [0], [[image + 0.1 for image in images]])


@pytest.mark.parametrize("place", ["top row", "bottom row", "left column", "right column", ""])
@pytest.mark.parametrize("side", [16, 24])
def test_a_wrong_line_of_pixels_at_the_border_of_a_reference_is_told(place: str, side: int) -> None:
    """A pose had followed a reference that was shifted by a pixel, to 110 of its standard errors, and only the border did not fit.

    The left column has more noise, which is no difference.
    """
    y, x = np.mgrid[:side, :side]
    light, generator = np.repeat((1.0 + 0.3 * (x + y) / side)[..., None], 3, axis=2), np.random.default_rng(side)
    scale = 0.02 * np.where(x == 0, 4.0 if place else 10.0, 1.0)[..., None]
    reference = light + scale * generator.standard_t(3.0, light.shape)
    if place:
        line = 0 if place.startswith(("top", "left")) else -1
        reference.swapaxes(0, int(place.endswith("column")))[line] = 0.5
    images = [light + scale * generator.normal(size=light.shape) for _ in range(2)]
    residuals = np.stack([(image - reference).reshape(-1, 3) for image in images])
    found = verification.misfit(Residuals(residuals, light.reshape(-1, 3), np.ones(side * side), [(side, side)]), 0.01)
    assert (found is not None and f"in its {place} of pixels" in found.line) is bool(place)
    assert bool(place) or found is None


def test_noise_of_pictures_is_no_line_at_the_border() -> None:
    """A run with the right result was said to differ in its right column. Seven of these 2000 pairs of pictures had such a line."""
    side, scale = 32, 1.0 + np.arange(32)[None, :, None] / 31.0
    for seed in range(2000):
        generator = np.random.default_rng(seed)
        one, other = ((scale * generator.normal(size=(side, side, 3))).reshape(-1, 3) for _ in range(2))
        assert not paired_losses.at_border(one, other, np.ones(side**2), [(side, side)])[1], seed


@pytest.mark.parametrize("local", [0.0, 0.4])
def test_a_difference_has_its_largest_part(local: float) -> None:
    """A tenth of the picture off everywhere, or beside a square that differs by four times as much."""
    generator, side = np.random.default_rng(0), 64
    wrong = np.full((side, side, 1), 0.1)
    wrong[16:32, 40:56] += local
    images = (wrong + generator.normal(0.0, 0.1, (4, side, side, 3))).reshape(4, -1, 3)
    residuals = Residuals(images, np.ones((side**2, 3)), np.ones(side**2), [(side, side)])
    found = verification.misfit(residuals, 0.01)
    assert found is not None
    assert found.largest == pytest.approx(
        0.1 + local, abs=0.03
    )  # the mean of a square has the noise 0.1 / 8 / 2 in each channel
    assert ("up to 0.5" in found.line) is (local > 0.0)
    assert Residuals(images, residuals.references, residuals.weights, []).largest == 0.0


def brighter(light: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """A picture twice as bright."""
    return 2.0 * light + generator.normal(0.0, 0.01, light.shape)


def rarely_lit(light: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """A picture of light that three of four groups of paths find."""
    return 3.0 * light * (generator.random((*light.shape[:2], 1)) < 0.75)


def at_white(light: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """A picture as bright as white."""
    return light + generator.normal(0.0, 0.1, light.shape)


def dark(light: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """A picture without light in half of the saturated pixels, and brighter ones beside."""
    half = np.arange(SIDE)[:, None, None] < SIDE // 2
    return np.where(half, 0.0, 2.0) * light + generator.normal(0.0, 0.01, light.shape)


@pytest.mark.parametrize(
    ("picture", "count"),
    [(brighter, 0.0), (rarely_lit, 0.0), (at_white, 0.0), (dark, 0.5)],
    ids=["brighter", "rarely lit", "at white", "dark"],
)
@pytest.mark.parametrize("images", [2, 16])
def test_a_picture_darker_than_a_saturated_reference_is_wrong(picture: Any, count: float, images: int) -> None:
    """The loss takes its pixels as lower bounds, which only these pictures do not reach."""
    problem, generator = (
        made(loss=ur.losses.Censored(ur.losses.L2(), 1.0), offset=9.0, white=1.0),
        np.random.default_rng(0),
    )
    light = np.ones((SIDE, SIDE, 3))
    halves = [picture(light, generator) for _ in range(images)]
    weights = problem.test_weights(0, halves)
    assert weights.mean() == pytest.approx(count, abs=0.001)
    fresh = FreshPictures(problem, 0, 0).weights_of([np.stack(halves).reshape(images, -1, 3)])
    np.testing.assert_array_equal(fresh, weights.ravel() / max(weights.max(), 1e-300))
    assert bool(verification.misfit_of_views(problem, [0], [halves])) is (count > 0)
    error, _ = debiased.rmse(halves[0], halves[1], np.asarray(problem.views[0].reference), weights)
    assert error == pytest.approx(1.0 if count else 0.0, abs=0.02)


def test_a_run_that_ends_darker_than_a_saturated_reference_is_told(tmp_path: Path) -> None:
    """Its bounds are below the values that light the upper half of the picture."""
    generator = np.random.default_rng(0)
    matrix, truth = generator.random((SIDE * SIDE * 3, SIZE)), np.full(SIZE, 0.6)
    renderer = AnalyticRenderer({"x": truth}, matrix, noise=0.1, shape=(SIDE, SIDE))
    reference = np.minimum(renderer.exact({"x": truth}), 0.4)
    unknown = ur.Parameter("x", initial=0.05, bounds=(0.0, 0.1))
    dim = ur.Problem(renderer, [unknown], [ur.View(reference)], ur.losses.Censored(ur.losses.L2(), 0.4))
    result = ur.optimize(dim, RCV, ur.optimizers.Adam(0.02), 40, run_directory=tmp_path)
    assert any(verification.DIFFERS in line for line in result.warnings)
    assert result.image_errors["view0/result"][0] > 0.05


@pytest.mark.parametrize("outliers", [0, 1, 2, 3, 5, 40])
@pytest.mark.parametrize("edge", [3.0, 0.02])
def test_noise_of_the_references_in_few_pixels_is_no_difference(edge: float, outliers: int) -> None:
    """Such as along the edges of a lamp, where the pictures have more noise too; and pixels that are outliers of the reference."""
    generator, problem = np.random.default_rng(0), made()
    deviation = np.where(np.arange(4096) % 512 < 2, edge, 0.02)[:, None]
    for _ in range(20):
        reference = 1.0 + deviation * generator.standard_t(6, (4096, 3))
        reference[generator.choice(4096, outliers, replace=False)] += generator.uniform(20.0, 60.0, (outliers, 1))
        residuals = 1.0 - reference + 2.0 * deviation * generator.standard_t(6, (2, 4096, 3))
        of = Residuals(residuals, np.ones((4096, 3)), np.ones(4096), [(64, 64)])
        assert not verification.misfit_of_numbers(problem, of)


def test_noise_of_the_references_is_no_fault_where_the_true_values_leave_as_much() -> None:
    generator, problem = np.random.default_rng(0), made()
    residuals = 0.05 * generator.normal(size=(512, 3)) + generator.normal(0.0, 0.002, (4, 512, 3))
    arguments = problem, Residuals(residuals, np.full((512, 3), 0.1), np.ones(512), [(16, 32)])
    found = verification.misfit_of_numbers(*arguments, improved=False)
    assert found is not None
    assert "this picture's noise does not explain: the references are noisy, or" in found.line
    assert verification.NOISE in found.causes
    assert not verification.misfit_of_numbers(*arguments, improved=False, at_truth=lambda: 0.05**2)
    assert verification.misfit_of_numbers(*arguments, improved=False, at_truth=lambda: 0.01**2)


def test_a_run_that_starts_at_the_truth_has_not_improved(monkeypatch: pytest.MonkeyPatch) -> None:
    noted: list[bool] = []
    differs = verification.Misfit(0.1, 1.0, 0.1)
    monkeypatch.setattr(verify, "misfit_of_numbers", lambda *_, improved, **__: noted.append(improved) or differs)
    result = ur.optimize(made(start=None, noise=0.1), ur.GaussNewton(), ur.optimizers.AveragedNewton(), steps=12)
    assert noted == [False]
    assert not result.standard_error


def seen_through_a_filter(generator: np.random.Generator, side: int) -> np.ndarray:
    """Independent noise of a film's points, as a Gaussian filter of a standard deviation of half a pixel leaves it, (side², 3)."""
    places = np.arange(4 * side) / 4
    weights = np.exp(-2.0 * np.square(places[::4, None] - places))
    image = np.einsum("ia,jb,abc->ijc", weights, weights, generator.normal(size=(4 * side, 4 * side, 3)), optimize=True)
    image = image.reshape(-1, 3)
    return image / image.std()


@pytest.mark.parametrize("sampled", [False, True])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_difference_that_changes_its_sign_within_tiles_is_told(axis: int, sampled: bool) -> None:
    """Edges that are a pixel off, such as that of a cone of light: one side is too bright, the other too dark, and only along them."""
    generator, problem, sizes = np.random.default_rng(0), made(), [(64, 36)]
    places = np.indices(sizes[0]).reshape(2, -1).T
    if sampled:
        pixels = np.arange(0, len(places), 2)
        partners = fresh_pictures._partners(pixels, np.array(sizes).repeat(len(pixels), axis=0))
        places, sizes = places[np.stack([pixels, partners], axis=1).ravel()], []
    edges = 0.04 * np.array([1, -1, 0, 0, 0, 0, 0])[places[:, axis] % 7][:, None]
    noise = generator.normal(0.0, 0.02, (1, len(places), 3)) + generator.normal(0.0, 0.01, (4, len(places), 3))
    same = np.full((len(places), 3), 0.2), np.ones(len(places)), sizes
    found = verification.misfit_of_numbers(problem, Residuals(edges + noise, *same))
    assert found is not None
    assert found.line.startswith(f"{verification.DIFFERS} by 0.0")
    assert not verification.misfit_of_numbers(problem, Residuals(noise, *same))


@pytest.mark.parametrize(
    ("side", "size", "count"),
    [(24, 0.05, 40), slow(48, 0.05, 40), slow(128, 0.2, 6), slow(256, 0.1, 3), slow(256, 0.2, 3)],
)
def test_noise_of_references_with_a_reconstruction_filter_is_no_difference(side: int, size: float, count: int) -> None:
    """The score of a correlation grows with the root of the number of pixels, so that one of 0.018 shows in large pictures."""
    generator, problem = np.random.default_rng(0), made()
    for _ in range(count):
        noise = size * seen_through_a_filter(generator, side)
        adjacent = float(np.mean(noise[1:] * noise[:-1]) / np.mean(noise**2))
        assert 0.2 < adjacent < 0.5
        residuals = noise + generator.normal(0.0, 0.01, (4, side * side, 3))
        of = Residuals(residuals, np.ones((side * side, 3)), np.ones(side * side), [(side, side)])
        assert not verification.misfit_of_numbers(problem, of)


@pytest.mark.parametrize("status", [{}, [], None, 1, "else"])
def test_a_status_that_is_none_of_ours_is_not_verified(status: object) -> None:
    record = RunRecord.model_validate(
        {"status": "finished", "name": "a", "method": "b", "verification": {"status": status}}
    )
    assert record.verified == NOT_VERIFIED


def test_a_difference_along_edges_is_told_beside_filtered_noise_of_references() -> None:
    """Edges that differ by 8 % of the picture, in references of 256² pixels with a noise of 20 %."""
    generator, problem, side = np.random.default_rng(0), made(), 256
    edges = np.where(np.arange(side * side) // 6 % 2 < 1, 0.08, -0.08)[:, None]
    residuals = edges + 0.2 * seen_through_a_filter(generator, side) + generator.normal(0.0, 0.01, (4, side * side, 3))
    assert paired_losses.systematic(residuals.mean(axis=0), layout=(3, 1)).score < paired_losses.SIGNIFICANT
    of = Residuals(residuals, np.ones((side * side, 3)), np.ones(side * side), [(side, side)])
    assert verification.misfit_of_numbers(problem, of)


def test_a_difference_that_more_steps_may_answer_is_no_other_status() -> None:
    differs, status, problem = verification.Misfit(0.1, 1.0, 0.01), verification.fit_status, made()
    for few in (False, True):
        assert status(problem, "finished", differs, few) == "does not fit"
        assert status(problem, "worse than start", differs, few) == "worse than start"
        for cause in (verification.STEPS, verification.PRIOR, verification.NOISE):
            assert status(problem, "finished", replace(differs, causes=(cause,)), few) == "finished"
        assert status(problem, "finished", replace(differs, causes=(verification.STEPS_OF_FEW,)), few) == (
            "finished" if few else "does not fit"
        )
        assert status(problem, "finished", None, few) == "finished"


@pytest.mark.parametrize(("error", "status"), [(0.2, "finished"), (0.25, "does not fit"), (3.0, "does not fit")])
def test_the_status_reads_the_size_of_a_difference(error: float, status: str) -> None:
    for size, noise in ((1.0, 0.01), (1.0, 10.0), (1e5, 1e3), (1e-6, 1e-8)):
        differs = verification.Misfit(error * size, size, noise)
        assert verification.fit_status(smooth(0.0, 0, known=False), "finished", differs, few=False) == status
        assert verification.fit_status(made(), "finished", differs, few=False) == "does not fit"


@pytest.mark.parametrize("steps", [20, 60, slow(150)])
@pytest.mark.parametrize("deviation", [slow(0.01), 0.03])
def test_few_numbers_with_a_strong_prior_end_as_finished_after_any_number_of_steps(
    deviation: float, steps: int, tmp_path: Path
) -> None:
    problem = made()
    prior = Prior(near=0.9, std=deviation)
    problem = ur.Problem(problem.renderer, [ur.Parameter("x", initial=0.5, prior=prior)], problem.views)
    for parts in (
        (ur.PathGradient(spp=4), ur.optimizers.Adam(0.02)),
        (ur.GaussNewton(4, 4), ur.optimizers.AveragedNewton()),
    ):
        result = ur.optimize(problem, *parts, steps=steps, run_directory=tmp_path / type(parts[1]).__name__)
        assert result.status == "finished", result.warnings
        assert result.misfit is None or verification.PRIOR in result.misfit.causes


@pytest.mark.parametrize("outliers", [0, 3, 5])
def test_bright_pixels_of_references_leave_a_run_finished_with_standard_errors(outliers: int, tmp_path: Path) -> None:
    generator, problem = np.random.default_rng(0), made()
    reference = np.asarray(problem.views[0].reference) + generator.normal(0.0, 0.02, (SIDE, SIDE, 3))
    reference.reshape(-1, 3)[generator.choice(SIDE * SIDE, outliers, replace=False)] += 8.0
    problem = ur.Problem(problem.renderer, [ur.Parameter("x", initial=0.5)], [ur.View(reference)])
    result = ur.optimize(problem, steps=60, run_directory=tmp_path / "run")
    assert result.status == "finished", result.warnings
    assert not any(verification.DIFFERS in line for line in result.warnings)
    assert np.isfinite(result.standard_error["x"]).all()


@pytest.mark.mitsuba
def test_a_resumed_run_is_judged_by_the_same_earlier_images(tmp_path: Path) -> None:
    """The loss has hardly fallen since step 64, which the session that ends the run has not seen."""
    parts = ur.PathGradient(spp=4), ur.optimizers.Adam(0.05)
    whole = ur.optimize(smooth(0.5, 0), *parts, steps=100, run_directory=tmp_path / "whole", checkpoint_every=10)
    assert whole.verification["change"]["step"] == 64
    options: Any = {"run_directory": tmp_path / "part", "checkpoint_every": 10, "callbacks": [Kill()]}
    with pytest.raises(KeyboardInterrupt):
        ur.optimize(smooth(0.5, 0), *parts, steps=100, **options)
    resumed = ur.resume(tmp_path / "part", smooth(0.5, 0))
    assert resumed.resumed == [80]
    assert resumed.verification == whole.verification
    assert (resumed.status, resumed.misfit) == (whole.status, whole.misfit)


@pytest.mark.mitsuba
def test_a_run_that_begins_anew_has_the_remarks_on_its_settings(tmp_path: Path) -> None:
    def bounded() -> ur.Problem:
        return made().replaced(parameters=[ur.Parameter("x", initial=np.full(SIZE, 0.1), bounds=(0, 1))])

    class KillEarly(ur.protocols.Callback):
        def on_step(self, run: Any, record: dict[str, Any]) -> None:
            raise KeyboardInterrupt

    parts = ur.PathGradient(spp=4), ur.optimizers.Adam(0.6)
    with pytest.raises(KeyboardInterrupt):
        ur.optimize(bounded(), *parts, steps=4, run_directory=tmp_path, callbacks=[KillEarly()])
    resumed = ur.resume(tmp_path, bounded())
    assert resumed.resumed == [0]
    assert sum("crosses its range" in line for line in resumed.warnings) == 1


def test_a_difference_of_the_end_is_not_that_of_better_parameters_which_the_result_holds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A rate that rises after 70 steps leaves the minimum that step 64 had found. Few pixels are judged one by one."""
    monkeypatch.setitem(globals(), "SIDE", 5)
    adam = ur.optimizers.Adam(0.05, schedule=Rising())
    result = ur.optimize(made(1), ur.PathGradient(spp=4), adam, steps=90, seed=1)
    assert result.verification["best"] == "step 64"
    assert result.verification["end"][0] > 50 * result.verification["best_loss"][0]
    assert (result.status, result.misfit) == ("finished", None)


class FoldedBeside(Folded):
    """`Folded` with another number z, in which it is linear."""

    def image(self, parameters: Any, request: Any) -> Any:
        return AnalyticRenderer.image(self, {**parameters, "x": folded(parameters["x"])}, request)

    def adjoint(self, parameters: Any, paths: Any, weights: Any) -> Any:
        found = AnalyticRenderer.adjoint(self, {**parameters, "x": folded(parameters["x"])}, paths, weights)
        return {**found, "x": found["x"] * (3 * parameters["x"] ** 2 - 3)}


@pytest.mark.parametrize("known", [(), ("z",), ("x", "z")])
def test_true_values_of_some_unknowns_do_not_tell_the_noise_of_the_references(known: tuple[str, ...]) -> None:
    """A local minimum of x leaves a difference, also with the true z."""
    generator = np.random.default_rng(0)
    matrix, truth = generator.uniform(0.5, 1.5, (12, 2)), {"x": np.full(1, 2.6), "z": np.full(1, 0.4)}
    renderer = FoldedBeside({"x": np.full(1, -2.0), "z": np.full(1, 0.5)}, matrix, noise=0.3, shape=(2, 2))
    reference = (matrix @ [*folded(truth["x"]), *truth["z"]]).reshape(2, 2, 3)
    parameters = [ur.Parameter("x"), ur.Parameter("z", bounds=(0, 1))]
    problem = ur.Problem(renderer, parameters, [ur.View(reference)], truth={key: truth[key] for key in known})
    result = ur.optimize(problem, ur.PathGradient(spp=4), ur.optimizers.Adam(0.02), steps=300)
    assert abs(result.parameters["x"][0] + 1) < 0.1
    assert result.status == "does not fit"


def test_arrays_of_an_earlier_end_do_not_outlast_it(tmp_path: Path) -> None:
    result = ur.optimize(made(), ur.PathGradient(spp=4), ur.optimizers.Adam(0.03), steps=2)
    maps: Any = {name: {"x": np.ones((2, 2, 3))} for name in ("sensitivity", "standard_error", "data_share")}
    replace(result, pictures={"view0/result": np.ones((2, 2, 3))}, **maps).save(tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    result.save(tmp_path)
    gone = names - {path.name for path in tmp_path.iterdir()}
    assert gone == {"sensitivity.npz", "standard_error.npz", "data_share.npz", "pictures.npz"}


@pytest.mark.mitsuba
@pytest.mark.parametrize("folder", [slow(False), True])
def test_no_reference_differs_from_pictures_whose_loss_has_none(folder: bool, tmp_path: Path) -> None:
    """The references of a function of the image alone are placeholders."""
    import drjit as dr

    problem = smooth(0.0, 0, known=False)
    views = [replace(view, reference=np.zeros_like(np.asarray(view.reference))) for view in problem.views]
    problem = problem.replaced(views=views, loss=lambda image: dr.square(dr.mean(image, axis=None) - 1.0))
    directory = tmp_path if folder else None
    result = ur.optimize(problem, ur.PathGradient(spp=4), ur.optimizers.Adam(0.05), steps=300, run_directory=directory)
    assert (result.status, result.misfit, result.warnings) == ("finished", None, [])
    assert not any("least-squares" in line for line in result.undetermined)
