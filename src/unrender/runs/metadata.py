"""Description of a run in its result and run folder."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from typing import Any

import numpy as np

from unrender.estimators.base import Estimator
from unrender.rendering.parameter_errors import PLAIN
from unrender.runs.folder.meshes import arrays_of
from unrender.runs.run import Run
from unrender.scene.fingerprint import fingerprint
from unrender.scene.problem import Problem

PARTS = "estimator", "optimizer"
"""Parts of a run that decide its steps beside the problem."""
_ADDRESS = re.compile(r" at 0x[0-9a-f]+")


@dataclass(frozen=True)
class RunAnnotations:
    """Additional description of a run for its run folder.

    Attributes:
        method: name of the method; "" for the estimator's.
        settings: settings of the method, in types of JSON.
        choices: choices of the method and their reasons, one line each.
        final_spp: samples per pixel of the final images; None chooses.
        phases: {phase: seconds} before the run, such as loading.
        began: Time of `time.perf_counter` from which a budget in seconds counts, with loading, compiling and final images; None if it
            covers the steps alone.
    """

    method: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    choices: Sequence[str] = ()
    command: str = ""
    final_spp: int | None = None
    phases: Mapping[str, float] = field(default_factory=dict)
    began: float | None = None


def first_values(run: Run) -> dict[str, np.ndarray]:
    """Return {key: array} of a run before its first step, at the scene's resolution, without copies where equal to the problem's arrays."""
    known = run.problem.unknowns
    return {k: known[k].initial if np.array_equal(known[k].initial, x) else x for k, x in run.full().items()}


def describe(estimator: Estimator) -> str:
    """Return a short name: the class, the coupled form, and the class of the image estimator if any."""
    image = getattr(estimator, "image", None)
    words = ["coupled"] if getattr(estimator, "coupled", False) else []
    words += [type(image).__name__] if image is not None else []
    return type(estimator).__name__ + (f"({', '.join(words)})" if words else "")


def describe_run(run: Run, annotations: RunAnnotations) -> dict[str, Any]:
    """Return the fields of `Result` that are known before the first step."""
    problem = run.problem
    loss = repr(problem.loss) if is_dataclass(problem.loss) else type(problem.loss).__name__
    components = {"estimator": repr(run.estimator), "optimizer": repr(run.optimizer)}
    return {
        "name": problem.name,
        "method": annotations.method or describe(run.estimator),
        "settings": {**annotations.settings, **components, "steps": run.steps, "seconds": run.seconds},
        "choices": list(annotations.choices),
        "seed": run.seed,
        "command": annotations.command,
        "problem": {
            "parameters": [p.key for p in problem.parameters],
            "views": len(problem.views),
            "loss": loss,
            "max_depth": problem.max_depth,
            "measures": recorded_measures(problem),
            **({} if problem.executor.variant is None else {"workers": problem.executor.variant}),
        },
        "truth": problem.truth,
        "meshes": arrays_of(problem),
    }


def described(run: Run) -> dict[str, Any]:
    """Return the fields of `describe_run` that another plan for the problem changes."""
    before, parts = run.description, {"estimator": repr(run.estimator), "optimizer": repr(run.optimizer)}
    known = {"fingerprint": fingerprint_of(run)} if "fingerprint" in before["problem"] else {}
    return {
        "settings": {**before["settings"], **parts},
        "choices": list(run.plan.lines),
        "problem": {**before["problem"], **known},
    }


def recorded_measures(problem: Problem) -> dict[str, Any]:
    """Return the error measures as recorded in a run folder, without the default ones."""
    return {key: u.measure.record() for key, u in problem.unknowns.items() if u.measure != PLAIN}


def fingerprint_of(run: Run) -> dict[str, str]:
    """Return the fingerprints of the problem, the estimator and the optimizer, without memory addresses."""
    return fingerprint(run.problem) | {name: _ADDRESS.sub("", repr(getattr(run, name))) for name in PARTS}
