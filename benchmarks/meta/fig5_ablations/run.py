"""What each part of meta-estimation is for (Balint et al. 2023, Fig. 5): `ajar`, one part left out at a time, each tuned.

    python benchmarks/meta/fig5_ablations/run.py [--seconds 5] [--seeds 2] [--resolution 48]

Left out: the zero-centred moments (variances about the mean instead), the bound of alpha, the shared samples (statistics from
independent ones, at twice the cost), the decoupling of the difference's variance from the step. Both forms.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import read, write
from races import Entrant, draw, race

import unrender as ur

HERE = Path(__file__).resolve().parent
RATES = (0.0003, 0.001)
ABLATIONS: dict[str, tuple[dict[str, Any], str]] = {
    "whole": ({}, "#1f6fb4"),
    "centred variances": ({"centred": True}, "#d1782a"),
    "alpha not bounded": ({"clip": False}, "#c0392b"),
    "independent statistics": ({"statistics": "independent"}, "#8a3fa8"),
    "not decoupled": ({"decouple": False}, "#777777"),
}
FORMS = {"meta": {}, "coupled": {"coupled": True, "spp": 3}}


def entrants() -> list[Entrant]:
    """Both forms, whole and with each part left out."""
    return [
        Entrant(f"{form}, {name}", name, ur.MetaEstimator(**kind, **options), ur.optimizers.MetaAdam, RATES)
        for form, kind in FORMS.items()
        for name, (options, _) in ABLATIONS.items()
    ]


def plot(results: dict[str, Any]) -> None:
    """Error over seconds, one panel per form."""
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.2), sharey=True, layout="constrained")
    for axis, form in zip(axes, FORMS, strict=True):
        for name, (_, colour) in ABLATIONS.items():
            found = results["methods"][f"{form}, {name}"]
            draw(axis, found, 0, colour, f"{name}, rate {found['rate']:g}: {found['final'][0]:.3f}")
        axis.set(title=f"ajar, {form}", xlabel="seconds", ylabel="parameter error / initial", yscale="log")
        axis.legend(fontsize=7)
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--resolution", type=int, default=48)
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        ur.use()
        problem = ur.gallery.problem("ajar", resolution=asked.resolution)
        found = race(problem, entrants(), asked.seeds, seconds=asked.seconds)
        write(HERE, {"seconds": asked.seconds, "resolution": asked.resolution, "seeds": asked.seeds, "methods": found})
    plot(read(HERE))


if __name__ == "__main__":
    main()
