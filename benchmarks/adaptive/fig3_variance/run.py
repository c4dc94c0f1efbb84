"""Variance of one parameter's gradient by pixel sampler (Adaptive Fig. 3): the roughness of a mirror.

`mirror-trio`, L2, at its start or another roughness. Every scheme traces as many paths a step: `count` pixels with two
paths each; all pixels at once, at two paths each, has its variance scaled to that budget. Of the two paths one gives
the image and the other its derivative, as in the paper, or, in leave-one-out sample groups, each gives both. The schemes
that estimate probabilities do so once, from `samples` paths, before the runs; these are left out, as the paper leaves
them. Samples independent of one another, as in the paper, and stratified ones. Differential: derivatives by the roughness
are sampled apart, for all schemes alike (`PathGradient(differential_bsdf=True)`, the paper's Fig. 6).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.pixel_schemes import PAPERS, SCHEMES, gradients, pixels, spread
from benchmarks.runner.records import Record

FIVE_LEVELS = "adaptive, five levels"
GROUPS = {1: "", 2: ", leave-one-out"}
"""By the estimator's `spp`."""
ALL_WAYS = ((1, False), (2, False), (1, True), (2, True))
"""`spp`, and whether samples are stratified."""
USUAL_SAMPLES = 1 << 15
SHOWN = ("loss", "adaptive")
"""Whose probabilities are kept as maps."""
MERGE = ("cases.*", "maps")
QUICK = {"runs": 8, "count": 16, "samples": 1 << 10, "resolution": 16}

Schemes = dict[str, dict[str, float]]


def ratios(schemes: Schemes) -> dict[str, list[float]]:
    """Variances of the schemes over adaptive sampling's, with standard errors."""
    found: dict[str, list[float]] = {}
    for name, ours in schemes.items():
        if not name.startswith("adaptive"):
            continue
        for other in ("uniform", "loss", "all"):
            of = name.replace(FIVE_LEVELS, other).replace("adaptive", other)
            if of in schemes:
                ratio = schemes[of]["variance"] / ours["variance"]
                error = ratio * float(np.linalg.norm([x["error"] / x["variance"] for x in (schemes[of], ours)]))
                found[f"{of} / {name}"] = [ratio, error]
    return found


def label(roughness: float, differential: bool, samples: int) -> str:
    """The name of a case."""
    words = ["differential"] * differential + [f"maps from {samples} paths"] * (samples != USUAL_SAMPLES)
    return ", ".join([f"roughness {roughness:g}", *words])


def measured(
    problem: ur.Problem, runs: int, count: int, samples: int, differential: bool, paper: bool
) -> Iterator[tuple[str, dict[str, float], np.ndarray | None]]:
    """Of each scheme its name, its variance, and its probabilities where it has some; see `run`."""
    ways = ALL_WAYS[:1] if paper else ALL_WAYS
    budget, exact = 2 * count, np.zeros(1)
    for spp in sorted({spp for spp, _ in ways}):
        rows, paths, _ = gradients(problem, ur.PathGradient(spp=spp, differential_bsdf=differential), runs)
        variance, error = spread(rows)
        yield f"all{GROUPS[spp]}", {"variance": variance * paths / budget, "error": error * paths / budget}, None
        exact = rows.mean(axis=0)
    fixed = {**PAPERS, "samples": samples, "refresh": 10 * runs}
    for spp, stratified in ways:
        for scheme, levels in (*((scheme, {}) for scheme in SCHEMES), ("adaptive", {"levels": 4})):
            sampler = pixels(scheme, count, stratified=stratified, **fixed, **levels)
            estimator = ur.PathGradient(pixels=sampler, spp=spp, differential_bsdf=differential)
            rows, paths, probability = gradients(problem, estimator, runs)
            if paths != budget:
                raise RuntimeError(f"{scheme} traced {paths} paths, not {budget}")
            variance, error = spread(rows)
            name = (FIVE_LEVELS if levels else scheme) + GROUPS[spp] + (", stratified" if stratified else "")
            z = (rows.mean(axis=0) - exact) / np.sqrt(np.var(rows, axis=0, ddof=1) / runs)
            yield name, {"variance": variance, "error": error, "z": float(np.abs(z).max())}, probability.get(0)


def run(
    runs: int = 1024,
    count: int = 512,
    samples: int = USUAL_SAMPLES,
    resolution: int = 64,
    roughness: float = 0.15,
    differential: bool = False,
    paper: bool = False,
) -> Iterator[dict[str, Any]]:
    """Variances, their ratios, and probabilities as maps; the other cases' figures stay.

    Args:
        samples: paths that probabilities are estimated from
        roughness: of the mirror, where the gradient is taken
        differential: whether derivatives by roughness are sampled apart
        paper: the paper's estimator alone: one path for the image, another for the derivative, independent
    """
    opened = ur.gallery.problem("mirror-trio", resolution=resolution)
    problem = opened.replaced(parameters=[replace(each, initial=roughness) for each in opened.parameters])
    case, sizes = label(roughness, differential, samples), {"runs": runs, "count": count, "resolution": resolution}
    schemes: Schemes = {}
    maps = {f"{case}|reference": np.asarray(problem.views[0].reference)}
    for name, values, probability in measured(problem, runs, count, samples, differential, paper):
        schemes[name] = values
        if probability is not None and name in SHOWN:
            maps[f"{case}|{name}"] = probability
        print(case, name, values, flush=True)
    yield {"cases": {case: {**sizes, "schemes": schemes, "ratios": ratios(schemes)}}, "maps": maps}


def table(record: Record) -> str:
    """Per case and scheme, and the ratios."""
    blocks = []
    for entry in markdown.named(record["cases"], "case"):
        text = "`mirror-trio`, {case}: {resolution}², {count} pixels with two paths each, {runs} runs."
        row = "{name} | {variance:.3g} ± {error:.1g} | "
        schemes = markdown.named(entry["schemes"], "name")
        rows = [[markdown.fill(row + ("{z:.1f}" if "z" in scheme else ""), scheme)] for scheme in schemes]
        ratios = ", ".join("{} {:.2f} ± {:.2f}".format(name, *ratio) for name, ratio in entry["ratios"].items())
        head = "scheme | variance at equal paths | mean against all pixels, z"
        blocks += [markdown.fill(text, entry), markdown.table(head, rows), f"Ratios: {ratios}."]
    return markdown.blocks(*blocks)


def plot(record: Record) -> figures.Figure:
    """The picture, and maps of pixel probabilities over uniform ones."""
    maps, first = record["maps"], next(iter(record["cases"]))
    shown = {f"{name}, over uniform": maps[f"{first}|{name}"] for name in SHOWN}
    return figures.pictures([{"reference": maps[f"{first}|reference"], **shown}], cmap="magma", norm="log", vmin=0.1)
