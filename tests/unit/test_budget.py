"""How long a run may go on."""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.core import timing
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import BlockEstimate
from unrender.estimators.gauss_newton import GaussNewton
from unrender.methods import method
from unrender.methods.auto import AutoMethod
from unrender.methods.plan import Plan
from unrender.optimizers.averaged_newton import AveragedNewton
from unrender.protocols import Callback
from unrender.runs import budget, loop
from unrender.runs.folder import writer
from unrender.runs.folder.history import thinned
from unrender.runs.image_sensitivity import curvature
from unrender.runs.metadata import RunAnnotations
from unrender.runs.resume import load_run, resume_run
from unrender.runs.run import Run
from unrender.runs.watches import InfluenceWatch
from unrender.scene import serialization
from unrender.scene.executor import LOCAL

TRUTH = {"gain": np.full(2, 0.5)}


def problem() -> ur.Problem:
    matrix = np.random.default_rng(1).uniform(0.0, 1.0, (48, 2))
    renderer = AnalyticRenderer(TRUTH, matrix, 0.1, 0.3)
    return ur.Problem(renderer, [ur.Parameter("gain", initial=0.2)], [ur.View(renderer.exact(TRUTH))], truth=TRUTH)


class SlowGradient(ur.PathGradient):
    """Path gradients that take a while."""

    pause = 0.0

    def estimate(self, *arguments: Any) -> Any:
        time.sleep(self.pause)
        return super().estimate(*arguments)


def slow(pause: float) -> ur.PathGradient:
    estimator = SlowGradient()
    object.__setattr__(estimator, "pause", pause)
    return estimator


