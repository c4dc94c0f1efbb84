"""The steady state (paper Fig. 3): weights and variance of the control variate on a scene that does not change.

    python benchmarks/rcv/fig3_weights/run.py [--resolution 48] [--spp 8] [--steps 50] [--runs 24]

On an unchanging `indirect-room` the best weight is n/(n+1) and the variance 1/(n+1) of one render's. Four rules weigh
the same renders:

- analytic: n/(n+1);
- online: Eq. 8 with Var[F_CV] from running statistics of F_CV itself, as if consecutive images were independent;
- relative: Eq. 8 with the recurrence (10), kept relative to Var[F]: `unrender.images.RecursiveControlVariate` itself;
- absolute: the same recurrence kept in absolute units, which freezes early, bad estimates of Var[F].

All but the analytic rule learn variances from earlier renders, from step 1 on, and so start to keep anything at step
3: the best that they can do is 1/(n-1), drawn as a dotted line. The variance is that over independent runs, per
pixel, summed, divided by that of one render. The bias is the mean over runs less that of the analytic rule on the
same renders (which is unbiased), relative to the mean of the image.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from along import Moments, gallery, read_maps, write_maps
from common import read, write
from rcv.fig3_weights.track import squares, track

import unrender as ur
from unrender import statistics
from unrender.core import arrays
from unrender.core.random import Key
from unrender.rendering.renderer import SampleRequest
from unrender.statistics import welford
from unrender.statistics.recursion import advance

HERE = Path(__file__).resolve().parent
RULES = {
    "analytic": ("analytic n/(n+1)", "#222222"),
    "online": ("Eq. 8, running statistics of F_CV", "#d1782a"),
    "absolute": ("Eq. 8 + recurrence, absolute", "#8a55a8"),
    "relative": ("Eq. 8 + recurrence, relative (unrender)", "#1f6fb4"),
}


class Simulated:
    """A control variate on renders F = H of an unchanging scene, in NumPy, with one of the other rules."""

    def __init__(self, rule: str, first: np.ndarray):
        self.rule, self.step, self.image = rule, 0, first
        self.renders = welford.init(first)
        self.own = welford.update(welford.init(first), first, first)
        self.variance = np.zeros_like(first)

    def advance(self, F: np.ndarray) -> np.ndarray:
        """Takes the next render; returns the weight that it used."""
        self.step += 1
        var = welford.covariance(self.renders)
        if self.rule == "analytic":
            weight = np.full_like(F, self.step / (self.step + 1))
        else:
            var_cv = welford.covariance(self.own) if self.rule == "online" else self.variance
            weight = statistics.control_weight(var, var, var_cv)
        self.image = advance(self.image, F, F, weight)
        self.renders = welford.update(self.renders, F, F)
        self.own = welford.update(self.own, self.image, self.image)
        var = welford.covariance(self.renders)
        self.variance = statistics.control_variate_variance(weight, var, var, var, self.variance)
        return weight


def one_run(
    problem: ur.Problem, steps: int, spp: int, seed: int
) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Renders (steps, H, W, 3), and per rule the images and the weights (0 at the first step) of the same shape."""
    start = problem.initial()
    session = problem.renderer.prepare(list(start), "path")
    sensor = problem.views[0].sensor
    renders = [
        arrays.numpy(session.image(start, SampleRequest(sensor, spp, Key(seed, step).uint32())).images[0])
        for step in range(steps)
    ]
    renders = np.stack(renders).astype(np.float64)
    images, weights = {}, {}
    for rule in ("analytic", "online", "absolute"):
        simulated = Simulated(rule, renders[0])
        used, kept = [np.zeros_like(renders[0])], [renders[0]]
        for F in renders[1:]:
            used.append(simulated.advance(F))
            kept.append(simulated.image)
        images[rule], weights[rule] = np.stack(kept), np.stack(used)
    images["relative"], weights["relative"] = track(problem, [start] * steps, spp, seed)
    return renders, images, weights


