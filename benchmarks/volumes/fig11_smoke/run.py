"""How many more samples the picture needs without its control variate (Fig. 11 of the recursive control variates): `smoke`, L1.

    python benchmarks/volumes/fig11_smoke/run.py [--seconds 30] [--seeds 3] [--resolution 32] [--grid 16]

Differential ratio tracking with 1 adjoint path per pixel throughout; the picture with 1, 2, 4, 8, 16 and 32 paths per pixel without a
control variate, and 1 and 2 with one. Adam, its learning rate tuned per method on a seed of its own for the whole budget. Error is each
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
PLAIN, WITH = (1, 2, 4, 8, 16, 32), (1, 2)
RATES = (0.01, 0.03)


def entrants() -> list[Entrant]:
    """Who races: the picture's samples differ, the derivative's do not."""
    adam, cv = ur.optimizers.Adam, ur.images.RecursiveControlVariate
    plain = [Entrant(f"plain, {n}", "plain", ur.PathGradient(spp=n, adjoint_spp=1), adam, RATES) for n in PLAIN]
    return plain + [Entrant(f"rcv, {n}", "rcv", ur.PathGradient(cv(), spp=n, adjoint_spp=1), adam, RATES) for n in WITH]


def plot(results: dict[str, Any]) -> None:
    """Error over time and over steps."""
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.5), layout="constrained")
    shades = dict(zip((f"plain, {n}" for n in PLAIN), colours(len(PLAIN)), strict=True))
    for axis, budget in zip(axes, ("time", "steps"), strict=True):
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
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--resolution", type=int, default=32)
    parser.add_argument("--grid", type=int, default=16)
    asked = parser.parse_args()
    ur.use()
    problem = ur.gallery.problem("smoke", resolution=asked.resolution, grid_resolution=asked.grid, reference_spp=4096)
    found = {
        "settings": vars(asked),
        "time": race(problem, entrants(), asked.seeds, seconds=asked.seconds),
        "steps": race(problem, entrants(), asked.seeds, steps=asked.steps),
    }
    write(HERE, found)
    plot(read(HERE))


if __name__ == "__main__":
    main()
