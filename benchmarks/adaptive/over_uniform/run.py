"""Variance of adaptive pixel mini-batches over that of uniform ones, from the first step of a descent on.

Adam descends with each sampler from the start of each problem. At some steps the parameters and the sampler's state are kept; then the
variance of the gradient with the probabilities of that step, summed over all elements, is divided by that of as many uniform pixels, two
paths each. Twice: plain, and relative to each element's mean square, which is what Adam's steps see and what the sampler minimises (of a
single parameter the two are the same). And in two ways. "By gradients": many independent ones of each sampler; standard errors from eighths
of them. "By paths": the second moment of each pixel, from many paths of whole views, the two factors from different ones, weighted by the
probabilities; the same paths judge both samplers, so it resolves what a few bright paths decide. Beside the default: pooling, which is the
default where no denoiser is installed, probabilities as they were before (a tenth uniform, maps of a few paths every 20 steps, raw), and
those in proportion to the loss derivative (Eq. 5). Problems of the gallery, a Cornell box with a rough conductor, and scenes of others
where assets are given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import markdown
from benchmarks.internals import Key, PixelSampler, Tree, element_scales, gradient_of, mi, pixel_shares, second_moments
from benchmarks.pixel_schemes import spread
from benchmarks.runner.records import Record
from benchmarks.suite.scenes import problem as foreign_problem

_LARGE = ("caustic", "mirror-trio", "sun-glossy", "plain-and-textured", "two-planets", "smoke", "nerf-volume")
_SMALL = ("indirect-room", "ajar", "spiral", "sunlit-vase", "chalice")
GALLERY: dict[str, dict[str, Any]] = {
    **{name: {} for name in ("rough-box", *_LARGE)},
    **{name: {"resolution": 64} for name in _SMALL},
}
"""Problems and their options."""
FOREIGN = ("plates, L2", "painting, L2", "tray, L2", "numbers, L2")
SAMPLERS: dict[str, Callable[[int], PixelSampler]] = {
    "adaptive": ur.pixels.Adaptive,
    "adaptive, pooling": partial(ur.pixels.Adaptive, denoiser="pooling"),
    "before": partial(ur.pixels.Adaptive, uniform=0.1, learn_from_draws=False, by_cost=False, denoiser="none"),
    "loss": ur.pixels.LossProportional,
}
STEPS = (0, 1, 3, 10, 30, 100)
"""At which the variance is measured: those done before."""
PARTS = 8
BOX = "large-box.bsdf.alpha.value"
MERGE = ("problems.*",)
QUICK = {
    "problem": ("mirror-trio",), "sampler": ("adaptive",), "count": 64, "runs": 16, "paths": 1, "gallery_reference_spp": 4,
}  # fmt: skip


def rough_box(reference_spp: int = 2048, resolution: int = 64) -> ur.Problem:
    """Mitsuba's Cornell box, its tall box a rough conductor: the roughness is unknown, .3 where the truth is .1."""

    def scene() -> dict[str, Any]:
        found = mi.cornell_box()
        found["sensor"]["film"].update(width=resolution, height=resolution, rfilter={"type": "box"})
        found["large-box"]["bsdf"] = {"type": "roughconductor", "alpha": 0.3}
        del found["integrator"]
        return found

    black, truth = ur.View(np.zeros((resolution, resolution, 3), np.float32)), {BOX: np.float32(0.1)}
    blank = ur.Problem(scene, [ur.Parameter(BOX, 0.3)], [black], max_depth=6, truth=truth, name="rough-box")
    parts = max(1, reference_spp // 256)
    images = [ur.render(blank, blank.truth, 0, reference_spp // parts, seed) for seed in range(parts)]
    return blank.replaced(views=[ur.View(np.mean(images, axis=0))])


class Kept(ur.protocols.Callback):
    """Parameters and the sampler's state before each of `STEPS`."""

    def __init__(self) -> None:
        self.before: dict[int, tuple[Tree, Any]] = {}

    def on_start(self, run: Any) -> None:
        if run.step in STEPS:
            self.before[run.step] = dict(run.parameters), run.state.estimator.pixels

    def on_step(self, run: Any, record: Any) -> None:
        del record
        self.on_start(run)


def rows(problem: ur.Problem, sampler: PixelSampler, at: Tree, state: Any, runs: int, seed: int) -> np.ndarray:
    """(runs, n) independent gradients with the probabilities of a state."""
    found = []
    for run in range(runs):
        redrawn = sampler.redraw(problem, state, Key(seed, run))  # pyright: ignore[reportAttributeAccessIssue]
        found.append(np.concatenate([np.ravel(g) for g in gradient_of(problem, at, redrawn, Key(seed, run))]))
    return np.array(found, np.float32)


def by_paths(moments: np.ndarray, shares: np.ndarray) -> tuple[float, float]:
    """Σ_j s_j / p_j over Σ_j s_j, for second moments s (parts, pixels) and probabilities p relative to uniform ones; with its error."""
    parts = len(moments)
    over, whole = moments @ (1 / shares), moments.sum(axis=1)
    left_out = (over.sum() - over) / (whole.sum() - whole)
    return float(over.sum() / whole.sum()), float(np.sqrt((parts - 1) * np.var(left_out)))


def least(moments: np.ndarray) -> float:
    """(Σ_j √s_j)² over N Σ_j s_j: the least that any probabilities leave of uniform ones' variance. The s of few paths make it smaller."""
    second = moments.mean(axis=0)
    return float(np.sqrt(second).mean() ** 2 / second.mean())


def point(
    problem: ur.Problem,
    adaptive: PixelSampler,
    at: Tree,
    before: Any,
    settings: dict[str, int],
    step: int,
    direct: bool,
) -> dict[str, Any]:
    """Ratios at one step, [plain, relative], with standard errors."""
    _, state = adaptive.draw(problem, at, before, Key(step))
    uniform = ur.pixels.Uniform(settings["count"])
    runs = settings["runs"] if direct else settings["runs"] // 4
    theirs = rows(problem, uniform, at, uniform.init(problem, at), runs, 2 * step + 1)
    ours = rows(problem, adaptive, at, state, runs, 2 * step) if direct else theirs
    scales = element_scales(at, np.square(np.concatenate([ours, theirs])).mean(axis=0, dtype=np.float64))
    shares = pixel_shares(problem, adaptive, state)
    found: dict[str, Any] = {"step": step, "uniform": state.uniform, "ratio": [], "error": [], "gradients": []}
    both = [np.ones(theirs.shape[1]), scales]
    moments = second_moments(problem, at, both, settings["paths"], PARTS, Key(step, 7))
    found["least"] = [least(of_factors) for of_factors in moments]
    for factors, of_factors in zip(both, moments, strict=True):
        ratio, error = by_paths(of_factors, shares)
        found["ratio"].append(ratio)
        found["error"].append(error)
        if direct:
            (a, error_a), (u, error_u) = (spread(each, np.square(factors), PARTS) for each in (ours, theirs))
            found["gradients"].append([a / u, a / u * float(np.hypot(error_a / a, error_u / u))])
    return found


def descent(problem: ur.Problem, label: str, settings: dict[str, int]) -> list[dict[str, Any]]:
    """Ratios at each of `STEPS`."""
    sampler = SAMPLERS[label](settings["count"])
    kept, estimator = Kept(), ur.PathGradient(pixels=sampler, spp=2)
    ur.optimize(problem, estimator, ur.optimizers.Adam(0.01), steps=STEPS[-1], callbacks=[kept])
    return [
        point(problem, sampler, at, state, settings, step, label == "adaptive")
        for step, (at, state) in sorted(kept.before.items())
    ]


def summarize(record: dict[str, Any]) -> dict[str, Any]:
    """Geometric means over the problems at the last step, and the worst ratio of any step: [plain, relative]."""
    found: dict[str, Any] = {}
    for name in SAMPLERS:
        entries = [entry[name] for entry in record["problems"].values() if name in entry]
        if entries:
            last = np.array([points[-1]["ratio"] for points in entries])
            every = [(at["ratio"], at["error"]) for points in entries for at in points]
            worst = [max((ratio[n], error[n]) for ratio, error in every) for n in range(2)]
            found[name] = {"problems": len(entries), "mean": np.exp(np.log(last).mean(axis=0)).tolist(), "worst": worst}
    return {"summary": found}


def run(
    problem: tuple[str, ...] = tuple(GALLERY),
    assets: Path | None = None,
    sampler: tuple[str, ...] = tuple(SAMPLERS),
    count: int = 1000,
    runs: int = 128,
    paths: int = 1 << 17,
    gallery_reference_spp: int | None = None,
) -> Iterator[dict[str, Any]]:
    """A part per problem.

    Args:
        problem: of the gallery, and "rough-box"
        sampler: that descend
        count: pixels a step, two paths each
        paths: of each measurement by paths, about
        gallery_reference_spp: of the gallery's references, none for its own
    """
    options = {} if gallery_reference_spp is None else {"reference_spp": gallery_reference_spp}
    for name in (*problem, *(FOREIGN if assets is not None else ())):
        if assets is not None and name in FOREIGN:
            opened = foreign_problem(name, assets, 64, 64, 1024)
        elif name == "rough-box":
            opened = rough_box(**options)
        else:
            opened = ur.gallery.problem(name, **GALLERY[name], **options)
        found: dict[str, Any] = {}
        for label in sampler:
            found[label] = descent(opened, label, {"count": count, "runs": runs, "paths": paths})
            shown = [
                f"{at['step']}: {at['ratio'][0]:.2f} {at['ratio'][1]:.2f} ± {at['error'][1]:.2f}" for at in found[label]
            ]
            print(f"{name}, {label}: {', '.join(shown)}", flush=True)
        yield {"problems": {name: found}}


def table(record: Record) -> str:
    settings = record["settings"]
    parts = [
        f"{settings['count']} pixels a step; plain / relative, by paths; ± is of the relative one. Steps are those done before; λ, the "
        "share of uniform draws, at each; least, that any probabilities leave as a plain sum."
    ]
    for label in record["summary"]:
        found = {name: entry[label] for name, entry in record["problems"].items() if label in entry}
        parts += [f"**{label}**, variance over uniform's after so many steps", _by_steps(found, _cell)]
    direct = {
        name: [point for point in entry["adaptive"] if point["gradients"]]
        for name, entry in record["problems"].items()
        if "adaptive" in entry
    }
    if direct:
        text = f"**adaptive**, by {settings['runs']} gradients of each sampler, plain / relative"
        parts += [text, _by_steps(direct, _direct)]
    head = "sampler | problems | geometric mean at the end, plain | relative | worst of all steps, plain | relative"
    row = "{label} | {problems} | {mean[0]:.2f} | {mean[1]:.2f} | {worst[0][0]:.2f} ± {worst[0][1]:.1g}"
    row += " | {worst[1][0]:.2f} ± {worst[1][1]:.1g}"
    return markdown.blocks(*parts, markdown.records(head, row, markdown.named(record["summary"], "label")))


def _by_steps(found: dict[str, Any], cell: Callable[[dict[str, Any]], str]) -> str:
    head = " | ".join(["problem", *(str(point["step"]) for point in next(iter(found.values())))])
    return markdown.table(head, [[name, *map(cell, points)] for name, points in found.items()])


def _cell(point: dict[str, Any]) -> str:
    plain, relative = point["ratio"]
    limit = f", least {point['least'][0]:.2f}" if "least" in point else ""
    return f"{plain:.2f} / {relative:.2f} ± {point['error'][1]:.1g}, λ {point['uniform']:.2g}{limit}"


def _direct(point: dict[str, Any]) -> str:
    return " / ".join(f"{ratio:.2f} ± {error:.1g}" for ratio, error in point["gradients"])
