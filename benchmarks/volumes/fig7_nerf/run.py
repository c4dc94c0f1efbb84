"""Meta-estimation of a radiance field at equal time (Figs 7 and 8 of its paper): `nerf-volume`, without coarse to fine.

    python benchmarks/volumes/fig7_nerf/run.py [--seconds 12] [--seeds 2] [--grid 64] [--resolution 64] [--schedule falling] [--only meta]

Adam on plain gradients at 2, 4 and 8 samples per pixel, against meta-estimation with MetaAdam in the paper's form (1 difference,
2 proportional samples), in the coupled one, and in that on a control variate's images; two of them with more samples as well. Each is
tuned on a seed of its own for the whole budget: the emission's learning rate, extinction's being 20 times that; constant, or falling
along half a cosine over the steps that fit into the budget.

The field has no truth, so errors are of pictures: root mean square over the 8 views that the descent sees, and over 4 between them that it
does not, relative to where it began. They are free of rendering noise: products of two independent renders' differences. Tuned is by
the views seen.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import read, write
from judged import at, compete, follow
from races import TUNING_SEED, Entrant, colours, draw

import unrender as ur
from unrender.core import arrays
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.estimators.base import Estimator
from unrender.rendering.renderer import SampleRequest
from unrender.schedules.functions import Constant, Cosine, Schedule

HERE = Path(__file__).resolve().parent
SPP = (2, 4, 8)
VIEWS = 12
GRID = 64
UNSEEN = (1, 4, 7, 10)
RATES = {
    ("Adam", "constant"): (0.01, 0.02, 0.04),
    ("meta", "constant"): (0.005, 0.01, 0.02),
    ("Adam", "falling"): (0.02, 0.04, 0.08),
    ("meta", "falling"): (0.01, 0.02, 0.04),
}
SCHEDULES = ("constant", "falling")
FLOOR = 0.05
GREENS = ("#8fd3aa", "#1a8f4c", "#7fb2dd", "#5b7f3a", "#1f6fb4")


def entrants(kind: str, schedule: Schedule) -> list[Entrant]:
    """Who races, by a kind of schedule."""

    adam, meta = at(ur.optimizers.Adam, schedule), at(ur.optimizers.MetaAdam, schedule)
    control = ur.images.RecursiveControlVariate()
    others: dict[str, Estimator] = {
        "meta": ur.MetaEstimator(),
        "coupled, 3 spp": ur.MetaEstimator(coupled=True, spp=3),
        "coupled on rcv, 3 spp": ur.MetaEstimator(coupled=True, spp=3, image=control),
        "meta, 8 and 4 spp": ur.MetaEstimator(proportional_spp=8, difference_spp=4),
        "coupled on rcv, 8 spp": ur.MetaEstimator(coupled=True, spp=8, image=control),
    }
    found = [Entrant(f"Adam, {n} spp", "Adam", ur.PathGradient(spp=n), adam, RATES["Adam", kind]) for n in SPP]
    return found + [Entrant(name, "meta", estimator, meta, RATES["meta", kind]) for name, estimator in others.items()]


class Pictures:
    """How far pictures of all views are from their references, relative to the start; by a renderer of its own."""

    def __init__(self, made: ur.Problem, options: dict[str, Any], spp: int = 16):
        renderer = ur.gallery.problem("nerf-volume", **{**options, "reference_spp": 1}).renderer
        self.session = renderer.prepare(list(made.initial()), None)
        self.references = [np.asarray(view.reference, np.float64) for view in made.views]
        self.sensors, self.spp = [view.sensor for view in made.views], spp
        self.start = self.errors(made.initial())

    def __call__(self, parameters: Tree) -> dict[str, float]:
        return {name: error / self.start[name] for name, error in self.errors(parameters).items()}

    def errors(self, parameters: Tree) -> dict[str, float]:
        """Root mean square over the views "seen", and over those "unseen"."""
        squares: dict[str, list[float]] = {"seen": [], "unseen": []}
        for number, (sensor, reference) in enumerate(zip(self.sensors, self.references, strict=True)):
            request = SampleRequest(sensor, self.spp, Key(424_242, number).uint32(), 2)
            a, b = arrays.numpy(self.session.image(parameters, request).images).astype(np.float64) - reference
            squares["unseen" if number in UNSEEN else "seen"].append(float(np.mean(a * b)))
        return {name: max(float(np.mean(x)), 0.0) ** 0.5 for name, x in squares.items()}


def run(problem: ur.Problem, pictures: Pictures, name: str, kind: str, seconds: float, seeds: int) -> dict[str, Any]:
    """One entrant's figures."""

    def entrant(schedule: Schedule) -> Entrant:
        return next(e for e in entrants(kind, schedule) if e.name == name)

    # Compiles and records what is left after a warm-up, watched as the runs are, and tells what a step takes.
    trial = entrant(Constant())
    watch = follow(problem, trial, pictures, trial.rates[0], TUNING_SEED, 0.2, steps=15)
    clocks = [seconds for seconds, _, _ in watch.points["seen"]]
    steps = max(1, round(seconds * 6 / (clocks[-1] - clocks[-3])))
    schedule = Constant() if kind == "constant" else Cosine(steps, FLOOR)
    return compete(problem, entrant(schedule), pictures, "seen", seeds, seconds=seconds)


