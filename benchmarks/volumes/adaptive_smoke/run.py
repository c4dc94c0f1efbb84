"""Drawn pixels of smoke (the adaptive sampling paper's SMOKE, at its end): uniform, by the loss derivative, adaptive. `smoke`, L2.

    python benchmarks/volumes/adaptive_smoke/run.py [--seconds 8] [--seeds 3] [--count 1024] [--resolution 64] [--grid 32]

Two paths per pixel, as many pixels for all, Adam, its learning rates tuned per scheme on a seed of its own for the whole budget: the
albedo's, extinction's being 10 times that. Errors as in `fig11_smoke`: root mean squares relative to the start, of extinction
and of extinction times albedo, averaged. At equal time; ratios to uniform at ten checkpoints, by time and by samples.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from adaptive.schemes import COLOURS, SCHEMES, pixels
from common import read, write
from judged import at, compete
from races import Entrant, draw, over
from smoke_error import measure

import unrender as ur

HERE = Path(__file__).resolve().parent
RATES = (0.003, 0.01)


def plot(results: dict[str, Any]) -> None:
    """Error over time, and over samples."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for axis, column, label in ((axes[0], 0, "seconds"), (axes[1], 1, "paths")):
        for name, entry in results["methods"].items():
            runs = {"runs": entry["runs"]["both"]}
            draw(axis, runs, column, COLOURS[name], f"{name}: {entry['final']['both'][0]:.3f}")
        axis.set(xlabel=label, ylabel="error / initial", yscale="log")
        axis.legend(fontsize=8)
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--count", type=int, default=1024)
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--grid", type=int, default=32)
    asked = parser.parse_args()
    ur.use()
    size = {"resolution": asked.resolution, "grid_resolution": asked.grid}
    problem = ur.gallery.problem("smoke", **size, loss="L2", reference_spp=1024)
    adam, methods = at(ur.optimizers.Adam), {}
    for scheme in SCHEMES:
        estimator = ur.PathGradient(pixels=pixels(scheme, asked.count), spp=2)
        entrant = Entrant(scheme, scheme, estimator, adam, RATES)
        methods[scheme] = compete(problem, entrant, measure(problem), "both", asked.seeds, seconds=asked.seconds)
    runs = {name: entry["runs"]["both"] for name, entry in methods.items()}
    ratios = over(runs, "uniform")
    for by, found in ratios.items():
        for name, ratio in found.items():
            print(by, name, [round(r, 3) for r in ratio])
    write(HERE, {"settings": vars(asked), "methods": methods, "over uniform": ratios})
    plot(read(HERE))


if __name__ == "__main__":
    main()
