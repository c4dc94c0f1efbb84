"""The volumes of the race: the gallery's smoke, the same with a lamp inside, and one that somebody else made. Errors of their grids are as
far as an image determines them: the albedo of empty voxels shows in none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from skimage.transform import resize

import unrender as ur
from benchmarks.internals import Smoke, Tree, arrays, build_problem, mi, parts, volumes
from benchmarks.paths import truth as true_parameters

FILE = "tutorials/volume.vol"
"""Of Mitsuba's tutorials, below the folder of assets."""
DENSEST = 6.0


@dataclass(frozen=True)
class Volume(Smoke):
    """The specification of `smoke` with another scene, which `change` makes from the smoke's and the size of its grids."""

    change: Callable[[dict[str, Any], int], dict[str, Any]] = lambda scene, grid: scene

    def scene(self) -> dict[str, Any]:
        """A new one at each call."""
        return self.change(super().scene(), self.grid_resolution)


def lit_inside(scene: dict[str, Any], grid: int) -> dict[str, Any]:
    """A ball of light in the middle of the plume, under a dim sky."""
    del grid
    ball = {"type": "sphere", "center": [0.0, -0.3, 0.0], "radius": 0.12, "bsdf": parts.diffuse(0.0)}
    return scene | {
        "sky": {"type": "constant", "radiance": parts.colour(0.05, 0.06, 0.08)},
        "lamp": ball | {"emitter": parts.light(30.0, 25.0, 18.0)},
    }


def from_file(file: Path) -> Callable[[dict[str, Any], int], dict[str, Any]]:
    """Its density in the place of the smoke's, under the same sky; one albedo everywhere, warm."""

    def change(scene: dict[str, Any], grid: int) -> dict[str, Any]:
        found = np.array(mi.VolumeGrid(str(file)), np.float32)
        density = np.asarray(resize(found.reshape(*found.shape[:3], -1)[..., 0], (grid,) * 3, anti_aliasing=True))
        colour = np.broadcast_to(np.array([0.9, 0.78, 0.6]), (grid, grid, grid, 3))
        medium = {
            "type": "heterogeneous",
            "sigma_t": volumes.grid((density * (DENSEST / density.max()))[..., None]),
            "albedo": volumes.grid(colour),
            "phase": {"type": "isotropic"},
        }
        return scene | {"smoke": volumes.cube(medium)}

    return change


def problem(name: str, resolution: int, grid: int, reference_spp: int, assets: Path) -> ur.Problem | None:
    """The problem of "smoke", "lit inside" or "tutorial"; None where the file of the last is not below `assets`."""
    sizes: dict[str, Any] = {"resolution": resolution, "grid_resolution": grid, "reference_spp": reference_spp}
    if name == "smoke":
        return ur.gallery.problem("smoke", **sizes)
    if name == "lit inside":
        return build_problem(name, Volume(**sizes, change=lit_inside))
    file = assets / FILE
    return build_problem(name, Volume(**sizes, change=from_file(file))) if file.is_file() else None


def smoothed(made: ur.Problem) -> ur.Problem:
    """The same problem, its grids preconditioned by `Sobolev`."""
    sobolev = ur.preconditioners.Sobolev()
    return made.replaced(parameters=[replace(parameter, preconditioner=sobolev) for parameter in made.parameters])


EXTINCTION, ALBEDO = (f"smoke.interior_medium.{name}.data" for name in ("sigma_t", "albedo"))


def measure(problem: ur.Problem) -> Callable[[Tree], dict[str, float]]:
    """ "both", and for the record extinction, scattering, and albedo over all voxels."""

    def fields(parameters: Any) -> dict[str, np.ndarray]:
        extinction, albedo = (np.asarray(arrays.numpy(parameters[key]), np.float64) for key in (EXTINCTION, ALBEDO))
        return {"extinction": extinction, "scattering": extinction * albedo, "albedo": albedo}

    truth = fields(true_parameters(problem))

    def errors(parameters: Tree) -> dict[str, float]:
        return {name: float(np.sqrt(np.mean((x - truth[name]) ** 2))) for name, x in fields(parameters).items()}

    start = errors(problem.initial())

    def relative(parameters: Tree) -> dict[str, float]:
        found = {name: error / start[name] for name, error in errors(parameters).items()}
        return {"both": (found["extinction"] + found["scattering"]) / 2, **found}

    return relative