def plot(folder: Path, results: dict[str, Any]) -> None:
    """Errors over time: a row per schedule; seen and unseen views."""
    kinds = [kind for kind in SCHEDULES if kind in results["schedules"]]
    figure, axes = plt.subplots(
        len(kinds), 2, figsize=(11, 4.2 * len(kinds)), squeeze=False, sharey=True, layout="constrained"
    )
    names = [entrant.name for entrant in entrants(SCHEDULES[0], Constant())]
    shades = dict(zip(names, [*colours(len(SPP)), *GREENS], strict=True))
    for row, kind in zip(axes, kinds, strict=True):
        found = results["schedules"][kind]
        for axis, views in zip(row, ("seen", "unseen"), strict=True):
            for name in (name for name in names if name in found):
                curves = {"runs": found[name]["runs"][views]}
                draw(axis, curves, 0, shades[name], f"{name}: {found[name]['final'][views][0]:.3f}")
            axis.set(
                title=f"{kind} rates, views {views}",
                xlabel="seconds",
                ylabel="error of pictures / initial",
                yscale="log",
            )
            axis.legend(fontsize=8)
    figure.savefig(folder / "figure.png", dpi=110)
    print(f"wrote {folder / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--grid", type=int, default=GRID, help="others than 64 have a folder of their own")
    parser.add_argument("--schedule", choices=SCHEDULES, action="append", help="these alone; others' figures stay")
    parser.add_argument("--only", action="append", help="these entrants alone; others' figures stay")
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    folder = HERE if asked.grid == GRID else HERE / f"grid{asked.grid}"
    if asked.plot_only:
        plot(folder, read(folder))
        return
    ur.use()
    options = {"resolution": asked.resolution, "grid_resolution": asked.grid, "views": VIEWS, "reference_spp": 1024}
    made = ur.gallery.problem("nerf-volume", **options)
    views = [view for number, view in enumerate(made.given_views) if number not in UNSEEN]
    problem = ur.Problem(made.renderer, made.parameters, views, made.loss, made.max_depth, name="nerf-volume")
    pictures = Pictures(made, options)
    found: dict[str, Any] = read(folder) if (folder / "results.json").is_file() else {}
    settings = {name: getattr(asked, name) for name in ("seconds", "seeds", "resolution", "grid")}
    for kind in asked.schedule or SCHEDULES:
        if found.setdefault("settings", {}).get(kind, settings) != settings:
            found["schedules"][kind] = {}
        found["settings"][kind] = settings
        names = [
            entrant.name
            for entrant in entrants(SCHEDULES[0], Constant())
            if entrant.name in (asked.only or [entrant.name])
        ]
        for name in names:
            entry = run(problem, pictures, name, kind, asked.seconds, asked.seeds)
            found.setdefault("schedules", {}).setdefault(kind, {})[name] = entry
            write(folder, found)
    plot(folder, read(folder))


if __name__ == "__main__":
    main()
