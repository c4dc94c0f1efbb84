"""What a run leaves behind."""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unrender.backend.limits import cores
from unrender.backend.variant import LLVM, current, llvm_version
from unrender.core.errors import InputError
from unrender.io import files
from unrender.runs.folder import schema
from unrender.runs.folder.history import lines, steps_in

if TYPE_CHECKING:
    from unrender.runs.figure import ResultFigure

__all__ = ["INTERRUPTED", "NON_FINITE", "PRUNED", "TERMINATED", "Result", "deciding_versions", "hardware", "versions"]

INTERRUPTED, TERMINATED, NON_FINITE = "interrupted", "terminated", "non-finite"
"""Reasons for a run to stop (`Result.stopped`) before its budget is used up: Ctrl-C or a command to stop, SIGTERM, and gradients that
were not finite."""
PRUNED = "pruned"
"""Likewise, of a sweep's run whose error is above other runs' (finished)."""


@dataclass(frozen=True, repr=False)
class Result:
    """The outcome of `optimize`.

    Attributes:
        parameters: {key: array}, float32, the recovered values.
        initial: {key: array}, where the descent began.
        history: one dictionary per step (of a run of millions of steps in a run folder, per second, fourth, ... of the earlier
            ones): "step" (from 0), "seconds" (of optimization so far, warm-up and callbacks left out),
            "loss", "samples" (paths traced so far), "gradient_noise" (share in [0, 1] or None), and, where the truth is known,
            "parameter_error" ({key: root mean square error}) now and then and at the last step; of parameters that are coarse at
            first, "resolution" ({key: texels along each axis}) at the first step of each resolution.
        seconds: of optimization.
        warmup_seconds: of tracing and compiling kernels before the first step.
        stopped: "steps", "seconds", "callback" or "pruned" (finished); "interrupted" (Ctrl-C, or a command to stop) or "terminated"
            (SIGTERM); "non-finite" (failed).
        skipped: steps whose gradient or loss was not finite, and which were not applied.
        warnings: one line each.
        info: of the last estimate, as NumPy arrays.
        name, method, settings, seed, command, problem: what was run.
        choices: what the method chose for the problem and why, one line each.
        adapted: what the optimizer has found as it went, such as how far its rates have changed, one line each.
        resumed: the steps at which it was resumed.
        truth: {key: array} where it is known.
        image_errors: {"view0/initial": (error, standard error), "view0/result": ...}: root mean square differences between the
            reference and what the picture converges to, the noise of its rendering taken out; see `evaluation.debiased`.
        phases: {phase: seconds}: where the time went, in order: "compiling", "steps", "checkpoints and callbacks", "final pictures",
            and, of the command line, what came before. Of the last session, where the run was resumed.
        sensitivity: {key: array} of the parameters' shapes: by how much the images change per unit of each element, as the root of the sum
            of squares over all pixels and channels, see `unrender.sensitivity`; {} of runs without a run folder, and where path
            gradients do not reach the parameters. Where it is small, the images tell nothing.
        pictures: {"view0/reference": (H, W, 3), ...}, linear; what reports show.
        meshes: {"KEY/faces": (F, 3), ...} of the parameters that are vertex positions, and the true surfaces, "KEY/true_vertices" and
            "KEY/true_faces", where they are known.
    """

    parameters: dict[str, np.ndarray]
    initial: dict[str, np.ndarray]
    history: list[dict[str, Any]]
    seconds: float
    warmup_seconds: float
    stopped: str
    skipped: int = 0
    warnings: list[str] = field(default_factory=list)
    info: Mapping[str, Any] = field(default_factory=dict)
    name: str = "problem"
    method: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    choices: Sequence[str] = ()
    adapted: Sequence[str] = ()
    seed: int = 0
    command: str = ""
    problem: Mapping[str, Any] = field(default_factory=dict)
    resumed: Sequence[int] = ()
    truth: Mapping[str, np.ndarray] = field(default_factory=dict)
    pictures: Mapping[str, np.ndarray] = field(default_factory=dict)
    image_errors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    sensitivity: Mapping[str, np.ndarray] = field(default_factory=dict)
    phases: Mapping[str, float] = field(default_factory=dict)
    meshes: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __repr__(self) -> str:
        from unrender.runs import notebook

        return notebook.line(self)

    def _repr_html_(self) -> str:
        from unrender.runs import notebook

        return notebook.html(self)

    def plot(self) -> ResultFigure:
        """A matplotlib figure: pictures of the views where there are some (`pictures`), recovered maps beside truth and start, curves of
        parameter error and loss. It belongs to no pyplot session: `result.plot().savefig("result.png")`.
        """
        from unrender.runs.figure import plot

        return plot(self)

    @property
    def steps(self) -> int:
        """How many steps were taken, skipped ones among them."""
        return steps_in(self.history)

    @property
    def status(self) -> str:
        """ "finished", "interrupted", or "failed": given up, `parameters` those of the last step that was applied."""
        if self.stopped in (INTERRUPTED, TERMINATED):
            return "interrupted"
        return "failed" if self.stopped == NON_FINITE else "finished"

    def save(self, directory: str | Path, status: str | None = None) -> Path:
        """Write the run folder: run.json, history.jsonl, parameters.npz, initial.npz, truth.npz, pictures.npz, sensitivity.npz.

        Each file is written beside its place, renamed, and on the disk when this returns; run.json, with `status` (None for the result's
        own), comes last. Raises `InputError` where the folder cannot be written.
        """
        folder = Path(directory)
        try:
            files.make_folder(folder)
            archives = {schema.PARAMETERS: self.parameters, schema.INITIAL: self.initial, schema.TRUTH: self.truth}
            others = {schema.PICTURES: self.pictures, schema.SENSITIVITY: self.sensitivity, schema.MESHES: self.meshes}
            for name, values in {**archives, **others}.items():
                if values or name in (schema.PARAMETERS, schema.INITIAL):
                    files.write_arrays(folder / name, values, name_too=False)
            files.write(folder / schema.HISTORY, lines(self.history), name_too=False)
            files.sync_folder(folder)
            record = json.dumps(self.record(status or self.status), indent=2) + "\n"
            files.write(folder / schema.RECORD, record.encode())
        except OSError as error:
            raise InputError(f"run folder {folder}: cannot be written: {error.strerror or error}") from error
        return folder

    def record(self, status: str, error: str = "") -> dict[str, Any]:
        """run.json, see `schema.RunRecord`.

        Args:
            status: "running", "finished", "interrupted" or "failed".
            error: the exception by which the run failed; "" for none.
        """
        if status == "failed" and not error:
            error = "given up: the last gradients were not finite"
        fields: dict[str, Any] = {
            "status": status,
            "name": self.name,
            "method": self.method,
            "settings": dict(self.settings),
            "choices": list(self.choices),
            "adapted": list(self.adapted),
            "seed": self.seed,
            "command": self.command,
            "versions": versions(),
            "hardware": hardware(),
            "variant": current() or "",
            "stopped": self.stopped,
            "steps": self.steps,
            "seconds": self.seconds,
            "warmup_seconds": self.warmup_seconds,
            "skipped": self.skipped,
            "warnings": list(self.warnings),
            "problem": dict(self.problem),
            "resumed": list(self.resumed),
            "image_errors": {
                name: list(error) for name, error in self.image_errors.items() if np.isfinite(error).all()
            },
            "phases": {name: round(seconds, 3) for name, seconds in self.phases.items()},
        }
        if error:
            fields["error"] = error
        return schema.serialize(schema.RunRecord.model_construct(None, **fields))


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide the numbers."""
    return dict(_versions())


@cache
def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in ("unrender", "mitsuba", "drjit", "numpy"):
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def deciding_versions() -> dict[str, str]:
    """What decides the bits of a run's numbers, as far as versions can: packages, LLVM, the variant."""
    return dict(_deciding_versions(current() or "none"))


@cache
def _deciding_versions(name: str) -> dict[str, str]:
    found = {name: version for name, version in versions().items() if name != "python"}
    for package in ("scipy", "cholespy", "cma"):
        found[package] = metadata.version(package)
    llvm = llvm_version() if name == LLVM else None
    return {**found, "variant": name, **({"llvm": ".".join(map(str, llvm))} if llvm else {})}


def hardware() -> dict[str, Any]:
    """The processor and how many cores this process may use."""
    return dict(_hardware())


@cache
def _hardware() -> dict[str, Any]:
    return {"processor": _processor(), "cores": cores(), "system": f"{platform.system()} {platform.machine()}"}


def _processor() -> str:
    if sys.platform == "linux":
        try:
            for line in Path("/proc/cpuinfo").read_text().splitlines():
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
        except OSError:
            pass
    return platform.processor() or platform.machine()
