"""Result of a run."""

from __future__ import annotations

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
from unrender.core.text import plain
from unrender.io import files
from unrender.runs.folder import schema
from unrender.runs.folder.history import lines, steps_in

if TYPE_CHECKING:
    from unrender.runs.figure import ResultFigure

INTERRUPTED, TERMINATED, NON_FINITE = "interrupted", "terminated", "non-finite"
"""Reasons for a run to stop (`Result.stopped`) before its budget is used up: Ctrl-C or a stop command, SIGTERM, and gradients that are
not finite."""
PRUNED = "pruned"
"""Reason for a sweep's run to stop because its error is above that of other runs; such a run is finished."""


@dataclass(frozen=True, repr=False)
class Result:
    """Result of `optimize`.

    Attributes:
        parameters: {key: array}, float32, the recovered values: the best ones that new images verify, see `verification`. Numbers and
            colours are means over the last steps where these have become stationary; `adapted` tells how many steps.
        initial: {key: array}, the initial values.
        last: {key: array}, the values after the last step; equal to `parameters` unless means or earlier values were better.
        history: one dictionary per step (in a run folder with millions of steps, per second, fourth, ... of the earlier ones): "step"
            (from 0), "seconds" (of optimisation so far, without warm-up and callbacks), "loss", "samples" (paths traced so far),
            "gradient_noise" (fraction in [0, 1] or None), and, if the truth is known, "parameter_error" ({key: error}, see
            `Problem.parameter_error`) at intervals and at the last step. For parameters with a coarse initial resolution, "resolution"
            ({key: texels along each axis}) at the first step of each resolution.
        seconds: seconds of optimisation.
        warmup_seconds: seconds of tracing and compiling kernels before the first step.
        stopped: "steps", "seconds", "callback" or "pruned" (finished); "interrupted" (Ctrl-C, or a stop command) or "terminated"
            (SIGTERM); "non-finite" (failed).
        skipped: number of steps that were not applied because the gradient or loss was not finite.
        warnings: one line each.
        info: information of the last estimate, as NumPy arrays.
        name, method, settings, seed, command, problem: description of the run.
        choices: choices of the method for the problem and their reasons, one line each.
        adapted: settings that the optimizer has adapted, such as the changes of its learning rates, one line each.
        resumed: steps at which it was resumed.
        truth: {key: array} of known true values.
        verification: results of new images, see `runs.verify`; empty if there were none. "status", "start", "end" and "best_loss" (loss
            and its standard error), "best" ("start", "step N" or "end"), "paths" (of each image), and "memory" (the root mean square
            "error" of a control variate, and of the "picture").
        image_errors: {"view0/initial": (error, standard error), "view0/result": ...}: root mean square differences between the reference
            and the image's expectation, without rendering noise; see `statistics.debiased`.
        standard_error: {key: array} of the parameters' shapes: standard deviation of each number from the noise of this run's renderings,
            without the noise of the references and errors of other unknowns. Available for numbers optimised by `AveragedNewton`, after
            its last step, except for those with a share in a direction that the images hardly determine; and for numbers that are means
            over enough steps.
        phases: {phase: seconds} in order: "compiling", "steps", "checkpoints and callbacks", "final pictures", and, on the command line,
            earlier phases. For a resumed run, those of the last session.
        sensitivity: {key: array} of the parameters' shapes: change of the images per unit of each element, as root sum of squares over
            all pixels and channels, see `unrender.sensitivity`. {} for runs without a run folder, and for parameters without path
            gradients. Where it is small, the images do not determine the element.
        pictures: {"view0/reference": (H, W, 3), ...}, linear, for reports.
        undetermined: one line for each unknown that the images do not determine, see `runs.determination`; empty for runs without a run
            folder.
        meshes: {"KEY/faces": (F, 3), ...} of the parameters that are vertex positions, and the true surfaces, "KEY/true_vertices" and
            "KEY/true_faces", if known.
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
    standard_error: Mapping[str, np.ndarray] = field(default_factory=dict)
    phases: Mapping[str, float] = field(default_factory=dict)
    meshes: Mapping[str, np.ndarray] = field(default_factory=dict)
    undetermined: Sequence[str] = ()
    last: Mapping[str, np.ndarray] = field(default_factory=dict)
    verification: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.last:
            object.__setattr__(self, "last", self.parameters)

    def __repr__(self) -> str:
        from unrender.runs import notebook

        return notebook.line(self)

    def _repr_html_(self) -> str:
        from unrender.runs import notebook

        return notebook.html(self)

    def plot(self) -> ResultFigure:
        """Return a matplotlib figure with images of the views if there are any (`pictures`), recovered textures with truth and start, and
        curves.

        It belongs to no pyplot session: `result.plot().savefig("result.png")`.
        """
        from unrender.runs.figure import plot

        return plot(self)

    @property
    def steps(self) -> int:
        """Number of steps, including skipped ones."""
        return steps_in(self.history)

    @property
    def best(self) -> dict[str, np.ndarray]:
        """The best values that new images verify: `parameters`."""
        return self.parameters

    @property
    def status(self) -> str:
        """How the run ended: "finished", "interrupted" or "failed".

        A run that used up its budget may also be "worse than start" (the final image is worse than the initial one) or "memory disagrees"
        (a control variate differs from a new image).
        """
        if self.stopped in (INTERRUPTED, TERMINATED):
            return "interrupted"
        return "failed" if self.stopped == NON_FINITE else str(self.verification.get("status", "finished"))

    def save(self, directory: str | Path, status: str | None = None) -> Path:
        """Write the run folder: run.json, history.jsonl, and the arrays. last.npz is written if `last` differs from `parameters`.

        Each file is written atomically, and is on disk when this returns. run.json, with `status` (None for the result's), comes last.
        Raises `InputError` if the folder is not writable.
        """
        folder = Path(directory)
        record = self.encoded_record(status or self.status, "", folder / schema.RECORD)
        for key in self.parameters:
            files.check_member(key, f"run folder {folder}: parameter")
        try:
            files.make_folder(folder)
            archives = {schema.PARAMETERS: self.parameters, schema.INITIAL: self.initial, schema.TRUTH: self.truth}
            last = {} if self.last is self.parameters else dict(self.last)
            others = {schema.PICTURES: self.pictures, schema.SENSITIVITY: self.sensitivity, schema.MESHES: self.meshes}
            others[schema.LAST] = last
            for name, values in {**archives, **others}.items():
                if values or name in (schema.PARAMETERS, schema.INITIAL):
                    files.write_arrays(folder / name, values, name_too=False)
            if not last:
                (folder / schema.LAST).unlink(missing_ok=True)
            files.write(folder / schema.HISTORY, lines(self.history), name_too=False)
            files.sync_folder(folder)
            files.write(folder / schema.RECORD, record)
        except OSError as error:
            raise InputError(f"run folder {folder}: cannot be written: {error.strerror or error}") from error
        return folder

    def encoded_record(self, status: str, error: str, path: Path) -> bytes:
        """Return the bytes of run.json. Raises `InputError` that names `path` if the reader would reject them."""
        return schema.encode(schema.RunRecord, self.record(status, error), str(path))

    def record(self, status: str, error: str = "") -> dict[str, Any]:
        """Return the contents of run.json, see `schema.RunRecord`.

        Args:
            status: "running", or a value of `Result.status`.
            error: exception by which the run failed; "" for none.
        """
        if status == "failed" and not error:
            error = "stopped: the last gradients were not finite"
        fields: dict[str, Any] = {
            "status": status,
            "name": self.name,
            "method": self.method,
            "settings": dict(self.settings),
            "choices": list(self.choices),
            "adapted": [plain(line) for line in self.adapted],
            "seed": self.seed,
            "command": self.command,
            "versions": versions(),
            "hardware": hardware(),
            "variant": current() or "",
            "stopped": plain(self.stopped),
            "steps": self.steps,
            "seconds": self.seconds,
            "warmup_seconds": self.warmup_seconds,
            "skipped": self.skipped,
            "warnings": [plain(line) for line in self.warnings],
            "problem": dict(self.problem),
            "resumed": list(self.resumed),
            "image_errors": {
                name: list(error) for name, error in self.image_errors.items() if np.isfinite(error).all()
            },
            "undetermined": list(self.undetermined),
            "standard_error": {
                key: [float(f"{value:.6g}") for value in np.ravel(error)] for key, error in self.standard_error.items()
            },
            "verification": dict(self.verification),
            "phases": {name: round(seconds, 3) for name, seconds in self.phases.items()},
        }
        if error:
            fields["error"] = plain(error)
        return schema.serialize(schema.RunRecord.model_construct(None, **fields))


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages on which the numbers depend."""
    return dict(_versions())


@cache
def _versions() -> dict[str, str]:
    versions_by_package = {"python": platform.python_version()}
    for package in ("unrender", "mitsuba", "drjit", "numpy"):
        try:
            versions_by_package[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions_by_package[package] = "not installed"
    return versions_by_package


def deciding_versions() -> dict[str, str]:
    """Return the versions on which the bits of a run's numbers depend: packages, LLVM, the variant."""
    return dict(_deciding_versions(current() or "none"))


@cache
def _deciding_versions(name: str) -> dict[str, str]:
    versions_by_package = {name: version for name, version in versions().items() if name != "python"}
    for package in ("scipy", "cholespy", "cma"):
        versions_by_package[package] = metadata.version(package)
    llvm = llvm_version() if name == LLVM else None
    return {**versions_by_package, "variant": name, **({"llvm": ".".join(map(str, llvm))} if llvm else {})}


def hardware() -> dict[str, Any]:
    """Return the processor, and the number of cores that this process may use."""
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
