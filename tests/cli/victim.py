"""A process whose children run and are killed: each forks off with everything imported, so that a hundred deaths take a minute.

    python victim.py < lines of "CASE FOLDER EVERY" > for each, the child's process id, and after another line its exit status

A child begins the run in FOLDER, or takes it up where there is one, with a checkpoint every EVERY steps. Analytic problems only: Dr.Jit's
threads would not survive the fork.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import unrender as ur
from tests.contract.analytic import problem
from unrender.images import RecursiveControlVariate

STEPS = 24
_optimizers, _schedules = ur.optimizers, ur.optimizers.schedules
CASES: dict[str, Callable[[], tuple[Any, Any]]] = {
    "plain-adam": lambda: (
        ur.PathGradient(spp=2),
        _optimizers.Adam(0.02, schedule=_schedules.Warmup(5, _schedules.Cosine(30))),
    ),
    "plain-sgd": lambda: (ur.PathGradient(spp=1), _optimizers.SGD(0.05, momentum=0.8)),
    "rcv-adam": lambda: (ur.PathGradient(RecursiveControlVariate(), spp=2), _optimizers.Adam(0.02)),
    "rcv-primary": lambda: (ur.PathGradient(RecursiveControlVariate("primary"), spp=2), _optimizers.SGD(0.1)),
    "uniform": lambda: (ur.PathGradient(pixels=ur.pixels.Uniform(8), spp=2), _optimizers.Adam(0.02)),
    "loss": lambda: (ur.PathGradient(pixels=ur.pixels.LossProportional(8, refresh=7), spp=2), _optimizers.Adam(0.02)),
    "adaptive": lambda: (
        ur.PathGradient(pixels=ur.pixels.Adaptive(8, refresh=7, denoiser="variation"), spp=2),
        _optimizers.Adam(0.02),
    ),
    "adaptive-rcv": lambda: (
        ur.PathGradient(RecursiveControlVariate(whole_views=5), ur.pixels.Adaptive(8, denoiser="none"), spp=2),
        _optimizers.Adam(0.02),
    ),
    "adaptive-coupled": lambda: (
        ur.MetaEstimator(coupled=True, spp=2, pixels=ur.pixels.Adaptive(8, denoiser="none")),
        _optimizers.MetaAdam(0.004),
    ),
    "meta": lambda: (ur.MetaEstimator(), _optimizers.MetaAdam(0.004)),
    "meta-independent": lambda: (ur.MetaEstimator(statistics="independent"), _optimizers.Adam(0.01)),
    "coupled": lambda: (ur.MetaEstimator(coupled=True, spp=3), _optimizers.MetaAdam(0.004)),
    "coupled-rcv": lambda: (
        ur.MetaEstimator(coupled=True, spp=2, image=RecursiveControlVariate()),
        _optimizers.MetaAdam(0.004),
    ),
    "smoothed-newton": lambda: (
        ur.SmoothedDerivatives(0.03, 32, "hessian", schedule=_schedules.Exponential(20)),
        _optimizers.Newton(trust_radius=None, inner_optimizer=_optimizers.Adam(0.02)),
    ),
    "smoothed-newton-cg": lambda: (ur.SmoothedDerivatives(0.03, 16, "hvp"), _optimizers.NewtonCG()),
    "smoothed-lbfgs": lambda: (ur.SmoothedDerivatives(0.03, 16), _optimizers.LBFGS(trust_radius=0.5)),
    "smoothed-adam": lambda: (ur.SmoothedDerivatives(0.03, 16), _optimizers.Adam(0.02)),
    "cma-es": lambda: (ur.estimators.LossValues(2), _optimizers.CMAES(0.1)),
}


def live(case: str, folder: Path, every: int) -> None:
    """Run from the start or from wherever the folder has come to."""
    made = problem(views=2)
    if (folder / "run.json").exists():
        if json.loads((folder / "run.json").read_text())["status"] != "finished":
            ur.resume(folder, made)
        return
    estimator, optimizer = CASES[case]()
    ur.optimize(made, estimator, optimizer, STEPS, run_directory=folder, checkpoint_every=every)


def main() -> None:
    for line in sys.stdin:
        case, folder, every = line.split()
        child = os.fork()
        if child == 0:
            status = 1
            try:
                live(case, Path(folder), int(every))
                status = 0
            finally:
                sys.stderr.flush()
                os._exit(status)
        print(child, flush=True)
        next(sys.stdin)  # until then, no other process can have its number
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    import cma  # noqa: F401 (a second to import: once, not in each child)

    main()
