"""How many more samples the picture needs without its control variate (Fig. 11 of the recursive control variates): `smoke`, L1.

    python benchmarks/volumes/fig11_smoke/run.py [--budget steps] [--steps 300] [--seconds 10] [--seeds 2] [--resolution 24] [--grid 16]

Differential ratio tracking with 1 adjoint path per pixel throughout; the picture with 1 to 32 paths per pixel without a control
variate, 1 and 2 with one. Adam, its learning rates tuned per method on a seed of its own for the whole budget: the albedo's, extinction's
being 10 times that. At equal steps, and some of them at equal time.

Errors are root mean squares relative to where the descent began, of extinction and of the scattering coefficient (extinction times
albedo), averaged: the albedo of empty voxels shows in no picture. "needs" says how many samples a plain picture needs for the error that
a control variate leaves: between the two neighbours in spp, along a line in logarithms.
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
from judged import at, compete
from races import Entrant, colours, draw
from smoke_error import measure

import unrender as ur

HERE = Path(__file__).resolve().parent
PLAIN, WITH = {"steps": (1, 2, 4, 8, 16, 32), "time": (1, 4, 16)}, (1, 2)
RATES = {"steps": (0.001, 0.0018, 0.003), "time": (0.001, 0.003)}


def entrants(budget: str) -> list[Entrant]:
    """Who races: the picture's samples differ, the derivative's do not."""
    adam, cv = at(ur.optimizers.Adam), ur.images.RecursiveControlVariate
    plain = [
        Entrant(f"plain, {n}", "plain", ur.PathGradient(spp=n, adjoint_spp=1), adam, RATES[budget])
        for n in PLAIN[budget]
    ]
    return plain + [
        Entrant(f"rcv, {n}", "rcv", ur.PathGradient(cv(), spp=n, adjoint_spp=1), adam, RATES[budget]) for n in WITH
    ]


def needs(found: dict[str, Any], name: str) -> dict[str, Any]:
    """Plain samples for the final error of "rcv, n": {"spp": ..., "times": spp / n}; "more_than" where no plain one reaches it."""
    spp = sorted(int(other.split(", ")[1]) for other in found if other.startswith("plain"))
    errors = [found[f"plain, {n}"]["final"]["both"][0] for n in spp]
    goal, own = found[name]["final"]["both"][0], int(name.split(", ")[1])
    first = next((i for i, error in enumerate(errors) if error <= goal), None)
    if first is None:
        return {"more_than": spp[-1], "times": spp[-1] / own}
    if first == 0:
        return {"spp": spp[0], "times": spp[0] / own}
    low, high = np.log(errors[first - 1]), np.log(errors[first])
    share = (low - np.log(goal)) / (low - high)
    between = float(np.exp(np.log(spp[first - 1]) + share * np.log(spp[first] / spp[first - 1])))
    return {"spp": between, "least": spp[first], "times": between / own}


def plot(results: dict[str, Any]) -> None:
    """Final errors by samples, and error along the descents."""
    budgets = [budget for budget in PLAIN if budget in results]
    figure, axes = plt.subplots(1, 1 + len(budgets), figsize=(5 * (1 + len(budgets)), 4.3), layout="constrained")
    found = results[budgets[0]]
    plain = [name for name in found if name.startswith("plain")]
    spp = [int(name.split(", ")[1]) for name in plain]
    middle, low, high = np.array([found[name]["final"]["both"] for name in plain]).T
    axes[0].errorbar(spp, middle, [middle - low, high - middle], marker="o", color="#d1782a", label="plain")
    blues = {"rcv, 1": "#1f6fb4", "rcv, 2": "#7fb2dd"}
    for name, blue in blues.items():
        axes[0].axhline(found[name]["final"]["both"][0], color=blue, label=name)
    axes[0].set(title=f"equal {budgets[0]}: error at the end", xlabel="paths per pixel of the picture", xscale="log")
    axes[0].set_xticks(spp, [str(n) for n in spp])
    axes[0].legend(fontsize=8)
    shades = dict(zip((f"plain, {n}" for n in PLAIN["steps"]), colours(len(PLAIN["steps"])), strict=True)) | blues
    for axis, budget in zip(axes[1:], budgets, strict=True):
        for name, entry in results[budget].items():
            if name in shades:
                curves = {"runs": entry["runs"]["both"]}
                draw(axis, curves, 0, shades[name], f"{name}: {entry['final']['both'][0]:.3f}")
        axis.set(title=f"equal {budget}", xlabel="seconds", ylabel="error / initial")
        axis.legend(fontsize=7)
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--budget", choices=list(PLAIN), action="append", help="this alone; the other's figures stay")
    parser.add_argument("--only", action="append", help="these entrants alone; others' figures stay")
    parser.add_argument("--resolution", type=int, default=24)
    parser.add_argument("--grid", type=int, default=16)
    asked = parser.parse_args()
    ur.use()
    problem = ur.gallery.problem("smoke", resolution=asked.resolution, grid_resolution=asked.grid, reference_spp=4096)
    found: dict[str, Any] = read(HERE) if (HERE / "results.json").is_file() else {}
    settings = {name: getattr(asked, name) for name in ("seconds", "steps", "seeds", "resolution", "grid")}
    if found.get("settings") != settings:
        found = {"settings": settings}
    for budget in asked.budget or PLAIN:
        limit = {"seconds": asked.seconds} if budget == "time" else {"steps": asked.steps}
        for entrant in entrants(budget):
            if entrant.name in (asked.only or [entrant.name]):
                entry = compete(problem, entrant, measure(problem), "both", asked.seeds, **limit)
                found.setdefault(budget, {})[entrant.name] = entry
        names = [entrant.name for entrant in entrants(budget)]
        if budget == "steps" and all(name in found[budget] for name in names):
            found["needs"] = {f"rcv, {n}": needs(found[budget], f"rcv, {n}") for n in WITH}
        found[budget] = {name: found[budget][name] for name in names if name in found[budget]}
    write(HERE, found)
    results = read(HERE)
    if "needs" in results:
        print(results["needs"])
        plot(results)


if __name__ == "__main__":
    main()
