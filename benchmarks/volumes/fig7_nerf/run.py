"""Meta-estimation of a radiance field at equal time (Figs 7 and 8 of its paper): `nerf-volume`, without coarse to fine.

    python benchmarks/volumes/fig7_nerf/run.py [--seconds 15] [--seeds 2] [--grid 64] [--resolution 32]

Adam on plain gradients at 2, 4 and 8 samples per pixel, against meta-estimation with MetaAdam in the paper's form (1 difference,
2 proportional samples) and in the coupled one. The learning rate of each is tuned on a seed of its own for the whole budget. Error is each
grid's RMSE relative to where it began, averaged over extinction and emission.
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
SPP = (2, 4, 8)
RATES, META_RATES = (0.01, 0.03), (0.001, 0.003)


def entrants() -> list[Entrant]:
    """Who races."""
    adam, meta = ur.optimizers.Adam, ur.optimizers.MetaAdam
    found = [Entrant(f"Adam, {n} spp", "Adam", ur.PathGradient(spp=n), adam, RATES) for n in SPP]
    found.append(Entrant("meta", "meta", ur.MetaEstimator(), meta, META_RATES))
    found.append(Entrant("coupled, 3 spp", "coupled", ur.MetaEstimator(coupled=True, spp=3), meta, META_RATES))
    return found


def plot(results: dict[str, Any]) -> None:
    """Error over time."""
    figure, axis = plt.subplots(figsize=(6.5, 4.5), layout="constrained")
    shades = dict(zip((f"Adam, {n} spp" for n in SPP), colours(len(SPP)), strict=True))
    for name, entry in results["methods"].items():
        shade = shades.get(name, "#1a8f4c" if name.startswith("coupled") else "#8fd3aa")
        draw(axis, entry, 0, shade, f"{name}: {entry['final'][0]:.3f}")
    axis.set(title="nerf-volume", xlabel="seconds", ylabel="parameter error / initial", yscale="log")
    axis.legend(fontsize=8)
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--resolution", type=int, default=32)
    parser.add_argument("--grid", type=int, default=64)
    asked = parser.parse_args()
    ur.use()
    problem = ur.gallery.problem("nerf-volume", resolution=asked.resolution, grid_resolution=asked.grid)
    write(HERE, {"settings": vars(asked), "methods": race(problem, entrants(), asked.seeds, seconds=asked.seconds)})
    plot(read(HERE))


if __name__ == "__main__":
    main()
