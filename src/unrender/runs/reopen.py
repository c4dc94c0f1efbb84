"""Reopening of run folders: the problem of a run, and the run itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from unrender import gallery
from unrender.core import checks
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.estimators.base import Estimator
from unrender.io import bounded_files, toml_lines
from unrender.optimizers.base import Optimizer
from unrender.rendering.renderer import ReplacedMesh
from unrender.runs.callbacks import Callback
from unrender.runs.folder.meshes import surfaces_in
from unrender.runs.folder.reader import RunFolder, read_run_record
from unrender.runs.folder.schema import MESHES
from unrender.runs.refinement import remeshed
from unrender.runs.result import Result
from unrender.runs.resume import load_run, resume_run
from unrender.scene import serialization
from unrender.scene.fingerprint import differences, fingerprint, shortened
from unrender.scene.problem import Problem

_LONGEST = 1 << 24

_SCENE = ("scene", "file ", "max_depth", "expression ")
"""First words of the parts of a fingerprint that decide the pictures of given parameters."""


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
    """Resume a run from its last checkpoint, whether it was interrupted, killed, or finished and gets a larger budget.

    The resumed run equals an uninterrupted one, including its clock: bit for bit on LLVM with one thread (see `optimize` for more
    threads). Steps after the checkpoint are repeated identically.

    Args:
        directory: the run folder.
        problem: problem of the run; None recreates it from the folder, which works for problem files, XML scenes and gallery problems.
        steps, seconds: a budget that replaces the run's, counted from its start.
        force: whether to continue although the problem, versions or scene files have changed.
        callbacks: callbacks that observe the run.
        estimator, optimizer: components that replace those of method.toml; required for components that are not registered
            (`unrender.register`).

    Raises:
        InputError: the run folder is missing, malformed or in use; the run is finished and the budget is not larger; something has
            changed, which the message names; or no checkpoint is readable.
    """
    directory = checks.path("resume: directory", directory)
    stored = load_run(directory, steps, seconds)
    return resume_run(stored, problem or problem_of(directory), force, callbacks, estimator, optimizer)


def with_meshes(problem: Problem, run: RunFolder) -> Problem:
    """Return the problem with the final triangles of a run's meshes, if they were remeshed."""
    replaced = {
        key: ReplacedMesh(run.parameters[key].reshape(-1, 3), mesh.faces, mesh.uv)
        for key, mesh in run.meshes.items()
        if key in problem.faces and not np.array_equal(mesh.faces, problem.faces[key])
    }
    return remeshed(problem, replaced) if replaced else problem


def scene_changes(problem: Problem, run: RunFolder) -> list[str]:
    """Return a notice if the reopened scene is no longer that of the run, whose result suits that scene only; else nothing."""
    before = run.record.problem.fingerprint
    parts = [] if before is None else differences(_of_scene(before), _of_scene(fingerprint(problem)))
    if not parts:
        return []
    return [f"{run.path}: the result is of an earlier scene, since {shortened(parts)}; run again for the present one"]


def _of_scene(parts: Mapping[str, str]) -> dict[str, str]:
    return {name: text for name, text in parts.items() if name.startswith(_SCENE)}


def problem_of(directory: str | Path) -> Problem:
    """Recreate the problem of a run folder.

    It is read from the original problem file, if it still exists (so that changes are detected), else from the folder's copy. Raises
    `InputError` if the problem was made in Python, or problem.toml is malformed.
    """
    folder = Path(directory)
    origin = read_run_record(folder).problem.origin
    path = folder / serialization.FILE
    if not bounded_files.exists(path):
        raise InputError(
            f"{path}: no such file: Result.save stores no problem; pass it, as unrender.resume(folder, problem) and "
            "unrender.app.export((problem, result.parameters), out), or store a complete run, with run_directory="
        )
    stored = toml_lines.parse(bounded_files.read_text(path, _LONGEST, folder), str(path))
    if "gallery" in stored:
        name, options = stored["gallery"], stored.get("options", {})
        if not isinstance(name, str) or not isinstance(options, dict) or set(stored) - {"gallery", "options"}:
            raise InputError(f'{path}: expected gallery = "name" and a table [options], got {repr(stored)[:80]}')
        return gallery.problem(name, **options)
    loss = stored.get("loss")
    if "scene" not in stored or (isinstance(loss, str) and "." in loss.partition("(")[0]):  # such as __main__.function
        raise InputError(
            f"{path}: the problem was made in Python; pass it, as unrender.resume(folder, problem) or "
            "unrender.app.export((problem, result.parameters), out)"
        )
    file = origin.get("file")
    problem = Problem.from_file(file if isinstance(file, str) and bounded_files.kind(Path(file)) == "file" else path)
    return _with_surfaces(problem, folder)


def _with_surfaces(problem: Problem, folder: Path) -> Problem:
    """Return the problem with the true surfaces of a run folder, which problem files do not have."""
    if not problem.faces or not bounded_files.exists(folder / MESHES):
        return problem
    known = surfaces_in(bounded_files.read_float_arrays(folder / MESHES, folder))
    unknowns = {key: replace(problem.unknowns[key], surface=x) for key, x in known.items() if key in problem.faces}
    return problem.with_parts(unknowns={**problem.unknowns, **unknowns})
