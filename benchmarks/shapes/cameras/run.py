"""Poses of cameras from their pictures of a known scene: how near `auto` comes, and how near path gradients with Adam do.

Every camera starts 2 degrees off, about a random axis, and 2 % of its distance from what it looks at, in a random direction. Asked for are
0.05 degrees and 0.1 %. Scenes: the gallery's `camera`; its `glossy-room`, whose materials are known here, seen by its three cameras; with
assets, two models with textures on a table under a photographed sky, seen by two cameras. References have 1024 samples per pixel.
Path gradients are what `auto` takes with `image=plain`. Time is the processor's, of all threads, without the first step.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import method, mi
from benchmarks.timed_runs import Kept, blind
from unrender.gallery import parts

DEGREES, PERCENT = 2.0, 2.0
ASKED = (0.05, 0.1)
ENTRANTS: dict[str, dict[str, Any]] = {"auto": {}, "path gradients, Adam": {"image": "plain"}}
MERGE = ("scenes.*",)
QUICK: dict[str, Any] = {
    "scenes": ("camera",), "seconds": 0.5, "seeds": 1, "path_seeds": 1, "resolution": 8, "reference_spp": 4,
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A scene and its cameras: {id: where it stands}, and what they look at."""

    problem: ur.Problem
    places: dict[str, tuple[float, float, float]]
    target: tuple[float, float, float]

    def distance(self, camera: str) -> float:
        """Of a camera from what it looks at."""
        return float(np.linalg.norm(np.subtract(self.places[camera], self.target)))

    def errors(self, values: dict[str, np.ndarray]) -> list[list[float]]:
        """Of each camera: degrees between the rotations, and the distance of the places in per cent of its own; the truth is 0."""
        return [
            [
                float(np.degrees(np.linalg.norm(values[f"{name}.rotation"]))),
                float(100 * np.linalg.norm(values[f"{name}.translation"]) / self.distance(name)),
            ]
            for name in self.places
        ]

    def start(self, seed: int) -> ur.Problem:
        """The problem from a start of its own."""
        rng, unknown = np.random.default_rng([23, seed]), []
        for name in self.places:
            shift, axis = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
            far = PERCENT / 100 * self.distance(name)
            unknown.append(ur.Parameter(f"{name}.translation", initial=far * shift))
            unknown.append(ur.Parameter(f"{name}.rotation", initial=np.radians(DEGREES) * axis))
        return self.problem.replaced(parameters=unknown)


def _gallery(name: str, resolution: int, reference_spp: int) -> Case:
    found = ur.gallery.problem(name, resolution=resolution, reference_spp=reference_spp)
    if name == "camera":
        places = {"left": (-1.95, 1.36, 1.95), "middle": (0.15, 1.89, 2.55), "right": (2.18, 1.06, 1.5)}
        return Case(found, places, (0.0, 0.35, 0.0))
    places = {f"camera_{number}": (x, 1.5, 4.0) for number, x in enumerate(np.linspace(-1.5, 1.5, 3))}
    return Case(found, places, (0.0, 0.85, 0.0))


def _models(assets: Path, resolution: int, reference_spp: int) -> Case:
    """A cow and a blob fish of Keenan Crane, on a table of wood, under the sky of a museum."""
    places = {"one": (-1.6, 1.3, 3.0), "two": (1.9, 0.9, 2.6)}
    to = mi.ScalarTransform4f

    def bitmap(file: str) -> dict[str, Any]:
        return {"type": "diffuse", "reflectance": {"type": "bitmap", "filename": str(assets / file)}}

    def scene() -> dict[str, Any]:
        return {
            "type": "scene",
            **{name: parts.camera(place, (0, 0, 0), 42.0, resolution) for name, place in places.items()},
            "sky": {"type": "envmap", "filename": str(assets / "textures/museum.exr")},
            "table": {
                "type": "rectangle",
                "to_world": to().translate([0, -0.74, 0]).rotate([1, 0, 0], -90).scale([2.5, 2.5, 1]),
                "bsdf": bitmap("textures/wood.jpg"),
            },
            "cow": {
                "type": "obj",
                "filename": str(assets / "spot/spot.obj"),
                "to_world": to().translate([-0.6, 0, 0.2]).rotate([0, 1, 0], 150),
                "bsdf": bitmap("spot/spot_texture.png"),
            },
            "fish": {
                "type": "obj",
                "filename": str(assets / "bob/bob_tri.obj"),
                "to_world": to().translate([0.75, -0.1, -0.5]).rotate([0, 1, 0], 60),
                "bsdf": bitmap("bob/bob_diffuse.png"),
            },
        }

    unknown = [ur.Parameter(f"{name}.{part}") for name in places for part in ("translation", "rotation")]
    empty = np.zeros((resolution, resolution, 3), np.float32)
    made = ur.Problem(
        scene, unknown, [ur.View(empty, index) for index in range(len(places))], max_depth=2, name="models"
    )
    zeros = {parameter.key: np.zeros(3, np.float32) for parameter in unknown}
    views = [ur.View(ur.render(made, zeros, index, spp=reference_spp, seed=77), index) for index in range(len(places))]
    return Case(made.replaced(views=views), places, (0.0, 0.0, 0.0))


def case(name: str, assets: Path | None, resolution: int, reference_spp: int) -> Case | None:
    """A scene by its name; None for the models without assets."""
    if name != "models":
        return _gallery(name, resolution, reference_spp)
    return None if assets is None else _models(assets, resolution, reference_spp)


def descend(made: Case, settings: dict[str, Any], seed: int, seconds: float) -> dict[str, Any]:
    """One run of `auto`: errors of every camera at the end, and the largest of them over seconds, angle and place."""
    problem, kept = made.start(seed), Kept(seconds)
    choice = method("auto").plan(problem, settings)
    ur.optimize(blind(problem), choice, steps=1 << 20, seed=seed, callbacks=[kept])
    errors = [np.array(made.errors(values)) for _, values in kept.found]
    curve = [[second, *map(float, error.max(axis=0))] for (second, _), error in zip(kept.found, errors, strict=True)]
    return {"final": errors[-1].tolist(), "curve": [list(x) for x in zip(*curve, strict=True)]}


def run(
    scenes: tuple[str, ...] = ("camera", "glossy-room", "models"),
    assets: Path | None = None,
    seconds: float = 20.0,
    seeds: int = 5,
    path_seeds: int = 2,
    resolution: int = 48,
    reference_spp: int = 1024,
) -> Iterator[dict[str, Any]]:
    """A part per scene.

    Args:
        scenes: of camera, glossy-room and models
        assets: folder of models and textures, for models
        seconds: of a run, of the processor
        seeds: starts of auto
        path_seeds: starts of path gradients
        resolution: film size
        reference_spp: of the references
    """
    for name in scenes:
        if (made := case(name, assets, resolution, reference_spp)) is None:
            print(f"{name}: left out, without assets", flush=True)
            continue
        found: dict[str, Any] = {}
        for entrant, settings in ENTRANTS.items():
            count = path_seeds if settings else seeds
            found[entrant] = [descend(made, settings, seed, seconds) for seed in range(count)]
            print(name, entrant, *(np.round(one["final"], 3).tolist() for one in found[entrant]), flush=True)
        yield {"scenes": {name: found}}
