"""What noise does to a loss and to its derivative (paper Figs 6 and 7).

    python benchmarks/rcv/fig6_7_loss_bias/run.py [--resolution 40] [--runs 24]

Fig. 6: `indirect-room` with one unknown, a factor on the back wall's albedo, whose true value is 1. The mean over
noisy renders of the L1 and the L2 loss, and of their derivatives by the factor, at 1, 4, 16 and 64 spp: where the
loss is least, and where a descent would stop. The derivative is the mean of loss' (noisy image) · dI/dfactor, the two
from independent samples as in Eqs 12 and 13; dI/dfactor is a central difference of converged images on shared paths.
At factor 1.2, 4 spp, the mean of `unrender.PathGradient` (path replay) must agree.

Fig. 7: the derivative of the loss by each pixel at step 20 of a real descent, seen by a plain render and by a control
variate that took the same 20 steps; mean over runs less the derivative at a converged image, its mean square freed of
the runs' noise, and the variance. Derivatives are per pixel, times the number of pixels and channels, so that L1's
are ±1.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from along import Moments, converged, descent, follow, gallery, paired_bias, read_maps, write_maps
from common import read, write
from rcv.fig6_7_loss_bias.landscape import LOSSES, check, places, plot_landscape, sample, table

import unrender as ur
from unrender.core import arrays
from unrender.core.trees import Tree

HERE = Path(__file__).resolve().parent
KEY = "back.bsdf.reflectance.data"
TRUE_SCALE = 0.7
"""The true wall is this share of the photograph, so that factors up to 1.4 keep its albedo below 1."""
CHECK_FACTOR, CHECK_SPP = 1.2, 4


def at(problem: ur.Problem, factor: float) -> Tree:
    """The parameters at a factor of the true wall."""
    return {KEY: problem.renderer.array(factor * TRUE_SCALE * problem.truth[KEY])}


def by_factor(problem: ur.Problem, factors: np.ndarray, runs: int, reference_spp: int) -> dict[str, Any]:
    """Loss and derivative at every factor, sample count and loss, with standard errors over runs."""

    def state(factor: float) -> Tree:
        return at(problem, factor)

    reference = converged(problem, state(1.0), reference_spp).mean
    values = sample(problem, state, factors.tolist(), runs, reference, reference_spp // 4)
    along = {KEY: TRUE_SCALE * problem.truth[KEY]}
    checked = check(problem, state(CHECK_FACTOR), along, reference, CHECK_SPP, 4 * runs)
    found = {"factors": factors.tolist(), "table": table(values), "places": places(factors.tolist(), values)}
    return {**found, "check": checked}


def derivatives(
    problem: ur.Problem, steps: int, spp: int, runs: int, reference_spp: int
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Fig. 7: numbers per loss and method, and maps."""
    path = descent(problem, ur.PathGradient(spp=16), 0.02, steps + 1)
    target = converged(problem, {KEY: problem.renderer.array(problem.truth[KEY])}, reference_spp).mean
    image = converged(problem, path[-1], reference_spp, seed=123_456).mean
    methods = {"plain": ur.images.Plain(), "rcv": ur.images.RecursiveControlVariate()}
    moments = {(loss, method): Moments() for loss in LOSSES for method in methods}
    variance = {method: Moments() for method in methods}
    maps: dict[str, np.ndarray] = {}
    for method, estimator in methods.items():
        taken = path if method == "rcv" else path[-1:]  # a plain render knows nothing of the steps before
        for run in range(runs):
            *_, last = follow(problem, estimator, taken, spp, run)
            noisy = arrays.numpy(last.mean()).astype(np.float64)
            variance[method].add(noisy)
            for name, loss in LOSSES.items():
                slope = loss.derivative(noisy, target)
                moments[name, method].add(slope - loss.derivative(image, target))
                if run == 0:
                    maps[f"{name}/{method}"] = slope.mean(axis=-1)
    result: dict[str, Any] = {}
    for name, loss in LOSSES.items():
        reference = loss.derivative(image, target)
        scale = float(np.abs(reference).mean())
        maps[f"{name}/reference"] = reference.mean(axis=-1)
        result[name] = {"scale": scale}
        for method in methods:
            found = moments[name, method]
            spread = float(found.variance.mean() / scale**2)
            result[name][method] = {**paired_bias(found, scale), "variance": spread}
            maps[f"{name}/{method}/bias"] = found.mean.mean(axis=-1)
    gain = float(variance["plain"].variance.sum() / variance["rcv"].variance.sum())
    return {"losses": result, "image_variance_ratio": gain}, maps


