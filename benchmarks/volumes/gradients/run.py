# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Gradients of voxels that are empty, thin, middling and at the majorant, half of them black: ours and `prbvolpath`'s, in standard errors
from finite differences.

    python benchmarks/volumes/gradients/run.py [--runs 48]

Finite differences are of pairs of states on one set of paths, to both sides, or to second order upwards where the value is zero.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import write

import unrender as ur
from unrender.gallery import parts, volumes
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

HERE = Path(__file__).resolve().parent
SIZE, SPP, VOXELS, DEPTH = 16, 64, 6, 5
LEVELS = {"empty": 0.0, "thin": 0.02, "middling": 1.0, "at the majorant": 4.0}
_rng = np.random.default_rng(0)
KIND = _rng.permutation(np.arange(VOXELS**3) % 4).reshape(VOXELS, VOXELS, VOXELS, 1)
BLACK = _rng.permutation(np.arange(VOXELS**3) % 2).reshape(VOXELS, VOXELS, VOXELS, 1) == 0
WEIGHT = np.random.default_rng(2).uniform(0.2, 1.8, (1, SIZE, SIZE, 3))
EXTINCTION, ALBEDO = (f"cloud.interior_medium.{name}.data" for name in ("sigma_t", "albedo"))


def scene() -> dict[str, Any]:
    """The voxels over a floor, under a lamp and a sky."""
    albedo = np.where(BLACK, 0, np.random.default_rng(1).uniform(0.3, 0.95, (VOXELS, VOXELS, VOXELS, 3)))
    grids = {"sigma_t": np.array(list(LEVELS.values()))[KIND], "albedo": albedo}
    medium = {name: volumes.grid(values) | {"filter_type": "nearest"} for name, values in grids.items()}
    return {
        "type": "scene",
        "camera": parts.camera((0, 2.2, 5), (0, 0, 0), 35.0, SIZE),
        "sky": {"type": "constant", "radiance": parts.colour(0.6)},
        "lamp": parts.rectangle((1.5, 3, 1), (0.6, 0, 0), (0, 0, 0.6), parts.diffuse(0), emitter=parts.light(9, 8, 6)),
        "floor": parts.rectangle((0, -1.3, 0), (3, 0, 0), (0, 0, -3), parts.diffuse(0.7, 0.5, 0.3)),
        "cloud": volumes.cube({"type": "heterogeneous", **medium}),
    }


def directions() -> dict[str, tuple[str, np.ndarray, float, bool]]:
    """name -> (key, direction, step, upwards only)."""
    found = {}
    for number, (name, level) in enumerate(LEVELS.items()):
        step = {"empty": 0.04, "thin": 0.01}.get(name, 0.1)
        found[f"extinction, {name}"] = (EXTINCTION, (number == KIND) * 1.0, step, level == 0)
    for number, name in ((1, "thin"), (3, "at the majorant")):
        for black in (True, False):
            along = (number == KIND) * (black == BLACK) * np.ones(3)
            found[f"albedo, {name}, {'black' if black else 'grey'}"] = (ALBEDO, along, 0.05, black)
    return found


def stock(current: dict[str, Any]) -> Callable[[int], dict[str, np.ndarray]]:
    """Gradients by Mitsuba's own integrator, of a seed."""
    theirs = mi.load_dict(scene())
    parameters = mi.traverse(theirs)
    integrator = mi.load_dict({"type": "prbvolpath", "max_depth": DEPTH})

    def gradient(seed: int) -> dict[str, np.ndarray]:
        leaves = {key: mi.TensorXf(np.array(value)) for key, value in current.items()}
        for key, leaf in leaves.items():
            dr.enable_grad(leaf)
            parameters[key] = leaf
        parameters.update()
        image = mi.render(theirs, parameters, integrator=integrator, spp=SPP, seed=mi.UInt32(seed))
        dr.backward(dr.sum(image * mi.TensorXf(WEIGHT[0]), axis=None))
        return {key: np.array(dr.grad(leaf)) for key, leaf in leaves.items()}

    return gradient


def main() -> None:
    """Measure, and write results.json."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--runs", type=int, default=48)
    asked = parser.parse_args()
    print(ur.use())
    renderer = MitsubaRenderer(scene, DEPTH)
    session = renderer.prepare([EXTINCTION, ALBEDO], "path")
    current, weight = renderer.values([EXTINCTION, ALBEDO]), renderer.array(WEIGHT)
    methods = {
        "differential ratio tracking": lambda seed: session.adjoint(
            current, session.image(current, SampleRequest(0, SPP, seed)).paths, weight
        ),
        "prbvolpath": stock(current),
    }
    gradients = {name: [method(1000 + run) for run in range(asked.runs)] for name, method in methods.items()}

    def difference(key: str, high: np.ndarray, low: np.ndarray, seed: int) -> float:
        states = [{**current, key: renderer.array(value)} for value in (high, low)]
        pair = session.image_pair(states[0], states[1], SampleRequest(0, 4 * SPP, seed), "path")
        return float(((np.array(pair.images).astype(np.float64) - np.array(pair.previous)) * WEIGHT).sum())

    table = {}
    for name, (key, along, step, upwards) in directions().items():
        value, rows = np.array(current[key]).astype(np.float64), []
        for run in range(max(8, asked.runs // 3)):
            once = difference(key, value + step * along, value - (not upwards) * step * along, 5000 + 2 * run)
            if upwards:
                twice = difference(key, value + 2 * step * along, value, 5001 + 2 * run)
                rows.append((4 * once - twice) / (2 * step))
            else:
                rows.append(once / (2 * step))
        expected, error = np.mean(rows), np.std(rows, ddof=1) / len(rows) ** 0.5
        table[name] = {"finite differences": [float(expected), float(error)]}
        for method, found in gradients.items():
            sums = [float((np.array(g[key]).astype(np.float64) * along).sum()) for g in found]
            own = np.std(sums, ddof=1) / len(sums) ** 0.5
            z = (np.mean(sums) - expected) / np.hypot(own, error)
            table[name][method] = [float(np.mean(sums)), float(own), float(z)]
        print(name, table[name])
    write(HERE, {"runs": asked.runs, "spp": SPP, "depth": DEPTH, "directions": table})


if __name__ == "__main__":
    main()
