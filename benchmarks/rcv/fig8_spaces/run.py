"""Where to share samples between two states (paper Fig. 8): primary space against path space.

    python benchmarks/rcv/fig8_spaces/run.py [--scene glossy-room] [--resolution 32] [--spp 8] [--steps 50] [--runs 10]

On `glossy-room` (its roughness maps change where paths go) and `indirect-room` (its albedo does not), view 0. One
descent fixes the path of the parameters; a plain render, a control variate in primary space and one in path space
then take it alike, on several seeds. Per step: the mean control weight and the variance over runs, relative to that
of the plain render; every few steps also the mean square error against a converged image, likewise relative. The cost
is the median time of one image of one view, and of one whole gradient step of all views.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import drjit as dr
import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from along import Moments, converged, descent, follow, gallery, read_maps, write_maps
from common import median_time, read, write

import unrender as ur
from unrender.core import arrays
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.images.base import ImageEstimator
from unrender.problem.batches import WholeView

HERE = Path(__file__).resolve().parent
SCENES = ("glossy-room", "indirect-room")
RATE = 0.02
METHODS: dict[str, tuple[str, str, ImageEstimator]] = {
    "plain": ("plain", "#888888", ur.images.Plain()),
    "primary": ("primary space", "#d1782a", ur.images.RecursiveControlVariate(space="primary")),
    "path": ("path space", "#1f6fb4", ur.images.RecursiveControlVariate(space="path")),
}


def measure(
    problem: ur.Problem, path: list[Tree], spp: int, runs: int, every: int, reference_spp: int
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Weights, variances and errors of every method along the path; weight maps of the last step."""
    checked = sorted({*range(0, len(path), every), len(path) - 1})
    references = {step: converged(problem, path[step], reference_spp) for step in checked}
    # What noise the references add to a mean square error.
    floor = {step: float(np.mean(reference.error**2)) for step, reference in references.items()}
    result: dict[str, Any] = {"checked": checked, "methods": {}}
    maps: dict[str, np.ndarray] = {}
    for name, (_, _, estimator) in METHODS.items():
        seen = [Moments() for _ in path]
        weights = [Moments() for _ in path]
        errors = {step: Moments() for step in checked}
        last = Moments()
        for run in range(runs):
            for step, estimate in enumerate(follow(problem, estimator, path, spp, run)):
                image = arrays.numpy(estimate.mean()).astype(np.float64)
                seen[step].add(image)
                weight = arrays.numpy(estimate.info["control_weight"]) if estimate.info else np.zeros_like(image)
                weights[step].add(weight.mean())
                if step in errors:
                    errors[step].add(np.mean((image - references[step].mean) ** 2) - floor[step])
                if step == len(path) - 1:
                    last.add(weight)
        result["methods"][name] = {
            "weight": [w.level for w in weights],
            "variance": [float(m.variance.mean()) for m in seen],
            "error": [errors[step].level for step in checked],
            "error_error": [errors[step].level_error for step in checked],
        }
        maps[name] = last.mean.mean(axis=-1)
        print(f"{problem.name}, {name}: done", flush=True)
    maps["reference"] = references[checked[-1]].mean
    return result, maps


def costs(problem: ur.Problem, path: list[Tree], spp: int) -> dict[str, dict[str, float]]:
    """Median milliseconds of an image (view 0) and of a gradient (all views), parameters changing at every call."""
    found: dict[str, dict[str, float]] = {}
    for name, (_, _, image) in METHODS.items():
        box: dict[str, Any] = {"image": image.init(problem, path[0])}

        def one_image(n: int, image: ImageEstimator = image, box: dict[str, Any] = box) -> None:
            now = path[n % len(path)]
            estimate, kept = image.estimate(problem, now, box["image"], WholeView(problem, 0), spp, 1, Key(1, n))
            box["image"] = image.advance(now, box["image"], (kept,))
            dr.eval(estimate.images, box["image"])

        estimator = ur.PathGradient(image, spp=spp)
        box["gradient"] = estimator.init(problem, path[0])

        def one_step(n: int, estimator: ur.PathGradient = estimator, box: dict[str, Any] = box) -> None:
            now = path[n % len(path)]
            _, box["gradient"] = estimator.estimate(problem, now, box["gradient"], Key(2, n))

        found[name] = {"image_ms": median_time(one_image)[0], "step_ms": median_time(one_step)[0]}
    return found