@pytest.mark.parametrize(
    ("within", "warming", "compiles", "steps"),
    [
        (False, 12.0, True, 21),
        (True, 0.0, False, 18),
        (True, 12.0, False, 10),
        (True, 12.0, True, 11),
        (True, 18.0, False, 4),
    ],
)
def test_a_budget_may_cover_more_than_the_steps(
    within: bool, warming: float, compiles: bool, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps alone have all 20 seconds. Otherwise 3 are for the final pictures, and the steps have half of the budget, as long as all ends
    within 5 seconds of it, or 15 if kernels were compiled. Each step takes a second, which the next one sees."""
    now, warm_up = [100.0], loop.warm_up

    def compiled(run: Run) -> Any:
        now[0] += warming
        done, run.compiled = warm_up(run), compiles
        return done

    monkeypatch.setattr(budget.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(budget, "slowdown", lambda: 1.0)

    class Seconds(Callback):
        def on_step(self, run: Any, record: Any) -> None:
            now[0] += 1.0
            run.clock = float(run.step)

    monkeypatch.setattr(loop, "warm_up", compiled)
    annotations = RunAnnotations(began=now[0] if within else None)
    result = ur.optimize(problem(), "plain", seconds=20, callbacks=[Seconds()], annotations=annotations)
    assert result.stopped == "seconds"
    assert result.steps == steps


@pytest.mark.parametrize(
    ("pause", "resumed", "cheaper", "steps"),
    [
        (0.1, False, False, 2),
        (0.9, False, False, 1),
        (0.9, True, False, 2),
        (0.9, False, True, 2),
        (1.9, False, True, 1),
    ],
)
def test_a_long_step_warms_up_once(
    pause: float, resumed: bool, cheaper: bool, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a step of 8 s, whose kernels were known, two came before the first one of a budget of 15 s. A resumed run compares two states.
    With cheaper steps, a second one may take no more than half of what is left: 9 s of 12 had gone before the plan changed."""
    now, paused = [100.0], []
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(time, "sleep", lambda seconds: (paused.append(seconds), now.__setitem__(0, now[0] + seconds)))
    plan = Plan(problem(), slow(pause), ur.optimizers.Adam(0.01), cheaper=(lambda share: None) if cheaper else None)
    run = loop.prepare(plan, None, 4.0, 0)
    run.begin_budget(now[0])
    run.resumed = [] if resumed else None
    seconds, _ = loop.warm_up(run)
    assert run.tracing == pytest.approx(pause if steps == 1 else 0.0)
    assert (len(paused), seconds, run.trial[0]) == (steps, pytest.approx(steps * pause), pytest.approx(pause))


@pytest.mark.parametrize(
    ("slower", "left", "tracing", "tested"),
    [(1.0, 9.0, 2.0, True), (1.0, 6.0, 0.0, False), (9.0, 9.0, 0.0, False), (1.0, 9.0, 4.0, False)],
)
def test_tests_at_the_end_need_time_on_this_machine(slower: float, left: float, tracing: float, tested: bool) -> None:
    """Beside ten other jobs, tests took 11 s of a budget of 15 s, whose steps had 6, and tracing of their kernels 13.5 s."""
    run = loop.prepare(Plan(problem(), ur.PathGradient(), ur.optimizers.Adam(0.01)), None, 10.0, 0)
    run.deadline, run.trial, run.tracing = time.perf_counter() + left, (0.3 * slower, 16 * 8), tracing
    assert budget.can_test(run) is tested


def test_advice_on_few_steps_suits_the_run() -> None:
    assert budget.few_steps(4.0, 3, spp=16, large=True).endswith(
        "; use more seconds, fewer samples (--set spp=4), a smaller picture (resolution), or fewer pixels a step "
        "(--set pixels=4096 --set spp=4)"
    )
    assert budget.few_steps(4.0, 3, spp=4).endswith(
        "; use more seconds, fewer samples (--set spp=2), or a smaller picture (resolution)"
    )
    assert budget.few_steps(4.0, 3, spp=2).endswith("; use more seconds or a smaller picture (resolution)")
    assert not budget.few_steps(4.0, 20, spp=16)
    assert "; use at least 13 seconds or a smaller picture" in budget.few_steps(4.0, 3, enough=12.1)
    assert "about 3 steps after 2 s of loading and compiling; use" in budget.few_steps(4.0, 3, before=1.8)
    # The next run has the kernels: with them the same seconds suffice, and more than these would not be the least.
    again = budget.few_steps(12.0, 3, enough=9.0, before=8.0, compiled=True)
    assert again.endswith("; run it again, since its kernels are now compiled")
    assert "; use at least 14 seconds" in budget.few_steps(12.0, 3, enough=13.5, before=8.0, compiled=True)


@pytest.mark.parametrize(("workers", "own", "compiled"), [(False, 0, False), (False, 1, True), (True, 0, True)])
def test_kernels_of_other_processes_do_not_count_unless_workers_trace_paths(
    workers: bool, own: int, compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run whose kernels were known, beside one that compiled, was allowed to end 15 s late."""
    monkeypatch.setattr(loop.cache, "kernels_changed", itertools.count().__next__)
    monkeypatch.setattr(loop.dr.detail, "launch_stats", ((0, 0, own * n) for n in itertools.count()).__next__)
    remote: Any = SimpleNamespace(**{name: getattr(LOCAL, name) for name in dir(LOCAL) if name[0] != "_"})
    made = problem().with_parts(executor=remote if workers else LOCAL)
    run = loop.prepare(Plan(made, ur.PathGradient(), ur.optimizers.Adam(0.01)), 1, None, 0)
    loop.warm_up(run)
    assert run.compiled is compiled


@pytest.mark.parametrize(
    ("newton", "clock", "told"), [(False, 3.0, "at least 20"), (True, 3.0, ""), (True, 6.0, "at least 16")]
)
def test_gauss_newton_steps_need_fewer(newton: bool, clock: float, told: str) -> None:
    """20 of them were asked for, which take minutes, where a few converge."""
    parts: Any = (GaussNewton(), AveragedNewton()) if newton else (ur.PathGradient(), ur.optimizers.Adam(0.1))
    run = loop.prepare(Plan(problem(), *parts), None, 10.0, 0)
    run.step, run.clock = 3, clock
    budget._warn_of_few_steps(run)
    assert [f"use {told} seconds" in line for line in run.warnings] == [True] * bool(told)


def test_a_budget_of_few_steps_is_told_after_the_first() -> None:
    found = ur.optimize(problem(), slow(0.1), ur.optimizers.Adam(0.01), seconds=0.4)
    (line,) = (line for line in found.warnings if "allows about" in line)
    assert not any("too few" in line for line in found.warnings)  # the same again
    assert "fewer samples (--set spp=" in line
    assert "pixels=4096" not in line  # the view has 16 pixels
    assert not ur.optimize(problem(), slow(0.05), ur.optimizers.Adam(0.01), steps=8).warnings


@pytest.mark.parametrize(("steps", "words"), [(1, "1 step is"), (7, "7 steps are"), (8, "")])
@pytest.mark.parametrize("saved", [False, True])
def test_too_few_steps_to_judge_are_told(steps: int, words: str, saved: bool, tmp_path: Path) -> None:
    """Such runs ended as finished, without a word. Unknowns with standard errors have been judged, as in a run folder."""
    given = ur.PathGradient(), ur.optimizers.Adam(0.01), steps
    found = ur.optimize(problem(), *given, run_directory=tmp_path / "run" if saved else None)
    judged = bool(found.standard_error) or any("it settled" in line for line in found.warnings)
    assert judged is saved
    lines = [line for line in found.warnings if "too few" in line]
    expected = f"{words} too few to judge whether gain converged: give more steps"
    assert lines == [expected] * bool(words and not saved)


@pytest.mark.parametrize("interrupted", [False, True])
def test_the_end_of_a_number_of_steps_does_not_depend_on_the_clock(
    interrupted: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that goes five times as far with each look gave other pictures and left tests out; so did a resumed run."""

    class Interrupt(Callback):
        def on_step(self, run: Run, record: dict[str, Any]) -> None:
            if run.step == 20 and interrupted:
                raise KeyboardInterrupt

    ends = []
    for pace in (0.01, 0.05):
        clock = itertools.count(0.0, pace)
        monkeypatch.setattr(time, "perf_counter", lambda clock=clock: next(clock))
        given = ur.PathGradient(), ur.optimizers.Adam(0.02), 40
        folder, stops = tmp_path / str(pace), [Interrupt()] * (pace > 0.01)
        with contextlib.suppress(KeyboardInterrupt):
            end = ur.optimize(problem(), *given, callbacks=stops, run_directory=folder, checkpoint_every=8)
        if interrupted and stops:
            end = resume_run(load_run(folder), problem())
            assert end.resumed == [16]
        ends.append(end)
    first, last = ends
    assert first.verification == last.verification
    assert first.image_errors == last.image_errors
    for name in ("warnings", "undetermined", "without_errors"):
        assert list(getattr(first, name)) == list(getattr(last, name))
    for name in ("parameters", "standard_error"):
        np.testing.assert_array_equal(getattr(first, name)["gain"], getattr(last, name)["gain"])


@pytest.mark.parametrize("side", [16, 32, 64])
def test_numbers_have_standard_errors_after_few_steps_whatever_the_size_of_the_pictures(
    side: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four numbers at 32 x 32 pixels needed a hundredth more than their time, so a run of 60 steps had no standard errors. The end of a
    short run took 3 s of renderings whatever its steps took."""
    ends, render = [], writer.render_final_images

    def counted(*arguments: Any) -> Any:
        return render(*arguments), ends.append(timing.now())

    monkeypatch.setattr(writer, "render_final_images", lambda *arguments: counted(*arguments)[0])
    truth = {"gain": np.full(4, 0.5)}
    matrix = np.random.default_rng(1).uniform(0.0, 1.0, (3 * side * side, 4))
    made = AnalyticRenderer(truth, matrix, 0.1, 0.3, shape=(side, side))
    asked = ur.Problem(made, [ur.Parameter("gain", initial=0.5)], [ur.View(made.exact(truth))], truth=truth)
    found = ur.optimize(asked, ur.PathGradient(), ur.optimizers.Adam(0.001), 16, run_directory=tmp_path / "run")
    assert not any("too short for this test" in line for line in found.undetermined)
    assert ends[0] < 1.5


@pytest.mark.parametrize("rigid", [False, True])
def test_adjoints_of_poses_are_counted_with_their_boundary_terms(rigid: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """One takes a tenth of a second, not a hundredth: the end of a run of 2.5 s took 11 s, of which 8 s for 26 probes."""
    made = problem()
    infos = {key: replace(info, rigid=rigid) for key, info in made.renderer.parameters().items()}
    monkeypatch.setattr(made.renderer, "parameters", lambda: infos)
    with timing.counting():
        probes = curvature(made, made.initial_values(), seconds=0.5).probes
    assert probes <= 3 if rigid else probes > 12


def test_a_budget_of_few_steps_is_told_at_the_end_if_the_first_were_quick(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]

    class Busy(Callback):
        def on_step(self, run: Any, record: Any) -> None:
            object.__setattr__(estimator, "pause", 0.1 if run.step > 3 else 0.001)

    def passed(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(time, "sleep", passed)
    monkeypatch.setattr(budget, "slowdown", lambda: 1.0)
    estimator = slow(0.001)
    found = ur.optimize(problem(), estimator, ur.optimizers.Adam(0.01), seconds=0.6, callbacks=[Busy()])
    assert found.steps < 20
    (line,) = (line for line in found.warnings if "allows about" in line)
    assert f"allows about {found.steps} steps" in line


def test_steps_that_become_quick_leave_no_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first three steps took 0.3 s, those that followed a hundredth of it; the line still said that the budget allows 6 steps."""
    now = [100.0]

    class Quick(Callback):
        def on_step(self, run: Any, record: Any) -> None:
            noted.append([line for line in run.warnings if "allows about" in line])
            object.__setattr__(estimator, "pause", 0.1 if run.step < 3 else 0.001)

    def passed(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(time, "sleep", passed)
    monkeypatch.setattr(budget, "slowdown", lambda: 1.0)
    estimator, noted = slow(0.1), []
    found = ur.optimize(problem(), estimator, ur.optimizers.Adam(0.01), seconds=0.6, callbacks=[Quick()])
    assert found.steps > 20
    assert "; use at least 2 seconds" in noted[3][0]
    assert not found.warnings


@pytest.mark.parametrize(
    ("seconds", "slowdown", "left"), [(10.0, 1.0, 8.0), (1.0, 1.0, 0.5), (30.0, 2.0, 22.0), (30.0, 9.0, 18.0)]
)
def test_the_end_of_the_steps_leaves_time_for_the_final_pictures(
    seconds: float, slowdown: float, left: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A tenth and a second, times the slowdown of a busy machine, up to 3; but half of the budget at most."""
    monkeypatch.setattr(budget, "slowdown", lambda: slowdown)
    run = loop.prepare(Plan(problem(), ur.PathGradient(), ur.optimizers.Adam(0.01)), None, seconds, 0)
    run.deadline = time.perf_counter() + seconds
    budget.Budget()._set_last_step(run)
    assert (run.last_step or 0.0) - time.perf_counter() == pytest.approx(left, abs=0.1)
    run.step, run.clock = 3, 0.15 * left  # 20 steps fill this time, and it advised 10 seconds of 12 on a busy machine
    run.deadline = time.perf_counter() + seconds - run.clock
    assert budget._enough(run, 20) == pytest.approx(seconds, rel=0.01)
    run.before, run.tracing, run.compiled = 5.0, 5.0, True  # seconds that another run does not need
    assert budget._enough(run, 20) == pytest.approx(seconds, rel=0.01)


def test_a_resumed_run_has_what_is_left_of_its_budget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[float] = []
    check = budget.Budget._check
    monkeypatch.setattr(budget.Budget, "_check", lambda self, run: (seen.append(run.time_left()), check(self, run))[1])
    parts = ur.PathGradient(), ur.optimizers.Adam(0.01)
    clock = ur.optimize(problem(), *parts, steps=5, run_directory=tmp_path / "run").seconds
    seen.clear()
    resume_run(load_run(tmp_path / "run", seconds=clock + 0.5), problem(), began=time.perf_counter())
    assert seen[0] <= 0.5


@pytest.mark.parametrize(
    ("steps", "seconds", "message"),
    [
        (None, None, "set a budget"),
        (0, None, "steps must be a whole number of at least 1, got 0"),
        (2.0, None, "steps must be a whole number of at least 1, got 2.0"),
        (True, None, "steps must be a whole number of at least 1, got True"),
        (1 << 63, None, "steps must be at most 9223372036854775807, got 9223372036854775808"),
        (None, 0, "seconds must be positive and finite, got 0"),
        (None, math.inf, "seconds must be positive and finite, got inf"),
        (None, math.nan, "seconds must be positive and finite, got nan"),
        (None, True, "seconds must be positive and finite, got True"),
        (None, 10**400, "seconds must be positive and finite, got an integer of 1329 bits"),
        (None, "5", "seconds must be positive and finite, got '5'"),
    ],
)
def test_an_invalid_budget_is_refused(steps: Any, seconds: Any, message: str) -> None:
    with pytest.raises(ur.InputError, match=f"^optimize: {message}"):
        budget.check_budget(steps, seconds)


@pytest.mark.parametrize("scale", [1.0, 1e-5, 1e-11])
def test_dim_pictures_whose_gradient_is_below_epsilon_are_told(scale: float) -> None:
    """Such a run ended as finished at its start, and dimmer pictures were said not to depend on the parameter."""
    matrix = np.random.default_rng(1).uniform(0.0, scale, (48, 2))
    renderer = AnalyticRenderer(TRUTH, matrix, 0.0, 0.0)
    dim = ur.Problem(renderer, [ur.Parameter("gain", initial=0.2)], [ur.View(renderer.exact(TRUTH))])
    result = ur.optimize(dim, ur.PathGradient(spp=2), ur.optimizers.Adam(0.01), steps=6)
    told = [line for line in result.warnings if "gain: its gradient" in line]
    assert (len(told), result.history[-1]["loss"] < 1e-9) == ((0, False) if scale == 1.0 else (1, True))
    assert all("below the optimizer's epsilon of 1e-08" in line for line in told)


@pytest.mark.parametrize("of_block", [False, True])
def test_gauss_newton_steps_of_small_gradients_are_not_short(of_block: bool) -> None:
    """The steps of a pose, which have no epsilon, were said to be short where Adam's epsilon for a texture was larger."""
    optimizer = ur.optimizers.Partitioned(("gain",), AveragedNewton(), ur.optimizers.Adam(0.01))
    run = loop.prepare(Plan(problem(), ur.PathGradient(), ur.optimizers.Adam(0.01)), 9, None, 0)
    run.optimizer, watch, gradient = optimizer, InfluenceWatch(), {"gain": np.full(2, 1e-10)}
    block = (BlockEstimate(("gain",), Estimate(0.0, gradient)),) if of_block else ()
    for run.step in range(1, 6):
        watch.on_update(run, Estimate(0.0, gradient, block), True)
    assert ["below the optimizer's epsilon" in line for line in run.warnings] == [True] * (not of_block)


def test_the_plan_of_another_problem_is_refused() -> None:
    """The optimizer of a plan in a file names parameters; a run folder whose problem has got other keys has such a plan."""
    optimizer = ur.optimizers.ScheduleFree(preconditioner=ur.preconditioners.Sobolev(), preconditioned=("wall.data",))
    with pytest.raises(ur.InputError, match='preconditioned: unknown parameter "wall'):
        ur.optimize(problem(), ur.PathGradient(spp=2), optimizer, steps=1)


def test_numbers_of_numpy_are_a_budget() -> None:
    parts = ur.PathGradient(spp=2), ur.optimizers.Adam(0.01)
    result = ur.optimize(problem(), *parts, steps=np.int64(3), seconds=np.float32(60))  # pyright: ignore[reportArgumentType]
    assert result.steps == 3
    numbers: Any = {"view": np.int64(0), "spp": np.int64(2), "seed": np.int64(1)}
    assert np.array_equal(ur.render(problem(), **numbers), ur.render(problem(), spp=2, seed=1))
    wrong: Any
    for name, wrong in (("view", 0.0), ("view", None), ("seed", 1.5), ("spp", 10**400), ("spp", 2**32)):
        with pytest.raises(ur.InputError, match=f"^render: {name}"):
            ur.render(problem(), **{name: wrong})


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_values_that_are_not_finite_are_not_rendered(wrong: float) -> None:
    values = {key: np.full(np.shape(x), wrong) for key, x in problem().initial().items()}
    renderings = [lambda: ur.render(problem(), values), lambda: ur.estimate(problem(), "plain", values)]
    for render in [*renderings, lambda: ur.render_pair(problem(), problem().initial(), values, 2, 0)]:
        with pytest.raises(
            ur.InputError, match=r"^parameter .*: expected finite numbers, got NaN, infinite ones or another type$"
        ):
            render()


def test_slowdown_is_at_least_one() -> None:
    assert 1.0 <= budget.slowdown() < 1e3


@pytest.mark.slow
def test_a_run_that_its_budget_ends_before_a_third_step_is_told() -> None:
    found = ur.optimize(problem(), slow(0.5), ur.optimizers.Adam(0.01), seconds=0.6)
    assert found.steps < 3
    assert sum("allows about" in line for line in found.warnings) == 1


def test_thinning_keeps_the_records_of_refinements() -> None:
    records: list[dict[str, Any]] = [{"step": step} for step in range(80)]
    records[5]["resolution"], records[7]["faces"] = {"albedo": [8, 8]}, {"mesh": 320}
    for length in (80, 60):
        records = thinned(records[:length])
    assert [r["step"] for r in records if len(r) > 1] == [5, 7]
    assert len(records) < 50


def large_view(loss: str, side: int = 128) -> ur.Problem:
    truth = {"gain": np.full(1, 0.5)}
    made = AnalyticRenderer(truth, np.ones((3 * side * side, 1)), 0.1, 0.3, shape=(side, side))
    view = ur.View(made.exact(truth))
    return ur.Problem(made, [ur.Parameter("gain", initial=0.2)], [view], loss=getattr(ur.losses, loss)())


@pytest.mark.parametrize(("loss", "options"), [("L2", {"pixels": 4096, "spp": 4}), ("L1", None)])
def test_large_views_have_mini_batches_where_time_is_short(loss: str, options: dict[str, int] | None) -> None:
    """With L1 and the noise of few samples, such steps diverged to 2.5 times the error of the start."""
    asked = large_view(loss)
    cheaper = method("auto").plan(asked).cheaper
    assert (cheaper is None) == (options is None)  # a run without other steps warms up once if they are long
    found = cheaper(0.1) if cheaper else None
    assert (found and found[1]) == options
    assert not found or isinstance(found[0].estimator, ur.PathGradient)


@pytest.mark.parametrize(
    ("name", "loss", "estimator", "side", "told"),
    [
        ("auto", "L2", ur.PathGradient(spp=2), 256, True),
        ("auto", "L2", ur.PathGradient(spp=2), 128, False),
        ("auto", "L1", ur.PathGradient(spp=2), 256, False),
        ("auto", "L2", GaussNewton(), 256, False),
        ("auto", "L2", ur.PathGradient(pixels=ur.pixels.Uniform(4096)), 256, False),
        ("plain", "L2", ur.PathGradient(spp=2), 256, False),
    ],
)
def test_mini_batches_are_advised_where_they_are_an_option_and_converge(
    name: str, loss: str, estimator: Any, side: int, told: bool
) -> None:
    """With L1, a run that took this advice ended at 2.5 times the error of its start; other methods refused the option. In small
    pictures, 4096 pixels have more paths than all of them, and a run that had gone on with other steps was told to undo that."""
    optimizer = AveragedNewton() if isinstance(estimator, GaussNewton) else ur.optimizers.Adam(0.1)
    run = loop.prepare(Plan(large_view(loss, side), estimator, optimizer), None, 10.0, 0)
    run.step, run.clock, run.description = 3, 6.0, {"method": name}
    budget._warn_of_few_steps(run)
    assert ["--set pixels=4096 --set spp=4" in line for line in run.warnings] == [told]
    run.replanned = True
    budget._warn_of_few_steps(run)
    (line,) = run.warnings
    assert line.endswith("; use more seconds or a smaller picture (resolution)")


def test_derivative_images_get_no_shorter_by_samples_of_images() -> None:
    """A run of a pose went on with smoothed gradients, since a trial of four samples could not tell its derivative images from noise."""
    plan, options = Plan(large_view("L2"), GaussNewton(), AveragedNewton()), method("auto").configure({})
    assert isinstance(options, AutoMethod)
    assert options._shorter(plan, 0.1) is None
    assert options._shorter(replace(plan, estimator=ur.PathGradient(spp=16)), 0.1) == {"spp": 2}


@pytest.mark.mitsuba  # which a run folder asks for its version
def test_auto_takes_shorter_steps_where_one_takes_a_fifth_of_the_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such runs ended after three steps, with advice. A given spp stays, and so do steps of a budget of steps alone."""
    now, estimate, save, saved = [100.0], ur.PathGradient.estimate, serialization.save, []
    monkeypatch.setattr(serialization, "save", lambda *of: (saved.append(of), save(*of)))

    def slowly(self: ur.PathGradient, *arguments: Any) -> Any:
        now[0] += 0.1 * self.spp
        return estimate(self, *arguments)

    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(ur.PathGradient, "estimate", slowly)
    monkeypatch.setattr(budget, "slowdown", lambda: 1.0)
    cases = (now[0], {}, 2, None), (now[0], {"spp": 16}, 16, None), (None, {}, 16, None), (now[0], {}, 16, 2)
    for began, options, spp, steps in cases:  # of which two long ones fit into the time
        plan, folder = method("auto").plan(problem(), options), tmp_path / f"{began}-{len(options)}-{steps}"
        annotations = RunAnnotations("auto", began=None if began is None else now[0], choices=plan.lines)
        found = ur.optimize(problem(), plan, steps=steps, seconds=10, run_directory=folder, annotations=annotations)
        lines = [line for line in found.warnings if "goes on as with --set spp=2;" in line]
        assert len(lines) == (spp == 2)
        assert f"{spp} samples per pixel" in found.choices[0]
        stored = load_run(folder, steps=found.steps + 1)
        assert stored.method.estimator["path"]["spp"] == spp  # pyright: ignore[reportArgumentType]
        assert found.steps >= (20 if spp == 2 else 1)
        assert resume_run(stored, problem()).steps == found.steps + 1
    assert len(saved) == len(cases)  # references may be large
