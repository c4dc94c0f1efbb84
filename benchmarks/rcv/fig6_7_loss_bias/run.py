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
from matplotlib.lines import Line2D

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from along import Moments, converged, descent, follow, gallery, paired_bias, read_maps, write_maps
from common import read, write

import unrender as ur
from unrender import arrays
from unrender.keys import Key
from unrender.losses import Loss
from unrender.rendering.port import Shot
from unrender.trees import Tree

HERE = Path(__file__).resolve().parent
KEY = "back.bsdf.reflectance.data"
TRUE_SCALE = 0.7
"""The true wall is this share of the photograph, so that factors up to 1.4 keep its albedo below 1."""
SPP = (1, 4, 16, 64)
LOSSES: dict[str, Loss] = {"L1": ur.losses.L1(), "L2": ur.losses.L2()}
CHECK_FACTOR, CHECK_SPP = 1.2, 4


def at(problem: ur.Problem, factor: float) -> Tree:
    """The parameters at a factor of the true wall."""
    return {KEY: problem.renderer.array(factor * TRUE_SCALE * problem.truth[KEY])}


def slopes(problem: ur.Problem, factor: float, spp: int, change: float = 0.02) -> np.ndarray:
    """dI/dfactor, (H, W, 3), on paths that both sides share."""
    higher, lower, found = at(problem, factor + change), at(problem, factor - change), Moments()
    problem.renderer.select([KEY], "path")
    for number in range(max(1, spp // 64)):
        shot = Shot(problem.views[0].sensor, 64, Key(31_337, number).uint32())
        pair = problem.renderer.image_pair(higher, lower, shot, "path")
        assert pair.previous is not None
        found.add((arrays.numpy(pair.images[0]) - arrays.numpy(pair.previous[0])) / (2 * change))
    return found.mean


def landscape(problem: ur.Problem, factors: np.ndarray, runs: int, reference_spp: int) -> dict[str, Any]:
    """Loss and derivative at every factor, sample count and loss, with standard errors over runs."""
    reference = converged(problem, at(problem, 1.0), reference_spp).mean
    table: dict[str, Any] = {name: {str(spp): [] for spp in SPP} for name in LOSSES}
    for index, factor in enumerate(factors):
        parameters, slope = at(problem, float(factor)), slopes(problem, float(factor), reference_spp // 4)
        problem.renderer.select([KEY], None)
        for spp in SPP:
            seen: dict[str, list[tuple[float, float]]] = {name: [] for name in LOSSES}
            for run in range(runs):
                shot = Shot(problem.views[0].sensor, spp, Key(run, index, spp).uint32())
                image = arrays.numpy(problem.renderer.image(parameters, shot).images[0]).astype(np.float64)
                for name, loss in LOSSES.items():
                    value, derivative = loss.value(image, reference), loss.derivative(image, reference) * slope
                    seen[name].append((float(value.mean()), float(derivative.mean())))
            for name, values in seen.items():
                mean, error = np.mean(values, axis=0), np.std(values, axis=0, ddof=1) / np.sqrt(runs)
                table[name][str(spp)].append([mean[0], error[0], mean[1], error[1]])
        print(f"factor {factor:.2f}", flush=True)
    places = {
        name: {
            spp: {"least": least(factors, np.array(rows)[:, 0]), "stop": stop(factors, np.array(rows)[:, 2])}
            for spp, rows in entry.items()
        }
        for name, entry in table.items()
    }
    return {"factors": factors.tolist(), "table": table, "places": places, "check": check(problem, runs, reference)}


def least(x: np.ndarray, y: np.ndarray) -> float | None:
    """Where a curve is least, by a parabola through its lowest point's neighbours; None at an end."""
    n = int(np.argmin(y))
    if n in (0, len(x) - 1):
        return None
    a, b, _ = np.polyfit(x[n - 1 : n + 2], y[n - 1 : n + 2], 2)
    return float(-b / (2 * a))


def stop(x: np.ndarray, y: np.ndarray) -> float | None:
    """Where a derivative crosses from below 0 to above, and a descent stops; None if it does not."""
    for n in range(len(x) - 1):
        if y[n] < 0 <= y[n + 1]:
            return float(x[n] - y[n] * (x[n + 1] - x[n]) / (y[n + 1] - y[n]))
    return None


def check(problem: ur.Problem, runs: int, reference: np.ndarray) -> dict[str, list[float]]:
    """The same derivative by the library's own estimator at one place: mean and standard error, per loss."""
    found: dict[str, list[float]] = {}
    for name, loss in LOSSES.items():
        posed = ur.Problem(problem.renderer, problem.parameters, [ur.View(reference.astype(np.float32))], loss=loss)
        estimator = ur.PathGradient(spp=CHECK_SPP, adjoint_spp=CHECK_SPP)
        parameters = at(problem, CHECK_FACTOR)
        state, values = estimator.init(posed, parameters), []
        for run in range(4 * runs):
            estimate, _ = estimator.estimate(posed, parameters, state, Key(run, 0, 99))
            values.append(float(np.sum(arrays.numpy(estimate.gradient[KEY]) * TRUE_SCALE * problem.truth[KEY])))
        found[name] = [float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))]
    return found


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


def plot_landscape(axes: Any, fig6: dict[str, Any]) -> None:
    """Two rows (losses) of loss and derivative."""
    factors = np.array(fig6["factors"])
    colours = dict(zip(map(str, SPP), ("#c0392b", "#d1782a", "#4a9c6d", "#1f6fb4"), strict=True))
    for row, name in zip(axes, LOSSES, strict=True):
        for spp, colour in colours.items():
            rows = np.array(fig6["table"][name][spp])
            place = fig6["places"][name][spp]
            for axis, column, where in ((row[0], 0, place["least"]), (row[1], 2, place["stop"])):
                axis.errorbar(factors, rows[:, column], rows[:, column + 1], color=colour, label=f"{spp} spp", lw=1.4)
                if where is not None:
                    y = 0.0 if column else np.interp(where, factors, rows[:, column])
                    axis.plot([where], [y], "x", color=colour, ms=9, mew=2.5, zorder=5)
        row[1].axhline(0.0, color="black", lw=0.7)
        for axis in row:
            axis.axvline(1.0, color="black", lw=0.7, ls=":")
            axis.set_xlabel("factor on the wall's albedo (truth 1)")
        row[0].set(title=f"{name}: mean loss (× least)", ylabel="loss", yscale="log")
        row[1].set(title=f"{name}: mean derivative (× where a descent stops)", ylabel="d loss / d factor")
        row[0].margins(y=0.2)
        row[0].legend(fontsize=8, ncols=4, loc="upper left")
        missing = [spp for spp in colours if fig6["places"][name][spp]["stop"] is None]
        if missing:
            handle = Line2D([], [], color="none", label=f"no stop in this range: {', '.join(missing)} spp")
            row[1].legend(handles=[handle], fontsize=8, loc="upper left", handlelength=0)


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
    plot_landscape(above.subplots(2, 2), results["fig6"])
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
        fig6 = landscape(problem, np.linspace(0.6, 1.4, asked.factors), asked.runs, asked.reference_spp)
        fig7, maps = derivatives(problem, asked.step, asked.spp, asked.runs, asked.reference_spp)
        sizes = {k: getattr(asked, k) for k in ("resolution", "runs", "spp", "step", "reference_spp")}
        results = {**sizes, "fig6": fig6, "fig7": fig7}
        report(results)
        write(HERE, results)
        write_maps(HERE, maps)
    plot(read(HERE))


if __name__ == "__main__":
    main()
