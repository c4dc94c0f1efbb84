"""Parameters that are coarse at first: how they are resampled, what is remembered across a change, and whole runs."""

from __future__ import annotations

import functools
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
from resizable import KEY, FieldRenderer, upsampled
from scipy import stats

import unrender as ur
from tests.local_hosts import LocalHosts
from tiers import quick, slow
from unrender.app.distributed.executor import DistributedExecutor
from unrender.app.distributed.share import ViewShare
from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.estimators.meta import MetaState
from unrender.io.resampling import downsample, resize, upsample
from unrender.io.volumes import write_grid
from unrender.methods import method
from unrender.methods.plan import Plan
from unrender.optimizers.recipes import ChainState
from unrender.runs import loop, refinement
from unrender.scene.parameter import ParameterSettings
from unrender.scene.upsampling import SQUARES

TRUTH = np.random.default_rng(2).uniform(0.2, 0.8, (16, 12, 1))
rcv = ur.images.RecursiveControlVariate
PAIRS: dict[str, tuple[Any, Any]] = {
    "plain": (ur.PathGradient(spp=2), ur.optimizers.Adam(0.02)),
    "rcv": (ur.PathGradient(image=rcv(), spp=2), ur.optimizers.Adam(0.02)),
    "meta": (ur.MetaEstimator(), ur.optimizers.MetaAdam(0.002)),
    "centred": (ur.MetaEstimator(centred=True), ur.optimizers.MetaAdam(0.002)),
    "coupled": (ur.MetaEstimator(coupled=True, image=rcv()), ur.optimizers.MetaAdam(0.002)),
    "adaptive": (
        ur.PathGradient(pixels=ur.pixels.Adaptive(16, refresh=4, uniform=0.2, denoiser="none"), spp=2),
        ur.optimizers.Adam(0.02),
    ),
    "uniform": (ur.PathGradient(pixels=ur.pixels.Uniform(16), spp=2), ur.optimizers.Adam(0.02)),
    "loss": (ur.PathGradient(pixels=ur.pixels.LossProportional(16, refresh=4, denoiser="none"), spp=2), ur.optimizers.Adam(0.02)),
    "views": (ur.PathGradient(image=rcv(), pixels=ur.pixels.Views(1), spp=2), ur.optimizers.Adam(0.02)),
    "momentum": (ur.PathGradient(spp=2), ur.optimizers.SGD(0.5, momentum=0.9)),
}  # fmt: skip


def problem(way: Any = (3, 6), noise: float = 0.5, **options: Any) -> ur.Problem:
    renderer = FieldRenderer(TRUTH, noise)
    parameter = ur.Parameter(KEY, initial=0.5, bounds=(0, 1), coarse_to_fine=way, **options)
    return ur.Problem(
        renderer, [parameter], [ur.View(renderer.at(TRUTH.shape).exact({KEY: TRUTH}))], truth={KEY: TRUTH}
    )


# ---------------------------------------------------------------------- resampling


@pytest.mark.parametrize(
    ("coarse", "fine"), [((5, 4), (10, 8)), ((4, 3, 5), (8, 6, 10)), ((5, 7), (13, 8)), ((4, 4, 4), (16, 16, 16))]
)
def test_upsampling_is_exact_for_linear_functions_away_from_the_borders(coarse: Any, fine: Any) -> None:
    slope = np.arange(1, len(coarse) + 1)

    def plane(size: Any) -> tuple[np.ndarray, np.ndarray]:
        axes = np.meshgrid(*((np.arange(n) + 0.5) / n for n in size), indexing="ij")
        inner = np.all([(a > 0.5 / n) & (a < 1 - 0.5 / n) for a, n in zip(axes, coarse, strict=True)], axis=0)
        height = np.sum([s * a for s, a in zip(slope, axes, strict=True)], axis=0)
        return height[..., None] * [1.0, -2.0], inner

    expected, inner = plane(fine)
    assert inner.sum() > 20
    given = plane(coarse)[0]
    np.testing.assert_allclose(upsample(given, fine)[inner], expected[inner], atol=1e-12)
    np.testing.assert_allclose(upsample(given, fine), upsampled(given, fine), atol=1e-12)
    # Planted fault: the convention that puts texels on the borders.
    assert np.abs(upsampled(given, fine, corners=True) - expected)[inner].max() > 0.01


@pytest.mark.cpu("texture units interpolate with 8-bit weights")
@pytest.mark.parametrize("wrap", [False, True])
@pytest.mark.parametrize("axes", [2, 3])
def test_upsampling_reads_what_mitsuba_reads(axes: int, wrap: bool) -> None:
    """At the middles of the finer texels, the borders included."""
    coarse, fine = (5, 4, 6)[:axes], (10, 7, 18)[:axes]
    values = np.random.default_rng(0).random((*coarse, 3)).astype(np.float32)
    kind: Any
    point: Any
    kind, point = (mi.Texture2f, mi.Point2f) if axes == 2 else (mi.Texture3f, mi.Point3f)
    mode = dr.WrapMode.Repeat if wrap else dr.WrapMode.Clamp
    texture: Any = kind(mi.TensorXf(values), filter_mode=dr.FilterMode.Linear, wrap_mode=mode)
    grid = np.meshgrid(*((np.arange(n) + 0.5) / n for n in fine), indexing="ij")
    read = texture.eval(point(*(mi.Float(axis.ravel().astype(np.float32)) for axis in reversed(grid))))
    expected = np.stack([np.array(channel) for channel in read], axis=-1).reshape(*fine, 3)
    np.testing.assert_allclose(upsample(values, fine, (wrap,) * axes), expected, atol=2e-5)
    assert np.abs(upsample(values, fine, (not wrap,) * axes) - expected).max() > 0.05


