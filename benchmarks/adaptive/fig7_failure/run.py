"""Where adaptive probabilities fail (Fig. 7 of the paper): a caustic, which paths from the camera find by chance.

    python benchmarks/adaptive/fig7_failure/run.py [--resolution 64] [--many 1024]

Maps of probabilities estimated from few and from many paths per pixel, undenoised, without levels; how far the first are from the last
(correlation of their logarithms, over repeated estimates), and the same on `plain-and-textured`, where they are not.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import read, write

import unrender as ur
from unrender.keys import Key

HERE = Path(__file__).resolve().parent
PROBLEMS = ("caustic", "plain-and-textured")


def maps(problem: ur.Problem, spp: int, seed: int) -> np.ndarray:
    """Probabilities over uniform ones, one per pixel of view 0."""
    height, width = problem.renderer.resolutions()[problem.views[0].sensor]
    scheme = ur.pixels.Adaptive(
        256, levels=0, samples=spp * height * width * len(problem.views), denoiser="none", uniform=0.01
    )
    at = problem.initial()
    problem.renderer.select(list(at), None)
    pick, _ = scheme.draw(problem, at, scheme.init(problem, at), Key(seed))
    return pick.probability[0]


def alike(a: np.ndarray, b: np.ndarray) -> float:
    """The correlation of two maps' logarithms."""
    return float(np.corrcoef(np.log(a).ravel(), np.log(b).ravel())[0, 1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--many", type=int, default=1024, help="paths per pixel of the map to compare with")
    parser.add_argument("--repeats", type=int, default=5)
    asked = parser.parse_args()
    ur.use()
    found: dict[str, Any] = {}
    kept: dict[str, np.ndarray] = {}
    for name in PROBLEMS:
        problem = ur.gallery.problem(name, resolution=asked.resolution)
        many = [maps(problem, asked.many, 100 + seed) for seed in range(2)]
        entry = {"many": alike(*many)}
        for spp in (2, 4, 16, 64):
            likeness = [alike(maps(problem, spp, seed), many[0]) for seed in range(asked.repeats)]
            entry[f"{spp}"] = float(np.mean(likeness))
        found[name] = entry
        print(name, entry, flush=True)
        kept |= {
            f"{name}/reference": np.asarray(problem.views[0].reference),
            f"{name}/few": maps(problem, 4, 0),
            f"{name}/many": many[0],
        }
    stored: dict[str, Any] = {key.replace("/", "|"): value for key, value in kept.items()}
    np.savez_compressed(HERE / "maps.npz", **stored)
    write(HERE, {"settings": vars(asked), "correlation": found})
    plot(read(HERE))


def plot(results: dict[str, Any]) -> None:
    """Reference, map from few paths, map from many."""
    stored = np.load(HERE / "maps.npz")
    figure, axes = plt.subplots(len(PROBLEMS), 3, figsize=(9, 3.2 * len(PROBLEMS)), layout="constrained")
    for row, name in zip(axes, PROBLEMS, strict=True):
        row[0].imshow(np.clip(stored[f"{name}|reference"], 0, 1) ** (1 / 2.2))
        row[0].set_title(name)
        for axis, which in zip(row[1:], ("few", "many"), strict=True):
            axis.imshow(stored[f"{name}|{which}"], cmap="magma", norm="log")
            spp = 4 if which == "few" else results["settings"]["many"]
            likeness = results["correlation"][name]["4" if which == "few" else "many"]
            axis.set_title(f"{spp} paths per pixel, correlation {likeness:.2f}")
        for axis in row:
            axis.axis("off")
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


if __name__ == "__main__":
    main()