def summarise(entry: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Over the second half of the path: mean weight and plain's variance over this one's; costs relative to plain's."""
    plain, times = entry["methods"]["plain"], entry["costs"]
    half = len(plain["variance"]) // 2
    summary = {}
    for name, found in entry["methods"].items():
        gain = float(np.sum(plain["variance"][half:]) / np.sum(found["variance"][half:]))
        summary[name] = {
            "weight": float(np.mean(found["weight"][half:])),
            "variance_ratio": gain,
            "image_cost": times[name]["image_ms"] / times["plain"]["image_ms"],
            "step_cost": times[name]["step_ms"] / times["plain"]["step_ms"],
            "error_ratio_at_last": plain["error"][-1] / found["error"][-1],
        }
    return summary


def plot(results: dict[str, Any]) -> None:
    """A row per scene: weight and variance over steps, weight maps of the two spaces, cost."""
    maps = read_maps(HERE)
    # Where the spaces agree, both are to be seen.
    styles: dict[str, dict[str, Any]] = {"plain": {}, "primary": {"lw": 4, "alpha": 0.6}, "path": {}}
    entries = results["scenes"]
    size, widths = (19, 3.9 * len(entries)), [1.35, 1.35, 1, 1, 1, 1.2]
    figure, axes = plt.subplots(len(entries), 6, figsize=size, squeeze=False, layout="constrained", width_ratios=widths)
    for row, (scene, entry) in zip(axes, entries.items(), strict=True):
        steps, checked = np.arange(len(entry["methods"]["plain"]["weight"])), np.array(entry["checked"])
        plain = entry["methods"]["plain"]
        for name, (label, colour, _) in METHODS.items():
            found = entry["methods"][name]
            if name != "plain":
                row[0].plot(steps, found["weight"], color=colour, label=label, **styles[name])
            row[1].plot(
                steps, np.array(found["variance"]) / plain["variance"], color=colour, label=label, **styles[name]
            )
            unit = np.array(plain["variance"])[checked]
            marks: dict[str, Any] = {"color": colour, "ls": "none", "marker": "x", "ms": 5, "capsize": 2}
            row[1].errorbar(checked, np.array(found["error"]) / unit, np.array(found["error_error"]) / unit, **marks)
        row[0].plot(steps, steps / (steps + 1), color="#bbbbbb", ls=":", label="n/(n+1)")
        row[0].set(title=f"{scene}: mean control weight", xlabel="step", ylabel="weight", ylim=(0, 1.02))
        row[0].legend(fontsize=8)
        row[1].set(
            title="variance over runs (× squared error)",
            xlabel="step",
            ylabel="relative to a plain render",
            yscale="log",
        )
        row[1].legend(fontsize=8)
        reference = maps[f"{scene}/reference"]
        row[2].imshow(np.clip(reference / np.quantile(reference, 0.98), 0, 1) ** (1 / 2.2))
        row[2].set_title("converged, last step", fontsize=9)
        drawn = None
        for axis, name in zip(row[3:5], ("primary", "path"), strict=True):
            drawn = axis.imshow(maps[f"{scene}/{name}"], vmin=0, vmax=1, cmap="viridis")
            axis.set_title(f"weights, {METHODS[name][0]}", fontsize=9)
        assert drawn is not None
        figure.colorbar(drawn, ax=list(row[3:5]), label="control weight (mean over runs)", shrink=0.8)
        for axis in row[2:5]:
            axis.axis("off")
        place = np.arange(len(METHODS))
        for shift, what, shade in ((-0.2, "image", 1.0), (0.2, "step", 0.5)):
            times = [entry["costs"][name][f"{what}_ms"] for name in METHODS]
            bars = row[5].bar(place + shift, times, 0.38, color=[m[1] for m in METHODS.values()], alpha=shade)
            row[5].bar_label(bars, [f"{what}\n{time / times[0]:.2f}×" for time in times], fontsize=7)
        row[5].set_xticks(place, [m[0] for m in METHODS.values()], fontsize=8)
        row[5].set(title="cost: image, gradient step", ylabel="milliseconds")
        row[5].margins(y=0.18)
    words = f"{results['resolution']}², {results['spp']} spp a step, {results['runs']} runs"
    figure.suptitle(f"{words}, the same parameters for all")
    figure.savefig(HERE / "figure.png", dpi=100)
    print(f"wrote {HERE / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", action="append", choices=SCENES)
    parser.add_argument("--resolution", type=int, default=32)
    parser.add_argument("--spp", type=int, default=8)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--every", type=int, default=10, help="steps between converged images")
    parser.add_argument("--reference-spp", type=int, default=2048)
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        ur.use()
        entries, maps = {}, {}
        for scene in asked.scene or SCENES:
            problem = gallery(scene, asked.resolution, max(16, asked.resolution // 2))
            path = descent(
                problem, ur.PathGradient(ur.images.RecursiveControlVariate(), spp=asked.spp), RATE, asked.steps
            )
            entry, pictures = measure(problem, path, asked.spp, asked.runs, asked.every, asked.reference_spp)
            entry["costs"] = costs(problem, path, asked.spp)
            entry["summary"] = summarise(entry)
            print(scene, {name: {k: round(v, 3) for k, v in row.items()} for name, row in entry["summary"].items()})
            entries[scene] = entry
            maps.update({f"{scene}/{key}": value for key, value in pictures.items()})
        sizes = {k: getattr(asked, k) for k in ("resolution", "spp", "steps", "runs", "every", "reference_spp")}
        write(HERE, {**sizes, "rate": RATE, "scenes": entries})
        write_maps(HERE, maps)
    plot(read(HERE))


if __name__ == "__main__":
    main()
