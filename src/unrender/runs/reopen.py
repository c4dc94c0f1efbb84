"""Run folders opened again: the problem that a run was of, and the run itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from unrender import gallery
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.estimators.base import Estimator
from unrender.io import bounded_files, toml_lines
from unrender.optimizers.base import Optimizer
from unrender.rendering.renderer import ReplacedMesh
from unrender.runs.callbacks import Callback
from unrender.runs.folder.reader import RunFolder, read_run_record
from unrender.runs.remeshing import remeshed
from unrender.runs.result import Result
from unrender.runs.resume import load_run, resume_run
from unrender.scene import serialization
from unrender.scene.problem import Problem

_LONGEST = 1 << 24


@exclusive("resume", long=True)
def resume(
    directory: str | Path,
    problem: Problem | None = None,
    steps: int | None = None,
    seconds: float | None = None,
    force: bool = False,
    callbacks: Sequence[Callback] = (),
    estimator: Estimator | None = None,
    optimizer: Optimizer | None = None,
) -> Result:
    """Take up a run where its last checkpoint left it: interrupted, killed, or finished and to be given more.

    The resumed run is the one that would have been without the interruption, its clock included: bit for bit on LLVM with one thread
    (see `optimize` for more threads). What was done after the checkpoint is done again, the same.

    Args:
        directory: the run folder.
        problem: what it was a run of; None makes it again from the folder, which goes for problem files, XML scenes and the gallery's.
        steps, seconds: a budget in place of the run's, counted from its start.
        force: go on though problem, versions or scene files are not as they were.
        callbacks: listeners.
        estimator, optimizer: in place of those of method.toml; needed for components that are not registered (`unrender.register`).

    Raises:
        InputError: no run folder, a malformed one, one in use; finished and no larger budget; something changed since, which the message
            says; or no checkpoint can be read.
    """
    found = load_run(directory, steps, seconds)
    return resume_run(found, problem or problem_of(directory), force, callbacks, estimator, optimizer)


def with_meshes(problem: Problem, run: RunFolder) -> Problem:
    """The problem with the triangles that a run's meshes ended with, where they were remeshed on the way."""
    replaced = {
        key: ReplacedMesh(run.parameters[key].reshape(-1, 3), mesh.faces, mesh.uv)
        for key, mesh in run.meshes.items()
        if key in problem.faces and not np.array_equal(mesh.faces, problem.faces[key])
    }
    return remeshed(problem, replaced) if replaced else problem


def problem_of(directory: str | Path) -> Problem:
    """The problem that a run folder is of, made again.

    From the problem file that it came from, where that is still there (so what changed in it is noticed), else from the folder's own copy.

    Raises:
        InputError: it was made in Python, or problem.toml is malformed.
    """
    folder = Path(directory)
    origin = read_run_record(folder).problem.origin
    path = folder / serialization.FILE
    if not bounded_files.exists(path):
        raise InputError(
            f"{path}: no such file: Result.save keeps no problem; pass it, as unrender.app.export((problem, result.parameters), "
            "out), or keep a whole run, with run_directory="
        )
    stored = toml_lines.parse(bounded_files.read_text(path, _LONGEST, folder), str(path))
    if "gallery" in stored:
        name, options = stored["gallery"], stored.get("options", {})
        if not isinstance(name, str) or not isinstance(options, dict) or set(stored) - {"gallery", "options"}:
            raise InputError(f'{path}: expected gallery = "name" and a table [options], got {repr(stored)[:80]}')
        return gallery.problem(name, **options)
    if "scene" not in stored:
        raise InputError(
            f"{path}: the problem was made in Python; pass it, as unrender.resume(folder, problem) or "
            "unrender.app.export((problem, result.parameters), out)"
        )
    file = origin.get("file")
    return Problem.from_file(file if isinstance(file, str) and bounded_files.kind(Path(file)) == "file" else path)
