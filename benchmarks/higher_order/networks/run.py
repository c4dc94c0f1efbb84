"""Smoothed derivatives behind a network (HO Table 2, CNN and CNN5): learning poses from images without labels.

A network answers with the pose of a mug in an image; its answer is rendered and compared with the image, and the
derivative of that comparison is sampled. Needs PyTorch. CNN answers with the angle; CNN5, one network as well, with
five numbers: the paper says rotation, position and colour, which is read as the angle, the place across the image,
and the cup's red, green and blue. The network is given its images less their mean, over their standard deviation.
Methods: OurG, the aggregate gradient of the black box through the network with Adam; OurHVPA, Newton-CG on products
with the Hessian of the whole, network and black box; OurJoint, the same with gradient and products from the same
renders. Newton-CG is in Adam's metric: of weights over the fourth root of 1 / v, v the mean square of the gradient.
Rates, radii and σ fall over a run. FR22 is OurG with the product of gradient kernels; for one output they are the
same. CMA-ES on 268 000 weights has no chance and is left out, as is a Hessian. Error: root mean square over the
images of the answers, relative to the first, each number over its range. The loss is a product of two renders, which has
no bias by their noise. Seconds are the processor's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks import figures, markdown
from benchmarks.races import first_at
from benchmarks.runner.records import Record

MERGE = ("tasks.*.methods",)
QUICK = {"task": ("CNN",), "runs": 1, "seconds": 0.3, "images": 2, "size": 8, "steps": 200}
METHODS = ("OurG", "OurHVPA", "OurJoint")
PUBLISHED = "FR22, published"


def run(
    task: tuple[str, ...] = ("CNN", "CNN5"),
    runs: int = 3,
    seconds: float = 120.0,
    images: int = 16,
    size: int = 32,
    only: tuple[str, ...] = (*METHODS, PUBLISHED),
    steps: int = 3000,
    rate: float | None = None,
) -> Iterator[dict[str, Any]]:
    """A part per task.

    Args:
        seconds: processor time of a run
        images: that the network learns from
        size: of the rendered answers, pixels along a side
        steps: of runs with the published settings of CNN, whose code has 10 000; their time is not limited
        rate: of longer runs, which are not tuned; they have an entry of their own
    """
    from benchmarks.higher_order.networks import training  # PyTorch is optional, and tables do not need it

    training.torch.set_num_threads(1)
    for name in task:
        data = training.Data(name, images, size, 5)
        weights = training.parameter_count(training.PoseNetwork(len(data.ranges)))
        methods: dict[str, Any] = {}
        for method in (method for method in only if method in METHODS):
            rates = () if rate else training.GRID[method]
            tried = {r: training.train(data, method, r, seconds / 4, 1000)["final"] for r in rates}
            best = rate or min(tried, key=lambda one, tried=tried: tried[one])
            found = [training.train(data, method, best, seconds, seed) for seed in range(runs)]
            methods[method] = {"rate": best, "tried": tried, "runs": found}
            print(name, method, best, [round(one["final"], 3) for one in found], flush=True)
        if PUBLISHED in only and name == "CNN":
            found = [training.train_published(data, seed, steps) for seed in range(runs)]
            methods[PUBLISHED] = {"rate": 1e-4, "tried": {}, "runs": found}
        entry = {"weights": weights, "seconds": seconds, "methods": methods}
        yield {"tasks": {f"{name}, {seconds:g} s" if rate else name: entry}}


def table(record: Record) -> str:
    """Errors of the networks' answers, and when they had fallen by 90 and 99 %."""
    rows = []
    for entry in markdown.named(record["tasks"], "task", "methods", "method"):
        runs = entry["runs"]
        finals, steps, reached = ([run[key] for run in runs] for key in ("final", "steps", "reached"))
        papers = np.median([[first_at(run["curve"], goal) for goal in _PAPERS_GOALS] for run in runs], axis=0)
        images = [run["image"] for run in runs if "image" in run]
        row = "{task}, {weights} weights | {method} | {count} of {seconds:g} s | {rate:g}"
        rows.append(
            [
                markdown.fill(row, entry, {"count": len(runs)}),
                markdown.spread(finals),
                *(f"{t:.3g}" if math.isfinite(t) else "—" for t in np.median(reached, axis=0)),
                " / ".join(f"{t:.3g}" if math.isfinite(t) else "—" for t in papers),
                ", ".join(f"{1 - image:.2%}" for image in images) or "—",
                f"{np.median(steps):.0f}",
            ]
        )
    head = "task | method | runs | rate or radius | final error: median (range) | s to 90 % | 99 % | s to the paper's goals | image | steps"
    text = "The paper's goals are squared errors of .1, .01 and .001, of single steps. Image: reduction of the squared error at the end."
    return markdown.blocks(text, markdown.table(head, rows))


_PAPERS_GOALS = tuple(math.sqrt(goal) for goal in (0.1, 0.01, 0.001))


def plot(record: Record) -> figures.Figure:
    panels = {name: figures.run_curves(task["methods"]) for name, task in record["tasks"].items()}
    return figures.curves(panels, "seconds", "error of the poses / at the start")
