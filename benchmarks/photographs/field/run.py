"""Radiance fields of photographs: held-out ones over processor time, as `unrender import --field` sets it up and by the plain estimator.

All descents are of the same grid, with spherical harmonics of degree 2, in the same cube. "default" runs the stages that the import
writes, by their shares of the time; "plain" has 4096 pixels of all photographs a step at 2 samples each, and Adam at the same first rates,
which stay, in the full grid from the start. PSNR is as displayed, the mean of the held-out photographs; that of every eleventh
training photograph beside it. The time is the processor's, of all threads, without compiling. Mitsuba's own integrators cannot take
part: its media do not emit, so `prbvolpath` has no such field, not of degree 0 either, and `volprim_rf_basic` renders ellipsoids, no grids.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Whole, method_parts, stages_file
from benchmarks.runner.records import scratch
from unrender.app.capture import importing
from unrender.app.capture.writing import PROBLEM
from unrender.app.evaluation.held_out import HELD_OUT
from unrender.app.evaluation.measures import measure

ENTRANTS = ("default", "plain")
MERGE = ("captures.*.methods",)
QUICK = {"minutes": 0.01, "voxels": 8, "resolution": 16, "final_spp": 2, "points": 1}
_TRAINING = 11


class Judge:
    """How near a field comes to photographs of a problem file, every so many of them."""

    def __init__(self, file: Path, every: int, spp: int):
        given = ur.Problem.from_file(file)
        self.keys = [parameter.key for parameter in given.parameters]
        unknowns = [ur.Parameter(key) for key in self.keys]
        self.problem = ur.Problem(given.origin["scene"], unknowns, given.given_views[::every], max_depth=1)
        self.spp = spp

    def __call__(self, values: dict[str, np.ndarray]) -> float:
        """PSNR."""
        known, found = {key: values[key] for key in self.keys}, []
        for index, view in enumerate(self.problem.views):
            image, photograph = np.asarray(ur.render(self.problem, known, view=index, spp=self.spp)), view.reference
            mask = np.ones(image.shape[:2], np.float32) if view.mask is None else np.asarray(view.mask)
            found.append(measure(image, np.asarray(photograph), mask).psnr)
        return float(np.mean(found))


class Clock(ur.protocols.Callback):
    """Ends a stage after so many seconds of the processor; now and then, it looks at what there is."""

    def __init__(self, earlier: float, seconds: float, marks: list[float], judges: tuple[Judge, ...], curve: list):
        self.earlier, self.seconds, self.marks, self.judges, self.curve = earlier, seconds, marks, judges, curve
        self.spent, self.steps = 0.0, 0

    def on_start(self, run: Any) -> None:
        """See `ur.protocols.Callback`."""
        self._since = time.process_time()

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        """See `ur.protocols.Callback`."""
        del record
        self.spent += time.process_time() - self._since
        self.steps += 1
        if self.marks and self.earlier + self.spent >= self.marks[0]:
            while self.marks and self.earlier + self.spent >= self.marks[0]:
                self.marks.pop(0)
            values = run.full()
            self.curve.append([(self.earlier + self.spent) / 60, *(judge(values) for judge in self.judges)])
            print(self.curve[-1], flush=True)
        if self.spent >= self.seconds:
            run.stop()
        self._since = time.process_time()


def prepare(photographs: Path | None, resolution: int, voxels: int) -> tuple[str, Path]:
    """Import the photographs, or those that the project renders; the capture's name, and the folder of the problem."""
    place = scratch("photographs/field")
    if photographs is None:
        photographs = place / "vase"
        shutil.rmtree(photographs, ignore_errors=True)
        ur.gallery.photographs(photographs, views=32, size=resolution, spp=64)
    folder = place / f"{photographs.name}-problem"
    shutil.rmtree(folder, ignore_errors=True)
    importing.import_capture(photographs, folder, importing.ImportOptions(resolution=resolution, field=voxels))
    return photographs.name, folder


def descend(name: str, folder: Path, seconds: float, judges: tuple[Judge, ...], points: int) -> dict[str, Any]:
    """One entrant: its curve of [minutes, held-out PSNR, training PSNR], and its steps."""
    stages = stages_file.read(folder / stages_file.FILE)
    whole = Whole.read(stages)
    if name == "plain":
        stages = replace(stages, stages=(stages_file.Stage("plain", stages.stages[-1].unknowns),))
    shares = [share or 0.0 for _, share in stages_file.split(replace(stages, steps=None, seconds=seconds))]
    marks = [seconds * (number + 1) / points for number in range(points)]
    values: dict[str, np.ndarray] = {}
    curve: list[list[float]] = []
    steps: dict[str, int] = {}
    spent = 0.0
    for index, (stage, share) in enumerate(zip(stages.stages, shares, strict=True)):
        problem = whole.of_stage(stage, values, folder / "scenes" / stage.name)
        parts: tuple[Any, Any] = ur.PathGradient(pixels=ur.pixels.Uniform(4096), spp=2), ur.optimizers.Adam()
        if name != "plain":
            parts = method_parts(stage.method or stages.method, stages.settings_of(stage))
        clock = Clock(spent, share, marks, judges, curve)
        result = ur.optimize(problem, *parts, steps=1_000_000, seed=index, callbacks=[clock])
        values |= {key: np.asarray(value) for key, value in result.parameters.items()}
        spent, steps[stage.name] = spent + clock.spent, clock.steps
    curve.append([spent / 60, *(judge(values) for judge in judges)])
    print(name, steps, curve[-1], flush=True)
    return {"curve": curve, "steps": steps}


def run(
    photographs: Path | None = None,
    minutes: float = 8.0,
    voxels: int = 64,
    resolution: int = 96,
    entrant: tuple[str, ...] = ENTRANTS,
    final_spp: int = 32,
    points: int = 6,
) -> Iterator[dict[str, Any]]:
    """A part per entrant.

    Args:
        photographs: folder of a capture; left out, photographs of a vase that the project renders
        minutes: of the processor, for each descent
        voxels: along a side
        resolution: pixels along the longer side of a photograph
        entrant: who takes part; the others' figures stay
        final_spp: of the pictures that are measured
        points: of the curve
    """
    name, folder = prepare(photographs, resolution, voxels)
    held_out, training = ((folder / file, every) for file, every in ((HELD_OUT, 1), (PROBLEM, _TRAINING)))
    judges = tuple(Judge(file, every, final_spp) for file, every in (held_out, training))
    conditions = {
        "minutes": minutes,
        "voxels": voxels,
        "resolution": resolution,
        "held_out": len(judges[0].problem.views),
    }
    for one in entrant:
        found = descend(one, folder, minutes * 60, judges, points)
        yield {"captures": {f"{name}, {voxels}": {**conditions, "methods": {one: found}}}}
