"""Descents on the perceptual loss: the textured back wall of a Cornell box, from grey."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import IndirectRoom, arrays, build_problem, parts
from benchmarks.races import Entrant, race
from unrender.losses import Loss
from unrender.schedules import Cosine

WALL = "back.bsdf.reflectance.data"
ADJOINT_SPP = 4
RATES = (0.03, 0.06, 0.12)
FLOOR = 0.02
"""Of the falling rate, at the end."""


@dataclass(frozen=True)
class CornellBox(IndirectRoom):
    """The specification of the problem: `indirect-room` with a square lamp at its ceiling in place of the one that lights that alone."""

    def scene(self) -> dict[str, Any]:
        """A new one at each call."""
        room = {name: piece for name, piece in super().scene().items() if not name.startswith("lamp")}
        lamp = parts.rectangle((0, 0.995, 0), (0.35, 0, 0), (0, 0, 0.35), parts.diffuse(0.0))
        return room | {"lamp": lamp | {"emitter": parts.light(9.0, 8.0, 6.5)}}


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
    made = CornellBox(resolution, resolution, reference_spp, loss=loss)
    problem = build_problem("cornell-box", made)
    assert problem.truth is not None
    walls: dict[str, Any] = {"wall/reference": problem.truth[WALL]}

    def ended(name: str, seed: int, result: ur.Result) -> None:
        if seed == 0:
            walls[f"wall/{name}"] = result.parameters[WALL]

    found = race(problem, entrants(steps), seeds, ended=ended, points=30, steps=steps)
    return found, {name: np.asarray(arrays.numpy(wall)) for name, wall in walls.items()}
