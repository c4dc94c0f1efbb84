"""Roughness gradients by differential BSDF sampling, with uniform and adaptive pixels (Adaptive Fig. 6).

First the variance by the alpha of a rough conductor, ordinary and differential, at values of alpha around that of the reference: of the
image's derivative alone, weighted by fixed numbers, and of the gradient of an L2 loss, in which the noise of the image counts too.
Differential over ordinary at equal paths from the camera; times the ratio of processor times of image and adjoint, in turns, it is the
ratio at equal processor time. Then descents from small mini-batches, as in the paper's figure: uniform and adaptive pixels, ordinary and
differential derivatives; the error of alpha over the last quarter of the steps, relative to where it began, over seeds. `plate` and `ball`
lie under a sky with a sun; `rough-box` is Mitsuba's Cornell box with a rough conductor in it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.adaptive.over_uniform.run import rough_box
from benchmarks.internals import Key, SampleRequest, Tree, with_differential_bsdf
from benchmarks.paths import descent
from benchmarks.pixel_schemes import pixels, spread
from benchmarks.runner.records import Record
from unrender.gallery import parts

ALPHAS = (0.02, 0.05, 0.15, 0.5)
KINDS = ("ordinary", "differential")
SPP = 4
"""Of the gradients whose variance is measured, leave-one-out."""
WARM = 4
SCHEMES = ("uniform", "adaptive")
DESCENTS = {"plate": (0.2, 0.05), "rough-box": (0.3, 0.1)}
"""Where alpha begins, and its true value."""
QUICK = {"scene": ("plate",), "alphas": (0.1,), "runs": 16, "resolution": 8, "seeds": 2, "steps": 4, "reference_spp": 4}
MERGE = ("variance.*", "descents.*")


def _metal(shape: str, truth: float, resolution: int) -> Callable[[], dict[str, Any]]:
    """A thing of metal under a sky."""

    def scene() -> dict[str, Any]:
        silver = {"type": "roughconductor", "material": "Ag", "alpha": truth, "distribution": "ggx"}
        sun = np.array([-0.35, 0.75, -0.56])
        sky = parts.picture(tuple(sun / np.linalg.norm(sun)), 0.12, (60.0, 55.0, 45.0))
        of_shape = {
            "plate": lambda: parts.rectangle((0, 0, 0), (1.2, 0, 0), (0, 0.75, -0.95), silver),
            "ball": lambda: {"type": "sphere", "radius": 1.0, "bsdf": silver},
        }
        return {
            "type": "scene",
            "camera": parts.camera((0, 0.8, 4), (0, 0, 0), 36.0, resolution),
            "metal": of_shape[shape](),
            "sky": parts.environment(sky),
        }

    return scene


def opened(name: str, resolution: int, reference_spp: int) -> ur.Problem:
    """A problem of one unknown: the roughness."""
    if name == "rough-box":
        return rough_box(reference_spp, resolution)
    if name == "mirror-trio":
        return ur.gallery.problem(name, resolution=resolution, reference_spp=reference_spp)
    start, truth = DESCENTS.get(name, (0.2, 0.05))
    scene, key = _metal(name, truth, resolution), "metal.bsdf.alpha.value"
    black = ur.View(np.zeros((resolution, resolution, 3), np.float32))
    unknown = ur.Parameter(key, start, bounds=(0.01, 1))
    blank = ur.Problem(scene, [unknown], [black], max_depth=4, truth={key: np.float32(truth)}, name=name)
    return blank.replaced(views=[ur.View(ur.render(blank, blank.truth, 0, reference_spp, 0))])


def image_derivative(problem: ur.Problem, at: Tree, kind: str, spp: int) -> Callable[[Any], float]:
    """A function of a key: the derivative of the image, weighted by fixed numbers, along fresh paths."""
    renderer: Any = problem.renderer if kind == "ordinary" else with_differential_bsdf(problem.renderer)
    session = renderer.prepare(list(at), None)
    height, width = renderer.resolutions()[0]
    weights = renderer.array(np.random.default_rng(1).uniform(0.5, 1.5, (1, height, width, 3)) / (height * width))

    def found(key: Any) -> float:
        paths = session.image(at, SampleRequest(0, spp, key.uint32())).paths
        return float(np.ravel(session.adjoint(at, paths, weights)[problem.parameters[0].key])[0])

    return found


def loss_gradient(problem: ur.Problem, at: Tree, kind: str, spp: int) -> Callable[[Any], float]:
    """A function of a key: the gradient of the loss."""
    estimator = ur.PathGradient(spp=spp, differential_bsdf=kind == "differential")
    state = estimator.init(problem, at)

    def found(key: Any) -> float:
        return float(np.ravel(estimator.estimate(problem, at, state, key)[0].gradient[problem.parameters[0].key])[0])

    return found


def compared(contenders: dict[str, Callable[[Any], float]], runs: int) -> dict[str, Any]:
    """Differential over ordinary: the ratio of variances with its standard error, that of processor times, z of the means' difference."""
    rows: dict[str, list[float]] = {kind: [] for kind in KINDS}
    times: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for run in range(runs + WARM):
        for number, kind in enumerate(KINDS):
            began = time.process_time()
            rows[kind].append(contenders[kind](Key(number, run)))
            times[kind].append(time.process_time() - began)
    one, other = (np.array(rows[kind][WARM:]) for kind in KINDS)
    (a, error_a), (b, error_b) = (spread(values[:, None], parts=8) for values in (one, other))
    return {
        "ratio": b / a,
        "error": b / a * float(np.hypot(error_a / a, error_b / b)),
        "cost": float(np.median(times[KINDS[1]][WARM:]) / np.median(times[KINDS[0]][WARM:])),
        "mean": [float(one.mean()), float(other.mean())],
        "deviation": [float(np.sqrt(a)), float(np.sqrt(b))],
        "z": float((one.mean() - other.mean()) / np.sqrt((a + b) / runs)),
    }


