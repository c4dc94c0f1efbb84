"""Coarse to fine: what states should do at a change of resolution, at equal steps.

    python benchmarks/coarse_to_fine/run.py smoke plain rcv --variants none reset

Per variant and seed: the parameters' error and the loss over the last steps. Variants: "none" (the finest resolution from the start),
"reset" (all states begun anew), "carry-1", "carry-1.5" and "carry-2" (all carried, mean squares times n^-1 to n^-2, see
`unrender.training.refining`), "estimator" (only the estimator's carried, as by default).
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import unrender as ur
from unrender.methods import method
from unrender.training import refining

SEEDS, LAST = 3, 10
VARIANTS = ("none", "reset", "carry-1", "carry-1.5", "carry-2", "estimator")
PROBLEMS = {
    "smoke": ({"resolution": 16, "grid_resolution": 16, "views": 4, "reference_spp": 256}, (40, 80), 120),
    "indirect-room L2": (
        {"resolution": 32, "texture_resolution": 32, "reference_spp": 256, "loss": "L2"},
        (50, 100),
        150,
    ),
    "indirect-room": ({"resolution": 32, "texture_resolution": 32, "reference_spp": 256}, (50, 100), 150),
}


def main(name: str, methods: list[str], variants: list[str]) -> None:
    options, changes, steps = PROBLEMS[name]
    base = ur.gallery.problem(name.split()[0], **options)
    path = Path(__file__).parent / "results.json"
    results = json.loads(path.read_text()) if path.exists() else {}
    for chosen in methods:
        for variant in variants:
            refining.SQUARES = float(variant.partition("-")[2] or 2)
            states = variant if variant in ("reset", "estimator") else "carry"
            way = None if variant == "none" else ur.CoarseToFine(changes, states=states)
            parameters = [replace(p, coarse_to_fine=way) for p in base.parameters]
            problem = ur.Problem(
                base.renderer, parameters, base.given_views, base.loss, base.max_depth, truth=base.truth, name=name
            )
            rows = []
            for seed in range(SEEDS):
                estimator, optimizer = method(chosen).start({})
                started = time.perf_counter()
                found = ur.optimize(problem, estimator, optimizer, steps, seed=seed)
                row = {
                    "error": problem.parameter_error(found.parameters),
                    "loss": float(np.mean([record["loss"] for record in found.history[-LAST:]])),
                    "jump": [
                        found.history[change + 5]["loss"] / found.history[change - 1]["loss"] for change in changes
                    ],
                    "seconds": found.seconds,
                    "wall": time.perf_counter() - started,
                }
                rows.append(row)
            errors = {key: [row["error"][key] for row in rows] for key in rows[0]["error"]}
            losses = [row["loss"] for row in rows]
            shown = {key.split(".")[-2]: f"{np.mean(e):.4f}±{np.std(e):.4f}" for key, e in errors.items()}
            jump = np.mean([row["jump"] for row in rows], axis=0)
            print(
                f"{name} {chosen:8} {variant:8} loss {np.mean(losses):.5f}±{np.std(losses):.5f} error {shown} "
                f"jump {jump.round(2)} seconds {np.mean([row['seconds'] for row in rows]):.1f} wall {rows[-1]['wall']:.1f}",
                flush=True,
            )
            results.setdefault(name, {}).setdefault(chosen, {})[variant] = {"errors": errors, "losses": losses}
    path.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    ur.use("llvm_ad_rgb")
    parser = argparse.ArgumentParser()
    parser.add_argument("problem", choices=PROBLEMS)
    parser.add_argument("methods", nargs="+")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=VARIANTS)
    asked = parser.parse_args()
    main(asked.problem, asked.methods, asked.variants)
