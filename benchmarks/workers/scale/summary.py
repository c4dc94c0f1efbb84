"""What the measured steps say: the fit and how good it is, the simulation against the closed form, the prediction for more workers."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np

from benchmarks.workers.scale.cost import Costs, Job, Network, compute, fit, wire_bytes
from benchmarks.workers.scale.simulation import IN_A_ROW, Faults, simulate

__all__ = ["COUNTS", "JOBS", "NETWORKS", "STORE", "summary"]

COUNTS = (8, 64, 512)
STORE = 30e9
"""Bytes of the driver's object store: Ray's default on a machine with 100 GB."""
JOBS = {
    "materials": Job(10_000, 512, 0.05, 0.1),
    "texture": Job(6_291_456, 512, 0.05, 0.1),
    "volume": Job(16_777_216, 512, 0.05, 0.1),
    "large": Job(100_000_000, 512, 0.05, 0.1),
}
"""Ten thousand numbers, two textures of 1024² texels, a grid of 256³, a hundred million numbers; 512 views, 50 ms each, 10 % of spread."""
NETWORKS = {"one hall": (25e9 / 8, 1e-4), "the internet": (1e9 / 8, 0.05)}
"""Bytes a second into the driver's machine, seconds there and back. Eight workers a machine, those of the first on the driver's."""
PER_MACHINE = 8
HOUR = 3600.0
LOST_EVERY, SLOW_EVERY = 1000 * HOUR, 100 * HOUR
"""A worker is lost once in 1000 hours, and turns ten times slower once in 100."""
FAULTS = Faults(slowness=10.0, notice=5.0, restart=30.0, collected_every=100)
STEPS, BETWEEN = {8: 30000, 64: 3000, 512: 600}, 25
"""Of a simulation of faults: how many, and from one fault to the next, which is far more often than they come: what one costs counts."""


def summary(record: dict[str, Any]) -> dict[str, Any]:
    """The entries that are made of the measured ones."""
    rows = [{"link": link, **row} for link, of in record["cases"].items() for row in of]
    stand_ins = [row for row in rows if row["view_seconds"] is not None]
    if len(stand_ins) < 12:  # toy sizes
        return {}
    fitted = [row for index, row in enumerate(stand_ins) if index % 3 != 2]
    costs = fit([_case(row, record["views"]) for row in fitted], [row["seconds"] for row in fitted])
    for row in rows:
        row["predicted"] = costs.step(*_case(row, record["views"]))
        row["use"] = "rendering" if row["view_seconds"] is None else "fitted" if row in fitted else "held out"
    return {
        "costs": asdict(costs),
        "fit": {use: _errors([row for row in rows if row["use"] == use]) for use in ("fitted", "held out", "rendering")},
        "rows": rows,
        "predicted": {
            where: {name: {str(n): _predicted(costs, job, network(n, *limits)) for n in COUNTS} for name, job in JOBS.items()}
            for where, limits in NETWORKS.items()
        },
        "faults": {str(n): _faulty(costs, n) for n in COUNTS},
    }  # fmt: skip


def network(workers: int, rate: float, trip: float) -> Network:
    """So many workers, eight a machine."""
    machines = -(-workers // PER_MACHINE)
    remote = max(workers - PER_MACHINE, 0)
    return Network(workers, machines - 1, remote, rate, trip)


def _case(row: dict[str, Any], views: int) -> tuple[Job, Network]:
    workers = row["workers"]
    each = -(-views // workers)
    sent, received = (2.0, 4.0) if row["compress"] else (4.0, 8.0)
    job = Job(3 * row["side"] ** 2, views, row["busy"] / each, 0.0, sent, received)
    if "trip" not in row:
        return job, Network(workers)
    return job, Network(workers, 1, workers // 2, row["rate"] or float("inf"), row["trip"])


def _errors(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Relative errors of the predicted steps, and of what is beside the workers' own time."""
    if not rows:
        return {"count": 0, "median": 0.0, "worst": 0.0}
    errors = [abs(row["predicted"] / row["seconds"] - 1) for row in rows]
    return {"count": len(rows), "median": float(np.median(errors)), "worst": float(max(errors))}


def _predicted(costs: Costs, job: Job, where: Network) -> dict[str, Any]:
    """The step, its parts, what it would be with compression, and with the replies of each machine summed there."""
    found = simulate(costs, job, where, 20, seed=0)
    time = costs.step(job, where)
    small = replace(job, sent=2.0, received=4.0)
    tree = replace(where, remote=where.nodes, workers=min(where.workers, PER_MACHINE) + where.nodes)
    summed = costs.step(job, where) - sum(costs.parts(job, where).values()) + sum(costs.parts(job, tree).values())
    return {
        "compute": compute(job, where),
        "parts": costs.parts(job, where),
        "step": time,
        "simulated": found.step,
        "efficiency": job.views * job.view_seconds / (where.workers * time),
        "compressed": costs.step(small, where),
        "summed_by_machine": summed,
        "into_the_driver": wire_bytes(job, where)[1],
        "store": job.received * job.parameters * job.gradients * where.workers,
    }


def _faulty(costs: Costs, workers: int) -> dict[str, float]:
    """Seconds that a loss and a straggler cost, simulated and by the closed form, and the share of the time at their usual rates."""
    job, where = JOBS["texture"], network(workers, *NETWORKS["one hall"])
    steps = STEPS[workers]
    base = simulate(costs, job, where, steps, seed=1).step
    each = -(-job.views // workers) * job.view_seconds
    queue = (costs.byte + costs.transfer / where.rate) * wire_bytes(job, where)[1]  # what is late hides behind it
    doubled = FAULTS.restart / base * max(each - queue, 0.0)  # until the new worker is there, one has twice the views
    forms = {
        "lost": FAULTS.notice + (1 + (FAULTS.collected_every - 1) / 2) * each + doubled,
        "slow": IN_A_ROW * max((FAULTS.slowness - 1) * each - queue, 0.0) + doubled,
    }
    found: dict[str, float] = {"step": base}
    for name, every in (("lost", LOST_EVERY), ("slow", SLOW_EVERY)):
        often = workers * (BETWEEN * base + 4 * forms[name])
        rates = {"lost_every": float("inf"), "slow_every": float("inf")} | {f"{name}_every": often}
        run = simulate(costs, job, where, steps, 1, replace(FAULTS, **rates))
        count = run.lost if name == "lost" else run.moved
        seconds = (run.step - base) * steps / max(count, 1)
        found |= {f"{name}_events": count, f"{name}_seconds": seconds, f"{name}_closed": forms[name]}
        found[f"{name}_share"] = workers * seconds / every
    return found
