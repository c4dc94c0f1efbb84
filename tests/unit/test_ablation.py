"""The suite without one of the parts of `auto`."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.internals import CachingSession, mi, prepare
from benchmarks.stock_loop import StockViews
from benchmarks.suite import ablation, run, scenes
from tests.unit.test_auto import problem
from unrender import InputError, gallery, losses, optimize, optimizers
from unrender.images import Plain
from unrender.rendering.mitsuba.frozen import _registered


def test_each_part_is_left_out_alone() -> None:
    made = problem(losses.L1())
    own: Any = ablation.plan(made)
    plans: dict[str, Any] = {part: ablation.plan(made, part) for part in ablation.PARTS}
    assert {part for part in plans if not ablation.changes(made, part)} == {"model-steps"}
    assert isinstance(plans["control-variate"].estimator.image, Plain)
    assert not plans["sobolev"].optimizer.preconditioned
    assert plans["schedule-free"].optimizer == optimizers.Adam(own.optimizer.learning_rate)
    assert plans["schedule-free"].estimator == own.estimator
    assert (plans["leave-one-out"].estimator.adjoint_spp, own.estimator.adjoint_spp) == (own.estimator.spp, None)
    assert plans["leave-one-out"].optimizer == own.optimizer
    assert plans["damping"].estimator.tolerance == 0.0 < own.estimator.tolerance
    tuned: Any = ablation.plan(made, "spp=3")
    assert tuned.estimator.spp == 3
    assert not ablation.changes(problem(losses.L2()), "damping")  # only losses that noise biases have it
    for plan in plans.values():
        assert optimize(plan.problem, plan, steps=2).steps == 2


@pytest.mark.mitsuba
def test_paths_and_model_steps_are_left_out(mitsuba_variant: str) -> None:
    room = gallery.problem("indirect-room", resolution=8, texture_resolution=4, reference_spp=4)
    plan = ablation.plan(room, "kept-paths")
    kinds = [isinstance(prepare(one, list(one.unknowns)), CachingSession) for one in (room, plan.problem)]
    assert kinds == [True, False]
    assert optimize(plan.problem, plan, steps=1).steps == 1
    camera = gallery.problem("camera", resolution=8, reference_spp=4)
    names = [type(ablation.plan(camera, part).optimizer).__name__ for part in ("", "model-steps")]
    assert names == ["AveragedNewton", "NewtonCG"]


def test_the_table_has_the_geometric_mean_without_each_part() -> None:
    entries = [
        {"speed": 2.0, "seconds_of_loop": 4.0, "without": {"sobolev": {"speed": 1.0, "changed": True}}},
        {"speed": 8.0, "seconds_of_loop": 2.0, "without": {"sobolev": {"speed": None, "changed": False}}},
    ]
    rows = ablation.table(entries, lambda speeds: run._mean(speeds, entries, 4.0)).splitlines()
    assert rows[2:] == ["|  | 4.00 | 1 |  |", "| sobolev | 0.71 | 0.18 | 1 |"]  # sqrt(1 * 2 / 4)
    assert ablation.table([*entries, {"speed": 1.0, "seconds_of_loop": 4.0}], lambda _: 1.0) == ""


def test_an_unknown_part_is_refused_before_any_run() -> None:
    with pytest.raises(InputError, match="--without caches: expected kept-paths, control-variate, sobolev"):
        next(run.run(without=("caches",)))


def test_options_of_a_problem_of_the_gallery_reach_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The film's resolution, too, which problems of others have by position."""
    monkeypatch.setattr(gallery, "problem", lambda name, **options: (name, options))
    assert scenes.problem("wall", None, 64, 64, 4096, resolution=512) == ("wall", {"resolution": 512})


@pytest.mark.slow
@pytest.mark.mitsuba
def test_scenes_of_a_row_are_freed_before_the_next(mitsuba_variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    alive: list[int] = []

    def loop(opened: Any, *arguments: Any) -> list[tuple[float, float]]:
        alive.append(sum(1 for _ in _registered(mi.BSDFPtr)))
        StockViews(opened)
        return [(1.0, 0.5)]

    monkeypatch.setattr(run, "loop", loop)
    monkeypatch.setattr(run, "ours", lambda *arguments: (loop(arguments[0]), {"steps": 1, "compile_seconds": 0.0}))
    sizes: dict[str, Any] = {"gallery_resolution": 8, "gallery_reference_spp": 1, "seeds": 1}
    assert len(list(run.run(("poster",) * 2, retune=False, **sizes))) == 2
    assert alive[0] == alive[2]
