"""Where adaptive pixel probabilities fail (Adaptive Fig. 7): a caustic, which paths from the camera rarely find.

Probabilities estimated from 4 paths per pixel, raw and denoised, and from many: the variance of the gradient at the
start, summed over parameters, when 512 pixels are sampled by them, two independent paths each, over that of uniform
sampling. Means over estimates of the probabilities, of 256 gradients each. The same on two problems whose light is found
easily. And how far maps from few paths are from those of many: the correlation of their logarithms.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import Key, PixelSampler, pixel_probability
from benchmarks.pixel_schemes import PAPERS, gradients, spread
from benchmarks.runner.records import Record

PROBLEMS = ("caustic", "plain-and-textured", "mirror-trio")
FEW, COUNT = 4, 512
QUICK = {"problem": ("caustic",), "resolution": 16, "many": 8, "repeats": 2, "runs": 8}


def probabilities(problem: ur.Problem, spp: int, seed: int) -> np.ndarray:
    """Raw probabilities over uniform ones, one per pixel of view 0."""
    options = {**PAPERS, "relative": True, "uniform": 0.01, "denoiser": "none"}
    return pixel_probability(problem, ur.pixels.Adaptive(256, samples=spp * problem.pixels, **options), Key(seed))


def variances(problem: ur.Problem, many: int, repeats: int, runs: int) -> dict[str, Any]:
    """By how the probabilities were found: the variance over that of uniform sampling, mean and standard error."""

    def summed(sampler: PixelSampler, seed: int) -> float:
        return spread(gradients(problem, ur.PathGradient(pixels=sampler, spp=1), runs, seed)[0])[0]

    def adaptive(spp: int, denoiser: Any) -> PixelSampler:
        return ur.pixels.Adaptive(COUNT, samples=spp * problem.pixels, refresh=10 * runs, denoiser=denoiser, **PAPERS)

    uniform = float(np.mean([summed(ur.pixels.Uniform(COUNT), seed) for seed in range(repeats)]))
    samplers = {"few": adaptive(FEW, "none"), "few, denoised": adaptive(FEW, "auto"), "many": adaptive(many, "none")}
    found: dict[str, Any] = {}
    for name, sampler in samplers.items():
        ratios = np.array([summed(sampler, seed) for seed in range(repeats)]) / uniform
        found[name] = {
            "mean": float(ratios.mean()),
            "error": float(ratios.std(ddof=1) / np.sqrt(repeats)),
            "worst": float(ratios.max()),
        }
    return found


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Of two maps' logarithms."""
    return float(np.corrcoef(np.log(a).ravel(), np.log(b).ravel())[0, 1])


def run(
    problem: tuple[str, ...] = PROBLEMS, resolution: int = 64, many: int = 1024, repeats: int = 8, runs: int = 256
) -> dict[str, Any]:
    """Variances and correlations; probabilities as maps.

    Args:
        many: paths per pixel of the map to compare with
        repeats: estimates of the probabilities
    """
    correlations: dict[str, Any] = {}
    variance: dict[str, Any] = {}
    maps: dict[str, np.ndarray] = {}
    for name in problem:
        made = ur.gallery.problem(name, resolution=resolution)
        exact, again = (probabilities(made, many, 100 + seed) for seed in range(2))
        correlations[name] = {"many": correlation(exact, again)}
        for spp in (2, 4, 16, 64):
            found = [correlation(probabilities(made, spp, seed), exact) for seed in range(repeats)]
            correlations[name][str(spp)] = float(np.mean(found))
        variance[name] = variances(made, many, repeats, runs)
        print(name, correlations[name], variance[name], flush=True)
        maps[f"{name}|reference"] = np.asarray(made.views[0].reference)
        maps |= {f"{name}|few": probabilities(made, FEW, 0), f"{name}|many": exact}
    return {"correlation": correlations, "variance": variance, "maps": maps}


KINDS = ("few", "few, denoised", "many")


def table(record: Record) -> str:
    """What probabilities from few paths cost, and how far their maps are from one of many."""
    many = record["settings"]["many"]
    cells = (f"{{{kind}[mean]:.2f}} ± {{{kind}[error]:.2f}}, worst {{{kind}[worst]:.2f}}" for kind in KINDS)
    gains = markdown.records(
        f"problem | 4 paths per pixel | 4, denoised | {many}",
        " | ".join(["{name}", *cells]),
        markdown.named(record["variance"], "name"),
    )
    correlation = markdown.table(
        f"problem | 2 paths per pixel | 4 | 16 | 64 | {many}, with another of {many}",
        [
            [name, *(f"{entry[spp]:.2f}" for spp in ("2", "4", "16", "64", "many"))]
            for name, entry in record["correlation"].items()
        ],
    )
    text = f"Correlation of the logarithms of probabilities with those from {many} paths per pixel."
    return markdown.blocks("Variance over that of uniform draws.", gains, text, correlation)


def plot(record: Record) -> figures.Figure:
    """Per problem: the picture, and maps of probabilities from few paths and from many."""
    maps = record["maps"]
    rows = [
        {name: maps[f"{name}|reference"]}
        | {f"{kind}: variance × {found[kind]['mean']:.2f}": maps[f"{name}|{kind}"] for kind in ("few", "many")}
        for name, found in record["variance"].items()
    ]
    return figures.pictures(rows, cmap="magma", norm="log")
