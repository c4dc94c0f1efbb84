"""What the order of use and update costs (paper Fig. 4): bias where the weight sees the samples that it weighs.

    python benchmarks/rcv/fig4_order/run.py [--resolution 32] [--spp 4] [--steps 32] [--runs 32]

On `indirect-room`, once with parameters that do not change and once on a fixed path from the initial values to the
truth. Statistics are updated after use (`RecursiveControlVariate()`) or before (`update_before_use=True`). Their
bias, relative to the mean of the image, is measured twice: as the mean over runs less a converged image at the same
parameters, and, far more sharply, less the same recursion on the same samples with weights fixed beforehand (those of
other runs), which is unbiased. Mean squares are freed of noise. "Equivalent spp" is the spp of one step times
Var[plain] / Var[control variate].

At few samples a part of the bias is not of the order: while a pixel has seen equal samples only (often 0), its variance
is 0, so is its weight, and those samples are forgotten once another comes. `--spp 32` shows the order alone.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from along import Moments, bias, converged, drift, follow, gallery, paired_bias, read_maps, write_maps
from common import read, write

import unrender as ur
from unrender.core import arrays
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.rendering.renderer import SampleRequest
from unrender.statistics.recursion import advance

HERE = Path(__file__).resolve().parent
METHODS = {
    "plain": ("plain render", "#888888"),
    "before": ("updated before use", "#c0392b"),
    "after": ("updated after use", "#1f6fb4"),
}
PATHS = {"still": "unchanging parameters", "drift": "drifting parameters"}
ORDERS = {
    "before": ur.images.RecursiveControlVariate(update_before_use=True),
    "after": ur.images.RecursiveControlVariate(),
}
PILOT_SEEDS = (1_000_001, 1_000_002)


def pilot_weights(problem: ur.Problem, path: list[Tree], spp: int) -> list[Any]:
    """The control weights of every step, averaged over runs of other seeds: independent of all that is measured."""
    found = []
    for seed in PILOT_SEEDS:
        run = follow(problem, ORDERS["after"], path, spp, seed)
        found.append([arrays.numpy(e.info["control_weight"]) if e.info else 0.0 for e in run])
    return [np.mean(np.stack(list(step)), axis=0) for step in zip(*found, strict=True)]


def fixed(problem: ur.Problem, path: list[Tree], weights: list[Any], spp: int, seed: int) -> Iterator[np.ndarray]:
    """The recursion (6) with given weights, on the samples that `follow` takes: unbiased."""
    session = problem.renderer.prepare(list(path[0]), "path")
    memory: Any = None
    for step, (now, before) in enumerate(zip(path, [path[0], *path], strict=False)):
        request = SampleRequest(problem.views[0].sensor, spp, Key(seed, step).uint32())
        rendering = session.image_pair(now, before, request, "path")
        assert rendering.previous is not None
        F, H = (arrays.numpy(images[0]).astype(np.float64) for images in (rendering.images, rendering.previous))
        memory = F if memory is None else advance(memory, F, H, weights[step])
        yield memory


def measure(
    problem: ur.Problem, path: list[Tree], spp: int, runs: int, steps: list[int], reference_spp: int
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Bias and variance of every method at the chosen steps of one path; maps of the paired |bias| at the last."""
    references: dict[int, Moments] = {}
    for step in steps:
        same = next((s for s in references if path[s] is path[step]), None)
        references[step] = converged(problem, path[step], reference_spp) if same is None else references[same]
    weights = pilot_weights(problem, path, spp)
    found = {name: {step: Moments() for step in steps} for name in METHODS}
    paired = {name: {step: Moments() for step in steps} for name in (*ORDERS, "difference")}
    for run in range(runs):
        plain = follow(problem, ur.images.Plain(), [path[step] for step in steps], spp, runs + run)
        for step, estimate in zip(steps, plain, strict=True):
            found["plain"][step].add(arrays.numpy(estimate.mean()))
        sound = {n: image for n, image in enumerate(fixed(problem, path, weights, spp, run)) if n in steps}
        seen: dict[str, dict[int, np.ndarray]] = {}
        for name, image in ORDERS.items():
            estimates = enumerate(follow(problem, image, path, spp, run))
            seen[name] = {n: arrays.numpy(e.mean()).astype(np.float64) for n, e in estimates if n in steps}
        for step in steps:
            for name in ORDERS:
                found[name][step].add(seen[name][step])
                paired[name][step].add(seen[name][step] - sound[step])
            paired["difference"][step].add(seen["before"][step] - seen["after"][step])
        if (run + 1) % 8 == 0 or run + 1 == runs:
            print(f"run {run + 1} of {runs}", flush=True)
    end = steps[-1]
    scales = {step: float(references[step].mean.mean()) for step in steps}
    methods: dict[str, Any] = {}
    for name, moments in found.items():
        gain = float(found["plain"][end].variance.sum() / moments[end].variance.sum())
        rows = [{"step": step, **bias(moments[step], references[step])} for step in steps]
        methods[name] = {"converged": rows, "equivalent_spp": gain * spp}
    for name, moments in paired.items():
        rows = [{"step": step, **paired_bias(moments[step], scales[step])} for step in steps]
        methods.setdefault(name, {})["paired"] = rows
    maps = {name: np.abs(paired[name][end].mean).mean(axis=-1) / scales[end] for name in ORDERS}
    return {"methods": methods}, {**maps, "reference": references[end].mean}