def measure(problem: ur.Problem, steps: int, spp: int, runs: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Everything over independent runs."""
    single = Moments()
    images: dict[str, list[np.ndarray]] = {rule: [] for rule in RULES}
    weights: dict[str, Moments] = {rule: Moments() for rule in RULES}
    spread: dict[str, list[np.ndarray]] = {rule: [] for rule in RULES}
    maps: dict[str, np.ndarray] = {}
    for run in range(runs):
        renders, kept, used = one_run(problem, steps, spp, run)
        for F in renders:
            single.add(F)
        for rule in RULES:
            images[rule].append(kept[rule].astype(np.float32))
            weights[rule].add(used[rule].mean(axis=(1, 2, 3)))
            spread[rule].append(np.percentile(used[rule], [10, 90], axis=(1, 2, 3)))
            if run == 0:
                maps[rule] = used[rule][-1].mean(axis=-1)
        print(f"run {run + 1} of {runs}", flush=True)
    unit, brightness = float(single.variance.sum()), float(single.mean.mean())
    rules = {}
    for rule in RULES:
        stack = np.stack(images[rule]).astype(np.float64)  # (runs, steps, H, W, 3)
        variance = squares(stack) / unit
        extra = (stack[:, -1] - np.stack(images["analytic"])[:, -1]).mean(axis=(1, 2, 3)) / brightness
        rules[rule] = {
            "weight": weights[rule].mean.tolist(),
            "weight_10_90": np.mean(spread[rule], axis=0).tolist(),
            "variance": variance.mean(axis=0).tolist(),
            "variance_error": (variance.std(axis=0, ddof=1) / np.sqrt(runs)).tolist(),
            "bias": float(extra.mean()),
            "bias_error": float(extra.std(ddof=1) / np.sqrt(runs)),
        }
    return rules, maps


def plot(results: dict[str, Any]) -> None:
    """Weights and variance over steps; the last weights of one run as maps."""
    maps = read_maps(HERE)
    mosaic: Any = [["weight"] * 3 + ["variance"] * 3, ["online"] * 2 + ["absolute"] * 2 + ["relative"] * 2]
    figure, axes = plt.subplot_mosaic(
        mosaic,
        figsize=(11, 7.4),
        layout="constrained",
        height_ratios=[1.25, 1],
    )
    steps = np.arange(results["steps"])
    for rule, (label, colour) in RULES.items():
        found = results["rules"][rule]
        style: dict[str, Any] = {"color": colour, "ls": "--" if rule == "analytic" else "-", "label": label}
        axes["weight"].plot(steps, found["weight"], **style)
        if rule != "analytic":
            low, high = np.array(found["weight_10_90"])
            axes["weight"].fill_between(steps, low, high, color=colour, alpha=0.12, lw=0)
        mean, error = np.array(found["variance"]), np.array(found["variance_error"])
        axes["variance"].plot(steps + 1, mean, **style)
        axes["variance"].fill_between(steps + 1, mean - error, mean + error, color=colour, alpha=0.2, lw=0)
    axes["variance"].plot(steps + 1, 1 / (steps + 1), color="#999999", lw=4, alpha=0.5, zorder=0, label="1/(n+1)")
    axes["variance"].plot(
        steps[3:] + 1, 1 / (steps[3:] - 1), color="#999999", ls=":", label="1/(n-1): learns from step 1 on"
    )
    axes["weight"].set(
        xlabel="step n", ylabel="control weight (mean; 10th to 90th percentile)", title="Weights", ylim=(0, 1.02)
    )
    axes["weight"].legend(loc="lower right", fontsize=8)
    title = f"Variance over {results['runs']} runs (band: standard error)"
    axes["variance"].set(xlabel="renders so far, n + 1", ylabel="variance / variance of one render", title=title)
    axes["variance"].set(xscale="log", yscale="log")
    axes["variance"].legend(loc="lower left", fontsize=8)
    drawn = None
    for rule in ("online", "absolute", "relative"):
        drawn = axes[rule].imshow(maps[rule], vmin=0, vmax=1, cmap="viridis")
        mean = results["rules"][rule]["weight"][-1]
        best = results["rules"]["analytic"]["weight"][-1]
        words = f"{RULES[rule][0]}\nlast weights of one run (mean {mean:.3f}; n/(n+1) = {best:.3f})"
        axes[rule].set_title(words, fontsize=8)
        axes[rule].axis("off")
    assert drawn is not None
    figure.colorbar(drawn, ax=[axes[r] for r in ("online", "absolute", "relative")], label="control weight", shrink=0.9)
    figure.suptitle(f"indirect-room, unchanging, {results['resolution']}², {results['spp']} spp a step")
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=48)
    parser.add_argument("--spp", type=int, default=8)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--runs", type=int, default=24)
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        ur.use()
        problem = gallery("indirect-room", asked.resolution, asked.resolution, reference_spp=16)
        rules, maps = measure(problem, asked.steps, asked.spp, asked.runs)
        for rule, found in rules.items():
            at = [n for n in (4, 9, 24, 49) if n < asked.steps]
            words = ", ".join(f"{n}: {found['weight'][n]:.3f}, {found['variance'][n]:.4f}" for n in at)
            bias = f"{found['bias']:+.2%} ± {found['bias_error']:.2%}"
            print(f"{rule}: step: weight, variance: {words}; bias at the last {bias}")
        sizes = {name: getattr(asked, name) for name in ("resolution", "spp", "steps", "runs")}
        write(HERE, {**sizes, "rules": rules})
        write_maps(HERE, maps)
    plot(read(HERE))


if __name__ == "__main__":
    main()
