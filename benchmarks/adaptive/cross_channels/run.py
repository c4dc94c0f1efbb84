"""The terms between colours in the probabilities of pixels (Adaptive Eq. 12), and how much any probabilities can gain (its Fig. 3).

A path's gradient is Σ_c ∂L/∂I_c ∂I_c/∂θ over the colours c, so its second moment has terms between colours:

    Σ_k E[(Σ_c ∂L/∂I_c ∂I_c/∂θ_k)²] = Σ_{c,d} E[∂L/∂I_c ∂L/∂I_d] · Σ_k E[∂I_c/∂θ_k ∂I_d/∂θ_k],

where image and derivative are of independent paths. `Adaptive` has those with c = d alone ("summed"); "between colours" has all.
Both products are estimated by signed derivatives along random ±1 tangents. All probabilities are judged by that whole second moment, from
other paths than they are made of, as variances: less the squared gradient. "Many": maps of most of the paths, raw. "Few": of 8 paths a
pixel, blurred over 1.5 pixels; where the sum with the products between colours is negative, it counts as none. A tenth of the draws
is uniform, or as many as the label says. Eq. 5 is p ∝ Σ_c E|∂L/∂I_c|. "Bound": p made of the very paths that
judge it, which no probabilities can undercut, optimistic by the noise of these. Problems at their start, in units of Adam's steps where
there are several elements.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.gradient_variance import gradients
from benchmarks.internals import Key, channel_moments, element_scales, with_differential_bsdf

PROBLEMS: dict[str, dict[str, Any]] = {
    "mirror-trio": {"reference_spp": 256},
    "chalice": {"resolution": 48, "reference_spp": 256},
    "poster": {"resolution": 48},
    "smoke": {"resolution": 32, "reference_spp": 256},
    "glossy-room": {"resolution": 48, "reference_spp": 256},
    "sun-glossy": {"resolution": 48, "reference_spp": 256},
    "mirror-trio, roughness 0.08": {"reference_spp": 256},
    "mirror-trio, roughness 0.25": {"reference_spp": 256},
    "mirror-trio, 32²": {"resolution": 32, "reference_spp": 1024},
    "mirror-trio, roughness 0.15, differential": {"reference_spp": 256},
    "mirror-trio, roughness 0.25, differential": {"reference_spp": 256},
}
"""By label: the problem's name comes first. The roughness is the mirror's where the gradient is taken; 0.15 otherwise.
Differential: derivatives by roughness are sampled apart (`PathGradient(differential_bsdf=True)`)."""
UNIFORM = 0.1
PARTS = 8
BLUR = 1.5
MERGE = ("problems.*",)
QUICK = {"problem": ("mirror-trio",), "paths": 1, "runs": 8, "resolution": 16}


def blurred(problem: ur.Problem, maps: np.ndarray) -> np.ndarray:
    """Maps (pixels, ...) of all views, blurred over `BLUR` pixels."""
    from scipy import ndimage

    known, first, found = problem.renderer.resolutions(), 0, []
    for view in problem.views:
        height, width = known[view.sensor]
        part = maps[first : first + height * width].reshape(height, width, -1)
        found.append(ndimage.gaussian_filter(part, (BLUR, BLUR, 0)).reshape(height * width, *maps.shape[1:]))
        first += height * width
    return np.concatenate(found)


def importance(products: np.ndarray, moments: np.ndarray) -> dict[str, np.ndarray]:
    """√ of the second moment of each pixel, (pixels,), in both forms; of (pixels, 3, 3) each."""
    every = products * moments
    summed, between = np.trace(every, axis1=1, axis2=2), every.sum(axis=(1, 2))
    return {name: np.sqrt(np.maximum(x, 0)) for name, x in (("summed", summed), ("between colours", between))}


def shares(importance: np.ndarray, uniform: float = UNIFORM) -> np.ndarray:
    """Probabilities relative to uniform ones, (pixels,)."""
    return uniform + (1 - uniform) * importance / importance.mean()


def candidates(
    problem: ur.Problem, few: list[np.ndarray], many: list[np.ndarray], magnitude: np.ndarray
) -> dict[str, np.ndarray]:
    """Probabilities by name, (pixels,)."""
    exact = importance(*many)
    smooth = importance(*(blurred(problem, x) for x in many))
    noisy = importance(*(blurred(problem, x) for x in few))
    return {
        "uniform": np.ones(len(magnitude)),
        "Eq. 5": shares(magnitude.sum(axis=1)),
        **{f"{name}, many": shares(x) for name, x in exact.items()},
        **{f"{name}, few": shares(x) for name, x in noisy.items()},
        "summed, many, 0.02 uniform": shares(exact["summed"], 0.02),
        "between colours, many, 0.02 uniform": shares(exact["between colours"], 0.02),
        **{f"summed, many, blurred, {share} uniform": shares(smooth["summed"], share) for share in (0.1, 0.03)},
    }


def measure(problem: ur.Problem, paths: int, runs: int, seed: int = 0) -> dict[str, Any]:
    """Variances of one draw over uniform's by name: [ratio, standard error]."""
    at = problem.initial()
    rows, _, _ = gradients(problem, ur.PathGradient(spp=4), runs, seed)
    scales = element_scales(at, np.square(rows).mean(axis=0, dtype=np.float64))
    rounds = max(1, round(paths / (problem.pixels * PARTS * 8)))
    found = [channel_moments(problem, at, scales, rounds, Key(seed, 11, part)) for part in range(PARTS)]
    means = np.array([half.mean(axis=0) for half in np.array_split(rows.astype(np.float64), 2)]) * scales
    squared = float(means[0] @ means[1])
    table: dict[str, list[float]] = {}
    for part in range(PARTS):
        others = [index for index in range(PARTS) if index != part]
        products, moments, _ = found[part]
        true = (products[::-1] * moments).sum(axis=(2, 3)).mean(axis=0)
        many = [np.mean([found[index][kind].mean(axis=0) for index in others], axis=0) for kind in (0, 1)]
        few = [found[others[0]][kind].mean(axis=0) for kind in (0, 1)]
        magnitude = np.mean([found[index][2] for index in others], axis=0)
        made = candidates(problem, few, many, magnitude) | {"bound": shares(np.sqrt(np.maximum(true, 0)), 0.001)}
        for name, share in made.items():
            table.setdefault(name, []).append(len(true) * float((true / share).sum()) - squared)
    base = np.array(table["uniform"])
    entry: dict[str, Any] = {"pixels": problem.pixels, "rounds": rounds, "variance": {}}
    for name, values in table.items():
        left = (np.sum(values) - np.array(values)) / (base.sum() - base)
        error = float(np.sqrt((PARTS - 1) * np.var(left)))
        entry["variance"][name] = [float(np.sum(values) / base.sum()), error]
    for kind in ("many", "few"):
        one, other = (np.array(table[f"{name}, {kind}"]) for name in ("between colours", "summed"))
        left = (one.sum() - one) / (other.sum() - other)
        error = float(np.sqrt((PARTS - 1) * np.var(left)))
        entry[f"between over summed, {kind}"] = [float(one.sum() / other.sum()), error]
    return entry


def run(
    problem: tuple[str, ...] = tuple(PROBLEMS), paths: int = 1 << 21, runs: int = 64, resolution: int | None = None
) -> Iterator[dict[str, Any]]:
    """A part per problem.

    Args:
        problem: of the gallery
        paths: of all parts together
        runs: gradients whose mean squares give Adam's units
        resolution: film size, in place of each problem's own
    """
    for name in problem:
        options = {**PROBLEMS[name], **({"resolution": resolution} if resolution else {})}
        kind, *special = name.split(", ")
        made = ur.gallery.problem(kind, **options)
        for roughness in (float(word.split()[1]) for word in special if word.startswith("roughness")):
            made = made.replaced(parameters=[replace(parameter, initial=roughness) for parameter in made.parameters])
        if "differential" in special:
            made = made.rendered_by(with_differential_bsdf(made.renderer))
        entry = measure(made, paths, runs)
        print(name, entry, flush=True)
        yield {"problems": {name: {"options": options, **entry}}}