def descents(
    problem: ur.Problem, count: int, rate: float, steps: int, seeds: int, kinds: tuple[str, ...], falling: bool
) -> dict[str, Any]:
    """By pixels and kind: the error along each run, relative to its start, and its mean over the last quarter, one for each seed."""
    key, found = problem.parameters[0].key, {}
    for scheme in SCHEMES:
        for kind in kinds:
            estimator = ur.PathGradient(pixels=pixels(scheme, count), spp=2, differential_bsdf=kind == "differential")
            runs, spent = [], time.process_time()
            for seed in range(seeds):
                path = descent(problem, estimator, rate, steps + 1, seed, falling)
                errors = [problem.parameter_error(at)[key] for at in path]
                runs.append([error / errors[0] for error in errors])
            last = [float(np.mean(run[-(steps // 4) :])) for run in runs]
            found[f"{scheme}, {kind}"] = {
                "last": last,
                "mean": float(np.mean(last)),
                "error": float(np.std(last, ddof=1) / np.sqrt(seeds)),
                "seconds": (time.process_time() - spent) / seeds,
                "budget": [steps, count],
                "along": np.round(np.mean(runs, axis=0), 4).tolist(),
            }
            print(problem.name, scheme, kind, last, flush=True)
    return found


def run(
    scene: tuple[str, ...] = ("plate", "ball", "mirror-trio", "rough-box"),
    alphas: tuple[float, ...] = ALPHAS,
    runs: int = 96,
    resolution: int = 32,
    count: int = 128,
    rate: float = 0.003,
    steps: int = 300,
    seeds: int = 6,
    reference_spp: int = 1024,
    part: tuple[str, ...] = ("variance", "descents"),
    kinds: tuple[str, ...] = KINDS,
    falling: bool = False,
) -> Iterator[dict[str, Any]]:
    """A part per scene.

    Args:
        alphas: where the variance is measured
        count: pixels a step of the descents, two paths each
        rate: of Adam
        kinds: of derivatives of the descents; the other's figures stay
        falling: whether rates fall as half a cosine; these descents have an entry of their own
    """
    for name in scene:
        problem = opened(name, resolution, reference_spp)
        found: dict[str, Any] = {"variance": {name: []}} if "variance" in part else {}
        for alpha in alphas if found else ():
            at = {problem.parameters[0].key: problem.renderer.array(np.full((), alpha, np.float32))}
            point: dict[str, Any] = {"alpha": alpha}
            for measured, of in (("derivative", image_derivative), ("loss", loss_gradient)):
                point[measured] = compared({kind: of(problem, at, kind, SPP) for kind in KINDS}, runs)
            found["variance"][name].append(point)
            print(name, point, flush=True)
        if name in DESCENTS and "descents" in part:
            label = f"{name}, {steps} steps, falling rate" if falling else name
            found["descents"] = {label: descents(problem, count, rate, steps, seeds, kinds, falling)}
        yield found


def table(record: Record) -> str:
    """Ratios of variances, then descents."""
    s, variance = record["settings"], record["variance"]
    alphas = [f"{point['alpha']:g}" for point in next(iter(variance.values()))]
    parts = [
        f"{s['resolution']}² pixels, {SPP} paths each, {s['runs']} gradients; differential over ordinary, by alpha."
    ]
    kinds = {"derivative": "variance of the image's derivative", "loss": "variance of the loss's gradient"}
    for of, label in kinds.items():
        rows = [[name, *(_ratio(point[of]) for point in points)] for name, points in variance.items()]
        head = " | ".join(["scene", *alphas])
        parts += [f"**{label}** at equal paths; at equal processor time", markdown.table(head, rows)]
    every = [point[of] for points in variance.values() for point in points for of in kinds]
    worst = max(abs(entry["z"]) for entry in every)
    return markdown.blocks(
        *parts,
        f"The largest |z| of the difference of the {len(every)} pairs of means: {worst:.2f}.",
        "**descents**: two paths a pixel, constant rate if not said otherwise",
        markdown.records(
            "scene | steps × pixels | seeds | pixels, derivatives | error of alpha, last quarter | processor seconds a run",
            "{scene} | {budget[0]} × {budget[1]} | {last!n} | {kind} | {mean:.3f} ± {error:.2g} | {seconds:.1f}",
            markdown.named(record["descents"], "scene", "", "kind"),
        ),
    )


def _ratio(entry: dict[str, Any]) -> str:
    return f"{entry['ratio']:.2g} ± {entry['error']:.1g}; {entry['ratio'] * entry['cost']:.2g}"


def plot(record: Record) -> figures.Figure:
    panels = {
        name: {label: figures.over_steps(entry["along"]) for label, entry in entries.items()}
        for name, entries in record["descents"].items()
    }
    return figures.curves(panels, "step", "error of alpha / at the start")
