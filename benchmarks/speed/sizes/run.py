"""Milliseconds of an image, a pair, an adjoint and whole steps over film sizes, on `indirect-room`, and the memory that each size takes.

In turns: the image, the pair of the current and the previous state, the image with its adjoint, and a step with leave-one-out sample
groups, with the control variate, and of the stock loop (`mi.render`, `dr.backward`, `mi.ad.Adam`) at equal samples per pixel. Memory is
the peak of what Dr.Jit has allocated while these ran, of the device where there is one.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import unrender as ur
from benchmarks.internals import SampleRequest, allocated, dr, prepare
from benchmarks.runner.timing import percentiles, turns
from benchmarks.speed.run import stepper, stock_time

QUICK = {"size": (16,), "spp": 2, "repeats": 2}
MERGE = ("sizes",)


def costs(problem: ur.Problem, spp: int, repeats: int) -> dict[str, Any]:
    """Milliseconds: median, 10th and 90th percentile; and bytes."""
    session, now = prepare(problem, [p.key for p in problem.parameters], "path"), problem.initial()
    before = {key: x * 0.99 for key, x in now.items()}
    weights = problem.loss_derivative(0, session.image(now, SampleRequest(0, spp, 1, 2)).images)
    dr.eval(before, weights)
    peak = allocated()

    def pair(number: int) -> None:
        found = session.image_pair(now, before, SampleRequest(0, spp, number, 2), "path")
        dr.eval(found.images, found.previous)

    def adjoint(number: int) -> None:
        found = session.image(now, SampleRequest(0, spp, number, 2))
        dr.eval(found.images, session.adjoint(now, found.paths, weights))

    times = turns(
        {
            "image": lambda n: dr.eval(session.image(now, SampleRequest(0, spp, n, 2)).images),
            "pair": pair,
            "image and adjoint": adjoint,
            "step, leave-one-out": stepper(problem, ur.PathGradient(spp=spp)),
            "step, control variate": stepper(problem, ur.PathGradient(ur.images.RecursiveControlVariate(), spp=spp)),
        },
        repeats=repeats,
        warm=2,
    )
    found: dict[str, Any] = {name: percentiles(values) for name, values in times.items()}
    stock = stock_time(problem, spp, steps=repeats + 2)
    return {"ms": {**found, "step, stock loop": [stock, stock, stock]}, "bytes": peak()}


def run(size: tuple[int, ...] = (64, 128, 256), spp: int = 4, repeats: int = 7) -> Iterator[dict[str, Any]]:
    """A part per size.

    Args:
        size: of the film, pixels along a side
        spp: samples per pixel
        repeats: of each, in turns
    """
    for side in size:
        problem = ur.gallery.problem("indirect-room", resolution=side, reference_spp=16, loss="L2")
        entry = costs(problem, spp, repeats)
        print(side, entry, flush=True)
        yield {"sizes": {str(side): entry}}