def report(path: str, result: dict[str, Any]) -> None:
    """The last step in words."""
    for name, entry in result["methods"].items():
        label = METHODS[name][0] if name in METHODS else "before less after"
        for how in ("converged", "paired"):
            if how in entry:
                last = entry[how][-1]
                signed, error = last["signed"], last["signed_error"]
                print(
                    f"{path}, {label}, {how}: bias {signed:+.3%} ± {error:.3%} ({signed / error:+.1f} σ), "
                    f"rms {last['rms']:.2%} ({last['square'] / last['square_error']:+.1f} σ)"
                )
        if "equivalent_spp" in entry:
            print(f"{path}, {label}: equivalent to {entry['equivalent_spp']:.0f} spp")


def plot(results: dict[str, Any]) -> None:
    """A row per path: signed bias over steps, the rendered scene, |bias| maps of the two orders."""
    maps = read_maps(HERE)
    figure, axes = plt.subplots(2, 4, figsize=(14, 7), layout="constrained", width_ratios=[1.5, 1, 1, 1])
    for line, (path, title) in zip(axes, PATHS.items(), strict=True):
        result = results["paths"][path]
        for name, (label, colour) in METHODS.items():
            for how, style in (("converged", "none"), ("paired", "-")):
                if how not in result["methods"][name] or (name == "plain"):
                    continue
                rows = result["methods"][name][how]
                x = [row["step"] for row in rows]
                y, e = ([100 * row[key] for row in rows] for key in ("signed", "signed_error"))
                against = "converged image" if how == "converged" else "fixed weights, same samples"
                marks: dict[str, Any] = {"capsize": 2, "marker": "o" if how == "paired" else "x", "ms": 4, "ls": style}
                alpha = 1.0 if how == "paired" else 0.45
                line[0].errorbar(x, y, e, color=colour, alpha=alpha, label=f"{label}, less {against}", **marks)
        line[0].axhline(0, color="black", lw=0.7)
        line[0].set(xlabel="step", ylabel="mean bias, % of the image's mean", title=f"{title} (± standard error)")
        line[0].legend(fontsize=7)
        line[1].imshow(
            np.clip(maps[f"{path}/reference"] / np.quantile(maps[f"{path}/reference"], 0.98), 0, 1) ** (1 / 2.2)
        )
        line[1].set_title(f"converged, step {results['steps'] - 1}", fontsize=9)
        top = 100 * float(np.quantile(maps[f"{path}/before"], 0.98))
        drawn = None
        for axis, name in zip(line[2:], ("before", "after"), strict=True):
            drawn = axis.imshow(100 * maps[f"{path}/{name}"], vmin=0, vmax=top, cmap="magma")
            entry = result["methods"][name]
            last = entry["paired"][-1]
            words = f"bias {last['signed']:+.2%} ± {last['signed_error']:.2%}, rms {last['rms']:.2%}"
            axis.set_title(f"{METHODS[name][0]}\n{words}\nequivalent to {entry['equivalent_spp']:.0f} spp", fontsize=9)
        assert drawn is not None
        figure.colorbar(drawn, ax=line[3], label="|mean over runs less fixed weights|,\n% of the image's mean")
        for axis in line[1:]:
            axis.axis("off")
    figure.suptitle(f"indirect-room, {results['resolution']}², {results['spp']} spp a step, {results['runs']} runs")
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=32)
    parser.add_argument("--spp", type=int, default=4)
    parser.add_argument("--steps", type=int, default=32)
    parser.add_argument("--runs", type=int, default=32)
    parser.add_argument("--half-life", type=float, default=8.0, help="steps in which the drift halves what is left")
    parser.add_argument("--reference-spp", type=int, default=8192)
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        ur.use()
        problem = gallery("indirect-room", asked.resolution, asked.resolution, reference_spp=16)
        moving = drift(problem, asked.steps, asked.half_life)
        chosen = sorted({*(2**k for k in range(1, 12) if 2**k < asked.steps - 1), asked.steps - 1})
        found, maps = {}, {}
        for name, path in {"still": [problem.initial()] * asked.steps, "drift": moving}.items():
            found[name], pictures = measure(problem, path, asked.spp, asked.runs, chosen, asked.reference_spp)
            maps.update({f"{name}/{key}": value for key, value in pictures.items()})
            report(name, found[name])
        sizes = {k: getattr(asked, k) for k in ("resolution", "spp", "steps", "runs", "half_life", "reference_spp")}
        write(HERE, {**sizes, "paths": found})
        write_maps(HERE, maps)
    plot(read(HERE))


if __name__ == "__main__":
    main()
