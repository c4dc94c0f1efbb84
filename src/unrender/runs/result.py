"""Result of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unrender.core import checks
from unrender.runs.folder.contents import write_result
from unrender.runs.folder.history import steps_in

if TYPE_CHECKING:
    from unrender.runs.verification import Misfit

INTERRUPTED, TERMINATED, NON_FINITE = "interrupted", "terminated", "non-finite"
"""Reasons for a run to stop (`Result.stopped`) before its budget is used up: Ctrl-C or a stop command, SIGTERM, and gradients that are
not finite."""


@dataclass(frozen=True, repr=False, eq=False)
class Result:
    """Result of `optimize`.

    Attributes:
        parameters: {key: array}, float32, the recovered values: the best ones that new images verify, see `verification`. Numbers and
            colours are means over the last steps where these have become stationary; `adapted` contains the number of these steps.
        initial: {key: array}, the initial values.
        last: {key: array}, the values after the last step; equal to `parameters` unless means or earlier values were better.
        history: one dictionary per step (in a run folder with millions of steps, per second, fourth, ... of the earlier ones): "step" (from
            0), "seconds" (of optimisation so far, without warm-up and callbacks), "loss", "samples" (paths traced so far), "gradient_noise"
            (fraction in [0, 1] or None), and, if the truth is known, "parameter_error" ({key: error}, see `Problem.parameter_error`) at
            intervals and at the last step. For parameters with a coarse initial resolution, "resolution" ({key: texels along each axis}) at
            the first step of each resolution. For meshes, "faces" ({key: number of triangles}) at the first step after each remeshing.
        seconds: seconds of optimisation.
        warmup_seconds: seconds of tracing and compiling kernels before the first step.
        stopped: "steps", "seconds" or "callback" (finished); "interrupted" (Ctrl-C, or a stop command) or "terminated"
            (SIGTERM); "non-finite" (failed).
        skipped: number of steps that were not applied because the gradient or loss was not finite.
        warnings: one line each.
        info: information of the last estimate, as NumPy arrays.
        name, method, settings, seed, command, problem: description of the run.
        choices: choices of the method for the problem and their reasons, one line each.
        adapted: settings that the optimizer has adapted, such as the changes of its learning rates, one line each.
        resumed: steps at which it was resumed.
        truth: {key: array} of known true values.
        misfit: difference of the final pictures from the references that noise does not explain: its size, its `share` of the picture,
            its warning (`line`), and the `causes` that are no fault of the scene; None if there is none.
        verification: results of new images, see `runs.verify`; empty if there were none. "status", "start", "end" and "best_loss" (loss
            and its standard error), "best" ("start", "step N" or "end"), "paths" (of each image), and "memory" (the root mean square
            "error" of a control variate, and of the "picture"). "change" holds the change of the "loss" since a "step", and its standard
            error, if the end is best.
        image_errors: {"view0/initial": (error, standard error), "view0/result": ...}: root mean square differences between the reference
            and the image's expectation, without rendering noise; see `statistics.debiased`.
        standard_error: {key: array} of the parameters' shapes: standard deviation of each number from the noise of this run's renderings
            and of the references, infinite where the images do not determine it, or call for one beyond a bound. Runs with a run folder
            have it for up to 24 elements of numbers, also if textures and grids are unknown. There is none if the test cannot change
            another unknown, or has no time; a line of `undetermined` says so. Other runs have it if all unknowns are numbers that
            `AveragedNewton` optimises; for the rest call `unrender.runs.uncertainty`. Few numbers have none where the final picture
            differs from the references by more than noise; a warning says so. Textures of runs with a run folder have a map, see
            `unrender.runs.uncertainty`.
        data_share: {key: array} of the parameters' shapes, in [0, 1], for textures: weight of the references in each element, see
            `unrender.runs.uncertainty`. {} for runs without a run folder.
        without_errors: one line for each texture or grid without a map of standard errors: the reason. Without a run folder, one for each
            unknown without standard errors.
        phases: {phase: seconds} in order: on the command line, earlier phases such as loading; then "compiling", "steps", "checkpoints
            and callbacks", "verification", "final pictures". For a resumed run, those of the last session.
        sensitivity: {key: array} of the parameters' shapes: change of the images per unit of each element, as root sum of squares over
            all pixels and channels, see `unrender.runs.sensitivity`. {} for runs without a run folder, and for parameters without path
            gradients. Where it is small, the images do not determine the element.
        pictures: {"view0/reference": (H, W, 3), ...}, linear, for reports.
        undetermined: one line for each unknown that the images do not determine, see `runs.determination`; empty for runs without a run
            folder.
        pixel_weights: weights of each view's pixels in Gauss-Newton steps with a `noise_limit`, (H, W, 1) or (H, W, 3), which
            `unrender.runs.uncertainty` needs; () if equal, and in results that are read from a run folder.
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
    data_share: Mapping[str, np.ndarray] = field(default_factory=dict)
    phases: Mapping[str, float] = field(default_factory=dict)
    meshes: Mapping[str, np.ndarray] = field(default_factory=dict)
    pixel_weights: Sequence[np.ndarray] = ()
    undetermined: Sequence[str] = ()
    without_errors: Sequence[str] = ()
    last: Mapping[str, np.ndarray] = field(default_factory=dict)
    verification: Mapping[str, Any] = field(default_factory=dict)
    misfit: Misfit | None = None

    def __post_init__(self) -> None:
        if not self.last:
            object.__setattr__(self, "last", self.parameters)

    def __repr__(self) -> str:
        from unrender.runs import notebook

        return notebook.line(self)

    def _repr_html_(self) -> str:
        from unrender.runs import notebook

        return notebook.html(self)

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
        """End of the run: "finished", "interrupted" or "failed".

        A run that used up its budget may also be "worse than start" (the final image is worse than the initial one), "memory disagrees" (a
        control variate differs from a new image), or "does not fit" (the final image differs from the references after enough steps).
        """
        if self.stopped in (INTERRUPTED, TERMINATED):
            return "interrupted"
        return "failed" if self.stopped == NON_FINITE else str(self.verification.get("status", "finished"))

    def save(self, directory: str | Path, status: str | None = None) -> Path:
        """Write the run folder: run.json, history.jsonl, and the arrays. last.npz is written if `last` differs from `parameters`.

        Each file is written atomically, and is on disk when this returns. run.json, with `status` (None for the result's), comes last.
        Raises `InputError` if it is no folder, or not writable.
        """
        folder = checks.path("save: directory", directory)
        write_result(folder, self, status or self.status)
        return folder
