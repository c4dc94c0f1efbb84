"""Dealt runs as events on a clock: calls, links in which messages queue, workers of random speed, stragglers and losses. NumPy alone.

One step: the driver calls the workers one after the other; parameters leave its machine one copy a machine after the other; a worker
begins when its machine has them; replies enter the driver's machine in the order in which they are ready, one at a time; the driver sums
when all are there. A worker that is lost is noticed after a while, its views go to another, which makes what they remembered again
by repeating steps, and a new one joins later. A worker that turns slow is moved from after some steps, as `RayHosts` does.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np

from benchmarks.workers.scale.cost import Costs, Job, Network

__all__ = ["IN_A_ROW", "Faults", "Outcome", "simulate"]

IN_A_ROW, _LAGGING = 8, 4.0
"""Steps until a straggler's views are moved, and times the others' time from which it counts as one."""


@dataclass(frozen=True)
class Faults:
    """What goes wrong, and what it takes.

    Attributes:
        lost_every: mean seconds between losses of one worker; infinite for none.
        slow_every: mean seconds until a worker turns slow.
        slowness: times slower that it is then.
        notice: seconds until a loss is noticed.
        restart: seconds until a new worker is there and holds views.
        collected_every: steps between collections of what workers remember; what was lost is made again from the last one on.
        collect: seconds of such a collection; also of every checkpoint.
        repeats: whether a share that was lost repeats its steps since then: with control variates, not with plain images.
    """

    lost_every: float = float("inf")
    slow_every: float = float("inf")
    slowness: float = 10.0
    notice: float = 5.0
    restart: float = 20.0
    collected_every: int = 100
    collect: float = 0.0
    repeats: bool = True


@dataclass(frozen=True)
class Outcome:
    """What came of a run.

    Attributes:
        step: mean seconds of a step, everything included.
        undisturbed: median seconds of a step.
        lost, moved: workers lost, and stragglers whose views were moved.
        link: share of the time in which something entered the driver's machine.
    """

    step: float
    undisturbed: float
    lost: int
    moved: int
    link: float


def simulate(costs: Costs, job: Job, network: Network, steps: int, seed: int, faults: Faults | None = None) -> Outcome:
    """A run of so many steps.

    Args:
        costs, job, network: see there. Workers are divided evenly among the machines; the first are on the driver's own.
        steps: of the run.
        seed: of speeds, stragglers and losses.
        faults: None for none.
    """
    run = _Run(costs, job, network, np.random.default_rng(seed), faults or Faults())
    times = [run.step(number) for number in range(steps)]
    return Outcome(run.now / steps, float(np.median(times)), run.lost, run.moved, run.busy / run.now)


class _Run:
    """The state of a run between steps. Mutable."""

    def __init__(self, costs: Costs, job: Job, network: Network, rng: np.random.Generator, faults: Faults):
        self.costs, self.job, self.network, self.rng, self.faults = costs, job, network, rng, faults
        workers = min(network.workers, job.views)
        share, extra = divmod(job.views, workers)
        self.views = np.array([share + (w < extra) for w in range(workers)])
        local = workers - min(network.remote, workers)
        self.node = np.array([-1 if w < local else (w - local) % max(network.nodes, 1) for w in range(workers)])
        self.now = self.busy = 0.0
        self.lost = self.moved = 0
        self.slow_since = np.full(workers, -1)
        self.holder = np.arange(workers)  # of each share
        self.back = np.zeros(workers)  # when a share's own worker is there again
        self.next_loss = rng.exponential(faults.lost_every, workers) if np.isfinite(faults.lost_every) else None
        self.next_slow = rng.exponential(faults.slow_every, workers) if np.isfinite(faults.slow_every) else None

    def step(self, number: int) -> float:
        """Carry out one; its seconds."""
        began = self.now
        self._rejoin()
        self._turn_slow(number)
        self._attempt(self._speeds())
        if self.next_loss is not None:
            self._lose(began, number)
        if self.faults.collect and (number + 1) % self.faults.collected_every == 0:
            self.now += self.faults.collect
        return self.now - began

    def _attempt(self, seconds: np.ndarray) -> None:
        """From the first call to the sum."""
        costs, job, network = self.costs, self.job, self.network
        start = self.now + costs.driver + costs.parameter * job.parameters
        each = costs.byte + costs.transfer / network.rate
        out = job.sent * job.parameters * each
        back = job.received * job.parameters * job.gradients * each
        half = costs.trip * network.trip / 2
        called = start + costs.worker * np.arange(1, len(self.views) + 1)
        arrived: dict[int, float] = {-1: start}
        free = start
        for node in range(network.nodes):  # one copy after the other leaves the driver's machine
            free += out
            arrived[node] = free + half
        there = np.maximum(called, [arrived[node] for node in self.node])
        finished = self._rendered(there, seconds)
        events = [(time + (half if node >= 0 else 0.0), share, node >= 0) for share, (time, node) in
                  enumerate(zip(finished, self.node, strict=True))]  # fmt: skip
        heapq.heapify(events)
        free = start
        while events:  # replies queue at the driver's machine
            ready, _, remote = heapq.heappop(events)
            if remote:
                free = max(free, ready) + back
                self.busy += back
            else:
                free = max(free, ready)
        self.now = free + costs.gradient * job.parameters * job.gradients * len(self.views)

    def _rendered(self, there: np.ndarray, seconds: np.ndarray) -> np.ndarray:
        """When each share has been: a worker with several does one after the other."""
        free: dict[int, float] = {}
        finished = np.empty(len(there))
        for share in np.argsort(there, kind="stable"):
            holder = int(self.holder[share])
            free[holder] = max(free.get(holder, 0.0), float(there[share])) + float(seconds[share])
            finished[share] = free[holder]
        return finished

    def _speeds(self) -> np.ndarray:
        """Seconds of each share in this step."""
        seconds = self.views * self.job.view_seconds
        if self.job.spread:
            sigma = np.sqrt(np.log1p(self.job.spread**2))
            seconds = seconds * np.exp(sigma * self.rng.standard_normal(len(self.views)) - sigma**2 / 2)
        slow = (self.slow_since >= 0) & (self.holder == np.arange(len(self.views)))
        return np.where(slow, seconds * self.faults.slowness, seconds)

    # ------------------------------------------------------------------ what goes wrong

    def _rejoin(self) -> None:
        own = np.arange(len(self.holder))
        there = (self.holder != own) & (self.back <= self.now)
        self.holder = np.where(there, own, self.holder)

    def _turn_slow(self, number: int) -> None:
        """Workers turn slow, and lose their share a few steps later to one that is not; a new one takes it again when it is there."""
        if self.next_slow is None:
            return
        turned = (self.next_slow <= self.now) & (self.slow_since < 0)
        self.slow_since[turned] = number
        for share in np.flatnonzero((self.slow_since >= 0) & (number - self.slow_since >= IN_A_ROW)):
            self.moved += 1
            if self.faults.slowness >= _LAGGING:
                self._give(int(share))
            self.slow_since[share] = -1
            self.next_slow[share] = self.now + self.rng.exponential(self.faults.slow_every)

    def _lose(self, began: float, number: int) -> None:
        """Workers that were lost during this step: it is repeated by others, and so are those since the last collection."""
        assert self.next_loss is not None
        gone = np.flatnonzero((self.next_loss > began) & (self.next_loss <= self.now))
        if not len(gone):
            return
        self.lost += len(gone)
        steps = 1 + (number % self.faults.collected_every if self.faults.repeats else 0)
        self.now += self.faults.notice + steps * self.job.view_seconds * float(self.views[gone].max())
        for share in gone:
            self._give(int(share))
            self.next_loss[share] = float(self.back[share]) + self.rng.exponential(self.faults.lost_every)

    def _give(self, share: int) -> None:
        """A share to the worker with the fewest."""
        loads = np.bincount(self.holder, minlength=len(self.holder))
        loads[share] += len(self.holder)
        self.holder[share] = int(np.argmin(loads))
        self.back[share] = self.now + self.faults.restart