def test_downsampling_keeps_the_mean_and_constants() -> None:
    values = np.random.default_rng(0).random((12, 9, 7, 2)).astype(np.float32)
    found = downsample(values, (4, 3, 7))
    np.testing.assert_allclose(found, values.reshape(4, 3, 3, 3, 7, 2).mean(axis=(1, 3)), rtol=1e-5)
    np.testing.assert_allclose(downsample(values, (5, 4, 3)).mean(), values.mean(), rtol=1e-5)
    np.testing.assert_allclose(resize(np.full((7, 5, 3, 1), 0.3), (4, 9, 3)), 0.3, rtol=1e-6)
    assert downsample(values, (5, 4, 3)).dtype == values.dtype == upsample(values, (24, 9, 8)).dtype


# ---------------------------------------------------------------------- what may be asked for


def test_shapes_by_step() -> None:
    way = ur.scene.CoarseToFine((200, 400))
    assert [way.shape((64, 64, 64, 1), step) for step in (0, 199, 200, 399, 400, 9999)] == [
        (n, n, n, 1) for n in (16, 16, 32, 32, 64, 64)
    ]
    assert ur.scene.CoarseToFine((5,), factor=3).shape((53, 45, 44, 1), 0) == (18, 15, 15, 1)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ur.scene.CoarseToFine(()), r"steps must be whole numbers of at least 1 that ascend, such as \[200, 400\], got \(\)"),
        (lambda: ur.scene.CoarseToFine((4, 4)), "steps must be whole numbers"),
        (lambda: ur.scene.CoarseToFine((0, 4)), "steps must be whole numbers"),
        (lambda: ur.scene.CoarseToFine((True, 4)), "steps must be whole numbers"),
        (lambda: ur.scene.CoarseToFine((4,), factor=1), "factor must be"),
        (lambda: ur.scene.CoarseToFine((4,), wrap=1), "wrap must be true, false"),  # type: ignore
        (lambda: ur.scene.CoarseToFine((4,), states="keep"), 'states must be "estimator", "carry" or "reset", got \'keep\''),  # type: ignore
        (lambda: problem((1, 2, 3, 4)), "coarse_to_fine: shape .* is too small to be coarser 4 times by 2"),
        (lambda: problem(ur.scene.CoarseToFine((1,), wrap=(True,))), "coarse_to_fine: wrap must have 2 entries"),
        (lambda: problem("soon"), "coarse_to_fine: steps must be whole numbers"),
        (lambda: problem({"step": 3}), "coarse_to_fine: CoarseToFine has no option step"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_one_line(make: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_what_has_one_resolution_is_refused() -> None:
    scene = {
        "type": "scene",
        "camera": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(np.ones((8, 16, 3), np.float32))},
    }
    for key in ("sky.data", "sky.scale"):
        with pytest.raises(InputError, match=r"its resolution is fixed|cannot be recovered"):
            ur.Problem(lambda: scene, [ur.Parameter(key, coarse_to_fine=(3,))], [ur.View(np.ones((4, 4, 3)))])


# ---------------------------------------------------------------------- what is remembered


def at_the_change(name: str, states: str, steps: int = 5) -> tuple[Any, Any, Any, Any]:
    """A run before its change of resolution, and after: (run, memory) each."""
    found = problem(ur.scene.CoarseToFine((steps,), states=states))  # type: ignore
    run = loop.prepare(Plan(found, *PAIRS[name]), 9, None, 0)
    for _ in range(steps):
        loop._step(run)
    before = dict(run.parameters), loop.replace(run.state)
    assert refinement.is_due(run)
    refinement.refine(run)
    assert not refinement.is_due(run)
    return *before, run, run.state


def held(state: ChainState, field: str) -> np.ndarray:
    """What a transform of the chain holds of the parameter."""
    return next(getattr(part, field)[KEY] for part in state.states if hasattr(part, field))


def by_hand(value: np.ndarray, power: float = 0.0) -> np.ndarray:
    return upsampled(value, TRUTH.shape[:-1]) / 4**power


@pytest.mark.parametrize("name", PAIRS)
def test_carried_states_are_the_hand_upsampled_ones(name: str) -> None:
    parameters, before, run, memory = at_the_change(name, "carry")
    np.testing.assert_allclose(run.parameters[KEY], by_hand(parameters[KEY]), rtol=1e-12)
    assert np.ptp(parameters[KEY]) > 0.01
    assert np.abs(run.parameters[KEY] - upsampled(parameters[KEY], TRUTH.shape[:-1], corners=True)).max() > 1e-3
    old, new = before.optimizer, memory.optimizer
    assert new.step == old.step == 5
    if name == "momentum":
        np.testing.assert_allclose(held(new, "velocity"), by_hand(held(old, "velocity"), 1), rtol=1e-10)
    elif "MetaAdam" not in type(run.optimizer).__name__:
        first, before_first = (held(state, "first_moment") for state in (new, old))
        np.testing.assert_allclose(first, by_hand(before_first, 1), rtol=1e-10, atol=1e-18)
        second, before_second = (held(state, "second_moment") for state in (new, old))
        np.testing.assert_allclose(second, by_hand(before_second, SQUARES), rtol=1e-10)
        assert new.begun == 0
    old, new = before.estimator, memory.estimator
    image, past = new.image, old.image
    if name in ("rcv", "coupled", "views"):
        np.testing.assert_allclose(image.parameters[KEY], by_hand(past.parameters[KEY]), rtol=1e-12)
        assert image.views is past.views
    if name in ("adaptive", "loss"):
        assert new.pixels.maps is old.pixels.maps
        assert new.pixels.shares is old.pixels.shares
    if name == "adaptive":
        np.testing.assert_allclose(
            new.pixels.second_moment[KEY], by_hand(old.pixels.second_moment[KEY], SQUARES), rtol=1e-10
        )
    if isinstance(new, MetaState):
        assert new.parameters is not None
        assert old.parameters is not None
        if name == "coupled":
            np.testing.assert_array_equal(new.parameters[KEY], image.parameters[KEY])
        a, b = new.elements[KEY], old.elements[KEY]
        lengths = [
            float(np.linalg.norm(here - there))
            for here, there in (
                (parameters[KEY], old.parameters[KEY]),
                (by_hand(parameters[KEY]), by_hand(old.parameters[KEY])),
            )
        ]
        ratio = lengths[0] / lengths[1]
        assert 0.3 < ratio < 0.9
        for part, power, factor in (
            ("gradient", 1, 1), ("variance", SQUARES, 1), ("alpha", 0, 1),
            ("proportional.mean", 1, 1), ("proportional.square", SQUARES, 1),
            ("difference.mean", 1, ratio), ("difference.square", SQUARES, ratio**2),
        ):  # fmt: skip
            values = [a, b]
            for word in part.split("."):
                values = [getattr(value, word) for value in values]
            if part.endswith("mean") and name != "centred":
                assert values == [0.0, 0.0]  # nobody asks for means
                continue
            np.testing.assert_allclose(
                values[0], factor * by_hand(values[1], power), rtol=1e-9, atol=1e-25, err_msg=part
            )
        assert a.steps == b.steps


@pytest.mark.parametrize("name", PAIRS)
def test_reset_states_know_nothing_but_the_step(name: str) -> None:
    _, before, run, memory = at_the_change(name, "reset")
    estimator, optimizer = PAIRS[name]
    fresh = optimizer.init(run.parameters, run.problem.learning_rates)
    assert memory.optimizer.step == before.optimizer.step == 5
    for field in ("first_moment", "second_moment", "velocity"):
        if any(hasattr(part, field) for part in fresh.states):
            np.testing.assert_array_equal(held(memory.optimizer, field), np.zeros(TRUTH.shape))
    fresh = estimator.init(run.problem, run.parameters)
    assert repr(memory.estimator.image) == repr(fresh.image)
    if isinstance(memory.estimator, MetaState):
        assert memory.estimator.parameters is None
        assert not memory.estimator.elements


@dataclass(frozen=True)
class Unweighted:
    """Another sampler's pixels, all of the mean weight: a planted fault."""

    inner: Any

    def init(self, problem: ur.Problem, parameters: Any) -> Any:
        return self.inner.init(problem, parameters)

    def draw(self, problem: ur.Problem, parameters: Any, state: Any, key: Key) -> Any:
        batch, state = self.inner.draw(problem, parameters, state, key)
        weights = np.full_like(batch.sample.weights, np.mean(batch.sample.weights))
        return replace(batch, sample=replace(batch.sample, weights=weights)), state

    def observe(self, problem: ur.Problem, state: Any, gradient: Any) -> Any:
        return state


@pytest.mark.slow
def test_mini_batches_are_unbiased_after_a_change_whose_probabilities_were_carried() -> None:
    _, _, run, memory = at_the_change("adaptive", "carry")
    state = memory.estimator
    assert np.ptp(state.pixels.shares) > 0.1
    whole = ur.PathGradient(spp=2)

    def mean(estimator: Any, state: Any, stream: int) -> tuple[np.ndarray, np.ndarray]:
        rows = [
            estimator.estimate(run.problem, run.parameters, state, Key(7, stream, number))[0].gradient[KEY].ravel()
            for number in range(600)
        ]
        return np.mean(rows, axis=0), np.var(rows, axis=0, ddof=1) / len(rows)

    exact, noise = mean(whole, whole.init(run.problem, run.parameters), 0)
    carried = replace(PAIRS["adaptive"][0], pixels=replace(PAIRS["adaptive"][0].pixels, refresh=10**6))
    scores = []
    for stream, estimator in enumerate((carried, replace(carried, pixels=Unweighted(carried.pixels)))):
        found, variance = mean(estimator, state, 1 + stream)
        seen = noise + variance > 0
        scores.append(np.abs((found - exact)[seen]) / np.sqrt((noise + variance)[seen]))
    limit = stats.norm.isf((1 - (1 - 1e-4) ** (1 / len(scores[0]))) / 2)
    assert len(scores[0]) > 100
    assert scores[0].max() < limit
    assert scores[1].max() > limit


@pytest.mark.parametrize("name", ["uniform", "adaptive", "rcv"])
def test_dealt_views_become_finer_as_those_of_one_process(name: str) -> None:
    renderer = FieldRenderer(TRUTH)
    views = [ur.View(renderer.at(TRUTH.shape).exact({KEY: TRUTH}))] * 3
    parameter = ur.Parameter(KEY, initial=0.5, bounds=(0, 1), coarse_to_fine=(3, 6))
    alone = ur.Problem(renderer, [parameter], views)
    shares = ((0, 2), (1,))
    parts = tuple(ViewShare(ur.Problem(renderer, [parameter], [views[v] for v in part]), part) for part in shares)
    dealt = alone.with_parts(executor=DistributedExecutor(alone, shares, LocalHosts(parts)))
    one, other, seeded = (
        ur.optimize(each, *PAIRS[name], 9, seed=seed) for each, seed in ((alone, 0), (dealt, 0), (alone, 1))
    )
    assert other.warnings == []
    assert [h["resolution"][KEY] for h in other.history if "resolution" in h] == [(4, 3), (8, 6), (16, 12)]
    assert np.abs(one.parameters[KEY] - other.parameters[KEY]).max() < 1e-12
    assert np.abs(one.parameters[KEY] - seeded.parameters[KEY]).max() > 3e-3


def test_auto_starts_a_grid_coarse_whoever_has_the_views() -> None:
    field = np.random.default_rng(3).uniform(0.2, 0.8, (8, 8, 8, 1))
    renderer = FieldRenderer(field)
    views = [ur.View(renderer.at(field.shape).exact({KEY: field}))] * 2
    parameter = ur.Parameter(KEY, initial=0.5)
    alone = ur.Problem(renderer, [parameter], views)
    parts = tuple(ViewShare(ur.Problem(renderer, [parameter], [views[v]]), (v,)) for v in (0, 1))
    dealt = alone.with_parts(executor=DistributedExecutor(alone, ((0,), (1,)), LocalHosts(parts)))
    one, other = (ur.optimize(each, "auto", steps=16) for each in (alone, dealt))
    for result in (one, other):
        assert [h["resolution"][KEY] for h in result.history if "resolution" in h] == [(4, 4, 4), (8, 8, 8)]
    assert np.abs(one.parameters[KEY] - other.parameters[KEY]).max() < 1e-12


def test_by_default_the_estimator_remembers_and_the_optimizer_starts_anew() -> None:
    assert ur.scene.CoarseToFine((3,)).states == "estimator"
    parameters, before, run, memory = at_the_change("rcv", "estimator")
    assert memory.estimator.image.views is before.estimator.image.views
    np.testing.assert_allclose(
        memory.estimator.image.parameters[KEY], by_hand(before.estimator.image.parameters[KEY]), rtol=1e-12
    )
    assert (memory.optimizer.step, memory.optimizer.begun) == (5, 5)
    assert not held(memory.optimizer, "first_moment").any()
    assert parameters[KEY].shape != run.parameters[KEY].shape


def test_adam_that_starts_anew_makes_a_first_step_again() -> None:
    """−η sign(g), by the schedule's factor of the present step."""
    schedule = ur.optimizers.schedules.Steps(every=3, factor=0.5)
    found = problem(ur.scene.CoarseToFine((3,), states="reset"))
    plan = Plan(found, ur.PathGradient(spp=2), ur.optimizers.Adam(0.02, schedule=schedule))
    run = loop.prepare(plan, 9, None, 0)
    for _ in range(3):
        loop._step(run)
    refinement.refine(run)
    start = run.parameters[KEY]
    loop._step(run)
    moved = run.parameters[KEY] - start
    gradient = run.estimate.gradient[KEY]  # type: ignore
    clear = np.abs(gradient) > 1e-6
    assert clear.sum() > 50
    np.testing.assert_allclose(moved[clear], -0.01 * np.sign(gradient[clear]), rtol=1e-2)


def test_what_cannot_be_carried_starts_anew_and_says_so() -> None:
    found = problem(ur.scene.CoarseToFine((2,), states="carry"))
    result = ur.optimize(found, ur.PathGradient(spp=2), ur.optimizers.LBFGS(0.1), 5)
    assert "after step 2: LBFGSState cannot be carried to another resolution: it restarts" in result.warnings
    smoothed = ur.optimize(found, ur.SmoothedDerivatives(0.05, 8), ur.optimizers.CMAES(diagonal=True), 4)
    assert any("CMAESState" in line for line in smoothed.warnings)
    assert smoothed.parameters[KEY].shape == TRUTH.shape


# ---------------------------------------------------------------------- whole runs


class Shapes(ur.protocols.Callback):
    def __init__(self):
        self.seen: list[Any] = []

    def on_step(self, run, record):
        self.seen.append(arrays.shape(run.parameters[KEY])[:-1])


WITH_STATES = [
    (name, states)
    if name == "rcv" or (states == "estimator" and name in ("adaptive", "coupled", "meta", "momentum"))
    else slow(name, states)
    for name in PAIRS
    for states in ("estimator", "carry", "reset")
]


@pytest.mark.parametrize(("name", "states"), WITH_STATES)
def test_a_run_ends_fine_with_the_history_of_all_stages(name: str, states: Any, tmp_path: Path) -> None:
    listen = Shapes()
    live = ur.runs.Live(tmp_path / "run")
    found = problem(ur.scene.CoarseToFine((3, 6), states=states))
    result = ur.optimize(found, *PAIRS[name], 9, callbacks=[listen, live], run_directory=tmp_path / "run")
    assert listen.seen == [(4, 3)] * 3 + [(8, 6)] * 3 + [(16, 12)] * 3
    assert [record["step"] for record in result.history] == list(range(9))
    told = {record["step"]: record["resolution"][KEY] for record in result.history if "resolution" in record}
    assert told == {0: (4, 3), 3: (8, 6), 6: (16, 12)}
    for array in (result.parameters[KEY], result.initial[KEY]):
        assert array.shape == TRUTH.shape
    assert not result.warnings
    assert all("parameter_error" in record or record["step"] for record in result.history[-1:])
    with np.load(tmp_path / "run" / "live" / "parameters.npz") as kept:
        assert kept[KEY].shape == TRUTH.shape[:-1] + (1,)


def test_a_run_that_ends_early_is_interpolated_and_says_so() -> None:
    found = problem()
    result = ur.optimize(found, *PAIRS["plain"], 4)
    assert result.warnings == [f"parameter {KEY}: still 6x8 at the end, after 4 steps of at least 7"]
    assert result.parameters[KEY].shape == TRUTH.shape
    coarse = result.parameters[KEY].reshape(8, 2, 6, 2, 1).mean(axis=(1, 3))
    assert ur.render(found, {KEY: coarse}, spp=1).shape == (6, 8, 3)
    error = math.sqrt(float(np.mean((result.parameters[KEY] - TRUTH) ** 2)))
    assert result.history[-1]["parameter_error"][KEY] == pytest.approx(error, rel=1e-5)


def test_without_noise_coarse_to_fine_finds_the_field() -> None:
    smooth = upsampled(np.random.default_rng(0).uniform(0.2, 0.8, (4, 3, 1)), (16, 12))
    renderer = FieldRenderer(smooth, 0.0, 0.0)
    parameter = ur.Parameter(KEY, initial=0.5, coarse_to_fine=(60, 120))
    found = ur.Problem(
        renderer, [parameter], [ur.View(renderer.at(smooth.shape).exact({KEY: smooth}))], truth={KEY: smooth}
    )
    plain = ur.Problem(renderer, [ur.Parameter(KEY, initial=0.5)], found.original_views, truth={KEY: smooth})
    ends = [
        ur.optimize(each, ur.PathGradient(spp=8), ur.optimizers.Adam(0.02), 180).history[-1]["parameter_error"][KEY]
        for each in (found, plain)
    ]
    assert ends[0] < 0.5 * ends[1]  # 48 pixels do not tell 192 texels, but 12


class Stop(ur.protocols.Callback):
    def __init__(self, step: int):
        self.step = step

    def on_step(self, run, record):
        if run.step == self.step:
            raise KeyboardInterrupt


@functools.cache
def uninterrupted(name: str, states: Any) -> ur.Result:
    return ur.optimize(problem(ur.scene.CoarseToFine((3,), states=states)), *PAIRS[name], 6)


@pytest.mark.usefixtures("short_ends")
@pytest.mark.parametrize("at", quick([2, 3, 4], 3))
@pytest.mark.parametrize(("name", "states"), WITH_STATES)
def test_a_resumed_run_is_the_uninterrupted_one(name: str, states: Any, at: int, tmp_path: Path) -> None:
    """Interrupted before a change of resolution, at it, and after it."""
    way = ur.scene.CoarseToFine((3,), states=states)
    whole = uninterrupted(name, states)
    with pytest.raises(KeyboardInterrupt):
        ur.optimize(
            problem(way), *PAIRS[name], 6, callbacks=[Stop(at)], run_directory=tmp_path / "run", checkpoint_every=1
        )
    result = ur.resume(tmp_path / "run", problem(way))
    assert result.resumed == [at]
    np.testing.assert_array_equal(result.parameters[KEY], whole.parameters[KEY])
    np.testing.assert_array_equal(result.initial[KEY], whole.initial[KEY])
    for before, after in zip(whole.history, result.history, strict=True):
        assert before["loss"] == after["loss"]
    with pytest.raises(InputError, match=f"parameter {KEY}: coarse_to_fine"):
        ur.resume(tmp_path / "run", problem((4,)), steps=8)


# ---------------------------------------------------------------------- smooth steps on grids


def solve(strength: float, size: tuple[int, ...], x: np.ndarray) -> np.ndarray:
    """(I + λ L)^-1 x on a grid, L a sum of Kronecker products of path graphs."""
    cells, laplacian = math.prod(size), scipy.sparse.csr_matrix((math.prod(size),) * 2)
    for axis, n in enumerate(size):
        path: Any = scipy.sparse.diags([np.r_[1, np.full(n - 2, 2), 1], -np.ones(n - 1), -np.ones(n - 1)], [0, 1, -1])  # pyright: ignore
        left, right = math.prod(size[:axis]), math.prod(size[axis + 1 :])
        laplacian = laplacian + scipy.sparse.kron(
            scipy.sparse.kron(scipy.sparse.identity(left), path), scipy.sparse.identity(right)
        )
    matrix = (scipy.sparse.identity(cells) + strength * laplacian).tocsc()
    return np.asarray(scipy.sparse.linalg.spsolve(matrix, x.ravel())).reshape(x.shape)


class Sizes(ur.protocols.Callback):
    """What a callback sees of the parameter's size; its error can be asked for."""

    def __init__(self) -> None:
        self.seen: list[tuple[int, ...]] = []

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        self.seen.append(arrays.shape(run.parameters[KEY]))
        if not run.plan.problem.coarse_to_fine:
            assert problem(None).parameter_error(run.parameters)[KEY] < 1


def planned(given: ur.Problem, **settings: Any) -> Plan:
    """Schedule-free steps, with settings of the parameter."""
    estimator, optimizer = ur.PathGradient(image=rcv(), spp=2), ur.optimizers.ScheduleFree(0.05)
    return Plan(given, estimator, optimizer, {KEY: ParameterSettings(**settings)})


@pytest.mark.usefixtures("short_ends")
def test_a_plan_brings_resolutions_and_a_resumed_run_is_the_uninterrupted_one(tmp_path: Path) -> None:
    """As those of `Parameter`, with states carried; a parameter's own come first."""
    estimator = ur.PathGradient(image=rcv(), spp=2)
    coarse = ur.scene.CoarseToFine((3, 6), states="carry")
    brings = planned(problem(None), coarse_to_fine=coarse)
    whole = ur.optimize(problem(None), brings, steps=8, seed=1)
    given = problem(ur.scene.CoarseToFine((3, 6), states="carry"))
    own = ur.optimize(given, estimator, ur.optimizers.ScheduleFree(0.05), steps=8, seed=1)
    np.testing.assert_array_equal(whole.parameters[KEY], own.parameters[KEY])
    assert [step["resolution"][KEY] for step in whole.history if "resolution" in step] == [(4, 3), (8, 6), (16, 12)]
    first = ur.optimize(problem((5,)), brings, steps=6, seed=1)
    assert [step["resolution"][KEY] for step in first.history if "resolution" in step] == [(8, 6), (16, 12)]

    ur.optimize(problem(None), brings, steps=4, seed=1, run_directory=tmp_path / "run", checkpoint_every=1)
    resumed = ur.resume(tmp_path / "run", problem(None), steps=8)
    np.testing.assert_array_equal(resumed.parameters[KEY], whole.parameters[KEY])

    sizes = Sizes()
    ur.optimize(problem(None), brings, steps=4, callbacks=[sizes])
    assert sizes.seen == [TRUTH.shape] * 4  # callbacks see nothing that the problem did not ask for
    present = Sizes()
    ur.optimize(problem((3,)), brings, steps=4, callbacks=[present])
    assert present.seen == [(8, 6, 1)] * 3 + [TRUTH.shape]


class Ticks:
    """A clock of which each look takes 20 ms."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        self.now += 0.02
        return self.now


@pytest.mark.usefixtures("short_ends")
def test_resolutions_follow_the_time_at_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Few steps in the budget bring a plan's changes forward, many or a budget of steps do not; a resumed run knows."""

    def changes(result: ur.Result) -> list[tuple[int, tuple[int, ...]]]:
        return [(h["step"], tuple(h["resolution"][KEY])) for h in result.history if "resolution" in h]

    plan = planned(problem(None), coarse_to_fine=ur.scene.CoarseToFine((10, 40), states="carry"))
    slow = [(0, (4, 3)), (3, (8, 6)), (12, (16, 12))]
    budgets: list[tuple[Any, Any]] = [
        ({"seconds": 0.61}, slow),
        ({"seconds": 0.07}, [(0, (4, 3)), (3, (16, 12))]),
        ({"seconds": 2.5}, [(0, (4, 3)), (10, (8, 6)), (40, (16, 12))]),
        ({"steps": 31}, [(0, (4, 3)), (10, (8, 6))]),
    ]
    found = []
    for budget, wanted in budgets:
        monkeypatch.setattr(loop, "time", Ticks())
        found.append(ur.optimize(problem(None), plan, **budget, progress=False))
        assert changes(found[-1]) == wanted
    monkeypatch.setattr(loop, "time", Ticks())
    asked = ur.optimize(problem((10, 40)), plan, seconds=0.61, progress=False)
    assert changes(asked) == [(0, (4, 3)), (10, (8, 6))]  # the problem's own steps stay
    for stop in (3, 8, 20):
        monkeypatch.setattr(loop, "time", Ticks())
        folder = tmp_path / str(stop)
        ur.optimize(problem(None), plan, steps=stop, seconds=0.61, run_directory=folder, checkpoint_every=1)
        resumed = ur.resume(folder, problem(None), steps=found[0].steps, seconds=0.61)
        assert changes(resumed) == slow
        np.testing.assert_array_equal(resumed.parameters[KEY], found[0].parameters[KEY])


def test_resolutions_of_a_plan_that_make_no_sense_are_refused() -> None:
    def descend(steps: Any) -> None:
        ur.optimize(problem(None), planned(problem(None), coarse_to_fine=ur.scene.CoarseToFine(steps)), steps=1)

    with pytest.raises(InputError, match=f"parameter {KEY}: coarse_to_fine: .*too small to be coarser 5 times by 2"):
        descend((3, 6, 9, 12, 15))
    with pytest.raises(InputError, match="CoarseToFine: steps must be whole numbers"):
        descend((6, 3))


@pytest.mark.parametrize(
    ("cells", "steps"), [((16, 16, 16), (8, 20)), ((12, 20, 9), (14,)), ((7, 20, 20), ()), ((16, 16), ())]
)
def test_auto_takes_coarse_steps_for_grids_alone(cells: tuple[int, ...], steps: tuple[int, ...]) -> None:
    truth = np.full((*cells, 1), 0.3)
    renderer = FieldRenderer(truth)
    unknown = ur.Parameter(KEY, initial=0.5, bounds=(0, 1))
    made = ur.Problem(renderer, [unknown], [ur.View(renderer.at(truth.shape).exact({KEY: truth}))])
    choice = method("auto").plan(made)
    assert isinstance(choice.optimizer, ur.optimizers.ScheduleFree)
    coarse = choice.settings[KEY].coarse_to_fine
    assert coarse == (ur.scene.CoarseToFine(steps, states="carry") if steps else None)
    assert any("coarse to fine" in reason for reason in choice.reasons) == bool(steps)
    detailed = truth + np.arange(cells[0]).reshape(-1, *(1,) * len(cells)) * 0.01
    for others, options in (
        (unknown, {"coarse": False} if steps else {}),
        (replace(unknown, initial=detailed), {}),  # detail that coarse cells would lose
        (replace(unknown, coarse_to_fine=(5,)), {}),
    ):
        made = ur.Problem(renderer, [others], [ur.View(renderer.at(truth.shape).exact({KEY: truth}))])
        choice = method("auto").plan(made, options)
        assert isinstance(choice.optimizer, ur.optimizers.ScheduleFree)
        assert choice.settings[KEY].coarse_to_fine is None
        assert not any("coarse to fine" in reason for reason in choice.reasons)


@pytest.mark.parametrize("strength", [0.5, 20.0])
def test_large_steps_on_a_grid_through_a_change_of_resolution(strength: float) -> None:
    """Two steps of plain descent, x ← x − η S S g, are those by hand, S on 4³ and then on 8³ voxels with the same λ."""
    rng = np.random.default_rng(3)
    truth, initial = rng.uniform(0, 1, (8, 8, 8, 1)), rng.uniform(0, 1, (8, 8, 8, 1)).astype(np.float32)
    renderer = FieldRenderer(truth, 0.0, 0.0)
    smooth, rate = ur.preconditioners.LargeSteps(strength), 500.0
    parameter = ur.Parameter(KEY, initial=initial, preconditioner=smooth, coarse_to_fine=(1,))
    found = ur.Problem(renderer, [parameter], [ur.View(renderer.at(truth.shape).exact({KEY: truth}))])

    def step(x: np.ndarray, strength: float) -> np.ndarray:
        own, size = renderer.at(x.shape), x.shape[:-1]
        slope = found.loss_derivative(0, own.exact({KEY: x})).reshape(-1) @ own.matrix
        return x - rate * solve(strength, size, solve(strength, size, slope.reshape(x.shape)))

    coarse = initial.astype(float).reshape(4, 2, 4, 2, 4, 2, 1).mean(axis=(1, 3, 5))
    middle = upsampled(step(coarse, strength), (8, 8, 8))
    expected, wrong = step(middle, strength), step(middle, strength / 4)
    result = ur.optimize(found, ur.PathGradient(spp=2), ur.optimizers.SGD(rate), 2)
    moved = np.abs(expected - middle).max()
    assert moved > 1e-3
    np.testing.assert_allclose(result.last[KEY], expected, atol=1e-3 * moved)
    assert np.abs(wrong - expected).max() > 0.1 * moved  # planted fault: another strength on the finer grid


# ---------------------------------------------------------------------- in a scene

SCENE = """<scene version="3.0.0">
    <sensor type="perspective"><transform name="to_world"><lookat origin="0, 0, 6" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="6"/><rfilter type="box"/></film>
    </sensor>
    <emitter type="constant" id="sky"/>
    <shape type="rectangle" id="wall"><transform name="to_world"><translate z="-1.5"/></transform>
        <bsdf type="diffuse"><texture type="bitmap" name="reflectance">
            <string name="filename" value="wall.exr"/><boolean name="raw" value="true"/></texture></bsdf>
    </shape>
    <shape type="cube" id="smoke"><bsdf type="null"/>
        <medium type="heterogeneous" name="interior">
            <volume type="gridvolume" name="sigma_t"><string name="filename" value="smoke.vol"/><boolean name="raw" value="true"/>
                <transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2"/></transform></volume>
        </medium>
    </shape>
</scene>
"""
WALL, SMOKE = "wall.bsdf.reflectance.data", "smoke.interior_medium.sigma_t.data"
PROBLEM = f"""\
scene = "scene.xml"
max_depth = 3
[[parameters]]
key = "{WALL}"
initial = 0.4
coarse_to_fine = [2, 4]
[[parameters]]
key = "{SMOKE}"
initial = "smoke.vol"
preconditioner = {{ type = "LargeSteps", strength = 2.0 }}
coarse_to_fine = {{ steps = [3], states = "reset" }}
[[views]]
reference = "photo.exr"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "problem.toml").write_text(PROBLEM)
    mi.Bitmap(np.full((8, 8, 3), 0.5, np.float32)).write(str(tmp_path / "wall.exr"))
    write_grid(tmp_path / "smoke.vol", np.random.default_rng(0).uniform(0.2, 0.6, (4, 4, 4, 1)))
    mi.Bitmap(np.full((6, 6, 3), 0.6, np.float32)).write(str(tmp_path / "photo.exr"))
    return tmp_path


class Scenes(ur.protocols.Callback):
    """What both scenes hold at each step: texels of the wall, voxels of the smoke along an axis."""

    def __init__(self):
        self.seen: list[Any] = []

    def on_step(self, run: Any, record):
        pair = run.problem.renderer.pair
        states = pair.current_parameters, pair.loaded(previous=True).parameters
        self.seen.append([(state[WALL].shape[0], state[SMOKE].shape[0]) for state in states])


@pytest.mark.slow
def test_the_scene_takes_each_resolution(folder: Path) -> None:
    found = ur.Problem.from_file(folder / "problem.toml")
    assert found.coarse_to_fine[WALL] == ur.scene.CoarseToFine((2, 4))
    assert found.coarse_to_fine[SMOKE] == ur.scene.CoarseToFine((3,), states="reset")
    scenes = Scenes()
    result = ur.optimize(
        found, *PAIRS["coupled"], 5, callbacks=[scenes], run_directory=folder / "run", checkpoint_every=1
    )
    expected = [(2, 2), (2, 2), (4, 2), (4, 4), (8, 4)]
    for step, seen in enumerate(scenes.seen):
        assert all(each == expected[step] for each in seen)
    assert result.parameters[WALL].shape == (8, 8, 3)
    assert result.parameters[SMOKE].shape == (4, 4, 4, 1)
    assert result.skipped == 0
    (folder / "problem.toml").rename(folder / "moved.toml")  # the folder's own copy says the same
    again = ur.resume(folder / "run", steps=6)
    assert again.steps == 6
    assert again.history[:5] == ur.resume(folder / "run", steps=7).history[:5]
    done = ur.app.export(folder / "run", folder / "out")
    assert np.array(mi.VolumeGrid(str(done.folder / "maps" / "smoke.interior_medium.sigma_t.vol"))).shape == (4, 4, 4)


def test_an_interpolated_field_looks_the_same(folder: Path) -> None:
    """Of a texture without kinks: a ramp along x, in a picture that does not see the border."""
    near = SCENE.replace('type="perspective">', 'type="perspective"><float name="fov" value="10"/>')
    (folder / "scene.xml").write_text(near.replace('value="smoke.vol"', 'value="nothing.vol"'))
    write_grid(folder / "nothing.vol", np.full((4, 4, 4, 1), 1e-6))
    (folder / "problem.toml").write_text(PROBLEM.replace("smoke.vol", "nothing.vol"))
    found = ur.Problem.from_file(folder / "problem.toml")
    ramp = np.broadcast_to((np.arange(4)[None, :, None] + 0.5) / 4, (4, 4, 3)).astype(np.float32)
    smoke = np.full((4, 4, 4, 1), 1e-6, np.float32)
    coarse = ur.render(found, {WALL: ramp, SMOKE: smoke}, spp=64)
    fine = ur.render(found, found.full({WALL: ramp, SMOKE: smoke}), spp=64)
    flat = ur.render(found, {WALL: np.full((8, 8, 3), 0.5, np.float32), SMOKE: smoke}, spp=64)
    np.testing.assert_allclose(coarse, fine, rtol=1e-3)
    assert np.abs(flat - coarse).max() > 0.05


def test_a_schedule_that_makes_no_sense_is_told_with_its_line(folder: Path) -> None:
    (folder / "problem.toml").write_text(PROBLEM.replace("[2, 4]", "[4, 2]"))
    with pytest.raises(InputError, match=r"problem\.toml:6: parameters\[0\]\.coarse_to_fine: steps must be"):
        ur.Problem.from_file(folder / "problem.toml")
    (folder / "problem.toml").write_text(PROBLEM.replace("[2, 4]", "2"))
    with pytest.raises(InputError, match=r"problem\.toml:6: parameters\[0\]\.coarse_to_fine: expected a list of steps"):
        ur.Problem.from_file(folder / "problem.toml")


# ------------------------------------------- parameterisations


@pytest.mark.parametrize(
    "states", ["estimator", *(pytest.param(name, marks=pytest.mark.slow) for name in ("carry", "reset"))]
)
@pytest.mark.parametrize(
    ("estimator", "optimizer"),
    [
        (ur.PathGradient(image=rcv(), spp=2), ur.optimizers.ScheduleFree(0.2)),
        (ur.MetaEstimator(coupled=True), ur.optimizers.MetaAdam(0.004)),
        (ur.PathGradient(pixels=ur.pixels.Adaptive(16, refresh=2, denoiser="none"), spp=2), ur.optimizers.Adam(0.1)),
        (ur.PathGradient(spp=2), ur.optimizers.SGD(0.5, momentum=0.5)),
    ],
    ids=["rcv", "coupled", "adaptive", "momentum"],
)
def test_a_parameterised_run_comes_to_its_resolution_and_repeats_when_resumed(
    estimator: Any, optimizer: Any, states: str, tmp_path: Path
) -> None:
    def fresh() -> ur.Problem:
        return problem({"steps": (3, 6), "states": states}, parameterisation="log")

    whole = ur.optimize(fresh(), estimator, optimizer, steps=12)
    assert whole.parameters[KEY].shape == TRUTH.shape
    assert np.abs(whole.parameters[KEY] - TRUTH).mean() < np.abs(0.5 - TRUTH).mean() * 1.1
    ur.optimize(fresh(), estimator, optimizer, steps=5, run_directory=tmp_path)
    np.testing.assert_array_equal(ur.resume(tmp_path, fresh(), steps=12).parameters[KEY], whole.parameters[KEY])


@pytest.mark.slow
def test_compiling_at_a_new_resolution_counts_as_compiling(monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(run: Any) -> Any:
        time.sleep(0.3)
        seconds, state = loop.warm_up(run)
        return seconds + 0.3, state

    monkeypatch.setattr(refinement, "warm_up", slow)
    result = ur.optimize(problem(), *PAIRS["plain"], steps=8)
    assert result.phases["compiling"] >= 0.6
    assert sum(result.phases.values()) >= 0.6 + result.seconds