def report(results: dict[str, Any]) -> None:
    """Both figures in words."""
    fig6, fig7 = results["fig6"], results["fig7"]
    for name, entry in fig6["places"].items():
        for spp, place in entry.items():
            words = {what: "outside the range" if x is None else f"{x:.3f}" for what, x in place.items()}
            print(f"{name}, {spp} spp: loss least at factor {words['least']}, derivative 0 at {words['stop']}")
        mean, error = fig6["check"][name]
        print(f"{name}: PathGradient at factor {CHECK_FACTOR}, {CHECK_SPP} spp: {mean:.5f} ± {error:.5f}")
        row = next((n for n, x in enumerate(fig6["factors"]) if abs(x - CHECK_FACTOR) < 1e-6), None)
        if row is not None:
            _, _, mean, error = fig6["table"][name][str(CHECK_SPP)][row]
            print(f"{name}: the landscape's there: {mean:.5f} ± {error:.5f}")
    for name, entry in fig7["losses"].items():
        for method in ("plain", "rcv"):
            found = entry[method]
            print(
                f"{name}' at step {results['step']}, {method}: "
                f"bias {found['signed']:+.2%} ± {found['signed_error']:.2%}, rms {found['rms']:.2%}, "
                f"variance {found['variance']:.3g} (all relative to the mean of |derivative|)"
            )
    print(f"image variance, plain / control variate: {fig7['image_variance_ratio']:.1f}")


def plot_derivatives(axes: Any, figure: Any, results: dict[str, Any]) -> None:
    """Two rows (losses) of derivative images."""
    maps = read_maps(HERE)
    for row, name in zip(axes, LOSSES, strict=True):
        top = 1.0 if name == "L1" else float(np.quantile(np.abs(maps[f"{name}/reference"]), 0.98))
        entry = results["fig7"]["losses"][name]
        titles = {
            "reference": f"∂{name}, converged",
            "plain": f"plain, {results['spp']} spp, one run",
            "rcv": "control variate, one run",
            "plain/bias": f"plain: bias {entry['plain']['signed']:+.1%}, rms {entry['plain']['rms']:.1%}",
            "rcv/bias": f"control v.: bias {entry['rcv']['signed']:+.1%}, rms {entry['rcv']['rms']:.1%}",
        }
        drawn = None
        for axis, (what, title) in zip(row, titles.items(), strict=True):
            drawn = axis.imshow(maps[f"{name}/{what}"], vmin=-top, vmax=top, cmap="RdBu_r")
            variance = f"\nvariance {entry[what]['variance']:.3g}" if what in entry else "\nmean of runs less converged"
            axis.set_title(title + (variance if what != "reference" else ""), fontsize=8)
            axis.axis("off")
        assert drawn is not None
        figure.colorbar(drawn, ax=list(row), label=f"∂{name}/∂pixel (per pixel)", shrink=0.9)


def plot(results: dict[str, Any]) -> None:
    """Fig. 6 above, Fig. 7 below."""
    whole = plt.figure(figsize=(12.5, 13), layout="constrained")
    halves: Any = whole.subfigures(2, 1, height_ratios=[1.3, 1])
    above, below = halves
    plot_landscape(above.subplots(2, 2), results["fig6"], "the wall's albedo")
    above.suptitle(
        f"Fig. 6: indirect-room, {results['resolution']}², mean of {results['runs']} renders (± standard error)"
    )
    plot_derivatives(below.subplots(2, 5), below, results)
    words = "bias and variance relative to the mean of |derivative| and its square"
    below.suptitle(
        f"Fig. 7: derivative of the loss at step {results['step']} of a descent, {results['runs']} runs; {words}"
    )
    whole.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=40)
    parser.add_argument("--runs", type=int, default=24)
    parser.add_argument("--spp", type=int, default=4, help="of Fig. 7")
    parser.add_argument("--step", type=int, default=20, help="of Fig. 7")
    parser.add_argument("--factors", type=int, default=13, help="points between 0.6 and 1.4")
    parser.add_argument("--reference-spp", type=int, default=8192)
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        ur.use()
        problem = gallery("indirect-room", asked.resolution, asked.resolution, loss="L1")
        landscape = by_factor(problem, np.linspace(0.6, 1.4, asked.factors), asked.runs, asked.reference_spp)
        fig7, maps = derivatives(problem, asked.step, asked.spp, asked.runs, asked.reference_spp)
        sizes = {k: getattr(asked, k) for k in ("resolution", "runs", "spp", "step", "reference_spp")}
        results = {**sizes, "fig6": landscape, "fig7": fig7}
        report(results)
        write(HERE, results)
        write_maps(HERE, maps)
    plot(read(HERE))


if __name__ == "__main__":
    main()
