"""What the loss sees where a mesh moves: plain images, control variates, and no damping, at equal processor time.

Problems of the gallery, and spheres that are to become meshes of others under a photographed sky, with L1 and L2. Errors over the start's,
of the surface, where it is known, and of pictures. `plain` (`image=plain`) renders anew at each step half of the views, all where there are
few, and damps the derivative of L1 where noise exceeds the residual; without damping it is `tolerance=0`. With `rcv` (`image=rcv`), damped,
too, a memory of all views is set up every twenty steps, and learns from the views between.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import method
from benchmarks.timed_runs import Kept, blind, measured
from unrender.gallery import mesh_files, meshes, parts
from unrender.gallery.specification import reference
from unrender.rendering.mitsuba.scene_loading import load

QUICK: dict[str, Any] = {
    "problems": ["sphere-to-bunny"], "losses": ["L1"], "seconds": 0.5, "seeds": 1, "resolution": 8, "subdivisions": 1, "views": 4,
}  # fmt: skip
FOREIGN = {
    "suzanne": ("tutorials/meshes/suzanne.ply", parts.diffuse(0.75, 0.6, 0.45)),
    "spot": ("spot/spot.obj", {"type": "roughconductor", "material": "Al", "alpha": 0.2}),
}
"""Meshes among the assets, and their materials."""
_SKY = "tutorials/textures/envmap.exr"
CHOICES: dict[str, dict[str, Any]] = {
    "plain": {"image": "plain"},
    "plain, undamped": {"image": "plain", "tolerance": 0},
    "rcv": {"image": "rcv"},
}
"""Options of `auto`."""


def foreign(
    name: str, assets: Path, loss: ur.losses.Loss, resolution: int, subdivisions: int, views: int
) -> ur.Problem:
    """A sphere that is to become the mesh of that name."""
    path, material = FOREIGN[name]
    angles = 2 * np.pi * (np.arange(views) + 0.25) / views
    heights = np.where(np.arange(views) % 2 == 0, 0.4, 2.0)
    points, faces = meshes.icosphere(subdivisions)

    def stage(of: dict[str, Any]) -> dict[str, Any]:
        places = [(3.6 * np.sin(a), h, 3.6 * np.cos(a)) for a, h in zip(angles, heights, strict=True)]
        cameras = {f"camera_{n}": parts.camera(place, (0, 0, 0), 42.0, resolution) for n, place in enumerate(places)}
        return {"type": "scene", **cameras, "sky": {"type": "envmap", "filename": str(assets / _SKY)}, **of}

    true = load(lambda: stage({"body": mesh_files.centred(str(assets / path), parts.twosided(material))}))
    seen = [ur.View(reference(true, view, 256, 2), view) for view in range(views)]
    body = next(shape for shape in true.shapes() if shape.is_mesh())
    return ur.Problem(
        lambda: stage({"sphere": meshes.triangles("sphere", 0.7 * points, faces, parts.twosided(material))}),
        (ur.Parameter("sphere.vertex_positions"),),
        seen,
        loss,
        2,
        name=name,
        surfaces={"sphere.vertex_positions": meshes.surface(body)},
    )


def descend(problem: ur.Problem, options: dict[str, Any], seconds: float, seed: int) -> dict[str, float]:
    """What a run reached, over the start, and its steps."""
    choice = method("auto").choose(problem, options)
    ur.optimize(blind(problem), choice.estimator, choice.optimizer, steps=3, seed=seed + 100)  # compiles what there is
    choice, kept = method("auto").choose(problem, options), Kept(seconds)
    result = ur.optimize(
        blind(problem), choice.estimator, choice.optimizer, seconds=100 * seconds, seed=seed, callbacks=[kept]
    )
    found = measured(problem, kept.found[-1:])
    ends = {what: found[what] for what in ("surface", "pictures") if what in found}
    return {**ends, "steps": float(len(result.history))}


def run(
    problems: tuple[str, ...] = ("sphere-to-bunny", "statue", "shadow-art", *FOREIGN),
    losses: tuple[str, ...] = ("L1", "L2"),
    choices: tuple[str, ...] = tuple(CHOICES),
    seconds: float = 8.0,
    seeds: int = 2,
    resolution: int = 48,
    subdivisions: int = 3,
    views: int = 6,
    assets: Path | None = None,
) -> Iterator[dict[str, Any]]:
    """Every problem, loss and choice.

    Args:
        problems: of the gallery, or of others where assets are given
        losses: L1, L2
        choices: of what the loss sees
        seconds: of a run, of the processor
        views: how many, of problems that let it be chosen
        subdivisions: of the spheres
        assets: folder of the meshes of others
    """
    found: dict[str, Any] = {}
    for name in problems:
        if name in FOREIGN and assets is None:
            print(f"{name}: left out, without assets", flush=True)
            continue
        for of in losses:
            loss = {"L1": ur.losses.L1(), "L2": ur.losses.L2()}[of]
            if name in FOREIGN:
                assert assets is not None
                problem = foreign(name, assets, loss, resolution, subdivisions, views)
            else:
                more = {} if name == "shadow-art" else {"views": views}
                problem = ur.gallery.problem(name, resolution=resolution, subdivisions=subdivisions, loss=loss, **more)
            of_loss = found.setdefault(name, {}).setdefault(of, {})
            for choice in choices:
                if "tolerance" in CHOICES[choice] and loss.linear:
                    continue
                runs = [descend(problem, CHOICES[choice], seconds, seed) for seed in range(seeds)]
                of_loss[choice] = {key: [one[key] for one in runs] for key in runs[0]}
                print(name, of, choice, of_loss[choice], flush=True)
            yield {"problems": found}
