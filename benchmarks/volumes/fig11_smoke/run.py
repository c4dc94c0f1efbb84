"""How many more samples the picture needs without its control variate (Fig. 11 of the recursive control variates): `smoke`, L1.

    python benchmarks/volumes/fig11_smoke/run.py [--budget steps] [--steps 150] [--seconds 12] [--seeds 2] [--resolution 32] [--grid 16]

Differential ratio tracking with 1 adjoint path per pixel throughout; the picture with 1, 4, 8 and 16 paths per pixel without a control
variate, and 1 with one. Adam, its learning rate tuned per method on a seed of its own for the whole budget. Error is each
grid's RMSE relative to where it began, averaged over the two grids, at equal time and at equal steps.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import read, write
from races import Entrant, colours, draw, race

import unrender as ur

HERE = Path(__file__).resolve().parent
PLAIN, WITH = (1, 4, 8, 16), (1,)
RATES = (0.01, 0.03)
BUDGETS = ("time", "steps")


def entrants() -> list[Entrant]:
    """Who races: the picture's samples differ, the derivative's do not."""
    adam, cv = ur.optimizers.Adam, ur.images.RecursiveControlVariate
    plain = [Entrant(f"plain, {n}", "plain", ur.PathGradient(spp=n, adjoint_spp=1), adam, RATES) for n in PLAIN]
    return plain + [Entrant(f"rcv, {n}", "rcv", ur.PathGradient(cv(), spp=n, adjoint_spp=1), adam, RATES) for n in WITH]


def plot(results: dict[str, Any]) -> None:
    """Error over time and over steps."""
    budgets = [budget for budget in BUDGETS if budget in results]
    figure, axes = plt.subplots(1, len(budgets), figsize=(6 * len(budgets), 4.5), squeeze=False, layout="constrained")
    shades = dict(zip((f"plain, {n}" for n in PLAIN), colours(len(PLAIN)), strict=True))
    for axis, budget in zip(axes[0], budgets, strict=True):
        for name, entry in results[budget].items():
            draw(
                axis,
                entry,
                0,
                shades.get(name, "#1f6fb4" if name == "rcv, 1" else "#7fb2dd"),
                f"{name}: {entry['final'][0]:.3f}",
            )
        axis.set(title=f"equal {budget}", xlabel="seconds", ylabel="parameter error / initial", yscale="log")
        axis.legend(fontsize=7)
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument(
        "--budget", choices=list(BUDGETS), action="append", help="run this again, keep the other's figures"
    )
    parser.add_argument("--resolution", type=int, default=32)
    parser.add_argument("--grid", type=int, default=16)
    asked = parser.parse_args()
    ur.use()
    problem = ur.gallery.problem("smoke", resolution=asked.resolution, grid_resolution=asked.grid, reference_spp=4096)
    found: dict[str, Any] = read(HERE) if (HERE / "results.json").is_file() else {}
    found["settings"] = vars(asked)
    for budget in asked.budget or BUDGETS:
        limit = {"seconds": asked.seconds} if budget == "time" else {"steps": asked.steps}
        found[budget] = race(problem, entrants(), asked.seeds, **limit)
    write(HERE, found)
    plot(read(HERE))


if __name__ == "__main__":
    main()
