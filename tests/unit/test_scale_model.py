"""The cost model of dealt runs and its simulation, against closed forms. No Ray, no rendering."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from benchmarks.runner import records
from benchmarks.runner.catalogue import ROOT
from benchmarks.workers.scale import table
from benchmarks.workers.scale.cost import Costs, Job, Network, fit, slowest
from benchmarks.workers.scale.simulation import Faults, simulate
from benchmarks.workers.scale.summary import NETWORKS

COSTS = Costs(0.01, 2e-9, 1e-3, 3e-9, 1e-9, 2.0, 1.2)
LINKS = ((np.inf, 0.0), (1e8, 0.0), (1e7, 0.02), (3e7, 0.1))
JOB = Job(1_000_000, 64, 0.01)


def test_the_slowest_of_two_is_the_closed_form() -> None:
    sigma = np.sqrt(np.log1p(0.3**2))
    assert slowest(2, 0.3) == pytest.approx(2 * ndtr(sigma / np.sqrt(2)), rel=1e-6)
    assert slowest(1, 0.3) == slowest(9, 0.0) == 1.0


def test_a_fit_finds_the_costs_that_made_the_steps() -> None:
    cases = [
        (Job(size, 64, 0.01), where)
        for size in (10_000, 300_000, 3_000_000)
        for workers in (2, 4, 16)
        for where in (Network(workers), *(Network(workers, 1, workers // 2, *link) for link in LINKS))
    ]
    found = fit(cases, [COSTS.step(*case) for case in cases])
    for name, value in vars(COSTS).items():
        assert getattr(found, name) == pytest.approx(value, rel=1e-6)


def test_a_step_on_one_machine_is_the_sum_of_its_terms() -> None:
    for workers in (1, 4, 64):
        where = Network(workers)
        assert simulate(COSTS, JOB, where, 3, 0).step == pytest.approx(COSTS.step(JOB, where))


def test_replies_queue_where_they_enter_the_drivers_machine() -> None:
    where = Network(8, 8, 8, rate=1e8, trip=0.1)
    each = JOB.parameters * (COSTS.byte + COSTS.transfer / where.rate)
    # The first worker has its parameters after one copy, begins, and is followed at a copy's distance; replies are twice as long.
    expected = COSTS.driver + COSTS.parameter * JOB.parameters + 4 * each + COSTS.trip * where.trip
    expected += 8 * JOB.view_seconds + 8 * 8 * each + COSTS.gradient * JOB.parameters * 8
    assert simulate(COSTS, JOB, where, 2, 0).step == pytest.approx(expected)
    assert COSTS.step(JOB, where) == pytest.approx(expected + 7 * 4 * each + 8 * COSTS.worker)


def test_random_speeds_cost_what_the_largest_of_them_does() -> None:
    job, where, steps = replace(JOB, spread=0.2), Network(16), 400
    alone = simulate(COSTS, JOB, where, 1, 0).step
    ends = [simulate(COSTS, job, where, steps, seed).step - alone for seed in range(4)]
    expected = 4 * JOB.view_seconds * (slowest(16, 0.2) - 1)
    # The last worker is called 15 ms after the first, so the largest is not quite as late as it would be at once.
    assert np.mean(ends) == pytest.approx(expected, rel=0.5)
    assert np.std(ends) / 2 < 0.02 * expected


def test_losses_come_as_often_as_they_should_and_cost_what_they_do() -> None:
    faults = Faults(lost_every=500.0, notice=3.0, restart=0.0, repeats=False)
    where, steps = Network(16), 1500
    alone, broken = (simulate(COSTS, JOB, where, steps, 1, given) for given in (None, faults))
    expected = 16 * broken.step * steps / 500.0
    assert abs(broken.lost - expected) < 4 * np.sqrt(expected)
    cost = (broken.step - alone.step) * steps / broken.lost
    assert cost == pytest.approx(3.0 + 4 * JOB.view_seconds, rel=0.05)


def test_a_straggler_costs_some_steps_of_its_slowness() -> None:
    faults = Faults(slow_every=2000.0, slowness=10.0, restart=0.0)
    alone, broken = (simulate(COSTS, JOB, Network(16), 1500, 1, given) for given in (None, faults))
    cost = (broken.step - alone.step) * 1500 / broken.moved
    assert cost == pytest.approx(8 * 9 * 4 * JOB.view_seconds, rel=0.1)


def test_the_page_has_the_tables_of_the_record() -> None:
    record = records.read(ROOT / "benchmarks" / "workers" / "scale")
    page = (ROOT / "docs" / "scale.md").read_text()
    assert record is not None
    for part in (table.costs, table.errors, table.faults):
        assert part(record) in page
    for where in NETWORKS:
        assert table.predictions(record, where).partition("\n\n")[2] in page
    assert all(text in page for text in (record["date"], record["commit"], record["command"]))
