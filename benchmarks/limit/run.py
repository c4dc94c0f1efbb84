"""The least error that the paths of a plain rendering allow (Cramér and Rao), and how near `auto` is to it.

N paths in each pixel have the information N Jᵀ Σ⁻¹ J about the unknowns. J is the derivative of the pixels at the truth, Σ the covariance
of a pixel's channels for one path. With the squared error of the start as the variance of a prior, C, no estimate has a mean squared error
below tr((N Jᵀ Σ⁻¹ J + C⁻¹)⁻¹) / n that takes the unknowns as independent. Neighbouring texels are alike, and `auto` smooths them: it may be
below this limit. The efficiency of a run is the number of paths with which the limit has the run's error, over the
number of paths that the run has traced for images and adjoints. It does not depend on the machine.

J is from central differences of images with equal random numbers. The product of two independent estimates of J has no bias, but noise may
make eigenvalues negative, which count as 0: the limit is then too high. The mean of both estimates has too much information, by the square
of its noise: the limit is then too low. The table shows both. Σ is from 4,096 paths in each pixel, since fewer miss rare bright ones.
A channel of a colour is assumed to reach the same channel of the picture alone. Errors are those of `suite`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import method
from benchmarks.races import Recorder
from benchmarks.runner.records import Record
from benchmarks.suite import scenes
from benchmarks.suite.run import error_of, visible

GALLERY = {"wall": {"resolution": 16, "texture_resolution": 8, "reference_spp": 16384}}
"""Problems of the gallery, and their sizes."""
FOREIGN = {"numbers, L2": (16, 1), "tray, L2": (16, 8), "cbox, L2": (16, 8)}
"""Problems of others: film and texture."""
MERGE = ("problems",)
QUICK = {"problem": ("wall",), "steps": 4, "seeds": 1, "paths": 1 << 16}
_STEP = 0.02
"""Half the difference, relative to an unknown's root mean square."""
_GROUPS, _GROUP_SPP = 256, 16
"""Pictures from which Σ is estimated, and their samples per pixel."""
_REFERENCE_SPP = 16384


def columns(problem: ur.Problem) -> list[tuple[str, tuple[int, ...], bool]]:
    """Return (key, index, whether it is a colour) of each difference: the channels of a colour differ together."""
    found = []
    for key, value in problem.truth.items():
        colour = value.ndim > 0 and value.shape[-1] == 3
        found += [(key, index, colour) for index in np.ndindex(value.shape[:-1] if colour else value.shape)]
    return found


def pictures(problem: ur.Problem, values: dict[str, np.ndarray], spp: int, seed: int) -> np.ndarray:
    """Return the pixels of all views, (N, 3)."""
    views = range(len(problem.views))
    return np.concatenate([ur.render(problem, values, view, spp, seed).reshape(-1, 3) for view in views])


def jacobians(problem: ur.Problem, rows: dict[str, slice], spp: int) -> np.ndarray:
    """Return two independent estimates of the derivatives of the pixels at the truth, (2, n, N, 3)."""
    truth = {key: np.array(value, np.float32) for key, value in problem.truth.items()}
    sizes = {key: _STEP * float(np.sqrt(np.mean(value**2))) for key, value in truth.items()}
    found = np.zeros((2, sum(x.size for x in truth.values()), problem.pixels, 3))
    for key, index, colour in columns(problem):
        ends = []
        for sign in (1, -1):
            moved = {**truth, key: truth[key].copy()}
            moved[key][index] += sign * sizes[key]
            ends.append([pictures(problem, moved, spp, seed) for seed in (1, 2)])
        slopes = (np.array(ends[0]) - ends[1]) / (2 * sizes[key])
        shape, place = truth[key].shape, (*index, 0) if colour else index
        first = rows[key].start + (int(np.ravel_multi_index(place, shape)) if shape else 0)
        for channel in range(3) if colour else (slice(None),):
            found[:, first + (channel if colour else 0), :, channel] = slopes[:, :, channel]
    return found


