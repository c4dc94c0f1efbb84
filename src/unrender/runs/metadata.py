"""What a result and a run folder say of a run beside what the run found."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from typing import Any

import numpy as np

from unrender.core import arrays
from unrender.estimators.base import Estimator
from unrender.rendering.parameter_errors import PLAIN
from unrender.runs.folder.meshes import arrays_of
from unrender.runs.result import Result
from unrender.runs.run import Run
from unrender.scene.fingerprint import fingerprint
from unrender.scene.problem import Problem

_ADDRESS = re.compile(r" at 0x[0-9a-f]+")


@dataclass(frozen=True)
class RunAnnotations:
    """What a run folder should say of its run beside what `optimize` knows.

    Attributes:
        method: its name; "" for the estimator's.
        settings: of the method, as JSON can hold them.
        choices: what the method chose and why, one line each.
        command: what was typed.
        final_spp: samples per pixel of the final pictures; None chooses.
        phases: {phase: seconds} of what came before, such as loading.
        within_seconds: Whether the budget in seconds covers compilation and final pictures too, not the steps alone.
        spent: Seconds of that budget that are gone before the run, such as those of loading.
    """

    method: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    choices: Sequence[str] = ()
    command: str = ""
    final_spp: int | None = None
    phases: Mapping[str, float] = field(default_factory=dict)
    within_seconds: bool = False
    spent: float = 0.0

    def deadline(self, seconds: float | None) -> float | None:
        """Return when a run that begins now and has this budget should be done, see `Run.deadline`; None where the steps alone count."""
        return time.perf_counter() + seconds - self.spent if self.within_seconds and seconds is not None else None


def first_values(run: Run) -> dict[str, np.ndarray]:
    """{key: array} of a run that has not begun, at the scene's own resolution: the problem's own arrays where they are equal, in place of
    copies of the run's."""
    known = run.problem.unknowns
    return {k: known[k].initial if np.array_equal(known[k].initial, x) else x for k, x in run.full().items()}


@dataclass
class RunMetadata:
    """What a result says beside what the run found.

    Attributes:
        description: fields of `Result`, see `describe_run`.
        initial: {key: array}, where the descent began.
        history: one record per step.
        warmup_seconds: of tracing and compiling.
    """

    description: dict[str, Any]
    initial: dict[str, np.ndarray]
    history: list[dict[str, Any]] = field(default_factory=list)
    warmup_seconds: float = 0.0

    def result(self, run: Run, warnings: Sequence[str] = (), info: bool = False, adapted: Sequence[str] = ()) -> Result:
        """What the run has reached so far.

        Args:
            run: the run.
            warnings: lines beside those of the run.
            info: whether to include `Estimate.info` of the last step.
            adapted: see `Result.adapted`.
        """
        return Result(
            parameters=run.full(),
            initial=self.initial,
            history=self.history,
            seconds=run.clock,
            warmup_seconds=self.warmup_seconds,
            stopped=run.stopped,
            skipped=run.skipped,
            warnings=[*run.warnings, *warnings],
            info=to_numpy(run.estimate.info) if info and run.estimate else {},
            adapted=list(adapted),
            **self.description,
        )


def describe(estimator: Estimator) -> str:
    """A short name: the class, whether it is the coupled form, and the class of its image where it has one."""
    image = getattr(estimator, "image", None)
    words = ["coupled"] if getattr(estimator, "coupled", False) else []
    words += [type(image).__name__] if image is not None else []
    return type(estimator).__name__ + (f"({', '.join(words)})" if words else "")


def describe_run(run: Run, annotations: RunAnnotations) -> dict[str, Any]:
    """Fields of `Result` that are known before the first step."""
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


def recorded_measures(problem: Problem) -> dict[str, Any]:
    """Return how errors are measured as a run folder records it: without the plain measures."""
    return {key: u.measure.record() for key, u in problem.unknowns.items() if u.measure != PLAIN}


def fingerprint_of(run: Run) -> dict[str, str]:
    """The problem's fingerprint, and those of estimator and optimizer: their representations without memory addresses."""
    components = {"estimator": run.estimator, "optimizer": run.optimizer}
    return fingerprint(run.problem) | {name: _ADDRESS.sub("", repr(part)) for name, part in components.items()}


def to_numpy(info: Any) -> Any:
    """`Estimate.info` with NumPy arrays in place of Dr.Jit's."""
    if isinstance(info, Mapping):
        return {key: to_numpy(value) for key, value in info.items()}
    return arrays.numpy(info) if arrays.is_drjit(info) else info
