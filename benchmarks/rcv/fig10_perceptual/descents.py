"""Descents on the perceptual loss: the textured back wall of a Cornell box, from grey."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import arrays, build_problem, parts, textures
from benchmarks.races import Entrant, race
from unrender.losses import Loss
from unrender.schedules import Cosine

WALL = "back.bsdf.reflectance.data"
ADJOINT_SPP = 4
RATES = (0.03, 0.06, 0.12)
FLOOR = 0.02
"""Of the falling rate, at the end."""
POINTS = 30
"""Of a run that are kept."""


@dataclass(frozen=True)
class CornellBox:
    """The specification of the problem: a room with a photograph on its back wall and a square lamp at its ceiling."""

    resolution: int
    reference_spp: int
    loss: Loss
    max_depth: int = 6

    def scene(self) -> dict[str, Any]:
        """A new one at each call."""
        picture = textures.bitmap(textures.photograph("astronaut", self.resolution))
        walls = parts.room(parts.diffuse(0.75), parts.diffuse(0.6, 0.08, 0.06), parts.diffuse(0.12, 0.42, 0.1))
        lamp = parts.rectangle((0, 0.995, 0), (0.35, 0, 0), (0, 0, 0.35), parts.diffuse(0.0))
        painted = {"type": "diffuse", "reflectance": picture}
        return {
            "type": "scene",
            "camera": parts.camera((0, 0, 2.1), (0, 0, -1), 40.0, self.resolution),
            **walls,
            "back": parts.rectangle((0, 0, -1), (1, 0, 0), (0, 1, 0), painted),
            "lamp": lamp | {"emitter": parts.light(9.0, 8.0, 6.5)},
        }

    def parameters(self) -> tuple[ur.Parameter, ...]:
        """The wall's texture, as in `indirect-room`."""
        return (ur.Parameter(WALL, initial=0.5, preconditioner=ur.preconditioners.LargeSteps(2.0)),)


def entrants(steps: int) -> list[Entrant]:
    """Adjoint paths are as many for all."""
    adam = functools.partial(ur.optimizers.Adam, schedule=Cosine(steps, FLOOR))
    estimators = {
        "plain, 4": ur.PathGradient(spp=4, adjoint_spp=ADJOINT_SPP),
        "plain, 32": ur.PathGradient(spp=32, adjoint_spp=ADJOINT_SPP),
        "rcv, 4": ur.PathGradient(ur.images.RecursiveControlVariate(), spp=4, adjoint_spp=ADJOINT_SPP),
    }
    return [Entrant(name, name.split(",")[0], made, adam, RATES) for name, made in estimators.items()]


def descents(loss: Loss, resolution: int, reference_spp: int, steps: int, seeds: int) -> tuple[dict[str, Any], Any]:
    """Every method, tuned, at equal steps.

    Returns:
        {method: see `race`}, and {"wall/reference", "wall/plain, 4", ...: (N, N, 3)}, textures at the end of the first seed's runs.
    """
    problem = build_problem("cornell-box", CornellBox(resolution, reference_spp, loss))
    racing = entrants(steps)
    found = race(problem, racing, seeds, steps=steps)
    assert problem.truth is not None
    walls = {"wall/reference": problem.truth[WALL]}
    for entrant in racing:
        made = entrant.optimizer(found[entrant.name]["rate"])
        result = ur.optimize(problem, entrant.estimator, made, steps=steps, seed=0)
        walls[f"wall/{entrant.name}"] = result.parameters[WALL]
    for entry in found.values():
        entry["runs"] = [[*run[: -1 : max(1, len(run) // POINTS)], run[-1]] for run in entry["runs"]]
    return found, {name: np.asarray(arrays.numpy(wall)) for name, wall in walls.items()}
