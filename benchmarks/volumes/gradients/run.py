"""Gradients of voxels in participating media: differential ratio tracking and `prbvolpath` against finite differences.

Voxels are empty, thin, middling and at the majorant, half of them black. Finite differences are of pairs of states on
one set of paths, to both sides, or to second order upwards where the value is zero. Differences from them are in
standard errors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.internals import Renderer, SampleRequest, dr, mi, mitsuba_renderer
from unrender.gallery import parts, volumes

SIZE, SPP, VOXELS, DEPTH = 16, 64, 6, 5
LEVELS = {"empty": 0.0, "thin": 0.02, "middling": 1.0, "at the majorant": 4.0}
_rng = np.random.default_rng(0)
KIND = _rng.permutation(np.arange(VOXELS**3) % 4).reshape(VOXELS, VOXELS, VOXELS, 1)
BLACK = _rng.permutation(np.arange(VOXELS**3) % 2).reshape(VOXELS, VOXELS, VOXELS, 1) == 0
WEIGHT = np.random.default_rng(2).uniform(0.2, 1.8, (1, SIZE, SIZE, 3))
EXTINCTION, ALBEDO = (f"cloud.interior_medium.{name}.data" for name in ("sigma_t", "albedo"))
QUICK = {"runs": 2}


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


def finite_difference(
    renderer: Renderer, current: dict[str, Any], key: str, along: np.ndarray, step: float, upwards: bool, seed: int
) -> float:
    """The derivative along a direction, from states on one set of paths."""
    session, value = renderer.prepare(list(current), "path"), np.array(current[key]).astype(np.float64)

    def difference(high: np.ndarray, low: np.ndarray, number: int) -> float:
        one, other = ({**current, key: renderer.array(state)} for state in (high, low))
        pair = session.image_pair(one, other, SampleRequest(0, 4 * SPP, number), "path")
        return float(((np.array(pair.images).astype(np.float64) - np.array(pair.previous)) * WEIGHT).sum())

    once = difference(value + step * along, value - (not upwards) * step * along, seed)
    if not upwards:
        return once / (2 * step)
    return (4 * once - difference(value + 2 * step * along, value, seed + 1)) / (2 * step)


def run(runs: int = 48) -> dict[str, Any]:
    """Derivatives along each direction, with standard errors and z-scores."""
    renderer, keys = mitsuba_renderer(scene, DEPTH), [EXTINCTION, ALBEDO]
    session, current, weight = renderer.prepare(keys, "path"), renderer.values(keys), renderer.array(WEIGHT)
    methods = {
        "differential ratio tracking": lambda seed: session.adjoint(
            current, session.image(current, SampleRequest(0, SPP, seed)).paths, weight
        ),
        "prbvolpath": stock(current),
    }
    gradients = {name: [method(1000 + number) for number in range(runs)] for name, method in methods.items()}
    table: dict[str, Any] = {}
    for name, (key, along, step, upwards) in directions().items():
        rows = [
            finite_difference(renderer, current, key, along, step, upwards, 5000 + 2 * number)
            for number in range(max(8, runs // 3))
        ]
        expected, error = np.mean(rows), np.std(rows, ddof=1) / len(rows) ** 0.5
        table[name] = {"finite differences": [float(expected), float(error)]}
        for method, found in gradients.items():
            sums = [float((np.array(g[key]).astype(np.float64) * along).sum()) for g in found]
            own = np.std(sums, ddof=1) / len(sums) ** 0.5
            z = (np.mean(sums) - expected) / np.hypot(own, error)
            table[name][method] = [float(np.mean(sums)), float(own), float(z)]
        print(name, table[name], flush=True)
    return {"spp": SPP, "depth": DEPTH, "directions": table}
