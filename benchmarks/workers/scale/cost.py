"""The time of a step of a dealt run, as a sum of terms, and its fit to measured steps. NumPy alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.special import ndtr

__all__ = ["TERMS", "Costs", "Job", "Network", "compute", "fit", "slowest", "terms", "wire_bytes"]

TERMS = ("driver", "parameter", "worker", "gradient", "byte", "trip", "transfer")
"""Names of what is fitted, see `Costs`."""


@dataclass(frozen=True)
class Job:
    """What is computed.

    Attributes:
        parameters: numbers.
        views: how many.
        view_seconds: that a worker needs for one.
        spread: standard deviation of a worker's time in a step over its mean.
        sent, received: bytes of a parameter, and of its gradient: 4 and 8, or 2 and 4 with compression.
        gradients: in a reply: 1; 2 for methods that have the previous state's, too.
    """

    parameters: int
    views: int
    view_seconds: float
    spread: float = 0.0
    sent: float = 4.0
    received: float = 8.0
    gradients: int = 1


@dataclass(frozen=True)
class Network:
    """Who computes it.

    Attributes:
        workers: how many; no more than there are views have any.
        nodes: machines beside the driver's.
        remote: workers that are not on the driver's machine.
        rate: bytes a second into the driver's machine, and as many out of it; infinite for one machine.
        trip: seconds there and back.
    """

    workers: int
    nodes: int = 0
    remote: int = 0
    rate: float = float("inf")
    trip: float = 0.0


@dataclass(frozen=True)
class Costs:
    """What is fitted.

    Attributes:
        driver: seconds of a step, whatever is computed.
        parameter: seconds for each parameter: optimizer, bounds, copies to the host.
        worker: seconds for each worker: a call, its reply.
        gradient: seconds for each number of each worker's reply: from the object store, into a sum in double precision.
        byte: seconds for each byte that goes from machine to machine, whatever the link's rate.
        trip: times there and back of the link.
        transfer: time of bytes on the link over what their number and the link's rate say: 1 for a link that is always full.
    """

    driver: float
    parameter: float
    worker: float
    gradient: float
    byte: float
    trip: float
    transfer: float

    def step(self, job: Job, network: Network) -> float:
        """Seconds of a step: what workers compute, and the terms."""
        return compute(job, network) + sum(self.parts(job, network).values())

    def parts(self, job: Job, network: Network) -> dict[str, float]:
        """Seconds of each term."""
        costs = asdict(self)
        return {name: costs[name] * value for name, value in terms(job, network).items()}


def terms(job: Job, network: Network) -> dict[str, float]:
    """What multiplies each of the costs."""
    numbers = job.parameters * job.gradients * network.workers
    return {
        "driver": 1.0,
        "parameter": float(job.parameters),
        "worker": float(network.workers),
        "gradient": float(numbers),
        "byte": sum(wire_bytes(job, network)),
        "trip": network.trip if network.remote else 0.0,
        "transfer": sum(wire_bytes(job, network)) / network.rate,
    }


def wire_bytes(job: Job, network: Network) -> tuple[float, float]:
    """Out of the driver's machine, once for each other machine; and into it, for each worker on these."""
    out = job.sent * job.parameters * network.nodes
    return out, job.received * job.parameters * job.gradients * network.remote


def compute(job: Job, network: Network) -> float:
    """Seconds until the slowest worker has rendered its views: the one with the most, and the largest of their spreads."""
    each = -(-job.views // network.workers) * job.view_seconds
    return each * slowest(min(network.workers, job.views), job.spread)


def slowest(workers: int, spread: float) -> float:
    """The mean of the largest of so many lognormal numbers of mean 1 and this standard deviation."""
    if workers < 2 or spread == 0:
        return 1.0
    sigma = np.sqrt(np.log1p(spread**2))
    # E[max] is the integral of 1 - F(x)^n, by the substitution x = exp(sigma z - sigma^2 / 2).
    z = np.linspace(-12.0, 12.0, 24001)
    x = np.exp(sigma * z - sigma**2 / 2)
    return float(x[0] + np.trapezoid(1 - ndtr(z) ** workers, x))


def fit(cases: Sequence[tuple[Job, Network]], seconds: Sequence[float]) -> Costs:
    """Costs, none negative, that make the sum of squared relative errors of the steps' times least.

    Args:
        cases: that were measured.
        seconds: of a step of each.
    """
    measured = np.asarray(seconds, np.float64)
    rows = np.array([list(terms(job, network).values()) for job, network in cases])
    known = np.array([compute(job, network) for job, network in cases])
    scale = np.maximum(np.abs(rows).max(axis=0), 1e-300)  # so that all columns are of one size
    found, _ = nnls(rows / scale / measured[:, None], (measured - known) / measured)
    return Costs(*(float(x) for x in found / scale))
