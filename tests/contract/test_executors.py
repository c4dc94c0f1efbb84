"""Every executor gives the run that one process gives, with checkpoints that any other executor takes up."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.contract import analytic
from tests.local_hosts import LocalHosts
from tiers import quick
from unrender.app.distributed.assignment import assign
from unrender.app.distributed.executor import DistributedExecutor
from unrender.app.distributed.share import ViewShare
from unrender.scene.executor import Executor, LocalExecutor

VIEWS, STEPS = 3, 6


class Counting(LocalExecutor):
    """An executor of one file, as another package would write it."""

    def __init__(self) -> None:
        self.requests = 0

    def estimate_gradient(self, problem: Any, request: Any) -> Any:
        self.requests += 1
        return super().estimate_gradient(problem, request)


def distributed(problem: ur.Problem) -> DistributedExecutor:
    shares = assign([16] * VIEWS, 2)
    parts = [problem.replaced(views=[problem.original_views[view] for view in views]) for views in shares]
    hosts = LocalHosts(tuple(ViewShare(part, views) for part, views in zip(parts, shares, strict=True)))
    return DistributedExecutor(problem, shares, hosts)


EXECUTORS: dict[str, Callable[[ur.Problem], Executor]] = {
    "local": lambda problem: LocalExecutor(),
    "distributed": distributed,
    "of another package": lambda problem: Counting(),
}


def run(problem: ur.Problem, folder: Path, steps: int) -> ur.Result:
    estimator = ur.PathGradient(ur.images.RecursiveControlVariate(), spp=2)
    return ur.optimize(problem, estimator, ur.optimizers.Adam(0.02), steps, run_directory=folder, progress=False)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> ur.Result:
    """The run of one process."""
    return run(analytic.problem(views=VIEWS), tmp_path_factory.mktemp("alone"), STEPS)


@pytest.mark.parametrize("name", quick(EXECUTORS, "local", "distributed"))
def test_runs_are_alike_and_change_executors_on_the_way(name: str, alone: ur.Result, tmp_path: Path) -> None:
    problem = analytic.problem(views=VIEWS)
    executor = EXECUTORS[name](problem)
    other = problem.with_parts(executor=executor)
    whole = run(other, tmp_path / "whole", STEPS)
    run(other, tmp_path / "begun", STEPS // 2)
    resumed = ur.resume(tmp_path / "begun", problem, steps=STEPS)
    for key, value in alone.parameters.items():
        np.testing.assert_allclose(whole.parameters[key], value, rtol=1e-6)
        np.testing.assert_allclose(resumed.parameters[key], value, rtol=1e-6)
    if isinstance(executor, Counting):
        assert executor.requests >= STEPS + STEPS // 2
