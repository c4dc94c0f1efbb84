"""What shares a gradient among neighbouring texels, compared by equal steps and samples.

`auto` as it is, with Sobolev gradients whose strength it fits, against `auto` without smoothing, with a Laplacian pyramid in place of
Sobolev, and with gradients filtered by their noise (`FilteredGradient`, two halves of the samples), with Sobolev and alone. All else is as
`auto` chooses. The problems are those of `suite` whose unknown is a texture, and a checkerboard of one-texel squares, where there is
nothing to share. Errors are of the elements that the views see, as in `suite`, after tenths of the steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import unrender as ur
from benchmarks.internals import dr, method
from benchmarks.suite import scenes
from benchmarks.suite.choices.run import checkerboard
from benchmarks.suite.run import error_of

GALLERY = ("wall", "indirect-room", "checkerboard, L1", "checkerboard, L2")
FOREIGN = ("tray, L1", "tray, L2", "cbox, L1", "cbox, L2", "spot, L1", "spot, L2", "painting, L1")
SMOOTHING = ("sobolev", "none", "pyramid", "filter", "filter and sobolev")
MERGE = ("problems.*",)
QUICK = {
    "problem": ("checkerboard, L2",),
    "smoothing": ("none", "filter and sobolev"),
    "steps": 10,
    "gallery_reference_spp": 16,
}


class Tenths(ur.Callback):
    """The error after each tenth of the steps."""

    def __init__(self, error: Any, steps: int):
        self.errors: list[float] = []
        self._error, self._steps = error, steps

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        """The error, where a tenth is full."""
        if run.step * 10 >= self._steps * (len(self.errors) + 1):
            self.errors.append(self._error(run.parameters))


def parts(problem: ur.Problem, smoothing: str) -> tuple[Any, Any]:
    """Estimator and optimizer of `auto`, but for the smoothing."""
    chosen = method("auto").choose(problem, {"smooth": "sobolev" in smoothing or smoothing == "pyramid"})
    estimator, optimizer = chosen.estimator, chosen.optimizer
    if not (isinstance(estimator, ur.PathGradient) and isinstance(optimizer, ur.optimizers.ScheduleFree)):
        raise ur.InputError(f"{problem.name}: auto chooses no path gradients")
    if smoothing == "pyramid":
        optimizer = replace(optimizer, preconditioner=ur.preconditioners.LaplacianPyramid())
    if "filter" in smoothing:
        estimator = ur.FilteredGradient(replace(estimator, spp=max(1, estimator.spp // 2)))
    return estimator, optimizer


def run(
    problem: tuple[str, ...] = GALLERY,
    foreign: tuple[str, ...] = FOREIGN,
    assets: Path | None = None,
    smoothing: tuple[str, ...] = SMOOTHING,
    steps: int = 160,
    seeds: int = 1,
    resolution: int = 64,
    texture: int = 64,
    reference_spp: int = 4096,
    gallery_reference_spp: int | None = None,
) -> Iterator[dict[str, Any]]:
    """Every problem, every smoothing.

    Args:
        problem: of the gallery, and the checkerboards
        foreign: of others, where assets are given
        assets: folder of the scenes of others
        smoothing: what is compared
        steps: of a run
        seeds: runs of each
        resolution: of pictures of the scenes of others
        texture: side of their textures
        reference_spp: of their references
        gallery_reference_spp: of the gallery's references, none for its own
    """
    options = {} if gallery_reference_spp is None else {"reference_spp": gallery_reference_spp}
    found: dict[str, Any] = {"problems": {}}
    for name in (*(foreign if assets is not None else ()), *problem):
        if name in FOREIGN and assets is not None:
            opened = scenes.problem(name, assets, resolution, texture, reference_spp)
        elif name.startswith("checkerboard"):
            opened = checkerboard(**options).replaced(loss=scenes.LOSSES[name.split(", ")[1]], name=name)
        else:
            opened = ur.gallery.problem(name, **options)
        error = error_of(opened)
        curves: dict[str, list[list[float]]] = {}
        for kind in smoothing:
            curves[kind] = []
            for seed in range(seeds):
                tenths = Tenths(error, steps)
                ur.optimize(opened, *parts(opened, kind), steps=steps, seed=seed, callbacks=[tenths])
                curves[kind].append(tenths.errors)
            print(f"{name}, {kind}: {', '.join(f'{curve[-1]:.4f}' for curve in curves[kind])}", flush=True)
        found["problems"][name] = curves
        del opened, error
        dr.sync_thread()
        yield found
