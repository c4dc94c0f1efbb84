"""What noise does to a loss and its derivative along the extinction of fog (Fig. 6 of the recursive control variates): `three-bodies`.

    python benchmarks/volumes/fig6_landscape/run.py [--resolution 32] [--runs 96] [--factors 11]

The true extinction of the fog times a factor, all else at the truth: the mean over noisy renders of the L1 and the L2 loss, and of their
derivatives by the factor, at 1, 4, 16 and 64 spp; where the mean loss is least, and where the mean derivative is zero, with standard errors
by resampling the runs. A run has the same random numbers at every factor. At factor 1.2, 4 spp, the mean of `unrender.PathGradient` must
agree with the derivative.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from along import converged
from common import read, write
from rcv.fig6_7_loss_bias.landscape import LOSSES, SPP, Values, check, places, plot_landscape, sample, table

import unrender as ur
from unrender.core.trees import Tree

HERE = Path(__file__).resolve().parent
KEY = "fog.interior_medium.sigma_t.value.value"
CHECK_FACTOR, CHECK_SPP = 1.2, 4
DRAWS = 200


def errors(factors: list[float], values: Values) -> dict[str, dict[str, dict[str, float | None]]]:
    """Standard errors of `places`, from runs drawn with replacement; None where half of the draws have no such place."""
    rng = np.random.default_rng(0)
    drawn: list[Any] = []
    for _ in range(DRAWS):
        runs = values["L1"]["1"].shape[1]
        some = rng.integers(runs, size=runs)  # of all factors, whose random numbers are the same
        resampled = {name: {spp: x[:, some] for spp, x in entry.items()} for name, entry in values.items()}
        drawn.append(places(factors, resampled))

    def error(*path: str) -> float | None:
        name, spp, what = path
        found = [one[name][spp][what] for one in drawn if one[name][spp][what] is not None]
        return float(np.std(found, ddof=1)) if 2 * len(found) > DRAWS else None

    return {
        name: {str(spp): {what: error(name, str(spp), what) for what in ("least", "stop")} for spp in SPP}
        for name in LOSSES
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=32)
    parser.add_argument("--runs", type=int, default=96)
    parser.add_argument("--factors", type=int, default=11, help="points between 0.5 and 1.5")
    parser.add_argument("--reference-spp", type=int, default=16384)
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        ur.use()
        made = ur.gallery.problem("three-bodies", resolution=asked.resolution, reference_spp=1)
        fog = [ur.Parameter(p.key) for p in made.parameters if p.key == KEY]
        problem = ur.Problem(made.renderer, fog, made.given_views, made.loss, made.max_depth, name="three-bodies")
        truth = np.asarray(made.truth[KEY])

        def at(factor: float) -> Tree:
            return {KEY: problem.renderer.array(factor * truth)}

        factors = np.linspace(0.5, 1.5, asked.factors).tolist()
        reference = converged(problem, at(1.0), asked.reference_spp).mean
        values = sample(problem, at, factors, asked.runs, reference, asked.reference_spp // 8, common=True)
        checked = check(problem, at(CHECK_FACTOR), {KEY: truth}, reference, CHECK_SPP, 4 * asked.runs)
        found = {"factors": factors, "table": table(values), "places": places(factors, values), "check": checked}
        write(HERE, {"settings": vars(asked), **found, "errors": errors(factors, values)})
        for name in LOSSES:
            for spp in map(str, SPP):
                print(name, spp, found["places"][name][spp])
            row = found["table"][name][str(CHECK_SPP)][int(np.argmin(np.abs(np.array(factors) - CHECK_FACTOR)))]
            print(f"{name}: PathGradient {checked[name]}, landscape {row[2:]}")
    results = read(HERE)
    figure = plt.figure(figsize=(11, 7.5), layout="constrained")
    plot_landscape(figure.subplots(2, 2), results, "the fog's extinction")
    settings = results["settings"]
    figure.suptitle(
        f"three-bodies, {settings['resolution']}², mean of {settings['runs']} renders (bars: standard errors)"
    )
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


if __name__ == "__main__":
    main()