def information(problem: ur.Problem, paths: int) -> tuple[np.ndarray, np.ndarray, dict[str, slice]]:
    """Return Jᵀ Σ⁻¹ J of one path in each pixel without bias, the same from the mean of J, and the rows of each key.

    Args:
        problem: with its truth.
        paths: of all differences.
    """
    truth = {key: np.array(value, np.float32) for key, value in problem.truth.items()}
    starts = np.cumsum([0, *(value.size for value in truth.values())])
    rows = {key: slice(*pair) for key, pair in zip(truth, itertools.pairwise(starts.tolist()), strict=True)}
    spp = max(1, paths // (4 * len(columns(problem)) * problem.pixels))
    noise = np.stack([pictures(problem, truth, _GROUP_SPP, 100 + seed) for seed in range(_GROUPS)])
    inverse = inverse_covariance(noise) / _GROUP_SPP

    def product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        weighted = np.einsum("kpc,pcd->kpd", other, inverse).reshape(len(other), -1)
        found = one.reshape(len(one), -1) @ weighted.T
        return 0.5 * (found + found.T)

    both = jacobians(problem, rows, spp)
    mean = both.mean(axis=0)
    return product(*both), product(mean, mean), rows


def inverse_covariance(noise: np.ndarray) -> np.ndarray:
    """Return Σ⁻¹ of each pixel, (N, 3, 3), from K pictures (K, N, 3). Pixels without noise have no light, and no weight."""
    number = len(noise)
    centred = noise - noise.mean(axis=0)
    covariance = np.einsum("kpc,kpd->pcd", centred, centred) / (number - 1)
    scale = np.trace(covariance, axis1=1, axis2=2)
    covariance += (1e-3 * scale + 1e-12)[:, None, None] * np.eye(3)
    unbiased = (number - 5) / (number - 1)  # of the inverse of a sample covariance of three channels
    return unbiased * np.linalg.inv(covariance) * (scale > 0)[:, None, None]


def limit(problem: ur.Problem, fisher: np.ndarray, rows: dict[str, slice], paths: np.ndarray) -> np.ndarray:
    """Return the least error of `suite` for each number of paths in a pixel."""
    seen, start = visible(problem), problem.initial_values()
    squares = {key: np.mean((start[key] - value)[seen[key]] ** 2) for key, value in problem.truth.items()}
    scale = np.concatenate([np.full(problem.truth[key].size, np.sqrt(squares[key])) for key in rows])
    values, vectors = np.linalg.eigh(scale[:, None] * fisher * scale)
    weights = vectors**2
    curves = []
    for number in paths:
        variance = weights @ (1.0 / (1.0 + number * np.maximum(values, 0.0)))
        curves.append(np.mean([np.sqrt(variance[rows[key]][seen[key].reshape(-1)].mean()) for key in rows]))
    return np.array(curves)


def run(
    problem: tuple[str, ...] = (*GALLERY, *FOREIGN),
    assets: Path | None = None,
    steps: int = 160,
    seeds: int = 2,
    paths: int = 1 << 23,
) -> Iterator[dict[str, Any]]:
    """The limit and the runs of each problem.

    Args:
        problem: of the gallery, or of others, such as "cbox, L2"
        paths: of all differences of pictures for J
    """
    for name in problem:
        sizes = (*FOREIGN[name], _REFERENCE_SPP) if name in FOREIGN else ()
        opened = scenes.problem(name, assets, *sizes, **GALLERY.get(name, {}), loss="L2")
        unbiased, most, rows = information(opened, paths)
        error, runs = error_of(opened), []
        for seed in range(seeds):
            recorder = Recorder(lambda parameters, of=error: {"": of(parameters)}, {"": error(opened.initial())}, 0.0)
            plan = method("auto").plan(opened)
            ur.optimize(opened, plan, steps=steps, seed=seed, callbacks=[recorder], progress=False)
            runs.append(np.array(recorder.points[""])[1:])
        traced = runs[0][:, 1] / opened.pixels
        errors = np.median([points[:, 2] for points in runs], axis=0)
        numbers = np.geomspace(traced[0] / 1e4, traced[-1], 200)
        least, lowest = (limit(opened, fisher, rows, numbers) for fisher in (unbiased, most))
        every = max(1, steps // 40)
        found = {
            "limit": [numbers[::4].tolist(), least[::4].tolist()],
            "auto": [traced[::every].tolist(), errors[::every].tolist()],
            "end": [float(errors[-1]), float(least[-1]), float(lowest[-1])],
            "paths": float(traced[-1]),
            "efficiency": {
                str(step): [
                    float(np.interp(-errors[step - 1], -x, numbers) / traced[step - 1]) for x in (least, lowest)
                ]
                for step in (max(1, steps // 16), max(1, steps // 4), steps)
            },
        }
        print(f"{name}: {found['end']}, {found['efficiency']}", flush=True)
        yield {"problems": {name: found}}


def table(record: Record) -> str:
    """Errors at the end, and the efficiency at three steps."""
    rows = []
    for name, entry in record["problems"].items():
        efficiency = [f"{low:.2g} to {high:.2g} ({step})" for step, (high, low) in entry["efficiency"].items()]
        auto, high, low = entry["end"]
        rows.append([name, f"{entry['paths']:.0f}", f"{auto:.3f}", f"{low:.3f} to {high:.3f}", *efficiency])
    text = (
        "{steps} steps, {seeds} seeds, medians. Efficiency: paths of the limit over those of `auto`, to the error of `auto`; from 1 on, "
        "`auto` is below the limit, which takes texels as independent."
    )
    head = "problem | paths in a pixel | auto at the end | limit | efficiency (steps) | later | at the end"
    return markdown.blocks(text.format(**record["settings"]), markdown.table(head, rows))


def plot(record: Record) -> figures.Figure:
    panels = {name: {side: [entry[side]] for side in ("auto", "limit")} for name, entry in record["problems"].items()}
    return figures.curves(panels, "paths in a pixel", log="xy")
