# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""What primal, pair and adjoint cost on a grid, against Mitsuba's `volpath` and `prbvolpath`, as ratios within one run.

    python benchmarks/volumes/cost/run.py [--resolution 64] [--grid 32] [--spp 16] [--sparse]

On one view of `smoke`; with `--sparse`, of a small dense core and a thin shell in a wide empty box. Everything
is timed in turns, so that what else the machine does falls on all alike.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import mitsuba_renderer, write

import unrender as ur
from unrender.gallery import volumes
from unrender.rendering.renderer import SampleRequest

HERE = Path(__file__).resolve().parent


def turns(contenders: dict[str, Callable[[int], Any]], repeats: int, warm: int = 3) -> dict[str, list[float]]:
    """Milliseconds of each, by turns; each must evaluate what it makes."""
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for number in range(warm + repeats):
        for name, contender in contenders.items():
            dr.sync_thread()
            began = time.perf_counter()
            contender(number)
            dr.sync_thread()
            if number >= warm:
                times[name].append(1e3 * (time.perf_counter() - began))
    return times


def core(resolution: int) -> np.ndarray:
    """Extinction (Z, Y, X, 1) of a small dense ball, and a thin open shell beside it."""
    x, y, z = volumes.positions(resolution)
    ball = 40 * np.clip(1 - np.sqrt((x + 0.4) ** 2 + (y + 0.3) ** 2 + z**2) / 0.2, 0, 1)
    shell = 3 * (np.abs(np.hypot(x - 0.3, z) - 0.35) < 0.06) * (y > 0.2)
    return (ball + shell)[..., None]


def contenders(problem: ur.Problem, spp: int, sparse: bool) -> dict[str, Callable[[int], Any]]:
    """What is compared, each a function of a seed."""
    renderer = mitsuba_renderer(problem)
    keys = list(problem.truth)
    session = renderer.prepare(keys, "path")
    values = {
        key: core(len(value)) if sparse and key.endswith("sigma_t.data") else value
        for key, value in problem.truth.items()
    }
    current = {key: renderer.array(value) for key, value in values.items()}
    previous = {key: value * 0.98 for key, value in current.items()}
    size = np.asarray(problem.views[0].reference).shape
    weight = renderer.array(np.ones((1, *size)))
    image = session.image(current, SampleRequest(0, spp, 1)).paths
    pair = session.image_pair(current, previous, SampleRequest(0, spp, 1), "path").paths

    description = renderer.pair.description
    assert callable(description)
    stock = mi.load_dict(description())
    parameters = mi.traverse(stock)
    for key, value in current.items():
        parameters[key] = mi.TensorXf(value)
    parameters.update()
    depth = problem.max_depth
    volpath, prbvolpath = (mi.load_dict({"type": kind, "max_depth": depth}) for kind in ("volpath", "prbvolpath"))

    def prbvolpath_step(seed: int) -> None:
        leaves = {key: mi.TensorXf(value) for key, value in current.items()}
        for key, leaf in leaves.items():
            dr.enable_grad(leaf)
            parameters[key] = leaf
        parameters.update()
        picture = mi.render(stock, parameters, integrator=prbvolpath, spp=spp, seed=mi.UInt32(seed))
        dr.backward(dr.sum(picture, axis=None))
        dr.eval([dr.grad(leaf) for leaf in leaves.values()])

    return {
        "volpath": lambda n: dr.eval(mi.render(stock, integrator=volpath, spp=spp, seed=mi.UInt32(n))),
        "primal": lambda n: session.image(current, SampleRequest(0, spp, n)),
        "pair": lambda n: session.image_pair(current, previous, SampleRequest(0, spp, n), "path"),
        "adjoint": lambda n: session.adjoint(current, image, weight),
        "adjoint of a pair": lambda n: session.adjoint_pair(current, previous, pair, weight, weight),
        "primal and adjoint": lambda n: session.adjoint(
            current, session.image(current, SampleRequest(0, spp, n)).paths, weight
        ),
        "prbvolpath, primal and adjoint": prbvolpath_step,
    }


def main() -> None:
    """Measure, and write results.json."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--grid", type=int, default=32)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--sparse", action="store_true")
    parser.add_argument("--repeats", type=int, default=9)
    asked = parser.parse_args()
    print(ur.use())
    problem = ur.gallery.problem(
        "smoke", resolution=asked.resolution, grid_resolution=asked.grid, views=1, reference_spp=1
    )
    times = turns(contenders(problem, asked.spp, asked.sparse), asked.repeats)
    medians = {name: float(np.median(found)) for name, found in times.items()}

    def ratio(a: str, b: str) -> list[float]:
        """10 %, 50 % and 90 % quantiles of the ratio turn by turn."""
        return [float(q) for q in np.quantile(np.array(times[a]) / np.array(times[b]), [0.1, 0.5, 0.9])]

    ratios = {
        "throughput of the primal / volpath": ratio("volpath", "primal"),
        "pair / primal": ratio("pair", "primal"),
        "adjoint / primal": ratio("adjoint", "primal"),
        "adjoint of a pair / adjoint": ratio("adjoint of a pair", "adjoint"),
        "primal and adjoint / prbvolpath's": ratio("primal and adjoint", "prbvolpath, primal and adjoint"),
    }
    for name, found in (medians | ratios).items():
        print(name, found)
    write(HERE / "sparse" if asked.sparse else HERE, {**vars(asked), "median_ms": medians, "ratios": ratios})


if __name__ == "__main__":
    main()
